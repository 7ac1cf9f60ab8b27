"""Deconfounded imitation learning, Tier 2: Algorithm 1 (training) and Algorithm 2 (deployment) of the paper.

A latent-variable model is trained on exploration that is blind to theta. It infers latents theta_hat_H on whole expert
trials, given which a latent-conditional policy pi_eta(a | s, theta_hat) is cloned. At test time the agent samples
theta_hat from its belief (posterior sampling), acts, and updates the belief on the transition: core/latent_agent.py.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.agents import Checkpoint, ramp
from deconfounded.deconf.core.data import Batch, Draws, Rngs, Signature, Source, as_generators, take, trials_of
from deconfounded.deconf.core.deployment import deployments
from deconfounded.deconf.core.drift import choose_kept, split_episodes
from deconfounded.deconf.core.latent_agent import DeconfoundedAgent, Explorer
from deconfounded.deconf.core.latent_model import final_belief
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import Scales
from deconfounded.deconf.core.sizes import Configuration
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.experts.agent import Agent
from deconfounded.experts.trials import Trials

Explore = Callable[[Agent | None], Trials]
"""Rolls out a behaviour (None: uniformly random actions) under fresh thetas: as many trials for each seed."""


@dataclass(frozen=True)
class DeconfoundedConfig(Configuration):
    """Hyperparameters for each seed. Each round explores, then updates the model, the online belief and the policy.

    The linear and the discrete model have exact likelihoods: beta, warm_up and inference_steps do not apply to them.
    Their priors are fixed; by fit_prior the linear model takes the scale of latents, for its online belief.
    """

    model: Literal["linear", "innovations", "evidence", "forgetting", "gru", "discrete"] = "linear"
    width: int = 64
    latent: int = 8  # dimensions of theta_hat, or its number of values if discrete
    beta: float = 1e-3
    warm_up: float = 0.5  # share of a model's inference updates over which beta rises to its value
    rounds: int = 8
    inference_updates: int = 300  # a round
    inference_batch: int | None = 16  # trials, whose every step is evidence; None: all there are
    shortest: float = 1 / 16  # least share of these trials that an update reads: see Batch.beginnings
    inference_steps: int | None = 1024  # whose next observation is predicted, of these trials; None: all
    inference_rate: float = 3e-3
    imitation_updates: int = 250  # a round
    final_updates: int = 2000  # of the policy, after the last round
    imitation_batch: int | None = 1024  # steps; None: all there are
    imitation_rate: float = 2e-3
    cooled: bool = True  # the model's learning rate falls to 0 along a cosine; the policy's does after the last round
    accumulate: bool = True  # train on exploration of all rounds; else of each alone, and on fresh demonstrations
    fit_prior: bool = True  # to the latents of expert trials (empirical Bayes); else it is N(0, 1)
    drifts: bool = False  # theta changes between the episodes of a trial: see deconf/core/drift.py
    device: str = "cpu"
    random_share: float = 0.1  # of exploration's actions that are uniformly random; 1: without the imitator
    restart: bool = False  # the last round begins with new networks, and has half of all inference updates

    def inference_by_round(self) -> list[int]:
        """How many inference updates each round has."""
        before, half = self.rounds - 1, self.rounds * self.inference_updates // 2
        return [half // before] * before + [half] if self.restarts else [self.inference_updates] * self.rounds

    @property
    def restarts(self) -> bool:
        """Whether there are networks before those of the last round."""
        return self.restart and self.rounds > 1


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
    signature = Signature.of(demonstrations, first)
    episodes, first = first.mask.shape[1], unit(signature.checked(first))
    expert, explored = (Batch.of(x, seeds, device) for x in (demonstrations, first))
    draws = Draws(rngs, device)
    inference_batch = config.inference_batch
    if config.drifts:
        inference_batch = inference_batch and inference_batch * episodes  # as many steps as of whole trials
    by_round = config.inference_by_round()
    total = sum(by_round) + config.rounds * config.imitation_updates + config.final_updates

    def begun(updates: int) -> tuple[DeconfoundedAgent, Adam, Adam, Checkpoint]:
        """An untrained agent, the optimizers of its model, for so many updates, and of its policy; what is saved."""
        scales = Scales.of(signature, expert, explored)
        agent = DeconfoundedAgent.new(config.model, config.latent, config.width, scales, draws)
        if config.drifts:
            agent.model.kept.fill_(0.5**agent.model.share_power)  # during exploration
        inference = Adam([agent.model], config.inference_rate, updates if config.cooled else None)
        imitation = Adam([agent.policy], config.imitation_rate)
        checkpoint = Checkpoint(monitor, rngs, **agent.parts(), inference=inference, imitation=imitation, draws=draws)
        return agent, inference, imitation, checkpoint

    def imitate(done: int, optimizer: Adam) -> None:
        """One update of eta."""
        loss = agent.loss(expert, belief, config.imitation_batch, draws)
        optimizer.step(loss)
        monitor.update(done + 1, total, {"imitation": loss.mean().item()}, agent)

    begin, done, start = 0, 0, 0
    span = sum(by_round[:-1] if config.restarts else by_round)  # updates of the model that there is, from start on
    agent, inference, imitation, checkpoint = begun(span)
    if before := checkpoint.load():
        begin, belief, latents, explored = before["round"], before["belief"], before["latents"], Batch(*before["seen"])
        expert = Batch(*before["expert"]) if before["expert"] else expert
        done = sum(by_round[:begin]) + begin * config.imitation_updates
    for i in range(begin, config.rounds):
        if i > 0:
            explorer = Explorer(agent, latents, config.random_share) if config.random_share < 1 else None
            new = Batch.of(unit(signature.checked(explore(explorer))), seeds, device)
            explored = explored.joined(new) if config.accumulate else new
            if not config.accumulate:
                expert = Batch.of(unit(trials_of(trials)), seeds, device)
        if config.restarts and i == config.rounds - 1:
            start, span = span, by_round[-1]
            agent, inference, imitation, checkpoint = begun(span)
        model, online = agent.model, agent.online
        for j in range(sum(by_round[:i]), sum(by_round[: i + 1])):  # of phi and psi
            warm = ramp(j - start, config.warm_up * span)
            beginnings = explored.beginnings(j, config.shortest)
            batch = beginnings.draw_trials(inference_batch, draws)
            loss = model.learn(inference, batch, config.inference_steps, config.beta * warm, draws)
            done += 1
            monitor.update(done, total, {"inference": loss}, agent)
        belief = final_belief(model, expert)
        drawn = belief  # of a latent a trial; or one a step, padding too
        if belief.shape[1] > len(expert):
            drawn = take(belief, expert.draw_steps(belief.shape[1], draws))
        latents = model.for_cloning(drawn, draws)
        if config.fit_prior:
            model.set_prior(drawn, draws)
        if online is not None:
            online.fit(model, explored, by_round[i], draws)
        for _ in range(config.imitation_updates):
            imitate(done, imitation)
            done += 1
        fresh = None if isinstance(trials, Trials) else expert.tensors
        checkpoint.save(round=i + 1, belief=belief, latents=latents, seen=explored.tensors, expert=fresh)
    final = Adam([agent.policy], config.imitation_rate, config.final_updates)
    for _ in range(config.final_updates):
        imitate(done, final)
        done += 1
    if config.drifts:
        choose_kept(agent.model, explored[:, -(len(first) // seeds) :], episodes, draws)
    return agent


ON_BANDIT = DeconfoundedConfig(
    model="evidence",  # observations are 0 or 1, and a linear model needs Gaussian noise
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
SHARED: dict[str, Any] = {  # with the variants of this method
    "smoke": {"rounds": 2, "imitation_updates": 100, "final_updates": 400, "inference_updates": 100},
    "smoke_bandit": {"rounds": 1, "imitation_updates": 400, "final_updates": 800, "inference_updates": 800},
    "deployments": deployments("episode", "mode"),  # the mean of a Gaussian is its mode
}


@uses(
    *USES, version=8, cost=3, on_control=DeconfoundedConfig(), on_bandit=ON_BANDIT, paper=PAPER, large=large, **SHARED
)
def fit(given: Given) -> DeconfoundedAgent:
    """Train by Algorithm 1."""
    trials = given.demonstrations if given.config.accumulate else given.source
    return train(trials, given.explore, given.config, given.rngs, given.monitor)
