"""Tasks of patches: which latent acts, and beliefs that factorise over patches."""

from typing import Any

import numpy as np
import pytest

from deconfounded import envs
from deconfounded.deconf.equations import belief_update
from deconfounded.deconf.exact import Grid, PatchGrid
from deconfounded.envs.contract.probe import actions, streams
from deconfounded.envs.streams import Array
from deconfounded.envs.tasks.drifting_raft import LAG, THRUST, DriftingRaft
from deconfounded.envs.tasks.patchy_road import PatchyRoad
from deconfounded.experts import policy


def drive(task: PatchyRoad, steps: int) -> list[tuple[Array, Array, Array, Array]]:
    """State, observation, action and next state of random driving, straight on, in eight environments."""
    env, rows = envs.BatchEnv(task, 8), []
    obs = env.reset(2)
    for action in actions(task, 8, steps) * (0.1, 1):
        before, seen = env.state, obs
        obs = env.step(action)[0]
        rows.append((before, seen, action, env.state))
    return rows


def test_the_present_patch_alone_acts() -> None:
    """Outcomes are those of icy_road with the patch's grip; the other patches' grips change no bit."""
    task, icy = PatchyRoad(), envs.get("icy_road")
    theta = task.sample_theta(envs.streams.Streams(np.random.default_rng(0).spawn(8)))
    for state, _, action, _ in drive(task, 3):
        patch = task.patch(state)
        own = np.take_along_axis(theta, patch[:, None], -1)
        outcome = task.outcome(state, action, theta)
        np.testing.assert_array_equal(outcome, icy.outcome(state, action, own))
        np.testing.assert_array_equal(outcome, task.outcome(state, action, np.where(theta == own, theta, 0.3)))
    assert len(np.unique(patch)) > 2


def test_an_open_loop_has_no_patches() -> None:
    """It would stay in the patch that each model holds."""
    env = envs.BatchEnv(PatchyRoad(), 2)
    env.reset(0)
    simulator: Any = env.simulator
    with pytest.raises(envs.InputError, match="patchy_road has a theta for each place"):
        simulator.rollout(env.state, np.zeros((2, 3, 2)))


def test_one_model_serves_rows_in_several_patches() -> None:
    """Rows of one environment in all patches are as they are alone."""
    task = PatchyRoad()
    theta = np.geomspace(0.15, 0.6, 6)
    simulator = task.simulator(1)
    simulator.set_theta(0, theta)
    state, _, action, _ = drive(task, 1)[0]
    together = simulator.outcome(state, action, np.zeros(8, int))
    np.testing.assert_array_equal(together, task.outcome(state, action, np.tile(theta, (8, 1))))


def test_the_expert_heeds_the_patch_a_metre_ahead() -> None:
    """All around the circuit, from the observation alone; its network is icy_road's, for other grips."""
    task = PatchyRoad()
    x = np.arange(0.05, 24, 0.1)
    state = task.state(x=(x, 1.0))
    heeded = task.heeded(task.observe(state).astype(np.float32))
    np.testing.assert_array_equal(heeded, (np.floor((x + 1) / 4) % 6).astype(int))
    theta = np.tile(np.geomspace(0.15, 0.6, 6), (len(x), 1))
    obs = task.observe(state)
    icy = policy.load(envs.get("icy_road")).mean(obs[:, :-2], theta[0, heeded][:, None])  # type: ignore[attr-defined]
    np.testing.assert_allclose(policy.load(task).mean(obs, theta), icy, atol=1e-5)  # type: ignore[attr-defined]


def rafts(n: int, raft: DriftingRaft) -> Array:
    """States in all streams, on the mark, as fast as it, and with the thrust that this needs in still water."""
    x, y, along, across = np.random.default_rng(0).uniform((-30, -30, -1, -1), (30, 30, 1, 1), (n, 4)).T
    state = raft.state(x=(x, along), y=(y, across), mark_x=(x, along), mark_y=(y, across))
    state[:, -2:] = np.stack([along, across], -1)
    return state


def test_marks_cross_the_streams_to_either_side() -> None:
    """At .9 to 1.4 m/s, at most 45 degrees off the x axis; half of 400, within 5 standard errors, against it."""
    raft = DriftingRaft()
    state = raft.init_state(streams(*range(400)))
    along, across = raft.qvel(state, "mark_x"), raft.qvel(state, "mark_y")
    assert (along > 0).mean() == pytest.approx(0.5, abs=5 * 0.5 / np.sqrt(400))
    assert (np.abs(across) <= np.abs(along)).all()
    speed = np.hypot(along, across)
    assert ((speed > 0.9) & (speed < 1.4)).all()


def test_the_current_of_the_present_stream_carries_the_raft() -> None:
    """It adds to the velocity along y of a raft that would else keep its velocity; other currents change nothing."""
    raft, still = DriftingRaft(), np.zeros((200, 6))
    state = rafts(200, raft)
    theta = still.copy()
    theta[np.arange(200), np.floor(raft.qpos(state, "x") % 12 / 2).astype(int)] = 0.7
    action = state[:, -2:] / THRUST
    before = raft.outcome(state, action, still)
    for axis in "xy":
        np.testing.assert_allclose(raft.qvel(before, axis), raft.qvel(state, axis), atol=1e-12)
    shift = raft.outcome(state, action, theta) - before
    dt = raft.control_dt / 2
    np.testing.assert_allclose(raft.qvel(shift, "y"), 0.7 * (1 - (1 + dt) ** -2), rtol=1e-6)  # implicit in the drag
    np.testing.assert_array_equal(raft.qvel(shift, "x"), 0)
    np.testing.assert_array_equal(raft.outcome(state, action, still + 0.7 - theta), before)


def test_the_expert_heeds_the_stream_within_the_lag() -> None:
    """Where the mark's speed takes the raft; there it pushes against the current, on the mark by nothing else."""
    raft = DriftingRaft()
    state = rafts(500, raft)
    obs = raft.observe(state)
    stream = np.floor((raft.qpos(state, "x") + LAG * raft.qvel(state, "mark_x")) % 12 / 2).astype(int)
    np.testing.assert_array_equal(raft.heeded(obs), stream)
    np.testing.assert_array_equal(raft.heeded(obs + 3 * (np.arange(14) == 2)), stream)  # whatever its own speed is
    assert len(np.unique(stream)) == 6
    currents = np.linspace(-1, 1, 6)
    wanted = (state[:, -2:] - [0, 1] * currents[stream, None]) / THRUST
    np.testing.assert_allclose(raft.expert_mean(obs, np.tile(currents, (500, 1))), wanted, atol=1e-9)


def test_actions_are_evidence_of_the_patch_that_is_heeded() -> None:
    """And a step of the patch that it was in; of others nothing is learned."""
    task, rng = PatchyRoad(), np.random.default_rng(0)
    grid, apart = PatchGrid(envs.BatchEnv(task, 8), policy.load(task), 2), 0
    for state, obs, _, _ in drive(task, 12):
        before, nothing, likely = grid.prior(8), np.zeros((8, 2)), rng.normal(size=(8, 2))
        for given, patch in (((nothing, likely), task.heeded(obs)), ((likely, None), task.patch(state))):
            learned = (grid.updated(before, state, obs, *given) != before).any(-1)
            np.testing.assert_array_equal(learned, patch[:, None] == np.arange(6))
        apart += int((task.heeded(obs) != task.patch(state)).sum())
    assert apart > 8


@pytest.mark.slow
@pytest.mark.parametrize("conditional", [False, True])
def test_the_factorised_posterior_is_the_joint_one(conditional: bool) -> None:
    """Two grips of six patches: marginals of the joint posterior over 64 thetas, after 25 steps."""
    task = PatchyRoad()
    expert, env = policy.load(task), envs.BatchEnv(task, 8)
    factored, joint = PatchGrid(env, expert, 2), Grid(env, expert, 2)
    values = factored.theta[:, 0]
    joint.theta = np.stack(np.meshgrid(*[values] * 6, indexing="ij"), -1).reshape(-1, 6)
    joint._simulator = task.simulator(64)
    for i, theta in enumerate(joint.theta):
        joint._simulator.set_theta(i, theta)
    beliefs, whole = factored.prior(8), np.full((8, 64), -np.log(64))
    for state, obs, action, following in drive(task, 25):
        log_policy = [grid.log_policy(obs, action) if conditional else None for grid in (factored, joint)]
        likely = factored.log_dynamics(state, action, following)
        beliefs = factored.updated(beliefs, state, obs, likely, log_policy[0])
        whole = belief_update(whole, joint.log_dynamics(state, action, following), log_policy[1])
    high = joint.theta == values[1]
    np.testing.assert_allclose(np.exp(beliefs)[..., 1], np.exp(whole) @ high, atol=1e-4)  # single precision
    assert np.ptp(np.exp(beliefs)[..., 1]) > 0.5
