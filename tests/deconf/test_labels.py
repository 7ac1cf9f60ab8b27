"""Columns that hold theta: the look names them, and a diagnosis says that it is not hidden."""

import numpy as np
import pytest

from deconfounded.deconf.diagnosis import labels
from deconfounded.deconf.diagnosis.judgement import judge
from deconfounded.deconf.diagnosis.look import look
from deconfounded.experts.trials import Trials
from tests.deconf.test_diagnose import CLEAR
from tests.deconf.test_lookalikes import world


def with_column(trials: Trials, column: np.ndarray) -> Trials:
    """Trials with one observation more [B], the same in all steps of a trial."""
    more = np.broadcast_to(column[:, None, None, None], trials.obs.shape)
    return Trials(np.concatenate([trials.obs, more], -1), trials.action, trials.mask)


def explored(kind: str, informative: bool) -> Trials:
    """Exploration with a column that is the wind, or a number that says nothing; `world` draws the wind first."""
    column = np.random.default_rng(1 if informative else 7).uniform(-1, 1, 96)
    return with_column(world(kind, 96, 1, explores=True), column)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "informative", "columns"), [("wind", True, [1]), ("wind", False, []), ("idle", False, [])]
)
def test_theta_among_observations(kind: str, informative: bool, columns: list[int]) -> None:
    """A column that shows how trials differ; one that does not, and one of trials that do not differ."""
    trials = explored(kind, informative)
    assert labels.constant(trials) == [1]
    assert labels.of_dynamics(trials) == columns
    remarks = [remark.text for remark in look(trials, blind=True) if remark.kind == "dynamics"]
    assert ["observations show how: observation 1" in text for text in remarks] == [bool(columns)]


def test_constant_means_in_all_steps_of_a_trial_and_not_in_all_trials() -> None:
    trials = world("idle", 24, 0)
    assert labels.constant(trials) == []
    assert labels.constant(with_column(trials, np.zeros(24))) == []
    obs, mask = with_column(trials, np.arange(24.0)).obs.copy(), trials.mask.copy()
    obs[3, :, 5:, 1] += 1
    assert labels.constant(Trials(obs, trials.action, mask)) == []
    mask[3, :, 5:] = False  # steps that did not take place
    column = Trials(obs, trials.action, mask)
    assert labels.constant(column) == [1]
    mask[7] = False  # a trial that did not take place
    assert labels.constant(Trials(obs, trials.action, mask)) == [1]
    [remark] = [remark for remark in look(column) if remark.kind == "label"]
    assert remark.odd
    assert "observation 1" in remark.text


def test_verdict() -> None:
    """Where past actions add nothing, and a column shows how trials differ; where they add, it decides nothing."""
    nothing = CLEAR._replace(memory_gain=0.0, latent_gain=0.0, exploration_evidence=0.0, dynamics_differ=0.0)
    assert judge([nothing] * 3).verdict == "cannot tell"
    diagnosis = judge([nothing] * 3, 96, ["wind"])
    assert (diagnosis.verdict, diagnosis.tier) == ("not confounded", 1)
    assert "wind, constant in each trial" in diagnosis.conclusion
    assert judge([CLEAR] * 3, 96, ["wind"]).verdict == "confounded"
