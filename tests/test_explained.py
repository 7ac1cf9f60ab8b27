"""What the world tells of a latent is found in a small world whose truth is known, and so is the size of its noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from deconfounded.deconf.core.data import Batch, Draws
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.diagnosis import latent, measures
from deconfounded.deconf.diagnosis.diagnose import SILENT
from deconfounded.deconf.diagnosis.measures import Amounts, split
from deconfounded.deconf.methods.cloning import CloningConfig
from deconfounded.deconf.methods.deconfounded import DeconfoundedConfig
from deconfounded.experts.rollout import Trials

NOISE, FALL = 0.1, 1.5
EXPLORING = DeconfoundedConfig(inference_updates=400, inference_rate=3e-3)
CLONING = CloningConfig(updates=200)


def world(push: float, expert: bool, n: int, seed: int, episodes: int = 1, drifts: bool = False) -> Trials:
    """s' = s + a / 2 + push theta + noise, wild beyond |s| = 1.5; the expert holds s at 0, others do anything."""
    rng = np.random.default_rng(seed)
    theta = np.repeat(rng.choice([-1.0, 1.0], (n, 1)), episodes, 1)
    if drifts:
        theta = rng.choice([-1.0, 1.0], (n, episodes))
    obs, actions = [rng.normal(0, 0.1 if expert else 3.0, (n, episodes))], []
    for _ in range(40):
        s = obs[-1]
        act = -2 * s - 0.4 * theta + rng.normal(0, 0.05, s.shape) if expert else rng.uniform(-1, 1, s.shape) - s
        act = act.clip(-1, 1)
        noise = np.where(abs(s) > FALL, 20 * NOISE, NOISE) * rng.normal(size=s.shape)
        obs.append(s + act / 2 + push * theta + noise)
        actions.append(act)
    return Trials(np.stack(obs, -1)[..., None], np.stack(actions, -1)[..., None], np.ones((n, episodes, 40), bool))


def by_world(push: float) -> latent.Explanation:
    rng = np.random.default_rng(0)
    expert, explored = (split(world(push, kind, 128, seed), 0.25, rng) for seed, kind in enumerate((True, False)))
    return latent.by_world(expert, explored, 1, EXPLORING, CLONING, Draws([rng], "cpu"), Monitor())


def test_world_that_tells() -> None:
    """theta moves s by .2 either way, in noise of .1: 8 nats a step between opposite ones, as half of all pairs are."""
    found = by_world(0.2)
    assert found.explored == pytest.approx(4, rel=0.35)
    assert found.shown == pytest.approx(4, rel=0.35)
    head = found.model.dynamics
    assert (torch.exp(head.log_std) * head.change.std).item() == pytest.approx(NOISE, rel=0.3)


def test_world_that_says_nothing() -> None:
    found = by_world(0.0)
    assert found.explored == pytest.approx(0, abs=SILENT)
    assert found.shown == pytest.approx(0, abs=SILENT)


def test_half_tells_the_other_half(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beliefs read as many steps as they were learned on: every other one; what is likely is asked of those between."""
    read: list[torch.Tensor] = []
    final = latent.final_belief
    monkeypatch.setattr(latent, "final_belief", lambda model, batch: read.append(batch.mask) or final(model, batch))
    rng = np.random.default_rng(0)
    expert, explored = (split(world(0.2, kind, 32, seed), 0.25, rng) for seed, kind in enumerate((True, False)))
    few = replace(EXPLORING, inference_updates=5)
    latent.by_world(expert, explored, 1, few, replace(CLONING, updates=5), Draws([rng], "cpu"), Monitor())
    assert read
    for mask in read:
        assert mask[..., ::2].any()
        assert not mask[..., 1::2].any()
    batch = Batch.of(expert[0], 1)
    between = latent.odd(batch).mask
    assert between[..., 1::2].eq(batch.mask[..., 1::2]).all()
    assert not between[..., ::2].any()


def test_theta_that_drifts() -> None:
    """Each episode of the 48 trials that are learned from has a latent of its own; whole trials would show nothing."""
    rng, amounts = np.random.default_rng(0), Amounts(exploring=EXPLORING, cloning=CLONING)
    expert, explored = (
        split(world(0.2, kind, 64, seed, 4, drifts=True), 0.25, rng) for seed, kind in enumerate((True, False))
    )
    found = measures._by_world(expert, explored, amounts, Draws([rng], "cpu"), lambda share: None)
    assert found.latents.shape[1] == 4 * 48
    assert found.explored == pytest.approx(4, rel=0.35)
