"""GAIL's PPO: vector environments without theta, whose episode is a whole trial, and the recurrent policy."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.logger import Logger
from torch import Tensor, nn

from deconfounded.deconf.given import Environments
from deconfounded.envs.support.spaces import action_sizes
from deconfounded.experts.sb3 import BatchVecEnv

if TYPE_CHECKING:
    from deconfounded.deconf.methods.gail import GailConfig

Reward = Callable[[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32]]
"""Observations [N, O], actions [N, A], next observations [N, O] -> rewards [N]. The task's reward is hidden."""


class TrialVecEnv(BatchVecEnv):
    """A vector of environments whose episode, for PPO, is a whole trial: `done` marks the end of the trial.

    Its observation [N, O + F + 1]: the task's, scaled; the previous action, one-hot if discrete; and a flag of the
    start of an episode, where there is no such action. `transitions` holds those since the last reset.
    """

    def __init__(
        self, environments: Environments, space: Any, mean: NDArray[Any], std: NDArray[Any], reward: Reward
    ) -> None:
        """space: of actions. mean, std [O]: of the expert's observations."""
        self._environments, self._mean, self._std, self._reward = environments, mean, std, reward
        width, self._actions = action_sizes(space)
        self._features = self._actions or width
        observation_space = spaces.Box(-np.inf, np.inf, (len(mean) + self._features + 1,), np.float32)
        super().__init__(environments.n, observation_space, space)

    def reset(self) -> Any:
        """Start trials, under the thetas of these environments' seeds."""
        self._obs = self._environments.reset()
        self.transitions: list[tuple[NDArray[np.float32], ...]] = []
        return self._observation(np.zeros((self.num_envs, self._features)), np.ones(self.num_envs, bool))

    def _observation(self, before: NDArray[Any], starts: NDArray[np.bool_]) -> NDArray[np.float32]:
        columns = [(self._obs - self._mean) / self._std, np.where(starts[:, None], 0, before), starts[:, None]]
        return np.concatenate(columns, -1).astype(np.float32)

    def step_async(self, actions: Any) -> None:
        self._chosen = np.asarray(actions, np.float32).reshape(self.num_envs, -1)

    def step_wait(self) -> Any:
        action, obs = self._chosen, self._obs
        next_obs, following, over, done = self._environments.step(action)
        reward = self._reward(obs, action, next_obs)
        self.transitions.append((obs, action, next_obs))
        before = np.eye(self._actions)[action[:, 0].astype(int)] if self._actions else action
        self._obs = next_obs
        infos: list[dict[str, Any]] = [{} for _ in done]
        terminal = self._observation(before, np.zeros(len(done), bool))
        for i in np.flatnonzero(done):
            infos[i] = {"terminal_observation": terminal[i], "TimeLimit.truncated": True}  # PPO bootstraps here
        self._obs = following
        return self._observation(before, over), reward, done, infos

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Nothing: seeds are those of the environments."""
        return [None] * self.num_envs


class SequencePolicy(RecurrentActorCriticPolicy):
    """sb3-contrib's recurrent policy, with an LSTM that reads a sequence at once if episodes start at its first step.

    The rollout buffer splits sequences at starts of episodes, so that this holds in training.
    """

    @staticmethod
    def _process_sequence(
        features: Tensor, lstm_states: tuple[Tensor, Tensor], episode_starts: Tensor, lstm: nn.LSTM
    ) -> tuple[Any, Any]:
        """features [n * T, F], states [1, n, W], starts [n * T] -> outputs [n * T, W], the states after."""
        hidden, cell = lstm_states
        starts = episode_starts.reshape(hidden.shape[1], -1).clone()
        kept = 1 - starts[None, :, :1]
        starts[:, 0] = 0
        return RecurrentActorCriticPolicy._process_sequence(features, (kept * hidden, kept * cell), starts, lstm)


@contextlib.contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed torch's and numpy's global generators, which Stable-Baselines3 uses, and restore them afterwards."""
    before = np.random.get_state()  # noqa: NPY002
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        try:
            yield
        finally:
            np.random.set_state(before)  # noqa: NPY002


class PpoState:
    """RecurrentPPO of one seed, as a part of a checkpoint."""

    def __init__(self, ppo: RecurrentPPO) -> None:
        self.ppo = ppo

    def state_dict(self) -> dict[str, Any]:
        return {"policy": self.ppo.policy.state_dict(), "adam": self.ppo.policy.optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.ppo.policy.load_state_dict(state["policy"])
        self.ppo.policy.optimizer.load_state_dict(state["adam"])


def new_ppo(env: TrialVecEnv, config: "GailConfig", seed: int) -> RecurrentPPO:
    """An untrained RecurrentPPO. Its actions have a mean near 0 and a std of .6."""
    widths = [config.width, config.width]
    policy = {
        "lstm_hidden_size": config.width,
        "net_arch": {"pi": widths, "vf": widths},
        "activation_fn": nn.ReLU,
        "log_std_init": -0.5,
    }
    with seeded(seed):
        ppo = RecurrentPPO(
            SequencePolicy,
            env,
            learning_rate=config.policy_rate,
            n_steps=config.steps,
            batch_size=config.minibatch,
            n_epochs=config.epochs,
            gamma=config.gamma,
            policy_kwargs=policy,
            device=config.device,
        )
    ppo.set_logger(Logger(None, []))  # the default logger leaves an empty temporary folder each round
    return ppo
