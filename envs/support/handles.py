"""Handles of C++ resources (thread pools, GL contexts), each of which belongs to one process and one object in it."""

import atexit
import ctypes
import os
import weakref
from collections.abc import Callable
from typing import Any, Generic, TypeVar

T = TypeVar("T")


class Handle(Generic[T]):
    """A resource that is created on first use; a copy, an unpickled handle and a forked process create their own.

    make: creates it, with its arguments bound (`functools.partial`), since copies and pickles hold `make`. close: frees
    it, when this handle or the process ends.
    """

    def __init__(self, make: Callable[[], T], close: Callable[[T], None] | None = None) -> None:
        self._make, self._close = make, close
        self._made: list[T] = []
        self._end: weakref.finalize[Any, Any] | None = None
        _HANDLES.add(self)

    def __call__(self) -> T:
        if not self._made:
            made = self._make()
            self._made.append(made)
            if self._close is not None:  # at exit, before the library is unloaded, which finalize alone does not ensure
                self._end = weakref.finalize(self, self._close, made)
                atexit.register(self._end)
        return self._made[0]

    def __reduce__(self) -> tuple[Any, ...]:
        return Handle, (self._make, self._close)

    @staticmethod
    def abandon_all() -> None:
        """Drop the parent process's resources undestroyed: a destructor would wait for threads that a fork lacks."""
        for handle in list(_HANDLES):
            if handle._end is not None:
                handle._end.detach()
            for made in handle._made:
                ctypes.pythonapi.Py_IncRef(ctypes.py_object(made))  # so that it is never destroyed, not even at exit
            handle._made.clear()


_HANDLES: weakref.WeakSet[Handle[Any]] = weakref.WeakSet()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=Handle.abandon_all)
