"""What holds for every test: tasks that it registers are gone after it; those that need dm_control are skipped."""

import sys
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

import pytest

from deconfounded import envs
from deconfounded.envs.support import outside


@pytest.fixture(autouse=True)
def _forget_tasks() -> Iterator[None]:
    """A task from outside that a test registers has its name in that test alone: workers share tests in any order."""
    before = dict(envs.TASKS)
    yield
    for name in envs.TASKS.keys() - before.keys():
        del envs.TASKS[name]


@pytest.fixture(autouse=True)
def _forget_helpers() -> Iterator[None]:
    """Modules beside a plug-in file of a test: those of the same name beside another test's are others."""
    yield
    if folders := [folder for folder in outside.FOLDERS if "pytest-of-" in folder]:
        for name, module in list(sys.modules.items()):
            file = str(getattr(module, "__file__", None) or "")
            if "pytest-of-" in file and not name.startswith(outside.PREFIX):
                del sys.modules[name]
        outside.FOLDERS.difference_update(folders)
        sys.path[:] = [entry for entry in sys.path if entry not in folders]


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Jobs of a run run in this process, one after another: others take seconds to begin."""
    from deconfounded.benchmarks import commands
    from deconfounded.benchmarks.engine.local import Here

    monkeypatch.setattr(commands, "local", Here)


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run in this process draws nothing: pictures take longer than a small run."""
    monkeypatch.setattr("deconfounded.benchmarks.output.run_report.pictures", lambda *_: None)


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The figures that are drawn from now on, as matplotlib has them; none is saved as .png."""
    from deconfounded.benchmarks.output import pictures

    drawn: list[Any] = []
    monkeypatch.setattr(pictures, "save_figure", lambda figure, *_: drawn.append(figure))
    return drawn


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Without dm_control there is no walker."""
    if find_spec("dm_control") is not None:
        return
    for item in items:
        if "slippery_walker" in getattr(getattr(item, "callspec", None), "params", {}).values():
            item.add_marker(pytest.mark.skip(reason="dm_control is not installed"))
