"""What tests share."""

from __future__ import annotations

from pathlib import Path

from deconfounded.benchmarks.engine.presets import Preset
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
        obs=RecurrentConfig(updates=2, batch=4),
        dagger=DaggerConfig(updates=2, rounds=2, batch=4),
        cloning=CloningConfig(updates=3, batch=64),
        mean=MeanConfig(**few, inference_steps=64),
        gail=GailConfig(width=16, rounds=2, envs=2, steps=32, epochs=1, minibatch=32, discriminator_updates=2),
        rma=RmaConfig(updates=2, rounds=2, batch=4, teacher_updates=3, teacher_batch=64),
        transformer=TransformerConfig(updates=2, batch=4, width=16, heads=2),
        dropout=DropoutConfig(updates=2, batch=4),
        palr=PalrConfig(updates=2, batch=4, samples=32),
    )


def processes(mark: str, *starts: str) -> list[tuple[int, str]]:
    """Number and command line of those with `mark` (NAME=value) in their environment, whose command line starts so."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words, environ = ((folder / name).read_bytes() for name in ("cmdline", "environ"))
        except OSError:
            continue
        line = words.decode(errors="replace")
        if mark.encode() in environ.split(b"\0") and line.startswith(starts):
            found.append((int(folder.name), line))
    return sorted(found)
