"""Naive behavioural cloning with memory: an RNN fitted to expert trials by likelihood.

At its optimum it is the conditional policy, Eq. (2), which takes its own past actions as evidence of theta. A fair
opponent: it is trained on whole trials, its memory is carried over the resets, and its history encoder is that of the
paper's belief.
"""

from __future__ import annotations

from deconfounded.deconf.agents import Checkpoint, Monitor
from deconfounded.deconf.data import Batch, Draws, Rngs, Signature, Source, drawn, listed
from deconfounded.deconf.nets import Scaler
from deconfounded.deconf.recurrent import Cloner, RecurrentAgent, RecurrentConfig


def fit(trials: Source, config: RecurrentConfig, rng: Rngs, monitor: Monitor | None = None) -> RecurrentAgent:
    """Clone the expert's trials, which are in as many equal groups as there are generators in rng.

    Or clone what draws them: fresh ones for every batch.
    """
    rngs, monitor = listed(rng), monitor or Monitor()
    shown = drawn(trials, rngs)
    data, draws = Batch.of(shown, len(rngs), config.device), Draws(rngs, config.device)
    agent = RecurrentAgent.new(config.width, Signature.of(shown), Scaler(data.obs, data.mask), draws)
    cloner = Cloner(agent, config, data.mask.shape[2], monitor)
    checkpoint = Checkpoint(
        monitor, rngs, memory=agent.memory, policy=agent.policy, optimizer=cloner.optimizer, draws=draws
    )
    if before := checkpoint.load():
        cloner.done = before["done"]
    while cloner.done < cloner.total:
        if shown is trials:
            batch = data.draw_trials(config.batch, draws)
        else:
            batch = Batch.of(drawn(trials, rngs), len(rngs), config.device)
        cloner.learn(batch, batch.action)
        checkpoint.save(done=cloner.done)
    return agent
