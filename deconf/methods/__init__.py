"""Methods, a file each, and training loops that several share. A line of METHODS registers a method.

A method is a function with the decorator `uses` (deconf/method.py), given here as module:function.
"""

from collections.abc import Callable
from importlib import import_module

from deconfounded.deconf.given import Given
from deconfounded.experts.agent import Agent

METHODS = {
    "deconfounded": "deconfounded:fit",
    "deconfounded_gru": "deconfounded_gru:fit",
    "deconfounded_discrete": "deconfounded_discrete:fit",
    "deconfounded_forgetting": "deconfounded_forgetting:fit",
    "deconfounded_large": "deconfounded_large:fit",
    "deconfounded_offline": "deconfounded_offline:fit",
    "deconfounded_mean": "deconfounded_mean:fit",
    "dagger": "dagger:fit",
    "dpt": "dpt:fit",
    "gail": "gail:fit",
    "rma": "rma:fit",
    "naive_transformer": "naive_transformer:fit",
    "naive_obs": "naive_obs:fit",
    "naive_dropout": "naive_dropout:fit",
    "palr": "palr:fit",
    "dml_il": "dml_il:fit",
    "dadp": "dadp:fit",
    "flow_bc": "flow_bc:fit",
    "naive_rnn": "naive_rnn:fit",
    "oracle_bc": "oracle_bc:fit",
    "blind_bc": "blind_bc:fit",
    "conditional": "references:conditional",
    "interventional": "references:interventional",
    "expert": "references:expert",
    "random": "references:random",
}
"""In the order of tables."""


def load(name: str) -> Callable[[Given], Agent]:
    """The function of a registered method, from its module, which is imported now."""
    module, function = METHODS[name].split(":")
    return getattr(import_module(f"{__name__}.{module}"), function)
