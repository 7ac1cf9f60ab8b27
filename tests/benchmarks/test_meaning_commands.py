"""What commands and the engine say and take, by what it means: returns that are played, versions, and digests."""

import json
import os
from argparse import ArgumentTypeError
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from deconfounded import envs
from deconfounded.benchmarks import play, run
from deconfounded.benchmarks.console import whole
from deconfounded.benchmarks.engine import catalogue, guest_host, job_files, local, sources
from deconfounded.benchmarks.engine.context import Context
from deconfounded.benchmarks.engine.provider import fit
from deconfounded.benchmarks.output import certificate, records
from deconfounded.benchmarks.studies import cards, table
from deconfounded.envs.support.origin import ROOT
from deconfounded.experts.agent import RandomAgent
from deconfounded.experts.datasets.units import Units
from deconfounded.experts.rollout import run_trials
from tests import toys
from tests.tools import deconf, tiny_preset

METHOD = """
from deconfounded.deconf.method import uses

@uses("demonstrations", version=3)
def fit(given): pass
"""


def test_a_return_that_is_played_is_the_sum_of_its_episode_s_rewards() -> None:
    """An episode ends where the environment says so, by a fall or by the time limit."""
    episodes: list[list[float]] = []

    class Watched(envs.GymEnv):
        def reset(self, **options: Any) -> Any:
            episodes.append([])
            return super().reset(**options)

        def step(self, action: Any) -> Any:
            then = super().step(action)
            episodes[-1].append(then[1])
            return then

    env = Watched(toys.Push())
    returns, _ = play.play(RandomAgent(env.task.action_space), env, 8, 5)
    assert returns == pytest.approx([sum(rewards) for rewards in episodes])
    lengths = [len(rewards) for rewards in episodes]
    assert max(lengths) <= env.task.horizon
    assert max(lengths) > 1
    assert len(set(lengths)) > 1


def test_actions_that_are_remembered_are_those_that_were_taken() -> None:
    """The environment clips them, as it does in a run; an agent may leave that to it."""
    remembered: list[float] = []

    class Strong(RandomAgent):
        def act(self, obs: NDArray[np.float32]) -> Any:
            return 3 * super().act(obs)

        def observe(self, obs: Any, action: Any, next_obs: Any, alive: Any) -> None:
            remembered.extend(action[0])

    env = envs.GymEnv(toys.Push())
    play.play(Strong(env.task.action_space), env, 8, 5)
    assert max(map(abs, remembered)) == 1


def test_what_play_is_asked_for(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """So many episodes, under that seed and theta; as many as in the task's trials where no number is given."""
    asked: list[tuple[Any, ...]] = []

    def played(agent: Any, env: envs.GymEnv, episodes: int, seed: int, theta: Any) -> Any:
        env.reset(seed=seed, options=theta and {"theta": theta})
        asked.append((agent, episodes, seed, theta))
        return [1.25, -0.5], []

    monkeypatch.setattr(play, "ready", lambda folder, task: f"{folder} on {task.name}")
    monkeypatch.setattr(play, "play", played)
    for more in ([], ["--episodes", "2", "--seed", "4", "--theta", "0.25"]):
        monkeypatch.setattr("sys.argv", ["play", "--agent", "mine", "--task", "slippery_cartpole", *more])
        play.main()
    agent, task = "mine on slippery_cartpole", envs.get("slippery_cartpole")
    assert task.episodes != 2
    assert asked == [(agent, task.episodes, 0, None), (agent, 2, 4, [0.25])]
    said = f"slippery_cartpole, friction 0.25 {task.latents[0].unit}".strip()
    assert capsys.readouterr().out.splitlines()[1] == f"{said}: returns 1.25 -0.50"


def test_the_version_of_a_method_from_outside_is_its_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever number it declares: a change of the text alone makes its records stale."""
    monkeypatch.setattr(catalogue.METHODS, "outside", {})
    (tmp_path / "versioned.py").write_text(METHOD)
    name = catalogue.add(f"{tmp_path}/versioned.py:fit")
    assert catalogue.METHODS[name].version == 0
    guest = catalogue.guest(name)
    assert guest is not None
    assert (guest.version, guest.uses) == (0, ("demonstrations",))


def test_a_digest_is_of_names_and_contents(tmp_path: Path) -> None:
    """Wherever the files lie, and in any order; but not if two of them change places, or if one has another name."""
    texts = {"a.py": "x = 1", "b.py": "x = 2"}
    folders = {"first": texts, "again": texts, "turned": {"a.py": "x = 2", "b.py": "x = 1"}}
    folders["named"] = {"a.py": "x = 1", "c.py": "x = 2"}
    made: dict[str, set[str]] = {}
    for folder, held in folders.items():
        (tmp_path / folder).mkdir()
        for name, text in held.items():
            (tmp_path / folder / name).write_text(text)
        files = [tmp_path / folder / name for name in held]
        made[folder] = {sources.digest(files), sources.digest(reversed(files))}
    assert [len(digests) for digests in made.values()] == [1] * 4
    assert made["first"] == made["again"]
    assert len(set.union(*made.values())) == 3


def test_whether_two_machines_have_the_same_is_without_what_a_wheel_lacks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Studies are in a checkout alone; code, models and weights count, and pictures do not."""
    monkeypatch.setattr(sources, "OURS", (tmp_path,))
    counts = {"a.py": True, "b.xml": True, "c.safetensors": True, "studies/d.py": False, "e.png": False}
    (tmp_path / "studies").mkdir()
    for name in counts:
        (tmp_path / name).write_text("1")
    before = sources.package.__wrapped__()
    for name, matters in counts.items():
        (tmp_path / name).write_text("23")
        assert (sources.package.__wrapped__() != before) is matters, name
        before = sources.package.__wrapped__()


@pytest.mark.parametrize("key", ["returns", "objective", "probe"])
def test_a_job_s_file_without_a_number_is_broken(key: str) -> None:
    """Whichever of its arrays lacks it: the record would hold it too."""
    shapes = {"x/returns": (2, 3), "x/objective": (2, 3), "x/probe": (3,)}
    meta = {"identity": {"method": "x"}, "seed": 0, "budget": {}, "spans": [], "cpu_s": 1.0, "arrays": list(shapes)}
    meta |= {"machine": "m", "commit": None, "agents": {"x": ""}, "curve": {}, "tier": "1"}
    data = {"meta": meta, **{name: np.zeros(shape) for name, shape in shapes.items()}}
    assert job_files.broken(data) == ""
    for value in (np.nan, -np.inf):
        data[f"x/{key}"][-1] = value
        assert job_files.broken(data) == f"x/{key} holds NaN or infinity"


def test_many_seeds_have_a_name_of_their_own() -> None:
    """It is short, though others may have the same first and last."""
    many, fewer = list(range(12)), [*range(10), 11]
    assert job_files.in_name([0, 2, 1]) == "0-2-1"
    assert job_files.in_name(many).startswith("0-to-11-")
    assert job_files.in_name(many) == job_files.in_name(tuple(many)) != job_files.in_name(fewer)
    assert len(job_files.in_name(range(1000))) < 30


@pytest.mark.parametrize("threads", [None, "4"])
def test_workers_alone_have_one_thread(threads: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever this process has, it has again when they are made."""
    if threads is None:
        monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    else:
        monkeypatch.setenv("OMP_NUM_THREADS", threads)
    with local.inherited():
        assert os.environ["OMP_NUM_THREADS"] == "1"
    assert os.environ.get("OMP_NUM_THREADS") == threads


def test_a_gpu_has_a_single_job_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which has all seeds side by side; of a CPU, each core has its own."""
    monkeypatch.setattr(local, "cores", lambda: 6)
    with local.Local() as engine:
        assert [engine.slots(device) for device in ("cpu", "cuda", "cuda:1")] == [6, 1, 1]


@pytest.mark.parametrize(
    ("more", "docs"), [([], True), (["--set", "eval_trials=4"], False), (["--preset", "smoke"], False)]
)
def test_the_table_in_docs_is_of_default_runs_alone(
    more: list[str], docs: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Records of other settings, or of another preset, are kept in the folder given."""
    read: list[Path] = []
    monkeypatch.setattr(records, "held", lambda file: (read.append(file), [])[1])
    words = ["table", "--tasks", "bandit", "--methods", "random", "--seeds", "1", "--list", "--out", str(tmp_path)]
    monkeypatch.setattr("sys.argv", [*words, *more])
    table.main()
    assert [file.is_relative_to(cards.DOCS if docs else tmp_path) for file in read] == [True]


def test_the_last_edit_is_the_latest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of any Python file of the package, in any of its folders."""
    monkeypatch.setattr(sources, "OURS", (tmp_path / "a", tmp_path / "b"))
    for name, at in (("a/x.py", 1), ("b/c/y.py", 3), ("b/z.py", 2), ("b/z.png", 9)):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
        os.utime(tmp_path / name, ns=(0, at))
    assert sources.last_edit() == 3


def test_a_whole_number_of_the_command_line_is_of_its_range() -> None:
    """Both ends are."""
    number = whole(2, 5)
    assert [number(text) for text in ("2", "5")] == [2, 5]
    assert whole(2)("10") == 10
    for text in ("1", "6", "2.5", "x", ""):
        with pytest.raises(ArgumentTypeError, match="it must be a whole number from 2 to 5"):
            number(text)


def test_an_agent_of_another_class_gets_numbers_as_in_its_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of seeds that it is sent, in a process of its own; one of ours gets the run's generators."""
    space = toys.Push.action_space
    monkeypatch.setattr(play.saved_agents, "describe", lambda folder: {})
    monkeypatch.setattr(play.deconfounded, "load", lambda folder: RandomAgent(space))
    ready, agent = play.ready(Path(), toys.Push()), RandomAgent(space)
    ready.reset([np.random.default_rng(3)])
    agent.reset([np.random.default_rng(seed) for seed in guest_host.fresh([np.random.default_rng(3)])])
    obs = np.zeros((4, 2), np.float32)
    np.testing.assert_array_equal(ready.act(obs), agent.act(obs))


@pytest.mark.parametrize(
    ("trained", "noted"), [("push", False), ("elsewhere/toys.py:Push", True), ("curling", True), (None, False)]
)
def test_an_agent_on_another_task_than_it_was_trained_on(
    trained: str | None, noted: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is played, if its spaces fit, but not without a word; a folder may name no task."""
    monkeypatch.setattr(play.saved_agents, "describe", lambda folder: {"task": trained} if trained else {})
    monkeypatch.setattr(play.deconfounded, "load", lambda folder: RandomAgent(toys.Push.action_space))
    play.ready(Path("mine"), toys.Push())
    assert capsys.readouterr().out == f"note: the agent in mine was trained on {trained}\n" * noted


def test_a_certificate_of_more_trials_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the same task; one of fewer trials, or of another version of the task, is replaced."""
    task, file = toys.Push(), tmp_path / "push.json"
    certificate.check_kept(file, task, 64)
    text = sources.digest(sources.of_task(task))
    file.write_text(json.dumps({"task_version": task.version, "text": text, "trials": 256}))
    certificate.check_kept(file, task, 256)
    with pytest.raises(
        envs.InputError, match=r"^--trials was 255, and .*push.json is of 256 trials; give --trials 256 or"
    ):
        certificate.check_kept(file, task, 255)
    file.write_text(json.dumps({"task_version": task.version, "text": "another", "trials": 256}))
    certificate.check_kept(file, task, 64)
    file.write_text("half a")
    certificate.check_kept(file, task, 64)


def test_settings_of_methods_are_of_those_that_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """But `--resume` has to be given what the run was given, though other methods may be left."""
    began: list[Any] = []
    monkeypatch.setattr(run, "run_tasks", lambda *given: began.append(given[2]))
    command = ["run", "--task", "bandit", "--methods", "naive_rnn", "--out", str(tmp_path), "--set"]
    for changes in (["naive_rnn.updates=5"], ["eval_trials=64"], ["dagger.updates=5", "--resume"]):
        monkeypatch.setattr("sys.argv", [*command, *changes])
        run.main()
    assert [{*methods} for methods in began] == [{"naive_rnn", "expert", "random"}] * 3
    monkeypatch.setattr("sys.argv", [*command, "naive_rnn.updates=5", "dagger.updates=5"])
    with pytest.raises(envs.InputError, match=r"^--set had dagger.updates=5, and method dagger does not run; add it"):
        run.main()


def test_pictures_of_a_world_are_refused_by_their_option(monkeypatch: pytest.MonkeyPatch) -> None:
    world = f"{ROOT}/docs/worlds/reversed_cart.py:ReversedCart"
    monkeypatch.setattr("sys.argv", ["play", "--agent", "gone", "--task", world, "--video", "a.mp4"])
    with pytest.raises(envs.InputError, match=r"^--video was given, and .* is a black box, which has no pictures"):
        play.main()


def test_an_agent_of_other_units_or_actions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a folder that states no spaces: `agent.save` and `units.agent(agent).save` write such."""
    units = Units(("x", "velocity"), ("push",), (-100.0,), (100.0,))
    monkeypatch.setattr(play.saved_agents, "describe", lambda folder: {})
    monkeypatch.setattr(play.deconfounded, "load", lambda folder: units.agent(RandomAgent(toys.Push.action_space)))
    with pytest.raises(envs.InputError, match="acts in the units of a log"):
        play.ready(Path("mine"), toys.Push())
    context = Context(envs.get("bandit"), tiny_preset(), [0])
    monkeypatch.setattr(play.deconfounded, "load", lambda folder: fit(context, "blind_bc"))
    with pytest.raises(envs.InputError, match="1 observation and one of 5 actions; push has 2 observations"):
        play.ready(Path("mine"), toys.Push())


def test_what_a_guest_hears_at_a_reset_does_not_tell_the_seed_of_theta() -> None:
    """Environments have one of 2^31 seeds, which a guest could try one by one, were it not for the salt."""
    numbers = [guest_host.fresh([np.random.default_rng([7, 1, 0])], salt)[0] for salt in ("", "a", "b", "a")]
    assert numbers[1] == numbers[3]
    assert len({*numbers}) == 3
    assert numbers[0] == np.random.default_rng([7, 1, 0]).integers(2**63)
    assert all(0 <= number < 2**63 for number in numbers)


def test_an_agent_of_others_may_change_its_arrays() -> None:
    """As it may in a process of its own: what is recorded, and observed next, stays what it was."""

    class Normalising(RandomAgent):
        def act(self, obs: Any) -> Any:
            obs -= 5
            return super().act(obs)

        def observe(self, obs: Any, action: Any, next_obs: Any, alive: Any) -> None:
            seen.append(obs.copy())
            for array in (obs, action, next_obs):
                array += 3
            alive[:] = False

    task, seen = toys.Push(), list[Any]()
    played = []
    for of in (RandomAgent, Normalising):
        env = envs.BatchEnv(task, 6)
        played.append(run_trials(env, guest_host.ReseededAgent(of(task.action_space), "salt"), 2, 0))
    for one, other in zip(vars(played[0].trials).values(), vars(played[1].trials).values(), strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(played[0].returns, played[1].returns)
    obs = played[1].trials.obs
    np.testing.assert_array_equal(seen[0], obs[:, 0, 0])
    np.testing.assert_array_equal(seen[1], obs[:, 0, 1])


def test_the_first_five_seeds_of_a_table_come_first(tmp_path: Path) -> None:
    """Of what a default run makes there are ten."""
    words = ["table", "--tasks", "bandit", "--methods", "naive_rnn", "rma", "--set", "eval_trials=4", "--list"]
    lines = [line.removeprefix("bandit, ") for line in deconf(tmp_path, *words).stdout.splitlines()]
    many = [f"{name}: seeds 0 1 2 3 4 5 6 7 8 9" for name in ("naive_rnn", "expert", "random")]
    assert {*lines} == {*many, "rma: seeds 0 1 2 3 4", "35 seeds are missing or stale"}
