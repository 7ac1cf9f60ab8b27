"""Plug-ins: tasks, methods, experts and agents from outside, by `path/file.py:name` or `package.module:name`."""

import ast
import hashlib
import importlib
import importlib.util
import inspect
import os
import sys
from collections.abc import Iterator, Set
from contextlib import contextmanager, nullcontext
from importlib.machinery import ModuleSpec, SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import Any

from deconfounded.envs.support.errors import InputError, error_line, users_line
from deconfounded.envs.support.origin import ROOT

SENT = "DECONFOUNDED_OUTSIDE"  # environment variable of a cluster worker: the folder that plug-in files were sent to
FOLDERS: set[str] = set()  # of plug-in files, which are on the import path for their sake
SCRIPTS = ("__main__", "__mp_main__")  # names of a process's script as a module, of which each process has its own
PREFIX = "outside_"  # of the module names of plug-in files


def is_outside(reference: str) -> bool:
    """Whether a name is a plug-in's reference, and not a registered name."""
    return ":" in reference


def find(kind: str, reference: str) -> Any:
    """Import the object that a reference names. kind: what it should be, for the error.

    A file is executed once, and again if it has changed; its folder is appended to the import path. That of a method
    imports what is beside it, whatever other plug-ins have imported by that name. Raises InputError if there is no such
    file, module or name in it, or if executing it fails; and by `check_helpers`, but for methods.
    """
    where, _, name = reference.rpartition(":")
    if not where or not name:
        raise InputError(f"{kind} was {reference!r}; from outside it must be path/file.py:name or package.module:name")
    if where.endswith(".py") and not here(Path(where)).is_file():
        raise InputError(f"{kind} {reference!r}: there is no file {where}")
    if not where.endswith(".py") and ({*where} & {"/", os.sep} or where.startswith(".")):
        raise InputError(f"{kind} {reference!r}: a file's path must end in .py, as {where}.py:{name}")
    try:
        if where.endswith(".py"):
            file = here(Path(where)).resolve()
            _put_on_path(str(file.parent))
            with _apart(str(file.parent)) if kind == "method" else nullcontext():
                module = _run(file)
        else:
            module = importlib.import_module(where)
    except InputError as error:
        if not (line := users_line(error)):
            raise
        raise InputError(f"{error} ({line})") from error
    except (Exception, SystemExit) as error:
        hint = f"; a file's path must end in .py, as {where}.py" if Path(f"{where}.py").is_file() else ""
        raise InputError(f"{kind} {reference!r}: {error_line(error)}{hint}") from error
    if where.endswith(".py") and kind != "method":
        check_helpers(here(Path(where)))
    if not hasattr(module, name):
        public = {key: value for key, value in vars(module).items() if not key.startswith("_")}
        own = [key for key, value in public.items() if getattr(value, "__module__", "") == module.__name__]
        names = own or [*public]  # else what it imports, which may be meant
        raise InputError(f"{kind} {reference!r}: {where} has no {name!r}; it has {', '.join(names)}")
    return getattr(module, name)


def absolute(reference: str) -> str:
    """The reference with an absolute path, valid in any working directory."""
    where, colon, name = reference.rpartition(":")
    return f"{Path(where).resolve()}:{name}" if where.endswith(".py") else f"{where}{colon}{name}"


def reference(cls: type) -> str:
    """The reference of a class, for `find` in another process; "" if it has none, as a class inside a function."""
    if cls.__qualname__ != cls.__name__:
        return ""
    if cls.__module__ in SCRIPTS or cls.__module__.startswith(PREFIX):
        return f"{file}:{cls.__name__}" if (file := source(cls)) else ""
    return f"{cls.__module__}:{cls.__name__}"


def file(reference: str) -> Path | None:
    """The file that a reference points to, which is not executed; None for a module that has no file."""
    where, _, _ = reference.rpartition(":")
    if where.endswith(".py"):
        return here(Path(where)).resolve()
    spec = importlib.util.find_spec(where)
    return Path(spec.origin).resolve() if spec is not None and spec.origin else None


def here(path: Path) -> Path:
    """A file's path on this machine: its own, or that of the copy which a cluster sent."""
    sent = Path(os.environ[SENT], *path.parts[1:]) if SENT in os.environ and path.is_absolute() else path
    return sent if sent.exists() else path


def source(of: Any) -> Path | None:
    """The file that defines a class or function, or the class of an object; None if it has none."""
    try:
        return Path(inspect.getfile(of if inspect.isclass(of) or inspect.isroutine(of) else type(of))).resolve()
    except (TypeError, OSError):
        return None


class _Loader(SourceFileLoader):
    """Compiles a file each time: cached bytecode is told apart by size and by seconds alone."""

    def path_stats(self, path: Any) -> Any:
        raise OSError("no bytecode is to be used")


def _module_name(path: Path) -> str:
    return f"{PREFIX}{path.stem}_{hashlib.sha256(os.fsencode(path) + path.read_bytes()).hexdigest()[:8]}"


def edited(cls: type) -> bool:
    """Whether the plug-in file that a class comes from has changed since it was executed."""
    file = source(cls) if cls.__module__.startswith(PREFIX) else None
    return file is not None and file.is_file() and cls.__module__ != _module_name(file)


def check_helpers(file: Path) -> None:
    """Raise InputError if a plug-in file imports a module beside it, and got that of another plug-in's folder."""
    path = file.resolve()
    nodes = [node for node in ast.walk(ast.parse(path.read_bytes())) if isinstance(node, ast.Import | ast.ImportFrom)]
    named = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    named += [node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module]
    for name in {each.partition(".")[0] for each in named}:
        beside = [path.parent / f"{name}.py", path.parent / name / "__init__.py"]
        if not any(file.is_file() for file in beside):
            continue
        spec = None if name in sys.modules else importlib.util.find_spec(name)  # it is imported later
        got = spec.origin if spec else getattr(sys.modules.get(name), "__file__", None)
        if not got or Path(got) in beside:
            continue
        if any(Path(got).is_relative_to(folder) for folder in FOLDERS):
            raise InputError(f"{path} imports {name}, and got {got} of another plug-in; rename one of the two")


def _helpers(folders: Set[str]) -> dict[str, ModuleType]:
    """The modules, by name, that plug-in files in these folders imported from beside them."""
    top = set()
    for name, module in sys.modules.items():
        file = Path(getattr(module, "__file__", None) or "")
        if "." in name or name in SCRIPTS or name.startswith(PREFIX) or not file.name:
            continue
        if str(file.parent.parent if file.name == "__init__.py" else file.parent) in folders:
            top.add(name)
    return {name: module for name, module in sys.modules.items() if name.partition(".")[0] in top}


@contextmanager
def _apart(folder: str) -> Iterator[None]:
    """Meanwhile, imports find what is in this plug-in's folder, and nothing that is in those of others."""
    path, foreign, before = [*sys.path], _helpers(FOLDERS - {folder}), _helpers({folder})
    for name in foreign:
        del sys.modules[name]
    sys.path[:] = [entry for entry in path if entry == folder or entry not in FOLDERS]
    try:
        yield
    finally:
        for name in _helpers({folder}).keys() - before.keys():
            del sys.modules[name]
        sys.modules.update(foreign)
        sys.path[:] = [*(entry for entry in sys.path if entry not in path), *path]


def _put_on_path(folder: str) -> None:
    """Let plug-in files import what is beside them: their `envs`, not that of our checkouts, which come last."""
    if folder not in sys.path:
        ours = [entry for entry in sys.path if entry and (Path(entry) / "deconfounded" / "__init__.py").is_file()]
        ours.sort(key=lambda entry: Path(entry).resolve() != ROOT)  # this one first, also in processes started later
        sys.path[:] = [*(entry for entry in sys.path if entry not in ours), folder, *ours]
        FOLDERS.add(folder)


def plugin_spec(name: str, path: Path) -> ModuleSpec:
    """How to import a plug-in file as the module of that name."""
    made = importlib.util.spec_from_file_location(name, path, loader=_Loader(name, str(path)))
    assert made is not None
    return made


def _run(path: Path) -> ModuleType:
    name = _module_name(path)
    if name not in sys.modules:
        module = importlib.util.module_from_spec(made := plugin_spec(name, path))
        sys.modules[name] = module
        try:
            made.loader.exec_module(module)  # type: ignore[union-attr]
        except BaseException:
            del sys.modules[name]
            raise
    return sys.modules[name]
