"""Exploration near the expert: a clone without memory, which cannot know theta, and some random actions."""

from __future__ import annotations

from torch import Tensor

from deconfounded.deconf.core.data import Rngs
from deconfounded.deconf.methods import cloning
from deconfounded.deconf.methods.cloning import CloningConfig, MemorylessAgent
from deconfounded.experts.rollout import Trials

SHARE = 0.25  # of actions that are random


class Wanderer(MemorylessAgent):
    """Random actions alone seldom come to where experts go; a clone alone tries nothing."""

    def choose(self, obs: Tensor) -> Tensor:
        return self.policy.signature.randomise(super().choose(obs), SHARE, self._draws)


def fit(trials: Trials, config: CloningConfig, rng: Rngs) -> Wanderer:
    """Clone the expert's trials as in `cloning.fit`, to explore with."""
    clone = cloning.train(trials, config, rng)
    return Wanderer(clone.policy, clone.scaler, None)
