"""How much data each preset spends, by kind of task, and with what amounts each method trains."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from deconfounded import envs
from deconfounded.benchmarks.engine.catalogue import METHODS
from deconfounded.deconf.core.sizes import fits

MOST = 1e9  # of any amount
FEWEST = 4  # trials of evaluation: of half of them, theta_r2 needs the variance


@dataclass(frozen=True)
class Preset:
    """Amounts of data, a seed, and the configurations of methods. Trials are of task.episodes episodes each."""

    seeds: int
    expert_trials: int
    explore_trials: int  # a round
    eval_trials: int
    query_trials: int  # a round
    fresh: int = 0  # expert trials drawn anew for each update of naive_rnn, and round of what does not accumulate; or 0
    device: str = "cpu"
    configs: dict[str, dict[str, Any]] = field(default_factory=dict, hash=False)  # of methods, by name

    def configured(self, method: str, **changes: Any) -> "Preset":
        """The same with other values of a method's configuration."""
        return replace(self, configs={**self.configs, method: self.configs[method] | changes})


_CONTROL = Preset(seeds=3, expert_trials=256, explore_trials=64, eval_trials=128, query_trials=48)
_BANDIT = Preset(seeds=5, expert_trials=24000, explore_trials=8000, eval_trials=4000, query_trials=2000)
_SMOKE = Preset(seeds=1, expert_trials=32, explore_trials=16, eval_trials=16, query_trials=8)
_SMOKE_BANDIT = Preset(seeds=1, expert_trials=2000, explore_trials=1000, eval_trials=1000, query_trials=500)


def preset(name: str, task: envs.Task, device: str, methods: Sequence[str] | None = None) -> Preset:
    """The amounts for a task, and the configurations of the methods (None: of all).

    Bandits have amounts of their own (`Task.is_bandit`), all others those of control.
    """
    bandit = task.is_bandit
    amounts = _BANDIT if bandit else _CONTROL
    if name == "smoke":
        amounts = _SMOKE_BANDIT if bandit else _SMOKE
    if name == "paper":
        amounts = replace(amounts, seeds=10)
        if bandit:
            amounts = replace(amounts, explore_trials=100, fresh=100)
    configs = {method: METHODS[method].amounts(name, task, device) for method in methods or METHODS}
    return replace(amounts, device=device, configs={method: values for method, values in configs.items() if values})


def whose(change: str) -> str:
    """The method whose setting a change is of: `naive_rnn.updates=500`; empty for an amount of all methods."""
    return change.partition("=")[0].rpartition(".")[0]


def changed(settings: Preset, changes: Sequence[str]) -> Preset:
    """The same with other amounts: `seeds=10`, or `naive_rnn.updates=500` for a method's.

    Raises InputError for an amount that there is not, or a value of another type.
    """
    for change in changes:
        key, _, value = change.partition("=")
        method, name = whose(change), key.rpartition(".")[2]
        if method in METHODS and method not in settings.configs:
            raise envs.InputError(f"--set had {key}, and method {method!r} has no config; it sets fields of one")
        if method not in ("", *settings.configs):
            raise envs.closest("--set method", method, list(settings.configs))
        values = settings.configs[method] if method else asdict(replace(settings, configs={}))
        amounts = [each for each in values if each not in ("device", "drifts", "configs")]
        if name not in amounts:
            raise envs.closest("--set amount", key, [f"{method}.{each}" if method else each for each in amounts])
        kind = get_type_hints(type(METHODS[method].on_control) if method else Preset)[name]
        kinds = get_args(kind) if get_origin(kind) in (Union, UnionType, Literal) else (get_origin(kind) or kind,)
        own = bool(method) and bool(METHODS[method].reference)
        new = {name: _parsed(key, value, kinds, values[name], own)}
        settings = settings.configured(method, **new) if method else replace(settings, **new)
    for method in {whose(change) for change in changes} - {""}:
        METHODS[method].config(settings.configs[method])  # raises InputError for values that do not fit each other
    return settings


def _parsed(key: str, text: str, kinds: tuple[Any, ...], now: Any, own: bool) -> Any:
    """The text as a value of one of those types, or one of those values. own: of a method from outside, of any size."""
    try:
        value = json.loads(text)
    except ValueError:
        value = text
    if own:
        value = tuple(value) if isinstance(value, list) and tuple in kinds else value
        if not fits(value, kinds, -math.inf):
            raise envs.InputError(f"--set {key} was {text!r}; it must be like {json.dumps(now)}")
        return value
    least = 0 if isinstance(now, float) or key.endswith(("updates", "fresh", "grid")) else 1
    least = FEWEST if key == "eval_trials" else least
    if fits(value, kinds, least, MOST):
        return value
    right = f"like {json.dumps(now)}"
    if not any(isinstance(kind, type) for kind in kinds):
        right = f"one of {', '.join(map(str, kinds))}"
    elif {int, float} & {*kinds}:
        right += f", and at least {least}"
    raise envs.InputError(f"--set {key} was {text!r}; it must be {right}")
