"""The process of a method from outside, `python -m deconfounded.deconf.wall`, which a run starts (engine/guest.py).

There are no tasks, experts, benchmarks or simulators in it, and importing them is refused. This prevents accidental
leakage, and what a method could do with a page of code; a process of the same user is still no prison.
"""

from __future__ import annotations

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
    why = "a method from outside has the data that it declares, and no tasks, experts or simulators"
    return ImportError(f"{name} cannot be imported here: {why}")


class Wall(MetaPathFinder):
    """Refuses to import what a method from outside does not get."""

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> None:
        """None, for the next finder. Raises ImportError for a closed module."""
        if _within(fullname, CLOSED) and not _within(fullname, OPEN):
            raise _refusal(fullname)


class ClosedPackage(ModuleType):
    """The package of environments without its contents; what is open of it can be imported."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise _refusal(f"{self.__name__}.{name}")


def close_the_door() -> None:
    """From now on this process refuses closed modules."""
    name = f"{PACKAGE}.envs"
    package = ClosedPackage(name)
    package.__path__ = [str(Path(__file__).resolve().parents[1] / "envs")]
    sys.modules[name] = package
    sys.meta_path.insert(0, Wall())


if __name__ == "__main__":
    close_the_door()  # before anything else of this package is imported
    from deconfounded.deconf.guest import main

    main()
