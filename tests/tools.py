"""What tests share."""

from __future__ import annotations

from deconfounded.benchmarks.engine.presets import Preset
from deconfounded.deconf.cloning import CloningConfig
from deconfounded.deconf.dagger import DaggerConfig
from deconfounded.deconf.deconfounded import DeconfoundedConfig
from deconfounded.deconf.offline import OfflineConfig
from deconfounded.deconf.recurrent import RecurrentConfig


def tiny_preset() -> Preset:
    """Two or three updates of each kind, on four trials."""
    few = {"rounds": 2, "inference_updates": 2, "inference_batch": 4, "imitation_updates": 2, "final_updates": 2}
    return Preset(
        seeds=3,
        expert_trials=4,
        explore_trials=4,
        eval_trials=4,
        query_trials=4,
        fresh=0,
        grid=3,
        deconfounded=DeconfoundedConfig(**few),
        discrete=DeconfoundedConfig(model="discrete", **few),
        offline=OfflineConfig(
            offline_updates=2, online_updates=2, online_batch=4, offline_batch=4, synthetic=4, online_steps=64
        ),
        naive=RecurrentConfig(updates=2, batch=4),
        dagger=DaggerConfig(updates=2, rounds=2, batch=4),
        cloning=CloningConfig(updates=3, batch=64),
    )
