"""Recurrent behavioural cloning on past observations alone (Swamy et al., 2022).

Without past actions the imitator cannot take its own for evidence of theta, but the effect of an action is hidden too:
where theta shows only there, as on the bandit, nothing is learned of it. All else is naive_rnn's.
"""

from torch import Tensor

from deconfounded.deconf.core.data import Batch
from deconfounded.deconf.core.gru import GruMemory
from deconfounded.deconf.core.nets import per_seed
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods.sequence_bc import SMOKE, RecurrentAgent, RecurrentConfig, train_recurrent


class ObsMemory(GruMemory):
    """A GRU over pairs (s, s'), without actions."""

    def _embed(self, batch: Batch) -> Tensor:
        constant = per_seed(self.inputs.scales.action.mean, batch.action).expand_as(batch.action)
        return super()._embed(Batch(batch.obs, constant, batch.next_obs, batch.mask))


class ObsAgent(RecurrentAgent):
    """A policy of past and present observations."""

    memory_kind = ObsMemory


@uses(
    "demonstrations",
    version=2,
    cost=2,
    on_control=RecurrentConfig(learning_rate=9e-4),
    on_bandit=RecurrentConfig(updates=2000, batch=128, chunk=50, learning_rate=3e-3),
    **SMOKE,
)
def fit(given: Given) -> ObsAgent:
    """Clone the demonstrations."""
    return train_recurrent(ObsAgent, given.source, given.config, given.rngs, given.monitor)
