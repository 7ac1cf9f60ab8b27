"""Naive behavioural cloning with memory: an RNN fitted to expert trials by likelihood.

At its optimum it is the conditional policy, Eq. (2), which takes its own past actions as evidence of theta. A fair
opponent: it is trained on whole trials, its memory is carried over the resets, and its history encoder is that of the
paper's belief.
"""

from __future__ import annotations

from deconf.nets import (
    Adam,
    Batch,
    Draws,
    Progress,
    Rngs,
    Scaler,
    Signature,
    Source,
    Watch,
    drawn,
    listed,
    no_progress,
    no_watch,
)
from deconf.recurrent import RecurrentAgent, RecurrentConfig


def fit(
    trials: Source, config: RecurrentConfig, rng: Rngs, progress: Progress = no_progress, watch: Watch = no_watch
) -> RecurrentAgent:
    """Clone the expert's trials, which are in as many equal groups as there are generators in rng.

    Or clone what draws them: fresh ones for every batch.
    """
    rngs = listed(rng)
    shown = drawn(trials, rngs)
    data, draws = Batch.of(shown, len(rngs), config.device), Draws(rngs, config.device)
    agent = RecurrentAgent.new(config, Signature.of(shown), Scaler(data.obs, data.mask), draws)
    chunks = -(-data.mask.shape[2] // config.chunk)
    passes = -(-config.updates // chunks)
    total = passes * chunks
    optimizer = Adam([agent.memory, agent.policy], config.learning_rate, total if config.cooled else None)
    for i in range(passes):
        if shown is not trials:
            batch = Batch.of(drawn(trials, rngs), len(rngs), config.device)
        else:
            batch = data.trials(draws.below(len(data), config.batch))
        losses = agent.clone(batch, batch.action, config.chunk, optimizer)
        progress((i + 1) * chunks, total, {"imitation": sum(losses) / chunks})
        watch((i + 1) * chunks, total, agent)
    return agent
