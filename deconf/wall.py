"""The process of a method from outside: `python -m deconfounded.deconf.wall FOLDER FD`, by engine/guest_host.py.

It holds no tasks, experts, benchmarks or simulators, and refuses to import them. This prevents accidental leakage and
simple attacks, not all: the process has the rights of its user.
"""

import os
import sys
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

PACKAGE, METHOD_FILE = "deconfounded", "DECONFOUNDED_METHOD"
OPEN = tuple(f"{PACKAGE}.envs.{name}" for name in ("support", "streams"))
CLOSED = (
    *(f"{PACKAGE}.{name}" for name in ("envs", "benchmarks", "deconf.exact")),
    *(f"{PACKAGE}.experts.{name}" for name in ("policy", "sb3", "train", "datasets")),
    *("mujoco", "dm_control"),
)


def _within(name: str, modules: tuple[str, ...]) -> bool:
    return any(name == module or name.startswith(f"{module}.") for module in modules)


def _refusal(name: str) -> ImportError:
    reason = "a method from outside has the data that it declares, and no tasks, experts or simulators"
    return ImportError(f"{name} cannot be imported here: {reason}")


class Wall(MetaPathFinder):
    """Refuses to import closed modules."""

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> None:
        """None, for the next finder. Raises ImportError for a closed module."""
        if _within(fullname, CLOSED) and not _within(fullname, OPEN):
            raise _refusal(fullname)


class MethodFinder(MetaPathFinder):
    """Finds the method's own module, by the name that `outside` gave it, in processes that the method starts.

    The environment variable METHOD_FILE is its file.
    """

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        from deconfounded.envs.support import outside  # which is open

        if not fullname.startswith(outside.PREFIX):
            return None
        return outside.plugin_spec(fullname, outside.here(Path(os.environ[METHOD_FILE])))


class ClosedPackage(ModuleType):
    """The package of environments without its contents; its open modules can be imported."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise _refusal(f"{self.__name__}.{name}")


def refuse_imports() -> None:
    """Refuse closed modules in this process from now on."""
    name = f"{PACKAGE}.envs"
    package = ClosedPackage(name)
    package.__path__ = [str(Path(__file__).resolve().parents[1] / "envs")]
    sys.modules[name] = package
    sys.meta_path[:] = [Wall(), *sys.meta_path, MethodFinder()]


if __name__ in ("__main__", "__mp_main__"):  # the latter where the method starts processes with multiprocessing
    refuse_imports()  # before anything else of this package is imported
if __name__ == "__main__":
    from deconfounded.deconf.guest import main

    main()
