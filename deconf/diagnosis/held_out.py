"""How well held-out trials are predicted, typically and at the best of a training; and the progress of a diagnosis."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from deconfounded.deconf.core.data import Batch
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.methods.memoryless_bc import MemorylessAgent
from deconfounded.deconf.methods.sequence_bc import RecurrentAgent
from deconfounded.experts.agent import Agent

CHECKS = 12  # of a training
TRIM = 0.1  # share of held-out trials that is left out at either end, when likelihoods are averaged

Report = Callable[[float], None]
"""Takes the share of the work that is done."""


def typical(x: Tensor, batch: Batch) -> float:
    """The trimmed mean over trials of the means of x [1, B, T] over their steps: no single one, a fall say, decides."""
    steps = batch.mask[0].sum(-1)
    means = ((x * batch.mask)[0].sum(-1) / steps.clamp(min=1))[steps > 0].sort().values
    trimmed = min(math.ceil(TRIM * len(means)), (len(means) - 1) // 2)
    return float(means[trimmed : len(means) - trimmed].mean())


class Best:
    """The log-likelihood [1, B, T] of held-out actions at the number of updates, of CHECKS, where it is highest.

    A clone learns few trials by heart, sooner with a memory, or a latent that names the trial, than without. What is
    left at the end of training says how soon, and not how much the observation, the memory or the latent tells.
    """

    log_prob: Tensor

    def __init__(self, held_out: Batch) -> None:
        self.held_out, self.highest, self.checked = held_out, float("-inf"), 0

    @torch.no_grad()
    def check(self, done: int, total: int, log_prob: Callable[[], Tensor]) -> bool:
        """Check, if it is time, and return whether the log-likelihood is the highest so far."""
        if CHECKS * done // total == self.checked:
            return False
        self.checked, now = CHECKS * done // total, log_prob()
        likely = typical(now, self.held_out)
        if likely <= self.highest:
            return False
        self.highest, self.log_prob = likely, now  # nan is kept too
        return True


class PartMonitor(Monitor):
    """Reports the progress of a training that is part of the work, from share `begin` to `end`."""

    def __init__(self, report: Report, begin: float, end: float) -> None:
        super().__init__()
        self.report, self.begin, self.end = report, begin, end

    def update(self, done: int, total: int, losses: dict[str, float], agent: Agent | None = None) -> None:
        self.report(self.begin + (self.end - self.begin) * done / total)


class BestMonitor(PartMonitor):
    """Also keeps the best log-likelihood of held-out actions, see `Best`."""

    def __init__(self, report: Report, begin: float, end: float, held_out: Batch) -> None:
        super().__init__(report, begin, end)
        self.best = Best(held_out)

    def update(self, done: int, total: int, losses: dict[str, float], agent: Agent | None = None) -> None:
        super().update(done, total, losses, agent)
        self.best.check(done, total, lambda: _log_prob(agent, self.best.held_out))


def _log_prob(agent: Agent | None, x: Batch) -> Tensor:
    if isinstance(agent, RecurrentAgent):
        return agent.log_prob(x)
    assert isinstance(agent, MemorylessAgent)
    return agent.policy.log_prob(agent.scales.obs(x.obs), x.action)
