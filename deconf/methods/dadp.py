"""Cross-episode context, after DADP (Wang et al., 2026, arXiv 2602.04037). Tier 1: demonstrations alone.

The idea: a latent that is inferred from the steps just before encodes what passes (a speed, a contact) beside what
stays (theta). So it is inferred from *another episode* under the same theta, which shares theta alone with this one.
First the encoder is trained, so that its latent predicts the next observation and the action of steps in other episodes
of the trial; then a policy pi(a | s, latent) is cloned. In deployment the context is the agent's earlier episodes of
the trial. In the first episode there is none, and so an episode never adapts to what happens in it.

Where this departs from the paper: the context is any number of whole episodes, not 16 steps of one, since theta shows
here through noise and needs many steps. Without a context the latent is 0, and the policy is trained for that too. The
encoder is a sum of evidence over transitions (`EvidenceBelief`), not a transformer; the policy is that of the other
clones, not a diffusion from noise shifted by the latent; likelihoods stand for squared errors. The data are of an
expert that knows its domain, as in the paper.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.agents import Checkpoint, LearnedAgent
from deconfounded.deconf.core.beliefs import EvidenceBelief
from deconfounded.deconf.core.data import Batch, Draws, Rngs, Signature, as_generators, take, trials_of
from deconfounded.deconf.core.drift import split_episodes
from deconfounded.deconf.core.dynamics import DynamicsHead
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Scales
from deconfounded.deconf.core.sizes import Configuration
from deconfounded.deconf.equations import imitation_loss
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.experts.trials import Trials


@dataclass(frozen=True)
class DadpConfig(Configuration):
    """Hyperparameters for each seed: of the encoder, then of the policy."""

    width: int = 64
    latent: int = 8
    inverse: float = 1.0  # weight of the likelihood of actions, beside that of next observations
    inference_updates: int = 2000  # of the encoder
    inference_batch: int = 16  # trials, whose every step is context
    inference_steps: int = 1024  # that are predicted, of these trials
    inference_rate: float = 3e-3
    imitation_updates: int = 2000  # of the policy
    imitation_batch: int = 1024  # steps
    imitation_rate: float = 2e-3
    device: str = "cpu"


class DadpAgent(LearnedAgent):
    """A policy of the observation and of a latent, which is inferred from the trial's earlier episodes."""

    def __init__(self, encoder: EvidenceBelief, policy: ActionHead) -> None:
        super().__init__(policy)
        self.encoder = encoder

    @classmethod
    def new(cls, latent: int, width: int, scales: Scales, draws: Draws) -> "DadpAgent":
        """An untrained agent."""
        encoder = EvidenceBelief(latent, width, scales, draws)
        return cls(encoder, ActionHead(encoder.inputs.obs_width + latent + 1, width, scales, draws))

    @classmethod
    def blank(cls, shape: dict[str, Any], scales: Scales, draws: Draws) -> "DadpAgent":
        return cls.new(shape["latent"], shape["width"], scales, draws)

    def shape(self) -> dict[str, Any]:
        return {"latent": self.encoder.prior_mean.shape[-1], "width": self.encoder.width}

    def parts(self) -> dict[str, nn.Module]:
        return {"encoder": self.encoder, "policy": self.policy}

    def begin(self, n: int) -> None:
        super().begin(n)
        self._memory = self.encoder.start(self._n)

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        super().reset(rngs)
        self._context = self._memory

    def latent(self, memory: Tensor) -> Tensor:
        """The latent [..., D] of a context's memory [..., M]; 0 without a context."""
        return self.encoder.posterior(memory)[0] * (memory[..., -1:] > 0)

    def inputs(self, obs: Tensor, memory: Tensor) -> Tensor:
        """The policy's features: the observation, the latent, and whether there is a context."""
        return torch.cat([self.encoder.inputs.obs(obs), self.latent(memory), (memory[..., -1:] > 0).float()], -1)

    def choose(self, obs: Tensor) -> Tensor:
        return self.policy.sample(self.inputs(obs, self._context), self._draws)

    def remember(self, step: Batch) -> None:
        self._memory = self.encoder.update(self._memory, step)

    @torch.no_grad()
    def remembered(self) -> NDArray[np.float32]:
        """The latent of all that was seen, on which the next episode is acted."""
        return self.latent(self._memory).flatten(0, 1).cpu().numpy()


def contexts(memories: Tensor, draws: Draws) -> Tensor:
    """Memories [S, B, E, M] of a context for each episode: of 0 to E - 1 *other* episodes of its trial, at random.

    memories [S, B, E, M]: of each episode alone.
    """
    trials, episodes = memories.shape[1:3]
    own = torch.eye(episodes, device=memories.device)
    rank = (draws.uniform(trials, episodes, episodes) + 2 * own).argsort(-1).argsort(-1)  # its own is the last
    chosen = rank < draws.integers(episodes, trials, episodes, 1)
    return (memories[:, :, None] * chosen[..., None]).sum(3)


def train(trials: Trials, config: DadpConfig, rng: Rngs, monitor: Monitor | None = None) -> DadpAgent:
    """Train the encoder, then the policy, on expert trials, in as many equal groups as there are generators in rng."""
    rngs, monitor, trials = as_generators(rng), monitor or Monitor(), trials_of(trials)
    each, steps = trials.mask.shape[1:]  # episodes of a trial, steps of an episode
    data, draws = Batch.of(split_episodes(trials), len(rngs), config.device), Draws(rngs, config.device)
    scales = Scales.of(Signature.of(trials), data)
    agent = DadpAgent.new(config.latent, config.width, scales, draws)
    encoder, policy = agent.encoder, agent.policy
    encoder.longest.fill_((each - 1) * steps)  # of a context
    forward = DynamicsHead(config.latent, config.width, encoder.inputs, draws)
    backward = ActionHead(2 * encoder.inputs.obs_width + config.latent, config.width, scales, draws)
    inference = Adam([encoder, forward, backward], config.inference_rate, config.inference_updates)
    imitation = Adam([policy], config.imitation_rate, config.imitation_updates)
    total = config.inference_updates + config.imitation_updates
    networks: dict[str, Any] = {**agent.parts(), "forward": forward, "backward": backward}
    checkpoint = Checkpoint(monitor, rngs, **networks, inference=inference, imitation=imitation, draws=draws)

    def inference_loss() -> Tensor:
        """Of the encoder, [S]."""
        index = draws.integers(len(data) // each, config.inference_batch)
        own = data.trials((each * index[..., None] + torch.arange(each, device=index.device)).flatten(1))
        memories = encoder(own)[:, :, -1].unflatten(1, (-1, each))
        index = own.draw_steps(config.inference_steps, draws)
        latent = agent.latent(take(contexts(memories, draws).flatten(1, 2), index // steps))
        step = own.steps(index)
        obs, then = encoder.inputs.obs(step.obs), encoder.inputs.obs(step.next_obs)
        likely = forward.log_prob(step.obs, step.action, step.next_obs, latent)[..., 0]
        likely = likely + config.inverse * backward.log_prob(torch.cat([obs, then, latent], -1), step.action)
        return imitation_loss(likely, step.mask) + encoder.innovation_loss(step)

    @torch.no_grad()
    def remembered(part: int = 256) -> Tensor:
        """The memory [S, B, E, M] of each episode alone; in parts of so many, to save memory."""
        indices = torch.arange(len(data), device=data.mask.device).split(part)
        return torch.cat([encoder(data[:, i])[:, :, -1] for i in indices], 1).unflatten(1, (-1, each))

    def loss_of_policy(memories: Tensor) -> Tensor:
        """[S]; memories [S, B, E, M]: of each episode alone."""
        index = data.draw_steps(config.imitation_batch, draws)
        step = data.steps(index)
        with torch.no_grad():
            features = agent.inputs(step.obs, take(contexts(memories, draws).flatten(1, 2), index // steps))
        return imitation_loss(policy.log_prob(features, step.action), step.mask)

    memories = None
    for done in range((checkpoint.load() or {"done": 0})["done"], total):
        if done < config.inference_updates:
            name, optimizer, loss = "inference", inference, inference_loss()
        else:
            memories = remembered() if memories is None else memories
            name, optimizer, loss = "imitation", imitation, loss_of_policy(memories)
        optimizer.step(loss)
        monitor.update(done + 1, total, {name: loss.mean().item()}, agent)
        checkpoint.save(done=done + 1)
    return agent


@uses(
    "demonstrations",
    cost=3,
    on_control=DadpConfig(),
    on_bandit=DadpConfig(inference_updates=500, imitation_updates=500),
    smoke={"inference_updates": 100, "imitation_updates": 400},
)
def fit(given: Given) -> DadpAgent:
    """Train on the demonstrations."""
    return train(given.demonstrations, given.config, given.rngs, given.monitor)
