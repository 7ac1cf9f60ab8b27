"""The methods that the benchmark scores, by name: how each agent comes about, for seeds side by side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from deconfounded.benchmarks.engine.context import EXPLORATION, Allowed, Context, stream
from deconfounded.deconf.exact import ExactAgent
from deconfounded.deconf.methods import (
    cloning,
    dagger,
    deconfounded,
    deconfounded_mean,
    gail,
    naive_obs,
    naive_rnn,
    naive_transformer,
    offline,
    palr,
    rma,
)
from deconfounded.deconf.methods.deconfounded import DeconfoundedConfig
from deconfounded.experts.rollout import Agent, ExpertAgent, RandomAgent, trial_seeds

if TYPE_CHECKING:
    from deconfounded.deconf.methods.practice import Practice


def _deploy(name: str, agent: deconfounded.DeconfoundedAgent) -> dict[str, Agent]:
    once = deconfounded.DeconfoundedAgent(agent.model, agent.policy, "episode")
    return {name: agent, f"{name}_episode": once}


def _deconfounded(context: Context | Allowed, name: str, config: DeconfoundedConfig) -> dict[str, Agent]:
    source = context.source(context.preset.fresh > 0 and not config.accumulate)
    agent = deconfounded.fit(source, context.explore, config, context.rngs, context.monitor)
    return _deploy(name, agent)


def _offline(context: Context | Allowed) -> dict[str, Agent]:
    agent = offline.fit(context.demonstrations, context.preset.offline, context.rngs, context.monitor)
    return {"deconfounded_offline": agent}


def _naive_rnn(context: Context | Allowed) -> dict[str, Agent]:
    agent = naive_rnn.fit(context.source(context.preset.fresh > 0), context.preset.naive, context.rngs, context.monitor)
    return {"naive_rnn": agent}


def _dagger(context: Context | Allowed) -> dict[str, Agent]:
    return {"dagger": dagger.fit(context.query, context.preset.dagger, context.rngs, context.monitor)}


def _mean(context: Context | Allowed) -> dict[str, Agent]:
    data, explore = context.demonstrations, context.explore
    return {
        "deconfounded_mean": deconfounded_mean.fit(data, explore, context.preset.mean, context.rngs, context.monitor)
    }


def _clone(context: Context | Allowed, name: str, fit: Callable[..., Agent], config: Any) -> dict[str, Agent]:
    return {name: fit(context.source(context.preset.fresh > 0), config, context.rngs, context.monitor)}


def _rma(context: Context | Allowed) -> dict[str, Agent]:
    context.monitor.spend("thetas", [context.preset.expert_trials] * len(context.seeds))
    theta = context.task.encode_theta(context.demonstrated_theta)
    agent = rma.fit(
        context.demonstrations, theta, context.explore_with_theta, context.preset.rma, context.rngs, context.monitor
    )
    return {"rma": agent}


def _gail(context: Context | Allowed) -> dict[str, Agent]:
    def practise(n: int, seed: int, mean: NDArray[Any], std: NDArray[Any], reward: Any) -> Practice:
        """Environments under thetas that nobody is told."""
        from deconfounded.deconf.methods.practice import Practice

        return Practice(context.task, n, trial_seeds(n, stream(EXPLORATION, seed)), mean, std, reward)

    return {"gail": gail.fit(context.demonstrations, practise, context.preset.gail, context.rngs, context.monitor)}


def _oracle(context: Context | Allowed) -> dict[str, Agent]:
    encode = context.task.encode_theta
    agent = cloning.fit(
        context.demonstrations,
        context.preset.cloning,
        context.rngs,
        encode(context.demonstrated_theta),
        lambda: encode(context.env.theta),
        context.monitor,
    )
    return {"oracle_bc": agent}


def _blind(context: Context | Allowed) -> dict[str, Agent]:
    return {
        "blind_bc": cloning.fit(context.demonstrations, context.preset.cloning, context.rngs, monitor=context.monitor)
    }


def _exact(context: Context | Allowed, conditional: bool) -> dict[str, Agent]:
    agent = ExactAgent(context.env, context.expert, conditional, context.preset.grid)
    return {"conditional" if conditional else "interventional": agent}


MAKERS: dict[str, Callable[[Context | Allowed], dict[str, Agent]]] = {
    "deconfounded": lambda context: _deconfounded(context, "deconfounded", context.preset.deconfounded),
    "deconfounded_gru": lambda context: _deconfounded(
        context, "deconfounded_gru", replace(context.preset.deconfounded, model="gru")
    ),
    "deconfounded_discrete": lambda context: _deconfounded(context, "deconfounded_discrete", context.preset.discrete),
    "deconfounded_offline": _offline,
    "deconfounded_mean": _mean,
    "dagger": _dagger,
    "gail": _gail,
    "rma": _rma,
    "naive_transformer": lambda context: _clone(
        context, "naive_transformer", naive_transformer.fit, context.preset.transformer
    ),
    "naive_obs": lambda context: _clone(context, "naive_obs", naive_obs.fit, context.preset.obs),
    "naive_dropout": lambda context: _clone(context, "naive_dropout", naive_obs.fit_dropout, context.preset.dropout),
    "palr": lambda context: _clone(context, "palr", palr.fit, context.preset.palr),
    "naive_rnn": _naive_rnn,
    "oracle_bc": _oracle,
    "blind_bc": _blind,
    "conditional": lambda context: _exact(context, True),
    "interventional": lambda context: _exact(context, False),
    "expert": lambda context: {"expert": ExpertAgent(context.env, context.expert)},
    "random": lambda context: {"random": RandomAgent(context.task.action_space)},
}
