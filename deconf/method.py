"""A method's declaration: the data that it uses, its version, and its configuration by kind of task and preset."""

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

from deconfounded.deconf.core.sizes import LARGE_OBSERVATION, WIDE
from deconfounded.envs.support.errors import InputError
from deconfounded.experts.agent import Agent

if TYPE_CHECKING:
    from deconfounded.deconf.given import Given
    from deconfounded.envs.task import Task

USES = {
    "demonstrations": "expert trials, without theta",
    "exploration": "roll-outs of a behaviour that is blind to theta",
    "queries": "the expert's action at each step of such a roll-out",
    "theta": "the theta of each demonstration, in training",
}
ENVIRONMENT = "environment"  # the environments of evaluation, and the expert: for the suite's references alone

Deployments = Mapping[str, Callable[[Any], Agent]]
"""Further deployments of a trained agent, by name."""


@dataclass(frozen=True)
class Method:
    """A method's declaration, made by `uses`.

    uses: of USES. version: raised by hand when the method's numbers change. cost: CPU time of training relative to
    blind BC, for estimates of remaining time. on_control, on_bandit: its configuration on control tasks, and on bandits
    (None: the same). two_latents: changes to the former on tasks of two latents. smoke, smoke_bandit: changes in the
    preset `smoke`; paper: its configuration on the bandit in the preset `paper`. large: changes for large observations,
    given the configuration. deployments: further deployments of its agent, each scored. exact: an exact reference
    policy. reference: path/file.py:function of a method from outside.
    """

    uses: tuple[str, ...]
    version: int = 1
    cost: int = 4
    on_control: Any = None
    on_bandit: Any = None
    two_latents: Mapping[str, Any] = field(default_factory=dict)
    smoke: Mapping[str, Any] = field(default_factory=dict)
    smoke_bandit: Mapping[str, Any] = field(default_factory=dict)
    paper: Any = None
    large: Callable[[Any], dict[str, Any]] | None = None
    deployments: Deployments = field(default_factory=dict)
    exact: bool = False
    reference: str = ""

    @property
    def learned(self) -> bool:
        """Whether it is trained on data."""
        return bool(self.uses or self.reference) and ENVIRONMENT not in self.uses

    @property
    def tier(self) -> str:
        """The paper's tier: 1, demonstrations; 2, exploration too; 3, queries; or "sees theta", or "reference"."""
        if not self.learned:
            return "sees theta" if self.uses and not self.exact else "reference"
        if "theta" in self.uses:
            return "sees theta"
        return "3" if "queries" in self.uses else "2" if "exploration" in self.uses else "1"

    def amounts(self, preset: str, task: "Task", device: str) -> dict[str, Any]:
        """The configuration on a task, in a preset, as plain values; empty if there is none."""
        bandit = task.is_bandit
        config = self.on_bandit if bandit and self.on_bandit is not None else self.on_control
        if config is None:
            return {}
        if not bandit and len(task.latents) == 2:
            config = replace(config, **self.two_latents)
        if preset == "smoke":
            own = self.smoke_bandit or ({} if self.on_bandit else self.smoke)  # one configuration, one set of changes
            config = replace(config, **(own if bandit else self.smoke))
        if preset == "paper" and bandit and self.paper is not None:
            config = self.paper
        values = asdict(config)
        changes: dict[str, Any] = {"device": device, "drifts": task.drifts}
        if len(task.observation) >= LARGE_OBSERVATION:  # the width of a method from outside is its author's
            changes |= {**({} if self.reference else {"width": WIDE}), **(self.large(config) if self.large else {})}
        return values | {key: value for key, value in changes.items() if key in values}

    @property
    def defaults(self) -> dict[str, Any]:
        """Those of the settings of its configuration that have a default."""
        options = () if self.on_control is None else fields(self.on_control)
        return {option.name: option.default for option in options if option.default is not MISSING}

    def config(self, values: Mapping[str, Any]) -> Any:
        """A configuration of these values; None if the method has none."""
        return None if self.on_control is None else type(self.on_control)(**values)


Fit = TypeVar("Fit", bound="Callable[[Given], Agent]")


def uses(*kinds: str, **declared: Any) -> Callable[[Fit], Fit]:
    """Declare a method: `@uses("demonstrations")` above `def fit(given: Given) -> Agent`.

    kinds: of USES. declared: further fields of Method, which becomes `fit.method`. Raises InputError for others, and
    for values that no run could use.
    """
    check_uses(kinds)
    try:
        method = Method(kinds, **declared)
    except TypeError:
        may = ", ".join(name for name in Method.__dataclass_fields__ if name != "uses")
        raise InputError(f"a method declares {', '.join(declared)}; it may declare {may}") from None
    check_values(method)

    def declare(fit: Fit) -> Fit:
        fit.method = method  # type: ignore[attr-defined]
        return fit

    return declare


def check_values(method: Method) -> None:
    """Raises InputError for a version, cost or configuration that no run could use."""
    for name in ("version", "cost"):
        if type(value := getattr(method, name)) is not int or value < 1:
            raise InputError(f"a method declares {name}={value!r}; it must be a whole number from 1 up")
    for name in ("on_control", "on_bandit", "paper"):
        if (config := getattr(method, name)) is None:
            continue
        if not is_dataclass(config) or type(config) is not type(method.on_control) or isinstance(config, type):
            right = "an object of a dataclass, and all of the same"
            raise InputError(f"a method declares {name}={config!r}; configurations must be {right}")
        if nested := [each.name for each in fields(config) if is_dataclass(getattr(config, each.name))]:
            right = "numbers, texts, lists and the like, which a run's --set and results can hold"
            raise InputError(f"a method declares {name} with the dataclass {nested[0]}; its values must be {right}")
        _check_json(name, config)
    on_bandit = method.on_bandit or method.on_control
    changed = (("two_latents", method.on_control), ("smoke", method.on_control), ("smoke_bandit", on_bandit))
    for name, config in changed:
        changes, settings = getattr(method, name), [] if config is None else [each.name for each in fields(config)]
        if not isinstance(changes, Mapping) or not set(changes) <= set(settings):
            right = f"a dictionary of fields of its configuration, {', '.join(settings) or 'which has none'}"
            raise InputError(f"a method declares {name}={changes!r}; it must be {right}")
        _check_json(name, changes)


def _check_json(name: str, given: Any) -> None:
    try:
        json.dumps(asdict(given) if is_dataclass(given) else dict(given))  # type: ignore[arg-type]
    except (TypeError, ValueError) as error:
        right = f"numbers, texts, lists and the like, as json has them ({error})"
        raise InputError(f"a method declares {name}={given!r}; its values must be {right}") from None


def check_uses(kinds: Iterable[str]) -> None:
    """Raises InputError for kinds other than USES and ENVIRONMENT."""
    if wrong := [kind for kind in kinds if kind not in (*USES, ENVIRONMENT)]:
        raise InputError(f"a method uses {wrong[0]!r}; it may use {', '.join(USES)}")
