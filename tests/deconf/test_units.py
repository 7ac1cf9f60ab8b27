"""Units of observations and actions do not matter: a method learns the same from the same trials in other units.

A few updates in double precision, in which only the observations' own rounding is left: to 1e-3 of a unit.
"""

import numpy as np
import pytest

from deconfounded.benchmarks.engine.catalogue import METHODS
from deconfounded.benchmarks.engine.context import EVALUATION, Context, stream
from deconfounded.benchmarks.engine.presets import preset
from deconfounded.benchmarks.engine.provider import fit
from deconfounded.envs.streams import Array
from deconfounded.experts.rollout import run_trials
from tests import toys
from tests.fingerprints import double, small

LEARNED = [name for name, method in METHODS.items() if method.learned and not method.exact]
CLONES = [name for name in LEARNED if set(METHODS[name].uses) <= {"demonstrations", "theta"}]
WITH_RANDOM_ACTIONS = ("deconfounded_offline",)  # these are uniform over the range, which experts do not use


def learned(name: str, task: toys.Push, expert: str) -> tuple[Array, Array]:
    """Actions at steps that took place, and returns, of an agent that is trained for a few updates."""
    with double():
        context = Context(task, small(preset("default", task, "cpu", [name])), (0,), expert=f"tests.toys:{expert}")
        agent = fit(context, name)
        trials, returns, _ = run_trials(context.env, agent, task.episodes, [stream(EVALUATION, 0, "units")])
    return trials.action[trials.mask].astype(float), returns


@pytest.mark.slow
@pytest.mark.parametrize("name", LEARNED)
def test_units_of_observations(name: str) -> None:
    action, returns = learned(name, toys.Push(), "control")
    other, other_returns = learned(name, toys.OtherUnits(), "other_control")
    np.testing.assert_allclose(other, action, atol=1e-3)
    np.testing.assert_allclose(other_returns, returns, atol=1e-3)
    assert np.ptp(action) > 0.1


@pytest.mark.parametrize("name", [name for name in CLONES if name not in WITH_RANDOM_ACTIONS])
def test_units_of_actions(name: str) -> None:
    """Where experts use a tenth or a fiftieth of the range, with an offset: a clone is as certain, and as random."""
    action, returns = learned(name, toys.StrongMotor(), "strong_control")
    other, other_returns = learned(name, toys.StrongerMotor(), "stronger_control")
    np.testing.assert_allclose(50 * (other - 0.3), 10 * action, atol=1e-3)
    np.testing.assert_allclose(other_returns, returns, atol=1e-3)
