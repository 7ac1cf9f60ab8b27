"""The methods that the benchmark scores, by name: how each agent comes about, for seeds side by side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from deconfounded.benchmarks.engine.context import Allowed, Context
from deconfounded.deconf import cloning, dagger, deconfounded, naive_rnn, offline
from deconfounded.deconf.deconfounded import DeconfoundedConfig
from deconfounded.deconf.exact import ExactAgent
from deconfounded.experts.demos import Agent, ExpertAgent, RandomAgent


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
    "dagger": _dagger,
    "naive_rnn": _naive_rnn,
    "oracle_bc": _oracle,
    "blind_bc": _blind,
    "conditional": lambda context: _exact(context, True),
    "interventional": lambda context: _exact(context, False),
    "expert": lambda context: {"expert": ExpertAgent(context.env, context.expert)},
    "random": lambda context: {"random": RandomAgent(context.task.action_space)},
}
