"""Where the theory ends: on each task marked so, what must fail fails, and what must work works."""

from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest

from deconfounded import envs
from deconfounded.benchmarks.engine.context import Context
from deconfounded.benchmarks.engine.presets import preset
from deconfounded.benchmarks.engine.provider import deployed, fit
from deconfounded.benchmarks.output.scoring import normalise
from deconfounded.deconf.exact import ExactAgent, Grid
from deconfounded.deconf.methods import memoryless_bc
from deconfounded.deconf.methods.deconfounded import DeconfoundedConfig
from deconfounded.deconf.methods.memoryless_bc import MemorylessConfig
from deconfounded.envs.streams import Array
from deconfounded.experts import policy
from deconfounded.experts.rollout import Agent, ExpertAgent, RandomAgent, run_trials, thetas

N, EPISODES = 48, 3


def scores(env: envs.BatchEnv, agent: Agent) -> Array:
    """Score [E] of an agent: 0 random, 1 the expert that sees theta."""
    expert = policy.load(env.task)
    zero, one, own = (
        run_trials(env, who, EPISODES, seed=7).returns.mean(0)
        for who in (RandomAgent(env.task.action_space), ExpertAgent(env, expert), agent)
    )
    return normalise(own, zero.mean(), one.mean())


@pytest.mark.parametrize("name", [name for name in envs.names() if envs.get(name).tier != 2])
def test_expert_trials_do_not_tell_theta(name: str) -> None:
    """The exact posterior, from the dynamics of expert trials, stays the prior."""
    env = envs.BatchEnv(envs.get(name), 8)
    expert = policy.load(env.task)
    grid = Grid(env, expert, 5)
    agent, obs = ExpertAgent(env, expert), env.reset(0)
    agent.reset([np.random.default_rng(0)])
    for _ in range(env.task.horizon):
        state, action = env.state, agent.act(obs)
        obs = env.step(action)[0]
        evidence = grid.log_dynamics(state, action, env.state)
        np.testing.assert_allclose(evidence, np.broadcast_to(evidence[:, :1], evidence.shape), atol=1e-9)


@pytest.mark.slow
def test_nobody_wins_where_dynamics_do_not_know() -> None:
    """hidden_goal: neither exact policy comes near the expert, and the interventional one does not learn."""
    env = envs.BatchEnv(envs.get("hidden_goal"), N)
    expert = policy.load(env.task)
    interventional, conditional = (scores(env, ExactAgent(env, expert, kind, 9)) for kind in (False, True))
    assert interventional.max() < 0.6
    assert conditional.max() < 0.6
    assert abs(interventional[-1] - interventional[0]) < 0.1


@pytest.mark.slow
def test_exact_policies_at_the_fork() -> None:
    """forked_path: the bump tells, to whom actions are no evidence; the deluded go wrong half of the time."""
    env = envs.BatchEnv(envs.get("forked_path"), N)
    expert = policy.load(env.task)
    assert scores(env, ExactAgent(env, expert, False))[-1] > 0.9
    assert scores(env, ExactAgent(env, expert, True))[-1] < 0.7


def trained(name: str, method: str, config: dict[str, Any], **amounts: Any) -> Agent:
    """A method's agent, from the default preset but for `config` of the method, and `amounts`."""
    task = envs.get(name)
    settings = replace(preset("default", task, "cpu"), **amounts).configured(method, **config)
    return fit(Context(task, settings, [0]), method)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hidden_goal", "forked_path"])
def test_tier_2_fails(name: str) -> None:
    """Given what dynamics tell, the expert trials of both are a mixture, and so is what is cloned from them."""
    config = asdict(DeconfoundedConfig(rounds=2, inference_updates=300, imitation_updates=300, final_updates=500))
    agent = trained(name, "deconfounded", config, expert_trials=64, explore_trials=32)
    assert scores(envs.BatchEnv(envs.get(name), N), agent)[-1] < 0.6


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hidden_goal", "forked_path"])
def test_who_sees_theta_can_clone(name: str) -> None:
    """What fails there is not the cloning: from as many trials, the oracle does well."""
    env = envs.BatchEnv(envs.get(name), 64)
    expert, encode = policy.load(env.task), env.task.encode_theta
    trials = run_trials(env, ExpertAgent(env, expert), env.task.episodes, seed=1).trials
    own, shown = envs.BatchEnv(env.task, N), encode(thetas(env.task, 64, env.task.episodes, 1))
    config = MemorylessConfig(updates=1500)
    oracle = memoryless_bc.train(trials, config, np.random.default_rng(0), shown, lambda: encode(own.theta))
    assert scores(own, oracle)[-1] > 0.9


@pytest.mark.slow
@pytest.mark.parametrize(("method", "atleast"), [("deconfounded", 48), ("deconfounded_discrete", 50)])
def test_tier_2_works_on_the_bandit(method: str, atleast: float) -> None:
    """Best-arm pulls of 100: exact 54 and 32; with one latent a trial, which never hears of the pay-outs, 20."""
    task = envs.get("bandit")
    context = Context(task, preset("smoke", task, "cpu"), [0])
    agents = deployed(method, fit(context, method))
    pulls, once = (run_trials(context.env, agents[way], 1, 3).returns.mean() for way in ("", "episode"))
    assert pulls > atleast
    assert once == pytest.approx(20, abs=3)
    assert context.monitor.budget["expert_trials"] == [2000]
    assert context.monitor.budget["exploration_trials"] == [1000]


@pytest.mark.slow
def test_tier_3_works_at_the_fork() -> None:
    """forked_path: who is told what the expert would do at the bump learns to go where its push points."""
    agent = trained("forked_path", "dagger", {})
    assert scores(envs.BatchEnv(envs.get("forked_path"), N), agent)[-1] > 0.7
