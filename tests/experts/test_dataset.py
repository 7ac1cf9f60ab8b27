"""Data that travels: Trials to a Minari data set and back."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces

from deconfounded import envs
from deconfounded.benchmarks import data
from deconfounded.benchmarks.engine.context import DEMOS, EXPLORATION, Context, stream
from deconfounded.benchmarks.engine.presets import preset
from deconfounded.deconf.methods import naive_rnn
from deconfounded.deconf.methods.sequence_bc import RecurrentConfig
from deconfounded.experts import datasets, policy
from deconfounded.experts.agent import ExpertAgent, RandomAgent
from deconfounded.experts.rollout import run_trials
from deconfounded.experts.trials import Trials
from tests.tools import tiny_preset

minari = pytest.importorskip("minari")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bandit", "slippery_cartpole", "icy_road"])
def test_the_same_in_another_process(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Seed 0's demonstrations, as a run has them: bit for bit, and what naive_rnn makes of them too."""
    monkeypatch.setattr(type(envs.get(name)), "horizon", 8)
    monkeypatch.setattr(type(envs.get(name)), "episodes", 2)
    context = Context(envs.get(name), tiny_preset(), [0])
    demonstrations = context.demonstrations
    monkeypatch.chdir(tmp_path.parent)
    monkeypatch.setattr("sys.argv", ["data", "--task", name, "--trials", "4", "--out", tmp_path.name])
    data.main()
    assert f"{name}: 4 trials, sha256 {demonstrations.sha256} -> {tmp_path}" in capsys.readouterr().out
    code = f"from deconfounded.experts.trials import Trials; print(Trials.from_minari({str(tmp_path)!r}).sha256)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert done.stdout.strip() == demonstrations.sha256, done.stderr
    trials, theta = datasets.read(tmp_path), datasets.read_theta(tmp_path)
    np.testing.assert_array_equal(theta, context.demonstrated_theta)
    config = RecurrentConfig(updates=2, batch=4)
    expected, again = (naive_rnn.train(given, config, context.rngs) for given in (demonstrations, trials))
    for key, array in expected.state()[1].items():
        np.testing.assert_array_equal(array, again.state()[1][key])
    with pytest.raises(envs.InputError, match="is there already"):
        data.main()


@pytest.mark.parametrize("before", [None, "/somewhere"])
def test_a_user_s_folder_of_minari_stays(before: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Writing sets it for a moment."""
    monkeypatch.delenv("MINARI_DATASETS_PATH", raising=False)
    if before:
        monkeypatch.setenv("MINARI_DATASETS_PATH", before)
    task = envs.get("bandit")
    collected = datasets.collect(task, 2, lambda env: RandomAgent(task.action_space), 0)
    datasets.write(tmp_path, task, "random", collected, "random", (1.0, 2.0))
    assert os.environ.get("MINARI_DATASETS_PATH") == before


def test_episodes_in_any_order(tmp_path: Path) -> None:
    """Theta is of the trial and the episode that the metadata say, as observations are."""
    task = envs.get("slippery_cartpole")
    trials, theta, _ = collected = datasets.collect(task, 2, lambda env: RandomAgent(task.action_space), 5)
    place = datasets.write(tmp_path, task, "random", collected, "random", (1.0, 2.0))
    storage = minari.MinariDataset(place / "data").storage
    turned = [{"trial": 1 - trial} for trial in range(2) for _ in range(task.episodes)]
    storage.update_episode_metadata(turned)
    np.testing.assert_array_equal(datasets.read_theta(place), theta[::-1])
    np.testing.assert_array_equal(datasets.read(place).action, trials.action[::-1])


def test_an_agent_s_random_numbers_are_of_the_episode() -> None:
    """Each has its own, or what an agent tries in one it would try again in the next."""
    task = envs.get("bandit")
    action = run_trials(envs.BatchEnv(task, 4), RandomAgent(task.action_space), 3, 0).trials.action
    assert all((action[:, i] != action[:, j]).any() for i, j in ((0, 1), (0, 2), (1, 2)))


@pytest.mark.parametrize("name", ["curling", "bandit"])
def test_random_actions_are_uniform(name: str) -> None:
    """Each tenth of [-1, 1] as often, or each arm; of 40,000, to five standard errors."""
    space = envs.get(name).action_space
    agent = RandomAgent(space)
    agent.reset(np.random.default_rng(0).spawn(1))
    action, groups = agent.act(np.zeros((40_000, 1), np.float32)), int(getattr(space, "n", 10))
    assert isinstance(space, spaces.Discrete) or np.abs(action).max() <= 1
    index = action if isinstance(space, spaces.Discrete) else np.floor((action + 1) / 2 * groups)
    counts = np.bincount(index[:, 0].astype(int), minlength=groups)
    np.testing.assert_allclose(counts, 40_000 / groups, atol=5 * (40_000 / groups) ** 0.5)


def test_as_many_trials_as_a_run_imitates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Unless another number is asked for."""
    task, asked = envs.get("slippery_cartpole"), list[int]()

    def collect(task: envs.Task, n: int, *_: object) -> None:
        asked.append(n)
        raise envs.InputError("enough")

    monkeypatch.setattr(type(task), "horizon", 4)
    monkeypatch.setattr(datasets, "collect", collect)
    monkeypatch.setattr("sys.argv", ["data", "--task", task.name, "--out", str(tmp_path / "data")])
    with pytest.raises(envs.InputError, match="enough"):
        data.main()
    assert asked == [preset("default", task, "cpu").expert_trials]


def test_what_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Returns, ends, reference scores and trials are Minari's own to read; theta is in the metadata alone."""
    task = envs.get("slippery_cartpole")
    monkeypatch.setattr(type(task), "horizon", 16)  # some episodes end before
    collected = datasets.collect(task, 3, lambda env: RandomAgent(task.action_space), 5)
    returns = run_trials(envs.BatchEnv(task, 3), RandomAgent(task.action_space), task.episodes, 5).returns
    place = datasets.write(tmp_path, task, "random", collected, "random", (1.0, 2.0))
    with pytest.raises(envs.InputError, match="name of the data set was 'my data'; it must be of letters"):
        datasets.write(tmp_path, task, "my data", collected, "random", (1.0, 2.0))
    dataset = minari.MinariDataset(place / "data")
    episodes = list(dataset.iterate_episodes())
    assert [round(float(one.rewards.sum()), 9) for one in episodes] == returns.ravel().round(9).tolist()
    for one in episodes:
        assert one.terminations[-1] or one.truncations[-1]
        assert one.truncations[-1] == (len(one.rewards) == task.horizon)
        assert not np.any([one.terminations[:-1], one.truncations[:-1]])
    assert len({bool(one.truncations[-1]) for one in episodes}) == 2
    assert "EpisodeData" in repr(episodes[0])
    assert (dataset.storage.metadata["ref_min_score"], dataset.storage.metadata["ref_max_score"]) == (1.0, 2.0)
    assert dataset.env_spec.id == task.gym_id
    about = list(dataset.storage.get_episode_metadata(range(15)))
    assert [(int(one["trial"]), int(one["episode"])) for one in about] == [(b, e) for b in range(3) for e in range(5)]
    assert not {"theta", "seed"} & set(vars(Trials.from_minari(place)))
    with pytest.raises(envs.InputError, match="obs 'theta' is no column"):
        datasets.read(place, obs=["theta"])


def test_what_the_command_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reference scores are of random actions and of the expert; explorations have other thetas than demonstrations."""
    env, thetas = envs.BatchEnv(envs.get("bandit"), 64), []
    agents = (RandomAgent(env.task.action_space), ExpertAgent(env, policy.load(env.task)))
    low, high = (run_trials(env, agent, 1, 3).returns.mean() for agent in agents)
    assert low < high
    for kind, option in (("expert", []), ("random", ["--explore"])):
        words = ["data", "--task", "bandit", "--trials", "8", "--seed", "3", "--out", str(tmp_path / kind), *option]
        monkeypatch.setattr("sys.argv", words)
        data.main()
        about = minari.MinariDataset(next((tmp_path / kind).rglob("data"))).storage.metadata
        assert (about["ref_min_score"], about["ref_max_score"]) == (low, high)
        thetas.append(datasets.read_theta(tmp_path / kind))
    assert (thetas[0] != thetas[1]).any()


def test_half_a_data_set_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the metadata of its episodes each of these would be read as a trial of its own."""
    monkeypatch.setattr("sys.argv", ["data", "--task", "bandit", "--trials", "4", "--out", str(tmp_path)])
    with monkeypatch.context() as interrupted:
        interrupted.setattr("minari.dataset._storages.hdf5_storage.HDF5Storage.update_episode_metadata", None)
        with pytest.raises(TypeError):
            data.main()
    assert not list(tmp_path.iterdir())
    data.main()
    assert [file.name for file in tmp_path.iterdir()] == ["deconf"]
    assert len(Trials.from_minari(tmp_path)) == 4


def test_bad_input_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(envs.InputError, match="holds 0 Minari data sets"):
        Trials.from_minari(tmp_path)
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "metadata.json").write_text(json.dumps({"data_format": "hdf5"}))
    with pytest.raises(envs.InputError, match="cannot be read") as caught:
        Trials.from_minari(tmp_path)
    assert "\n" not in str(caught.value)


def test_the_standard_sets_are_the_same() -> None:
    """Of the bandit, which a second makes; on MuJoCo the last bits are the machine's kind's."""
    kept = json.loads((Path(__file__).parents[2] / "docs" / "data.json").read_text())
    lacking = {f"{name}-v{envs.get(name).version}" for name in envs.SUITE} ^ set(kept)
    printed = "the sha256 that `deconf data --task NAME --out DIR` and `--explore` print"
    assert not lacking, f"docs/data.json and the suite differ in {lacking}; put there {printed}"
    for kind, purpose in (("expert", DEMOS), ("random", EXPLORATION)):
        env = envs.BatchEnv(envs.get("bandit"), 256)
        expert = ExpertAgent(env, policy.load(env.task))
        agent = expert if kind == "expert" else RandomAgent(env.task.action_space)
        assert run_trials(env, agent, 1, stream(purpose, 0)).trials.sha256 == kept["bandit-v0"][kind]
