"""Beliefs by particles: against the grid, against a closed form, and by ranks of the true theta."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.special import ndtri

from deconfounded import envs
from deconfounded.benchmarks.engine.context import Context
from deconfounded.benchmarks.engine.presets import preset
from deconfounded.benchmarks.engine.provider import fit
from deconfounded.deconf import particles
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.equations import belief_update
from deconfounded.deconf.exact import ExactAgent, Grid, grid_size
from deconfounded.deconf.methods import references
from deconfounded.deconf.particles import ParticleAgent, Particles, exact_agent, needs_particles
from deconfounded.envs.latent import Latent
from deconfounded.envs.streams import Array, Streams
from deconfounded.envs.task import Task
from deconfounded.envs.tasks.patchy_road import PatchyRoad
from deconfounded.experts import policy
from deconfounded.experts.agent import ExpertAgent
from deconfounded.experts.policy import CallableExpert
from deconfounded.experts.rollout import run_trials
from tests.toys import Arms, Push, Switch, control

N, FEW = 24, 256


@pytest.fixture(autouse=True)
def few_particles(monkeypatch: pytest.MonkeyPatch) -> None:
    """A quarter of the particles, as tests are to be cheap."""
    monkeypatch.setattr(particles, "PARTICLES", FEW)


class Three(Push):
    """A plane, in which a push acts with two hidden forces and a hidden gain: the dynamics are linear in theta."""

    name = "three"
    latents = (Latent("x", "N", -1, 1), Latent("y", "N", -1, 1), Latent("gain", "", 0, 1))
    std = np.array([0.3, 0.3])

    def outcome(self, state: Array, action: Array, theta: Array) -> Array:
        return state * 0.5 + 0.4 * (theta[:, :2] + theta[:, 2:] * action * (1, -1))

    def terminated(self, state: Array) -> np.ndarray:
        return np.zeros(len(state), bool)


class Drift(Push):
    name = "drift"
    latents = (Latent("force", "N", -1.0, 1.0, drift=0.3),)


class Kinds(Push):
    """Whether the force is to the left or to the right."""

    name = "kinds"
    latents = (Latent("side", "", 0, 1, "categorical"),)
    std = np.array([0.3, 0.3])

    def outcome(self, state: Array, action: Array, theta: Array) -> Array:
        return super().outcome(state, action, 0.4 * theta - 0.2)


class Slip(Push):
    """A push acts as far as a hidden grip lets it: steps have a kink, of grips that let all of it, and that do not."""

    name = "slip"
    latents = (Latent("grip", "N", 0.1, 0.6),)
    std = np.array([0.003, 0.003])

    def outcome(self, state: Array, action: Array, theta: Array) -> Array:
        return super().outcome(state, action.clip(-theta, theta), 0 * theta)

    def terminated(self, state: Array) -> np.ndarray:
        return np.zeros(len(state), bool)


def expert(task: Task) -> CallableExpert:
    return CallableExpert(task, lambda obs, theta: control(obs, theta[:, :1]), "toy")


class Follower(ExpertAgent):
    """The expert; beside it both beliefs of the same trials."""

    def __init__(self, env: envs.BatchEnv, grid: Grid, particles: Particles) -> None:
        super().__init__(env, grid.expert)
        self.grid, self.particles = grid, particles
        self.exact = ExactAgent(env, grid.expert, particles.conditional, grid, particles.static)

    def begin(self, n: int) -> None:
        self.particles.begin(n)
        self.exact.begin(n)

    def reset(self, rngs: Any) -> None:
        super().reset(rngs)
        self.particles.reset(self._rng)
        self.exact.reset(rngs)

    def act(self, obs: Any) -> Array:
        self._state = self.exact._state = self.env.state
        return super().act(obs)

    def observe(self, obs: Any, action: Array, next_obs: Any, alive: Any) -> None:
        self.particles.learn(self._state, obs, action, self.env.state, alive)
        self.exact.observe(obs, action, next_obs, alive)


def followed(task: Push, conditional: bool, k: int = 161) -> Follower:
    env = envs.BatchEnv(task, N)
    agent = Follower(env, Grid(env, expert(task), k), Particles(env, expert(task), conditional))
    run_trials(env, agent, 2, 0)
    return agent


CASES = [(Push(), False), (Push(), True), (Switch(), False), (Drift(), False), (Kinds(), False), (Kinds(), True)]


@pytest.mark.parametrize(("task", "conditional"), CASES, ids=lambda case: getattr(case, "name", str(case)))
def test_particles_agree_with_the_grid(task: Push, conditional: bool) -> None:
    """After two episodes of the expert: means to a fifth of a std, as of so many draws; stds to 10%.

    Actions say much at once, and are taken in by several stages.
    """
    agree(followed(task, conditional))


def agree(agent: Follower) -> None:
    belief, values = np.exp(agent.exact.log_belief), agent.grid.theta[:, 0]
    weight, theta = np.exp(agent.particles.log_weight), agent.particles.theta[..., 0]
    mean, ours = belief @ values, (weight * theta).sum(-1)
    std = np.sqrt((belief * (values - mean[:, None]) ** 2).sum(-1))
    our_std = np.sqrt((weight * (theta - ours[:, None]) ** 2).sum(-1))
    floor = 0.02  # of a std: where the grid's values are too far apart, or one category is sure
    assert np.median(np.abs(ours - mean) / (std + floor)) < 0.2
    assert np.median((our_std + floor) / (std + floor)) == pytest.approx(1, abs=0.1)
    assert std.mean() < 0.8 * values.std()


def test_true_thetas_have_uniform_ranks() -> None:
    """Of three latents, after two episodes: the rank of the true theta among the particles is uniform."""
    task = Three()
    env = envs.BatchEnv(task, 5 * N)
    agent = ParticleAgent(env, expert(task), conditional=False)
    run_trials(env, agent, 2, 0)
    weight, theta = np.exp(agent.belief.log_weight), agent.belief.theta
    rank = (weight[..., None] * (theta < env.theta[:, None])).sum(1)
    for ranks in rank.T:
        assert ranks.mean() == pytest.approx(0.5, abs=0.08)
        assert ranks.var() == pytest.approx(1 / 12, rel=0.3)
    truth = env.theta - env.theta.mean(0)
    assert (
        1 - np.square(agent.belief.mean(agent.belief.log_weight) - env.theta).mean(0) / np.square(truth).mean(0)
    ).min() > 0.3


@pytest.mark.slow
def test_a_quadratic_stands_for_simulation() -> None:
    """Of a drone in wind, posteriors by fitted outcomes are those by simulation, to .05 in total variation."""
    task, rows = envs.get("windy_drone"), np.arange(2)
    env, teacher = envs.BatchEnv(task, 2), policy.load(task)
    belief, gaps = Particles(env, teacher, False), []
    belief.begin(2)
    obs = env.reset(0)
    belief.reset(Streams([np.random.default_rng(0)]))
    for t in range(8):
        state, action = env.state, teacher.act(obs, env.theta, np.random.default_rng(1))
        env.step(action)
        if t in (0, 7):
            fitted = belief._log_prob(rows, state, obs, action, env.state)
            repeated = [np.repeat(x, FEW, 0) for x in (state, action, env.state)]
            outcome = task.outcome(*repeated[:2], belief.theta.reshape(-1, 2))
            simulated = task.log_prob(repeated[2], outcome).reshape(fitted.shape)
            posteriors = [np.exp(belief_update(belief.log_weight, x)) for x in (fitted, simulated)]
            gaps.append(np.abs(posteriors[0] - posteriors[1]).sum(-1).mean() / 2)
        belief.learn(state, obs, action, env.state, env.alive)
        obs = env.observe()
    assert max(gaps) < 0.05
    assert belief.missed < 16


@pytest.mark.parametrize(("name", "models"), [("cheetah_speed", 0), ("forked_path", FEW)])
def test_models_are_few_where_nothing_is_fitted(name: str, models: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """None where theta moves no state; as many as particles where a latent is categorical, once a transition comes.

    However many trials there are.
    """
    task, made, n = envs.get(name), list[int](), 10
    simulator = type(task).simulator
    monkeypatch.setattr(type(task), "simulator", lambda self, n: made.append(n) or simulator(self, n))
    env = envs.BatchEnv(task, n)
    belief = Particles(env, policy.load(task), False)
    made.clear()
    for transitions in (0, 1):
        obs = env.reset(0)
        belief.begin(n)
        belief.reset(Streams([*np.random.default_rng(0).spawn(n)]))
        for _ in range(transitions):
            state, action = env.state, np.zeros((n, task.action_width), np.float32)
            env.step(action)
            belief.learn(state, obs, action, env.state, env.alive)
            obs = env.observe()
        assert sum(made) == (models if transitions else 0)


def test_a_kink_does_not_mislead() -> None:
    """No true theta is left far outside of a belief, though of steps most are simulated for a few particles alone."""
    env = envs.BatchEnv(Slip(), 100)
    agent = ParticleAgent(env, expert(env.task), conditional=False)
    rollout = run_trials(env, agent, 2, 0)
    weight, theta = np.exp(agent.belief.log_weight), agent.belief.theta[..., 0]
    mean = (weight * theta).sum(-1)
    std = np.sqrt((weight * np.square(theta - mean[:, None])).sum(-1))
    assert np.abs((rollout.theta[:, -1, 0] - mean) / std).max() < 5
    assert np.median(std) < 0.01
    assert agent.belief.missed < 0.4 * rollout.trials.mask.sum()


@pytest.mark.parametrize(("mean", "std"), [(0.0, 1.0), (1.5, 0.2), (-2.5, 0.5)])
def test_a_move_keeps_mean_and_variance(mean: float, std: float) -> None:
    """In normal scores, of a belief that is normal there: those of the weighted particles before, over all trials."""
    task = Push()
    env = envs.BatchEnv(task, N)
    env.reset(0)
    belief = Particles(env, expert(task), conditional=False)
    belief.begin(N)
    belief.reset(Streams([np.random.default_rng(0)]))
    z = ndtri(belief._u[..., 0])
    log_weight = -0.5 * np.square((z - mean) / std) + 0.5 * np.square(z)  # p(theta) is that of z ~ N(0, 1)
    belief.log_weight = log_weight - np.logaddexp.reduce(log_weight, -1, keepdims=True)

    def moments() -> Array:
        weight, z = np.exp(belief.log_weight), ndtri(belief._u[..., 0])
        center = (weight * z).sum(-1)
        return np.array([center.mean(), (weight * np.square(z - center[:, None])).sum(-1).mean()])

    before = moments()
    belief._move(np.arange(N))
    once = moments()
    assert once[0] == pytest.approx(before[0], abs=0.1 * std)  # as .01 is where the std is .1
    assert once[1] == pytest.approx(before[1], rel=0.05)
    for _ in range(9):
        belief._move(np.arange(N))
    after = moments()
    assert after[0] == pytest.approx(before[0], abs=0.05)
    assert after[1] == pytest.approx(before[1], rel=0.15)


def test_of_a_latent_without_evidence_nothing_is_learned() -> None:
    """Beside two that are learned: over many moves its quantiles stay uniform, as p(theta) has them."""
    env = envs.BatchEnv(Three(), N)
    belief = Particles(env, expert(env.task), conditional=False)
    belief.begin(N)
    belief.reset(Streams([np.random.default_rng(0)]))
    for width in (0.3, 0.1, 0.03, 0.01):
        for _ in range(5):
            belief.log_weight = -0.5 * np.square((belief._u[..., :2] - 0.4) / width).sum(-1)
            belief.log_weight -= np.logaddexp.reduce(belief.log_weight, -1, keepdims=True)
            belief._move(np.arange(N))
    assert belief._u[..., :2].std() < 0.05
    unknown = belief._u[..., 2]
    assert unknown.mean() == pytest.approx(0.5, abs=0.05)
    assert unknown.std(1).mean() == pytest.approx(12**-0.5, rel=0.07)


class Boxes(Push):
    name = "boxes"
    latents = (Latent("box", "", 0, 4, "categorical"), Latent("force", "N", -1.0, 1.0))


@pytest.fixture
def boxes() -> Particles:
    """Beliefs of which .55 of the mass is at box 0, .45 at box 4, and none between, as of evidence in boxes."""
    env = envs.BatchEnv(Boxes(), N)
    belief = Particles(env, expert(env.task), conditional=False)
    belief.begin(N)
    belief.reset(Streams([np.random.default_rng(0)]))
    first, last = (belief.theta[..., 0] == box for box in (0, 4))
    weight = 0.55 * first / first.sum(-1, keepdims=True) + 0.45 * last / last.sum(-1, keepdims=True)
    belief.log_weight = np.log(weight + 1e-300)
    return belief


def test_categories_are_drawn_anew_and_not_moved(boxes: Particles) -> None:
    """To a category between two others, where there was no mass; latents beside them are moved."""
    before = boxes.theta[..., 1].copy()
    boxes._move(np.arange(N))
    assert np.isin(boxes.theta[..., 0], [0, 4]).all()
    assert (boxes.theta[..., 0] == 4).mean() == pytest.approx(0.45, abs=0.01)
    assert not np.isin(boxes.theta[..., 1], before).any()


def test_a_move_keeps_what_a_category_tells_of_other_latents(boxes: Particles) -> None:
    """In each category a force of its own, with its spread there, wide or narrow; without new evidence that stays."""
    boxes.begin(1)
    boxes.reset(Streams([np.random.default_rng(0)]))
    rng, shape = np.random.default_rng(1), boxes.theta.shape[:2]
    box = rng.integers(5, size=shape)
    std = np.where(box % 2, 0.002, 0.02)
    u = np.stack([(box + 0.5) / 5, 0.2 + 0.15 * box + std * rng.standard_normal(shape)], -1)
    boxes._set(np.arange(1), u)
    for _ in range(10):
        boxes._move(np.arange(1))
    for value in range(5):
        of = boxes._u[0, boxes.theta[0, :, 0] == value, 1]
        assert of.mean() == pytest.approx(0.2 + 0.15 * value, abs=0.02)
        assert of.std() == pytest.approx(0.002 if value % 2 else 0.02, rel=0.4)


def test_the_mean_of_a_category_is_its_likeliest_value(boxes: Particles) -> None:
    """Of all particles of each value; of the latent beside it the mean."""
    for _ in range(2):
        mean = boxes.mean(boxes.log_weight)
        assert (mean[:, 0] == 0).all()
        expected = (np.exp(boxes.log_weight) * boxes.theta[..., 1]).sum(-1)
        np.testing.assert_allclose(mean[:, 1], expected)
        boxes._move(np.arange(N))


def test_a_trial_does_not_depend_on_those_beside_it() -> None:
    """Two groups with a generator each: the second group's particles are those that it has alone."""
    task = Three()

    def final(seeds: list[int]) -> Array:
        env = envs.BatchEnv(task, 4 * len(seeds))
        agent = ParticleAgent(env, expert(task), conditional=True)
        run_trials(env, agent, 2, seeds)
        return agent.belief.theta

    np.testing.assert_array_equal(final([1, 2])[4:], final([2]))


def test_a_theta_of_an_episode_is_drawn_anew_in_the_next() -> None:
    env = envs.BatchEnv(Three(), N)
    agent, obs = ParticleAgent(env, expert(env.task), False), env.reset(0)
    agent.way = "episode"
    agent.begin(N)
    drawn = []
    for episode in range(2):
        agent.reset([np.random.default_rng(episode)])
        agent.act(obs)
        assert agent._theta is not None
        drawn.append(agent._theta.copy())
    assert (drawn[0] != drawn[1]).all()


def test_particles_are_for_many_latents() -> None:
    """Of one or two latents the exact policy has a grid; patches factorise, whatever their number."""
    for task, many in ((Push(), False), (Three(), True), (PatchyRoad(), False), (envs.get("windy_drone"), False)):
        assert needs_particles(task) == many
    env = envs.BatchEnv(Three(), 1)
    assert isinstance(exact_agent(env, expert(env.task), False), ParticleAgent)
    assert isinstance(exact_agent(env, expert(env.task), False, Grid(env, expert(env.task), 2)), ExactAgent)


def test_a_step_for_which_the_one_before_left_no_room() -> None:
    """Particles are drawn anew first, where the effective number is half of them, but for rounding."""
    task = Three()
    env = envs.BatchEnv(task, 2)
    env.reset(0)
    belief = Particles(env, expert(task), False)
    belief.begin(2)
    belief.reset(Streams([np.random.default_rng(i) for i in range(2)]))
    share = 0.5 * (1 + 1e-9)  # of particles with all of the weight: an effective number of just so many
    heavy = np.arange(FEW) < round(share * FEW)
    weight = np.where(heavy, 1.0, 1e-7)
    belief.log_weight[0] = np.log(weight / weight.sum())
    state = env.state
    env.step(np.ones((2, 1)))
    belief.learn(state, env.observe(), np.ones((2, 1)), env.state + 1.0, np.ones(2, bool))
    assert np.isfinite(belief.log_weight).all()


@pytest.mark.parametrize("name", [name for name in envs.names() if not needs_particles(envs.get(name))])
def test_grids_are_fine(name: str) -> None:
    """The exact policies' grid has 15 values or more of each continuous latent, so that its error is within noise."""
    task = envs.get(name)
    if task.is_bandit:
        return
    k = references.interventional.method.amounts("default", task, "cpu")["grid"]  # type: ignore[attr-defined]
    assert k == grid_size(task), "certificates have the same"
    for latent, values in zip(task.latents, task.theta_grid(k).T, strict=True):
        assert latent.distribution == "categorical" or len(np.unique(values)) >= 15


class Biased(Arms):
    """Two arms, of which the hidden latent says how often the first one pays: discrete actions, a uniform latent."""

    latents = (Latent("chance", "", 0.0, 1.0),)

    def outcome(self, state: Array, action: Array, theta: Array) -> Array:
        return 0.1 + 0.8 * np.where(action == 0, theta, 0.5)

    def expert_probs(self, obs: Array, theta: Array) -> Array:
        return np.concatenate([0.1 + 0.7 * theta, np.full((len(theta), 2), 0.45) - 0.35 * theta], -1)


def test_discrete_actions_and_a_latent_that_is_not_categorical() -> None:
    """The bandits' setting, in which the grid is of categories, means the usual grid of values."""
    task = Biased()
    settings = preset("default", task, "cpu", ["interventional"])
    assert settings.configs["interventional"] == {"grid": 0}
    agent = fit(Context(task, replace(settings, eval_trials=4), (0,), Monitor()), "interventional")
    assert len(agent.grid.theta) == 21


@pytest.mark.parametrize(("static", "share"), [(False, 1 - 0.9**4), (True, 0.0)])
def test_particles_switch_in_the_steps_that_an_early_end_left_out(static: bool, share: float) -> None:
    """Of an episode of seven steps three took place: one particle in ten moves in each of the other four."""
    env = envs.BatchEnv(Switch(), N)
    belief = Particles(env, expert(env.task), conditional=False, static=static)
    belief.begin(N)
    belief.reset(Streams([np.random.default_rng(0)]))
    belief._set(np.arange(N), np.full((N, FEW, 1), 0.3))
    belief._steps = 3
    belief.reset(Streams([np.random.default_rng(1)]))
    assert (belief._u != 0.3).mean() == pytest.approx(share, abs=0.03)
