"""Figures of one split of an expert's trials, on what the expert observes and its clone does not; without judgement.

An expert that observes more than its clone leaves three traces. A memory predicts its actions better than the present
observation does; one latent explains whole episodes, Eq. (7); and the evidence of the latent in the *dynamics*, against
that in the expert's actions, decides whether a recurrent clone infers it or deludes itself. The cost is estimated by
rollouts in the learned dynamics, under latents of the data: the naive clone and a policy that infers the latent from
the dynamics are compared with the expert policy given it, by trajectories and by actions, as in Eq. (1).
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from deconfounded.deconf.core import termination
from deconfounded.deconf.core.agents import LearnedAgent
from deconfounded.deconf.core.data import Batch, Draws, Signature, take
from deconfounded.deconf.core.drift import episodes_of
from deconfounded.deconf.core.sizes import LARGE_LATENT, LARGE_OBSERVATION, WIDE, Configuration
from deconfounded.deconf.diagnosis import latent, trait, trial_dynamics
from deconfounded.deconf.diagnosis.deviation import deviation, max_ratio, paired_deviation, paired_score, trajectories
from deconfounded.deconf.diagnosis.fits import Steps, distinct, select
from deconfounded.deconf.diagnosis.held_out import BestMonitor, PartMonitor, Report, typical
from deconfounded.deconf.diagnosis.latent import Explanation, odd_steps
from deconfounded.deconf.diagnosis.learned_env import (
    Actor,
    AgentActor,
    LatentPolicy,
    LearnedEnv,
    PosteriorSampler,
    valid_range,
)
from deconfounded.deconf.diagnosis.trait import Trait, TraitPolicy
from deconfounded.deconf.methods import memoryless_bc, naive_rnn
from deconfounded.deconf.methods.deconfounded import DeconfoundedConfig
from deconfounded.deconf.methods.deconfounded_offline import OfflineConfig
from deconfounded.deconf.methods.memoryless_bc import MemorylessConfig
from deconfounded.deconf.methods.sequence_bc import RecurrentConfig
from deconfounded.experts.trials import Trials

CLEAR = 0.1  # nats a step
RESOLVED = 0.5  # correlation of halves of trials that must be visible, if trials are to be said not to differ


@dataclass(frozen=True)
class Amounts(Configuration):
    """Hyperparameters of one split; offline: of Eq. (7); exploring: of Algorithm 1.

    candidates: number of latents in rollouts, drawn from the data's. rollouts: trials of each rollout in the learned
    dynamics.
    """

    held_out: float = 0.25  # share of the trials
    candidates: int = 32
    rollouts: int = 192
    cloning: MemorylessConfig = field(default_factory=lambda: MemorylessConfig(updates=1500))
    naive: RecurrentConfig = field(default_factory=lambda: RecurrentConfig(updates=1000))
    offline: OfflineConfig = field(default_factory=lambda: OfflineConfig(offline_steps=256, online_updates=0))
    exploring: DeconfoundedConfig = field(
        default_factory=lambda: DeconfoundedConfig(inference_updates=2000, shortest=1 / 4)
    )  # with shorter sets the bandit's latent is ignored for too long

    def fitting(self, width: int) -> "Amounts":
        """Hyperparameters with networks that are large enough for observations of that width."""
        if width < LARGE_OBSERVATION:
            return self
        return replace(
            self,
            cloning=replace(self.cloning, width=WIDE),
            naive=replace(self.naive, width=WIDE),
            offline=replace(self.offline, width=WIDE, latent=LARGE_LATENT),
            exploring=replace(self.exploring, width=WIDE),
        )


class Findings(NamedTuple):
    """The figures of one split. Nats are a step, on held-out trials, of which none decides alone (`held_out.typical`).

    memory_gain: gain in log-likelihood of the expert's actions by a memory, over the present observation alone, each
    at its best (`held_out.Best`).
    latent_gain: that by the latent inferred from the dynamics, over latents of other trials, each at its best, too.
    over_memory: typical log-likelihood at every other step given that latent, less that of the clone with a memory.
    Evidence is the log-likelihood given a trial's own latent less that given other trials'. exploration_evidence,
    expert_evidence: evidence in the dynamics, of exploration and of expert trials. action_evidence: evidence in the
    expert's actions, for which a naive clone takes its own.
    dynamics_differ: rank correlation of what two halves of an exploration trial, or of an episode, do beyond a fit of
    all trials; 0 if that is chance, None if they are too few to know (`trial_dynamics.own_dynamics`).

    The others are of the last episode of rollouts in the learned dynamics; deviations are relative to chance, 1.
    stakes: deviation of trajectories under a wrong latent, of the half that is farther from the right one, from those
    under right latents, in the feature where it is largest. paired_stakes: the same, paired by latent and start.
    model_deviation: mean deviation of trajectories under right latents from the data's. model_length: mean length of
    their episodes, over that of the data's. naive, latent: scores of the naive clone and of posterior sampling, from 0
    for a wrong latent to 1 for the right one (`deviation.paired_score`); naive_by_actions, latent_by_actions: by errors
    of actions, Eq. (1). Without exploration, latent_gain, over_memory and evidence are None, and the latent explains
    actions too, Eq. (7).

    Only where a memory gains and dynamics do not differ, others are not None: trait_gain, the gain by a trait of the
    trial that is inferred from the actions of its other half (`trait.py`), and its stakes. shared: the share of what
    the latent makes a policy do that lasts through exploration too (`latent.shared_with`).
    """

    memory_gain: float
    latent_gain: float | None
    over_memory: float | None
    exploration_evidence: float | None
    expert_evidence: float | None
    action_evidence: float | None
    dynamics_differ: float | None
    stakes: float
    paired_stakes: float
    model_deviation: float
    model_length: float
    naive: float
    latent: float
    naive_by_actions: float
    latent_by_actions: float
    trait_gain: float | None = None
    trait_stakes: float | None = None
    paired_trait_stakes: float | None = None
    shared: float | None = None


def measure(
    trials: Trials,
    explore: Trials | None,
    amounts: Amounts,
    rng: np.random.Generator,
    report: Report = lambda share: None,
) -> Findings:
    """Figures of a random split of expert trials, and of exploration that is blind to theta, if there is any."""
    amounts = amounts.fitting(trials.obs.shape[-1])
    trials, explore = distinct(trials), explore and distinct(explore)
    expert, rngs = split(trials, amounts.held_out, rng), [rng]
    train, held_out = expert[0], Batch.of(expert[1], 1)
    alone, remembering = (BestMonitor(report, begin, end, held_out) for begin, end in ((0, 0.1), (0.1, 0.25)))
    blind = memoryless_bc.train(train, amounts.cloning, rng, monitor=alone)
    recurrent = naive_rnn.train(train, amounts.naive, rng, remembering)
    memory = typical(remembering.best.log_prob - alone.best.log_prob, held_out)
    draws = Draws(rngs, "cpu")
    if explore is None:
        explanation = latent.from_expert_trials(train, amounts.offline, draws, PartMonitor(report, 0.25, 0.8))
    else:
        explanation = _explain(expert, split(explore, amounts.held_out, rng), amounts, draws, report)
    data = [train] if explore is None else [train, explore]
    ends = termination.fit(data, blind.scales.obs, draws)
    with torch.no_grad():
        episodes = Batch.of(episodes_of(train), 1)
        batches, (_, per_trial, horizon) = [Batch.of(trials, 1) for trials in data], trials.mask.shape

        def learned_env(reference: LatentPolicy) -> LearnedEnv:
            return LearnedEnv(reference, episodes, batches, per_trial, horizon, ends)

        rollouts = _rollouts(explanation, learned_env, recurrent, episodes, amounts, rngs)
    likely, at_odd_steps = explanation.log_likelihood, odd_steps(held_out)
    over_memory = None if likely is None else likely - typical(remembering.best.log_prob, at_odd_steps)
    in_dynamics = explanation.exploration_evidence, explanation.expert_evidence
    differ = None if explore is None else max(_differ(near(trials, explore)), key=lambda alike: alike or 0.0)
    shared = explanation.shared
    gains = memory, explanation.latent_gain, over_memory
    findings = Findings(*gains, *in_dynamics, explanation.action_evidence, differ, *rollouts, shared=shared)
    if differ == 0 and memory > CLEAR:
        whole = Batch.of(train, 1)
        of_trial = trait.fit(whole, held_out, Signature.of(train), amounts.cloning, draws)
        stakes = _trait_stakes(of_trial, explanation, learned_env, amounts, rngs)
        findings = findings._replace(trait_gain=of_trial.gain, trait_stakes=stakes[0], paired_trait_stakes=stakes[1])
    report(1)
    return findings


def near(expert: Trials, explore: Trials) -> Trials:
    """Exploration where the expert goes."""
    low, high = (x[0].numpy() for x in valid_range(Batch.of(expert, 1)))
    inside = np.asarray(explore.obs >= low) & np.asarray(explore.obs <= high)
    return Trials(explore.obs, explore.action, inside[:, :, :-1].all(-1) & explore.mask, explore.actions)


def _differ(explored: Trials) -> tuple[float | None, float]:
    """How much trials differ in their dynamics, see Findings, and how much their episodes, 0 of one episode."""
    lasting = trial_dynamics.own_dynamics(explored, Steps.of(explored), RESOLVED)
    if explored.mask.shape[1] == 1:
        return lasting and lasting[0], 0.0
    passing = trial_dynamics.own_dynamics(episodes := episodes_of(explored), Steps.of(episodes))
    return lasting and lasting[0], passing[0] if passing else 0.0


@torch.no_grad()
def _trait_stakes(
    of_trial: Trait,
    explanation: Explanation,
    learned_env: Callable[[LatentPolicy], LearnedEnv],
    amounts: Amounts,
    rngs: list[np.random.Generator],
) -> tuple[float, float]:
    """Stakes and paired stakes of wrong traits, under latents of the dynamics which they do not depend on."""
    draws, count = Draws(rngs, "cpu"), amounts.rollouts
    candidates = take(of_trial.traits, draws.integers(of_trial.traits.shape[1], amounts.candidates))
    index = draws.integers(amounts.candidates, count)
    latents = take(explanation.latents, draws.integers(explanation.latents.shape[1], count))
    right, wrong = (
        TraitPolicy(explanation.dynamics, of_trial, latents, take(candidates, i))
        for i in (index, draw_distant(candidates, index, draws))
    )
    env = learned_env(right)
    return stakes_of([env.rollout(actor, rngs).paths[0] for actor in (wrong, right, right, right)])


def stakes_of(paths: list[Tensor]) -> tuple[float, float]:
    """Deviation of trajectories [N, T, O] under wrong latents from those under right ones, over chance; and paired.

    paths: under wrong latents, under right ones, and two repeats of the latter, so that errors are independent.
    """
    away, home, repeat, second = paths
    half = len(home) // 2
    stakes = max_ratio(*(deviation(path[half:], home[:half], repeat[half:]) for path in (away, home)))
    return stakes, max_ratio(*(paired_deviation(path, home, repeat) for path in (away, second)))


def _rollouts(
    explanation: Explanation,
    learned_env: Callable[[LatentPolicy], LearnedEnv],
    recurrent: LearnedAgent,
    episodes: Batch,
    amounts: Amounts,
    rngs: list[np.random.Generator],
) -> tuple[float, float, float, float, float, float, float, float]:
    """Figures of rollouts: `stakes` and those after it in Findings. episodes: the data's [1, N, T]."""
    draws, dynamics, policy = Draws(rngs, "cpu"), explanation.dynamics, explanation.policy
    candidates = take(explanation.latents, draws.integers(explanation.latents.shape[1], amounts.candidates))
    index = draws.integers(amounts.candidates, amounts.rollouts)
    right = LatentPolicy(dynamics, policy, take(candidates, index))
    wrong = LatentPolicy(dynamics, policy, take(candidates, draw_distant(candidates, index, draws)))
    imitators: list[Actor] = [AgentActor(recurrent), PosteriorSampler(dynamics, policy, candidates)]
    env = learned_env(right)
    rollouts = [env.rollout(actor, rngs) for actor in [right, wrong, *imitators, right, right]]
    least, most, *errors = (rollout.error for rollout in rollouts[:4])
    judged = (float(1 - (error - least) / (most - least).clamp(min=0.05)) for error in errors)
    home, away, *imitated, repeat, second = (rollout.paths[0] for rollout in rollouts)
    stakes, paired_stakes = stakes_of([away, home, repeat, second])
    naive, inferring = (paired_score(path, away, home, (repeat, second)) for path in imitated)
    paths = trajectories(episodes)
    shuffled = paths[torch.randperm(len(paths), generator=torch.Generator().manual_seed(0))]
    unlike = float(deviation(home, *shuffled.tensor_split(2)).mean())
    length = float(rollouts[0].length.mean() / episodes.mask.sum(-1).mean())
    naive_by_actions, inferring_by_actions = judged
    return stakes, paired_stakes, unlike, length, naive, inferring, naive_by_actions, inferring_by_actions


def draw_distant(latents: Tensor, index: Tensor, draws: Draws) -> Tensor:
    """For each of index [S, N] into latents [S, K, D], the index of another, of the half at larger distances."""
    half = max(1, latents.shape[1] // 2)
    distant = torch.cdist(latents, latents).argsort(-1, descending=True)[..., :half]
    return take(distant, index).gather(-1, draws.integers(half, index.shape[1])[..., None])[..., 0]


def _explain(
    expert: tuple[Trials, Trials],
    exploration: tuple[Trials, Trials],
    amounts: Amounts,
    draws: Draws,
    report: Report,
) -> Explanation:
    """An explanation by a latent of whole trials; or of single episodes, if these explain clearly more.

    More of the dynamics and of the expert's actions: of one alone, it can be where an episode went, and no latent.
    Single episodes are tried where the halves of an episode are more alike in their dynamics than a trial's episodes.
    """
    per_trial = max(x[0].mask.shape[1] for x in (expert, exploration))
    config, batch = amounts.exploring, amounts.exploring.inference_batch
    units = [(expert, exploration, 1, config)]
    lasting, passing = _differ(near(*(train for train, _ in (expert, exploration))))
    if passing > (lasting or 0.0):
        longer = replace(config, inference_batch=batch and per_trial * batch)  # as many steps as of whole trials
        episodes = ((episodes_of(x[0]), episodes_of(x[1])) for x in (expert, exploration))
        units.append((*episodes, per_trial, longer))
    explanations = list[Explanation]()
    for i, unit in enumerate(units):
        part = PartMonitor(report, 0.25 + 0.55 * i / len(units), 0.25 + 0.55 * (i + 1) / len(units))
        explanations.append(latent.from_dynamics(*unit, amounts.cloning, draws, part))
    whole, single = explanations[0], explanations[-1]
    of_actions = (single.latent_gain or 0.0) - (whole.latent_gain or 0.0)
    of_dynamics = (single.expert_evidence or 0.0) - (whole.expert_evidence or 0.0)
    return single if min(of_actions, of_dynamics) > CLEAR else whole


def split(trials: Trials, share: float, rng: np.random.Generator) -> tuple[Trials, Trials]:
    """Trials for training, and that share of them that is held out."""
    order, count = rng.permutation(len(trials)), max(1, round(share * len(trials)))
    return select(trials, order[count:]), select(trials, order[:count])
