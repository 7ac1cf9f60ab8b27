"""Where theta drifts from each episode of a trial to the next: learn from episodes, and forget between them.

Within an episode theta stands still, so that the belief and the policy are trained as ever, on single episodes. What a
belief of earlier episodes is still worth is one number, the share of its memory that is kept: evidence is tempered by
it, p(theta | earlier) to the power of that share. It is chosen where it can be seen without theta: by how well the
belief, carried over so, predicts the next observations of explored trials.
"""

from __future__ import annotations

import torch

from deconfounded.deconf.core.data import Batch, Draws, drawn
from deconfounded.deconf.core.models import LatentModel
from deconfounded.experts.rollout import Trials

SHARES = 11  # 0, .1, ..., 1


def apart(trials: Trials) -> Trials:
    """Each episode as a trial of its own: [B, E, T] -> [B E, 1, T]."""
    trials = drawn(trials)
    obs, action = (x.reshape(-1, 1, *x.shape[2:]) for x in (trials.obs, trials.action))
    return Trials(obs, action, trials.mask.reshape(-1, 1, trials.mask.shape[2]), trials.actions)


@torch.no_grad()
def choose_kept(model: LatentModel, episodes: Batch, each: int, draws: Draws) -> None:
    """Set the share `kept` of each seed's model to what predicts best. episodes [S, B E, T], `each` = E to a trial."""
    seeds, steps = len(episodes.mask), episodes.mask.shape[2]
    trials = Batch(*(x.unflatten(1, (-1, each)).repeat(1, SHARES, *[1] * (x.dim() - 1)) for x in episodes.tensors))
    shares = torch.linspace(0, 1, SHARES, device=episodes.mask.device)
    share = shares.repeat_interleave(trials.mask.shape[1] // SHARES)[None, :, None]
    start = model.start(trials.mask.shape[1])
    memory, found = start, torch.zeros(seeds, trials.mask.shape[1], device=share.device)
    for e in range(each):
        model.kept.fill_(1)
        memory = model.forget(torch.lerp(start, memory, share))
        for t in range(steps):
            step = trials[:, :, e, t]
            found += model.log_next(memory, step, draws) * step.mask
            memory = model.update(memory, step)
    model.kept.copy_(shares[found.reshape(seeds, SHARES, -1).sum(-1).argmax(-1)])
