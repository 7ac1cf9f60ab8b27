"""How much data and training each preset spends, by kind of task."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, get_args, get_type_hints

from gymnasium import spaces

from deconfounded import envs
from deconfounded.deconf.core.sizes import MANY, SPACIOUS, WIDE
from deconfounded.deconf.methods.cloning import CloningConfig
from deconfounded.deconf.methods.dagger import DaggerConfig
from deconfounded.deconf.methods.deconfounded import DeconfoundedConfig
from deconfounded.deconf.methods.deconfounded_mean import MeanConfig
from deconfounded.deconf.methods.gail import GailConfig
from deconfounded.deconf.methods.naive_obs import DropoutConfig
from deconfounded.deconf.methods.naive_transformer import TransformerConfig
from deconfounded.deconf.methods.offline import OfflineConfig
from deconfounded.deconf.methods.palr import PalrConfig
from deconfounded.deconf.methods.recurrent import RecurrentConfig
from deconfounded.deconf.methods.rma import RmaConfig

MOST = 1e9  # of any amount
LONGER, GENTLE = 1.6, 2e-3  # where MANY are observed: updates of what infers theta, their rate (3e-3: ant_goal worse)


@dataclass(frozen=True)
class Preset:
    """Amounts of data and training. Trials are of task.episodes episodes each."""

    seeds: int
    expert_trials: int
    explore_trials: int  # a round
    eval_trials: int
    query_trials: int  # a round
    fresh: int  # expert trials drawn anew for each update of naive_rnn, and round of what does not accumulate; or 0
    grid: int
    deconfounded: DeconfoundedConfig
    discrete: DeconfoundedConfig
    offline: OfflineConfig
    naive: RecurrentConfig
    dagger: DaggerConfig
    cloning: CloningConfig
    mean: MeanConfig
    gail: GailConfig
    rma: RmaConfig
    transformer: TransformerConfig
    obs: RecurrentConfig
    dropout: DropoutConfig
    palr: PalrConfig


CONFIGS = (
    *("deconfounded", "discrete", "offline", "naive", "dagger", "cloning"),
    *("mean", "gail", "rma", "transformer", "obs", "dropout", "palr"),
)  # of a preset's fields

_ON_CONTROL = DeconfoundedConfig(
    inference_updates=500,
    inference_rate=3e-3,
    imitation_updates=250,
    final_updates=2000,
    imitation_rate=2e-3,
)
_CONTROL = Preset(
    seeds=3,
    expert_trials=256,
    explore_trials=64,
    eval_trials=128,
    query_trials=48,
    fresh=0,
    grid=21,
    deconfounded=_ON_CONTROL,
    discrete=replace(
        _ON_CONTROL, model="discrete", latent=16, inference_updates=800, inference_batch=8, inference_rate=1e-2
    ),
    offline=OfflineConfig(),
    naive=RecurrentConfig(),
    dagger=DaggerConfig(),
    cloning=CloningConfig(),
    mean=MeanConfig(model="evidence"),
    gail=GailConfig(discriminator_rate=3e-4),
    rma=RmaConfig(updates=3000, learning_rate=6e-4),
    transformer=TransformerConfig(layers=4),
    obs=RecurrentConfig(learning_rate=9e-4),
    dropout=DropoutConfig(learning_rate=9e-4),
    palr=PalrConfig(penalty=1.0),
)
_ON_BANDIT = DeconfoundedConfig(
    rounds=2,
    inference_batch=64,
    inference_rate=3e-3,
    shortest=1.0,  # its trials are short, and on the beginnings of few the latent is ignored for too long
    imitation_updates=800,
    final_updates=3200,
    imitation_rate=3e-3,
    random_share=1.0,
)
_BANDIT = Preset(
    seeds=5,
    expert_trials=24000,
    explore_trials=8000,
    eval_trials=4000,
    query_trials=2000,
    fresh=0,
    grid=0,
    deconfounded=replace(_ON_BANDIT, latent=5, beta=5e-3, inference_updates=1200, inference_steps=3200),
    discrete=replace(
        _ON_BANDIT, model="discrete", latent=10, inference_updates=400, imitation_updates=200, final_updates=800
    ),
    offline=OfflineConfig(
        latent=5,
        offline_batch=64,
        offline_steps=100,
        beta=5e-3,
        shortest=1.0,
        online_batch=64,
        online_steps=6400,
        synthetic=2000,
        refresh=200,
        random_share=1.0,
        learning_rate=3e-3,
    ),
    naive=RecurrentConfig(updates=2000, batch=128, chunk=50, learning_rate=1e-2),
    dagger=DaggerConfig(batch=64, shortest=1.0, updates=1000),
    cloning=CloningConfig(updates=500),
    mean=MeanConfig(
        model="evidence",
        latent=5,
        beta=0.01,
        ahead=1,
        rounds=2,
        inference_updates=600,
        inference_batch=64,
        shortest=1.0,
        inference_steps=6400,
        inference_rate=3e-3,
        imitation_updates=800,
        final_updates=3200,
        imitation_rate=3e-3,
    ),
    gail=GailConfig(
        rounds=150, envs=64, steps=100, minibatch=1600, gamma=0.9, policy_rate=3e-3, discriminator_rate=3e-4
    ),
    rma=RmaConfig(updates=2000, batch=128, rounds=2, learning_rate=3e-3, teacher_updates=500),
    transformer=TransformerConfig(width=32, layers=4, updates=1500, batch=64, shortest=1.0, learning_rate=3e-3),
    obs=RecurrentConfig(updates=2000, batch=128, chunk=50, learning_rate=3e-3),
    dropout=DropoutConfig(updates=2000, batch=128, chunk=50, learning_rate=3e-3),
    palr=PalrConfig(penalty=1.0, updates=2000, batch=128, chunk=50, learning_rate=1e-2),
)


_PAPER = replace(  # appendix D and table 1; what they leave open is in docs/paper.md
    _BANDIT,
    seeds=10,
    explore_trials=100,
    fresh=100,
    deconfounded=DeconfoundedConfig(
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
    ),
    discrete=replace(_BANDIT.discrete, rounds=40, inference_updates=40, imitation_updates=40),
    naive=RecurrentConfig(width=256, updates=5000, batch=100, chunk=100, learning_rate=1e-3, cooled=False),
)


def _smoke(full: Preset) -> Preset:
    """One seed, and little of everything; the bandit's belief gets enough to be ahead of naive cloning."""
    bandit = full is _BANDIT
    amounts: dict[str, Any] = (
        {"rounds": 1, "imitation_updates": 400, "final_updates": 800}
        if bandit
        else {"rounds": 2, "imitation_updates": 100, "final_updates": 400}
    )
    inference, updates = (800, 500) if bandit else (100, 60)
    return replace(
        full,
        seeds=1,
        expert_trials=2000 if bandit else 32,
        explore_trials=1000 if bandit else 16,
        eval_trials=1000 if bandit else 16,
        query_trials=500 if bandit else 8,
        grid=9,
        deconfounded=replace(full.deconfounded, **amounts, inference_updates=inference),
        discrete=replace(full.discrete, **amounts, inference_updates=inference),
        offline=replace(full.offline, offline_updates=300, online_updates=300),
        naive=replace(full.naive, updates=updates),
        dagger=replace(full.dagger, updates=updates, rounds=4),
        cloning=replace(full.cloning, updates=400),
        mean=replace(full.mean, **amounts, inference_updates=400 if bandit else 20),
        gail=replace(full.gail, rounds=20 if bandit else 2),
        rma=replace(full.rma, updates=updates, rounds=2, teacher_updates=400),
        transformer=replace(full.transformer, updates=200 if bandit else 10),
        obs=replace(full.obs, updates=updates),
        dropout=replace(full.dropout, updates=updates),
        palr=replace(full.palr, updates=updates),
    )


def preset(name: str, task: envs.Task, device: str) -> Preset:
    """The amounts for a task: discrete ones take the bandit's, all others those of control."""
    amounts = _BANDIT if isinstance(task.action_space, spaces.Discrete) else _CONTROL
    if name == "smoke":
        amounts = _smoke(amounts)
    if name == "paper":
        amounts = _PAPER if amounts is _BANDIT else replace(amounts, seeds=10)
    told: dict[str, dict[str, Any]] = {part: {"device": device} for part in CONFIGS}
    if len(task.observation) >= MANY:
        told = {part: values | {"width": WIDE} for part, values in told.items()}
        for part in ("deconfounded", "offline", "mean"):
            told[part] |= {"latent": SPACIOUS}
        updates = round(LONGER * amounts.deconfounded.inference_updates)
        told["deconfounded"] |= {"inference_updates": updates, "inference_rate": GENTLE}
        told["offline"] |= {"learning_rate": GENTLE}
    for part in ("deconfounded", "discrete", "offline", "dagger"):
        told[part] |= {"drifts": task.drifts}
    return replace(amounts, **{part: replace(getattr(amounts, part), **values) for part, values in told.items()})


def changed(settings: Preset, changes: Sequence[str]) -> Preset:
    """The same with other amounts: `seeds=10`, or `naive.updates=500` for a part's.

    Raises InputError for one that there is not, or a value of another type.
    """
    for change in changes:
        key, _, value = change.partition("=")
        part, _, field = key.rpartition(".")
        if part not in ("", *CONFIGS):
            raise envs.closest("--set part", part, list(CONFIGS))
        of = getattr(settings, part) if part else settings
        known = {name: now for name, now in asdict(of).items() if name not in CONFIGS}
        if field not in known or field in ("device", "drifts"):
            raise envs.closest("--set amount", key, [f"{part}.{name}" if part else name for name in known])
        kind = get_type_hints(type(of))[field]
        new = {field: _parsed(key, value, get_args(kind) or (kind,), known[field])}
        settings = replace(settings, **({part: replace(of, **new)} if part else new))
    return settings


def _parsed(key: str, text: str, kinds: tuple[Any, ...], now: Any) -> Any:
    """The text as a value of one of those types, or one of those values."""
    try:
        value = json.loads(text)
    except ValueError:
        value = text
    right = value in kinds or type(value) in kinds or (type(value) is int and float in kinds)
    least = 0 if isinstance(now, float) or key.endswith(("updates", "fresh", "grid")) else 1
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not right or (number and not least <= value < MOST):
        raise envs.InputError(f"--set {key} was {text!r}; it must be like {json.dumps(now)}")
    return value
