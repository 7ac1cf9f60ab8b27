"""Protocols: what a benchmark changes, alike for all methods, of the amounts of data, of a trial, or of the thetas.

A record names its protocol unless that is STANDARD. Versions of seeding and roll-outs are `identity.PROTOCOL`.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from deconfounded import envs
from deconfounded.envs.streams import Array

if TYPE_CHECKING:
    from deconfounded.benchmarks.engine.presets import Preset

STANDARD = "standard"
PROTOCOLS = {
    STANDARD: "the amounts of the preset, trials of several episodes",
    "scarce": "a sixteenth of the expert trials, of exploration and of queries",
    "unseen": "theta from the middle half of each latent's distribution in training, from the rest in evaluation",
    "once": "trials of one episode",
}
ONLY_AMOUNTS = (STANDARD, "scarce")  # differ in amounts of data, not in what is evaluated
COMPARED = (
    *("deconfounded", "deconfounded_offline", "dagger", "rma", "naive_rnn", "oracle_bc"),
    *("conditional", "interventional"),
)  # methods whose scores are compared under each protocol
LESS = 16
AMOUNTS = ("expert_trials", "explore_trials", "query_trials")
STEPWISE = ("gail",)  # methods that explore as many steps as their own settings say
EDGE = 0.25  # of the probability, at either end of a latent's distribution: thetas that training does not see


def middle(u: Array) -> Array:
    """Uniform numbers [...] -> uniform quantiles between the edges."""
    return EDGE + (1 - 2 * EDGE) * u


def edges(u: Array) -> Array:
    """Uniform numbers [...] -> uniform quantiles in the edges."""
    return 2 * EDGE * u + (1 - 2 * EDGE) * (u >= 0.5)


def why_not(protocol: str, task: envs.Task) -> str:
    """Why a task cannot be under a protocol of PROTOCOLS; empty if it can."""
    if protocol != "unseen":
        return ""
    if not task.draws_by_latents:
        return "it draws theta by its own sample_theta"
    if task.drifts or task.switches:
        return "its theta moves, and would leave the middle"
    categories = [lat.name for lat in task.latents if lat.distribution == "categorical"]
    return f"{categories[0]} is categorical, which has no middle" if categories else ""


def check(protocol: str, task: envs.Task) -> None:
    """Raises InputError for a protocol that there is not, or that the task cannot be under."""
    if protocol not in PROTOCOLS:
        raise envs.closest("protocol", protocol, list(PROTOCOLS))
    if why := why_not(protocol, task):
        raise envs.InputError(f"--protocol {protocol} is not for {task.name}: {why}")


def possible(protocol: str, methods: Sequence[str]) -> list[str]:
    """The methods to which a protocol's amounts of data apply."""
    return [name for name in methods if protocol != "scarce" or name not in STEPWISE]


def check_methods(protocol: str, methods: Sequence[str]) -> None:
    """Raises InputError for a method to which a protocol's amounts of data would not apply."""
    if strange := sorted({*methods} - {*possible(protocol, methods)}):
        raise envs.InputError(f"--protocol scarce is not for {strange[0]}: its own settings say how much it explores")


def amounts(protocol: str, preset: "Preset") -> "Preset":
    """The preset's amounts under a protocol."""
    if protocol != "scarce":
        return preset
    return replace(preset, fresh=0, **{name: max(1, getattr(preset, name) // LESS) for name in AMOUNTS})


def applied(protocol: str, task: envs.Task, evaluation: bool = False) -> envs.Task:
    """The task under a protocol: of training, or of evaluation. It never changes what p(theta) is to exact policies."""
    check(protocol, task)
    if protocol == "unseen":
        return task.changed(quantile=edges if evaluation else middle)
    if protocol == "once":
        return task.changed(episodes=1, latents=tuple(replace(latent, drift=0.0) for latent in task.latents))
    return task
