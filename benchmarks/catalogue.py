"""What there is to run, by name: methods and presets. It imports next to nothing, so that a command can list them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from deconfounded import envs


@dataclass(frozen=True)
class Method:
    """cost: about, where blind BC is 1, for the ETA alone. default: whether it runs if nobody asks for it."""

    cost: int = 1
    default: bool = True
    learned: bool = True
    imitates: bool = True  # the demonstrations
    exact: bool = False


METHODS = {
    "deconfounded": Method(4),
    "deconfounded_gru": Method(14, default=False),
    "deconfounded_discrete": Method(7, default=False),
    "deconfounded_offline": Method(7, default=False),
    "dagger": Method(4, default=False, imitates=False),
    "naive_rnn": Method(2),
    "oracle_bc": Method(),
    "blind_bc": Method(),
    "conditional": Method(learned=False, imitates=False, exact=True),
    "interventional": Method(learned=False, imitates=False, exact=True),
    "expert": Method(learned=False, imitates=False),
    "random": Method(learned=False, imitates=False),
}
"""Longest first, so that the last ones to run are short. A method may score several ways of deploying one agent."""

DEFAULT = tuple(name for name, method in METHODS.items() if method.default)  # the paper's comparison
EXACT = tuple(name for name, method in METHODS.items() if method.exact)
REFERENCES = ("random", "expert")  # always run: they are the 0 and 1 of every score

PRESETS = {
    "smoke": "a minute: does everything work?",
    "default": "minutes on two cores: the figures in README",
    "paper": "ten seeds; on the bandit, the paper's own architecture and hyper-parameters (hours)",
}


def check(name: str, methods: Sequence[str] | None, seeds: int | None, known: Sequence[str]) -> None:
    """Raises InputError for a preset, methods, or a number of seeds (None: the preset's) that cannot be."""
    for method in methods or ():
        if method not in known:
            raise envs.closest("method", method, list(known))
    if name not in PRESETS:
        raise envs.closest("preset", name, list(PRESETS))
    if seeds is not None and seeds < 1:
        raise envs.InputError(f"--seeds was {seeds}; it must be at least 1")
