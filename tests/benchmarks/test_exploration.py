"""Scores against the amount of exploration: what is run, and what is shown of it."""

import json
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock, Timeout

from deconfounded import envs
from deconfounded.benchmarks.engine.catalogue import METHODS
from deconfounded.benchmarks.engine.presets import changed, preset
from deconfounded.benchmarks.output import records
from deconfounded.benchmarks.studies import cards, exploration, table
from tests.tools import bars, dots

PNG = b"\x89PNG"


def point(task: str, method: str, share: int, last: list[float]) -> dict[str, Any]:
    first = [score / 2 for score in last]
    return {
        **{"task": task, "method": method, "version": 6, "share": share, "explored": 512 // share},
        **{"first": first, "last": last},
    }


@pytest.fixture
def points() -> list[dict[str, Any]]:
    of = [
        point("curling", "deconfounded", share, [score, score + 0.2])
        for share, score in ((1, 0.8), (4, 0.7), (16, 0.4))
    ]
    return [*of, point("windy_drone", "deconfounded", 4, [0.5]), point("windy_drone", "deconfounded", 1, [0.8])]


def test_methods_are_those_that_explore_or_query() -> None:
    """All but gail, whose interactions are no trials of the preset."""
    able = exploration.explorers()
    assert {"deconfounded", "dagger", "rma"} <= {*able}
    assert not {"naive_rnn", "oracle_bc", "interventional", "gail"} & {*able}
    assert all({"exploration", "queries"} & {*METHODS[name].uses} for name in able)


@pytest.mark.parametrize("share", exploration.SHARES)
def test_share_of_the_preset(share: int) -> None:
    """Exploration and queries alone are fewer, and at least one trial is left."""
    task = envs.get("slippery_cartpole")
    whole = preset("default", task, "cpu")
    less = changed(whole, exploration.fewer(whole, share))
    assert less.explore_trials == whole.explore_trials // share
    assert less.query_trials == max(1, whole.query_trials // share)
    assert less.expert_trials == whole.expert_trials


def test_two_programs_add_to_a_file(tmp_path: Path) -> None:
    """Neither loses a point of the other; a point made again takes the place of the one before."""
    file = tmp_path / "exploration.json"
    for task, last in (("curling", 0.5), ("windy_drone", 0.6), ("curling", 0.7)):
        points = exploration.added(file, point(task, "rma", 4, [last]))
    assert {key[0]: of["last"] for key, of in points.items()} == {"curling": [0.7], "windy_drone": [0.6]}


def test_other_programs_wait_while_a_file_changes(tmp_path: Path) -> None:
    """Until what was read of it is written."""
    file = tmp_path / "exploration.json"

    def add(held: list[int] | None) -> list[int]:
        with pytest.raises(Timeout):
            FileLock(file.with_suffix(".lock")).acquire(timeout=0)
        return [*(held or []), 1]

    assert [cards.changed(file, add) for _ in range(2)] == [[1], [1, 1]]


def test_points_of_two_presets_are_not_in_one_file(tmp_path: Path) -> None:
    """They would take each other's places; points of the default preset do not say so."""
    file, plain = tmp_path / "exploration.json", {"preset": "default", "set": []}
    smoke = {"preset": "smoke", "set": ["dpt.rounds=1"]}
    exploration.check_file(file, smoke)
    exploration.added(file, point("curling", "dpt", 1, [0.9]))
    exploration.check_file(file, plain)
    with pytest.raises(envs.InputError, match=r"exploration.json holds points of preset default, set none; give anoth"):
        exploration.check_file(file, smoke)
    exploration.added(file, point("curling", "dpt", 1, [0.9]) | smoke)
    exploration.check_file(file, smoke)
    with pytest.raises(
        envs.InputError, match=r"holds points of preset smoke, set \['dpt.rounds=1'\]; give another --out"
    ):
        exploration.check_file(file, plain)


def test_records_that_stand_for_all_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the method and of the references, of as many seeds as the other amounts have; none if one is missing."""
    task, methods = envs.get("curling"), ("random", "expert", "dagger", "rma")
    made: list[Any] = [{"method": method, "seed": seed} for method in methods for seed in range(3)]
    monkeypatch.setattr(records, "of_task", lambda *_: made)
    for lacking, expected in (((), [each for each in made[:9] if each["seed"] < 2]), ((1,), [])):
        monkeypatch.setattr(table, "missing", lambda *_, lacking=lacking: lacking)
        assert exploration.recorded(task, preset("default", task, "cpu", ["dagger"]), "dagger", 2) == expected


def test_table(points: list[dict[str, Any]]) -> None:
    """First and last score, a mean over seeds, of each share, and nothing where it was not run."""
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in exploration.table(points).splitlines()[2:]]
    assert rows == [
        ["curling", "deconfounded", "v6", "2", "0.45, 0.90 (512)", "0.40, 0.80 (128)", "0.25, 0.50 (32)", ""],
        ["windy_drone", "deconfounded", "v6", "1", "0.40, 0.80 (512)", "0.25, 0.50 (128)", "", ""],
    ]


def test_median_loss(points: list[dict[str, Any]]) -> None:
    """Over tasks: .1 and .3 with a quarter; .4 of one task with a 16th; none with a 64th."""
    third = [point("icy_stop", "deconfounded", share, [score]) for share, score in ((4, 0.0), (1, 0.9))]
    for of, median in ((points, "0.20 (2)"), ([*points, *third], "0.30 (3)")):  # .1, .3 and .9
        last = exploration.median_losses(of).splitlines()[-1]
        assert [cell.strip() for cell in last.split("|")[1:-1]] == ["deconfounded", median, "0.40 (1)", ""]


def test_panels_of_the_first_and_the_last_episode(
    points: list[dict[str, Any]], figures: list[Any], tmp_path: Path
) -> None:
    """Means over seeds by explored trials, and from the least to the most of them."""
    exploration.picture(points[:3], tmp_path / "exploration.png")
    for panel, share, end in zip(figures[0].axes, (0.5, 1), exploration.ENDS, strict=True):
        assert panel.get_ylabel() == f"score, {end} episode"
        for dot, expected in zip(dots(panel), [(32, 0.5), (128, 0.8), (512, 0.9)], strict=True):
            assert dot == pytest.approx((expected[0], share * expected[1]))
        assert bars(panel)[0] == pytest.approx((32, share * 0.4, 32, share * 0.6))


@pytest.mark.parametrize("count", [1, 5])
def test_picture(count: int, points: list[dict[str, Any]], tmp_path: Path) -> None:
    """Of the first point alone, too, and of tasks with more and with fewer amounts."""
    exploration.picture(points[:count], tmp_path / "exploration.png")
    assert (tmp_path / "exploration.png").read_bytes().startswith(PNG)


@pytest.mark.slow
def test_all_trials_are_of_the_records() -> None:
    """In docs/exploration.json, where records are of today's version of the method: the same scores."""
    compared, points = 0, json.loads((exploration.DOCS / "exploration.json").read_text())
    for whole in (each for each in points if each["share"] == 1):
        task, method = envs.get(whole["task"]), whole["method"]
        made = exploration.recorded(task, preset("default", task, "cpu", [method]), method, len(whole["last"]))
        if made:
            today = exploration.measured(made, method, 1)
            assert [today[end] for end in exploration.ENDS] == [whole[end] for end in exploration.ENDS], task.name
            compared += 1
    assert compared > 15
