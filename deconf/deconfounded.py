"""Deconfounded imitation learning, Tier 2: Algorithm 1 (training) and Algorithm 2 (deployment) of the paper.

q_phi and p_psi learn from exploration that is blind to theta, by Eq. (6). Latents theta_hat_H are inferred on whole
expert trials, and a latent-conditional policy pi_eta(a | s, theta_hat) is cloned. At test time the agent samples
theta_hat from its belief, acts, and updates the belief on what follows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deconf.beliefs import Belief, EvidenceBelief, GruBelief
from deconf.equations import gaussian_kl, imitation_loss, inference_loss, reparametrise
from deconf.nets import (
    ActionHead,
    Batch,
    DynamicsHead,
    Progress,
    Scaler,
    Signature,
    no_progress,
    seeded,
    torch_generator,
)
from envs.task import Array, InputError
from experts.demos import Agent, Trials

Explore = Callable[[Agent | None, np.random.Generator], Trials]
"""Roll out a behaviour (None: uniformly random actions) in fresh environments: trials of exploration."""


@dataclass(frozen=True)
class DeconfoundedConfig:
    """Widths and amounts. Each round explores, then updates belief and dynamics, then the policy."""

    belief: Literal["evidence", "gru"] = "evidence"
    width: int = 64
    latent: int = 4
    beta: float = 1e-3
    warm_up: float = 0.5  # share of inference updates over which beta rises to its value
    rounds: int = 8
    inference_updates: int = 300  # a round
    inference_batch: int = 16  # trials, whose every step is evidence
    inference_steps: int = 2048  # of them, whose next observation is predicted
    imitation_updates: int = 500  # a round, and four times as many at the end
    imitation_batch: int = 1024  # steps
    learning_rate: float = 1e-3
    device: str = "cpu"
    random_share: float = 0.1  # of exploring actions that are uniformly random
    resample: Literal["step", "episode"] = "step"


class DeconfoundedAgent(Agent):
    """Algorithm 2. resample: draw theta_hat anew every step, or once an episode."""

    def __init__(self, belief: Belief, policy: ActionHead, scaler: Scaler, resample: str) -> None:
        self.belief, self.policy, self.scaler, self.resample = belief, policy, scaler, resample

    def begin(self, n: int, rng: np.random.Generator) -> None:
        self._memory = self.belief.start(n)
        self._rng = torch_generator(rng, self._memory.device)
        self._latent: Tensor | None = None

    def reset(self) -> None:
        self._latent = None

    def latent(self) -> Tensor:
        """The theta_hat [N, D] to act under now."""
        if self._latent is None or self.resample == "step":
            self._latent = reparametrise(*self.belief.posterior(self._memory), self._rng)
        return self._latent

    @torch.no_grad()
    def act(self, obs: NDArray[np.float32]) -> Array:
        features = torch.cat([self.scaler(obs), self.latent()], -1)
        return self.policy.sample(features, self._rng).double().cpu().numpy()

    @torch.no_grad()
    def observe(
        self, obs: NDArray[np.float32], action: Array, next_obs: NDArray[np.float32], alive: NDArray[np.bool_]
    ) -> None:
        self._memory = self.belief.update(self._memory, Batch.step(obs, action, next_obs, alive, self._rng.device))


class Explorer(DeconfoundedAgent):
    """The imitator itself, so far, with some random actions; blind to theta but for what its own history tells.

    In every other trial its latents are drawn once an episode from those inferred on expert trials (which is what the
    prior stands for) instead of from the belief, so that each expert's behaviour is tried under each theta.
    """

    def __init__(
        self, belief: Belief, policy: ActionHead, scaler: Scaler, latents: Tensor, random_share: float
    ) -> None:
        super().__init__(belief, policy, scaler, "step")
        self.latents, self.random_share = latents, random_share

    def begin(self, n: int, rng: np.random.Generator) -> None:
        super().begin(n, rng)
        self._numpy, self._blind = rng, torch.arange(n, device=self._rng.device)[:, None] % 2 == 0
        self._drawn = self._draw()

    def _draw(self) -> Tensor:
        n, device = len(self._blind), self._rng.device
        return self.latents[torch.randint(len(self.latents), (n,), generator=self._rng, device=device)]

    def reset(self) -> None:
        self._drawn = self._draw()

    def latent(self) -> Tensor:
        return torch.where(self._blind, self._drawn, super().latent())

    def act(self, obs: NDArray[np.float32]) -> Array:
        action, actions = super().act(obs), self.policy.signature.actions
        if actions:
            other = self._numpy.integers(actions, size=action.shape).astype(float)
        else:
            other = self._numpy.uniform(-1, 1, action.shape)
        return np.where(self._numpy.random((len(action), 1)) < self.random_share, other, action)


def fit(
    trials: Trials,
    explore: Explore,
    config: DeconfoundedConfig,
    rng: np.random.Generator,
    progress: Progress = no_progress,
) -> DeconfoundedAgent:
    """Algorithm 1. trials: of the expert, without theta. explore: see `Explore`; it is called once a round."""
    if config.rounds < 1:
        raise InputError(f"rounds was {config.rounds}; it must be at least 1")
    device = config.device
    expert, signature = Batch.of(trials, device), Signature.of(trials)
    steps = expert.mask.bool()
    first = explore(None, rng)
    if Signature.of(first) != signature:
        raise InputError(f"exploration is {Signature.of(first)}, demonstrations are {signature}; they must agree")
    seen = Batch.of(first, device)
    real = seen.mask.bool()
    scaler = Scaler(torch.cat([seen.obs[real], expert.obs[steps]]))
    change = Scaler((seen.next_obs - seen.obs)[real])
    kind = {"evidence": EvidenceBelief, "gru": GruBelief}[config.belief]
    with seeded(rng):
        belief = kind(config.latent, config.width, signature, scaler, change).to(device)
        dynamics = DynamicsHead(config.latent, config.width, signature, scaler, change).to(device)
        policy = ActionHead(signature.obs + config.latent, config.width, signature).to(device)
    generator = torch_generator(rng, device)
    total = config.rounds * (config.inference_updates + config.imitation_updates) + 4 * config.imitation_updates
    done = 0
    inference = torch.optim.Adam([*belief.parameters(), *dynamics.parameters()], config.learning_rate)
    cooling = torch.optim.lr_scheduler.CosineAnnealingLR(inference, config.rounds * config.inference_updates)
    imitation = torch.optim.Adam(policy.parameters(), config.learning_rate)

    def infer(data: Batch, inferred: int) -> None:
        """One update of phi and psi; `inferred` have gone before."""
        batch = data[torch.randint(len(data), (config.inference_batch,), generator=generator, device=device)]
        keep = batch.mask.bool()
        picked = torch.randint(int(keep.sum()), (config.inference_steps,), generator=generator, device=device)
        mean, std = belief.posterior(belief(batch)[:, :-1][keep][picked])
        real = batch[keep][picked]
        theta_hat = reparametrise(mean, std, generator)
        log_next = dynamics.log_prob(real.obs, real.action, real.next_obs, theta_hat)
        kl = gaussian_kl(mean, std, belief.prior_mean, belief.prior_std)
        warm = min(1.0, inferred / (config.warm_up * config.rounds * config.inference_updates + 1))
        loss = inference_loss(log_next, kl, config.beta * warm)
        _descend(inference, loss)
        cooling.step()
        progress(done, total, {"inference": loss.item()})

    def imitate(mean: Tensor, std: Tensor) -> None:
        """One update of eta, on steps of expert trials whose theta_hat_H is N(mean, std^2) [B, D]."""
        index = torch.randint(len(where), (config.imitation_batch,), generator=generator, device=device)
        trial = where[index, 0]
        theta_hat = reparametrise(mean[trial], std[trial], generator)
        features = torch.cat([scaler(obs[index]), theta_hat], -1)
        log_policy = policy.log_prob(features, action[index])
        loss = imitation_loss(log_policy)
        _descend(imitation, loss)
        progress(done, total, {"imitation": loss.item()})

    where, obs, action = steps.nonzero(), expert.obs[steps], expert.action[steps]
    data = [first]
    latents: Tensor | None = None
    for i in range(config.rounds):
        if latents is not None:
            data.append(explore(Explorer(belief, policy, scaler, latents, config.random_share), rng))
        joined = Batch.of(Trials.concatenate(data), device)
        belief.train()
        for j in range(config.inference_updates):
            done += 1
            infer(joined, i * config.inference_updates + j)
        belief.eval()
        mean, std = final_belief(belief, expert)
        latents = reparametrise(mean, std, generator)
        belief.set_prior(latents)
        for _ in range(config.imitation_updates):
            done += 1
            imitate(mean, std)
    imitation = torch.optim.Adam(policy.parameters(), config.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(imitation, 4 * config.imitation_updates)
    for _ in range(4 * config.imitation_updates):
        done += 1
        imitate(mean, std)
        schedule.step()
    return DeconfoundedAgent(belief, policy, scaler, config.resample)


@torch.no_grad()
def final_belief(belief: Belief, trials: Batch) -> tuple[Tensor, Tensor]:
    """q_phi(theta_hat_H | tau) of whole trials: mean and std [B, D]."""
    memories = []
    for part in torch.arange(len(trials), device=trials.mask.device).split(64):
        batch = trials[part]
        memories.append(belief(batch)[torch.arange(len(part), device=part.device), batch.mask.sum(1).long()])
    return belief.posterior(torch.cat(memories))


def _descend(optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
    optimizer.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_([p for group in optimizer.param_groups for p in group["params"]], 1.0)
    optimizer.step()
