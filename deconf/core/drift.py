"""Tasks whose theta drifts from episode to episode of a trial: learning from episodes, and forgetting between them.

Within an episode theta is constant, so that the belief and the policy are trained on single episodes. A belief of
earlier episodes keeps a share of its memory. So evidence is tempered: the likelihood of earlier episodes has that
share for its power. The share is chosen without theta, by how well the belief predicts the next observations of trials.
"""

import torch

from deconfounded.deconf.core.data import Batch, Draws, trials_of
from deconfounded.deconf.core.latent_model import LatentModel
from deconfounded.experts.trials import Trials

SHARES = 11  # 0, .1, ..., 1, or powers of these


def split_episodes(trials: Trials) -> Trials:
    """Each episode as a trial of its own: [B, E, T] -> [B E, 1, T]."""
    trials = trials_of(trials)
    obs, action = (x.reshape(-1, 1, *x.shape[2:]) for x in (trials.obs, trials.action))
    return Trials(obs, action, trials.mask.reshape(-1, 1, trials.mask.shape[2]), trials.actions)


def episodes_of(trials: Trials) -> Trials:
    """Each episode that took place as a trial of its own; some trials may have fewer than others."""
    split = split_episodes(trials)
    took_place = split.mask.any((1, 2))
    return Trials(split.obs[took_place], split.action[took_place], split.mask[took_place], split.actions)


@torch.no_grad()
def choose_kept(model: LatentModel, episodes: Batch, per_trial: int, draws: Draws) -> None:
    """Set `kept` of each seed's model to the share of highest likelihood on episodes [S, B E, T], E = per_trial.

    Trials of one episode tell nothing of it, and leave it as it is.
    """
    if per_trial == 1:
        return
    seeds, steps = len(episodes.mask), episodes.mask.shape[2]
    trials = Batch(*(x.unflatten(1, (-1, per_trial)).repeat(1, SHARES, *[1] * (x.dim() - 1)) for x in episodes.tensors))
    shares = torch.linspace(0, 1, SHARES, device=episodes.mask.device) ** model.share_power
    share = shares.repeat_interleave(trials.mask.shape[1] // SHARES).expand(seeds, -1)
    memory = model.start(trials.mask.shape[1])
    log_likelihood = torch.zeros_like(share)
    for e in range(per_trial):
        memory = model.forget(memory, share)
        for t in range(steps):
            step = trials[:, :, e, t]
            log_likelihood += model.log_next(memory, step, draws) * step.mask
            memory = model.update(memory, step)
    model.kept.copy_(shares[log_likelihood.reshape(seeds, SHARES, -1).sum(-1).argmax(-1)])
