"""do-mpc's simulator and its example, a continuous stirred tank: a hidden heat flow, a hidden order, and copies."""

import warnings
from typing import Any

import casadi
import gymnasium
import numpy as np
from gymnasium import spaces

from deconfounded.benchmarks.studies.foreign.world import World
from deconfounded.envs.streams import Array
from deconfounded.experts.trials import Trials

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import do_mpc

HEAT, GUSTS, STEP = 2500.0, (0.002, 0.002, 0.2, 1.1), 0.005  # kJ/h; mol/l, mol/l, K, K a step; h
FLOW, FEED, COOL, LEAST = 18.0, 5.1, 130.0, -8500.0  # of the feed: 1/h, mol/l, degrees Celsius; kJ/h
START, TARGET = (1.2, 0.89, 134.0, 129.0), 134.0  # concentrations in mol/l, temperatures of reactor and jacket
FORWARD, SLOPE = -4390.0, 500.0  # kJ/h that hold TARGET, and more for each kelvin


def simulator() -> Any:
    """The reactor of do-mpc's documentation, with a flow of heat into its jacket."""
    model = do_mpc.model.Model("continuous")
    a, b, t, k = (model.set_variable("_x", name) for name in ("C_a", "C_b", "T_R", "T_K"))
    cooling, heat = model.set_variable("_u", "Q_dot"), model.set_variable("_p", "heat")
    rate = 1.287e12 * casadi.exp(-9758.3 / (t + 273.15))
    aside = 9.043e9 * casadi.exp(-8560.0 / (t + 273.15))
    release = (rate * a * 4.2 - rate * b * 11.0 - aside * a**2 * 41.85) / -(0.9342 * 3.01)
    model.set_rhs("C_a", FLOW * (FEED - a) - rate * a - aside * a**2)
    model.set_rhs("C_b", -FLOW * b + rate * a - rate * b)
    model.set_rhs("T_R", release + FLOW * (COOL - t) + 4032.0 * 0.215 * (k - t) / (0.9342 * 3.01 * 10.01))
    model.set_rhs("T_K", (cooling + heat + 4032.0 * 0.215 * (t - k)) / (5.0 * 2.0))
    model.setup()
    made = do_mpc.simulator.Simulator(model)
    made.set_param(t_step=STEP, integration_tool="cvodes", abstol=1e-6, reltol=1e-6)
    return made


class Reactor(gymnasium.Env):
    """Observes concentrations and temperatures; acts by cooling in kJ/h; its reward is -|T_R - target| / 10."""

    observation_space = spaces.Box(-np.inf, np.inf, (4,), np.float64)
    action_space = spaces.Box(LEAST, 0.0, (1,), np.float64)

    def __init__(self, heat: float, target: float, gusts: tuple[float, ...] = GUSTS) -> None:
        self.target, self.gusts, self.simulator = target, gusts, simulator()
        parameters = self.simulator.get_p_template()
        parameters["heat"] = heat
        self.simulator.set_p_fun(lambda time: parameters)
        self.simulator.setup()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.state = np.array(START) + self.np_random.normal(0, (0.05, 0.05, 2.0, 2.0))
        return self.state, {}

    def step(self, action: Array) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.simulator.x0 = self.state
        then = self.simulator.make_step(np.asarray(action, float).reshape(1, 1))[:, 0]
        self.state = then + self.np_random.normal(0, self.gusts)
        return self.state, -abs(self.state[2] - self.target) / 10, False, False, {}


class ReactorHeat(World):
    """theta: the heat [1] in kJ/h, for which the expert feeds cooling forward: confounded, and Tier 2 suffices."""

    episodes, steps, noise = 1, 40, 100.0
    evidence = [2, 3]

    def make(self, theta: Array) -> gymnasium.Env:
        return Reactor(float(theta[0]), TARGET)

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return rng.uniform(-HEAT, HEAT, 1)

    def expert(self, obs: Array, theta: Array) -> Array:
        return FORWARD - theta + 100.0 * (TARGET - obs[2:3])


class ReactorCalm(ReactorHeat):
    """The same without gusts: one transition reveals the heat."""

    def make(self, theta: Array) -> gymnasium.Env:
        return Reactor(float(theta[0]), TARGET, (0.0,) * 4)


class ReactorOrder(ReactorHeat):
    """theta: the temperature [1] that was ordered. Nothing but the reward reveals it, and so no exploration helps."""

    evidence = []

    def make(self, theta: Array) -> gymnasium.Env:
        return Reactor(0.0, float(theta[0]))

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return TARGET + rng.uniform(-4, 4, 1)

    def expert(self, obs: Array, theta: Array) -> Array:
        return FORWARD + SLOPE * (theta - TARGET) + 100.0 * (theta - obs[2:3])


class ReactorTwice(ReactorHeat):
    """Nothing hidden, and each trial is in the log twice."""

    evidence = []

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return np.zeros(1)

    def logged(self, trials: Trials) -> Trials:
        half = len(trials) // 2
        obs, action, mask = (np.concatenate([x[:half], x[:half]]) for x in (trials.obs, trials.action, trials.mask))
        return Trials(obs, action, mask, trials.actions)
