"""What there is to run, by name: methods and presets. It imports next to nothing, so that a command can list them."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import get_args

from deconfounded import envs
from deconfounded.deconf import methods
from deconfounded.deconf.core.deployment import Way
from deconfounded.deconf.method import ENVIRONMENT, USES, Method
from deconfounded.envs.support import outside


class Methods(Mapping[str, Method]):
    """Methods by name, ours and those from outside. The module of a method is imported when it is first looked at."""

    def __init__(self) -> None:
        self.outside: dict[str, Method] = {}

    def __getitem__(self, name: str) -> Method:
        if name in methods.METHODS:
            return methods.load(name).method  # type: ignore[attr-defined]
        return self.outside[name]

    def __iter__(self) -> Iterator[str]:
        yield from (*methods.METHODS, *self.outside)

    def __len__(self) -> int:
        return len(methods.METHODS) + len(self.outside)

    def __contains__(self, name: object) -> bool:
        return name in methods.METHODS or name in self.outside


METHODS = Methods()


def add(reference: str) -> str:
    """Make a method from outside (path/file.py:fit) known, for this process; returns the name that its files get.

    That is the file's, and the function's unless it is `fit`. Raises InputError if it cannot be run.
    """
    fit = outside.find("method", reference)
    if not callable(fit) or not isinstance(getattr(fit, "method", None), Method):
        raise envs.InputError(f"method {reference!r} must be a function declared with @uses(...) of what it may use")
    if ENVIRONMENT in fit.method.uses:
        raise envs.InputError(f"a method uses {ENVIRONMENT!r}; it may use {', '.join(USES)}")
    where, _, function = reference.rpartition(":")
    stem = Path(where).stem if where.endswith(".py") else where.rpartition(".")[2]
    name = re.sub(r"[^A-Za-z0-9_]", "_", stem if function == "fit" else f"{stem}_{function}")
    made = replace(fit.method, reference=outside.absolute(reference), version=0, exact=False, deployments={})
    taken = {"all", "demonstrations", *labels(methods.METHODS)}
    if name in taken or METHODS.outside.setdefault(name, made).reference != made.reference:
        raise envs.InputError(f"method {reference!r} would be called {name}, which there is already; rename its file")
    return name


def labels(names: Iterable[str]) -> list[str]:
    """What the agents of methods are called in tables, by way of deployment."""
    return [label(name, way) for name in names for way in ("", *METHODS[name].deployments)]


def label(method: str, deployment: str) -> str:
    """What a method's agent is called in tables: the method's name, and a further way of deploying it."""
    return f"{method}_{deployment}" if deployment else method


def guest(name: str) -> Method | None:
    """A method's declaration if it is from outside, for jobs: another process does not know it."""
    if name not in METHODS.outside:
        return None
    method = METHODS[name]
    return Method(method.uses, method.version, method.cost, reference=method.reference)


EXACT = ("conditional", "interventional")
REFERENCES = ("random", "expert")  # always run: they are the 0 and 1 of every score
DEFAULT = ("deconfounded", "naive_rnn", "oracle_bc", "blind_bc", *EXACT, "expert", "random")  # the paper's comparison

MOST_SEEDS = 1000
PRESETS = {
    "smoke": "a minute: does everything work?",
    "default": "minutes on two cores: the figures in README",
    "paper": "ten seeds; on the bandit, the paper's own architecture and hyper-parameters (hours)",
}


def check_names(kind: str, names: Sequence[str], allowed: Sequence[str]) -> None:
    """Raises InputError for a name that is not among those allowed."""
    for name in names:
        if name not in allowed:
            base, _, deployment = name.rpartition("_")
            if kind == "method" and base in METHODS and deployment in get_args(Way):
                right = f"give {base}, which is scored in every way that it can be deployed"
                raise envs.InputError(f"method {name!r} is none of its own; {right}")
            own = f"; one of your own is {name}:FUNCTION" if name.endswith(".py") else ""
            raise envs.closest(kind, name, list(allowed), own)


def check(name: str, methods: Sequence[str], seeds: int | None, allowed: Sequence[str]) -> None:
    """Raises InputError for a preset, methods, or a number of seeds (None: the preset's) that cannot be."""
    check_names("method", methods, allowed)
    check_names("preset", [name], list(PRESETS))
    if seeds is not None and not 1 <= seeds <= MOST_SEEDS:
        raise envs.InputError(f"--seeds was {seeds}; it must be at least 1, and at most {MOST_SEEDS:,}")
