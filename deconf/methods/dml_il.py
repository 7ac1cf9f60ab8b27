"""Instrumental regression, DML-IL (Shao et al., 2025, arXiv 2502.07656): the history of k steps ago as an instrument.

The paper's expert sees theta, and its actions also have noise that moves the state and lasts for k steps. Such noise
makes actions and recent states depend on each other in a way that no policy has. It is independent of the history up to
k steps ago, h_{t-k}. So the policy solves E[a_t - pi(h_t) | h_{t-k}] = 0, in two stages: a roll-out model, a mixture of
Gaussians, learns s_t given h_{t-k}; then the action taken is regressed on roll-outs, not on the states that the noise
moved. Each half of the trials has the roll-out model of the other half (cross-fitting, the "double machine learning").
Tier 1: demonstrations alone.

Where this departs from the paper: the policy reads s_t and features of a sum of evidence over the transitions up to
t - k (`EvidenceBelief`), actions too, not a window of observations. (A GRU in place of the sum predicts a_t itself, and
solves the moment without s_t: it learns no feedback.) Two independent roll-outs give an unbiased gradient of the
squared moment (Hartford et al., 2017); the released code takes one, which counts the spread of roll-outs as an error
too. Half of the trials is a fold, not a tenth. In the first k steps of an episode states are taken as they are, and the
history ends with the episode before. The policy is the conditional mean, without noise of its own; for discrete
actions, probabilities.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.agents import Checkpoint, LearnedAgent
from deconfounded.deconf.core.beliefs import EvidenceBelief
from deconfounded.deconf.core.data import Batch, Draws, Rngs, Signature, as_generators, joined, take
from deconfounded.deconf.core.layers import Mlp
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Scales, gaussian_log_prob, sample_index
from deconfounded.deconf.core.sizes import Configuration
from deconfounded.deconf.equations import imitation_loss, masked_mean
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.experts.trials import Trials


@dataclass(frozen=True)
class DmlConfig(Configuration):
    """Hyperparameters for each seed; the policy has as many updates as both roll-out models together."""

    width: int = 64
    latent: int = 16  # features of a history
    lag: int = 1  # k: for how many steps the noise lasts
    components: int = 5  # of a mixture
    updates: int = 3000  # of all networks
    batch: int = 16  # trials, whose every step is evidence
    shortest: float = 1 / 16  # least share of these trials that an update reads: see Batch.beginnings
    steps: int = 1024  # whose observation or action is predicted, of these trials
    learning_rate: float = 3e-3
    device: str = "cpu"


class History(nn.Module):
    """Features of h_{t-k}, and a network of them and of an observation."""

    def __init__(self, latent: int, width: int, scales: Scales, draws: Draws) -> None:
        super().__init__()
        self.memory = EvidenceBelief(latent, width, scales, draws)

    def inputs(self, memory: Tensor, obs: Tensor) -> Tensor:
        """Of memories [..., M] and scaled observations [..., O]."""
        return torch.cat([obs, self.memory.posterior(memory)[0]], -1)

    def at(self, batch: Batch, origin: Tensor) -> Tensor:
        """Memories [S, K, M] before steps [S, K] of a batch."""
        return take(self.memory(batch)[:, :, :-1].flatten(1, 2), origin)


class Rollouts(History):
    """p(s_t | h_{t-k}), a mixture of Gaussians of scaled observations."""

    def __init__(self, latent: int, width: int, components: int, scales: Scales, draws: Draws) -> None:
        super().__init__(latent, width, scales, draws)
        obs, self.components = scales.signature.obs, components
        self.net = Mlp(obs + latent, width, components * (1 + 2 * obs), draws)

    def forward(self, memory: Tensor, obs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Logits [..., K], means and stds [..., K, O], of memories [..., M] and scaled observations [..., O]."""
        out = self.net(self.inputs(memory, obs))
        logits, rest = out[..., : self.components], out[..., self.components :].unflatten(-1, (self.components, -1))
        change, raw = rest.chunk(2, -1)
        return logits, obs[..., None, :] + change, F.softplus(raw) + 0.01

    def log_prob(self, memory: Tensor, obs: Tensor, then: Tensor) -> Tensor:
        """Of later observations [..., O]: [...]."""
        logits, mean, std = self(memory, obs)
        likely = gaussian_log_prob(then[..., None, :].expand_as(mean), mean, std)
        return (F.log_softmax(logits, -1) + likely).logsumexp(-1)

    def sample(self, memory: Tensor, obs: Tensor, draws: Draws) -> Tensor:
        """Later observations [S, K, O]."""
        logits, mean, std = self(memory, obs)
        index = sample_index(F.softmax(logits, -1), draws)[..., None, None]
        mean, std = (torch.take_along_dim(x, index, -2)[..., 0, :] for x in (mean, std))
        return mean + std * draws.normal(*mean.shape[1:])


class MeanHead(ActionHead):
    """A policy that is a mean: of scaled actions, or of one-hot actions."""

    def mean(self, features: Tensor) -> Tensor:
        """[S, ..., A]; or probabilities [S, ..., K]."""
        return F.softmax(self.net(features), -1) if self.signature.actions else self._gaussian(features)[0]

    def residual(self, features: Tensor, action: Tensor) -> Tensor:
        """Actions [S, ..., A], scaled or one-hot, less the policy's mean."""
        label = self.signature.encode_action(action) if self.signature.actions else self.scaler(action)
        return label - self.mean(features)

    def sample(self, features: Tensor, draws: Draws) -> Tensor:
        if self.signature.actions:
            return super().sample(features, draws)
        return self.scaler.inverse(self.mean(features)).clamp(-1, 1)


class DmlAgent(LearnedAgent):
    """A policy of the observation and of the agent's transitions but the last `lag` of the episode."""

    def __init__(self, history: History, policy: MeanHead, lag: int) -> None:
        super().__init__(policy)
        self.history, self.lag = history, lag

    @classmethod
    def new(cls, latent: int, width: int, lag: int, scales: Scales, draws: Draws) -> "DmlAgent":
        """An untrained agent."""
        history = History(latent, width, scales, draws)
        return cls(history, MeanHead(scales.signature.obs + latent, width, scales, draws), lag)

    @classmethod
    def blank(cls, shape: dict[str, Any], scales: Scales, draws: Draws) -> "DmlAgent":
        return cls.new(shape["latent"], shape["width"], shape["lag"], scales, draws)

    def shape(self) -> dict[str, Any]:
        memory = self.history.memory
        return {"latent": memory.prior_mean.shape[-1], "width": memory.width, "lag": self.lag}

    def parts(self) -> dict[str, nn.Module]:
        return {"history": self.history, "policy": self.policy}

    def begin(self, n: int) -> None:
        super().begin(n)
        self._memory = self.history.memory.start(self._n)

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        super().reset(rngs)
        self._memories = deque([self._memory], self.lag + 1)  # the first is that of h_{t-k}

    def choose(self, obs: Tensor) -> Tensor:
        scaled = self.history.memory.inputs.obs(obs)
        return self.policy.sample(self.history.inputs(self._memories[0], scaled), self._draws)

    def remember(self, step: Batch) -> None:
        self._memory = self.history.memory.update(self._memory, step)
        self._memories.append(self._memory)

    @torch.no_grad()
    def remembered(self) -> NDArray[np.float32]:
        return self.history.memory.posterior(self._memory)[0].flatten(0, 1).cpu().numpy()


def sources(trials: Trials, lag: int, seeds: int, device: str | torch.device = "cpu") -> Tensor:
    """The step where h_{t-k} ends of each of `Batch.of` [S, B, T]: `lag` steps before, in the same episode."""
    number = np.broadcast_to(np.arange(trials.mask.shape[1])[:, None], trials.mask.shape)
    episode = joined(number[..., None], trials.mask, seeds, device)[..., 0]
    steps = torch.arange(episode.shape[2], device=device).expand_as(episode)
    first = (episode[:, :, 1:] != episode[:, :, :-1]) * steps[:, :, 1:]
    return torch.maximum(steps - lag, torch.cat([steps[:, :, :1], first], 2).cummax(2).values)


def moment_loss(residuals: Sequence[Tensor], mask: Tensor) -> Tensor:
    """An unbiased estimate [S] of E || E[a - pi | h_{t-k}] ||^2, but for a constant, from two independent roll-outs.

    residuals: a - pi [S, K, A] in each. mask [S, K].
    """
    first, second = residuals
    return masked_mean((first * second).sum(-1), mask)


def train(trials: Trials, config: DmlConfig, rng: Rngs, monitor: Monitor | None = None) -> DmlAgent:
    """Train two roll-out models, then the policy; trials are in as many equal groups as there are generators in rng."""
    rngs, monitor = as_generators(rng), monitor or Monitor()
    data, draws = Batch.of(trials, len(rngs), config.device), Draws(rngs, config.device)
    source = sources(trials, config.lag, len(rngs), config.device)
    scales = Scales.of(Signature.of(trials), data)
    agent = DmlAgent.new(config.latent, config.width, config.lag, scales, draws)
    history, policy = agent.history, agent.policy
    assert isinstance(policy, MeanHead)
    models = [Rollouts(config.latent, config.width, config.components, scales, draws) for _ in range(2)]
    halves = [torch.arange(len(data), device=draws.device)[min(i, len(data) - 1) :: 2] for i in range(2)]
    each = max(1, config.updates // 4)
    stage1 = [Adam([model], config.learning_rate, each) for model in models]
    stage2 = Adam([history, policy], config.learning_rate, config.updates - 2 * each)
    networks = {**agent.parts(), "model0": models[0], "model1": models[1]}
    optimizers = {"stage1_0": stage1[0], "stage1_1": stage1[1], "stage2": stage2}
    checkpoint = Checkpoint(monitor, rngs, **networks, **optimizers, draws=draws)

    def drawn(update: int, half: Tensor, share: int) -> tuple[Batch, Tensor, Tensor]:
        """Trials of a half, a share of the usual number; so many of their steps [S, K], and where h_{t-k} ends."""
        index = half[draws.integers(len(half), -(-config.batch // share))]
        batch, ends = data.beginnings(update, config.shortest).trials(index), take(source, index)
        index, length = batch.draw_steps(-(-config.steps // share), draws), batch.mask.shape[2]
        flat = ends[..., :length] + length * torch.arange(len(batch), device=draws.device)[:, None]
        return batch, index, flat.flatten(1).gather(1, index)

    def loss_of_model(update: int, i: int) -> Tensor:
        """Of the i-th roll-out model, on trials of the other half [S]."""
        batch, index, origin = drawn(update, halves[1 - i], 1)
        now, then = batch.steps(origin), batch.steps(index)
        likely = models[i].log_prob(models[i].at(batch, origin), scales.obs(now.obs), scales.obs(then.obs))
        old = then.mask * (index - origin == config.lag)
        return imitation_loss(likely, old) + models[i].memory.innovation_loss(now)

    def loss_of_policy(update: int) -> Tensor:
        """On trials of both halves [S]."""
        states: list[Tensor] = []
        parts = [drawn(update, half, 2) for half in halves]
        for model, (own, index, origin) in zip(models, parts, strict=True):
            obs, then, young = own.steps(origin).obs, own.steps(index).obs, index - origin < config.lag
            with torch.no_grad():
                memory = model.at(own, origin)
                rolled = [model.sample(memory, scales.obs(obs), draws) for _ in range(2)]
            states.append(torch.stack([torch.where(young[..., None], scales.obs(then), x) for x in rolled]))
        (batch, index, origin), (other, later, before) = parts
        beyond = batch.mask[0].numel()  # steps of the second half come after these
        batch, index = batch.joined(other), torch.cat([index, later + beyond], 1)
        origin = torch.cat([origin, before + beyond], 1)
        step, memory = batch.steps(index), history.at(batch, origin)
        residuals = [policy.residual(history.inputs(memory, obs), step.action) for obs in torch.cat(states, 2)]
        return moment_loss(residuals, step.mask) + history.memory.innovation_loss(step)

    for done in range((checkpoint.load() or {"done": 0})["done"], config.updates):
        if done < 2 * each:
            name, optimizer, loss = "rollouts", stage1[done % 2], loss_of_model(done, done % 2)
        else:
            name, optimizer, loss = "imitation", stage2, loss_of_policy(done)
        optimizer.step(loss)
        monitor.update(done + 1, config.updates, {name: loss.mean().item()}, agent)
        checkpoint.save(done=done + 1)
    return agent


@uses(
    "demonstrations",
    cost=4,
    on_control=DmlConfig(),
    on_bandit=DmlConfig(batch=64, shortest=1.0, updates=2000),
    smoke={"updates": 400},
    smoke_bandit={"updates": 400},
)
def fit(given: Given) -> DmlAgent:
    """Train on the demonstrations."""
    return train(given.demonstrations, given.config, given.rngs, given.monitor)
