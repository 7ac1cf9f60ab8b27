"""Logs as they come: files of each format, made by its own library, are the same Trials; bad ones are one line."""

import csv
import json
import os
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from gymnasium import spaces

import deconfounded
from deconfounded import envs
from deconfounded.deconf.methods import naive_rnn
from deconfounded.deconf.methods.sequence_bc import RecurrentConfig
from deconfounded.experts import datasets
from deconfounded.experts.datasets.logs import trials_of
from deconfounded.experts.datasets.rows import Roles
from deconfounded.experts.datasets.table import Odd, Table
from deconfounded.experts.datasets.tabular import parquet_columns
from deconfounded.experts.datasets.units import RawAgent, Units
from deconfounded.experts.trials import Trials

LENGTHS = {"a": (3, 5), "b": (4,), "c": (2, 3)}  # steps of each episode of each trial
OWNERS = [name for name, lengths in LENGTHS.items() for _ in lengths]
RNG = np.random.default_rng(0)
OBS = [RNG.normal(size=(n + 1, 2)) for lengths in LENGTHS.values() for n in lengths]
ACTIONS = [RNG.uniform(0, 100, (n, 1)) for lengths in LENGTHS.values() for n in lengths]
AFTER = 40.0  # an action without a next observation


def expected() -> Trials:
    """By hand."""
    obs, action, mask = np.zeros((3, 2, 6, 2)), np.zeros((3, 2, 5, 1)), np.zeros((3, 2, 5), bool)
    low, high = np.concatenate(ACTIONS).min(), np.concatenate(ACTIONS).max()
    for i, (b, e) in enumerate(((0, 0), (0, 1), (1, 0), (2, 0), (2, 1))):
        n = len(ACTIONS[i])
        obs[b, e, : n + 1], mask[b, e, :n] = OBS[i], True
        action[b, e, :n] = 2 * (ACTIONS[i] - low) / (high - low) - 1
    return Trials(obs, action, mask)


def rows(last: Any = "", skip: tuple[int, ...] = ()) -> list[dict[str, Any]]:
    """A row a step, and one of the last observation, with that action."""
    made = []
    for i, (obs, action) in enumerate(zip(OBS, ACTIONS, strict=True)):
        for t, (x, v) in enumerate(obs.tolist()):
            done = action[t, 0].item() if t < len(action) else last
            made.append({"vehicle": OWNERS[i], "lap": i, "time": 0.1 * t, "speed x": x, "speed y": v, "throttle": done})
    return [row for j, row in enumerate(made) if j not in skip]


ROLES: dict[str, Any] = {"trial": "vehicle", "episode": "lap", "obs": ["speed*"], "action": ["throttle"]}


def write_csv(file: Path, made: list[dict[str, Any]], separator: str = ",") -> Path:
    with file.open("w", newline="") as opened:
        writer = csv.DictWriter(opened, list(made[0]), delimiter=separator)
        writer.writeheader()
        writer.writerows(made)
    return file


def write_parquet(file: Path, columns: dict[str, Any]) -> Path:
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    file.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(pyarrow.table(columns), file)
    return file


def of_csv(folder: Path) -> datasets.Log:
    return datasets.read(write_csv(folder / "logs.csv", rows()), **ROLES)


def of_csv_with_last_actions(folder: Path) -> datasets.Log:
    return datasets.read(str(write_csv(folder / "logs.csv", rows(AFTER), ";")), **ROLES)


def of_csv_without_last_observations(folder: Path) -> datasets.Log:
    empty = {"speed x": "", "speed y": "", "throttle": AFTER}
    made = rows(AFTER)
    later = [
        {**row, **empty}
        for row, then in zip(made, [*made[1:], {"lap": None}], strict=True)
        if row["lap"] != then["lap"]
    ]
    return datasets.read(write_csv(folder / "logs.csv", sorted(made + later, key=lambda row: row["lap"])), **ROLES)


def of_several_csv(folder: Path) -> datasets.Log:
    cut = [row for row in rows() if row["lap"] < 3], [row for row in rows() if row["lap"] >= 3]
    return datasets.read([write_csv(folder / f"{i}.csv", part) for i, part in enumerate(cut)], **ROLES)


def of_parquet(folder: Path) -> datasets.Log:
    made = rows(None)
    columns = {key: [row[key] for row in made] for key in ("vehicle", "lap", "throttle")}
    columns["speed"] = [[row["speed x"], row["speed y"]] for row in made]
    return datasets.read(write_parquet(folder / "logs.parquet", columns), **{**ROLES, "obs": ["speed"]})


def of_robomimic(folder: Path, later: bool = True) -> datasets.Log:
    h5py = pytest.importorskip("h5py")
    with h5py.File(folder / "demos.hdf5", "w") as file:
        file.create_group("mask")["train"] = np.array([b"demo_0"])
        for i, (obs, action) in enumerate(zip(OBS, ACTIONS, strict=True)):
            demo = file.create_group(f"data/demo_{i + 8}")  # demo_10 comes after demo_9
            demo.attrs["vehicle"], demo.attrs["model_file"] = OWNERS[i], "<mujoco/>" * 99
            demo["actions"] = action if later else np.append(action, [[AFTER]], 0)
            demo["obs/speed"] = obs[:-1] if later else obs
            demo["obs/camera"] = np.zeros((len(demo["actions"]), 4, 4, 3), np.uint8)
            if later:
                demo["next_obs/speed"] = obs[1:]
    return datasets.read(folder / "demos.hdf5", "vehicle")


def of_d4rl(folder: Path, later: bool = True, flags: tuple[int, ...] = (-1,)) -> datasets.Log:
    h5py = pytest.importorskip("h5py")
    actions = ACTIONS if later else [np.append(action, [[AFTER]], 0) for action in ACTIONS]
    seen = [obs[:-1] for obs in OBS] if later else OBS
    ends = np.concatenate([np.arange(len(action)) == len(action) - 1 for action in actions])
    with h5py.File(folder / "d4rl.h5", "w") as file:
        file["observations"], file["actions"] = np.concatenate(seen), np.concatenate(actions)
        file["terminals"] = (ends & (np.cumsum(ends) < 3)).reshape(flags)
        file["timeouts"] = (ends & (np.cumsum(ends) >= 3)).reshape(flags)
        file["infos/vehicle"] = np.repeat([ord(name) for name in OWNERS], [len(action) for action in actions]) * 1.0
        file["metadata/algorithm"] = "expert"
        if later:
            file["next_observations"] = np.concatenate([obs[1:] for obs in OBS])
    return datasets.read(folder / "d4rl.h5", "infos/vehicle")


def of_lerobot(folder: Path, version: str = "v3.0") -> datasets.Log:
    made = rows(AFTER)
    frames: dict[int, list[dict[str, Any]]] = {i: [row for row in made if row["lap"] == i] for i in range(5)}
    features = {
        "observation.state": {"dtype": "float64", "shape": [2], "names": {"motors": ["x", "y"]}},
        "observation.images.top": {"dtype": "video", "shape": [4, 4, 3], "names": None},
        "action": {"dtype": "float64", "shape": [1], "names": None},
    }
    info = {"codebase_version": version, "total_episodes": 5, "total_frames": len(made), "features": features}
    (folder / "set" / "meta").mkdir(parents=True)
    (folder / "set" / "meta" / "info.json").write_text(json.dumps(info))

    def data(name: str, episodes: list[int]) -> None:
        held = [(i, t, row) for i in episodes for t, row in enumerate(frames[i])]
        columns = {"episode_index": [i for i, _, _ in held], "frame_index": [t for _, t, _ in held]}
        columns |= {"observation.state": [[row["speed x"], row["speed y"]] for *_, row in held]}
        columns |= {"action": [[row["throttle"]] for *_, row in held], "timestamp": [row["time"] for *_, row in held]}
        write_parquet(folder / "set" / "data" / "chunk-000" / name, columns)

    if version == "v3.0":
        data("file-000.parquet", [1, 0])
        data("file-001.parquet", [2, 3, 4])
        about: dict[str, list[Any]] = {
            "episode_index": list(range(5)),
            "vehicle": OWNERS,
            "tasks": [[f"drive {name}"] for name in OWNERS],
        }
        about |= {"stats/action/max": [[1.0]] * 5, "length": [len(frames[i]) for i in range(5)]}
        write_parquet(folder / "set" / "meta" / "episodes" / "chunk-000" / "file-000.parquet", about)
    else:
        for i in range(5):
            data(f"episode_{i:06d}.parquet", [i])
        lines = [
            json.dumps({"episode_index": i, "vehicle": OWNERS[i], "tasks": [f"drive {OWNERS[i]}"]}) for i in range(5)
        ]
        (folder / "set" / "meta" / "episodes.jsonl").write_text("\n".join(lines))
    return datasets.read(folder / "set", "vehicle")


def write_minari(folder: Path, about: list[dict[str, Any]]) -> Path:
    minari = pytest.importorskip("minari")
    from minari.data_collector import EpisodeBuffer

    buffers = []
    for i, (obs, action) in enumerate(zip(OBS, ACTIONS, strict=True)):
        n = len(action)
        ends = np.arange(n) == n - 1
        seen: Any = {"speed": obs, "mode": np.zeros(n + 1, np.int64)}
        buffers.append(EpisodeBuffer(i, None, None, seen, action, [0.0] * n, ends.tolist(), [False] * n, {}))  # type: ignore[arg-type]
    space = spaces.Dict(speed=spaces.Box(-9.0, 9.0, (2,), float), mode=spaces.Discrete(2))
    with patch.dict(os.environ, MINARI_DATASETS_PATH=str(folder)):
        kinds = {"observation_space": space, "action_space": spaces.Box(0.0, np.inf, (1,), float)}
        made = minari.create_dataset_from_buffers("of/others-v0", buffers, data_format="hdf5", **kinds)
    if about[0]:
        made.storage.update_episode_metadata(about)
    return folder


def of_minari(folder: Path) -> datasets.Log:
    made = write_minari(folder, [{"vehicle": name} for name in OWNERS])
    return datasets.read(made, "vehicle", obs=["observation.speed"])


FORMATS: dict[str, tuple[Callable[[Path], datasets.Log], bool]] = {  # how it is read; whether last actions are dropped
    "csv": (of_csv, False),
    "last actions": (of_csv_with_last_actions, True),
    "no last observations": (of_csv_without_last_observations, True),
    "several csv": (of_several_csv, False),
    "parquet": (of_parquet, False),
    "robomimic": (of_robomimic, False),
    "robomimic, no next_obs": (lambda folder: of_robomimic(folder, False), True),
    "d4rl": (of_d4rl, False),
    "d4rl, no next_observations": (lambda folder: of_d4rl(folder, False), True),
    "lerobot v3": (of_lerobot, True),
    "lerobot v2.1": (lambda folder: of_lerobot(folder, "v2.1"), True),
    "minari": (of_minari, False),
}


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_is_the_same_trials(kind: str, tmp_path: Path) -> None:
    """Ragged trials and episodes, raw actions, last rows of every kind."""
    read, drops = FORMATS[kind]
    log, right = read(tmp_path), expected()
    for key in ("mask", "obs", "action"):
        np.testing.assert_array_equal(getattr(log, key), getattr(right, key))
    assert log.sha256 == right.sha256
    assert len(log.units.obs) == 2
    assert ("In 5 episodes the last action" in " ".join(log.notes)) is drops
    assert log.units.low == (np.concatenate(ACTIONS).min(),)
    assert [name for name in log.names if name in ("97", "98", "99", "a", "b", "c")] == list(log.names)
    assert "3 trials of 1 to 2 episodes, each of 2 to 5 steps, 17 in all." in log.notes[0]
    assert " 0.5" in log.notes[1] or "Actions, each range taken as -1 to 1: " in log.notes[1]


class TestNotes:
    def test_an_episode_is_a_trial(self, tmp_path: Path) -> None:
        log = datasets.read(write_csv(tmp_path / "x.csv", rows()), episode="lap", obs=["speed x"], action=["throttle"])
        assert log.mask.shape[:2] == (5, 1)
        assert "every episode counts as a trial of its own (vehicle might say: --trial)" in " ".join(log.notes)

    def test_a_trial_is_an_episode(self, tmp_path: Path) -> None:
        log = datasets.read(write_csv(tmp_path / "x.csv", rows()), trial="lap", obs=["speed x"], action=["throttle"])
        assert log.mask.shape[:2] == (5, 1)
        assert "every episode counts" not in " ".join(log.notes)

    @pytest.mark.filterwarnings("ignore::UserWarning")
    def test_minari_without_a_word(self, tmp_path: Path) -> None:
        log = datasets.read(write_minari(tmp_path, [{}]))
        assert log.mask.shape[:2] == (5, 1)
        assert log.units.obs == (
            "observation.mode.0",
            "observation.mode.1",
            "observation.speed.0",
            "observation.speed.1",
        )
        assert "every episode counts as a trial" in " ".join(log.notes)

    def test_episodes_of_two_files_by_a_column(self) -> None:
        """Given --episode, the trials that a format states do not count: each episode is a trial, of its own file."""
        columns = {"trial": np.repeat([0.0, 1.0], 3), "lap": np.repeat([0.0, 1.0], 3), "x": np.arange(6.0)}
        columns["push"] = np.tile([0.1, 0.7], 3)
        tables = [Table(where, columns, trial="trial") for where in ("a.csv", "b.csv")]
        (log,) = trials_of([tables], Roles(None, "lap", ("x",), ("push",)))
        assert log.mask.shape[:2] == (4, 1)
        assert len(set(log.names)) == 4

    def test_d4rl_of_columns(self, tmp_path: Path) -> None:
        """Flags [N, 1] are flags; next observations of another shape are refused."""
        assert of_d4rl(tmp_path, flags=(-1, 1)).sha256 == expected().sha256
        h5py = pytest.importorskip("h5py")
        with h5py.File(tmp_path / "d4rl.h5", "a") as file:
            rows_of = file["next_observations"][:-1]
            del file["next_observations"]
            file["next_observations"] = rows_of
        with pytest.raises(envs.InputError, match=r"next_observations of .* have shape \(\d+, 2\); it must be "):
            datasets.read(tmp_path / "d4rl.h5", "infos/vehicle")

    def test_episodes_of_lerobot_in_any_order(self, tmp_path: Path) -> None:
        """What is said of an episode is by its number, not by its line."""
        log, lines = of_lerobot(tmp_path, "v2.1"), tmp_path / "set" / "meta" / "episodes.jsonl"
        lines.write_text("\n".join(reversed(lines.read_text().splitlines())))
        again = datasets.read(tmp_path / "set", "vehicle")
        assert (again.sha256, again.names) == (log.sha256, log.names)

    def test_gaps_and_constants(self, tmp_path: Path) -> None:
        made = [{**row, "gear": 3} for row in rows(skip=(6,))]
        made[3]["time"] = made[2]["time"]
        log = datasets.read(write_csv(tmp_path / "x.csv", made), **{**ROLES, "obs": ["speed*", "gear"]})
        notes = " ".join(log.notes)
        assert "1 gaps: more than 1.5 times the usual 0.1 of time passes (the first: row 7 of" in notes
        assert "1 rows have the time of the row before them: duplicates? (the first: row 4" in notes
        assert "Constant: gear." in notes
        assert "nothing to imitate" not in notes
        assert "Constant" not in " ".join(of_csv(tmp_path).notes)
        still = write_csv(tmp_path / "still.csv", [{**row, "throttle": 3} for row in rows()])
        assert "there is nothing to imitate." in " ".join(datasets.read(still, **ROLES).notes)

    def test_time_that_runs_backwards(self, tmp_path: Path) -> None:
        """In all of it, in a shuffled part, or where a column that says what an episode is was forgotten."""
        made = [{**row, "time": -row["time"]} for row in rows()]
        log = datasets.read(write_csv(tmp_path / "x.csv", made), **ROLES)
        notes = " ".join(log.notes)
        assert f"time runs backwards {len(made) - 5} times" in notes
        assert ["runs backwards" in note for note in log.notes if isinstance(note, Odd)] == [True]
        assert "gaps" not in notes
        roles = {**ROLES, "episode": None}
        notes = " ".join(datasets.read(write_csv(tmp_path / "x.csv", rows(AFTER)), **roles).notes)
        assert (
            "time runs backwards 2 times; are rows of several episodes taken for one, or unsorted? (the first" in notes
        )
        assert "runs backwards" not in " ".join(of_csv(tmp_path).notes)

    def test_time_that_is_left(self, tmp_path: Path) -> None:
        """It runs down, and says nothing of the order of rows."""
        made = [{"time_left" if key == "time" else key: value for key, value in row.items()} for row in rows()]
        made = [{**row, "time_left": -float(row["time_left"])} for row in made]
        assert "backwards" not in " ".join(datasets.read(write_csv(tmp_path / "x.csv", made), **ROLES).notes)

    @pytest.mark.parametrize("name", ["date", "minute", "Index", "ts", "Time [s]", "sim_time", "stamp_ns"])
    def test_columns_of_time(self, name: str, tmp_path: Path) -> None:
        """Also texts as ISO 8601 has them; of other texts nothing is known."""
        times = [f"2026-11-29T10:00:{second:02}Z" for second in (1, 2, 4, 3, 5)]
        zones = [time.replace("Z", "+02:00") for time in times]
        for stamps, notes in ((times, 1), (zones, 1), ([f"{i}." for i in (1, 2, 4, 3, 5)], 1), ([*"abdce"], 0)):
            made = [{"run": 0, name: stamp, "x": i, "u": i / 10} for i, stamp in enumerate(stamps)]
            log = datasets.read(write_csv(tmp_path / "x.csv", made), trial="run", obs=["x"], action=["u"])
            assert sum("runs backwards 1 times" in note for note in log.notes) == notes

    def test_duplicates_without_a_clock(self, tmp_path: Path) -> None:
        made = [{key: value for key, value in row.items() if key != "time"} for row in rows()]
        log = datasets.read(write_csv(tmp_path / "x.csv", [*made[:3], made[2], *made[3:]]), **ROLES)
        assert "1 rows repeat the row before them (the first: row 4)." in log.notes

    def test_dropped_and_left_out(self, tmp_path: Path) -> None:
        notes = " ".join(of_csv_with_last_actions(tmp_path).notes)
        assert "In 5 episodes the last action has no next observation; it is dropped." in notes
        made = [*rows(), {**rows()[0], "lap": 9}]
        notes = " ".join(datasets.read(write_csv(tmp_path / "x.csv", made), **ROLES).notes)
        assert "Episodes of one row, without a step, are left out: 1." in notes
        assert "is dropped" not in notes


class TestNames:
    """Trials whose names are not all in their numbers stay apart."""

    @staticmethod
    def named(names: list[Any]) -> list[dict[str, Any]]:
        """Three rows of a trial of each name."""
        return [{"run": name, "x": float(i + t), "u": t / 10} for i, name in enumerate(names) for t in range(3)]

    @pytest.mark.parametrize(
        "names",
        [
            ["20261129001", "20261129002"],
            ["1_11", "11_1", "111"],
            ["007", "7"],
            ["10", "1e1"],
            [str(2**60), str(2**60 + 1)],
            ["0.30000000001", "0.3"],
            ["3.1", "3.2", "3.10"],
        ],
    )
    @pytest.mark.parametrize("block", [2, 1000])
    def test_csv(self, names: list[str], block: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("deconfounded.experts.datasets.tabular.BLOCK", block)
        file = write_csv(tmp_path / "x.csv", self.named(names))
        log = datasets.read(file, trial="run", obs=["x"], action=["u"])
        assert log.names == tuple(names)
        assert log.mask.shape == (len(names), 1, 2)

    @pytest.mark.parametrize("separator", [",", ";", "\t"])
    def test_csv_of_quoted_names(self, separator: str, tmp_path: Path) -> None:
        """Separators and line breaks in them separate nothing."""
        names = ["speed, in m/s; or none\tof it", "a,b,c,d,e,f", "u\nv"]
        made = [{**dict(zip(names, (t, t, t / 10), strict=True)), "run": t // 3} for t in range(6)]
        file = write_csv(tmp_path / "x.csv", made, separator)
        log = datasets.read(file, trial="run", obs=names[:2], action=names[2:])
        assert (log.units.obs, log.units.action) == (tuple(names[:2]), tuple(names[2:]))
        assert log.obs[1, 0, :, 1].tolist() == [3, 4, 5]

    def test_csv_of_plain_numbers(self, tmp_path: Path) -> None:
        """1.0 and 1 are one number."""
        made = [
            {**row, "run": text} for row, text in zip(self.named([1, 2]), ["1", "1.0", "1"] + ["2"] * 3, strict=True)
        ]
        log = datasets.read(write_csv(tmp_path / "x.csv", made), trial="run", obs=["x"], action=["u"])
        assert log.names == ("1", "2")

    @pytest.mark.parametrize("other", ["7", "A", "007"])
    def test_unknown(self, other: str, tmp_path: Path) -> None:
        """Rows of an unknown trial are not of one trial; "none" may be a condition."""
        file = write_csv(tmp_path / "x.csv", self.named([other, "NA"]))
        quoted = r" \('NA'\)" if other == "A" else ""
        with pytest.raises(envs.InputError, match=rf"'run' of .*x\.csv is empty{quoted} in row 4"):
            datasets.read(file, trial="run", obs=["x"], action=["u"])
        file = write_csv(tmp_path / "y.csv", self.named(["heavy", "none"]))
        assert datasets.read(file, trial="run", obs=["x"], action=["u"]).names == ("heavy", "none")

    @pytest.mark.parametrize("role", ["trial", "episode"])
    def test_names_that_are_no_text(self, role: str, tmp_path: Path) -> None:
        file = write_csv(tmp_path / "x.csv", self.named([1, 2]))
        for name in (["run"], ("run",), 3):
            with pytest.raises(envs.InputError, match=rf"^{role} was .*; it must be the name of a column"):
                datasets.read(file, obs=["x"], action=["u"], **{role: name})

    def test_several_columns(self, tmp_path: Path) -> None:
        """As a goal of two numbers: together they are a trial's name, and no observations."""
        goals = [(0.5, 1.0), (0.5, 2.0), (3.0, 1.0)]
        made = [{"goal.0": a, "goal.1": b, "x": float(t), "u": t / 10} for a, b in goals for t in range(3)]
        for trial in ("goal", "g*"):
            log = datasets.read(write_csv(tmp_path / "x.csv", made), trial=trial, action=["u"], obs=["*"])
            assert log.names == ("0.5, 1", "0.5, 2", "3, 1")
            assert log.units.obs == ("x",)
        made[4]["goal.1"] = ""
        with pytest.raises(envs.InputError, match=r"'goal\.1' of .*x\.csv is empty in row 5"):
            datasets.read(write_csv(tmp_path / "x.csv", made), trial="goal", action=["u"], obs=["x"])

    @pytest.mark.parametrize("names", [[2**60, 2**60 + 1], [20261129001, 20261129002]])
    def test_parquet(self, names: list[int], tmp_path: Path) -> None:
        """Whole numbers that float64 rounds; in a column that nobody asks for they are no trouble."""
        made = self.named(names)
        columns = {key: [row[key] for row in made] for key in made[0]}
        columns["stamp"] = [2**62 + i for i in range(len(made))]
        log = datasets.read(write_parquet(tmp_path / "x.parquet", columns), trial="run", obs=["x"], action=["u"])
        assert log.names == tuple(map(str, names))

    def test_decimals(self, tmp_path: Path) -> None:
        """Of more digits than a float64 keeps they are different names; of less they are numbers."""
        pyarrow = pytest.importorskip("pyarrow")
        names = [Decimal(2**60), Decimal(2**60 + 1)]
        made = self.named(names)
        columns = {key: [row[key] for row in made] for key in made[0]}
        columns["run"] = pyarrow.array(columns["run"], pyarrow.decimal128(38, 0))
        columns["x"] = pyarrow.array([Decimal(f"{x:.2f}") for x in columns["x"]], pyarrow.decimal128(9, 2))
        log = datasets.read(write_parquet(tmp_path / "x.parquet", columns), trial="run", obs=["x"], action=["u"])
        assert log.names == tuple(map(str, names))

    @pytest.mark.parametrize(("unit", "per_second"), [("s", 1), ("ms", 10**3), ("us", 10**6), ("ns", 10**9)])
    def test_times_are_in_seconds(self, unit: str, per_second: int, tmp_path: Path) -> None:
        """From the first of a file on, and durations from their least, whatever unit they are kept in."""
        pyarrow = pytest.importorskip("pyarrow")
        ticks = [per_second * second for second in (10, 12, 15)]
        kinds = pyarrow.timestamp(unit), pyarrow.duration(unit)
        columns = {name: pyarrow.array(ticks, kind) for name, kind in zip(("at", "took"), kinds, strict=True)}
        read = parquet_columns(write_parquet(tmp_path / "times.parquet", columns))
        assert {name: x.tolist() for name, x in read.items()} == {"at": [0, 2, 5], "took": [0, 2, 5]}

    def test_days_times_of_a_day_and_views_of_text(self, tmp_path: Path) -> None:
        """Both are seconds; names of trials are whole."""
        pyarrow, day = pytest.importorskip("pyarrow"), 24 * 3600
        columns = {
            "day": pyarrow.array([19000, 19001, 19003], pyarrow.date32()),
            "hour": pyarrow.array([7200, 7205, 3600], pyarrow.time32("s")),
            "run": pyarrow.array(["a", "b", "a"], pyarrow.string_view()),
        }
        read = parquet_columns(write_parquet(tmp_path / "x.parquet", columns))
        assert {name: x.tolist() for name, x in read.items()} == {
            **{"day": [0, day, 3 * day], "hour": [3600, 3605, 0], "run": ["a", "b", "a"]}
        }

    def test_times_of_several_files(self, tmp_path: Path) -> None:
        """A trial that is named by when it began: times are not counted from each file's own first."""
        pyarrow, files = pytest.importorskip("pyarrow"), []
        for i in range(3):
            columns: dict[str, Any] = {key: [row[key] for row in self.named([0])] for key in ("x", "u")}
            columns["started"] = pyarrow.array([10**15 + i] * 3, pyarrow.timestamp("us"))
            files.append(write_parquet(tmp_path / f"{i}.parquet", columns))
        log = datasets.read(files, trial="started", obs=["x"], action=["u"])
        assert log.mask.shape[:2] == (3, 1)
        assert "Several files" not in " ".join(log.notes)

    def test_one_name_in_two_files(self, tmp_path: Path) -> None:
        """It is one trial, and a note says so."""
        files = [write_csv(tmp_path / f"{i}.csv", self.named([0, i])) for i in (1, 2)]
        log = datasets.read(files, trial="run", obs=["x"], action=["u"])
        assert log.names == ("0", "1", "2")
        assert [type(note) for note in log.notes if note.startswith("Rows of trial 0 are in several files")] == [Odd]


class TestActions:
    def test_one_range_of_all_files(self, tmp_path: Path) -> None:
        wide = [{**row, "throttle": 2 * row["throttle"] if row["throttle"] else ""} for row in rows()]
        files = [write_csv(tmp_path / f"{i}.csv", made) for i, made in enumerate((rows(), wide))]
        expert, explored = datasets.read_together(files, **ROLES)
        assert expert.units == explored.units
        assert expert.units.high == (2 * np.concatenate(ACTIONS).max(),)
        raw = expert.units.unscaled(expert.action[0, 0, :3].astype(float))
        np.testing.assert_allclose(raw, ACTIONS[0], rtol=1e-5)

    @pytest.mark.parametrize(
        ("values", "kept"),
        [
            (("left", "right", "on"), ("left", "on", "right")),
            ((3, 4, 5), (3, 4, 5)),
            (("0.0", "1.0", "2.0"), (0, 1, 2)),
            ((0, 40, 100), ()),
            ((0.5, 1, 2), ()),
        ],
    )
    def test_discrete(self, values: tuple[Any, ...], kept: tuple[Any, ...], tmp_path: Path) -> None:
        made = [{**row, "throttle": values[i % 3] if row["throttle"] else ""} for i, row in enumerate(rows())]
        log = datasets.read(write_csv(tmp_path / "x.csv", made), **ROLES)
        assert log.units.values == kept
        assert log.actions == len(kept)
        gaps = [note for note in log.notes if "They are whole numbers with gaps (0, 40, 100); discrete ones" in note]
        assert [type(note) for note in gaps] == [Odd] * (values == (0, 40, 100))
        back = log.units.unscaled(log.action[0, 0, :3])[:, 0].tolist()
        texts = isinstance(values[0], str) and kept[0] != 0
        assert back == (list(values) if texts else pytest.approx([float(value) for value in values]))

    def test_in_one_unit_they_stay(self, tmp_path: Path) -> None:
        """Actions from -1 to 1 keep their bits."""
        made = rows(AFTER)
        for row, value in zip(made, np.random.default_rng(0).uniform(-1e-12, 1e-12, len(made)), strict=True):
            row["throttle"] = value
        made[0]["throttle"], made[1]["throttle"] = -1, 1
        log = datasets.read(write_csv(tmp_path / "x.csv", made), **ROLES)
        np.testing.assert_array_equal(log.action[0, 0, :3, 0], np.float32([row["throttle"] for row in made[:3]]))
        assert not log.units.raw

    @pytest.mark.parametrize("discrete", [False, True])
    def test_an_agent_acts_in_raw_units(self, discrete: bool, tmp_path: Path) -> None:
        """The same after it was saved; it is told of actions in these units too."""
        made = rows()
        if discrete:
            made = [{**row, "throttle": ("stop", "go")[i % 2] if row["throttle"] else ""} for i, row in enumerate(made)]
        log = datasets.read(write_csv(tmp_path / "x.csv", made), **ROLES)
        plain = naive_rnn.train(log, RecurrentConfig(updates=2, batch=2), np.random.default_rng(0))
        agent = log.units.agent(plain)
        assert isinstance(agent, RawAgent)
        agent.save(tmp_path / "agent")
        obs, acted = np.zeros((1, 2), np.float32), []
        for actor in (agent, deconfounded.load(tmp_path / "agent"), plain):
            actor.begin(1)
            actor.reset([np.random.default_rng(0)])
            action = actor.act(obs)
            for _ in range(2):
                actor.observe(obs, action, obs + 1, np.ones(1, bool))
                action = actor.act(obs + 1)
            acted.append(action)
        np.testing.assert_array_equal(acted[0], acted[1])
        np.testing.assert_array_equal(acted[0], log.units.unscaled(acted[2]))
        assert discrete is (acted[0][0, 0] in ("stop", "go"))

    def test_units_are_those_of_trials_only_from_end_to_end(self) -> None:
        """Of every action: -1 to 1; or discrete ones by their numbers."""
        names = ("x",), ("y", "z")
        for low, high in (((-1, 0), (1, 1)), ((-1, -1), (1, 2)), ((0, 0), (2, 2))):
            assert Units(*names, low, high).raw
        assert not Units(*names, (-1, -1), (1, 1)).raw
        assert [Units(("x",), ("y",), (0,), (1,), values).raw for values in ((0, 1), (1, 2))] == [False, True]

    def test_what_is_no_action(self) -> None:
        units = Units(("x",), ("y",), (0.0,), (1.0,), ("go", "stop"))
        with pytest.raises(envs.InputError, match="an action was 'jump'; it must be one of go, stop"):
            units.scaled(np.array([["jump"]], object))


def test_large_ids_beside_small_ones(tmp_path: Path) -> None:
    """Of a parquet file: float64 would take the last two for one."""
    ids = [1, 2**53, 2**53 + 1]
    columns = {"id": np.repeat(ids, 3), "o": np.arange(9.0), "a": np.arange(9.0) % 2 - 0.3}
    log = datasets.read(write_parquet(tmp_path / "x.parquet", columns), "id", obs=["o"], action=["a"])
    assert log.names == tuple(map(str, ids))


def test_ranges_of_several_logs() -> None:
    """The widest that any of them declares, whatever was done."""
    made = [
        Table(
            name, {"o": np.arange(6.0), "a": np.linspace(-0.3, 0.4, 6)}, np.zeros(6, int), ("o",), ("a",), None, limits
        )
        for name, limits in (("first", {"a": (-1.0, 1.0)}), ("second", {"a": (-2.0, 0.5)}))
    ]
    for log in trials_of([[table] for table in made], Roles()):
        assert (log.units.low, log.units.high) == ((-2.0,), (1.0,))


BAD: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {  # roles; changes of row 3; what is said
    "missing": ({"obs": ["speed z"]}, {}, "obs 'speed z' is no column of .*x.csv; did you mean 'speed [xy]'?"),
    "pattern": (
        {"action": ["steer*"]},
        {},
        "action 'steer.' is no column of .*; there are vehicle, lap, time, speed x",
    ),
    "case": ({"trial": "VEHICLE"}, {}, "trial 'VEHICLE' is no column of .*; did you mean 'vehicle'?"),
    "text": ({}, {"speed x": "fast"}, "'speed x' of .*x.csv is 'fast' in row 3; it must be a number"),
    "a decimal comma": (
        {},
        {"speed x": "-0,5"},
        "'speed x' of .*x.csv is '-0,5' in row 3; it must be a number, with a decimal point",
    ),
    "text among actions": ({}, {"throttle": "off"}, "'throttle' of .*x.csv is 'off' in row 3; it must be a number"),
    "NaN": ({}, {"speed x": "nan"}, "'speed x' of .*x.csv holds no number in row 3"),
    "no action": ({}, {"throttle": ""}, "'throttle' of .*x.csv is empty in row 3"),
    "infinite": ({}, {"throttle": "inf"}, "'throttle' of .*x.csv is infinite in row 3"),
    "infinite observation": ({}, {"speed x": "-inf"}, "'speed x' of .*x.csv is infinite in row 3"),
    "two roles": ({"obs": ["speed x", "throttle"]}, {}, "obs 'throttle' of .*x.csv is an action too; a column has one"),
    "a trial observed": ({"obs": ["speed x", "vehicle"]}, {}, "obs 'vehicle' of .* is what a trial or an episode is"),
    "a trial and an episode": (
        {"episode": "vehicle"},
        {},
        "trial 'vehicle' of .* is the episode too; a column has one",
    ),
    "apart": (
        {},
        {"lap": 7},
        "rows of vehicle a, lap 0 stand apart in .*, from row 1 and again from row 4; sort it by",
    ),
    "no trial": ({}, {"vehicle": ""}, "'vehicle' of .* is empty in row 3"),
    "nothing said": ({"obs": []}, {}, "does not say which columns are obs; give --obs, some of vehicle, lap"),
    "no episode": ({"trial": None, "episode": None}, {}, "does not say where an episode begins; give --episode or"),
    "no list": ({"obs": None}, {}, "obs was None; it must be a list of columns$"),
    "one text": ({"obs": "speed x"}, {}, r"obs was 'speed x'; it must be a list of columns, \['speed x'\]"),
    "an action that is the trial": ({"action": ["vehicle"]}, {}, "action 'vehicle' of .* is what a trial or an"),
    "all used": ({"obs": ["thr*", "lap*"]}, {}, "no column of .* is left for obs, beside the trial"),
}


class TestBadInput:
    @pytest.mark.parametrize("case", BAD)
    def test_one_line(self, case: str, tmp_path: Path) -> None:
        roles, changes, says = BAD[case]
        made = [{**row, **changes} if i == 2 else row for i, row in enumerate(rows())]
        with pytest.raises(envs.InputError, match=says) as caught:
            datasets.read(write_csv(tmp_path / "x.csv", made), **{**ROLES, **roles})
        assert "\n" not in str(caught.value)

    def test_half_an_observation_at_the_end_of_an_episode(self, tmp_path: Path) -> None:
        """A row without any observation has none to give; one that lacks a part of it is a failure of a sensor."""
        made = rows()
        made[-1]["speed x"] = ""
        with pytest.raises(envs.InputError, match=rf"'speed x' of .*x.csv holds no number in row {len(made)}"):
            datasets.read(write_csv(tmp_path / "x.csv", made), **ROLES)

    def test_a_row_of_a_later_episode_is_named(self, tmp_path: Path) -> None:
        made = rows()
        made[-3]["throttle"] = "inf"
        with pytest.raises(envs.InputError, match=rf"'throttle' of .*x.csv is infinite in row {len(made) - 2}"):
            datasets.read(write_csv(tmp_path / "x.csv", made), **ROLES)

    @pytest.mark.parametrize("source", [None, 3, [], [None]])
    def test_no_path(self, source: Any) -> None:
        with pytest.raises(envs.InputError, match=r"a log was .*; it must be a \.csv, \.parquet"):
            datasets.read(source, **ROLES)

    def test_no_logs(self) -> None:
        with pytest.raises(envs.InputError, match="no log was given; give one or several"):
            datasets.read_together([], **ROLES)

    def test_actions_of_the_row_before(self, tmp_path: Path) -> None:
        made = rows(AFTER)
        for i, row in enumerate(made):
            row["throttle"] = "" if not i or made[i - 1]["lap"] != row["lap"] else 1.5 * i
        with pytest.raises(envs.InputError, match=r"empty in the first row of 5 episodes .* move it up by a row"):
            datasets.read(write_csv(tmp_path / "x.csv", made), **ROLES)

    def test_one_action_that_is_lost(self, tmp_path: Path) -> None:
        """In an episode's first row, which is no reason to move up all of them."""
        made = rows(AFTER)
        made[0]["throttle"] = ""
        with pytest.raises(envs.InputError, match=r"'throttle' of .*x.csv is empty in row 1$"):
            datasets.read(write_csv(tmp_path / "x.csv", made), **ROLES)

    def test_text_beyond_the_first_block(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """A column whose first blocks are numbers keeps its texts as they are written."""
        monkeypatch.setattr("deconfounded.experts.datasets.tabular.BLOCK", 4)
        made = [{**row, "vehicle": {"a": "007", "b": "8", "c": "x"}[row["vehicle"]]} for row in rows()]
        log = datasets.read(write_csv(tmp_path / "x.csv", made), **ROLES)
        assert log.names == ("007", "8", "x")
        assert log.sha256 == expected().sha256

    @pytest.mark.parametrize(
        ("name", "content", "says"),
        [
            ("x.xlsx", b"PK", "x.xlsx is of an unknown kind; give a .csv, .parquet"),
            ("x.csv", b"\xff\xfe\x00", "x.csv is no csv in UTF-8"),
            ("x.csv", b"", "has no header"),
            ("x.csv", b"a,b\n", "holds no rows beside its header"),
            ("x.csv", b"a,b\n1,2\n1,2,3\n", "line 3 of .*x.csv has 3 cells; its header has 2"),
            ("x.csv", b"a,b\n1,2\n1\n3,4\n", "line 3 of .*x.csv has 1 cells; its header has 2"),
            ("x.csv", b"a,a\n1,2\n", "two columns that are called 'a'"),
            ("x.parquet", b"junk", "x.parquet cannot be read as parquet"),
            ("x.hdf5", b"junk", "x.hdf5 cannot be read as HDF5"),
            ("x.npz", b"junk", "no trials could be read from .*x.npz: it is damaged, or no .npz file of Trials.save"),
        ],
    )
    def test_no_such_file(self, name: str, content: bytes, says: str, tmp_path: Path) -> None:
        if name == "x.parquet":
            pytest.importorskip("pyarrow")
        (tmp_path / name).write_bytes(content)
        with pytest.raises(envs.InputError, match=says) as caught:
            datasets.read(tmp_path / name)
        assert "\n" not in str(caught.value)

    def test_nothing_there(self, tmp_path: Path) -> None:
        with pytest.raises(envs.InputError, match=r"there is no .*gone.csv; give"):
            datasets.read(tmp_path / "gone.csv")

    def test_links_to_nothing(self, tmp_path: Path) -> None:
        h5py = pytest.importorskip("h5py")
        robomimic = {"data/demo_0/obs/x": np.zeros((4, 2)), "data/demo_0/actions": np.zeros((4, 1))}
        flat = {"observations": np.zeros((4, 2)), "actions": np.zeros((4, 1)), "terminals": np.zeros(4)}
        for content, link, says in (
            (robomimic, "data/demo_0/obs/y", "obs/y of .* is a link to nothing"),
            (robomimic, "data/demo_1", "demo_1 of .* must hold `actions` and `obs`"),
            (flat, "extra", "extra of .* is a link to nothing"),
        ):
            with h5py.File(tmp_path / "links.hdf5", "w") as file:
                for key, array in content.items():
                    file[key] = array
                file[link] = h5py.ExternalLink("gone.hdf5", "/x")
            with pytest.raises(envs.InputError, match=says):
                datasets.read(tmp_path / "links.hdf5")

    def test_hdf5_of_others(self, tmp_path: Path) -> None:
        h5py = pytest.importorskip("h5py")
        for name, content, says in (
            ("strange", {"x": np.zeros(3)}, "holds x; it must hold `data/demo_0` as of robomimic"),
            (
                "flat",
                {"observations": np.zeros((4, 2)), "actions": np.zeros((4, 1))},
                "neither `terminals` nor `timeouts`",
            ),
            ("less", {"observations": np.zeros((4, 2)), "actions": np.zeros((3, 1))}, "4 observations and 3 actions"),
            (
                "demo",
                {"data/demo_0/obs/x": np.zeros((4, 2)), "data/demo_0/actions": np.zeros((3, 1))},
                "obs/x of demo_0",
            ),
            ("none", {"data/demo_0/states": np.zeros((4, 2))}, "must hold `actions` and `obs`"),
            ("number", {"data/demo_0/obs/x": np.zeros((4, 2)), "data/demo_0/actions": 1.0}, "of at least one step"),
            ("empty", {"data/demo_0/obs/x": np.zeros((0, 2)), "data/demo_0/actions": np.zeros((0, 1))}, "at least one"),
            ("folder", {"data/demo_0/obs/x": np.zeros((4, 2)), "data/demo_0/actions/x": np.zeros(4)}, "at least one"),
            (
                "flat_folder",
                {"observations": np.zeros((4, 2)), "actions/x": np.zeros(4)},
                "holds actions, observations",
            ),
            ("flat_number", {"observations": np.zeros((4, 2)), "actions": 1.0}, "is a single number"),
        ):
            with h5py.File(tmp_path / f"{name}.hdf5", "w") as file:
                for key, array in content.items():
                    file[key] = array
            with pytest.raises(envs.InputError, match=says):
                datasets.read(tmp_path / f"{name}.hdf5")

    def test_lerobot_with_files_missing(self, tmp_path: Path) -> None:
        of_lerobot(tmp_path)
        (tmp_path / "set" / "data" / "chunk-000" / "file-001.parquet").unlink()
        with pytest.raises(envs.InputError, match=r"holds 10 frames; its meta/info.json says 22: are files missing?"):
            datasets.read(tmp_path / "set")
        (tmp_path / "set" / "meta" / "info.json").write_text('{"codebase_version": "v1.6", "features": {}}')
        with pytest.raises(envs.InputError, match=r"of version v1.6; it must be v2 or v3"):
            datasets.read(tmp_path / "set")

    @pytest.mark.parametrize(
        ("content", "says"),
        [
            (b"\xff\xfe", "info.json is not in UTF-8"),
            (b'{"codebase_version": "v3.0", "features": {"action": 1}}', "feature action of .* is no dictionary"),
        ],
    )
    def test_lerobot_of_others(self, tmp_path: Path, content: bytes, says: str) -> None:
        of_lerobot(tmp_path)
        (tmp_path / "set" / "meta" / "info.json").write_bytes(content)
        with pytest.raises(envs.InputError, match=says):
            datasets.read(tmp_path / "set")

    def test_a_trial_that_ends_within_an_episode(self, tmp_path: Path) -> None:
        of_lerobot(tmp_path)
        with pytest.raises(envs.InputError, match=r"'timestamp' of .* changes within an episode, in row 2"):
            datasets.read(tmp_path / "set", "timestamp")

    def test_files_that_differ(self, tmp_path: Path) -> None:
        first = write_csv(tmp_path / "a.csv", rows())
        other = write_csv(tmp_path / "b.csv", [{**row, "speed z": 1} for row in rows()])
        with pytest.raises(envs.InputError, match=r"b.csv and .*a.csv have other columns: speed z"):
            datasets.read([first, other], **ROLES)

    def test_columns_of_npz(self, tmp_path: Path) -> None:
        expected().save(tmp_path / "x.npz")
        assert datasets.read(tmp_path / "x.npz").sha256 == expected().sha256
        with pytest.raises(envs.InputError, match="has no columns to choose"):
            datasets.read(tmp_path / "x.npz", trial="vehicle")


def test_actions_too_large_for_arithmetic(tmp_path: Path) -> None:
    """Their squares would overflow; observations have the same limit."""
    rows = "".join(f"{trial},{step},{step},{1e300 if step else 0}\n" for trial in range(3) for step in range(4))
    (tmp_path / "log.csv").write_text(f"trial,x,y,torque\n{rows}")
    with pytest.raises(envs.InputError, match=r"an action, torque, was 1e\+300; it must be at most 1e\+15 in size"):
        datasets.read(tmp_path / "log.csv", trial="trial", obs=["x", "y"], action=["torque"])
