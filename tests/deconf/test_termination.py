"""Episodes that terminate early do so in the learned environment too."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from deconfounded.deconf.core import termination
from deconfounded.deconf.core.data import Batch, Draws
from deconfounded.deconf.core.nets import Scaler
from deconfounded.deconf.diagnosis.learned_env import LearnedEnv
from deconfounded.experts.trials import Trials


def observed(trials: Trials) -> Scaler:
    """The scaler of observations."""
    batch = Batch.of(trials, 1)
    return Scaler(batch.obs, batch.mask)


def walks(n: int = 200, steps: int = 20, limit: float = 2.0) -> Trials:
    """Random walks [n, 1, steps, 1] that terminate beyond the limit."""
    obs = np.random.default_rng(0).normal(size=(n, 1, steps + 1, 1)).cumsum(2).astype(np.float32)
    beyond = np.abs(obs[..., 0]) > limit
    mask = ~(np.maximum.accumulate(beyond, -1)[..., :-1])
    mask[..., 0] = True
    return Trials(obs, np.zeros((n, 1, steps, 1)), mask)


@pytest.mark.slow
def test_the_limit_is_learned() -> None:
    """Termination beyond the limit and not within: right for 95% of observations .3 or more from it.

    It is learned from all logs, of which one is of walks that go on.
    """
    trials = walks()
    draws = Draws([np.random.default_rng(0)], "cpu")
    model = termination.fit([walks(2, limit=1e9), trials], observed(trials), draws)
    assert model is not None
    obs = torch.linspace(-4, 4, 401)[None, :, None]
    predicted = (model.logit(obs) > 0)[0]
    clear = (obs.abs() - 2).abs()[0, :, 0] > 0.3
    right = predicted == (obs.abs() > 2)[0, :, 0]
    assert right[clear].float().mean() > 0.95


def test_a_horizon_is_no_termination() -> None:
    trials = walks(limit=1e9)
    assert termination.fit([trials], observed(trials), Draws([np.random.default_rng(0)], "cpu")) is None


def test_labels() -> None:
    """Of an episode of three steps of four the last is a termination; of one of four none is."""
    obs = np.arange(10.0).reshape(2, 1, 5, 1)
    mask = np.array([[[1, 1, 1, 0]], [[1, 1, 1, 1]]], bool)
    next_obs, terminated = termination.labelled(Trials(obs, np.zeros((2, 1, 4, 1)), mask))
    assert next_obs[:, 0].tolist() == [1, 2, 3, 6, 7, 8, 9]
    assert terminated.tolist() == pytest.approx([0, 0, 1, 0, 0, 0, 0])


class Walker:
    """Reference and actor: both take a step of 1."""

    theta_hat = torch.zeros(1, 3, 1)
    policy = SimpleNamespace(signature=SimpleNamespace(actions=0))

    def begin(self, n: int, rngs: Any) -> None:
        self.steps, self.farthest = 0.0, 0.0

    def choose(self, obs: torch.Tensor) -> torch.Tensor:
        return torch.ones_like(obs)

    def remember(self, step: Batch) -> None:
        self.steps += float(step.mask.sum()) / 3
        self.farthest = max(self.farthest, float(step.next_obs.max()))

    def next_obs(self, obs: torch.Tensor, action: torch.Tensor, draws: Draws) -> torch.Tensor:
        return obs + action

    def point(self, obs: torch.Tensor, latent: torch.Tensor) -> torch.Tensor:
        return torch.ones_like(obs)


class Astray(Walker):
    """A reference that would take a step of 2."""

    def point(self, obs: torch.Tensor, latent: torch.Tensor) -> torch.Tensor:
        return torch.full_like(obs, 2)


def trial(*obs: float) -> Batch:
    """A trial of one episode with these observations."""
    steps = len(obs) - 1
    return Batch.of(Trials(np.reshape(obs, (1, 1, -1, 1)), np.zeros((1, 1, steps, 1)), np.ones((1, 1, steps), bool)), 1)


def test_errors_are_of_the_steps_before_an_episode_s_end() -> None:
    """All four are wrong there, of which an early end is no excuse."""
    make: Any = LearnedEnv
    env = make(
        Astray(), trial(*range(6)), [trial(-1, 99.0)], 1, 20, SimpleNamespace(logit=lambda obs: obs[..., 0] - 3.5)
    )
    assert env.rollout(Walker(), [np.random.default_rng(0)]).error.item() == 1


@pytest.mark.parametrize(
    ("limit", "observed", "steps", "last", "error"),
    [(3.5, 99.0, 4, 4.0, 0.0), (99.0, 99.0, 8, 8.0, 12 / 20), (99.0, 5.0, 20, 5.0, 0.0)],
    ids=[
        "terminated: later steps do not count",
        "out of the valid range: the rest of the episode counts as wrong",
        "observations stay within the observed range",
    ],
)
def test_rollouts_end(limit: float, observed: float, steps: int, last: float, error: float) -> None:
    """From 0 on, a step at a time; the data is 0 to 5, so that dynamics are valid from -2.5 to 7.5."""
    walker, model = Walker(), SimpleNamespace(logit=lambda obs: obs[..., 0] - limit)
    make: Any = LearnedEnv
    expert = trial(*range(6))
    for episodes in (1, 2):  # of which the last counts
        env = make(walker, expert, [expert, trial(-1, observed)], episodes, 20, model)
        action_error, path, length = env.rollout(walker, [np.random.default_rng(0)])
        assert walker.steps == episodes * steps
        assert walker.farthest >= min(last + 1, 6)  # the actor's evidence is not clamped
        assert action_error.item() == pytest.approx(error)
        assert length.tolist() == [[steps] * 3]
        assert path[0, 0, :, 0].tolist() == [min(i, last) for i in range(1, 21)]
