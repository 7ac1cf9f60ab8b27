"""Deconfounded imitation learning, Tier 2: Algorithm 1 (training) and Algorithm 2 (deployment) of the paper.

A latent-variable model is trained on exploration that is blind to theta. It infers latents theta_hat_H on whole expert
trials, given which a latent-conditional policy pi_eta(a | s, theta_hat) is cloned. At test time the agent samples
theta_hat from its belief (posterior sampling), acts, and updates the belief on the transition.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.agents import Checkpoint, LearnedAgent, ramp
from deconfounded.deconf.core.data import Batch, Draws, Rngs, Signature, Source, as_generators, take, trials_of
from deconfounded.deconf.core.deployment import Latents, Way, acted_on, deployments
from deconfounded.deconf.core.drift import choose_kept, split_episodes
from deconfounded.deconf.core.models import LatentModel, final_belief, new_model
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Scales
from deconfounded.deconf.core.online import OnlineBelief, online_belief, reader
from deconfounded.deconf.core.sizes import Configuration
from deconfounded.deconf.equations import imitation_loss
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.envs.support.errors import InputError
from deconfounded.experts.rollout import Agent, Trials

Explore = Callable[[Agent | None], Trials]
"""Rolls out a behaviour (None: uniformly random actions) under fresh thetas: as many trials for each seed."""


@dataclass(frozen=True)
class DeconfoundedConfig(Configuration):
    """Hyperparameters for each seed. Each round explores, then updates the model, the online belief and the policy.

    The discrete model has an exact likelihood: beta, warm_up, inference_steps and fit_prior do not apply to it.
    """

    model: Literal["innovations", "evidence", "forgetting", "gru", "discrete"] = "innovations"
    width: int = 64
    latent: int = 8  # dimensions of theta_hat, or its number of values if discrete
    beta: float = 1e-3
    warm_up: float = 0.5  # share of inference updates over which beta rises to its value
    rounds: int = 8
    inference_updates: int = 500  # a round
    inference_batch: int | None = 16  # trials, whose every step is evidence; None: all there are
    shortest: float = 1 / 16  # least share of these trials that an update reads: see Batch.beginnings
    inference_steps: int | None = 1024  # whose next observation is predicted, of these trials; None: all
    inference_rate: float = 3e-3
    imitation_updates: int = 250  # a round
    final_updates: int = 2000  # of the policy, after the last round
    imitation_batch: int | None = 1024  # steps; None: all there are
    imitation_rate: float = 2e-3
    cooled: bool = True  # learning rates fall to 0 along a cosine
    accumulate: bool = True  # train on exploration of all rounds; else of each alone, and on fresh demonstrations
    fit_prior: bool = True  # to the latents of expert trials (empirical Bayes); else it is N(0, 1)
    drifts: bool = False  # theta changes between the episodes of a trial: see deconf/core/drift.py
    device: str = "cpu"
    random_share: float = 0.1  # of exploration's actions that are uniformly random; 1: without the imitator


class DeconfoundedAgent(LearnedAgent):
    """Algorithm 2, posterior sampling.

    online: its belief in the course of a trial; None: that is the model's own. way: how it takes theta_hat from its
    belief (`core/deployment.py`).
    """

    def __init__(
        self, model: LatentModel, policy: ActionHead, online: OnlineBelief | None = None, way: Way = "step"
    ) -> None:
        super().__init__(policy)
        self.model, self.online, self.way = model, online, way

    @staticmethod
    def new(kind: str, latent: int, width: int, scales: Scales, draws: Draws) -> "DeconfoundedAgent":
        """An untrained agent. Raises InputError for an unknown kind of model."""
        model = new_model(kind, latent, width, scales, draws)
        policy = ActionHead(model.inputs.obs_width + latent, width, scales, draws)
        return DeconfoundedAgent(model, policy, online_belief(model, draws))

    @classmethod
    def blank(cls, shape: dict[str, Any], scales: Scales, draws: Draws) -> "DeconfoundedAgent":
        sizes = (shape["model"], shape["latent"], shape["width"])
        agent = cls.new(*sizes, scales, draws)
        agent.way = shape["way"]
        return agent

    def shape(self) -> dict[str, Any]:
        model = self.model
        return {"model": model.kind, "latent": model.latent, "width": model.width, "way": self.way}

    def parts(self) -> dict[str, nn.Module]:
        own: dict[str, nn.Module] = {"model": self.model, "policy": self.policy}
        return own | {"online": self.online} if self.online else own

    def begin(self, n: int) -> None:
        super().begin(n)
        self._memory = self.model.start(self._n)

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        super().reset(rngs)
        self._latent: Tensor | None = None
        self._memory = self.model.forget(self._memory)

    def belief(self) -> tuple[Latents[Tensor, Draws], Tensor]:
        """What gives latents, and the belief [S, N, P] given the trial so far."""
        if self.online is None:
            return self.model, self.model.belief(self._memory)
        return self.online, self.online(reader(self.model), self._memory)

    def latent(self) -> Tensor:
        """The theta_hat [S, N, D] for the next action."""
        latents, belief = self.belief()
        self._latent = acted_on(latents, self.way, belief, self._draws, self._latent)
        return self._latent

    def choose(self, obs: Tensor) -> Tensor:
        return self.policy.sample(torch.cat([self.model.inputs.obs(obs), self.latent()], -1), self._draws)

    def remember(self, step: Batch) -> None:
        self._memory = self.model.update(self._memory, step)

    def loss(self, batch: Batch, belief: Tensor, steps: int | None, draws: Draws) -> Tensor:
        """The imitation loss [S] on steps of expert trials; theta_hat_H is drawn from `final_belief`."""
        index = batch.draw_steps(steps, draws)
        pairs = batch.steps(index)
        steps_each = batch.mask.shape[1:].numel() // belief.shape[1]  # of a belief: a trial's, or one
        theta_hat = self.model.sample(take(belief, index // steps_each), draws)
        with torch.no_grad():
            inputs = self.model.inputs.obs(pairs.obs)
        return imitation_loss(self.policy.log_prob(torch.cat([inputs, theta_hat], -1), pairs.action), pairs.mask)

    @torch.no_grad()
    def held_out_loss(self, batch: Batch) -> Tensor:
        """The imitation loss [S] on the expert's trials, given theta_hat_H."""
        return self.loss(batch, final_belief(self.model, batch), None, self._draws)

    @torch.no_grad()
    def features(self) -> NDArray[np.float32]:
        latents, belief = self.belief()
        mean = latents.mean(belief)
        return mean.flatten(0, 1).cpu().numpy()


class Explorer(DeconfoundedAgent):
    """The exploration policy: the current imitator, with a share of random actions; it sees no theta.

    In every other trial its latent is drawn once an episode from those inferred on expert trials (samples of the prior)
    instead of from the belief, so that each expert's behaviour is rolled out under each theta.
    """

    def __init__(self, agent: DeconfoundedAgent, latents: Tensor, random_share: float) -> None:
        super().__init__(agent.model, agent.policy, agent.online)
        self.latents, self.random_share = latents, random_share

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        super().reset(rngs)
        self._blind = torch.arange(self._n, device=self.device)[:, None] % 2 == 0
        self._drawn = take(self.latents, self._draws.integers(self.latents.shape[1], self._n))

    def latent(self) -> Tensor:
        return torch.where(self._blind, self._drawn, super().latent())

    def choose(self, obs: Tensor) -> Tensor:
        return self.policy.signature.randomise(super().choose(obs), self.random_share, self._draws)


def train(
    trials: Source, explore: Explore, config: DeconfoundedConfig, rng: Rngs, monitor: Monitor | None = None
) -> DeconfoundedAgent:
    """Algorithm 1.

    trials: of the expert, without theta, in as many equal groups as there are generators in rng; or a function that
    draws them, called in every round if config does not accumulate. explore: called once a round. Raises InputError if
    the two do not fit each other.
    """
    rngs, device, monitor = as_generators(rng), config.device, monitor or Monitor()
    seeds = len(rngs)
    unit = split_episodes if config.drifts else lambda trials: trials
    demonstrations, first = unit(trials_of(trials)), trials_of(lambda: explore(None))
    episodes, first = first.mask.shape[1], unit(first)
    signature = Signature.of(demonstrations)
    if Signature.of(first) != signature:
        raise InputError(f"exploration is {Signature.of(first)}, demonstrations are {signature}; they must agree")
    expert, explored = (Batch.of(x, seeds, device) for x in (demonstrations, first))
    draws = Draws(rngs, device)
    scales = Scales.of(signature, expert, explored)
    agent = DeconfoundedAgent.new(config.model, config.latent, config.width, scales, draws)
    model, policy, online = agent.model, agent.policy, agent.online
    inference_batch = config.inference_batch
    if config.drifts:
        model.kept.fill_(0.5)  # during exploration
        inference_batch = inference_batch and inference_batch * episodes  # as many steps as of whole trials

    inferences = config.rounds * config.inference_updates
    total = inferences + config.rounds * config.imitation_updates + config.final_updates
    inference = Adam([model], config.inference_rate, inferences if config.cooled else None)
    imitation = Adam([policy], config.imitation_rate)

    def imitate(done: int, optimizer: Adam) -> None:
        """One update of eta."""
        loss = agent.loss(expert, belief, config.imitation_batch, draws)
        optimizer.step(loss)
        monitor.update(done + 1, total, {"imitation": loss.mean().item()}, agent)

    begin, done = 0, 0
    checkpoint = Checkpoint(monitor, rngs, **agent.parts(), inference=inference, imitation=imitation, draws=draws)
    if before := checkpoint.load():
        begin, belief, latents, explored = before["round"], before["belief"], before["latents"], Batch(*before["seen"])
        expert = Batch(*before["expert"]) if before["expert"] else expert
        done = begin * (config.inference_updates + config.imitation_updates)
    for i in range(begin, config.rounds):
        if i > 0:
            explorer = Explorer(agent, latents, config.random_share) if config.random_share < 1 else None
            new = Batch.of(unit(explore(explorer)), seeds, device)
            explored = explored.joined(new) if config.accumulate else new
            if not config.accumulate:
                expert = Batch.of(unit(trials_of(trials)), seeds, device)
        for j in range(config.inference_updates):  # of phi and psi
            warm = ramp(i * config.inference_updates + j, config.warm_up * inferences)
            beginnings = explored.beginnings(i * config.inference_updates + j, config.shortest)
            batch = beginnings.draw_trials(inference_batch, draws)
            loss = model.learn(inference, batch, config.inference_steps, config.beta * warm, draws)
            done += 1
            monitor.update(done, total, {"inference": loss}, agent)
        belief = final_belief(model, expert)
        latents = model.sample(belief, draws)
        if config.fit_prior:
            model.set_prior(belief, draws)
        if online is not None:
            online.fit(model, explored, config.inference_updates, draws)
        for _ in range(config.imitation_updates):
            imitate(done, imitation)
            done += 1
        fresh = None if isinstance(trials, Trials) else expert.tensors
        checkpoint.save(round=i + 1, belief=belief, latents=latents, seen=explored.tensors, expert=fresh)
    final = Adam([policy], config.imitation_rate, config.final_updates)
    for _ in range(config.final_updates):
        imitate(done, final)
        done += 1
    if config.drifts:
        choose_kept(model, explored[:, -(len(first) // seeds) :], episodes, draws)
    return agent


ON_BANDIT = DeconfoundedConfig(
    model="evidence",  # with innovations it has .82, not .84 (one seed)
    rounds=2,
    latent=5,
    beta=5e-3,
    inference_updates=1200,
    inference_batch=64,
    inference_steps=3200,
    shortest=1.0,  # its trials are short; on their beginnings the latent is ignored for too long
    imitation_updates=800,
    final_updates=3200,
    imitation_rate=3e-3,
    random_share=1.0,
)
PAPER = DeconfoundedConfig(  # appendix D and table 1; docs/paper.md has what they leave open
    model="gru",
    width=256,
    latent=256,
    beta=1e-3,
    rounds=5000,
    shortest=1.0,
    inference_updates=1,
    inference_batch=None,
    inference_steps=2048,
    inference_rate=1e-4,
    imitation_updates=1,
    final_updates=0,
    imitation_batch=2048,
    imitation_rate=1e-3,
    cooled=False,
    accumulate=False,
    fit_prior=False,
    random_share=1.0,
)


def large(config: DeconfoundedConfig) -> dict[str, Any]:
    """Changes for large observations: more inference updates, at a lower rate (with 3e-3 ant_goal is worse)."""
    return {"inference_updates": round(1.6 * config.inference_updates), "inference_rate": 2e-3}


USES = ("demonstrations", "exploration")
SHARED: dict[str, Any] = {  # with deconfounded_gru and deconfounded_discrete
    "smoke": {"rounds": 2, "imitation_updates": 100, "final_updates": 400, "inference_updates": 100},
    "smoke_bandit": {"rounds": 1, "imitation_updates": 400, "final_updates": 800, "inference_updates": 800},
    "deployments": deployments("episode", "mode"),  # the mean of a Gaussian is its mode
}


@uses(
    *USES, version=5, cost=4, on_control=DeconfoundedConfig(), on_bandit=ON_BANDIT, paper=PAPER, large=large, **SHARED
)
def fit(given: Given) -> DeconfoundedAgent:
    """Train by Algorithm 1."""
    trials = given.demonstrations if given.config.accumulate else given.source
    return train(trials, given.explore, given.config, given.rngs, given.monitor)
