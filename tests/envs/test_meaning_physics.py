"""Physics by what it means: returns of known policies, directions, sizes of noise, and what evidence is of."""

import json
from typing import Any

import numpy as np
import pytest

from deconfounded import envs
from deconfounded.benchmarks.engine import published
from deconfounded.benchmarks.output import records
from deconfounded.deconf import exact
from deconfounded.envs import render
from deconfounded.envs.contract.probe import actions, streams
from deconfounded.envs.edits import ModelEdit, SpecEdit
from deconfounded.envs.physics import MujocoTask
from deconfounded.envs.streams import Array, Streams
from deconfounded.envs.tasks.forked_path import ForkedPath
from deconfounded.envs.tasks.icy_road import road
from deconfounded.envs.tasks.loaded_arm import INNER, OUTER
from deconfounded.envs.tasks.patchy_road import PatchyRoad
from deconfounded.envs.tasks.windy_drone import HEIGHT
from deconfounded.experts import policy
from deconfounded.experts.agent import ExpertAgent, RandomAgent
from deconfounded.experts.policy import CallableExpert
from deconfounded.experts.rollout import run_trials
from tests import toys

UPRIGHT = (0.0, 0.0, 0.75, 1.0, 0.0, 0.0, 0.0)  # place and rotation of an ant
TASKS = envs.names()
PHYSICAL = [name for name in TASKS if isinstance(envs.get(name), MujocoTask)]


def expected(name: str, policy_name: str) -> float:
    """Mean return: the certificate's, or that of the records of a task without one."""
    certificate = published.certificate(name)
    if certificate.is_file():
        return json.loads(certificate.read_text())[f"return_{policy_name}"]
    made = records.of_task(published.RECORDS, name)
    assert made, f"{name} has neither certificate nor records; run `deconf certify --task {name}`, and put it in docs/"
    return float(np.mean([record["returns"] for record in made if record["method"] == policy_name]))


@pytest.mark.slow
@pytest.mark.parametrize("name", [*envs.SUITE, *envs.HARD])
def test_returns_are_the_certificate_s(name: str) -> None:
    """The means of 24 episodes of expert and random actions, to four standard errors and 2% of their difference."""
    env = envs.BatchEnv(envs.get(name), 24)
    made: dict[str, tuple[Any, ...]] = {
        "random": (RandomAgent(env.task.action_space), 1),
        "expert": (ExpertAgent(env, policy.load(env.task)), 2),
    }
    spread = expected(name, "expert") - expected(name, "random")
    for kind, (agent, seed) in made.items():
        returns = run_trials(env, agent, 1, seed).returns
        tolerance = 4 * returns.std() / np.sqrt(len(returns)) + 0.02 * spread
        assert returns.mean() == pytest.approx(expected(name, kind), abs=tolerance), f"{kind} on {name}"


# Task, index of its latent, a low and a high value of it, the action held, steps, joint whose velocity is read, and the
# difference that the higher value makes to it, m/s or rad/s, whose sign is what the task's page says.
DIRECTIONS = (
    ("tilted_cartpole", 0, (-0.2, 0.2), (0.0,), 10, "slider", 1.53),  # down the rail, whose x end sinks
    ("rolling_deck", 0, (-0.2, 0.2), (0.0,), 10, "slider", 1.53),
    ("slippery_cartpole", 0, (0.05, 0.25), (0.0,), 10, "hinge", 3.41),  # the axle drags the pole along
    ("heavy_payload", 0, (1.0, 3.0), (0.0,), 5, "load", -2.12),
    ("icy_stop", 0, (0.1, 0.6), (-1.0,), 5, "car", -1.23),  # braking
    ("weak_thruster", 0, (0.8, 2.0), (1.0,), 10, "height", 9.6),
    ("dragged_sled", 0, (3.0, 18.0), (0.0,), 10, "sled", -3.6),
    ("curling", 0, (0.025, 0.1), (1.0,), 10, "slide", -0.545),
    ("swapped_lander", 0, (0, 1), (0.0, 1.0), 5, "x", -0.39),  # 1 is to the right, if it is not swapped
    ("slippery_walker", 1, (-0.1, 0.18), (0.0,) * 6, 10, "rootx", -0.69),  # uphill along x
    ("loaded_arm", 0, (-20, 20), (0.0, 0.0), 5, "joint0", 3.8),  # 40 N m for .1 s, on 1 kg m^2 and some damping
    ("loaded_arm", 1, (-20, 20), (0.0, 0.0), 5, "joint1", 3.8),
)


@pytest.mark.parametrize(("name", "latent", "values", "action", "steps", "joint", "difference"), DIRECTIONS)
def test_theta_acts_in_its_direction(
    name: str, latent: int, values: tuple[float, float], action: Any, steps: int, joint: str, difference: float
) -> None:
    """From the same start, without noise."""
    task = envs.get(name)
    assert isinstance(task, MujocoTask)
    env = envs.BatchEnv(task, 2)
    thetas = np.repeat(task.theta_grid(1)[:1], 2, 0)
    thetas[:, latent] = values
    env.reset([3, 3], {"theta": thetas})
    state = env.state.copy()
    for _ in range(steps):
        state = env.simulator.outcome(state, np.tile(action, (2, 1)))
    low, high = task.qvel(state, joint)
    assert high - low == pytest.approx(difference, rel=0.05)


def test_wind_blows_along_y_and_a_load_ahead_dips_the_nose() -> None:
    """Without noise, hovering; wind to either side mirrors the path, and moves the drone sideways alone."""
    task = envs.get("windy_drone")
    assert isinstance(task, MujocoTask)
    env = envs.BatchEnv(task, 4)
    env.reset([3] * 4, {"theta": [[0, 0], [12, 0], [-12, 0], [0, 0.02]]})
    level = np.array([0, 0, 1.5, 1, 0, 0, 0], float)
    state = task.state(flight=(np.tile(level, (4, 1)), np.zeros((4, 6))))
    for _ in range(5):
        state = env.simulator.outcome(state, np.zeros((4, 4)))
    calm, left, right, laden = task.qvel(state, "flight") - task.qvel(state, "flight")[0]
    assert not calm.any()
    assert left[1] == pytest.approx(-right[1], rel=0.01)
    assert left[1] > 0.1
    assert abs(left[0]) < 0.01 * left[1]
    assert laden[4] > 0.1  # about y, left: the x axis sinks
    assert abs(laden[3]) < 0.01 * laden[4]


def test_each_latent_of_a_loaded_drone_acts_by_itself() -> None:
    """Wind carries it along; a load ahead dips the nose, one to the left that side, and a weak front left rotor both.

    Without noise, hovering, for .2 s, against a drone that nothing disturbs.
    """
    task = envs.get("loaded_drone")
    assert isinstance(task, MujocoTask)
    calm = np.array([0.0, 0.0, 0.0, 0.0, 1.0])
    changes = ((0, 12.0), (1, 12.0), (2, 0.02), (3, 0.02), (4, 0.75))
    thetas = np.array([calm, *(np.where(np.arange(5) == i, value, calm) for i, value in changes)])
    env = envs.BatchEnv(task, 6)
    env.reset(0, {"theta": thetas})
    state = task.state(flight=(np.array([[0, 0, HEIGHT, 1, 0, 0, 0]] * 6), 0))
    for _ in range(5):
        state = env.simulator.outcome(state, np.zeros((6, 4)))
    velocity = task.qvel(state, "flight")
    moved = (velocity - velocity[0])[1:, [0, 1, 3, 4]]  # along x and y; to the right about x, nose down about y
    ahead, left, nose_heavy, left_heavy, weak = np.sign(np.where(np.abs(moved) > 0.03, moved, 0)).tolist()
    assert (ahead[:2], left[:2]) == ([1, 0], [0, 1])
    assert (nose_heavy[2:], left_heavy[2:], weak[2:]) == ([0, 1], [-1, 0], [-1, 1])


@pytest.mark.parametrize("name", PHYSICAL)
def test_columns_are_what_they_are_called(name: str) -> None:
    """A column with a joint's name is its position; with `_velocity` behind it, its velocity."""
    task = envs.get(name)
    assert isinstance(task, MujocoTask)
    rng = np.random.default_rng(0)
    joints = [joint for joint in task.process_noise if np.ndim(task.qpos(task.state(), joint)) == 1]
    there = {joint: (rng.uniform(-1, 1), rng.uniform(-1, 1)) for joint in joints}
    state = task.state(**there)
    seen = dict(zip(task.observation, task.observe(state)[0].tolist(), strict=True))
    for joint, (position, velocity) in there.items():
        assert seen.get(joint, position) == pytest.approx(position)
        assert seen.get(f"{joint}_velocity", velocity) == pytest.approx(velocity)


@pytest.mark.parametrize("kind", ["compiled", "specified"])
def test_a_slope_rises_along_x(kind: str) -> None:
    """Gravity pulls back along x by g sin, and down by g cos."""
    task = envs.get("slippery_walker")
    assert isinstance(task, MujocoTask)
    if kind == "compiled":
        import copy

        import mujoco

        model = copy.copy(task.model)
        ModelEdit(model, task.model, mujoco.MjData(model)).slope(0.1)
    else:
        spec = task.spec()
        SpecEdit(spec).slope(0.1)
        model = spec.compile()
    np.testing.assert_allclose(model.opt.gravity, [-9.81 * np.sin(0.1), 0, -9.81 * np.cos(0.1)], atol=1e-9)


@pytest.mark.parametrize("name", PHYSICAL)
def test_environments_have_the_noise_that_is_stated(name: str) -> None:
    """What BatchEnv steps to is off its outcome by the stated deviations: half a chi-squared of as many coordinates."""
    task = envs.get(name)
    assert isinstance(task, MujocoTask)
    env, falls = envs.BatchEnv(task, 40), list[Array]()
    env.reset(5)
    for action in actions(task, env.n, 12):
        alive = env.alive
        outcome = env.simulator.outcome(env.state, action)
        env.step(action)
        falls.append((task.log_prob(outcome, outcome) - task.log_prob(env.state, outcome))[alive])
    fall, right = np.concatenate(falls), task.noise.size / 2
    assert fall.mean() == pytest.approx(right, abs=5 * np.sqrt(right / len(fall)))


def test_a_reading_is_evidence_of_the_state_that_it_was_taken_in() -> None:
    """The lamp of a cheetah at 2 m/s says too fast: right if 1 is hidden, wrong if 3; what was before is no matter."""
    task = envs.get("cheetah_speed")
    assert isinstance(task, MujocoTask)
    before, after = task.state(rootx=([0.0, 0.0], [0.0, 0.0])), task.state(rootx=([0.0, 0.0], [2.0, 2.0]))
    before[:, -1], after[:, -1] = -1, 1
    log_likelihood = exact.log_next(task.simulator(2), before, np.zeros((2, 6)), after, np.array([[1.0], [3.0]]))
    np.testing.assert_allclose(np.exp(log_likelihood), [0.8, 0.2])


@pytest.mark.parametrize(("lamp", "colour"), [(1, 0), (-1, 2)])
def test_the_colour_of_a_lamp(lamp: int, colour: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Red for too fast, blue for too slow, as the task says."""
    monkeypatch.setattr(render, "MujocoRenderer", lambda model: lambda state, action: model.site("lamp").rgba[:3])
    task = envs.get("cheetah_speed")
    assert isinstance(task, MujocoTask)
    state = task.state()[0]
    state[-1] = lamp
    assert np.argmax(task.renderer(np.array([1.0]))(state, np.zeros(6))) == colour


@pytest.mark.parametrize("turns", [0, 1, -2])
def test_a_car_that_has_spun_heads_where_it_did(turns: int) -> None:
    task, along = envs.get("icy_road"), road(np.zeros(1))[1]
    assert isinstance(task, MujocoTask)
    heading = along + 0.3 + 2 * np.pi * turns
    seen = task.observe(task.state(yaw=(heading, 0)))[0]
    assert seen[list(task.observation).index("heading_error")] == pytest.approx(0.3)


def test_sensors_read_the_world_after_the_step() -> None:
    """Four readings in five fit the state that they are in, as stated."""
    task = envs.get("cheetah_speed")
    assert isinstance(task, MujocoTask)
    env, right = envs.BatchEnv(task, 40), list[Array]()
    env.reset(0)
    for action in actions(task, env.n, 15):
        env.step(action)
        off = task.qvel(env.state, "rootx") - env.theta[:, 0]
        right.append((env.state[:, -1] > 0) == (off > 0))
    assert np.mean(right) == pytest.approx(0.8, abs=0.07)


@pytest.mark.parametrize("conditional", [False, True])
def test_actions_are_weighed_by_what_was_seen_before_them(conditional: bool) -> None:
    """A step of the exact policies, by hand: Eq. (3) with the expert's density, Eq. (5) without."""
    task = toys.Push()
    env = envs.BatchEnv(task, 5)
    expert = CallableExpert(task, toys.control, "control")
    agent = exact.ExactAgent(env, expert, conditional, 7)
    obs = env.reset(2)
    agent.begin(5)
    agent.reset([np.random.default_rng(0)])
    state, action = env.state, agent.act(obs)
    following = env.step(action)[0]
    agent.observe(obs, action, following, np.ones(5, bool))
    log_belief = np.zeros((5, 7))
    for k, theta in enumerate(task.theta_grid(7)):
        thetas = np.tile(theta, (5, 1))
        log_belief[:, k] = task.log_prob(env.state, task.outcome(state, action, thetas))
        if conditional:
            log_belief[:, k] += expert.log_prob(obs, action, thetas)
    log_belief -= np.logaddexp.reduce(log_belief, -1, keepdims=True)
    np.testing.assert_allclose(agent.log_belief, log_belief, atol=1e-6)


@pytest.mark.parametrize("distribution", ["uniform", "loguniform"])
def test_a_grid_is_of_mid_quantiles(distribution: Any) -> None:
    """As far from one end as from the other, in quantiles, with equal steps between them."""
    latent = envs.Latent("x", "", 0.5, 8.0, distribution)
    quantiles = latent.cdf(latent.grid(5))
    np.testing.assert_allclose(quantiles, [0.1, 0.3, 0.5, 0.7, 0.9])
    by_hand = 0.5 * 16**quantiles if distribution == "loguniform" else 0.5 + 7.5 * quantiles
    np.testing.assert_allclose(latent.grid(5), by_hand)


@pytest.mark.parametrize(
    ("name", "k", "values"), [("windy_drone", 8, 4), ("windy_drone", 27, 9), ("windy_drone", 26, 8)]
)
def test_a_grid_of_two_latents(name: str, k: int, values: int) -> None:
    """All combinations of as many values of each as k^(2/3) has room for, also where that is a whole number."""
    grid = envs.get(name).theta_grid(k)
    assert [len({*column}) for column in grid.T] == [values] * 2
    assert len({tuple(theta) for theta in grid.tolist()}) == len(grid) == values**2


def test_quantiles_of_categories() -> None:
    """Of five, each begins a fifth after the one before, and is that of all quantiles up to the next."""
    latent = envs.Latent("x", "", 2, 6, "categorical")
    begins, values = latent.cdf(latent.grid(0)), [2, 3, 4, 5, 6]
    np.testing.assert_allclose(begins, [0, 0.2, 0.4, 0.6, 0.8])
    for share in (0.01, 0.19):
        np.testing.assert_array_equal(latent.ppf(begins + share), values)


SERVOS = (  # task, joint, and its velocity under an action held at .5, without noise, as the task's page has it
    ("dragged_sled", "hand", 2 + 3 * 0.5),
    ("heavy_payload", "hook", 3 * 0.5),
    ("icy_stop", "wheel", 3 * (1 + 0.5) / 0.1),
)


@pytest.mark.parametrize(("name", "joint", "velocity"), SERVOS)
def test_servos_reach_the_speed_that_is_asked_for(name: str, joint: str, velocity: float) -> None:
    task = envs.get(name)
    assert isinstance(task, MujocoTask)
    env = envs.BatchEnv(task, 1)
    env.reset(3)
    state = env.state.copy()
    for _ in range(30):
        state = env.simulator.outcome(state, np.full((1, 1), 0.5))
    assert task.qvel(state, joint)[0] == pytest.approx(velocity, rel=0.05)


def started(name: str, n: int = 500) -> tuple[MujocoTask, Array]:
    """The task, and the states in which episodes start."""
    task = envs.get(name)
    assert isinstance(task, MujocoTask)
    env = envs.BatchEnv(task, n)
    env.reset(0)
    return task, env.state


@pytest.mark.parametrize(("name", "along", "radius"), [("icy_stop", "car", 0.1)])
def test_wheels_roll_at_the_start(name: str, along: str, radius: float) -> None:
    """The rim is as fast as the car: no slip that would tell theta before anything was done."""
    task, state = started(name)
    np.testing.assert_allclose(task.qvel(state, "wheel") * radius, task.qvel(state, along))


def test_a_target_swings_no_further_than_it_began() -> None:
    """By .3 to .5 m, whichever part of its swing it starts in."""
    task, state = started("heavy_payload", 40)
    env, heights = envs.BatchEnv(task, 40), list[Array]()
    env.reset(0)
    for _ in range(100):  # 4 s; a swing takes 3 s
        state = env.simulator.outcome(state, np.zeros((40, 1)))
        heights.append(np.abs(task.qpos(state, "target")))
    swing = np.max(heights, 0)
    assert swing.min() > 0.29
    assert swing.max() < 0.51


LIMITS = (  # task, joints, column, and what is observed: no further than a lamp or a radar reaches
    ("weak_thruster", {"height": ([1.9, 2.5, 9.0], 0.0)}, "radar", [1.9, 2.0, 2.0]),
    ("icy_stop", {"line": ([1.9, 2.5, 9.0], 0.0), "car": (0.0, 0.0)}, "to_line", [1.9, 2.0, 2.0]),
)


@pytest.mark.parametrize(("name", "joints", "column", "seen"), LIMITS)
def test_what_is_far_is_not_seen(name: str, joints: dict[str, Any], column: str, seen: list[float]) -> None:
    task = envs.get(name)
    assert isinstance(task, MujocoTask)
    np.testing.assert_allclose(task.observe(task.state(**joints))[:, list(task.observation).index(column)], seen)


@pytest.mark.parametrize(("name", "joints", "most"), [("hidden_goal", "xy", 0.03), ("forked_path", "xy", 0.03)])
def test_a_start_tells_nothing_of_the_goal(name: str, joints: str, most: float) -> None:
    """At rest, within centimetres of the middle."""
    task, state = started(name)
    for joint in joints:
        assert 0.9 * most < np.abs(task.qpos(state, joint)).max() <= most
        assert not task.qvel(state, joint).any()


def test_patches_lie_along_the_road() -> None:
    """Six of 4 m, from x = 0 on, round and round; the expert heeds that of a metre ahead."""
    task = envs.get("patchy_road")
    assert isinstance(task, PatchyRoad)
    places = np.array([0.1, 2.9, 3.1, 3.9, 4.1, 23.1, 23.9, 24.1])
    state = task.state(x=(places, 0.0))
    assert task.patch(state).tolist() == [0, 0, 0, 0, 1, 5, 5, 0]
    assert task.heeded(task.observe(state)).tolist() == [0, 0, 1, 1, 1, 0, 0, 0]
    theta = np.tile(np.arange(6.0), (8, 1))
    assert task.acting_theta(theta, state)[:, 0].tolist() == [0, 0, 0, 0, 1, 5, 5, 0]


def test_joints_that_are_not_named_are_at_rest() -> None:
    """An ant's body stands, upright, where the model has it; its quaternion is one."""
    task = envs.get("lame_ant")
    assert isinstance(task, MujocoTask)
    place = task.qpos(task.state(), "root")[0]
    np.testing.assert_array_equal(place, task.model.qpos0[:7])
    np.testing.assert_array_equal(place[3:], [1, 0, 0, 0])


def test_a_list_drifts_as_the_page_says() -> None:
    """By a quarter of the quantiles, from the middle, where few walks reach an end."""
    task = envs.get("rolling_deck")
    middle = np.full((4000, 1), task.latents[0].ppf(np.array([0.5]))[0])
    walked = task.latents[0].cdf(task.drifted(middle, Streams(np.random.default_rng(0).spawn(4000)))[:, 0])
    assert np.sqrt(np.square(walked - 0.5).mean()) == pytest.approx(0.25, rel=0.1)


def test_a_drone_starts_nearly_level() -> None:
    """Turned by up to a tenth of a radian about each axis, and by nearly as much in some episode."""
    task, state = started("windy_drone")
    w, *axes = task.qpos(state, "flight")[:, 3:].T
    angles = np.abs(2 * np.array(axes) / w)
    assert (angles.max(1) > 0.09).all()
    assert (angles <= 0.1 + 1e-9).all()


BELL = np.exp(-0.5)
REWARDS: tuple[tuple[str, dict[str, Any], list[float], list[float], float], ...] = (  # by the formula of a task's page
    ("tilted_cartpole", {"slider": 0.25, "hinge": 0.3}, [1], [0], (1 + np.cos(0.3)) / 2 * (0.3 + 0.7 * BELL)),
    ("slippery_cartpole", {"slider": -0.25, "hinge": -0.3}, [0], [0.2], (1 + np.cos(0.3)) / 2 * (0.3 + 0.7 * BELL)),
    ("heavy_payload", {"load": 1.2, "target": 1.0}, [1], [0.2], 0.8 * BELL + 0.2 * np.exp(-0.2)),
    ("dragged_sled", {"sled": 0.8, "target": 1.0}, [1], [0.2], 0.8 * BELL + 0.2 * np.exp(-0.2)),
    ("slippery_walker", {"rootx": -0.06, "rooty": 0.2}, [0.5] * 6, [0.2, 0.12], 0.1 + 0.9 * np.exp(-1) - 0.025),
    ("hidden_goal", {"x": 0.0, "y": 0.7}, [1, 1], [0], 0.8 * BELL + 0.2 * np.exp(-0.3)),
    ("icy_stop", {"line": 5.25, "car": 5.0}, [1], [0.1], 0.9 * BELL + 0.1 * np.exp(-0.25 / 3)),
    ("icy_stop", {"line": 5.0, "car": 5.25}, [-1], [0.1], 0.9 * BELL + 0.1 * np.exp(-0.25 / 3)),
    ("weak_thruster", {"height": -0.25}, [1], [15], 0.9 * BELL + 0.1 * np.exp(-0.25 / 3)),
    ("cheetah_speed", {"rootx": (0.0, 1.4)}, [0.5] * 6, [2.0], 0.8 * BELL + 0.2 * np.exp(-0.6) - 0.025),
    ("ant_goal", {"root": UPRIGHT}, [0.5] * 8, [0.3, 0.4], 0.3 + 0.4 * np.exp(-0.125) - 0.0125),
    # an engine that is off costs nothing, and half of the main one a quarter of all of it:
    ("swapped_lander", {"x": 0.3, "z": 0.4}, [-1, 0], [0], 0.2 * np.exp(-0.25) + 0.8 * BELL),
    ("swapped_lander", {"x": 0.3, "z": 0.4}, [0, 0], [1], 0.2 * np.exp(-0.25) + 0.8 * BELL - 0.05 / 8),
    ("swapped_lander", {"pitch": 0.5}, [1, -1], [1], (1 + np.cos(0.5)) / 2 - 0.05),
    ("windy_drone", {"flight": (0.0, 0.25, HEIGHT, 1, 0, 0, 0)}, [0] * 4, [4, 0], 0.7 * BELL + 0.3 * np.exp(-0.25)),
    ("loaded_arm", {"target_x": INNER + OUTER, "target_y": 0.05}, [1, 1], [0] * 4, BELL),
    ("lame_ant", {"root": (0.15, 0.2, *UPRIGHT[2:])}, [1] * 8, [1] * 4, BELL),
    ("drifting_raft", {"mark_x": 2.0, "x": 2.0, "y": 0.3}, [1, 1], [0] * 6, 0.8 * BELL + 0.2 * np.exp(-0.3)),
)


@pytest.mark.parametrize(("name", "joints", "action", "theta", "reward"), REWARDS)
def test_rewards_by_hand(
    name: str, joints: dict[str, Any], action: list[float], theta: list[float], reward: float
) -> None:
    """Of the state after a step alone: the one before is far from any mark."""
    task = envs.get(name)
    assert isinstance(task, MujocoTask)
    there = {
        joint: value if isinstance(value, tuple) and len(value) == 2 else (value, 0.0)
        for joint, value in joints.items()
    }
    after, before = task.state(**there), task.state()
    made = task.reward(before, np.array([action], float), after, np.array([theta], float))
    np.testing.assert_allclose(made, [reward], atol=1e-9)


TURNED = [(0, 0, HEIGHT, np.cos(angle / 2), np.sin(angle / 2), 0, 0) for angle in (1.5, 1.6)]  # a right angle is 1.57
ENDS = (  # task, joints, and whether an episode ends there, as the task's page has it
    ("weak_thruster", {"height": ([0.4, -0.4, -0.6], 0.0)}, [False, False, True]),
    ("icy_stop", {"line": (5.0, 0.0), "car": ([4.0, 5.4, 5.6], 0.0)}, [False, False, True]),
    ("heavy_payload", {"load": ([1.1, -1.1, 1.3, -1.3], 0.0), "target": (0.0, 0.0)}, [False, False, True, True]),
    ("windy_drone", {"flight": ([(x, 0, HEIGHT, 1, 0, 0, 0) for x in (1.4, 1.6)], 0.0)}, [False, True]),
    (
        "windy_drone",
        {"flight": ([(0, 0, HEIGHT, np.cos(x / 2), np.sin(x / 2), 0, 0) for x in (1.5, 1.6)], 0.0)},
        [False, True],
    ),
    ("tilted_cartpole", {"hinge": ([1.1, -1.1, 1.3, -1.3], 0.0)}, [False, False, True, True]),
    ("slippery_walker", {"rooty": ([0.55, -0.55, 0.65, -0.65], 0.0)}, [False, False, True, True]),
    ("swapped_lander", {"z": ([0.05, 0.05, 0.05, 1.0], [-0.9, -1.1, 1.1, -1.1])}, [False, True, False, False]),
)


@pytest.mark.parametrize(("name", "joints", "ends"), ENDS)
def test_episodes_end_with_a_fall_or_a_crash(name: str, joints: dict[str, Any], ends: list[bool]) -> None:
    """To either side; by falling fast to the ground, and neither by rising from it nor high above it."""
    task = envs.get(name)
    assert isinstance(task, MujocoTask)
    assert task.terminated(task.state(**joints)).tolist() == ends


@pytest.mark.parametrize("side", [0.0, 1.0])
def test_a_bump_is_on_the_side_away_from_the_goal(side: float) -> None:
    """8 cm off the middle, so that it pushes to the goal's."""
    task, theta = ForkedPath(), np.array([side])
    bump, goal = task.edited(task.model, theta).body("bump").pos[0], task.goal(theta[None])[0, 0]
    assert bump == pytest.approx(-0.08 * goal)


def test_an_axle_starts_at_its_set_point() -> None:
    """It does not slip in the first observation."""
    task = envs.get("slippery_cartpole")
    obs = envs.BatchEnv(task, 4).reset(0)
    np.testing.assert_array_equal(obs[:, list(task.observation).index("slip")], 0)


def test_slip_is_that_of_an_axle_s_own_wheels() -> None:
    """Of a car at rest whose front wheels turn at 20 rad/s, 5 cm from their axle: 1 m/s in front, none behind."""
    task = envs.get("icy_road")
    assert isinstance(task, MujocoTask)
    state = task.state(front_left=(0.0, 20.0), front_right=(0.0, 20.0))
    seen = dict(zip(task.observation, task.observe(state)[0].tolist(), strict=True))
    assert (seen["front_slip"], seen["rear_slip"]) == (pytest.approx(1.0), 0)


def test_slow_driving_is_worth_nothing() -> None:
    """Backwards, at rest and at .6 m/s alike; 2 m/s above that, along the road, are worth a half."""
    task = envs.get("icy_road")
    assert isinstance(task, MujocoTask)
    speeds, direction = np.array([-1.0, 0.0, 0.6, 2.6]), np.arctan(2 * np.pi / 8)  # the road's where x is 0
    distance = speeds * task.control_dt
    before = task.state(x=(np.zeros(4), 0.0))
    after = task.state(x=(distance * np.cos(direction), 0.0), y=(distance * np.sin(direction), 0.0))
    made = task.reward(before, np.zeros((4, 2)), after, np.full((4, 1), 0.3))
    np.testing.assert_allclose(made, [0, 0, 0, 0.5], atol=1e-9)


@pytest.mark.parametrize("turn", [1, -1])
def test_an_arm_turns_the_shorter_way(turn: int) -> None:
    """To a mark behind its shoulder, across the angle at which bearings change their sign."""
    task = envs.get("loaded_arm")
    assert isinstance(task, MujocoTask)
    x, y = 0.21 * np.cos(3.0), -0.21 * turn * np.sin(3.0)
    state = task.state(joint0=(3.0 * turn, 0.0), joint1=(0.0, 0.0), target_x=(x, 0.0), target_y=(y, 0.0))
    push = task.expert_mean(task.observe(state), np.array([[0.0, 0.0, 1.0, 1.0]]))
    assert np.sign(push[0, 0]) == turn


def test_a_weak_leg_gets_larger_commands() -> None:
    """With half the strength of a hip's motor the expert doubles the command of that motor, and of no other."""
    task = envs.get("lame_ant")
    assert isinstance(task, MujocoTask)
    obs = envs.BatchEnv(task, 1).reset(3)
    even = task.expert_mean(obs, np.ones((1, 4)))
    for leg in range(1, 5):
        theta = np.ones((1, 4))
        theta[0, [latent.name for latent in task.latents].index(f"strength_{leg}")] = 0.5
        expected = even.copy()
        expected[0, task.model.actuator(f"hip_{leg}").id] *= 2
        assert (expected != even).any()
        np.testing.assert_allclose(task.expert_mean(obs, theta), expected)


def test_bearings_point_to_the_goal() -> None:
    """Without noise: from half a metre ahead, of a goal a metre to the left of there, and of one 1.5 m behind."""
    task = envs.get("ant_goal")
    assert isinstance(task, MujocoTask)
    place = np.array([[0.5, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0]] * 2)
    state, goals = task.state(root=(place, 0)), np.array([[0.5, 1.0], [-1.0, 0.0]])
    seen = task.observe(task.sense(state, goals, np.zeros((2, 3))))[:, -3:]
    np.testing.assert_allclose(seen, [[1.0, 0.0, 1.0], [1.5, -1.0, 0.0]], atol=1e-9)


def test_errors_of_bearings_are_their_own() -> None:
    """And not those of the body, which is observed: they would show the goal."""
    task, rng = envs.get("ant_goal"), np.random.default_rng(0)
    assert isinstance(task, MujocoTask)
    state, theta = task.state(root=(UPRIGHT, 0.0)), np.zeros((2, 2))
    noise = rng.standard_normal((2, task.noise.size + task.readings))
    noise[1, -3:] = noise[0, -3:]
    first, second = task.sense(np.repeat(state, 2, 0), theta, noise)[:, -3:]
    np.testing.assert_array_equal(first, second)
    assert (task.sense(state.copy(), theta[:1], noise[:1] + 1)[0, -3:] != first).all()


def test_bearings_have_the_density_of_their_noise() -> None:
    """Three normal numbers of std 1.6, on their means, and as far off as one of them is."""
    task, goal = envs.get("ant_goal"), np.array([[0.5, -0.5]])
    start = task.init_state(streams(0))
    for noise in (np.zeros((1, 3)), np.array([[0.0, 1.0, 0.0]])):
        log_density = task.log_sense(task.sense(start.copy(), goal, noise), goal)[0]
        assert log_density == pytest.approx(-3 * np.log(1.6 * np.sqrt(2 * np.pi)) - np.square(noise).sum() / 2)


def test_a_push_of_a_stone_costs_a_little() -> None:
    """A thousandth at full strength, by its square, and nothing at none."""
    task = envs.get("curling")
    assert isinstance(task, MujocoTask)
    moving = task.state(slide=([-2.0] * 3, 1.0))
    made = task.reward(moving, np.array([[1.0], [0.0], [-1.0]]), moving, np.full((3, 1), 0.05))
    np.testing.assert_allclose(made, [-0.001, -0.00025, 0], atol=1e-12)


def test_a_stone_is_worth_most_at_the_tee() -> None:
    """At rest 7 m past the hog line it is worth 1, and 1.7 m off exp(-.5); before the hog line nothing."""
    task = envs.get("curling")
    assert isinstance(task, MujocoTask)
    rest = task.state(slide=([7.0, 8.7, 5.3, -1.0], 0.0))
    made = task.reward(rest, np.full((4, 1), -1.0), rest, np.full((4, 1), 0.05))
    np.testing.assert_allclose(made, [1, np.exp(-0.5), np.exp(-0.5), 0], atol=1e-9)
