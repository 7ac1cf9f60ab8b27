"""Naive behavioural cloning with memory: an RNN fitted to expert trials by likelihood.

At its optimum it is the conditional policy, Eq. (2), which takes its own past actions as evidence of theta. A fair
opponent: it is trained on whole trials, its memory is carried over the resets, and its history encoder is that of the
paper's belief.
"""

from __future__ import annotations

from deconfounded.deconf.core.agents import Monitor
from deconfounded.deconf.core.data import Rngs, Source
from deconfounded.deconf.methods.clones import by_chunks, clone
from deconfounded.deconf.methods.recurrent import RecurrentAgent, RecurrentConfig


def fit(trials: Source, config: RecurrentConfig, rng: Rngs, monitor: Monitor | None = None) -> RecurrentAgent:
    """Clone the expert's trials, or what draws them: see `clone`."""
    return clone(trials, config, rng, lambda *kind: RecurrentAgent.new(config.width, *kind), by_chunks(config), monitor)
