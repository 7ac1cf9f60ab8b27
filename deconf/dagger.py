"""Tier 3: expert queries, after DAgger (Ross et al., 2011). A recurrent policy learns from labels on its own roll-outs.

It is on-policy distillation of a privileged expert: others call it SequIL, or counterfactual teaching (Ortega et al.,
2021). Other than DAgger's, its roll-outs are never the expert's, nor a mixture with it: the first are random.

The expert, which sees theta, is asked what it would do at each step that the imitator comes to. Actions in these
histories are the imitator's, and so no evidence of theta: at its optimum this is the interventional policy (Ortega et
al., 2021), whatever the dynamics tell. Expert roll-outs are not used: their actions would be evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deconfounded.deconf.agents import Monitor
from deconfounded.deconf.data import Batch, Draws, Rngs, Signature, listed, take
from deconfounded.deconf.nets import Scaler
from deconfounded.deconf.recurrent import Cloner, RecurrentAgent, RecurrentConfig
from deconfounded.envs.task import InputError
from deconfounded.experts.demos import Agent, Trials

Query = Callable[[Agent | None, Sequence[np.random.Generator]], tuple[Trials, NDArray[np.float32]]]
"""Roll out a behaviour (None: uniformly random actions) in fresh environments, as many trials for each generator.

Returns trials, and beside them what the expert would have done at each step [B, E, T, A]."""


@dataclass(frozen=True)
class DaggerConfig(RecurrentConfig):
    """Each round queries on fresh roll-outs of the policy so far; later rounds, with more labels, get more updates."""

    rounds: int = 10


def fit(query: Query, config: DaggerConfig, rng: Rngs, monitor: Monitor | None = None) -> RecurrentAgent:
    """Label roll-outs, train on all labels so far, and again. Raises InputError for less than one round."""
    if config.rounds < 1:
        raise InputError(f"rounds was {config.rounds}; it must be at least 1")
    rngs = listed(rng)
    draws = Draws(rngs, config.device)
    trials, labels = query(None, rngs)
    data, label = Batch.of(trials, len(rngs), config.device), _labels(trials, labels, len(rngs), config.device)
    agent = RecurrentAgent.new(config.width, Signature.of(trials), Scaler(data.obs, data.mask), draws)
    cloner = Cloner(agent, config, data.mask.shape[2], monitor or Monitor(), config.rounds)
    for i in range(config.rounds):
        if i > 0:
            trials, labels = query(agent, rngs)
            data = data.joined(Batch.of(trials, len(rngs), config.device))
            label = torch.cat([label, _labels(trials, labels, len(rngs), config.device)], 1)
        for _ in range(cloner.passes[i]):
            index = draws.below(len(data), config.batch)
            cloner.learn(data.trials(index), take(label, index))
    return agent


def _labels(trials: Trials, labels: NDArray[np.float32], seeds: int, device: str) -> Tensor:
    """[S, B, T, A], joined as the trials' own actions are."""
    return Batch.of(Trials(trials.obs, labels, trials.mask, trials.actions), seeds, device).action
