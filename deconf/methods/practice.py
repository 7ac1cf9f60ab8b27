"""The side of Stable-Baselines3 of GAIL: theta-blind environments, whose episode is a whole trial, and its policy."""

from __future__ import annotations

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
"""Of observations [N, O], actions [N, A] and what followed [N, O]: [N]. The task's own reward is told to nobody."""


class Practice(BatchVecEnv):
    """The environments of a vector in which a whole trial is one episode: `done` says that the trial is over.

    What is observed [N, O + F + 1]: the observation, scaled; the action before it, one-hot if discrete; and whether an
    episode has just begun, when there is no such action. `transitions` keeps what took place since the last reset.
    """

    def __init__(
        self, environments: Environments, space: Any, mean: NDArray[Any], std: NDArray[Any], reward: Reward
    ) -> None:
        """space: of actions. mean, std [O]: of the expert's observations."""
        self._environments, self._mean, self._std, self._reward = environments, mean, std, reward
        width, self._actions = action_sizes(space)
        self._features = self._actions or width
        seen = spaces.Box(-np.inf, np.inf, (len(mean) + self._features + 1,), np.float32)
        super().__init__(environments.n, seen, space)

    def reset(self) -> Any:
        """Trials start, under the thetas of these environments' seeds."""
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
        then, following, over, done = self._environments.step(action)
        reward = self._reward(obs, action, then)
        self.transitions.append((obs, action, then))
        before = np.eye(self._actions)[action[:, 0].astype(int)] if self._actions else action
        self._obs = then
        infos: list[dict[str, Any]] = [{} for _ in done]
        ends = self._observation(before, np.zeros(len(done), bool))
        for i in np.flatnonzero(done):
            infos[i] = {"terminal_observation": ends[i], "TimeLimit.truncated": True}  # life would go on
        self._obs = following
        return self._observation(before, over), reward, done, infos

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Its seeds are given when it is made."""
        return [None] * self.num_envs


class WholePolicy(RecurrentActorCriticPolicy):
    """sb3-contrib's, whose LSTM reads a sequence at once if an episode starts with it, instead of step by step.

    Its buffer cuts sequences where episodes start, so that this is how all of them are trained.
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
def numbers(seed: int) -> Iterator[None]:
    """Stable-Baselines3 draws from torch's and numpy's global generators: seeded here, and put back after."""
    before = np.random.get_state()  # noqa: NPY002
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        try:
            yield
        finally:
            np.random.set_state(before)  # noqa: NPY002


class Player:
    """RecurrentPPO of one seed: what of it is to be kept in a checkpoint."""

    def __init__(self, ppo: RecurrentPPO) -> None:
        self.ppo = ppo

    def state_dict(self) -> dict[str, Any]:
        return {"policy": self.ppo.policy.state_dict(), "adam": self.ppo.policy.optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.ppo.policy.load_state_dict(state["policy"])
        self.ppo.policy.optimizer.load_state_dict(state["adam"])


def new_ppo(env: Practice, config: GailConfig, seed: int) -> RecurrentPPO:
    """Untrained. Its mean is near 0 and its std .6 at first, for actions in [-1, 1]."""
    widths = [config.width, config.width]
    policy = {
        "lstm_hidden_size": config.width,
        "net_arch": {"pi": widths, "vf": widths},
        "activation_fn": nn.ReLU,
        "log_std_init": -0.5,
    }
    with numbers(seed):
        ppo = RecurrentPPO(
            WholePolicy,
            env,
            learning_rate=config.policy_rate,
            n_steps=config.steps,
            batch_size=config.minibatch,
            n_epochs=config.epochs,
            gamma=config.gamma,
            policy_kwargs=policy,
            device=config.device,
        )
    ppo.set_logger(Logger(None, []))  # its own would leave an empty folder in the temporary one, each round
    return ppo
