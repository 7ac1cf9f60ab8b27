"""Ways of deploying an agent that holds a belief about a latent: how it takes the latent on which it acts.

step: drawn at every step. episode: drawn once an episode, from the belief at its start. Both are posterior sampling.
mode: the likeliest value. mean: the belief's mean. An agent's attribute `way` is one of these.
"""

import copy
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, Protocol, TypeVar, get_args

from deconfounded.envs.support.errors import InputError

Way = Literal["step", "episode", "mode", "mean"]
Belief = TypeVar("Belief")
Rng = TypeVar("Rng", contravariant=True)


class Latents(Protocol[Belief, Rng]):
    """Values of a latent that beliefs give."""

    def sample(self, belief: Belief, rng: Rng, /) -> Belief: ...
    def mode(self, belief: Belief, /) -> Belief: ...
    def mean(self, belief: Belief, /) -> Belief: ...


def acted_on(latents: Latents[Belief, Rng], way: Way, belief: Belief, rng: Rng, before: Belief | None) -> Belief:
    """The latent that an agent acts on. before: the one of the step before it, None at the start of an episode."""
    if way == "episode" and before is not None:
        return before
    if way == "mode":
        return latents.mode(belief)
    if way == "mean":
        return latents.mean(belief)
    if way not in ("step", "episode"):
        raise InputError(f"an agent's way was {way!r}; it must be {', '.join(get_args(Way)[:-1])} or mean")
    return latents.sample(belief, rng)


def deployments(*ways: Way) -> dict[str, Callable[[Any], Any]]:
    """Further deployments of a method whose agent has a `way`, for its declaration: one training, each way scored."""
    return {way: partial(_deployed, way) for way in ways}


def _deployed(way: Way, agent: Any) -> Any:
    other = copy.copy(agent)
    other.way = way
    return other
