"""Behavioural cloning as robotics trains it today: flow matching over chunks of actions, given a short history.

After Diffusion Policy (Chi et al., 2023, arXiv 2303.04137), which draws a chunk of actions by denoising and executes
its beginning before it draws the next (receding horizon); chunks are ACT's too (Zhao et al., 2023, arXiv 2304.13705).
Flow matching (Lipman et al., 2023, arXiv 2210.02747) takes the place of diffusion, as in pi0 (Black et al., 2024, arXiv
2410.24164): paths are straight, from noise x_0 ~ N(0, 1) to a chunk x_1, with x_tau = (1 - tau) x_0 + tau x_1; there is
no noise schedule, and few steps of integration are enough. It knows demonstrations alone. Its history has its own past
actions, which it takes for the expert's, as `naive_rnn` does: to model the expert's actions better is no cure for that.
The history is cleared at each reset, as is usual in robotics, so that later episodes are no better than the first.

It departs from these papers as follows. Networks are small MLPs of standardised observations, not a U-Net or a
transformer of images. The network predicts the end of the path, E[x_1 | x_tau, history]; the velocity follows from it,
(E[x_1] - x_tau) / (1 - tau). Diffusion Policy reads past observations; here past actions are read too, because theta
shows in how observations answer actions. One action of a chunk is executed, not about half of them: the tasks have
process noise, and actions that ignore it cost most of the score. Discrete actions are vectors of -1 and one 1, to
which noise flows as to numbers, and the action is the largest number's: where the flow is exact, it ends in such
vectors, with the expert's probabilities.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.agents import LearnedAgent
from deconfounded.deconf.core.data import Batch, Draws, Rngs, Source, take, take_steps, trials_of
from deconfounded.deconf.core.drift import split_episodes
from deconfounded.deconf.core.layers import Mlp
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import Scales
from deconfounded.deconf.core.sizes import Configuration
from deconfounded.deconf.equations import masked_mean
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods.sequence_bc import train_sequence
from deconfounded.envs.support.errors import InputError

PHASES = 4  # cosines of tau that the network reads


@dataclass(frozen=True)
class FlowConfig(Configuration):
    """Hyperparameters for each seed; batch counts episodes, from which an update draws `steps`."""

    width: int = 64
    history: int = 16  # past steps that the policy reads
    ahead: int = 8  # actions of a chunk
    executed: int = 1  # of these, before the next chunk is drawn
    integration: int = 5  # steps of the midpoint method from noise to a chunk
    updates: int = 3000
    batch: int = 64
    steps: int = 512
    learning_rate: float = 2e-3
    device: str = "cpu"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.executed > self.ahead:
            raise InputError(f"executed of FlowConfig was {self.executed}; it must be at most ahead, {self.ahead}")


def of_time(tau: Tensor) -> tuple[Tensor, Tensor]:
    """What the network reads of times tau [..., 1]: the share [..., 1] of a point in the end, and phases [..., PHASES].

    The share is that of chunks of unit size; the network learns what differs from it (Karras et al., 2022).
    """
    turns = torch.arange(1, PHASES + 1, device=tau.device) * math.pi
    return tau / (tau.square() + (1 - tau).square()), (tau * turns).cos()


class ChunkFlow(nn.Module):
    """A flow from noise to a chunk of `ahead` actions, given features of a history."""

    def __init__(self, features: int, width: int, ahead: int, scales: Scales, draws: Draws) -> None:
        super().__init__()
        self.signature, self.scaler, self.width, self.ahead = scales.signature, scales.label, width, ahead
        self.chunk = ahead * self.signature.action_features
        self.embed = Mlp(features, width, width, draws)
        self.net = Mlp(self.chunk + PHASES + width, width, self.chunk, draws)

    def encode(self, action: Tensor) -> Tensor:
        """Actions [S, ..., A] -> [S, ..., action_features] of about unit size."""
        return 2 * self.signature.encode_action(action) - 1 if self.signature.actions else self.scaler(action)

    def decode(self, x: Tensor) -> Tensor:
        """The reverse of `encode`; continuous actions are clipped to [-1, 1]."""
        if self.signature.actions:
            return x.argmax(-1, keepdim=True).float()
        return self.scaler.inverse(x).clamp(-1, 1)

    def end(self, x: Tensor, share: Tensor, phases: Tensor, embedded: Tensor) -> Tensor:
        """The expected end [S, N, chunk] of paths that are at x [S, N, chunk] at times of this `share` and `phases`."""
        return torch.addcmul(self.net(torch.cat([x, phases, embedded], -1)), share, x)

    def loss(self, features: Tensor, chunk: Tensor, mask: Tensor, draws: Draws) -> Tensor:
        """The squared error [S] of ends, at random times of random paths to chunks [S, N, ahead, A].

        features [S, N, F], mask [S, N].
        """
        target = self.encode(chunk).flatten(2)
        tau, noise = draws.uniform(target.shape[1], 1), draws.normal(*target.shape[1:])
        error = self.end(torch.lerp(noise, target, tau), *of_time(tau), self.embed(features)) - target
        return masked_mean(error.square().mean(-1), mask)

    def sample(self, features: Tensor, steps: int, draws: Draws) -> Tensor:
        """Draw chunks [S, N, ahead, A], given features [S, N, F]."""
        x, embedded = draws.normal(features.shape[1], self.chunk), self.embed(features)
        tau = torch.arange(2 * steps, device=x.device)[:, None] / (2 * steps)
        times = [(share, phases.expand(*x.shape[:2], -1)) for share, phases in zip(*of_time(tau), strict=True)]
        for i in range(steps):  # of the midpoint method: the velocity is (end - x) / (1 - tau)
            middle = torch.lerp(x, self.end(x, *times[2 * i], embedded), 1 / (2 * steps - 2 * i))
            end = self.end(middle, *times[2 * i + 1], embedded)
            x = torch.add(x, end - middle, alpha=2 / (2 * steps - 2 * i - 1))
        return self.decode(x.unflatten(-1, (self.ahead, -1)))


class FlowAgent(LearnedAgent):
    """A policy of the latest steps of the episode, which draws chunks of actions and executes their beginnings."""

    policy: ChunkFlow  # type: ignore[assignment]

    def __init__(self, policy: ChunkFlow, scales: Scales, history: int, executed: int, integration: int) -> None:
        super().__init__(policy)  # type: ignore[arg-type]
        self.scales, self.history, self.executed, self.integration = scales, history, executed, integration

    @classmethod
    def blank(cls, shape: dict[str, Any], scales: Scales, draws: Draws) -> "FlowAgent":
        signature = scales.signature
        features = signature.obs + shape["history"] * (signature.obs + signature.action_features + 1)
        policy = ChunkFlow(features, shape["width"], shape["ahead"], scales, draws)
        return cls(policy, scales, shape["history"], shape["executed"], shape["integration"])

    def shape(self) -> dict[str, Any]:
        sizes = {"history": self.history, "executed": self.executed, "integration": self.integration}
        return {"width": self.policy.width, "ahead": self.policy.ahead, **sizes}

    def parts(self) -> dict[str, nn.Module]:
        return {"policy": self.policy, "scales": self.scales}

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        super().reset(rngs)
        signature = self.policy.signature
        width = signature.obs + signature.action_features + 1
        self._past = torch.zeros(self.seeds, self._n, self.history, width, device=self.device)
        self._chunk = torch.empty(0)
        self._left = 0

    def before(self, obs: Tensor, action: Tensor, took_place: Tensor) -> Tensor:
        """Features [..., O + F + 1] of past steps; zeros where took_place [...] is 0."""
        took_place = took_place[..., None].float()
        return torch.cat([self.scales.obs(obs), self.scales.encode(action), took_place], -1) * took_place

    def remembered(self) -> NDArray[np.float32]:
        return self._past.flatten(0, 1).flatten(1).cpu().numpy()

    def choose(self, obs: Tensor) -> Tensor:
        if not self._left:
            features = torch.cat([self.scales.obs(obs), self._past.flatten(2)], -1)
            self._chunk, self._left = self.policy.sample(features, self.integration, self._draws), self.executed
        self._left -= 1
        return self._chunk[:, :, self.executed - 1 - self._left]

    def remember(self, step: Batch) -> None:
        new = self.before(step.obs, step.action, step.mask)
        longer = torch.cat([new[:, :, None], self._past[:, :, :-1]], 2)
        self._past = torch.where(step.mask[..., None, None] > 0, longer, self._past)

    def loss(self, episodes: Batch, label: Tensor, steps: int | None, draws: Draws) -> Tensor:
        """The loss [S] of chunks of labels [S, B, T, A] from so many steps of episodes [S, B, T] on; None: from all."""
        index, length = episodes.draw_steps(steps, draws), episodes.mask.shape[2]
        back, ahead = (torch.arange(n, device=index.device) for n in (self.history, self.policy.ahead))
        past = index[..., None] - 1 - back
        earlier = [take_steps(x, past.clamp(min=0).flatten(1)) for x in (episodes.obs, episodes.action)]
        obs, action = (x.unflatten(1, past.shape[1:]) for x in earlier)
        before = self.before(obs, action, (index % length)[..., None] > back)
        features = torch.cat([self.scales.obs(take_steps(episodes.obs, index)), before.flatten(2)], -1)
        episode = index // length
        end = episode * length + take(episodes.mask.sum(2).long(), episode) - 1
        then = (index[..., None] + ahead).minimum(end[..., None]).clamp(min=0)  # the last action is repeated
        chunk = take_steps(label, then.flatten(1)).unflatten(1, then.shape[1:])
        return self.policy.loss(features, chunk, take_steps(episodes.mask, index), draws)


class FlowTrainer:
    """Trains by flow matching, an update a batch of episodes."""

    def __init__(self, agent: FlowAgent, config: FlowConfig, draws: Draws, monitor: Monitor) -> None:
        self.agent, self.config, self.draws, self.monitor = agent, config, draws, monitor
        self.done, self.total = 0, config.updates
        self.optimizer = Adam([agent.policy], config.learning_rate, config.updates)

    def learn(self, batch: Batch, label: Tensor) -> None:
        """Take one update."""
        loss = self.agent.loss(batch, label, self.config.steps, self.draws)
        self.optimizer.step(loss)
        self.done += 1
        self.monitor.update(self.done, self.total, {"imitation": loss.mean().item()}, self.agent)


def train(trials: Source, config: FlowConfig, rng: Rngs, monitor: Monitor | None = None) -> FlowAgent:
    """Clone the expert's trials, which are in as many equal groups as there are generators in rng."""
    given: list[Draws] = []

    def new_agent(scales: Scales, draws: Draws) -> FlowAgent:
        given.append(draws)
        shape = {name: getattr(config, name) for name in ("width", "history", "ahead", "executed", "integration")}
        return FlowAgent.blank(shape, scales, draws)

    def new_trainer(agent: FlowAgent, steps: int, monitor: Monitor) -> FlowTrainer:
        return FlowTrainer(agent, config, given[0], monitor)

    episodes = (lambda: split_episodes(trials_of(trials))) if callable(trials) else split_episodes(trials)
    return train_sequence(episodes, config, rng, new_agent, new_trainer, monitor)


@uses(
    "demonstrations",
    version=2,
    cost=2,
    on_control=FlowConfig(),
    on_bandit=FlowConfig(updates=1500, executed=1, ahead=4, history=32),
    smoke={"updates": 400},
    smoke_bandit={"updates": 400},
)
def fit(given: Given) -> FlowAgent:
    """Clone the demonstrations."""
    return train(given.source, given.config, given.rngs, given.monitor)
