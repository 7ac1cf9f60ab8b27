"""What comes in from outside is what it says it is, or one line: nothing is converted, cut or broadcast in silence."""

import json
import os
import pickle
import queue
import re
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import torch
from gymnasium import spaces
from safetensors.numpy import save_file
from safetensors.torch import save_file as torch_save

from deconfounded import envs
from deconfounded.benchmarks import check, data
from deconfounded.benchmarks.console import run_command
from deconfounded.benchmarks.engine import progress
from deconfounded.benchmarks.engine.scheduler import run_job
from deconfounded.deconf import methods
from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.data import Draws
from deconfounded.deconf.core.layers import Linear
from deconfounded.deconf.methods import dadp, deconfounded, deconfounded_mean, memoryless_bc, naive_rnn
from deconfounded.deconf.methods.dadp import DadpConfig
from deconfounded.deconf.methods.deconfounded import DeconfoundedConfig
from deconfounded.deconf.methods.deconfounded_mean import MeanConfig
from deconfounded.deconf.methods.memoryless_bc import MemorylessConfig
from deconfounded.deconf.methods.sequence_bc import RecurrentConfig
from deconfounded.envs.streams import Array
from deconfounded.envs.tasks.slippery_cartpole import SlipperyCartpole
from deconfounded.experts import arrays, datasets, policy
from deconfounded.experts.agent import Agent, RandomAgent
from deconfounded.experts.rollout import run_trials
from deconfounded.experts.trials import Trials, joined
from tests.toys import Push

OBS, ACTION = np.zeros((2, 1, 4, 3)), np.zeros((2, 1, 3, 1))
MASK = np.ones((2, 1, 3), bool)
BOX, ACTIONS = spaces.Box(-9.0, 9.0, (2,), np.float32), spaces.Box(-1.0, 1.0, (1,), np.float32)


def data_set(folder: Path, observation: Any, action: Any, values: Any, about: Any = None) -> Path:
    """A Minari data set of two trials of two episodes of three steps; values: the observations and actions of each."""
    minari = pytest.importorskip("minari")
    from minari.data_collector import EpisodeBuffer

    ends, buffers = np.arange(3) == 2, []
    for i in range(4):
        seen, done = values(i)
        buffers.append(
            EpisodeBuffer(
                id=i,
                observations=seen,
                actions=done,
                rewards=[0.0] * 3,
                terminations=ends.tolist(),
                truncations=[False] * 3,
                infos={},
            )
        )
    with patch.dict(os.environ, MINARI_DATASETS_PATH=str(folder)):
        made = minari.create_dataset_from_buffers(
            "outside/of-us-v0", buffers, observation_space=observation, action_space=action, data_format="hdf5"
        )
    about = about or [{"trial": i // 2, "episode": i % 2} for i in range(4)]
    made.storage.update_episode_metadata(about)
    return folder


@pytest.mark.filterwarnings("ignore::UserWarning")
class TestDataSets:
    def test_a_number_is_a_column(self, tmp_path: Path) -> None:
        """Every step has its own observation, and not the whole episode's, though the lengths would let it."""
        seen = np.linspace(-1, 1, 16, dtype=np.float32).reshape(4, 4)
        space = spaces.Box(-1.0, 1.0, (), np.float32)
        made = data_set(tmp_path, space, ACTIONS, lambda i: (seen[i], np.full((3, 1), 0.1 * i, np.float32)))
        trials = Trials.from_minari(made)
        np.testing.assert_array_equal(trials.obs, seen.reshape(2, 2, 4, 1))
        np.testing.assert_array_equal(trials.action[1, 0, :, 0], np.full(3, 0.2, np.float32))

    def test_a_discrete_observation_is_one_hot(self, tmp_path: Path) -> None:
        seen = np.arange(16).reshape(4, 4) % 3
        made = data_set(tmp_path, spaces.Discrete(3), spaces.Discrete(2), lambda i: (seen[i], np.array([0, 1, 1])))
        trials = Trials.from_minari(made)
        np.testing.assert_array_equal(trials.obs, np.eye(3)[seen].reshape(2, 2, 4, 3))
        np.testing.assert_array_equal(trials.action[0, 0, :, 0], (0, 1, 1))
        assert trials.actions == 2

    @pytest.mark.parametrize(
        ("observation", "action", "values", "says"),
        [
            (
                spaces.Dict(x=spaces.Box(0, 255, (4, 4, 3), np.uint8)),
                ACTIONS,
                ({"x": np.zeros((4, 4, 4, 3), np.uint8)}, np.zeros((3, 1), "f4")),
                "one must be of Box of one axis or none",
            ),
            (
                spaces.Tuple([BOX, BOX]),
                ACTIONS,
                ((np.zeros((4, 2), "f4"), np.zeros((4, 2), "f4")), np.zeros((3, 1), "f4")),
                "Box of one axis",
            ),
            (
                spaces.Box(0, 255, (4, 4, 3), np.uint8),
                ACTIONS,
                (np.zeros((4, 4, 4, 3), np.uint8), np.zeros((3, 1), "f4")),
                "of one axis",
            ),
            (spaces.MultiDiscrete([3, 3]), ACTIONS, (np.zeros((4, 2), int), np.zeros((3, 1), "f4")), "MultiDiscrete"),
            (spaces.MultiBinary(3), ACTIONS, (np.zeros((4, 3), np.int8), np.zeros((3, 1), "f4")), "MultiBinary"),
            (
                spaces.Discrete(3, start=-1),
                ACTIONS,
                (np.zeros(4, int), np.zeros((3, 1), "f4")),
                "Discrete from 0 up",
            ),
            (BOX, spaces.Discrete(3, start=-1), (np.zeros((4, 2), "f4"), np.zeros(3, int)), "Discrete from 0 up"),
            (
                BOX,
                spaces.Box(-1.0, 1.0, (), np.float32),
                (np.zeros((4, 2), "f4"), np.zeros(3, "f4")),
                r"must be of Box of one axis, or",
            ),
            (BOX, spaces.MultiDiscrete([3, 3]), (np.zeros((4, 2), "f4"), np.zeros((3, 2), int)), "actions of episode"),
            (BOX, ACTIONS, (np.zeros((3, 2), "f4"), np.zeros((3, 1), "f4")), r"shape \(3, 2\); it must be \(4, 2\)"),
        ],
    )
    def test_what_is_no_row_a_step(self, tmp_path: Path, observation: Any, action: Any, values: Any, says: str) -> None:
        made = data_set(tmp_path, observation, action, lambda _: values)
        with pytest.raises(envs.InputError, match=says) as caught:
            Trials.from_minari(made)
        assert "\n" not in str(caught.value)

    @pytest.mark.parametrize(
        ("about", "says"),
        [
            ([{"trial": 0.5 * i, "episode": 0} for i in range(4)], "cannot be read"),
            ([{"trial": i // 2, "episode": i % 2, "theta": [0.1] * (1 + i)} for i in range(4)], "several shapes"),
            ([{"trial": i // 2 - 1, "episode": i % 2} for i in range(4)], "every trial of 1"),
        ],
    )
    def test_what_episodes_say_of_themselves(self, tmp_path: Path, about: Any, says: str) -> None:
        values = np.zeros((4, 2), "f4"), np.zeros((3, 1), "f4")
        made = data_set(tmp_path, BOX, ACTIONS, lambda _: values, about)
        with pytest.raises(envs.InputError, match=says):
            (Trials.from_minari if "theta" not in about[0] else datasets.read_theta)(made)

    def test_no_folder(self) -> None:
        with pytest.raises(envs.InputError, match="a data set was None; it must be the path"):
            Trials.from_minari(None)  # type: ignore[arg-type]


class TestTrials:
    @pytest.mark.parametrize(
        ("change", "says"),
        [
            ({"obs": OBS + 0j}, "obs of Trials was of complex128; it must be an array of real numbers"),
            ({"obs": OBS.astype("datetime64[s]")}, "obs of Trials was of datetime64"),
            ({"obs": OBS.astype(str)}, "obs of Trials was of <U"),
            ({"obs": np.ma.masked_array(OBS, OBS == 0)}, "obs of Trials was a masked array"),
            ({"obs": OBS.astype(object)}, "obs of Trials was of object"),
            ({"obs": np.where(np.arange(3) == 1, np.finfo("f4").max, OBS)}, "an observation of 3.40282e.38; they must"),
            ({"obs": np.where(np.arange(3) == 1, -1e300, OBS)}, "an observation of 1e.300; they must"),
            ({"obs": OBS[..., :0]}, r"obs \(2, 1, 4, 0\)"),
            ({"mask": MASK.astype(str)}, "mask of Trials was of <U5"),
            ({"mask": np.where(MASK, np.nan, 0)}, "mask of Trials held numbers other than 0 and 1"),
            ({"mask": MASK * 2}, "mask of Trials held numbers other than 0 and 1"),
            ({"action": ACTION + 1.0000001}, "an action of size 1.00000012; actions must be in"),
            ({"action": (ACTION - 128).astype(np.int8)}, "an action of size 128;"),
            ({"action": ACTION + 1e300}, "NaN or infinity"),
            ({"actions": True}, "actions of Trials was True"),
        ],
    )
    def test_no_silent_conversion(self, change: dict[str, Any], says: str) -> None:
        with pytest.raises(envs.InputError, match=says):
            Trials(**({"obs": OBS, "action": ACTION, "mask": MASK, "actions": 0} | change))

    @pytest.mark.parametrize(("offset", "step"), [(4.2e6, 1.0), (1.7e9, 1.0), (1.7e9, 0.01)])
    def test_offsets_that_float32_loses(self, offset: float, step: float) -> None:
        """What varies about an offset, a clock in Unix time: refused, and kept once the offset is taken off."""
        noise = np.random.default_rng(0).normal(size=(8, 2, 51, 3))
        noise[..., 1] = step * np.arange(51)
        moved = noise.copy()
        moved[..., 1 if offset > 1e9 else 2] += offset
        action, mask = np.zeros((8, 2, 50, 1)), np.ones((8, 2, 50), bool)
        with pytest.raises(envs.InputError, match=r"float32 rounds it by up to .*; subtract its mean"):
            Trials(moved, action, mask)
        np.testing.assert_allclose(Trials(noise, action, mask).obs, noise, rtol=1e-6)

    def test_the_least_integer_is_large(self) -> None:
        """It has no negative in its type."""
        for kind in (np.int8, np.int64):
            assert arrays.size(np.array([np.iinfo(kind).min, 5], kind)) == -float(np.iinfo(kind).min)

    def test_whole_numbers_that_float32_loses(self) -> None:
        """Unix times, whose steps are all alike in float32."""
        times = (1_700_000_000 + np.arange(51)).reshape(1, 1, 51, 1)
        with pytest.raises(envs.InputError, match=r"float32 rounds it by up to .*; subtract its mean"):
            Trials(times, np.zeros((1, 1, 50, 1)), np.ones((1, 1, 50), bool))

    def test_what_float32_holds_well_enough(self) -> None:
        """Constants that it rounds, and columns that hardly vary."""
        obs = np.full((2, 1, 4, 3), 0.1)
        obs[..., 1] += 1e-7 * np.arange(4)
        obs[..., 2] = 1e6 + 3 * np.arange(4)
        np.testing.assert_array_equal(Trials(obs, ACTION, MASK).obs, obs.astype(np.float32))

    def test_padding_is_never_read(self) -> None:
        """NaN, infinity or 1e30 where no step took place: the same trials, to the bit. Steps beside it are kept."""
        rng = np.random.default_rng(0)
        obs, action = rng.normal(size=(2, 1, 6, 3)), rng.uniform(-1, 1, (2, 1, 5, 1))
        mask = np.array([[[1, 1, 1, 0, 0]], [[0, 1, 0, 0, 1]]], bool)
        trials = Trials(obs, action, mask)
        for value in (np.nan, np.inf, 1e30, -3.0):
            filled, acted = obs.copy(), np.where(mask[..., None], action, value)
            filled[0, 0, 4:] = filled[1, 0, 0] = filled[1, 0, 3] = value
            again = Trials(filled, acted, mask)
            assert again.sha256 == trials.sha256
        np.testing.assert_array_equal(trials.obs[0, 0, :4], obs[0, 0, :4].astype("f4"))
        np.testing.assert_array_equal(trials.obs[0, 0, 4:], np.tile(obs[0, 0, 3].astype("f4"), (2, 1)))
        np.testing.assert_array_equal(trials.obs[1, 0, [1, 2, 4, 5]], obs[1, 0, [1, 2, 4, 5]].astype("f4"))
        np.testing.assert_array_equal(trials.action[..., 0], np.where(mask, action[..., 0], 0).astype("f4"))

    def test_arrays_are_copies(self) -> None:
        """What is done to the arrays that were given does not change the trials, also where no type is converted."""
        obs, action, mask = OBS.astype("f4"), ACTION.astype("f4"), MASK.copy()
        trials = Trials(obs, action, mask)
        before = trials.sha256
        obs[:], action[:], mask[:] = 1, 1, False
        assert trials.sha256 == before


class Rude(SlipperyCartpole):
    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        raise SystemExit


class RudeLater(SlipperyCartpole):
    """Once the check is over."""

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        if len(state) > 16:
            sys.exit(0)
        return super().reward(state, action, next_state, theta)


class TestTasks:
    @pytest.mark.parametrize(
        ("name", "value", "says"),
        [
            ("episodes", 0, "episodes of slippery_cartpole was 0; it must be a whole number, an int, from 1 up"),
            ("episodes", -3, "episodes of slippery_cartpole was -3"),
            ("episodes", 2.5, "episodes of slippery_cartpole was 2.5"),
            ("horizon", True, "horizon of slippery_cartpole was True"),
            ("substeps", 0, "substeps of slippery_cartpole was 0"),
            ("version", "one", "version of slippery_cartpole was 'one'; it must be a whole number, an int, from 0 up"),
            ("tier", "x", "tier of slippery_cartpole was 'x'; it must be 1, 2, 3 or None"),
            ("tier", True, "tier of slippery_cartpole was True"),
        ],
    )
    def test_numbers_that_a_task_states(self, name: str, value: Any, says: str) -> None:
        with pytest.raises(envs.InputError, match=f"^{says}"):
            envs.check_task(type("Odd", (SlipperyCartpole,), {name: value})())

    @pytest.mark.parametrize(
        ("given", "says"),
        [
            (("x", "", "a", 1), "low of latent x was 'a'; it must be a number"),
            (("x", "", 0, None), "high of latent x was None"),
            (("x", "", False, 1), "low of latent x was False"),
            (("x", "", 0, 1, "uniform", "slow"), "drift of latent x was 'slow'"),
            ((None, "", 0, 1), "name and unit of a latent were None and ''; they must be texts"),
            (("x", None, 0, 1), "name and unit of a latent were 'x' and None"),
        ],
    )
    def test_latents(self, given: Any, says: str) -> None:
        with pytest.raises(envs.InputError, match=says):
            envs.Latent(*given)

    def test_a_task_is_made_without_arguments(self) -> None:
        class Sized(SlipperyCartpole):
            name = "sized"

            def __init__(self, size: int) -> None:
                self.size = size

        with pytest.raises(
            envs.InputError, match=r"task sized of .*test_doors.*missing 1 required .*; Sized\(\) must do"
        ):
            envs.register(Sized)

    def test_two_tasks_of_one_gymnasium_id(self) -> None:
        """It leaves underscores out."""
        envs.register(type("Slope", (Push,), {"name": "slope_3"}))
        with pytest.raises(envs.InputError, match=r"'slope3' of .* would be deconf/Slope3-v0, as slope_3 is; give it"):
            envs.register(type("Slope", (Push,), {"name": "slope3"}))
        assert "slope3" not in envs.names()

    def test_seeds_of_one(self) -> None:
        """A list of one, as a batch takes."""
        env, resets = envs.make("bandit"), []
        for seed in (3, [3], np.array([3]), [None]):
            resets.append(env.reset(seed=seed)[0])  # type: ignore[arg-type]
            assert env.np_random_seed == 3 or seed == [None]
        for other in resets[1:3]:
            np.testing.assert_array_equal(other, resets[0])

    def test_a_first_reset_of_no_environment(self) -> None:
        with pytest.raises(envs.InputError, match="`where` without any environment before the first reset"):
            envs.BatchEnv(envs.get("bandit"), 2).reset(0, where=np.zeros(2, bool))

    @pytest.mark.parametrize("options", [{1: 1, "b": 2}, {None: 1}, {("a", 1): 1, 2: 2}])
    def test_reset_options(self, options: Any) -> None:
        with pytest.raises(envs.InputError, match=r"^reset option .* is unknown; there are keep_theta and theta"):
            envs.make("bandit").reset(options=options)

    @pytest.mark.parametrize("arm", [0.5, 3.999])
    def test_a_category_is_a_whole_number(self, arm: float) -> None:
        """Also between those that there are."""
        with pytest.raises(
            envs.InputError, match=f"^best_arm of bandit was {arm}; it must be a whole number from 0 to 4"
        ):
            envs.make("bandit").reset(options={"theta": [arm]})

    def test_a_reward_that_ends_the_command(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
        """In silence, and as if all were well: in a check, in a command, and in a worker process of one."""
        with pytest.raises(envs.InputError, match=r"reward of slippery_cartpole: .*SystemExit, test_doors.py:\d+"):
            envs.check_task(Rude())
        monkeypatch.setitem(envs.TASKS, "slippery_cartpole", RudeLater)
        args = ["data", "--task", "slippery_cartpole", "--trials", "32", "--out", str(tmp_path)]
        monkeypatch.setattr("sys.argv", args)
        pytest.importorskip("minari")
        with pytest.raises(SystemExit) as ended:
            run_command(data.main)
        assert ended.value.code == 2
        assert re.fullmatch(r"error: .*SystemExit, test_doors.py:\d+\)\n", capsys.readouterr().err)

        class Ending:
            ticks = 0

            def run(self) -> str:
                raise SystemExit(0)

        monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
        with pytest.raises(envs.InputError, match=r"ended by 0 \(SystemExit, test_doors.py"):
            run_job(Ending())  # type: ignore[arg-type]

    def test_a_job_that_memory_is_too_small_for(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """It fails, and the others go on; any other error of a method of ours is one of the program."""
        monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)

        class Large:
            ticks = 0

            def __init__(self, error: Exception) -> None:
                self.error = error

            def run(self) -> str:
                raise self.error

        torch_says = RuntimeError("DefaultCPUAllocator: can't allocate memory: ...")
        for error in (MemoryError(), torch_says, RuntimeError("CUDA out of memory. Tried to allocate 2 GiB")):
            with pytest.raises(envs.InputError, match=r"memory was exhausted: .*Error.*test_doors.py"):
                run_job(Large(error))  # type: ignore[arg-type]
        with pytest.raises(RuntimeError, match="shapes"):
            run_job(Large(RuntimeError("shapes do not fit")))  # type: ignore[arg-type]

    def test_commands_may_end(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """As they do after --help, and where something failed."""
        monkeypatch.setattr(check, "CONTRACT", {"broken": lambda task: 1 / 0})
        for args, code in ((["--help"], 0), (["--task", "bandit"], 1)):
            monkeypatch.setattr("sys.argv", ["check", *args])
            with pytest.raises(SystemExit) as ended:
                run_command(check.main)
            assert ended.value.code == code

    def test_one_line_of_many_values(self) -> None:
        """Arrays print in several lines, from six values on."""
        theta = np.arange(40.0).reshape(20, 2) / 3
        with pytest.raises(envs.InputError, match="theta of bandit was array") as caught:
            envs.make_vec("bandit", 4).reset(options={"theta": theta})
        assert "\n" not in str(caught.value)
        assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)

    def test_expert_weights_of_integers(self, tmp_path: Path) -> None:
        task = envs.get("slippery_cartpole")
        width = len(task.observation) + task.theta_width
        weights = {"0.weight": np.ones((1, width), np.int64), "0.bias": np.ones(1, np.float32)}
        save_file(weights, tmp_path / "x.safetensors")
        with pytest.raises(envs.InputError, match="is of int64 and float32, not of float32"):
            policy.load(task, tmp_path / "x.safetensors")

    @pytest.mark.parametrize(("version", "stated"), [(3, 3), ("3", 0), (None, 0), ([3], 0)])
    def test_version_of_given_weights(self, version: Any, stated: int, tmp_path: Path) -> None:
        """That of the card beside them, if it is a number; not that of the task's own."""
        task, file = envs.get("slippery_cartpole"), tmp_path / "x.safetensors"
        file.with_suffix(".json").write_text(json.dumps({"version": version}))
        assert policy.version(task, file) == stated
        assert policy.version(task) == json.loads(policy.path(task).with_suffix(".json").read_bytes())["version"]

    def test_rows_that_are_drawn_need_not_be_normalised(self) -> None:
        """Each index as often as its share of its own row."""
        probs = np.repeat([[1.0, 3.0, 0.0], [0.1, 0.1, 0.2]], 20_000, 0)
        drawn = policy.sample_rows(probs, np.random.default_rng(0)).reshape(2, -1)
        shares = [np.bincount(row, minlength=3) / len(row) for row in drawn]
        np.testing.assert_allclose(shares, [[0.25, 0.75, 0], [0.25, 0.25, 0.5]], atol=0.015)

    @pytest.mark.parametrize(
        ("change", "says"),
        [
            ({"1.weight": np.ones((1, 3), np.float32)}, "layer 1 of .* takes 3 inputs, not 4"),
            ({"1.weight": np.full((1, 4), np.inf, np.float32)}, "layer 1 of .* holds NaN or infinity"),
            ({"1.bias": np.full(1, np.nan, np.float32)}, "layer 1 of .* holds NaN or infinity"),
            ({"0.bias": np.full(4, np.nan, np.float32)}, "layer 0 of .* holds NaN or infinity"),
            ({"1.bias": np.ones(2, np.float32)}, "lack a whole layer 1"),
            ({"log_std": np.ones(1, np.float32)}, "lack a whole layer 2"),
        ],
    )
    def test_expert_weights_of_each_layer(self, change: dict[str, Any], says: str, tmp_path: Path) -> None:
        task = envs.get("slippery_cartpole")
        shapes = {
            "0.weight": (4, len(task.observation) + task.theta_width),
            "0.bias": 4,
            "1.weight": (1, 4),
            "1.bias": 1,
        }
        weights = {name: np.ones(shape, np.float32) for name, shape in shapes.items()}
        save_file(weights, tmp_path / "x.safetensors")
        policy.load(task, tmp_path / "x.safetensors")
        save_file(weights | change, tmp_path / "x.safetensors")
        with pytest.raises(envs.InputError, match=says):
            policy.load(task, tmp_path / "x.safetensors")

    def test_expert_weights_that_numpy_has_no_type_for(self, tmp_path: Path) -> None:
        torch_save({"0.weight": torch.zeros((1, 6), dtype=torch.bfloat16)}, tmp_path / "x.safetensors")
        with pytest.raises(envs.InputError, match=r"x\.safetensors are damaged \(.*bfloat16"):
            policy.load(envs.get("slippery_cartpole"), tmp_path / "x.safetensors")


class TestRunTrials:
    @pytest.mark.parametrize(
        ("episodes", "seed", "says"),
        [
            (0, 0, "the number of episodes was 0"),
            (-1, 0, "the number of episodes was -1"),
            (1.5, 0, "the number of episodes was 1.5"),
            (1, [], r"seed was \[\]; it must be"),
            (1, np.zeros(0, int), r"seed was array"),
            (1, "12", "seed was '12'"),
            (1, [0, 1.5], r"seed was \[0, 1.5\]"),
            (1, None, "seed was None"),
            (1, -1, "seed was -1"),
        ],
    )
    def test_no_episodes_or_seeds(self, episodes: Any, seed: Any, says: str) -> None:
        env = envs.BatchEnv(envs.get("bandit"), 2)
        with pytest.raises(envs.InputError, match=says):
            run_trials(env, RandomAgent(env.task.action_space), episodes, seed)

    def test_a_seed_may_be_an_array(self) -> None:
        """Of one number, or of one for each group."""
        env, agent = envs.BatchEnv(envs.get("bandit"), 2), RandomAgent(spaces.Discrete(5))
        for number, array in ((3, np.array(3)), ([3, 5], np.array([3, 5]))):
            runs = [run_trials(env, agent, 1, seed).trials.sha256 for seed in (number, array)]
            assert runs[0] == runs[1]

    def test_environments_that_show_theta(self) -> None:
        env = envs.BatchEnv(envs.get("bandit"), 2, privileged=True)
        with pytest.raises(envs.InputError, match="run_trials was given privileged environments; agents act on"):
            run_trials(env, RandomAgent(env.task.action_space), 1, 0)

    def test_trials_of_other_actions_do_not_join(self) -> None:
        obs, action, mask = np.zeros((1, 1, 3, 1)), np.zeros((1, 1, 2, 1)), np.ones((1, 1, 2), bool)
        parts = [Trials(obs, action, mask, actions) for actions in (5, 0)]
        with pytest.raises(envs.InputError, match=r"had 0 and 5 discrete actions \(0: continuous\); all must have as"):
            joined(parts)
        assert len(joined([parts[0]] * 2)) == 2

    def test_actions_out_of_range(self) -> None:
        """They are clipped, as environments do, in trials and in what the agent observes."""

        class Wild(Agent):
            def act(self, obs: Any) -> Any:
                return np.full((len(obs), 1), 1.5)

            def observe(self, obs: Any, action: Any, next_obs: Any, alive: Any) -> None:
                assert (action == 1).all()

        trials = run_trials(envs.BatchEnv(envs.get("tilted_cartpole"), 2), Wild(), 1, 0).trials
        assert (trials.action[trials.mask] == 1).all()

    def test_an_agent_observes_the_steps_that_take_place(self) -> None:
        """An episode's last step too, and none after it, as the mask of the trials has it."""
        observed = list[Any]()

        class Noting(RandomAgent):
            def observe(self, obs: Any, action: Any, next_obs: Any, alive: Any) -> None:
                observed.append(alive.copy())

        trials = run_trials(envs.BatchEnv(Push(), 8), Noting(Push.action_space), 1, 0).trials
        assert not trials.mask.all()
        np.testing.assert_array_equal(np.stack(observed, 1), trials.mask[:, 0, : len(observed)])

    def test_random_actions_are_uniform(self) -> None:
        """In their range, to either end, or over all actions."""
        acted = []
        for space in (spaces.Discrete(3), Push.action_space):
            agent = RandomAgent(space)
            agent.reset([np.random.default_rng(0)])
            acted.append(agent.act(np.zeros((6000, 1), np.float32))[:, 0])
        assert np.bincount(acted[0].astype(int)) / 6000 == pytest.approx([1 / 3] * 3, abs=0.02)
        assert np.histogram(acted[1], 4, (-1, 1))[0] / 6000 == pytest.approx([1 / 4] * 4, abs=0.02)

    def test_random_numbers_of_an_agent_are_new_in_each_episode(self) -> None:
        """And of each seed its own, but they do not say which seed that is: thetas are drawn by it, too."""
        drawn, sequences = list[float](), list[np.random.SeedSequence]()

        class Drawing(Agent):
            def reset(self, rngs: Any) -> None:
                drawn.extend(rng.random() for rng in rngs)
                sequences.extend(rng.bit_generator.seed_seq for rng in rngs)

            def act(self, obs: Any) -> Any:
                return np.zeros((len(obs), 1))

        run_trials(envs.BatchEnv(envs.get("bandit"), 2), Drawing(), 3, [0, 5])
        assert len(set(drawn)) == len(drawn) == 6
        assert len({repr(each.entropy) for each in sequences}) == 1


class TestTraining:
    @pytest.mark.parametrize(
        ("change", "says"),
        [
            ({"chunk": 0}, "chunk of RecurrentConfig was 0; it must be int, from 1 up"),
            ({"width": 1.5}, "width of RecurrentConfig was 1.5"),
            ({"updates": -1}, "updates of RecurrentConfig was -1; it must be int, from 0 up"),
            ({"learning_rate": float("nan")}, "learning_rate of RecurrentConfig was nan; it must be float, from 0 up"),
            ({"cooled": 1}, "cooled of RecurrentConfig was 1; it must be bool"),
            ({"batch": True}, "batch of RecurrentConfig was True"),
        ],
    )
    def test_amounts(self, change: dict[str, Any], says: str) -> None:
        with pytest.raises(envs.InputError, match=says):
            RecurrentConfig(**change)

    def test_amounts_of_every_method(self) -> None:
        """Each configuration is held to its types; None and names where they are allowed."""
        for name in methods.METHODS:
            config = methods.load(name).method.on_control  # type: ignore[attr-defined]
            for part in () if config is None else asdict(config):
                with pytest.raises(envs.InputError, match=f"^{part} of {type(config).__name__} was "):
                    replace(config, **{part: b"x"})
        DeconfoundedConfig(model="gru", inference_batch=None, beta=0)
        with pytest.raises(envs.InputError, match="model of DeconfoundedConfig was 'tree'; it must be 'linear' or"):
            DeconfoundedConfig(model="tree")  # type: ignore[arg-type]

    @pytest.mark.parametrize("drifts", [True, False])
    def test_no_trials(self, drifts: bool) -> None:
        """Of exploration that returns nothing, and of a source of demonstrations."""
        trials, config = Trials(OBS, ACTION, MASK), DeconfoundedConfig(drifts=drifts)
        rng = np.random.default_rng(0)
        for call in (
            lambda: deconfounded.train(trials, lambda agent: None, config, rng),  # type: ignore[arg-type,return-value]
            lambda: deconfounded_mean.train(trials, lambda agent: None, MeanConfig(), rng),  # type: ignore[arg-type,return-value]
            lambda: naive_rnn.train(lambda: None, RecurrentConfig(), rng),  # type: ignore[arg-type,return-value]
            lambda: memoryless_bc.train(None, MemorylessConfig(), rng),  # type: ignore[arg-type]
            lambda: dadp.train(None, DadpConfig(), rng),  # type: ignore[arg-type]
        ):
            with pytest.raises(envs.InputError, match=r"(None|a NoneType); (it|they) must be Trials"):
                call()

    def test_no_generators(self) -> None:
        with pytest.raises(envs.InputError, match=r"random numbers were to come from \[\]; give np.random.default_rng"):
            memoryless_bc.train(Trials(OBS, ACTION, MASK), MemorylessConfig(), [])

    def test_a_loss_that_is_not_finite(self) -> None:
        """Training ends there, in a line that names the loss and the update: no agent of NaN comes of it."""
        rng = np.random.default_rng(0)
        trials = Trials(rng.normal(size=(2, 1, 4, 3)), rng.uniform(-1, 1, (2, 1, 3, 1)), MASK)
        config = MemorylessConfig(updates=20, batch=4, learning_rate=1e30)
        with pytest.raises(envs.InputError, match=r"the loss of ActionHead failed in update [2-5]: it was (nan|inf)"):
            memoryless_bc.train(trials, config, [np.random.default_rng(0), np.random.default_rng(1)])

    def test_a_gradient_that_is_not_a_number(self) -> None:
        """Of a finite loss: the root of 0 has none."""
        layer = Linear(2, 1, Draws([np.random.default_rng(0)], "cpu"))
        optimizer = Adam([layer], 1e-3)
        optimizer.step(layer(torch.ones(1, 3, 2)).mean((1, 2)))
        with pytest.raises(envs.InputError, match="the loss of Linear failed in update 2: its gradient was NaN"):
            optimizer.step((0 * layer(torch.ones(1, 3, 2))).square().sum((1, 2)).sqrt())

    def test_a_gradient_without_a_norm(self) -> None:
        """Its squares are infinite: the update would be none."""
        layer = Linear(2, 1, Draws([np.random.default_rng(0)], "cpu"))
        before = layer.weight.detach().clone()
        with pytest.raises(envs.InputError, match="failed in update 1: its gradient was NaN or too large"):
            Adam([layer], 1e-3).step((layer.weight - layer.weight.detach()).sum((1, 2)) * 1e25)
        assert torch.equal(layer.weight, before)
