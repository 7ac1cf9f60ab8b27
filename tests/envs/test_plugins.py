"""Files of one's own: what is executed of them, and when."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from deconfounded import envs
from deconfounded.envs.support import outside
from deconfounded.envs.support.origin import ROOT
from deconfounded.experts import policy

TASK = "from tests.toys import Push\nclass {name}(Push):\n    name = 'own_push'\n    horizon = {horizon}\n"


@pytest.fixture(autouse=True)
def clean(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Tasks, modules and folders of one test are unknown to the next."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(outside, "FOLDERS", {*outside.FOLDERS})
    yield
    envs.TASKS.pop("own_push", None)
    sys.modules.pop("util", None)


def test_a_task_is_that_of_the_file_as_it_is_now(tmp_path: Path) -> None:
    """Within a process, as in a notebook; what was made before stays what it was."""
    file, reference = tmp_path / "mine.py", f"{tmp_path / 'mine.py'}:Mine"
    file.write_text(TASK.format(name="Mine", horizon=6))
    first = envs.get(reference)
    assert type(envs.get(reference)) is type(first) is type(envs.get("own_push"))
    file.write_text(TASK.format(name="Mine", horizon=9))
    assert [task.horizon for task in (first, envs.get(reference), envs.get("own_push"))] == [6, 9, 9]
    file.unlink()
    assert envs.get(reference).horizon == 9


def test_a_world_is_that_of_the_file_as_it_is_now(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    text = "from tests.envs.test_blackbox import Sliding\nclass OwnPush(Sliding):\n    steps = {}\n"
    horizons = []
    for steps in (6, 9, 9):
        file.write_text(text.format(steps))
        horizons.append(envs.get(f"{file}:OwnPush").horizon)
    assert horizons == [6, 9, 9]


def test_a_file_that_no_longer_works(tmp_path: Path) -> None:
    """The task that it held keeps its name until the file is mended."""
    file = tmp_path / "mine.py"
    file.write_text(TASK.format(name="Mine", horizon=6))
    before = type(envs.get(f"{file}:Mine"))
    file.write_text(TASK.format(name="Mine", horizon=7) + "    latents = ()\n")
    with pytest.raises(envs.InputError, match="latents of own_push were"):
        envs.get(f"{file}:Mine")
    assert type(envs.get("own_push")) is before
    file.write_text(TASK.format(name="Mine", horizon=8))
    assert envs.get(f"{file}:Mine").horizon == envs.get("own_push").horizon == 8


def test_two_tasks_of_one_file_and_name_stay_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("\n".join(TASK.format(name=name, horizon=6) for name in ("Mine", "Other")))
    envs.get(f"{tmp_path}/mine.py:Mine")
    with pytest.raises(envs.InputError, match=r"^task name 'own_push' of .* is taken by"):
        envs.get(f"{tmp_path}/mine.py:Other")


def test_a_class_that_is_defined_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """As when a cell of a notebook is executed twice: the last one counts, also under another version."""
    monkeypatch.setattr(envs.registry, "TASKS", {**envs.TASKS})
    for horizon, version in ((6, 0), (9, 0), (9, 1)):
        cell: dict[str, Any] = {"__name__": "__main__"}
        exec(TASK.format(name="Mine", horizon=horizon) + f"    version = {version}\n", cell)
        envs.register(cell["Mine"])
        assert (envs.get("own_push").horizon, envs.get("own_push").version) == (horizon, version)
    assert "deconf/OwnPush-v1" in gymnasium.registry
    assert "deconf/OwnPush-v0" not in gymnasium.registry
    gymnasium.registry.pop("deconf/OwnPush-v1")


@pytest.mark.parametrize("helper", ["util.py", "util/__init__.py"])
def test_helpers_of_one_name_in_two_folders(helper: str, tmp_path: Path) -> None:
    """The second file would silently get the first one's; of one folder, and of installed modules, nothing is said."""
    for folder, gain in (("a", 1), ("b", -1)):
        (tmp_path / folder / helper).parent.mkdir(parents=True)
        (tmp_path / folder / helper).write_text(f"GAIN = {gain}")
        (tmp_path / folder / "random.py").write_text("")  # which Python does not take
        for name in ("mine", "more"):
            text = "import random\nimport numpy as np\nfrom util import GAIN\n"
            (tmp_path / folder / f"{name}.py").write_text(text + "def control(obs, theta): return GAIN * obs[:, :1]\n")
    task = envs.get("slippery_cartpole")
    obs, theta = np.full((2, 6), 0.5), np.ones((2, 1))
    for name in ("mine", "more"):
        expert = policy.load(task, f"{tmp_path}/a/{name}.py:control")
        np.testing.assert_array_equal(expert.mean(obs, theta), np.full((2, 1), 0.5))  # type: ignore[attr-defined]
    for _ in range(2):
        with pytest.raises(
            envs.InputError, match=rf"b/mine.py imports util, and got .*a/{helper} of another plug-in; re"
        ):
            policy.load(task, f"{tmp_path}/b/mine.py:control")


def test_a_discrete_world_has_its_own_expert() -> None:
    world = Path(__file__).parents[2] / "docs" / "worlds" / "reversed_cart.py"
    with pytest.raises(envs.InputError, match=r"that of reversed_cart is the world's own `expert`, as actions are dis"):
        policy.load(envs.get(f"{world}:ReversedCart"), "mine.py:control")


def test_a_registered_task_by_its_file() -> None:
    """Of this package: it has a name."""
    file = Path(envs.tasks.curling.__file__).resolve()
    with pytest.raises(envs.InputError, match=rf"{file} is the file of curling, which is registered; use that name$"):
        envs.get(f"{file}:Curling")


def test_a_method_imports_what_is_beside_it(tmp_path: Path) -> None:
    """Though another method, or the task, has a module of that name; which a function may import later."""
    head = "from dataclasses import dataclass\nfrom deconfounded.deconf.method import uses\nimport util\n"
    text = f"{head}@uses('demonstrations')\ndef fit(given):\n    raise NotImplementedError\nLIMIT = util.LIMIT\n"
    for folder, limit in (("a", 1.0), ("b", 0.01), ("task", 5.0)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "util.py").write_text(f"LIMIT = {limit}\n")
        (tmp_path / folder / f"clone_{folder}.py").write_text(text)
    later = "def step():\n    import util\n    return util.LIMIT\n"
    (tmp_path / "task" / "mine.py").write_text(TASK.format(name="Mine", horizon=6) + later)
    envs.get(f"{tmp_path / 'task' / 'mine.py'}:Mine")
    limits = [outside.find("method", f"{tmp_path}/{folder}/clone_{folder}.py:LIMIT") for folder in ("a", "b", "a")]
    assert limits == [1.0, 0.01, 1.0]
    assert "util" not in sys.modules
    assert outside.find("task", f"{tmp_path / 'task' / 'mine.py'}:step")() == 5.0


def test_of_two_checkouts_workers_have_the_code_of_this_one(tmp_path: Path) -> None:
    """It stays the first on the import path, and a plug-in's folder comes before both."""
    (other := tmp_path / "other" / "deconfounded").mkdir(parents=True)
    (other / "__init__.py").write_text("")
    (tmp_path / "mine.py").write_text(TASK.format(name="Mine", horizon=6))
    sys.path[:0] = [str(ROOT), str(other.parent)]
    envs.get(f"{tmp_path / 'mine.py'}:Mine")
    places = [sys.path.index(str(place)) for place in (tmp_path, ROOT, other.parent)]
    assert places == sorted(places)
    assert str(ROOT) not in sys.path[: places[0]]
