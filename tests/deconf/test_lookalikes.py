"""Verdicts on small worlds: what is confounded, and what only looks like it, each trained on and judged."""

from dataclasses import replace

import numpy as np
import pytest

from deconfounded.deconf.diagnosis import judgement, measures
from deconfounded.deconf.diagnosis.judgement import Diagnosis
from deconfounded.deconf.diagnosis.measures import Amounts, Findings
from deconfounded.deconf.methods.deconfounded import DeconfoundedConfig
from deconfounded.deconf.methods.memoryless_bc import MemorylessConfig
from deconfounded.deconf.methods.sequence_bc import RecurrentConfig
from deconfounded.experts.rollout import Trials

SMALL = Amounts(
    candidates=16,
    rollouts=96,
    cloning=MemorylessConfig(updates=400, width=32),
    naive=RecurrentConfig(updates=250, width=32),
    exploring=DeconfoundedConfig(inference_updates=400, inference_rate=3e-3, width=32, latent=2),
)
STEPS, NOISE = 40, 0.1


def world(kind: str, n: int, seed: int, explores: bool = False) -> Trials:
    """A point is to be held at 0: s' = s + a / 2 + push + noise; explorers add random actions to a blind controller.

    kind, what is hidden or only looks so. wind: a push, constant in a trial, which the expert leans against; goal: the
    point, 1 to either side, at which only the expert aims; habits: the experts' gains, 1.2 to 1.8; ar1: noise of the
    expert that lasts; memory: an integral that it keeps; pause: it rests for 0 to 15 steps at first; idle: nothing.
    """
    rng = np.random.default_rng(seed)
    theta = rng.uniform(-1, 1, n)
    gain = 1.5 + 0.3 * theta * (kind == "habits")
    push = 0.2 * theta * (kind == "wind")
    goal = np.sign(theta) * (kind == "goal")
    start = rng.integers(0, 16, n) * (kind == "pause")
    kept, s = np.zeros(n), rng.normal(0, 0.3, n) + (kind == "pause")
    obs, actions = [s], []
    for t in range(STEPS):
        noise = rng.normal(0, 0.05, n)
        if explores:
            act = -s + rng.uniform(-1, 1, n) + (rng.choice([-0.7, 0.7], n) if kind == "goal" else 0)
        else:
            if kind == "ar1":
                kept = 0.95 * kept + rng.normal(0, 0.06, n)
            elif kind == "memory":
                kept = 0.9 * kept - 0.15 * s
            act = gain * (goal - s) / 1.5 - 2 * push + kept + noise
            act = np.where(t < start, noise / 5, act)
        act = act.clip(-1, 1)
        moved = s + act / 2 + push + NOISE * rng.standard_normal(n)
        s = np.where((t < start) & (not explores), s, moved)
        obs.append(s)
        actions.append(act)
    return Trials(
        np.stack(obs, -1)[:, None, :, None], np.stack(actions, -1)[:, None, :, None], np.ones((n, 1, STEPS), bool)
    )


def found(trials: Trials, explored: Trials) -> Findings:
    return measures.measure(trials, explored, SMALL, np.random.default_rng(0))


def diagnosed(kind: str, n: int = 96, explored: int = 96) -> Diagnosis:
    return judgement.judge([found(world(kind, n, 0), world(kind, explored, 1, explores=True))], explored)
