"""gym-electric-motor's permanently excited DC motor, which turns a hidden load, or runs on a worn battery."""

import warnings
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium import spaces

from deconfounded.benchmarks.studies.foreign.world import Controller, World
from deconfounded.envs.streams import Array

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import gym_electric_motor as gem
    from gym_electric_motor.physical_systems import EulerSolver, PolynomialStaticLoad
    from gym_electric_motor.reference_generators import WienerProcessReferenceGenerator

R, L, PSI, J, U, TOP, TAU = 0.5, 1e-3, 0.5, 0.02, 60.0, 100.0, 0.01  # ohm, H, Wb, kg m^2, V, rad/s, s
LOAD, GUST = 20.0, 8.0  # N m; rad/s a step


class Torque(PolynomialStaticLoad):
    """A constant torque, whichever way the motor turns, as of a hoist."""

    def _static_load(self, omega: float) -> float:
        return float(self._load_parameter["c"])

    def mechanical_jacobian(self, t: float, state: Array, torque: float) -> tuple[Array, Array]:
        return np.zeros((1, 1)), np.array([1 / self._j_total])


class Hoist(gymnasium.Wrapper):
    """Observes speed and reference, of TOP; a gust on the speed after each step."""

    def __init__(self, env: gymnasium.Env, gust: float) -> None:
        super().__init__(env)
        self.gust = gust
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        (state, reference), info = self.env.reset(seed=seed, options=options)
        return np.array([state[0], reference[0]]), info

    def step(self, action: Array) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        (_, reference), reward, terminated, _, info = self.env.step(action)
        solver = self.env.unwrapped.physical_system._ode_solver  # type: ignore[attr-defined]
        y = np.array(solver.y)
        y[0] += self.gust * self.np_random.standard_normal()
        solver.set_initial_value(y, solver.t)
        return np.array([y[0] / TOP, reference[0]]), reward, terminated, False, info


class Motor(World):
    """theta: the load [1] in N m, for which the expert feeds a voltage forward: confounded, and Tier 2 suffices."""

    episodes, noise, gust = 1, 0.02, GUST
    evidence = [0]

    def make(self, theta: Array) -> gymnasium.Env:
        env = gem.make(
            "Cont-SC-PermExDc-v0",
            tau=TAU,
            motor={
                "motor_parameter": {"r_a": R, "l_a": L, "psi_e": PSI, "j_rotor": J},
                "limit_values": {"omega": TOP, "i": 1000.0, "u": U, "torque": 500.0},
                "nominal_values": {"omega": TOP, "i": 1000.0, "u": U, "torque": 500.0},
            },
            supply={"u_nominal": U},
            load=Torque(load_parameter={"a": 0.0, "b": 0.0, "c": float(theta[0]), "j_load": 1e-4}),
            reference_generator=WienerProcessReferenceGenerator(
                reference_state="omega", sigma_range=(0.02, 0.05), limit_margin=0.6
            ),
            ode_solver=EulerSolver(nsteps=20),
            constraints=(),
            disable_env_checker=True,
        )
        return Hoist(env, self.gust)

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return rng.uniform(-LOAD, LOAD, 1)

    def expert(self, obs: Array, theta: Array) -> Array:
        """The voltage that holds the reference under the load, and some feedback."""
        speed, reference = TOP * obs
        return np.array([(PSI * reference + R * theta[0] / PSI + 0.1 * (reference - speed)) / U])


class MotorIntegral(Motor):
    """The same load, and an expert that does not see it either: it integrates its errors, as a clone may."""

    evidence = []

    def expert(self, obs: Array, theta: Array) -> Array:
        return super().expert(obs, np.zeros(1))

    def controller(self, theta: Array, rng: np.random.Generator) -> Controller:
        total = 0.0

        def act(obs: Array) -> Array:
            nonlocal total
            total += 0.04 * TOP * (obs[1] - obs[0]) / U
            return self.expert(obs, theta) + total + self.noise * rng.standard_normal(1)

        return act


class MotorBattery(Motor):
    """theta: the share [1] of the voltage that a worn battery supplies. The expert asks for more. No load."""

    evidence = []

    def make(self, theta: Array) -> gymnasium.Env:
        return gymnasium.wrappers.TransformAction(super().make(np.zeros(1)), lambda action: theta[0] * action, None)

    def sample_theta(self, rng: np.random.Generator) -> Array:
        return rng.uniform(0.4, 1.0, 1)

    def expert(self, obs: Array, theta: Array) -> Array:
        return super().expert(obs, np.zeros(1)) / theta


class MotorCalm(Motor):
    """The same load without gusts: one transition reveals it."""

    gust = 0.0
