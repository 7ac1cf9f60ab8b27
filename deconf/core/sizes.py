"""Sizes of networks, by the width of observations, values that configurations can hold, and what a heavy tail is."""

import math
from typing import Any, get_args, get_type_hints

from deconfounded.envs.support.errors import InputError

LARGE_OBSERVATION, WIDE = 16, 128  # for observations of so many numbers or more, networks on control have this width
SHARES = ("shortest", "random_share", "warm_up", "anywhere", "gamma")
MOST = dict.fromkeys(SHARES, math.nextafter(1, 2)) | dict.fromkeys(("dropout", "held_out"), 1.0)  # values are below
LEAST = {"ridge": 1e-9}  # of settings without which a regression may have no solution
HEAVY = 30.0  # excess kurtosis, of labels and columns: a normal distribution has 0, Laplace's 3
LARGE_LATENT = 8  # dimensions of theta_hat there; with 4, one seed of three was worse on ant_goal and slippery_walker


def fits(value: object, kinds: tuple[Any, ...], least: float, most: float = math.inf) -> bool:
    """Whether a value is of the types, or one of the values, in `kinds`; a number also from `least` to below `most`."""
    if not (value in kinds or type(value) in kinds or (type(value) is int and float in kinds)):
        return False
    return not isinstance(value, int | float) or isinstance(value, bool) or least <= value < most


class Configuration:
    """Base of a method's configuration, a dataclass. Raises InputError for a value of another type, or below its least.

    The least is 1, but 0 for numbers that are not whole, for updates and for grids. Shares are at most 1.
    """

    def __post_init__(self) -> None:
        for name, kind in get_type_hints(type(self)).items():
            value, kinds = getattr(self, name), get_args(kind) or (kind,)
            least = LEAST.get(name, 0 if float in kinds or name.endswith(("updates", "grid")) else 1)
            most = MOST.get(name, math.inf)
            if not fits(value, kinds, least, most):
                right = " or ".join(getattr(kind, "__name__", repr(kind)) for kind in kinds)
                limit = f", from {least:g} up" if {int, float} & set(kinds) else ""
                limit += f", below {most:g}" if most == 1 else ", at most 1" if most < math.inf else ""
                raise InputError(f"{name} of {type(self).__name__} was {value!r}; it must be {right}{limit}")
