"""Exploration that shows no difference in mean motion, though something is hidden that the world tells.

A point on a line: x' = x + .2 a + drift + noise. Each system has 160 trials of an expert and 96 of exploration.
"""

from typing import Literal

import numpy as np
import pytest

from deconfounded.deconf.diagnosis import diagnose, doubts
from deconfounded.deconf.diagnosis.judgement import judge
from deconfounded.envs.streams import Array
from deconfounded.experts.trials import Trials, joined
from tests.deconf.test_diagnose import CLEAR

Kind = Literal["drift", "spread", "cliff", "goal"]
STEPS = 30
MIXED = CLEAR._replace(dynamics_differ=0.0, trait_gain=1.0, trait_stakes=9.0, paired_trait_stakes=9.0)


def roll(kind: Kind, theta: Array, expert: bool, seed: int) -> Trials:
    """Trials of three episodes. A blind explorer heads for a place that it draws for each episode, and varies."""
    rng, n = np.random.default_rng(seed), len(theta)
    noise: Array | float = theta if kind == "spread" else 0.03
    obs, action = np.zeros((n, 3, STEPS + 1, 1)), np.zeros((n, 3, STEPS, 1))
    mask = np.ones((n, 3, STEPS), bool)
    target = {"drift": 0 * theta, "spread": 1 - 3 * theta, "cliff": theta - 0.25, "goal": theta}[kind]
    for e in range(3):
        x, alive = rng.uniform(-1, -0.5, n), np.ones(n, bool)
        place, vary = (target, 0.05) if expert else (rng.uniform(-0.5, 1.7, n), 0.5)
        for t in range(STEPS):
            obs[:, e, t, 0], mask[:, e, t] = x, alive
            makes_up = 0.6 * theta if kind == "drift" and expert else 0
            action[:, e, t, 0] = (2 * (place - x) - makes_up + vary * rng.standard_normal(n)).clip(-1, 1)
            drift = 0.12 * theta if kind == "drift" else 0
            x = np.where(alive, x + 0.2 * action[:, e, t, 0] + drift + noise * rng.standard_normal(n), x)
            alive &= kind != "cliff" or ~(x > theta)
        obs[:, e, STEPS, 0] = x
    return Trials(obs, action, mask)


def thetas(kind: Kind, n: int, seed: int) -> Array:
    low, high = {"drift": (-1, 1), "spread": (0.02, 0.3), "cliff": (0, 1.5), "goal": (0, 1.5)}[kind]
    return np.random.default_rng([seed, 1]).uniform(low, high, n)


def doubted(kind: Kind, explored: Trials | None = None) -> tuple[str, ...]:
    explore = roll(kind, thetas(kind, 96, 1), False, 1) if explored is None else explored
    return doubts.doubts(roll(kind, thetas(kind, 160, 0), True, 0), explore)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "says"),
    [("spread", "how much a step varies"), ("cliff", "where their episodes end")],
)
def test_what_the_world_tells_beyond_its_mean_motion(kind: Kind, says: str) -> None:
    (doubt,) = doubted(kind)
    assert says in doubt


def beside(trials: Trials, seed: int) -> Trials:
    """With an observation and an action more, of noise."""
    rng = np.random.default_rng(seed)
    obs, action = (np.concatenate([x, rng.uniform(-0.5, 0.5, x.shape)], -1) for x in (trials.obs, trials.action))
    return Trials(obs, action, trials.mask)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "explores", "theta", "says"),
    [
        ("spread", True, None, "how much a step varies"),
        ("cliff", True, None, "where their episodes end"),
        ("drift", True, 0.3, "under one condition alone"),
        ("drift", False, None, "seems to see what is hidden"),
    ],
)
def test_one_column_of_two_is_enough(kind: Kind, explores: bool, theta: float | None, says: str) -> None:
    explored = thetas(kind, 96, 1) if theta is None else np.full(96, theta)
    explore = beside(roll(kind, explored, not explores, 1), 0)
    assert says in " ".join(doubts.doubts(beside(roll(kind, thetas(kind, 160, 0), True, 0), 1), explore))


@pytest.mark.slow
def test_episodes_that_a_log_lacks_end_nowhere() -> None:
    """Ends are compared between the first and the last of three episodes, if there is no second one."""
    explore = roll("cliff", thetas("cliff", 96, 1), False, 1)
    lacks = np.arange(3)[:, None] == 1
    ragged = Trials(np.where(lacks[..., None], 0, explore.obs), explore.action, explore.mask & ~lacks)
    assert any("where their episodes end" in doubt for doubt in doubted("cliff", ragged))


@pytest.mark.slow
def test_exploration_under_one_condition() -> None:
    (doubt,) = doubted("drift", roll("drift", np.full(96, 0.3), False, 1))
    assert "under one condition alone" in doubt


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.9, 0.5])
def test_exploration_that_sees_what_is_hidden(share: float) -> None:
    """Also if only half of its trials do."""
    theta, n_seeing = thetas("drift", 96, 1), int(96 * share)
    seeing, blind = roll("drift", theta[:n_seeing], True, 1), roll("drift", theta[n_seeing:], False, 2)
    parts = [np.concatenate([getattr(each, name) for each in (seeing, blind)]) for name in ("obs", "action", "mask")]
    assert "seems to see what is hidden" in doubted("drift", Trials(*parts))[0]


@pytest.mark.slow
def test_trials_of_exploration_without_a_step() -> None:
    """None of them acts as the expert does, the last trial of a log included."""
    explore = roll("drift", thetas("drift", 96, 1), True, 1)
    mask = explore.mask & (np.arange(96) % 5 < 4)[:, None, None]
    mask[-1] = False
    assert "seems to see" in doubted("drift", Trials(explore.obs, explore.action, mask))[0]


@pytest.mark.slow
def test_nothing_to_doubt() -> None:
    """Of a goal that nothing tells."""
    assert not doubted("goal")


@pytest.mark.slow
def test_a_difference_that_is_small() -> None:
    """As misfits leave: a quarter of the noise of a step."""
    trials = roll("drift", 0.1 * thetas("drift", 160, 0), True, 0)
    assert not doubts.doubts(trials, roll("drift", np.zeros(96), False, 1))


@pytest.mark.slow
def test_misfits_of_places_are_no_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where each trial of the expert stays at a place of its own, and the world is not linear."""
    monkeypatch.setattr(doubts, "LARGE", 0.1)
    trials, explore = (roll("goal", thetas("goal", n, i), n == 160, i) for i, n in enumerate((160, 96)))
    bent = [Trials((each.obs - 0.5) ** 3, each.action, each.mask) for each in (trials, explore)]
    assert not doubts.doubts(*bent)


@pytest.mark.slow
def test_episodes_that_begin_as_they_end() -> None:
    """A column that is constant in each trial is alike at the ends, and everywhere."""
    both = [roll("cliff", np.full(n, 0.7), n == 160, i) for i, n in enumerate((160, 96))]
    columns = (np.broadcast_to(thetas("goal", len(each), 2)[:, None, None, None], each.obs.shape) for each in both)
    named = [
        Trials(np.concatenate([each.obs, column], -1), each.action, each.mask)
        for each, column in zip(both, columns, strict=True)
    ]
    assert not doubts.doubts(*named)


@pytest.mark.slow
def test_a_policy_that_infers_what_is_hidden_is_blind() -> None:
    """It acts as the expert does from the second episode on; its first action tells nothing of that."""
    late, first = roll("drift", thetas("drift", 96, 1), True, 1), roll("drift", thetas("drift", 96, 5), True, 2)
    begins = np.arange(3)[None, :, None, None] == 0
    obs, action = (np.where(begins, getattr(first, name), getattr(late, name)) for name in ("obs", "action"))
    assert "seems to see" not in " ".join(doubted("drift", Trials(obs, action, late.mask)))


class TestVerdict:
    def test_doubts_leave_no_verdict_that_the_world_tells_nothing(self) -> None:
        sure, unsure = judge([MIXED] * 3, 96), judge([MIXED] * 3, 96, doubts=["It was all on one day.", "And so on."])
        assert (sure.verdict, sure.tier) == ("confounded", 3)
        assert (unsure.verdict, unsure.tier) == ("cannot tell", None)
        assert "It was all on one day." in unsure.conclusion
        assert unsure.reasons[-2:] == ("It was all on one day.", "And so on.")
        habits = MIXED._replace(trait_stakes=1.0, paired_trait_stakes=1.0)
        assert [judge([habits] * 3, 96, doubts=made).tier for made in ((), ["One day."])] == [1, None]

    def test_what_passes_is_nothing_hidden(self) -> None:
        """Whatever exploration was like."""
        passing = MIXED._replace(trait_gain=0.0)
        assert judge([passing] * 3, 96, doubts=["One day."]).verdict == "nothing at stake"
        assert judge([CLEAR] * 3, 96, doubts=["One day."]).verdict == "confounded"

    def test_they_are_asked_where_exploration_shows_no_difference(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(diagnose, "doubts", lambda *_: ("One day.",))
        expert, explore = roll("goal", thetas("goal", 30, 0), True, 0), roll("goal", thetas("goal", 30, 1), False, 1)
        assert diagnose.conclude([MIXED] * 3, expert, explore).verdict == "cannot tell"
        assert diagnose.conclude([CLEAR] * 3, expert, explore).verdict == "confounded"
        assert diagnose.conclude([CLEAR, CLEAR, MIXED], expert, explore).dissenting == ("cannot tell",)

    def test_copies_raise_no_doubt(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """They would count as more evidence than there is."""
        expert, explore = roll("goal", thetas("goal", 30, 0), True, 0), roll("goal", thetas("goal", 30, 1), False, 1)
        monkeypatch.setattr(diagnose, "doubts", lambda *of: (f"{len(of[0])} and {len(of[1])} trials.",))
        monkeypatch.setattr(diagnose.labels, "named", lambda _, explore: [f"of {len(explore)}"])
        diagnosis = diagnose.conclude([MIXED] * 3, joined([expert] * 4), joined([explore] * 2))
        assert diagnosis.conclusion.endswith("30 and 30 trials.")
        seen = diagnose.conclude([MIXED._replace(memory_gain=0.0)] * 3, joined([expert] * 4), joined([explore] * 2))
        assert "your columns show it: of 30, constant in" in seen.conclusion
