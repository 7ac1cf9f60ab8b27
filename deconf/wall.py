"""The process of a method from outside, which engine/guest_host.py starts: `python -m deconfounded.deconf.wall FD`.

It holds no tasks, experts, benchmarks or simulators, and refuses to import them. This prevents accidental leakage and
simple attacks, not all: the process has the rights of its user.
"""

import sys
from importlib.abc import MetaPathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

PACKAGE = "deconfounded"
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
    sys.meta_path.insert(0, Wall())


if __name__ == "__main__":
    refuse_imports()  # before anything else of this package is imported
    from deconfounded.deconf.guest import main

    main()
