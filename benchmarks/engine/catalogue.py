"""What there is to run, by name: methods and presets. It imports next to nothing, so that a command can list them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from deconfounded import envs
from deconfounded.envs import outside


@dataclass(frozen=True)
class Method:
    """uses: what it is handed (`deconf.given.USES`); references are handed the environment.

    part: of a preset, that has its configuration. cost: about, where blind
    BC is 1, for the ETA alone. default: whether it runs if nobody asks for it. reference: where one from outside is.
    version: raised by hand when its numbers change; 0 for one from outside, which has none.
    """

    uses: tuple[str, ...] = ("demonstrations",)
    part: str = ""
    cost: int = 1
    default: bool = True
    exact: bool = False
    reference: str = ""
    version: int = 1

    @property
    def learned(self) -> bool:
        """Whether it is trained, on data."""
        return bool(self.uses) and "environment" not in self.uses

    @property
    def tier(self) -> str:
        """Of the paper: 1, demonstrations; 2, exploration too; 3, queries of the expert. Or what else it sees."""
        if not self.learned:
            return "sees theta" if self.uses and not self.exact else "reference"
        if "theta" in self.uses:
            return "sees theta"
        return "3" if "queries" in self.uses else "2" if "exploration" in self.uses else "1"


_EXPLORES = ("demonstrations", "exploration")
METHODS = {
    "deconfounded": Method(_EXPLORES, "deconfounded", 4),
    "deconfounded_gru": Method(_EXPLORES, "deconfounded", 14, default=False),
    "deconfounded_discrete": Method(_EXPLORES, "discrete", 7, default=False),
    "deconfounded_offline": Method(part="offline", cost=7, default=False),
    "deconfounded_mean": Method(_EXPLORES, "mean", 8, default=False),
    "dagger": Method(("queries",), "dagger", 4, default=False),
    "gail": Method(_EXPLORES, "gail", 60, default=False),
    "rma": Method((*_EXPLORES, "theta"), "rma", 4, default=False),
    "naive_transformer": Method(part="transformer", cost=30, default=False),
    "naive_obs": Method(part="obs", cost=2, default=False),
    "naive_dropout": Method(part="dropout", cost=2, default=False),
    "palr": Method(part="palr", cost=4, default=False),
    "naive_rnn": Method(part="naive", cost=2),
    "oracle_bc": Method(("demonstrations", "theta"), "cloning"),
    "blind_bc": Method(part="cloning"),
    "conditional": Method(("environment",), exact=True),
    "interventional": Method(("environment",), exact=True),
    "expert": Method(("environment",)),
    "random": Method(()),
}
"""Longest first, so that the last ones to run are short. A method may score several ways of deploying one agent."""


def add(reference: str) -> str:
    """Make a method from outside (path/file.py:fit) known, for this process; returns the name that its files get.

    That is the file's, and the function's unless it is `fit`. Raises InputError if it cannot be run.
    """
    fit = outside.find("method", reference)
    if not callable(fit) or not isinstance(getattr(fit, "uses", None), tuple):
        raise envs.InputError(f"method {reference!r} must be a function declared with @uses(...) of what it may use")
    from deconfounded.deconf.given import check_uses

    check_uses(fit.uses)
    where, _, function = reference.rpartition(":")
    stem = where.removesuffix(".py").replace("/", ".").rpartition(".")[2]
    name = re.sub(r"\W", "_", stem if function == "fit" else f"{stem}_{function}")
    made = Method(fit.uses, cost=4, default=False, reference=outside.absolute(reference), version=0)
    taken = {"all", "demonstrations", *(f"{known}_episode" for known in METHODS)}
    if name in taken or METHODS.setdefault(name, made) != made:
        raise envs.InputError(f"method {reference!r} would be called {name}, which there is already; rename its file")
    return name


def guest(name: str) -> Method | None:
    """The method's entry if it is from outside, for jobs: another process does not know it."""
    return METHODS[name] if METHODS[name].reference else None


DEFAULT = tuple(name for name, method in METHODS.items() if method.default)  # the paper's comparison
EXACT = tuple(name for name, method in METHODS.items() if method.exact)
REFERENCES = ("random", "expert")  # always run: they are the 0 and 1 of every score

MOST_SEEDS = 1000
PRESETS = {
    "smoke": "a minute: does everything work?",
    "default": "minutes on two cores: the figures in README",
    "paper": "ten seeds; on the bandit, the paper's own architecture and hyper-parameters (hours)",
}


def check_names(kind: str, names: Sequence[str], known: Sequence[str]) -> None:
    """Raises InputError for a name that is not known."""
    for name in names:
        if name not in known:
            raise envs.closest(kind, name, list(known))


def check(name: str, methods: Sequence[str] | None, seeds: int | None, known: Sequence[str]) -> None:
    """Raises InputError for a preset, methods, or a number of seeds (None: the preset's) that cannot be."""
    check_names("method", methods or (), known)
    check_names("preset", [name], list(PRESETS))
    if seeds is not None and not 1 <= seeds <= MOST_SEEDS:
        raise envs.InputError(f"--seeds was {seeds}; it must be at least 1, and at most {MOST_SEEDS:,}")
