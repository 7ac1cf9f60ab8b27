"""How long one robot waits for an agent: milliseconds of `act` and `observe` in one environment, by method."""

import time
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks.engine.context import Context
from deconfounded.benchmarks.engine.presets import preset
from deconfounded.benchmarks.engine.provider import fit
from deconfounded.deconf.core.monitor import Monitor

STEPS, WARM_UP = 1000, 100


def latency(task: envs.Task, method: str) -> dict[str, float]:
    """Median and 99th percentile, in ms, of a step of an agent of one trial, hardly trained."""
    settings = preset("smoke", task, "cpu", [method])
    agent = fit(Context(task, settings, (0,), Monitor()), method)
    agent.begin(1)
    agent.reset([np.random.default_rng(0)])
    rng, times = np.random.default_rng(1), []
    observations = rng.standard_normal((WARM_UP + STEPS + 1, 1, task.observation_space.shape[0])).astype(np.float32)
    for obs, following in pairwise(observations):
        start = time.perf_counter()
        action = agent.act(obs)
        agent.observe(obs, action, following, np.ones(1, bool))
        times.append(1000 * (time.perf_counter() - start))
    return {"median_ms": float(np.median(times[WARM_UP:])), "p99_ms": float(np.percentile(times[WARM_UP:], 99))}


def by_method(task: envs.Task, methods: Sequence[str]) -> dict[str, dict[str, float]]:
    """Of each method, printed as they come."""
    measured = {}
    for method in methods:
        measured[method] = latency(task, method)
        print(f"{task.name}, {method:22} {measured[method]['median_ms']:.2f} ms, 99% {measured[method]['p99_ms']:.2f}")
    return measured
