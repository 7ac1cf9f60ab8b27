"""What is named from outside: `path/file.py:name`, or `package.module:name`."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import inspect
import os
import sys
import traceback
from pathlib import Path
from types import ModuleType
from typing import Any

from deconfounded.envs.support.errors import InputError

SENT = "DECONFOUNDED_OUTSIDE"  # in the environment of a worker elsewhere: the folder that such files were sent to

RUN = "outside_"  # the beginning of the name of a module that was a file


def is_outside(reference: str) -> bool:
    """Whether it names something by where it is, and not a registered one."""
    return ":" in reference


def find(kind: str, reference: str) -> Any:
    """The object named. kind: what it should be, for the error.

    A file is run once, as Python runs a script: what lies beside it can be imported, after all that is installed.
    Raises InputError if there is no such file, module or name in it, or if running it fails.
    """
    where, _, name = reference.rpartition(":")
    if not where or not name:
        raise InputError(f"{kind} was {reference!r}; from outside it must be path/file.py:name or package.module:name")
    if where.endswith(".py") and not here(Path(where)).is_file():
        raise InputError(f"{kind} {reference!r}: there is no file {where}")
    try:
        module = _run(here(Path(where))) if where.endswith(".py") else importlib.import_module(where)
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        raise InputError(f"{kind} {reference!r}: {told(error)}") from error
    if not hasattr(module, name):
        known = [key for key in vars(module) if not key.startswith("_")]
        raise InputError(f"{kind} {reference!r}: {where} has no {name!r}; it has {', '.join(known)}")
    return getattr(module, name)


def told(error: BaseException) -> str:
    """An error as part of one line: what it says, its type, and where it came from. One of ours says enough."""
    text = " ".join(str(error.args[0] if isinstance(error, KeyError) and error.args else error).split())
    if isinstance(error, InputError):
        return text
    if isinstance(error, SyntaxError) and error.filename:
        return f"{error.msg} ({type(error).__name__}, {Path(error.filename).name}:{error.lineno})"
    frame = traceback.extract_tb(error.__traceback__)[-1]
    return f"{text} ({type(error).__name__}, {Path(frame.filename).name}:{frame.lineno})"


def absolute(reference: str) -> str:
    """The same, wherever it is read from."""
    where, colon, name = reference.rpartition(":")
    return f"{Path(where).resolve()}:{name}" if where.endswith(".py") else f"{where}{colon}{name}"


def reference(cls: type) -> str:
    """What `find` takes for a class in another process, whatever that has imported; "" if it cannot be named so."""
    if cls.__qualname__ != cls.__name__:
        return ""
    if cls.__module__ in ("__main__", "__mp_main__") or cls.__module__.startswith(RUN):
        return f"{file}:{cls.__name__}" if (file := source(cls)) else ""
    return f"{cls.__module__}:{cls.__name__}"


def file(reference: str) -> Path | None:
    """Where it is defined, without running it; None for a module that has no file."""
    where, _, _ = reference.rpartition(":")
    if where.endswith(".py"):
        return here(Path(where)).resolve()
    spec = importlib.util.find_spec(where)
    return Path(spec.origin).resolve() if spec is not None and spec.origin else None


def here(path: Path) -> Path:
    """Where a file is on this machine: where it always was, or where a cluster sent it."""
    sent = Path(os.environ[SENT], *path.parts[1:]) if SENT in os.environ and path.is_absolute() else path
    return sent if sent.exists() else path


def source(of: Any) -> Path | None:
    """The file that defines a class or function, or the class of an object; None if it has none."""
    try:
        return Path(inspect.getfile(of if inspect.isclass(of) or inspect.isroutine(of) else type(of))).resolve()
    except (TypeError, OSError):
        return None


def _run(file: Path) -> ModuleType:
    path = file.resolve()
    name = f"{RUN}{path.stem}_{hashlib.sha256(os.fsencode(path)).hexdigest()[:8]}"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        if str(path.parent) not in sys.path:
            sys.path.append(str(path.parent))
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
    return sys.modules[name]
