"""What comes in from outside is what it says it is, or one line: nothing is converted, cut or broadcast in silence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from deconfounded import envs
from deconfounded.experts.rollout import Trials

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
    from deconfounded.experts import datasets

    with datasets._root(folder):
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
                spaces.Dict(x=BOX),
                ACTIONS,
                ({"x": np.zeros((4, 2), "f4")}, np.zeros((3, 1), "f4")),
                "Box of one axis or none",
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
                r"must be of Box\(-1, 1, \(A,\)\)",
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
            Trials.from_minari(made)

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
