"""Naive behavioural cloning with memory: an RNN fitted to expert trials by likelihood.

Its optimum is the conditional policy, Eq. (2), which takes its own past actions for evidence of theta. For a fair
comparison it is trained on whole trials, its memory outlives resets, and its history encoder is that of the paper's
belief.
"""

from deconfounded.deconf.core.data import Rngs, Source
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods.sequence_bc import SMOKE, RecurrentAgent, RecurrentConfig, train_recurrent


def train(trials: Source, config: RecurrentConfig, rng: Rngs, monitor: Monitor | None = None) -> RecurrentAgent:
    """Clone the expert's trials."""
    return train_recurrent(RecurrentAgent, trials, config, rng, monitor)


@uses(
    "demonstrations",
    version=2,
    cost=2,
    on_control=RecurrentConfig(),
    on_bandit=RecurrentConfig(updates=2000, batch=128, chunk=50, learning_rate=1e-2),
    **SMOKE,
    paper=RecurrentConfig(width=256, updates=5000, batch=100, chunk=100, learning_rate=1e-3, cooled=False),
)
def fit(given: Given) -> RecurrentAgent:
    """Clone the demonstrations."""
    return train(given.source, given.config, given.rngs, given.monitor)
