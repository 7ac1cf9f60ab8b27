"""Black-box tasks: other people's environments as tasks; the examples of docs/worlds.md, and a small world."""

import gc
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from deconfounded import envs
from deconfounded.benchmarks.certify import certify
from deconfounded.benchmarks.engine import protocols
from deconfounded.benchmarks.engine.presets import preset
from deconfounded.deconf import learned_reference
from deconfounded.deconf.learned_reference import LearnedGrid, learn
from deconfounded.envs.batch import BatchEnv
from deconfounded.envs.blackbox import BlackBox, task_of
from deconfounded.envs.contract.core import CONTRACT
from deconfounded.envs.contract.probe import Skipped
from deconfounded.envs.streams import Array, Mask
from deconfounded.envs.world import DrawnLatent
from deconfounded.experts import policy
from deconfounded.experts.agent import ExpertAgent, RandomAgent
from deconfounded.experts.policy import CallableExpert
from deconfounded.experts.rollout import Rollout, run_trials
from tests.toys import Push, control

WORLDS = Path(__file__).parents[2] / "docs" / "worlds"
UNSURE = np.random.default_rng(0)
EXAMPLES = ("context_pendulum.py:ContextPendulum", "reversed_cart.py:ReversedCart")


class Slide(gymnasium.Env[Any, Any]):
    """A point x, moved by action + theta + noise; `draws` numbers are drawn by reset; it ends beyond 4."""

    observation_space = spaces.Box(-9, 9, (1,))
    action_space: spaces.Space[Any] = spaces.Box(np.array([0.0], "f4"), np.array([4.0], "f4"))

    def __init__(self, theta: float, draws: int = 1) -> None:
        self.theta, self.draws = theta, draws

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.x = self.np_random.normal(size=self.draws)[:1]
        return self.x.astype("f4"), {"theta": self.theta}

    def step(self, action: Any) -> Any:
        self.action = action
        self.x = self.x + 0.2 * (np.asarray(action).reshape(1) - 2 + self.theta) + 0.3 * self.np_random.normal(size=1)
        return self.x.astype("f4"), float(-(self.x[0] ** 2)), bool(abs(self.x[0]) > 4), False, {}


class Sliding:
    """The expert pushes to 0, in the units of the environment: 2 is no push."""

    episodes, steps, noise = 2, 12, 0.1

    def make(self, theta: Any) -> Any:
        return Slide(theta[0])

    def sample_theta(self, rng: np.random.Generator) -> Any:
        return rng.uniform(-1, 1, 1)

    def expert(self, obs: Any, theta: Any) -> Any:
        return 2 - obs - theta


def task_with(**parts: Any) -> BlackBox:
    """The task of Sliding with other parts."""
    return task_of(type("Sliding", (Sliding,), parts))()


class Steps(Slide):
    """Of whole numbers from 0 to 5; it is cut off after seven steps, and counts how many of them are open."""

    action_space = spaces.Box(0, 5, (1,), np.int32)
    opened: ClassVar[list[int]] = [0]

    def __init__(self, theta: float) -> None:
        super().__init__(theta)
        self.opened[0] += 1

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.steps, self.taken = 0, list[int]()
        return super().reset(seed=seed)

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action)
        self.steps += 1
        return *super().step(action)[:2], False, self.steps == 7, {}

    def close(self) -> None:
        self.opened[0] -= 1


class Whole(Sliding):
    """The expert takes the third number."""

    noise = 0.0

    def make(self, theta: Any) -> Any:
        return Steps(theta[0])

    def expert(self, obs: Any, theta: Any) -> Any:
        return [3]


@pytest.mark.slow
def test_whole_actions() -> None:
    """All are alike to random actions, and the expert's are taken as they are."""
    task = task_of(Whole)()
    expert, rng = policy.load(task), np.random.default_rng(0)
    meant = expert.mean(np.zeros((1, 1)), np.zeros((1, 1)))[0]
    taken = [int(task.raw(meant + 0.01 * rng.standard_normal(1))[0]) for _ in range(200)]
    assert taken == [3] * 200
    chance = np.bincount([int(task.raw(rng.uniform(-1, 1, 1))[0]) for _ in range(6000)])
    assert len(chance) == 6
    assert (np.abs(chance - 1000) < 150).all(), chance  # five standard deviations
    assert [task.raw(np.array([end]))[0] for end in (-1, 1)] == [0, 5]
    for number in range(6):
        other = task_of(type("Whole", (Whole,), {"expert": lambda self, obs, theta, number=number: [number]}))()
        assert other.raw(policy.load(other).mean(np.zeros((1, 1)), np.zeros((1, 1)))[0]) == [number]
    with pytest.raises(envs.InputError, match="held NaN"):
        task.raw(np.array([np.nan]))


@pytest.mark.parametrize(("low", "high", "dtype"), [(-0.1, 0.3, "f8"), (-3.0, -0.8, "f4"), (0.1, 0.7, "f4")])
def test_scaled_actions_are_in_the_space(low: float, high: float, dtype: str) -> None:
    space = spaces.Box(low, high, (1,), np.dtype(dtype).type)
    task = task_with(make=lambda self, theta: type("Wide", (Slide,), {"action_space": space})(theta[0]))
    for action in (-1.0, -0.999, 0.3, 1.0):
        assert space.contains(task.raw(np.array([action])))


@pytest.mark.parametrize("kind", [np.uint8, np.int8])
def test_whole_actions_end_where_their_kind_does(kind: Any) -> None:
    """The largest is the largest, and not what overflows to the least."""
    low, high = np.iinfo(kind).min, np.iinfo(kind).max
    wide = type("Wide", (Slide,), {"action_space": spaces.Box(low, high, (1,), kind)})
    task = task_with(make=lambda self, theta: wide(theta[0]))
    assert [task.raw(np.array([end]))[0] for end in (-1.0, 1.0)] == [low, high]


def test_actions_of_an_infinite_range() -> None:
    huge = type("Huge", (Slide,), {"action_space": spaces.Box(-3e38, 3e38, (1,))})
    task = task_with(make=lambda self, theta: huge(theta[0]))
    with pytest.raises(envs.InputError, match="it must be bounded"):
        envs.GymEnv(task)


def test_a_world_s_own_time_limit() -> None:
    """It cuts an episode off, and ends no state: dm_env's discount stays 1."""
    task = task_of(Whole)()
    env, dm = envs.GymEnv(task), envs.DmEnv(task)
    env.reset(seed=0)
    dm.reset()
    ends, discounts = [], []
    for _ in range(7):
        ends.append(env.step(np.zeros(1))[2:4])
        discounts.append(dm.step(np.zeros(1)).discount)
    assert ends == [(False, False)] * 6 + [(False, True)]
    assert discounts == [1.0] * 7


def test_an_end_in_the_last_step() -> None:
    """It is an end, though the time is up too: dm_env's discount is 0."""

    class Short(Push):
        horizon = 1

        def terminated(self, state: Array) -> Any:
            return state[:, 0] > -9

    env, dm = envs.GymEnv(Short()), envs.DmEnv(Short())
    env.reset(seed=0)
    dm.reset()
    assert env.step(np.zeros(1))[2:4] == (True, True)
    assert dm.step(np.zeros(1)).discount == 0


def test_a_closed_world_takes_no_step() -> None:
    """Until it is reset."""
    env = BatchEnv(task_with(), 2)
    env.reset(0)
    env.close()
    with pytest.raises(envs.InputError, match=r"^step of .* was called after close; reset once$"):
        env.step(np.zeros((2, 1)))
    env.reset(0)
    env.step(np.zeros((2, 1)))


@pytest.mark.slow
def test_worlds_are_closed() -> None:
    """With their environment, as a new theta makes others, or when nobody holds it any more."""
    task = task_of(Whole)()
    assert task.horizon == 12  # a probe is made, and closed
    before = Steps.opened[0]
    for made in (envs.GymEnv(task), envs.GymVectorEnv(task, 3)):
        for seed in (0, 1):
            made.reset(seed=seed)
            assert Steps.opened[0] == before + (1 if isinstance(made, envs.GymEnv) else 3)
        made.close()
        assert Steps.opened[0] == before
    run_trials(BatchEnv(task, 4), RandomAgent(task.action_space), 2, 0)
    gc.collect()
    assert Steps.opened[0] == before


def test_a_world_whose_closing_fails() -> None:
    """Where an environment is replaced it does not matter; where the world is looked at, it is one line."""

    class Stuck(Slide):
        fails = False

        def close(self) -> None:
            if self.fails:
                raise RuntimeError("the window is gone")

    env = BatchEnv(task_with(make=lambda self, theta: Stuck(theta[0])), 2)
    env.reset(0)
    Stuck.fails = True
    env.reset(1, {"theta": [0.5]})
    simulator: Any = env.simulator
    assert [each.theta for each in simulator._envs] == [0.5, 0.5]
    with pytest.raises(envs.InputError, match=r"close of Sliding: the window is gone"):
        envs.GymEnv(task_with(make=lambda self, theta: Stuck(theta[0])))


def test_a_world_has_no_pictures() -> None:
    task = task_with()
    assert envs.GymEnv(task).metadata["render_modes"] == []
    with pytest.raises(envs.InputError, match="must be None, as a black box has no pictures"):
        envs.GymEnv(task, render_mode="rgb_array")


def test_no_observations_have_no_actions() -> None:
    task = task_with()
    expert = policy.load(task)
    assert expert.mean(np.zeros((0, 1)), np.zeros((0, 1))).shape == (0, 1)
    network = policy.load(envs.get("slippery_cartpole"))
    assert network.log_prob(np.zeros((0, 6)), np.zeros((0, 1)), np.zeros((0, 1))).shape == (0,)


def test_a_changed_task_has_what_it_was_given() -> None:
    """Not what the world says; protocol `once` changes the episodes."""
    task = task_with()
    changed = task.changed(episodes=1)
    assert (task.episodes, changed.episodes, changed.horizon) == (2, 1, 12)
    once = protocols.applied("once", task)
    trials = run_trials(envs.BatchEnv(once, 2), RandomAgent(task.action_space), once.episodes, 0).trials
    assert trials.mask.shape == (2, 1, 12)


@pytest.mark.slow
@pytest.mark.parametrize("check", CONTRACT)
@pytest.mark.parametrize("example", EXAMPLES)
def test_contract(example: str, check: str) -> None:
    """What of the contract needs no likelihood."""
    try:
        CONTRACT[check](envs.get(f"{WORLDS}/{example}"))
    except Skipped as why:
        pytest.skip(str(why))


@pytest.mark.filterwarnings("error::UserWarning")
def test_an_episode_of_one_step() -> None:
    """Nothing is stepped after its end, of which a warning would tell."""
    for check in ("observations_share_no_memory", "time_limit", "adapters_agree"):
        CONTRACT[check](task_with(steps=1))


def test_it_is_a_task() -> None:
    """By its name, as other tasks are; its amounts are those of control, and its theta is in no info."""
    task = envs.get(f"{WORLDS}/{EXAMPLES[1]}")
    assert (task.name, task.gym_id, task.n_actions) == ("reversed_cart", "deconf/ReversedCart-v0", 2)
    assert type(envs.get("reversed_cart")) is type(task)
    assert gymnasium.make("deconf/ReversedCart-v0").reset(seed=0)[1] == {}
    assert preset("default", task, "cpu", []) == preset("default", envs.get("tilted_cartpole"), "cpu", [])
    assert not isinstance(envs.get(f"{WORLDS}/{EXAMPLES[0]}"), type(task))


def test_the_contract_catches_a_generator_of_one_s_own() -> None:
    """Seeds would not reach it: all trials would have the same noise."""

    class Own(Slide):
        def __init__(self, theta: float) -> None:
            super().__init__(theta)
            self.rng = np.random.default_rng(0)

        def step(self, action: Any) -> Any:
            obs, *rest = super().step(action)
            return obs + self.rng.normal(size=1).astype("f4"), *rest

    task = task_with(make=lambda self, theta: Own(theta[0]))
    with pytest.raises(
        AssertionError, match=r"^observations of two episodes of an environment with the same seeds differ"
    ):
        CONTRACT["episodes_repeat"](task)
    CONTRACT["episodes_repeat"](task_with())


def test_actions_are_in_the_world_s_units() -> None:
    task = task_with()
    env = BatchEnv(task, 3)
    obs = env.reset(0, {"theta": [0.5]})
    expert = policy.load(task)
    assert task.expert_noise == pytest.approx(0.05)  # of half the range, which is 2
    np.testing.assert_allclose(task.expert_mean(obs, env.theta), np.clip((-obs - 0.5) / 2, -1, 1), atol=1e-6)
    env.step(np.array([[-1.0], [0.0], [1.0]]))
    simulator: Any = env.simulator
    assert [each.action.item() for each in simulator._envs] == [0.0, 2.0, 4.0]
    assert np.isfinite(expert.log_prob(obs, expert.act(obs, env.theta, np.random.default_rng(0)), env.theta)).all()
    with pytest.raises(envs.InputError, match="black box"):
        task.log_prob(obs, obs)


def test_an_expert_without_noise_has_a_density() -> None:
    """Eq. (1) needs it: of a hundredth of half the range."""
    task, zeros = task_with(noise=0.0), np.zeros((2, 1))
    expert = policy.load(task)
    assert task.expert_noise == pytest.approx(0.01)
    likely, unlikely = (expert.log_prob(zeros, zeros + off, zeros)[0] for off in (0.0, 0.01))
    assert likely == pytest.approx(-np.log(0.01 * np.sqrt(2 * np.pi)))
    assert likely - unlikely == pytest.approx(0.5)


def test_worlds_get_copies_of_theta() -> None:
    """What they do to theirs does not change an environment's."""

    def make(self: Any, theta: Any) -> Any:
        made = Slide(theta[0])
        theta *= 0
        return made

    env = BatchEnv(task_with(make=make), 2)
    env.reset(0, {"theta": [0.7]})
    np.testing.assert_array_equal(env.theta, [[0.7]] * 2)


def test_discrete_actions_start_anywhere() -> None:
    """Actions 5 and 6 are 0 and 1 here; an expert's noise is the share of random ones."""

    class Two(Slide):
        action_space = spaces.Discrete(2, start=5)

    task = task_with(make=lambda self, theta: Two(theta[0]), expert=lambda self, obs, theta: 6, noise=0.2)
    env = BatchEnv(task, 2)
    obs = env.reset(0)
    np.testing.assert_allclose(task.expert_probs(obs, env.theta), [[0.1, 0.9]] * 2)
    env.step(np.array([[0], [1]]))
    simulator: Any = env.simulator
    assert [each.action for each in simulator._envs] == [5, 6]
    with pytest.raises(envs.InputError, match="noise of Sliding was 2; of discrete actions it is a share, from 0 to 1"):
        envs.check_task(task_with(make=lambda self, theta: Two(theta[0]), noise=2))


def test_streams_are_separate() -> None:
    """Theta, start and noise come from generators of their own, however many numbers reset draws."""
    first_streams = [np.random.default_rng(np.random.SeedSequence(5 + i).spawn(3)[0]) for i in range(2)]
    drawn = np.stack([Sliding().sample_theta(rng) for rng in first_streams])
    paths = []
    for draws, theta in ((1, None), (7, None), (1, 0.7)):
        env = BatchEnv(task_with(make=lambda self, theta, draws=draws: Slide(theta[0], draws)), 2)
        first = env.reset(5, None if theta is None else {"theta": [theta]})
        forced = np.zeros((2, 1)) if theta is None else 0.2 * (theta - drawn)
        paths.append(np.array([first, *(env.step(np.zeros((2, 1)))[0] for _ in range(3))]))
        np.testing.assert_array_equal(env.theta, drawn if theta is None else [[theta]] * 2)
        paths[-1][1:] -= (np.arange(1, 4)[:, None, None] * forced).astype("f4")
    for other in paths[1:]:
        np.testing.assert_allclose(other, paths[0], atol=1e-5)


def test_episodes_that_end_early() -> None:
    """They are masked, and the next episode starts, under the same theta."""
    task = task_with(sample_theta=lambda self, rng: rng.choice([-8.0, 0.0], 1))
    env = BatchEnv(task, 16)
    trials, returns, theta = run_trials(env, ExpertAgent(env, policy.load(task), np.zeros((16, 1))), 2, 0)
    ended = ~trials.mask.all(-1)
    np.testing.assert_array_equal(ended, theta[..., 0] == -8)
    assert ended.any()
    assert not ended.all()
    assert trials.mask[:, :, 0].all()
    assert (returns < 0).all()


@pytest.mark.parametrize(("k", "values"), [(8, 4), (27, 9), (26, 8), (21, 7), (2, 2)])
def test_a_grid_of_two_latents(k: int, values: int) -> None:
    """m = floor(k^(2/3)) values of each, of perfect powers too, whose roots are rounded down."""
    two = type("Two", (Push,), {"latents": (Push.latents[0], Push.latents[0])})()
    assert two.theta_grid(k).shape == (values**2, 2)


def test_thetas_of_a_grid_can_occur() -> None:
    """On a circle, a product of quantiles would leave it."""

    def circle(self: Any, rng: np.random.Generator) -> Any:
        angle = rng.uniform(0, 2 * np.pi)
        return np.array([np.cos(angle), np.sin(angle)])

    task = task_with(sample_theta=circle, names=("east", "north"))
    grid = task.theta_grid(21)
    assert grid.shape == (49, 2)
    np.testing.assert_allclose((grid**2).sum(-1), 1)
    assert [latent.name for latent in task.latents] == ["east", "north"]
    east = task.latents[0]
    np.testing.assert_allclose(east.cdf(east.ppf(np.linspace(0.1, 0.9, 9))), np.linspace(0.1, 0.9, 9), atol=0.01)


@pytest.mark.parametrize("share", [(0.2,) * 5, (0.8, 0.1, 0.1), (0.6, 0.2, 0.2), (0.5, 0.25, 0.25, 0.0)])
@pytest.mark.parametrize("k", [21, 59])
def test_a_grid_of_a_category_in_several_numbers(share: tuple[float, ...], k: int) -> None:
    """Each of those that occur is there, as often as it occurs."""
    task = task_with(sample_theta=lambda self, rng: np.eye(len(share))[rng.choice(len(share), p=share)])
    grid = task.theta_grid(k)
    assert len(grid) <= k
    np.testing.assert_allclose(grid.mean(0), share, atol=0.04)


def test_a_rare_theta_takes_a_place_of_a_grid() -> None:
    task = task_with(sample_theta=lambda self, rng: np.eye(3)[rng.choice(3, p=[0.989, 0.01, 0.001])])
    assert sorted(np.unique(task.theta_grid(21), axis=0, return_counts=True)[1]) == [1, 1, 21]


def test_a_grid_of_numbers_that_depend_on_each_other() -> None:
    """It has their means, variances and correlation; of independent ones it has the quantiles of each."""

    def together(self: Any, rng: np.random.Generator) -> Any:
        x, y = rng.standard_normal(2)
        return np.array([x, 0.9 * x + 0.2 * y])

    def apart(self: Any, rng: np.random.Generator) -> Any:
        return rng.uniform(0, 1, 2)

    def mixed(self: Any, rng: np.random.Generator) -> Any:
        arm = rng.choice(3, p=[0.5, 0.3, 0.2])
        return np.array([*np.eye(3)[arm], arm + rng.uniform()])

    grid = task_with(sample_theta=together).theta_grid(59)
    np.testing.assert_allclose(np.cov(grid.T), [[1.0, 0.9], [0.9, 0.85]], atol=0.13)  # of draws: the tails are cut off
    grid = task_with(sample_theta=apart).theta_grid(21)
    by_quantile = np.sort(grid, 0).reshape(7, 7, 2)
    np.testing.assert_allclose(by_quantile.mean(1), np.repeat(np.arange(0.5, 7)[:, None] / 7, 2, 1), atol=0.03)
    assert abs(np.corrcoef(grid.T)[0, 1]) < 0.05
    grid = task_with(sample_theta=mixed).theta_grid(59)
    np.testing.assert_allclose(grid[:, :3].mean(0), [0.5, 0.3, 0.2], atol=0.03)
    np.testing.assert_array_equal(np.floor(grid[:, 3]), grid[:, :3].argmax(1))


def test_a_grid_of_many_numbers_is_no_larger_than_their_draws() -> None:
    task = task_with(sample_theta=lambda self, rng: rng.uniform(-1, 1, 14))
    grid = task.theta_grid(21)
    assert 128 <= len(grid) <= 500
    np.testing.assert_allclose(grid.std(0), 3**-0.5, atol=0.1)
    assert task.facts.draws.shape == (2000, 14)


def test_amounts_of_numpy_are_plain_ones() -> None:
    """Results hold them as json does."""
    task = task_with(episodes=np.int64(2), steps=np.int64(6))
    assert [type(amount) for amount in (task.episodes, task.horizon)] == [int, int]
    envs.check_task(task)


def test_an_expert_may_give_an_action_in_any_shape_of_its_size() -> None:
    task = task_with(expert=lambda self, obs, theta: 2.0 if obs[0] > 0 else np.array([[2.0]]))
    np.testing.assert_array_equal(task.expert_mean(np.array([[1.0], [-1.0]]), np.zeros((2, 1))), np.zeros((2, 1)))


def test_an_expert_is_asked_after_the_end_by_the_check_too() -> None:
    """As it is in runs, where one environment of many has ended."""

    def expert(self: Any, obs: Any, theta: Any) -> Any:
        assert abs(obs[0]) <= 4, "no action after the end"
        return 2 - 9 * obs

    task = task_with(expert=expert, sample_theta=lambda self, rng: rng.uniform(4, 9, 1))
    with pytest.raises(envs.InputError, match=r"^expert of sliding: no action after the end"):
        envs.check_task(task)


def test_a_world_of_long_steps_has_a_frame_rate() -> None:
    assert envs.GymEnv(task_with().changed(control_dt=5.0)).metadata["render_fps"] == 1


def test_a_theta_that_does_not_vary_is_left_out() -> None:
    """Before anything is measured."""
    task = task_with(sample_theta=lambda self, rng: np.array([rng.uniform(-1, 1), 10.0]), names=("push", "g"))
    with pytest.raises(envs.InputError, match=r"^g of sliding was 10 in all draws of theta; it must vary, or be left"):
        certify(task, policy.load(task))


def test_observations_that_never_change_have_no_dynamics() -> None:
    class Still(Slide):
        def step(self, action: Any) -> Any:
            super().step(action)
            return np.zeros(1, "f4"), 0.0, False, False, {}

        def reset(self, **options: Any) -> Any:
            super().reset(**options)
            return np.zeros(1, "f4"), {}

    task = task_with(make=lambda self, theta: Still(theta[0]))
    with pytest.raises(
        envs.InputError, match=r"^observations of sliding never changed within an episode; there are no"
    ):
        learn(task, policy.load(task), 8, 0)


def dict_obs(self: Any, theta: Any) -> Any:
    return type("Odd", (Slide,), {"observation_space": spaces.Dict(x=spaces.Box(-1, 1, (1,)))})(0.0)


def half_empty(self: Any, theta: Any) -> Any:
    """The second of two actions has no range."""
    low, high = np.array([-1.0, 0.5], "f4"), np.array([1.0, 0.5], "f4")
    return type("Odd", (Slide,), {"action_space": spaces.Box(low, high)})(0.0)


def of_no_numbers(self: Any, theta: Any) -> Any:
    return type("Odd", (Slide,), {"observation_space": spaces.Box(-1, 1, (0,))})(0.0)


def unbounded(self: Any, theta: Any) -> Any:
    return type("Odd", (Slide,), {"action_space": spaces.Box(-np.inf, np.inf, (1,))})(0.0)


def four(self: Any, theta: Any) -> Any:
    return type("Odd", (Slide,), {"step": lambda self, action: Slide.step(self, action)[:4]})(0.0)


def old_reset(self: Any, theta: Any) -> Any:
    return type("Odd", (Slide,), {"reset": lambda self: np.zeros(1)})(0.0)


def reset_of_one(self: Any, theta: Any) -> Any:
    return type("Odd", (Slide,), {"reset": lambda self, **options: Slide.reset(self, **options)[0]})(0.0)


def wide(self: Any, theta: Any) -> Any:
    def step(self: Slide, action: Any) -> Any:
        obs, *rest = Slide.step(self, action)
        return np.append(obs, 1.0), *rest

    return type("Odd", (Slide,), {"step": step})(0.0)


def nowhere(self: Any, theta: Any) -> Any:
    return type("Odd", (Slide,), {"step": lambda self, action: ([np.nan], *Slide.step(self, action)[1:])})(0.0)


def other_actions(self: Any, theta: Any) -> Any:
    return type("Odd", (Slide,), {"action_space": spaces.Box(0.0, 4.0 + float(theta[0]), (1,))})(theta[0])


def paid(reward: Any) -> Callable[..., Any]:
    """`make` of an environment that gives this reward."""

    def step(self: Slide, action: Any) -> Any:
        obs, _, *rest = Slide.step(self, action)
        return obs, reward, *rest

    return lambda self, theta: type("Odd", (Slide,), {"step": step})(0.0)


def over(*flags: Any) -> Callable[..., Any]:
    """`make` of an environment that gives these as `terminated` and `truncated`."""

    def step(self: Slide, action: Any) -> Any:
        obs, reward, *_ = Slide.step(self, action)
        return obs, reward, *flags, {}

    return lambda self, theta: type("Odd", (Slide,), {"step": step})(0.0)


def lost(self: Sliding, obs: Any, theta: Any) -> Any:
    """An expert that goes where it has no plan; others do not."""
    if obs[0] > 3:
        raise ValueError("there is no plan beyond 3")
    return np.full(1, 4.0)


class TestErrors:
    """Each is one line, which says what was given."""

    CASES: ClassVar[list[tuple[str, Callable[..., Any] | int | tuple[str, ...], str]]] = [
        ("make", lambda self, theta: 3, "make of Sliding gave 3; it must be a gymnasium.Env"),
        ("make", lambda self, theta: 1 / 0, r"make of Sliding: division by zero \(ZeroDivisionError, test_bl"),
        ("make", dict_obs, "observation_space of Sliding was Dict.*; it must be a Box of one axis: wrap"),
        ("make", of_no_numbers, r"observation_space of Sliding was Box.*; it must be of one number or more"),
        ("make", half_empty, r"action_space of Sliding was Box.*; it must be bounded"),
        ("make", unbounded, r"action_space of Sliding was Box\(-inf.*; it must be bounded"),
        ("make", four, "step of sliding returned 4 values; it must return obs, reward, terminated, truncated, info"),
        ("make", old_reset, "reset of Sliding takes no seed; it must be reset.seed=None, options=None., as gymn"),
        ("make", reset_of_one, "reset of sliding returned a ndarray; it must return obs, info, as gymnasium.Env"),
        ("make", wide, r"step of sliding gave an observation of shape \(2,\); it must be 1 finite numbers"),
        ("make", nowhere, r"step of sliding gave an observation of \[nan\]; it must be 1 finite numbers"),
        ("make", other_actions, r"make of sliding gave spaces .* for another theta$"),
        ("make", paid(None), "step of sliding gave the reward None; it must be a number"),
        ("make", paid(np.ones(2)), r"step of sliding gave the reward array\(\[1., 1.\]\); it must be a number"),
        ("make", over(None, False), "step of sliding gave terminated None; it must be True or False$"),
        ("make", over(False, "no"), "step of sliding gave truncated 'no'; it must be True or False$"),
        ("make", over(np.zeros(2, bool), False), r"gave terminated array\(\[False, False\]\); it must be True"),
        ("sample_theta", lambda self, rng: 0.5, "sample_theta of Sliding gave 0.5; it must be one axis"),
        ("sample_theta", lambda self, rng: [np.nan], "sample_theta of Sliding gave .nan.; it must be"),
        ("sample_theta", lambda self, rng: UNSURE.random(1), "sample_theta of sliding gave two thetas for one state"),
        ("sample_theta", lambda self, rng: [1] * rng.integers(1, 3), "it must be . finite numbers, as at first"),
        ("expert", lambda self, obs, theta: np.zeros(3), r"expert of sliding gave .* must be of shape \(1,\)"),
        ("expert", lambda self, obs, theta: None, "expert of sliding gave None for an observation; it must be of"),
        ("expert", lambda self, obs, theta: ([0.0], None), "expert of sliding gave a tuple; .* of what `predict` of "),
        ("expert", lambda self, obs, theta: UNSURE.random(1), "expert of sliding gave two actions for one observat"),
        ("steps", 0, "the number of steps of Sliding was 0"),
        *(("noise", x, rf"noise of Sliding was {x}; it must be a number from 0 up") for x in (-1, np.nan, np.inf)),
        ("expert", lost, "expert of sliding: there is no plan beyond 3 "),
        ("names", ("a", "b"), "names of Sliding were .*; they must be 1 different texts"),
    ]

    @pytest.mark.parametrize(("part", "value", "says"), CASES)
    def test_parts(self, part: str, value: Any, says: str) -> None:
        with pytest.raises(envs.InputError, match=says) as raised:
            envs.check_task(task_with(**{part: value}))
        assert "\n" not in str(raised.value)

    def test_what_is_missing(self, tmp_path: Path) -> None:
        (tmp_path / "mine.py").write_text("class Mine:\n    steps = 3\n    def make(self, theta): pass\n")
        with pytest.raises(envs.InputError, match="world Mine lacks sample_theta, expert, episodes; a world has make"):
            envs.get(f"{tmp_path}/mine.py:Mine")


class Holding(Slide):
    """A part of it holds its generator."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        made = super().reset(seed=seed)
        self.wind = self.np_random
        return made

    def step(self, action: Any) -> Any:
        return self.wind.normal(size=1).astype("f4"), 0.0, False, False, {}


def test_noise_of_a_part_of_an_environment() -> None:
    """It follows the noise's seed, though the part got its generator at the reset."""
    simulator = task_with(make=lambda self, theta: Holding(theta[0])).simulator(1)
    simulator.set_theta(0, np.zeros(1))
    rows, after = np.arange(1), []
    for noise in (7, 8):
        state = simulator.start(rows, np.array([[3.0]]), np.full((1, 12, 1), noise))
        after.append((state[0, 0], simulator.outcome(state, np.zeros((1, 1)), rows)[0, 0]))
    assert after[0][0] == after[1][0]
    assert after[0][1] != after[1][1]


class Remembering(Sliding):
    """An expert with a threshold, between whose sides it keeps its last action."""

    last = 2.0

    def expert(self, obs: Any, theta: Any) -> Any:
        self.last = self.last if abs(obs[0]) < 0.5 else float(obs[0] < 0) * 4
        return np.array([self.last])


class Tiring(Sliding):
    """An expert that is weaker once it has seen six observations."""

    def __init__(self) -> None:
        self.seen = set[float]()

    def expert(self, obs: Any, theta: Any) -> Any:
        self.seen.add(float(obs[0]))
        return super().expert(obs, theta) / (1 + (len(self.seen) > 6))


class Alike(Sliding):
    """All environments have the theta that was made last."""

    class Now(Slide):
        now = 0.0

        def step(self, action: Any) -> Any:
            self.theta = type(self).now
            return super().step(action)

    def make(self, theta: Any) -> Any:
        self.Now.now = float(theta[0])
        return self.Now(theta[0])


class Same(Sliding):
    """The same environment each time."""

    made: Slide | None = None

    def make(self, theta: Any) -> Any:
        type(self).made = type(self).made or Slide(theta[0])
        self.made.theta = float(theta[0])  # type: ignore[union-attr]
        return self.made


@pytest.mark.parametrize(
    ("world", "says"),
    [
        (Remembering, "expert of remembering gave two actions for one observation"),
        (Tiring, "expert of tiring gave two actions for one observation"),
        (Alike, "an environment of alike has another trial alone than beside another one; `make` must give a new one"),
        (Same, "an environment of same has another trial alone than beside another one"),
    ],
)
def test_parts_that_trials_share(world: type[Sliding], says: str) -> None:
    """A memory of the expert's, a theta, or all: scores would be of other trials than they say."""
    with pytest.raises(envs.InputError, match=says):
        envs.check_task(task_of(world)())


class Far(Slide):
    """Its x is given in a frame whose origin is `away`, in float64."""

    away, observation_space = 0.0, spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def reset(self, **given: Any) -> Any:
        super().reset(**given)
        return self.x + self.away, {}

    def step(self, action: Any) -> Any:
        return super().step(action)[0].astype(float) * 0 + self.x + self.away, 0.0, False, False, {}


@pytest.mark.parametrize(("away", "says"), [(0.0, ""), (1e4, ""), (5e6, "observation 0 of far is about")])
def test_coordinates_that_float32_loses(away: float, says: str) -> None:
    """As of logs: agents read float32."""

    def expert(self: Any, obs: Any, theta: Any) -> Any:
        return 2 - (obs - away) - theta

    own = type("Own", (Far,), {"away": away})
    task = task_of(type("Far", (Sliding,), {"make": lambda self, theta: own(theta[0]), "expert": expert}))()
    if says:
        with pytest.raises(
            envs.InputError, match=rf"{says} .*: float32 rounds it by up to 0\.2\d*; subtract its mean$"
        ):
            envs.check_task(task)
    else:
        envs.check_task(task)


class Running(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Rewards divided by how many there were, as by a running scale."""

    count = 0

    def step(self, action: Any) -> Any:
        self.count += 1
        obs, reward, *rest = self.env.step(action)
        return obs, float(reward) / self.count, *rest


def test_the_contract_catches_rewards_that_depend_on_earlier_episodes() -> None:
    with pytest.raises(AssertionError, match=r"^rewards of two episodes of an environment with the same seeds differ"):
        CONTRACT["episodes_repeat"](task_with(make=lambda self, theta: Running(Slide(theta[0]))))


def test_noise_is_of_trials_that_the_mean_was_not_fitted_to(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its covariance, and the exponent too."""
    used, given, original = list[Mask](), list[list[Rollout]](), learned_reference.steps

    def steps(rollouts: list[Rollout], which: Mask) -> tuple[Array, Array, Array, Array]:
        used.append(which)
        given.append(rollouts)
        return original(rollouts, which)

    monkeypatch.setattr(learned_reference, "steps", steps)
    task = Push()
    learn(task, CallableExpert(task, control, "control"), 64, 0)
    fitted, *held_out = used
    assert fitted.sum() == 48
    assert len(held_out) > 1
    assert not any((fitted & which).any() for which in held_out)
    assert len(given[0]) == 3
    assert len({*np.concatenate([rollout.theta[:, 0, 0] for rollout in given[0]])}) == 3 * 64, "fresh thetas in each"


def test_quantiles_of_draws() -> None:
    """The share of draws below, and half of those that are equal: of 0, 0, 1 and 2."""
    latent = DrawnLatent("x", "", 0.0, 2.0, values=(0.0, 0.0, 1.0, 2.0))
    np.testing.assert_allclose(latent.cdf(np.array([0.0, 1.0, 2.0])), [2 / 8, 5 / 8, 7 / 8])
    np.testing.assert_array_equal(latent.ppf(np.array([0.0, 0.49, 0.5, 0.99])), [0, 0, 1, 2])
    np.testing.assert_array_equal(latent.ppf(latent.cdf(np.array([0.0, 1.0, 2.0]))), [0, 1, 2])


@pytest.mark.slow
def test_a_clock_is_no_dynamics() -> None:
    """A share of the horizon changes by the same amount in each step, but for the rounding of float32."""

    def clocked(self: Any, theta: Any) -> Any:
        def with_time(self: Slide, obs: Any) -> Any:
            return np.append(obs, self.t / 30)

        def reset(self: Any, **options: Any) -> Any:
            self.t = 0
            return with_time(self, Slide.reset(self, **options)[0]), {}

        def step(self: Any, action: Any) -> Any:
            self.t += 1
            obs, *rest = Slide.step(self, action)
            return with_time(self, obs), *rest

        space = spaces.Box(-9, 9, (2,))
        return type("Clocked", (Slide,), {"reset": reset, "step": step, "observation_space": space})(theta[0])

    task = task_with(make=clocked, expert=lambda self, obs, theta: 2 - obs[:1] - theta, steps=30)
    dynamics = learn(task, policy.load(task), 32, 0)
    assert dynamics.scale[1] == 0 < dynamics.scale[0]
    assert 0 < dynamics.r2 < 1


@pytest.mark.slow
def test_learned_dynamics_give_the_posterior() -> None:
    """On Sliding the likelihood is Gaussian: x' - x - .2 (a + theta) has standard deviation .3."""
    task = task_with(steps=30)
    expert, env = policy.load(task), BatchEnv(task, 32)
    grid = LearnedGrid(env, expert, 15, learn(task, expert, 96, 0))
    trials, _, theta = run_trials(env, ExpertAgent(env, expert), 1, [7])
    total, exact = np.zeros((2, 32, 15))
    for t in range(30):
        obs, action, then = trials.obs[:, 0, t], trials.action[:, 0, t], trials.obs[:, 0, t + 1]
        state, following = (np.append(x, np.zeros((32, 3)), 1) for x in (obs, then))
        log_dynamics = grid.log_dynamics(state, action, following)
        true = grid.log_true(state, action, following, np.repeat(grid.theta[3:4], 32, 0))
        np.testing.assert_allclose(true, log_dynamics[:, 3], rtol=1e-6)
        total += log_dynamics
        exact -= 0.5 * ((then - obs - 0.2 * (2 * action + grid.theta.T)) / 0.3) ** 2
    means = [(w := np.exp(x - x.max(1, keepdims=True))) @ grid.theta[:, 0] / w.sum(1) for x in (total, exact)]
    assert np.abs(means[0] - means[1]).mean() < 0.1
    assert np.corrcoef(means[0], theta[:, 0, 0])[0, 1] > 0.8
