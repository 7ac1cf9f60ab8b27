"""Monitors of a diagnosis' trainings: progress, and how well held-out actions are predicted at best."""

from collections.abc import Callable

import torch
from torch import Tensor

from deconfounded.deconf.core.data import Batch
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.diagnosis.latent import typical
from deconfounded.deconf.methods.memoryless_bc import MemorylessAgent
from deconfounded.deconf.methods.sequence_bc import RecurrentAgent
from deconfounded.experts.rollout import Agent

CHECKS = 12  # of a training

Report = Callable[[float], None]
"""Takes the share of the work that is done."""


class PartMonitor(Monitor):
    """Reports the progress of a training that is part of the work, from share `begin` to `end`."""

    def __init__(self, report: Report, begin: float, end: float) -> None:
        super().__init__()
        self.report, self.begin, self.end = report, begin, end

    def update(self, done: int, total: int, losses: dict[str, float], agent: Agent | None = None) -> None:
        self.report(self.begin + (self.end - self.begin) * done / total)


class BestMonitor(PartMonitor):
    """Also keeps the log-likelihood [1, B, T] of held-out actions at the number of updates where it is highest.

    A clone learns few trials by heart, sooner with a memory than without one; what is left at the end of training says
    how soon, and not how much the present observation, or a memory, tells.
    """

    best: Tensor

    def __init__(self, report: Report, begin: float, end: float, held_out: Batch) -> None:
        super().__init__(report, begin, end)
        self.held_out, self.most, self.checked = held_out, float("-inf"), 0

    @torch.no_grad()
    def update(self, done: int, total: int, losses: dict[str, float], agent: Agent | None = None) -> None:
        super().update(done, total, losses, agent)
        if CHECKS * done // total == self.checked:
            return
        self.checked, x = CHECKS * done // total, self.held_out
        if isinstance(agent, RecurrentAgent):
            log_prob = agent.log_prob(x)
        else:
            assert isinstance(agent, MemorylessAgent)
            log_prob = agent.policy.log_prob(agent.scales.obs(x.obs), x.action)
        likely = typical(log_prob, x)
        if not likely <= self.most:  # nan is kept too
            self.most, self.best = likely, log_prob
