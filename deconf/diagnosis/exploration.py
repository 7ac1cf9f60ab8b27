"""Exploration near the expert's trajectories, blind to theta: a memoryless clone with some random actions."""

from torch import Tensor

from deconfounded.deconf.core.data import Rngs
from deconfounded.deconf.methods import memoryless_bc
from deconfounded.deconf.methods.memoryless_bc import MemorylessAgent, MemorylessConfig
from deconfounded.experts.trials import Trials

SHARE = 0.25  # of actions that are random


class ExplorationPolicy(MemorylessAgent):
    """A clone with random actions. These alone seldom go where experts go; a clone alone varies too little."""

    def choose(self, obs: Tensor) -> Tensor:
        return self.policy.signature.randomise(super().choose(obs), SHARE, self._draws)


def fit(trials: Trials, config: MemorylessConfig, rng: Rngs) -> ExplorationPolicy:
    """Clone the expert without memory, as an exploration policy."""
    clone = memoryless_bc.train(trials, config, rng)
    return ExplorationPolicy(clone.policy, clone.scales, None)
