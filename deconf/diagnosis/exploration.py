"""Exploration near the expert: a clone without memory, which cannot know theta, and some random actions."""

from __future__ import annotations

from torch import Tensor

from deconfounded.deconf.core.data import Rngs
from deconfounded.deconf.methods import memoryless_bc
from deconfounded.deconf.methods.memoryless_bc import MemorylessAgent, MemorylessConfig
from deconfounded.experts.rollout import Trials

SHARE = 0.25  # of actions that are random


class Wanderer(MemorylessAgent):
    """Random actions alone seldom come to where experts go; a clone alone tries nothing."""

    def choose(self, obs: Tensor) -> Tensor:
        return self.policy.signature.randomise(super().choose(obs), SHARE, self._draws)


def fit(trials: Trials, config: MemorylessConfig, rng: Rngs) -> Wanderer:
    """Clone the expert without memory, as the basis of exploration."""
    clone = memoryless_bc.train(trials, config, rng)
    return Wanderer(clone.policy, clone.scaler, None)
