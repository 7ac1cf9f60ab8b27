"""Small tasks for methods' fingerprints, which do not move when a task of the suite changes."""

import numpy as np
from gymnasium import spaces

from deconfounded.envs.latent import Latent
from deconfounded.envs.streams import Array, Streams
from deconfounded.envs.task import Renderer, Task


class Push(Task):
    """A point on a line, pushed by a hidden constant force; episodes end early beyond 1.2 m, and within .1 m of 0."""

    name = "push"
    latents = (Latent("force", "N", -1.0, 1.0),)
    horizon, episodes = 7, 2
    expert_noise = 0.1
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    observation = {"x": (-4.0, 4.0), "velocity": (-4.0, 4.0)}
    std = np.array([0.02, 0.05])

    def init_state(self, rng: Streams) -> Array:
        return np.stack(rng.uniform([-1.0, -0.3], [1.0, 0.3]), -1)

    def sample_noise(self, rng: Streams) -> Array:
        return rng.standard_normal((rng.groups, self.horizon, 2))

    def outcome(self, state: Array, action: Array, theta: Array) -> Array:
        velocity = 0.8 * state[:, 1] + 0.4 * (action[:, 0] + theta[:, 0])
        return np.stack([state[:, 0] + 0.5 * velocity, velocity], -1)

    def apply_noise(self, outcome: Array, noise: Array) -> Array:
        return outcome + self.std * noise

    def log_prob(self, next_state: Array, outcome: Array) -> Array:
        return (-0.5 * ((next_state - outcome) / self.std) ** 2 - np.log(self.std)).sum(-1) - np.log(2 * np.pi)

    def observe(self, state: Array) -> Array:
        return state

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        return np.exp(-(next_state[:, 0] ** 2))

    def terminated(self, state: Array) -> np.ndarray:
        return (np.abs(state[:, 0]) > 1.2) | (np.abs(state[:, 0]) < 0.1)

    def renderer(self, theta: Array) -> Renderer:
        raise NotImplementedError


class OtherUnits(Push):
    """Push, whose observation comes in other units: one column large, one small, and both with an offset."""

    observation = {"x": (-450.0, 450.0), "velocity": (-0.1, 0.1)}

    def observe(self, state: Array) -> Array:
        return state * [100, 0.02] + [50, 0.01]


class StrongMotor(Push):
    """Push with a motor that is ten times as strong, so that experts use a small part of its range."""

    gain, rest = 10.0, 0.0
    expert_noise = 0.01

    def outcome(self, state: Array, action: Array, theta: Array) -> Array:
        return super().outcome(state, self.gain * (action - self.rest), theta)


class StrongerMotor(StrongMotor):
    """One that is five times as strong again, and rests at .3."""

    gain, rest = 50.0, 0.3
    expert_noise = 0.002


class Drift(Push):
    """The same, under a force that drifts from episode to episode."""

    name = "drift"
    latents = (Latent("force", "N", -1.0, 1.0, drift=0.1),)


class Switch(Push):
    """The same, under a force that is drawn anew in one step of ten."""

    name = "switch"
    latents = (Latent("force", "N", -1.0, 1.0, switch=0.1),)


class Arms(Task):
    """Three arms, of which a hidden one pays more often; the expert knows which."""

    name = "arms"
    latents = (Latent("best_arm", "", 0, 2, "categorical"),)
    horizon, episodes = 8, 1
    action_space = spaces.Discrete(3)
    observation = {"payout": (0.0, 1.0)}

    def init_state(self, rng: Streams) -> Array:
        return np.zeros((rng.groups, 1))

    def sample_noise(self, rng: Streams) -> Array:
        return rng.random((rng.groups, self.horizon, 1))

    def outcome(self, state: Array, action: Array, theta: Array) -> Array:
        return np.where(action == theta, 0.7, 0.3)

    def apply_noise(self, outcome: Array, noise: Array) -> Array:
        return (noise < outcome).astype(float)

    def log_prob(self, next_state: Array, outcome: Array) -> Array:
        return np.log(np.where(next_state == 1, outcome, 1 - outcome))[..., 0]

    def observe(self, state: Array) -> Array:
        return state

    def reward(self, state: Array, action: Array, next_state: Array, theta: Array) -> Array:
        return (action == theta)[:, 0].astype(float)

    def expert_probs(self, obs: Array, theta: Array) -> Array:
        return np.where(np.arange(3) == theta, 0.6, 0.2)

    def renderer(self, theta: Array) -> Renderer:
        raise NotImplementedError


def control(obs: Array, theta: Array) -> Array:
    """The expert of Push and Drift: brakes, and leans against the force."""
    return np.clip(-obs[:, :1] - 0.5 * obs[:, 1:] - theta, -1, 1)


def other_control(obs: Array, theta: Array) -> Array:
    """The expert of OtherUnits."""
    return control((obs - [50, 0.01]) / [100, 0.02], theta)


def strong_control(obs: Array, theta: Array) -> Array:
    """The expert of StrongMotor."""
    return control(obs, theta) / 10


def stronger_control(obs: Array, theta: Array) -> Array:
    """The expert of StrongerMotor."""
    return 0.3 + control(obs, theta) / 50
