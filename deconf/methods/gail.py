"""GAIL with memory, the published paper's baseline: PPO trains a recurrent policy on a discriminator's logit.

A discriminator separates the expert's transitions (s, a, s') from the policy's own (Ho and Ermon, 2016). PPO's
environments hide theta and the task's reward. They begin new trials each round, of 512 steps in each environment: one
whole trial or several, where episodes end early, and else the first episodes of one. It learns to match the expert's
mixture over theta; it matches the expert under *this* theta only as far as transitions identify theta.

RecurrentPPO is sb3-contrib's. An episode of PPO is a whole trial, so that the LSTM's state outlives the resets. PPO
trains seeds one after another, each with random numbers of its own; discriminators are trained side by side.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.agents import Checkpoint, LearnedAgent, Stateful
from deconfounded.deconf.core.data import Batch, Draws, Rngs, Signature, as_generators
from deconfounded.deconf.core.layers import Linear, Mlp
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Scales
from deconfounded.deconf.core.sizes import Configuration
from deconfounded.deconf.given import Environments, Given
from deconfounded.deconf.method import uses
from deconfounded.envs.support.errors import InputError
from deconfounded.experts.trials import Trials

if TYPE_CHECKING:
    from deconfounded.deconf.methods.gail_ppo import TrialVecEnv

Space = spaces.Box | spaces.Discrete
Make = Callable[[int, int], Environments]
"""Makes environments for the seed of an index: that many."""


@dataclass(frozen=True)
class GailConfig(Configuration):
    """Hyperparameters for each seed. A round: `steps` in each of `envs`, from new trials; then PPO, then D."""

    width: int = 64
    rounds: int = 60
    envs: int = 16
    steps: int = 512
    epochs: int = 5  # of PPO, over a round's steps
    minibatch: int = 1024  # steps
    gamma: float = 0.99
    policy_rate: float = 1e-3
    discriminator_updates: int = 20  # a round
    discriminator_batch: int = 512  # transitions of each kind
    discriminator_rate: float = 1e-3
    device: str = "cpu"


class Lstm(nn.Module):
    """S LSTMs side by side, for deployment: torch's equations, gates i, f, g, o."""

    def __init__(self, inputs: int, width: int, draws: Draws) -> None:
        super().__init__()
        self.width = width
        self.input, self.recurrent = Linear(inputs, 4 * width, draws), Linear(width, 4 * width, draws)

    def forward(self, x: Tensor, state: Tensor) -> Tensor:
        """x [S, N, I], state [S, N, 2 W] (hidden, cell) -> the next state."""
        hidden, cell = state.chunk(2, -1)
        i, f, g, o = (self.input(x) + self.recurrent(hidden)).chunk(4, -1)
        cell = f.sigmoid() * cell + i.sigmoid() * g.tanh()
        return torch.cat([o.sigmoid() * cell.tanh(), cell], -1)


class PpoHead(ActionHead):
    """Stable-Baselines3's distribution: categorical, or Gaussian with a std that does not depend on features."""

    def __init__(self, width: int, signature: Signature, draws: Draws) -> None:
        super().__init__(width, width, Scales.plain(signature, len(draws)).to(draws.device), draws)
        self.net = Mlp(width, width, signature.actions or signature.action, draws)
        self.log_std = nn.Parameter(torch.zeros(len(draws), 1, signature.action, device=draws.device))

    def _gaussian(self, features: Tensor) -> tuple[Tensor, Tensor]:
        mean = self.net(features)
        return mean, self.log_std.exp().expand_as(mean)


class GailAgent(LearnedAgent):
    """The policies of all seeds that PPO has trained, with a memory that outlives resets."""

    policy: PpoHead

    def __init__(self, lstm: Lstm, policy: PpoHead, scales: Scales) -> None:
        super().__init__(policy)
        self.lstm, self.scales, self.width = lstm, scales, lstm.width

    @classmethod
    def blank(cls, shape: dict[str, Any], scales: Scales, draws: Draws) -> "GailAgent":
        width, signature = shape["width"], scales.signature
        lstm = Lstm(signature.obs + signature.action_features + 1, width, draws)
        return cls(lstm, PpoHead(width, signature, draws), scales)

    def shape(self) -> dict[str, Any]:
        return {"width": self.width}

    def parts(self) -> dict[str, nn.Module]:
        return {"lstm": self.lstm, "policy": self.policy, "scales": self.scales}

    def begin(self, n: int) -> None:
        super().begin(n)
        self._state = torch.zeros(self.seeds, self._n, 2 * self.width, device=self.device)
        self._next: Tensor | None = None  # the state after `act`, until the step takes place

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        super().reset(rngs)
        before = self.policy.signature.action_features
        self._before = torch.zeros(self.seeds, self._n, before + 1, device=self.device)
        self._before[..., -1] = 1  # flags the start of an episode

    def _after(self, obs: Tensor) -> Tensor:
        return self.lstm(torch.cat([self.scales.obs(obs), self._before], -1), self._state)

    def choose(self, obs: Tensor) -> Tensor:
        self._next = self._after(obs)
        return self.policy.sample(self._next[..., : self.width], self._draws)

    def remember(self, step: Batch) -> None:
        after, self._next = self._after(step.obs) if self._next is None else self._next, None
        alive = step.mask[..., None] > 0
        action = self.policy.signature.encode_action(step.action)
        self._state = torch.where(alive, after, self._state)
        self._before = torch.where(alive, F.pad(action, (0, 1)), self._before)

    def remembered(self) -> NDArray[np.float32]:
        return self._state[..., : self.width].flatten(0, 1).cpu().numpy()

    @torch.no_grad()
    def load_policy(self, i: int, policy: Any) -> None:
        """Copy the weights of Stable-Baselines3's policy to seed i."""
        lstm = policy.lstm_actor
        for gate, weight, bias in (
            (self.lstm.input, lstm.weight_ih_l0, lstm.bias_ih_l0),
            (self.lstm.recurrent, lstm.weight_hh_l0, lstm.bias_hh_l0),
        ):
            gate.weight[i], gate.bias[i, 0] = weight.T, bias
        modules = [*policy.mlp_extractor.policy_net, policy.action_net]
        sources = [layer for layer in modules if isinstance(layer, nn.Linear)]
        targets = [layer for layer in self.policy.net if isinstance(layer, Linear)]
        for target, source in zip(targets, sources, strict=True):
            target.weight[i], target.bias[i, 0] = source.weight.T, source.bias
        if not self.policy.signature.actions:
            self.policy.log_std[i, 0] = policy.log_std


class Discriminator(nn.Module):
    """Logits that a transition is the expert's."""

    def __init__(self, width: int, scales: Scales, draws: Draws) -> None:
        super().__init__()
        self.scales, signature = scales, scales.signature
        self.net = Mlp(2 * signature.obs + signature.action_features, width, 1, draws)

    def forward(self, batch: Batch) -> Tensor:
        """Steps [S, N] without a time axis -> [S, N]."""
        inputs = [self.scales.obs(batch.obs), self.scales.encode(batch.action)]
        return self.net(torch.cat([*inputs, self.scales.change(batch.next_obs - batch.obs)], -1))[..., 0]

    def loss(self, expert: Batch, own: Batch) -> Tensor:
        """The binary cross-entropy [S] of the expert's steps against the policy's own."""
        return (F.softplus(-self(expert)) + F.softplus(self(own))).mean(-1) / 2

    @torch.no_grad()
    def reward(self, *step: NDArray[np.float32]) -> NDArray[np.float32]:
        """The logits [N] of transitions (observation, action, next observation); for a discriminator of one seed."""
        obs, action, next_obs = (torch.as_tensor(x, device=self.scales.obs.mean.device)[None] for x in step)
        return self(Batch(obs, action, next_obs, obs[..., 0]))[0].cpu().numpy()

    def of_seed(self, i: int) -> "Discriminator":
        """A copy of the i-th seed's discriminator."""
        single = copy.deepcopy(self)
        for tensor in (*single.parameters(), *single.buffers()):
            tensor.data = tensor.data[i : i + 1]
        return single


def train(
    trials: Trials, environments: Make, space: Space, config: GailConfig, rng: Rngs, monitor: Monitor | None = None
) -> GailAgent:
    """Adversarial imitation, in rounds of PPO and of the discriminator.

    trials: of the expert, in as many equal groups as there are generators in rng. environments: for PPO. space: of
    actions. Raises InputError where sb3-contrib is not installed.
    """
    if find_spec("sb3_contrib") is None:
        raise InputError("gail needs sb3-contrib; install deconfounded-imitation[train]")
    from deconfounded.deconf.methods.gail_ppo import PpoState, TrialVecEnv, new_ppo, seeded

    rngs, monitor, signature = as_generators(rng), monitor or Monitor(), Signature.of(trials)
    seeds, draws = len(rngs), Draws(rngs, config.device)
    expert = Batch.of(trials, seeds, config.device)
    scales = Scales.of(signature, expert)
    discriminator = Discriminator(config.width, scales, draws)
    optimizer = Adam([discriminator], config.discriminator_rate)
    agent = GailAgent.blank({"width": config.width}, scales, draws)
    mean, std = (x.cpu().numpy() for x in (scales.obs.mean, scales.obs.std))

    def vector(i: int) -> "TrialVecEnv":
        reward = discriminator.of_seed(i).reward
        return TrialVecEnv(environments(i, config.envs), space, mean[i], std[i], reward)

    states = [PpoState(new_ppo(vector(i), config, int(rngs[i].integers(2**31)))) for i in range(seeds)]
    named: dict[str, Stateful] = {f"player{i}": state for i, state in enumerate(states)}
    named |= agent.parts()
    checkpoint = Checkpoint(monitor, rngs, discriminator=discriminator, optimizer=optimizer, draws=draws, **named)
    begin = (checkpoint.load() or {"round": 0})["round"]
    for done in range(begin, config.rounds):
        own = []
        for i, state in enumerate(states):
            env = vector(i)
            with seeded(int(rngs[i].integers(2**31))):
                state.ppo.set_env(env)
                state.ppo.learn(config.envs * config.steps)
            own.append([np.concatenate(column) for column in zip(*env.transitions, strict=True)])
            agent.load_policy(i, state.ppo.policy)
        before, action, after = (torch.as_tensor(np.stack(x), device=config.device) for x in zip(*own, strict=True))
        generated = Batch(before, action, after, torch.ones_like(before[..., 0]))[:, None]
        losses = []
        for _ in range(config.discriminator_updates):
            real, fake = (x.steps(x.draw_steps(config.discriminator_batch, draws)) for x in (expert, generated))
            loss = discriminator.loss(real, fake)
            optimizer.step(loss)
            losses.append(loss.mean().item())
        monitor.update(done + 1, config.rounds, {"discriminator": float(np.mean(losses))}, agent)
        checkpoint.save(round=done + 1)
    return agent


@uses(
    *("demonstrations", "exploration"),
    version=2,
    cost=60,
    on_control=GailConfig(discriminator_rate=3e-4),
    on_bandit=GailConfig(
        rounds=150, envs=64, steps=100, minibatch=1600, gamma=0.9, policy_rate=3e-3, discriminator_rate=3e-4
    ),
    smoke={"rounds": 2},
    smoke_bandit={"rounds": 20},
)
def fit(given: Given) -> GailAgent:
    """Train by GAIL on demonstrations and exploration."""
    data, space = given.demonstrations, given.action_space
    return train(data, given.environments, space, given.config, given.rngs, given.monitor)
