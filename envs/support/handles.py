"""Handles of C++ libraries (thread pools, GL contexts): each belongs to one process, and to one object in it."""

from __future__ import annotations

import atexit
import ctypes
import os
import weakref
from collections.abc import Callable
from typing import Any, Generic, TypeVar

T = TypeVar("T")


class Handle(Generic[T]):
    """What `make` makes, when it is first asked for; a copy, a pickle and a forked process make one of their own.

    make: with its arguments (`functools.partial`), which copies and pickles take along. close: what ends it, with this
    handle or with the process.
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
            if self._close is not None:  # at exit, before the library is gone: finalize's own place can be after
                self._end = weakref.finalize(self, self._close, made)
                atexit.register(self._end)
        return self._made[0]

    def __reduce__(self) -> tuple[Any, ...]:
        return Handle, (self._make, self._close)

    def _abandon(self) -> None:
        """Forget what the parent process made: its threads are not here, and its destructor would wait for them."""
        if self._end is not None:
            self._end.detach()
        for made in self._made:
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(made))  # so that it is never destroyed, at exit neither
        self._made.clear()


_HANDLES: weakref.WeakSet[Handle[Any]] = weakref.WeakSet()


def _forked() -> None:
    for handle in list(_HANDLES):
        handle._abandon()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)
