"""Episodes that end early end in dreams too."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from deconfounded.deconf.core import termination
from deconfounded.deconf.core.data import Batch, Draws
from deconfounded.deconf.core.nets import scalers
from deconfounded.deconf.diagnosis.learned_env import World
from deconfounded.experts.rollout import Trials


def walks(n: int = 200, steps: int = 20, limit: float = 2.0) -> Trials:
    """Random walks [n, 1, steps, 1], that are over where they come beyond the limit."""
    obs = np.random.default_rng(0).normal(size=(n, 1, steps + 1, 1)).cumsum(2).astype(np.float32)
    beyond = np.abs(obs[..., 0]) > limit
    mask = ~(np.maximum.accumulate(beyond, -1)[..., :-1])
    mask[..., 0] = True
    return Trials(obs, np.zeros((n, 1, steps, 1)), mask)


def test_what_ends_them_is_learned() -> None:
    """Beyond the limit it is over, within it is not: right of 95% that are .3 or more away from it."""
    some = walks()
    draws = Draws([np.random.default_rng(0)], "cpu")
    ends = termination.fit([some], scalers(Batch.of(some, 1))[0], draws)
    assert ends is not None
    at = torch.linspace(-4, 4, 401)[None, :, None]
    over = (ends.logit(at) > 0)[0]
    clear = (at.abs() - 2).abs()[0, :, 0] > 0.3
    right = over == (at.abs() > 2)[0, :, 0]
    assert right[clear].float().mean() > 0.95


def test_a_horizon_is_no_end() -> None:
    some = walks(limit=1e9)
    assert termination.fit([some], scalers(Batch.of(some, 1))[0], Draws([np.random.default_rng(0)], "cpu")) is None


def test_arrivals() -> None:
    """Of an episode of three steps of four the last arrival is its end; of one of four none is."""
    obs = np.arange(10.0).reshape(2, 1, 5, 1)
    mask = np.array([[[1, 1, 1, 0]], [[1, 1, 1, 1]]], bool)
    came, over = termination.labelled(Trials(obs, np.zeros((2, 1, 4, 1)), mask))
    assert came[:, 0].tolist() == [1, 2, 3, 6, 7, 8, 9]
    assert over.tolist() == pytest.approx([0, 0, 1, 0, 0, 0, 0])


class Walker:
    """As judge and actor: it goes a step ahead, and holds that for right."""

    theta_hat = torch.zeros(1, 3, 1)
    policy = SimpleNamespace(signature=SimpleNamespace(actions=0))
    model = SimpleNamespace(dynamics=SimpleNamespace(sample=lambda obs, action, latent, draws: obs + action))

    def begin(self, n: int, rngs: Any) -> None:
        self.went, self.met = 0.0, 0.0

    def choose(self, obs: torch.Tensor) -> torch.Tensor:
        return torch.ones_like(obs)

    def remember(self, step: Batch) -> None:
        self.went += float(step.mask.sum()) / 3
        self.met = max(self.met, float(step.next_obs.max()))

    def point(self, obs: torch.Tensor, latent: torch.Tensor) -> torch.Tensor:
        return torch.ones_like(obs)


@pytest.mark.parametrize(
    ("limit", "seen", "steps", "last", "off"),
    [(3.5, 99.0, 4, 4.0, 0.0), (99.0, 99.0, 8, 8.0, 12 / 20), (99.0, 5.0, 20, 5.0, 0.0)],
    ids=[
        "over: what would have followed does not count",
        "lost: the rest of the episode counts as wrong",
        "what was never observed is not dreamt of",
    ],
)
def test_dreams_end(limit: float, seen: float, steps: int, last: float, off: float) -> None:
    """From 0 on, a step at a time; dynamics are known of 0 to 5, and so hold from -2.5 to 7.5."""

    def trial(*obs: float) -> Batch:
        steps = len(obs) - 1
        return Batch.of(
            Trials(np.reshape(obs, (1, 1, -1, 1)), np.zeros((1, 1, steps, 1)), np.ones((1, 1, steps), bool)), 1
        )

    walker, ends = Walker(), SimpleNamespace(logit=lambda obs: obs[..., 0] - limit)
    dream: Any = World
    held = trial(*range(6))
    found, path = dream(walker, held, [held, trial(-1, seen)], 1, 20, ends).visit(walker, [np.random.default_rng(0)])
    assert walker.went == steps
    assert walker.met >= min(last + 1, 6)  # evidence is as drawn, beyond what a sensor shows
    assert found.item() == pytest.approx(off)
    assert path[0, 0, :, 0].tolist() == [min(i, last) for i in range(1, 21)]
