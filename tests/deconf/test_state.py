"""Whether observations show the whole state: a speed that is not logged, an action that acts late."""

import numpy as np
import pytest

from deconfounded.deconf.diagnosis import advice, state
from deconfounded.deconf.diagnosis.judgement import judge
from deconfounded.deconf.diagnosis.look import look
from deconfounded.experts.trials import Trials
from tests.deconf.test_diagnose import CLEAR, SILENT
from tests.deconf.test_lookalikes import world


def cart(speed: bool, late: bool = False, discrete: bool = False, b: int = 128) -> Trials:
    """Random pushes of a cart; speed: whether it is observed; late: pushes act a step later."""
    rng, steps = np.random.default_rng(0), 40
    pushes = rng.integers(0, 3, (b, steps)) - 1.0 if discrete else rng.uniform(-1, 1, (b, steps))
    path, v = np.zeros((b, 1, steps + 1, 2)), np.zeros(b)
    for t in range(steps):
        push = pushes[:, t - 1] * (t > 0) if late else pushes[:, t]
        v = 0.9 * v + 0.2 * push + 0.05 * rng.standard_normal(b)
        path[:, 0, t + 1] = np.stack([0.9 * path[:, 0, t, 0] + v + 0.05 * rng.standard_normal(b), v], 1)
    obs = path if speed else path[..., :1]
    action = pushes[:, None, :, None] + discrete
    return Trials(obs, action, np.ones((b, 1, steps), bool), 3 if discrete else 0)


@pytest.mark.parametrize("discrete", [False, True])
def test_a_speed_that_is_not_observed(discrete: bool) -> None:
    assert state.incomplete(cart(speed=False, discrete=discrete)) == [0]
    assert state.incomplete(cart(speed=True, discrete=discrete)) == []


def test_an_action_that_acts_late() -> None:
    assert 1 in state.incomplete(cart(speed=True, late=True))


@pytest.mark.parametrize("kind", ["ar1", "memory", "pause", "habits", "idle"])
def test_what_experts_do_is_no_state_of_the_world(kind: str) -> None:
    assert state.incomplete(world(kind, 96, 1, explores=True)) == []


def test_too_little_to_say() -> None:
    assert state.incomplete(cart(speed=False, b=32)) == []
    assert state.named(None) == []


@pytest.mark.slow
def test_some_of_many_trials() -> None:
    """Every second, or third, of which half are held out in turn."""
    for b in (1100, 2200):
        assert state.incomplete(cart(speed=False, b=b)) == [0]


def test_steps_that_did_not_take_place_do_not_count() -> None:
    """What stands there goes on, or turns, which the step before would tell."""
    trials = cart(speed=True, b=256)
    mask, obs = trials.mask.copy(), trials.obs.copy()
    mask[:, :, 20:] = False
    obs[:, :, 21:] = np.tile([1, 1, -1, -1], 5)[:, None]
    assert state.incomplete(Trials(obs, trials.action, mask)) == []


def test_the_step_before_adds_to_the_present() -> None:
    """Most of the motion is a smooth function of the present push; of what it leaves the speed is a large part."""
    trials = cart(speed=False)
    obs = trials.obs.copy()
    obs[:, :, 1:, 0] += 3 * trials.action[..., 0] ** 2
    assert state.incomplete(Trials(obs, trials.action, trials.mask)) == [0]


def test_noise_of_many_columns_tells_nothing() -> None:
    """Nor do fits that have nearly as many features as steps, whose errors are of any size."""
    rng = np.random.default_rng(0)
    for steps in (80, 400):
        obs, action = rng.standard_normal((16, 1, steps + 1, 60)), rng.uniform(-1, 1, (16, 1, steps, 8))
        assert state.incomplete(Trials(obs, action, np.ones((16, 1, steps), bool))) == []


def test_a_clone_without_a_memory_is_not_advised_there() -> None:
    """Only where trials do not differ in their dynamics: the step before tells of a latent too."""
    habits = [CLEAR._replace(**{**SILENT, "trait_gain": 0.05})] * 3
    assert judge(habits).next is advice.CLONE_HABITS
    advised = judge(habits, incomplete=["y"])
    assert (advised.verdict, advised.tier) == ("nothing at stake", 1)
    assert advised.next.fit == advice.CLONE.fit
    assert "(y) depends on the step before" in advised.next.advice
    passing = [CLEAR._replace(naive=0.98, latent=1.0)] * 3
    assert judge(passing, incomplete=["y"]).next is advice.CLONE_HABITS
    assert judge([CLEAR] * 3, incomplete=["y"]).next is advice.EXPLORE


@pytest.mark.slow
def test_a_look_at_exploration_says_so() -> None:
    for speed in (False, True):
        [remark] = [remark for remark in look(cart(speed), blind=True) if remark.kind == "dynamics"]
        assert ("(observation 0) depends on the step before" in remark.text) is not speed
