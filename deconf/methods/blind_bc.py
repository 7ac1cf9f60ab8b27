"""Blind behavioural cloning: pi(a | s), without memory and without theta."""

from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods import memoryless_bc
from deconfounded.deconf.methods.memoryless_bc import PRESETS, MemorylessAgent


@uses("demonstrations", version=2, **PRESETS)
def fit(given: Given) -> MemorylessAgent:
    """Clone the expert's action at each step."""
    return memoryless_bc.train(given.demonstrations, given.config, given.rngs, monitor=given.monitor)
