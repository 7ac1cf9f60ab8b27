"""Oracle behavioural cloning: pi(a | s, theta), which sees theta in training and when it is deployed."""

from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods import memoryless_bc
from deconfounded.deconf.methods.memoryless_bc import PRESETS, MemorylessAgent


@uses("demonstrations", "theta", version=2, **PRESETS)
def fit(given: Given) -> MemorylessAgent:
    """Clone the expert's action at each step, given theta."""
    trials, theta = given.demonstrations, given.theta
    return memoryless_bc.train(trials, given.config, given.rngs, theta, given.acting_theta, given.monitor)
