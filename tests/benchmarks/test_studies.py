"""What the studies share, and what the benchmark costs."""

import json
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from deconfounded import envs
from deconfounded.benchmarks import commands
from deconfounded.benchmarks.engine import presets, scheduler
from deconfounded.benchmarks.studies import findings, latency, particles, performance, runs, stepping, tune
from deconfounded.deconf.exact import ExactAgent
from deconfounded.envs.physics import cores
from deconfounded.envs.tasks.bandit import Bandit
from deconfounded.experts.agent import ExpertAgent
from tests.tools import dots, tiny_preset


@pytest.mark.slow
def test_performance(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All parts, small: each leaves its numbers, which are above 0, and its picture."""
    for module, name, value in (
        *((stepping, "SIZES", (1, 65)), (performance, "STEPS", (10, 20)), (performance, "VALUES", (2, 3))),
        *((performance, "GRID", "bandit"), (performance, "SEEDS", (1, 2)), (performance, "TIMED", ("naive_rnn",))),
        *((performance, "LEARNED", ("blind_bc",)), (performance, "SHARES", (0.5,)), (particles, "TRIALS", 2)),
    ):
        monkeypatch.setattr(module, name, value)
    monkeypatch.setattr(presets, "preset", lambda *_: tiny_preset())
    monkeypatch.setattr("sys.argv", ["performance", "--tasks", "tilted_cartpole", "--out", str(tmp_path)])
    performance.main()
    read = {file.stem: json.loads(file.read_text()) for file in tmp_path.glob("*.json")}
    few, many = read["speed"]["tasks"]["tilted_cartpole"].values()
    assert set(few) - set(many) == {"sync_vector_env"}, "65 single environments are too many"
    assert all(rate > 0 for name, rate in [*few.items(), *many.items()] if name != "kib")
    assert {what: [*by] for what, by in read["growth"].items()} == {
        "steps of a trial": ["an update of the belief", "a pass of the RNN"],
        "values of the grid": ["exact interventional", "exact conditional"],
    }
    assert [*read["growth"]["steps of a trial"]["a pass of the RNN"]] == ["10", "20"]
    assert [*read["seeds"]["methods"]["naive_rnn"]] == ["1", "2"]
    assert read["training"]["cpu_s"]["blind_bc"] > 0
    assert 0 < read["latency"]["methods"]["blind_bc"]["median_ms"] <= read["latency"]["methods"]["blind_bc"]["p99_ms"]
    assert [(row["task"], row["trials"]) for row in read["particles"]["rows"]] == [("tilted_cartpole", 2)]
    cost = read["cost-tilted_cartpole"]["methods"]
    assert [(method, *points) for method, points in cost.items()] == [("blind_bc", "0.5")]
    for name in ("speed", "growth", "cost-tilted_cartpole"):
        assert (tmp_path / f"{name}.png").stat().st_size > 5000


def test_median_of_repeats_after_one_to_warm_up() -> None:
    """Of runs in turn: one takes 100, 1, 2 and 9 seconds, the other none."""
    now, took = 0.0, iter([100.0, 1.0, 2.0, 9.0])

    def slow() -> None:
        nonlocal now
        now += next(took)

    assert stepping.seconds({"slow": slow, "fast": lambda: None}, lambda: now, 3) == {"slow": 2, "fast": 0}
    assert performance.power({1: 3.0, 2: 12.0, 4: 48.0}) == pytest.approx(2)


def test_rates_are_in_control_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of runs that take 2 s: all environments' steps, and physics steps of all threads by those of a control step."""
    task = envs.get("icy_stop")
    assert isinstance(task, envs.MujocoTask)
    assert task.substeps == 5
    monkeypatch.setattr(stepping, "seconds", lambda runs: dict.fromkeys(runs, 2.0))
    rates = stepping.measure(task, 3)
    assert rates["closed_loop"] == rates["open_loop"] == 3 * task.horizon / 2
    assert rates["sync_vector_env"] == 3 * task.horizon / 2  # no more steps than there are
    assert rates["mj_step"] == 4000 * cores() / 5 / 2


def test_panels_of_speed(figures: list[Any], tmp_path: Path) -> None:
    """Closed loop over open loop, and microseconds of the closed one."""
    rows = {"1": {"closed_loop": 1e4, "open_loop": 2e4}, "16": {"closed_loop": 1e5, "open_loop": 4e5}}
    stepping.picture({"icy_stop": rows}, tmp_path / "speed.png")
    left, right = figures[0].axes
    assert dots(left) == [(1, 0.5), (16, 0.25)]
    np.testing.assert_allclose(dots(right), [(1, 100), (16, 10)])


def test_seconds_of_an_update(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock that advances 6 s from one report to the next, of three updates each; the first two warm up."""
    clock = count()
    monkeypatch.setattr(performance, "time", SimpleNamespace(perf_counter=lambda: 6.0 * next(clock)))

    def fit(context: Any, method: str) -> None:
        for done in (1, 2, 5, 8, 11):
            context.monitor.update(done, 11, {"imitation": 0.0})

    monkeypatch.setattr("deconfounded.benchmarks.engine.provider.fit", fit)
    task = envs.get("bandit")
    assert performance.update_seconds(task, tiny_preset(), "naive_rnn", 1) == {"imitation": 2.0}


def test_a_share_of_the_updates() -> None:
    """All else stays, and one update is left at least."""
    config = {"updates": 100, "final_updates": 1, "width": 64, "rounds": 2}
    assert performance.scaled(config, 0.25) == {**config, "updates": 25}


def test_table_of_rates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rates of the closed loop, as a share of the open one, beside others', and how much slower 4096 are than 256."""
    about = {"mj_step": 7000.0, "sync_vector_env": 800.0, "kib": 3.0}
    by_size = {
        n: {"closed_loop": rate, "open_loop": 2 * rate, **about}
        for n, rate in (("64", 1e4), ("256", 3e4), ("4096", 2e4))
    }
    monkeypatch.setattr(findings, "kept", lambda name: {"tasks": {"curling": by_size}})
    row = findings.rates().splitlines()[2].strip("| ").split(" | ")
    assert row == ["curling", "10,000", "30,000", "20,000", "0.50", "0.50", "0.50", "7,000", "800", "1.50", "3"]


def test_latency_is_in_milliseconds(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock that advances 2 ms from one reading to the next."""
    clock = count()
    monkeypatch.setattr(latency, "time", SimpleNamespace(perf_counter=lambda: 2e-3 * next(clock)))
    assert latency.latency(envs.get("bandit"), "random") == pytest.approx({"median_ms": 2, "p99_ms": 2})


def test_ranks_are_the_mass_below_theta() -> None:
    """By weight, each latent for itself; of mass at theta itself, any share."""
    belief: Any = SimpleNamespace(
        theta=np.array([[[0.0, 5.0], [1.0, 4.0], [2.0, 3.0]]] * 200),
        log_weight=np.log([[0.2, 0.3, 0.5]] * 200),
    )
    of = particles.ranks(belief, np.tile([1.5, 3.0], (200, 1)), np.random.default_rng(0))
    np.testing.assert_allclose(of[:, 0], 0.5)
    assert (of[:, 1].min(), of[:, 1].max()) == (pytest.approx(0, abs=0.02), pytest.approx(0.5, abs=0.02))


def test_particles_less_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scores by random actions and the expert of the same trials, differences by trial, and ranks that are all 1.

    The error stays too large, so that there are four times as many trials, of other seeds.
    """
    now, seeds = 0.0, set[int]()

    def run_trials(env: envs.BatchEnv, agent: Any, episodes: int, seed: int) -> Any:
        nonlocal now
        apart = np.arange(env.n)[:, None] + np.zeros(episodes)
        by = {ExpertAgent: 20.0 + 0 * apart, ExactAgent: 15.0 + 0 * apart, particles.ParticleAgent: 15.0 + apart}
        now += 3 if type(agent) is ExactAgent else 1
        seeds.add(seed)
        if type(agent) is particles.ParticleAgent:  # each trial's belief is at 0, and its theta above that
            agent.belief.theta, agent.belief.log_weight = np.zeros((env.n, 1, 1)), np.zeros((env.n, 1))
        theta = np.ones((env.n, episodes, 1))
        return SimpleNamespace(returns=by.get(type(agent), 10.0 + 0 * apart), theta=theta)

    monkeypatch.setattr(particles, "run_trials", run_trials)
    monkeypatch.setattr(particles, "time", SimpleNamespace(process_time=lambda: now))
    made = particles.compared(envs.get("tilted_cartpole"), 5)
    assert sorted(seeds) == [11, 16, 21, 26], "no trial twice"
    assert made["grid"] == {"score": 0.5, "cpu_s": 12.0}
    assert made["particles"] == {"score": 0.7, "cpu_s": 4.0}
    assert made["difference"] == pytest.approx(0.2)
    assert made["standard_error"] == pytest.approx(np.std([0, 0.1, 0.2, 0.3, 0.4] * 4, ddof=1) / np.sqrt(20), abs=1e-4)
    assert made["p"] == [0]
    row = particles.table([{"task": "tilted_cartpole", **made}]).splitlines()[2].strip("| ").split(" | ")
    assert row == ["tilted_cartpole", "20", "0.50", "0.70", "+0.200 ± 0.032", "0.00", "12", "4"]


def test_trials_of_beliefs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Many without physics; few where each step simulates every particle, or latents are many. What is there stays."""
    file, usual, few = tmp_path / "particles.json", particles.TRIALS, particles.FEW
    expected = {"bandit": particles.MANY, "curling": usual, "swapped_lander": few, "hidden_goal": usual}
    expected["lame_ant"] = few
    for made, tasks in ((1, ["bandit", "curling"]), (2, [*expected])):
        monkeypatch.setattr(particles, "compared", lambda task, trials, made=made: {"trials": trials, "made": made})
        particles.by_task([*map(envs.get, tasks)], file)
    rows = json.loads(file.read_bytes())["rows"]
    assert {row["task"]: row["trials"] for row in rows} == expected
    assert [row["made"] for row in rows] == [1, 1, 2, 2, 2]


@pytest.mark.parametrize(("name", "kinds"), [("patchy_road", {"grid", "particles"}), ("lame_ant", {"particles"})])
def test_what_has_a_grid(name: str, kinds: set[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Patches have one each; of four latents that are not of patches there are particles alone."""
    ran: list[str] = []

    def run_trials(env: envs.BatchEnv, agent: Any, episodes: int, seed: int) -> Any:
        ran.append(type(agent).__name__)
        expert = isinstance(agent, ExpertAgent)
        return SimpleNamespace(returns=np.full((env.n, episodes), 1.0 + expert), theta=np.zeros((env.n, episodes, 1)))

    monkeypatch.setattr(particles, "run_trials", run_trials)
    monkeypatch.setattr(particles, "ranks", lambda belief, theta, rng: np.ones((2, 1)))
    assert kinds == {*particles.compared(envs.get(name), 2)} & {"grid", "particles"}
    assert sorted(ran) == [*["ExactAgent"] * (len(kinds) - 1), "ExpertAgent", "ParticleAgent", "RandomAgent"], "once"


def test_runs_lock_their_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scheduler, "run_all", None)
    with commands.locked(tmp_path), pytest.raises(envs.InputError, match="another command is at work"):
        runs.run(envs.get("bandit"), tiny_preset(), ["random"], [0], tmp_path)


@pytest.mark.slow
@pytest.mark.usefixtures("here")
def test_runs_are_those_asked_for(tmp_path: Path) -> None:
    """What else the folder has is not in their records; what it has of them is not made again."""
    task, settings = envs.get("bandit"), tiny_preset()
    made = runs.run(task, settings, ["random", "expert"], [0, 1], tmp_path)
    assert sorted((one["method"], one["seed"]) for one in made) == [
        (m, i) for m in ("expert", "random") for i in (0, 1)
    ]
    before = {file: file.stat().st_mtime_ns for file in (tmp_path / "jobs").glob("*.npz")}
    again = runs.run(task, settings, ["random"], [1], tmp_path)
    assert [(one["method"], one["seed"]) for one in again] == [("random", 1)]
    assert {file: file.stat().st_mtime_ns for file in (tmp_path / "jobs").glob("*.npz")} == before


@pytest.mark.slow
@pytest.mark.usefixtures("here")
def test_settings_share_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of each setting its own numbers, and references that are made once; what is kept is not tried again."""
    (tmp_path / "docs").mkdir()
    for name, value in (("DOCS", tmp_path / "docs"), ("TASKS", ("bandit",)), ("BEFORE", {}), ("SEEDS", (100,))):
        monkeypatch.setattr(tune, name, value)
    monkeypatch.setattr(tune, "TRIED", {"naive_rnn": ({"width": 2},)})
    monkeypatch.setattr(presets, "preset", lambda *_: tiny_preset())
    monkeypatch.setattr("sys.argv", ["tune", "--out", str(tmp_path / "out")])
    tune.main()
    jobs, kept = tmp_path / "out" / "bandit" / "jobs", (tmp_path / "docs" / "tuning.json").read_text()
    made = {file.stem: file.stat().st_mtime_ns for file in jobs.glob("*.npz")}
    assert sorted(made) == ["demonstrations-100", "expert-100", "naive_rnn-100", "random-100"]
    assert made["naive_rnn-100"] > max(made[name] for name in made if name != "naive_rnn-100")
    usual, wide = json.loads(kept)["rows"]
    assert (usual["setting"], wide["setting"]) == ("the preset", "width x 2")
    assert 2 * usual["amounts"]["bandit"]["width"] == wide["amounts"]["bandit"]["width"]
    assert usual["loss"] != wide["loss"]
    tune.main()
    assert (tmp_path / "docs" / "tuning.json").read_text() == kept
    monkeypatch.setattr(type(envs.get("bandit")), "version", 99)
    monkeypatch.setattr("sys.argv", ["tune", "--out", str(tmp_path / "again")])
    tune.main()
    rows = json.loads((tmp_path / "docs" / "tuning.json").read_text())["rows"]
    assert [row["task_versions"] for row in rows] == [{"bandit": 99}] * 2


def test_a_certificate_is_kept_while_what_made_it_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = list[int]()

    def certify(task: envs.Task, expert: Any) -> dict[str, Any]:
        made.append(task.version)
        return {"verdict": "passed"}

    monkeypatch.setattr("deconfounded.benchmarks.certify.certify", certify)
    task = Bandit()
    for version in (1, 1, 2, 2):
        task.version = version
        assert runs.certificate(task, None, tmp_path) == {"verdict": "passed"}
    assert made == [1, 2]
    newer = {name: SimpleNamespace(version=99) for name in ("conditional", "interventional", "blind_bc")}
    monkeypatch.setattr(runs, "METHODS", newer)
    runs.certificate(task, None, tmp_path)
    assert made == [1, 2, 2]
