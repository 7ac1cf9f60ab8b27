"""Logs as other programs write them: byte-order marks, tabs, dictionaries, large numbers, rows in any order."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deconfounded import envs
from deconfounded.experts import datasets
from deconfounded.experts.datasets.logs import trials_of
from deconfounded.experts.datasets.rows import Roles
from deconfounded.experts.datasets.table import Table, number, of_episodes
from deconfounded.experts.datasets.units import Units
from tests.experts.test_logs import ROLES, expected, of_lerobot, rows, write_csv, write_parquet


def test_a_byte_order_mark(tmp_path: Path) -> None:
    """As spreadsheets begin a csv file: it is no part of the first column's name."""
    file = write_csv(tmp_path / "x.csv", rows())
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert datasets.read(file, **ROLES).sha256 == expected().sha256


def test_tabs(tmp_path: Path) -> None:
    assert datasets.read(write_csv(tmp_path / "x.tsv", rows(), "\t"), **ROLES).sha256 == expected().sha256


def test_dictionaries_of_parquet(tmp_path: Path) -> None:
    """As pandas writes categories: they are the texts that they stand for."""
    pyarrow = pytest.importorskip("pyarrow")
    made = rows(None)
    columns: dict[str, Any] = {key: [row[key] for row in made] for key in made[0]}
    columns["vehicle"] = pyarrow.array(columns["vehicle"]).dictionary_encode()
    log = datasets.read(write_parquet(tmp_path / "x.parquet", columns), **ROLES)
    assert (log.sha256, log.names) == (expected().sha256, ("a", "b", "c"))


def test_the_row_of_an_error_is_that_of_the_file(tmp_path: Path) -> None:
    """In a later episode, too."""
    made = rows()
    made[7]["speed x"] = ""
    with pytest.raises(envs.InputError, match=r"'speed x' of .*x.csv holds no number in row 8"):
        datasets.read(write_csv(tmp_path / "x.csv", made), **ROLES)


def demonstrations(file: Path, *demos: dict[str, Any]) -> Path:
    """A file of robomimic's, with these columns of each demonstration's observations, and attribute `run`."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(file, "w") as opened:
        for i, obs in enumerate(demos):
            demo = opened.create_group(f"data/demo_{i}")
            demo["actions"], demo.attrs["run"] = np.full((3, 1), i / 2), 2**60 + i
            for name, values in obs.items():
                demo[f"obs/{name}"] = values
    return file


def test_whole_numbers_that_float64_rounds_name_demonstrations(tmp_path: Path) -> None:
    column = np.arange(3.0)[:, None]
    file = demonstrations(tmp_path / "x.hdf5", {"x": column}, {"x": column})
    assert datasets.read(file, "run").names == (str(2**60), str(2**60 + 1))


@pytest.mark.parametrize("lacking", [0, 1])
def test_demonstrations_of_different_arrays(lacking: int, tmp_path: Path) -> None:
    """Whichever of them has more."""
    both, less = {"x": np.zeros((3, 1)), "y": np.zeros((3, 1))}, {"x": np.zeros((3, 1))}
    file = demonstrations(tmp_path / "x.hdf5", *((less, both) if lacking == 0 else (both, less)))
    with pytest.raises(
        envs.InputError, match=r"demo_1 and demo_0 of .* hold different arrays; obs/y.0 is in one alone"
    ):
        datasets.read(file)


@pytest.mark.parametrize("lacking", [(), ("y",), ("x", "y")])
def test_a_last_observation_is_whole(lacking: tuple[str, ...], tmp_path: Path) -> None:
    """Where `next_obs` lacks an observation, none is made up for the end."""
    columns = {"x": np.arange(3.0)[:, None], "y": np.arange(4.0, 7)[:, None]}
    file = demonstrations(tmp_path / "x.hdf5", columns, columns)
    with pytest.importorskip("h5py").File(file, "a") as opened:
        for demo in opened["data"].values():
            for name in {*columns} - {*lacking}:
                demo[f"next_obs/{name}"] = columns[name] + 1
    last = datasets.read(file).obs[0, 0, -1]
    np.testing.assert_array_equal(last, [3, 7] if not lacking else [2, 6])


@pytest.mark.parametrize("kept", [2, 1])
def test_parts_of_one_name(kept: int, tmp_path: Path) -> None:
    """They are numbered, so that none is lost."""
    of_lerobot(tmp_path)
    info = json.loads((file := tmp_path / "set" / "meta" / "info.json").read_text())
    info["features"]["observation.state"]["names"] = ["x", "y" if kept == 1 else "x"]
    file.write_text(json.dumps(info))
    log = datasets.read(tmp_path / "set", "vehicle")
    assert log.units.obs == tuple(f"observation.state.{part}" for part in ("xy" if kept == 1 else "01"))


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_a_trial_of_lerobot_by_its_tasks(version: str, tmp_path: Path) -> None:
    """Which are lists, of which each episode has its own."""
    log = of_lerobot(tmp_path, version)
    by_tasks = datasets.read(tmp_path / "set", "tasks")
    assert by_tasks.names == tuple(f"drive {name}" for name in log.names)
    np.testing.assert_array_equal(by_tasks.mask, log.mask)
    np.testing.assert_array_equal(by_tasks.obs, log.obs)


def test_what_episodes_of_lerobot_are_not(tmp_path: Path) -> None:
    """A number that is none is no episode's; where all lack one, nothing is known of them but their frames."""
    of_lerobot(tmp_path, "v2.1")
    (tmp_path / "set" / "meta" / "episodes.jsonl").write_text('{"episode_index": [0], "vehicle": "a"}\n')
    assert len(datasets.read(tmp_path / "set").obs) == 5
    of_lerobot(tmp_path / "later")
    for file in (tmp_path / "later" / "set" / "meta" / "episodes").rglob("*.parquet"):
        write_parquet(file, {"stats": [[[1.0]]] * 5})
    assert len(datasets.read(tmp_path / "later" / "set").obs) == 5


def test_a_csv_that_may_not_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = write_csv(tmp_path / "x.csv", rows())

    def refuse(*_: Any, **__: Any) -> Any:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(envs.InputError, match=r"x\.csv cannot be read: Permission denied"):
        datasets.read(file, **ROLES)


def test_frames_of_lerobot_in_any_order(tmp_path: Path) -> None:
    """They are in that of their numbers, not of their rows."""
    log = of_lerobot(tmp_path)
    parquet = pytest.importorskip("pyarrow.parquet")
    for file in (tmp_path / "set" / "data").rglob("*.parquet"):
        table = parquet.read_table(file)
        parquet.write_table(table.take(list(reversed(range(len(table))))), file)
    assert datasets.read(tmp_path / "set", "vehicle").sha256 == log.sha256


def test_text_is_no_observation_of_lerobot(tmp_path: Path) -> None:
    """By itself; it may say which trial a row is of."""
    log = of_lerobot(tmp_path)
    parquet, pyarrow = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("pyarrow")
    for file in (tmp_path / "set" / "data").rglob("*.parquet"):
        table = parquet.read_table(file)
        modes = pyarrow.array([f"mode {i}" for i in table["episode_index"].to_pylist()])
        parquet.write_table(table.append_column("observation.mode", modes), file)
    again = datasets.read(tmp_path / "set", "vehicle")
    assert (again.sha256, again.units.obs) == (log.sha256, log.units.obs)
    assert datasets.read(tmp_path / "set", "observation.mode").names == tuple(f"mode {i}" for i in range(5))


def test_what_each_episode_says_of_itself_is_a_column_of_its_rows() -> None:
    """What one of them leaves out, or says at length, is none."""
    both = {"driver": "a", "wind": 0.5, "tasks": ["turn", "stop"], "notes": "x" * 101, "seed": 2**60}
    columns = of_episodes([{**both, "late": 1}, {**both, "driver": "b", "wind": 2}], [2, 1])
    assert {name: column.tolist() for name, column in columns.items()} == {
        "driver": ["a", "a", "b"],
        "wind": [0.5, 0.5, 2.0],
        "tasks": ["turn, stop"] * 3,
        "seed": [str(2**60)] * 3,
    }


def test_a_declared_range_holds_what_was_done() -> None:
    """An action beyond the range that a format declares widens it, and comes back as it was."""
    columns = {"lap": np.repeat([0.0, 1.0], 3), "x": np.arange(6.0), "push": np.array([0.0, 0.5, 0, 3.0, 0.2, 0])}
    table = Table("a", columns, limits={"push": (-1.0, 1.0)})
    (log,) = trials_of([[table]], Roles(None, "lap", ("x",), ("push",)))
    assert (log.units.low, log.units.high) == ((-1.0,), (3.0,))
    raw = log.units.unscaled(log.action[:, 0].astype(float))
    np.testing.assert_allclose(raw[..., 0], [[0, 0.5], [3, 0.2]], atol=1e-6)


def test_actions_of_agents_stay_in_the_range() -> None:
    """An action beyond -1 or 1 is the end of the range."""
    units = Units(("x",), ("y",), (0.0,), (100.0,))
    np.testing.assert_array_equal(units.unscaled(np.array([[-1.5], [0.0], [1.5]])), [[0.0], [50.0], [100.0]])


def test_actions_beyond_the_range_are_its_ends() -> None:
    """In a column from -1 to 1, too, whose other actions keep their bits."""
    units = Units(("x",), ("y", "z"), (-1.0, 0.0), (1.0, 4.0))
    np.testing.assert_array_equal(units.scaled(np.array([[1.5, 9.0], [-3.0, -1.0]])), [[1.0, 1.0], [-1.0, -1.0]])
    assert units.scaled(np.array([[0.1, 2.0]])).tolist() == [[0.1, 0.0]]


def test_an_action_that_never_changes_is_0() -> None:
    """And comes back as what it always was."""
    units = Units(("x",), ("y",), (3.0,), (3.0,))
    np.testing.assert_array_equal(units.scaled(np.array([[3.0], [5.0]])), [[0.0], [0.0]])
    np.testing.assert_array_equal(units.unscaled(np.array([[0.0], [0.7]])), [[3.0], [3.0]])


def test_the_first_part_of_a_name_ends_at_a_dot() -> None:
    """A column whose name goes on otherwise is another one."""
    table = Table("a", {name: np.zeros(2) for name in ("speed.0", "speed.1", "speed_limit")})
    assert table.select("obs", ["speed"]) == ("speed.0", "speed.1")


def test_a_column_that_two_patterns_match_is_taken_once() -> None:
    table = Table("a", {name: np.zeros(2) for name in ("speed x", "speed y", "push")})
    assert table.select("obs", ["speed y", "speed*", "push", "push"]) == ("speed y", "speed x", "push")


@pytest.mark.parametrize(("count", "values"), [(32, tuple(range(32))), (33, ())])
def test_up_to_32_whole_numbers_are_discrete_actions(count: int, values: tuple[int, ...]) -> None:
    """More are a continuous action."""
    columns = {"lap": np.zeros(count + 1), "x": np.arange(count + 1.0), "push": np.append(np.arange(count), 0.0)}
    (log,) = trials_of([[Table("a", columns)]], Roles(None, "lap", ("x",), ("push",)))
    assert (log.units.values, log.actions) == (values, len(values))


@pytest.mark.parametrize("cell", ["", " ", "NA", "n/a", "NaN", "NULL", "None "])
def test_an_empty_cell_is_no_number_however_it_is_written(cell: str) -> None:
    assert np.isnan(number(cell))


@pytest.mark.parametrize("column", ["run", "lap"])
def test_decimals_of_other_digits_are_other_names(column: str, tmp_path: Path) -> None:
    """3.1 and 3.10, as of a numbering; numbers of equally many digits are read as numbers, whose zeros are no more."""
    names = [f"3.{i}" for i in range(1, 13)]
    made = [{"run": "a", column: name, "x": f"{t / 4:.2f}", "u": 0.5} for name in names for t in range(3)]
    log = datasets.read(
        write_csv(tmp_path / "x.csv", made),
        trial="run",
        episode="lap" if column == "lap" else None,
        obs=["x"],
        action=["u"],
    )
    assert log.mask.any(2).sum() == 12
    if column == "run":
        assert log.names == tuple(names)
    np.testing.assert_array_equal(log.obs[0, 0, :3, 0], [0, 0.25, 0.5])


def test_one_row_alone_may_lack_its_observation(tmp_path: Path) -> None:
    """The last of an episode; of more rows none is dropped."""
    made = [{"run": run, "x": float(t), "u": 0.5} for run in "ab" for t in range(5)]
    made[4]["x"] = ""
    log = datasets.read(write_csv(tmp_path / "x.csv", made), "run", None, ["x"], ["u"])
    assert log.mask.sum(2).ravel().tolist() == [3, 4]
    made[3]["x"] = ""
    with pytest.raises(envs.InputError, match=r"'x' of .*x.csv holds no number in row 4"):
        datasets.read(write_csv(tmp_path / "x.csv", made), "run", None, ["x"], ["u"])


def test_flags_of_d4rl_are_a_row_a_step(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "x.hdf5", "w") as file:
        file["observations"], file["actions"] = np.zeros((8, 2)), np.zeros((8, 1))
        file["terminals"], file["timeouts"] = np.zeros(8), np.arange(7) % 4 == 3
    with pytest.raises(
        envs.InputError, match=r"timeouts of .*x.hdf5 has shape \(7,\); it must be \(8,\), a row an action"
    ):
        datasets.read(tmp_path / "x.hdf5")


def test_two_columns_of_one_name_in_parquet(tmp_path: Path) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    columns = [pyarrow.array([1.0, 2.0]), pyarrow.array([9.0, 9.0])]
    parquet.write_table(pyarrow.Table.from_arrays(columns, names=["x", "x"]), tmp_path / "x.parquet")
    with pytest.raises(envs.InputError, match="two columns that are called 'x'"):
        datasets.read(tmp_path / "x.parquet", None, None, ["x"], ["u"])


def test_columns_of_parquet_that_are_not_read(tmp_path: Path) -> None:
    """They are there, and the message names their type."""
    pyarrow = pytest.importorskip("pyarrow")
    columns = {"run": [0, 0], "x": pyarrow.nulls(2), "u": [0.5, 0.5]}
    with pytest.raises(envs.InputError, match=r"obs 'x' of .* is of type null; it must hold numbers or text"):
        datasets.read(write_parquet(tmp_path / "x.parquet", columns), "run", None, ["x"], ["u"])


def test_times_are_counted_from_the_first_of_one_file(tmp_path: Path) -> None:
    """Which other files do not share: as observations they are of one file alone."""
    pyarrow = pytest.importorskip("pyarrow")
    files = []
    for i in range(2):
        clock = pyarrow.array([86400 * i + t for t in range(3)], pyarrow.timestamp("s"))
        columns = {"run": [i] * 3, "x": [0.0, 1.0, 2.0], "clock": clock, "u": [0.5] * 3}
        files.append(write_parquet(tmp_path / f"{i}.parquet", columns))
    assert datasets.read(files[1], "run", None, ["clock"], ["u"]).obs[0, 0, :, 0].tolist() == [0, 1, 2]
    for sources in ([files], [[files[0]], [files[1]]]):
        with pytest.raises(
            envs.InputError, match=r"'clock' of .* is a time, which each file counts from its own first"
        ):
            datasets.read_together(sources, "run", None, ["clock"], ["u"])
    assert len(datasets.read(files, "run", None, ["x"], ["u"]).names) == 2


def test_actions_are_texts_in_all_files_or_in_none(tmp_path: Path) -> None:
    for name, actions in (("texts", ["left", "right", ""]), ("numbers", [0, 1, ""])):
        made = [{"run": name, "x": float(t), "u": actions[t]} for t in range(3)]
        write_csv(tmp_path / f"{name}.csv", made)
    files = [tmp_path / "numbers.csv", tmp_path / "texts.csv"]
    with pytest.raises(envs.InputError, match=r"'u' is text in .*texts.csv, and numbers in .*numbers.csv"):
        datasets.read(files, "run", None, ["x"], ["u"])


def test_words_for_columns_and_files_that_are_none(tmp_path: Path) -> None:
    file = write_csv(tmp_path / "x.csv", rows())
    for name in ("", " "):
        with pytest.raises(envs.InputError, match=r"trial was .*; it must be the name of a column"):
            datasets.read(file, name, None, ["x"], ["u"])
    with pytest.raises(envs.InputError, match=r"obs was \[3\]; it must be a list of columns"):
        datasets.read(file, None, None, [3], ["u"])  # type: ignore[list-item]
    with pytest.raises(envs.InputError, match=r"they must be a list of logs, \['.*x.csv'\]"):
        datasets.read_together(str(file))  # type: ignore[arg-type]
