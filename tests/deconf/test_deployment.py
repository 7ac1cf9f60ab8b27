"""Ways of deploying one agent: what it acts on, given its belief."""

import numpy as np
import pytest

from deconfounded import envs
from deconfounded.deconf.core.data import Draws, Signature
from deconfounded.deconf.core.deployment import Way, deployments
from deconfounded.deconf.core.latent_agent import DeconfoundedAgent
from deconfounded.deconf.core.nets import Scales
from deconfounded.deconf.exact import ExactAgent, PatchGrid
from deconfounded.envs.streams import Array, Streams
from deconfounded.experts import policy
from deconfounded.experts.rollout import run_trials

N = 64
WAYS = ("step", "episode", "mode", "mean")


class Heeded:
    """An expert that keeps the thetas by which it is to act."""

    def __init__(self, expert: policy.Expert) -> None:
        self.expert, self.thetas = expert, list[Array]()

    def act(self, obs: Array, theta: Array, rng: object) -> Array:
        self.thetas.append(theta)
        return self.expert.act(obs, theta, rng)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["bandit", "tilted_cartpole", "patchy_road"])
def test_the_theta_that_an_exact_policy_acts_on(name: str) -> None:
    """Under a belief that puts .6 on the last value of the grid and .4 on the first, in every trial, for two steps."""
    task = envs.get(name)
    env = envs.BatchEnv(task, N)
    agent = ExactAgent(env, policy.load(task), conditional=False, k=0 if name == "bandit" else 3)
    grid, acted = agent.grid, {}
    low, high = grid.theta[0], grid.theta[-1]
    for way, deploy in deployments(*WAYS).items():
        other = deploy(agent)
        other.expert = heeded = Heeded(agent.expert)
        obs = env.reset(0)
        other.begin(N)
        other.reset([np.random.default_rng(0)])
        other.log_belief = np.full_like(other.log_belief, -np.inf)
        other.log_belief[..., 0], other.log_belief[..., -1] = np.log(0.4), np.log(0.6)
        for _ in range(2):
            other.act(obs)
        acted[way] = np.stack(heeded.thetas)
    assert (acted["mode"] == high).all()
    mean = high if name == "bandit" else 0.4 * low + 0.6 * high
    np.testing.assert_allclose(acted["mean"], np.broadcast_to(mean, acted["mean"].shape))
    for way in ("step", "episode"):
        share = (acted[way] == high).mean()
        assert share == pytest.approx(0.6, abs=0.2)
        assert (acted[way] == high).any(-1).any()
    assert (acted["episode"][0] == acted["episode"][1]).all()
    assert (acted["step"][0] != acted["step"][1]).any()


@pytest.mark.parametrize(("way", "steps_differ", "episodes_differ"), [("step", True, True), ("episode", False, True)])
def test_the_latent_that_a_learned_agent_acts_on(way: Way, steps_differ: bool, episodes_differ: bool) -> None:
    """Drawn again at every step, or once an episode; in each episode of a trial by itself."""
    draws = Draws([np.random.default_rng(0)], "cpu")
    scales = Scales.plain(Signature(obs=2, action=1, actions=0, binary=False), 1)
    agent = DeconfoundedAgent.new("evidence", 3, 8, scales, draws)
    agent.way = way
    latents = []
    agent.begin(4)
    for episode in range(2):
        agent.reset([np.random.default_rng(episode)])
        latents.append([agent.latent() for _ in range(2)])
    (first, second), (later, _) = latents
    assert bool((first != second).all()) is steps_differ
    assert bool((first == second).all()) is not steps_differ
    assert bool((second != later).all()) is episodes_differ


def test_a_drawn_theta_has_each_patch_s_own_belief() -> None:
    """Beliefs that are certain of another value in each patch give just these values."""
    env = envs.BatchEnv(envs.get("patchy_road"), 3)
    grid = PatchGrid(env, policy.load(env.task), 7)
    value = (np.arange(3)[:, None] + np.arange(6)) % 7
    drawn = grid.sample(np.log(np.eye(7)[value] + 1e-300), Streams(np.random.default_rng(0).spawn(3)))
    np.testing.assert_array_equal(drawn, grid.theta[value, 0])


def test_ways_differ_in_what_comes_of_them() -> None:
    """Best-arm pulls of 100 of the exact belief: with one arm a trial, drawn before any evidence, 20 as by chance."""
    env = envs.BatchEnv(envs.get("bandit"), 400)
    agent = ExactAgent(env, policy.load(env.task), conditional=False, k=0)
    pulls = {way: run_trials(env, deploy(agent), 1, 3).returns.mean() for way, deploy in deployments(*WAYS).items()}
    assert pulls["episode"] == pytest.approx(20, abs=3)
    assert pulls["mode"] == pulls["mean"] > pulls["step"] > 50
