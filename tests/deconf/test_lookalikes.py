"""Verdicts on small worlds: what is confounded, and what only looks like it; each is trained on, and judged."""

from functools import cache

import numpy as np
import pytest
import torch

from deconfounded.deconf.core.data import Batch, Draws
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import LabelScaler, Scaler
from deconfounded.deconf.diagnosis import fits, judgement, latent, measures, trial_dynamics
from deconfounded.deconf.diagnosis.fits import Steps
from deconfounded.deconf.diagnosis.measures import Amounts
from deconfounded.deconf.diagnosis.verdict import Diagnosis
from deconfounded.deconf.methods.deconfounded import DeconfoundedConfig
from deconfounded.deconf.methods.memoryless_bc import MemorylessConfig
from deconfounded.deconf.methods.sequence_bc import RecurrentConfig
from deconfounded.experts.trials import Trials

SMALL = Amounts(
    candidates=16,
    rollouts=48,
    cloning=MemorylessConfig(updates=200, width=32),
    naive=RecurrentConfig(updates=130, width=32),
    exploring=DeconfoundedConfig(inference_updates=200, inference_rate=5e-3, width=32, latent=2),
)
NOISE = 0.1


def world(kind: str, n: int, seed: int, explores: bool = False) -> Trials:
    """A point on a line is to be held at 0: s' = s + a / 2 + push + noise. Explorers act at random about a controller.

    kind, what is hidden or only looks so. wind: a push, constant in a trial, which the expert leans against, with so
    weak a feedback that a naive clone is off by .48 on average, and the expert by .12 (with twice the feedback by .18
    and .09: such a clone does well enough); goal: +-1, to which the expert goes, in four episodes; habits: gains of
    experts, .3 to 1.7; ar1: noise of the expert that lasts; memory: an integral that it keeps; pause: it rests for 0 to
    15 steps at first; idle: nothing.
    """
    rng = np.random.default_rng(seed)
    theta, episodes, steps = rng.uniform(-1, 1, n), 4 if kind == "goal" else 1, 10 if kind == "goal" else 40
    push, goal = 0.2 * theta * (kind == "wind"), np.sign(theta) * (kind == "goal")
    gain = 1 + 0.7 * theta * (kind == "habits") - 0.5 * (kind == "wind")
    kept, start = np.zeros(n), rng.integers(0, 16, n) * (kind == "pause")
    obs, actions = np.zeros((n, episodes, steps + 1, 1)), np.zeros((n, episodes, steps, 1))
    for e in range(episodes):
        s = rng.normal(kind == "pause", 0.3, n)
        for t in range(steps):
            if kind == "ar1":
                kept = 0.95 * kept + rng.normal(0, 0.06, n)
            elif kind == "memory":
                kept = 0.95 * kept - 0.2 * s
            act = (gain * (goal - s)).clip(-0.4, 0.4) - 2 * push + kept + rng.normal(0, 0.05, n)
            if explores:
                act = rng.uniform(-1, 1, n) - s + rng.choice([-0.5, 0.5], n) * (kind == "goal")
            rests = (t < start) & (not explores)
            act = np.where(rests, 0.02 * rng.standard_normal(n), act).clip(-1, 1)
            obs[:, e, t, 0], actions[:, e, t, 0] = s, act
            s = np.where(rests, s, s + act / 2 + push + NOISE * rng.standard_normal(n))
        obs[:, e, steps, 0] = s
    return Trials(obs, actions, np.ones((n, episodes, steps), bool))


@cache
def diagnosed(kind: str, explored: int = 96, unit: float = 1.0) -> Diagnosis:
    """unit: that of the expert's and the explorers' actions."""
    expert, exploration = world(kind, 96, 0), world(kind, explored, 1, explores=True)
    logs = (Trials(x.obs, unit * x.action, x.mask) for x in (expert, exploration))
    return judgement.judge([measures.measure(*logs, SMALL, np.random.default_rng(0))], explored)


@pytest.mark.slow
def test_wind_is_confounded() -> None:
    diagnosis = diagnosed("wind")
    assert (diagnosis.verdict, diagnosis.tier) == ("confounded", 2)
    assert diagnosis.figures["over_memory"].value < 0.25  # past actions tell a memory all of the wind


@pytest.mark.slow
def test_units_do_not_decide() -> None:
    """The same logs with actions in a unit fifty times as large: the same verdict, and memory in nats."""
    diagnosis, scaled = diagnosed("wind"), diagnosed("wind", unit=0.02)
    assert (scaled.verdict, scaled.tier) == (diagnosis.verdict, diagnosis.tier)
    assert scaled.figures["memory_gain"].value == pytest.approx(diagnosis.figures["memory_gain"].value, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ar1", "memory", "pause", "habits"])
def test_nothing_at_stake(kind: str) -> None:
    """Past actions predict, and nothing is lost by going by them."""
    diagnosis = diagnosed(kind)
    assert diagnosis.figures["memory_gain"].value > 0.1
    assert diagnosis.verdict == "nothing at stake"
    assert diagnosis.headline == "Past actions predict, nothing is at stake"


@pytest.mark.slow
def test_nothing_hidden() -> None:
    diagnosis = diagnosed("idle")
    assert diagnosis.verdict == "cannot tell"
    assert "differs from trial to trial" not in diagnosis.conclusion


@pytest.mark.slow
def test_tier_3_for_a_goal_that_the_world_does_not_tell() -> None:
    assert (diagnosed("goal").verdict, diagnosed("goal").tier) == ("confounded", 3)


@pytest.mark.slow
def test_too_little_exploration_is_no_tier_3() -> None:
    diagnosis = diagnosed("wind", explored=24)
    assert diagnosis.tier != 3
    assert diagnosis.verdict == "confounded" or "You have 24 trials of exploration" in diagnosis.conclusion


def tank(heat: float, lasting: float = 0.0, rough: float = 0.0) -> Trials:
    """Explored trials of a tank whose temperatures tell of a hidden heat as soon as it has moved them.

    lasting: correlation of gusts from step to step; rough: of the tank's response, which no smooth fit has.
    """
    rng, b, steps = np.random.default_rng(0), 64, 40
    theta, gust = heat * rng.uniform(-1, 1, b), np.zeros(b)
    obs, action = np.zeros((b, 1, steps + 1, 2)), rng.uniform(-1, 1, (b, 1, steps, 1))
    obs[:, 0, 0] = rng.normal(0, 0.3, (b, 2))
    for t in range(steps):
        jacket, content = obs[:, 0, t].T
        gust = lasting * gust + 0.4 * rng.standard_normal(b)
        heating = 0.4 * action[:, 0, t, 0] + theta + rough * np.sin(9 * content)
        obs[:, 0, t + 1, 0] = jacket + 0.4 * (content - jacket) + heating + gust
        obs[:, 0, t + 1, 1] = content + 0.2 * (jacket - content) - 0.1 * content + 0.02 * rng.standard_normal(b)
    return Trials(obs, action, np.ones((b, 1, steps), bool))


def test_halves_are_of_the_steps_that_are_in() -> None:
    """Where the first steps of each episode are left out, as out of the expert's range, so are those of its halves."""
    rng = np.random.default_rng(0)
    theta, action = rng.uniform(-1, 1, (48, 1, 1, 1)), rng.uniform(-1, 1, (48, 1, 60, 1))
    moves = (action + theta + 0.5 * rng.standard_normal(action.shape)).cumsum(2)
    obs = rng.normal(0, 30, (48, 1, 1, 1)) + np.concatenate([np.zeros((48, 1, 1, 1)), moves], 2)
    trials = Trials(obs, action, np.ones((48, 1, 60), bool) & (np.arange(60) >= 35))
    alike = trial_dynamics.own_dynamics(trials, Steps.of(trials))
    assert alike is not None
    assert alike[0] > 0.5


def wandering(hidden: float, actions: int = 0, episodes: int = 1) -> Trials:
    """40 trials of a point that is pushed by its action, and by a force that is hidden."""
    rng = np.random.default_rng(0)
    shape = (40, episodes, 40, 1)
    action = rng.integers(2, size=shape).astype(float) if actions else rng.uniform(-1, 1, shape)
    moves = 0.3 * action + hidden * rng.uniform(-1, 1, (40, 1, 1, 1)) + 0.3 * rng.standard_normal(shape)
    obs = np.concatenate([np.zeros((40, episodes, 1, 1)), moves.cumsum(2)], 2)
    return Trials(obs, action, np.ones(shape[:3], bool), actions)


class TestHalves:
    """Halves of a trial are alike where something of the trial moves it."""

    def alike(self, trials: Trials) -> float | None:
        measured = trial_dynamics.own_dynamics(trials, Steps.of(trials))
        return measured and measured[0]

    @pytest.mark.slow
    def test_constant_columns(self) -> None:
        """An observation that never changes, and an action that is never taken, are alike in all halves."""
        trials = wandering(0)
        still = np.concatenate([trials.obs, np.full_like(trials.obs, 7)], -1)
        assert self.alike(trials) == self.alike(Trials(still, trials.action, trials.mask)) == 0
        assert self.alike(wandering(0, actions=2)) == self.alike(wandering(0, actions=3)) == 0
        hidden = wandering(0.5)
        still = np.concatenate([hidden.obs, np.full_like(hidden.obs, 7)], -1)
        assert self.alike(Trials(still, hidden.action, hidden.mask)) == self.alike(hidden)

    def test_trials_of_different_numbers_of_episodes(self) -> None:
        """Those of one episode have halves, too, if another trial has two."""
        two = wandering(0.5, episodes=2)
        mask = two.mask.copy()
        mask[1:, 1] = False
        alike = self.alike(Trials(two.obs, two.action, mask))
        assert alike is not None
        assert alike > 0.8

    def test_episodes_that_did_not_take_place(self) -> None:
        """Halves are of every other one of those that did."""
        two = wandering(0.5, episodes=2)
        obs, action, mask = (np.repeat(x, 2, 1) for x in (two.obs, two.action, two.mask))
        mask[:, 1::2] = False
        assert self.alike(Trials(obs, action, mask)) == self.alike(two)

    def test_chance_is_that_of_all_columns_together(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Of eight columns of noise, and their products with observations and actions, none is alike in .95 of logs.

        In fewer than three of twelve, with probability .98.
        """
        monkeypatch.setattr(trial_dynamics, "FINE", 4)
        monkeypatch.setattr(fits, "CHANCE", 0.05)
        said = 0
        for seed in range(12):
            rng = np.random.default_rng(seed)
            obs, action = rng.normal(size=(24, 1, 21, 8)), rng.uniform(-1, 1, (24, 1, 20, 1))
            said += self.alike(Trials(obs, action, np.ones((24, 1, 20), bool))) != 0
        assert said < 3


class TestStatesThatTell:
    """Dynamics that differ from trial to trial, by an amount that observations tell of."""

    @pytest.fixture(autouse=True)
    def _few_features(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(trial_dynamics, "FINE", 16)

    def differ(self, trials: Trials) -> float:
        alike = trial_dynamics.own_dynamics(trials, Steps.of(trials))
        assert alike is not None
        return alike[0]

    def test_least_squares_takes_it_for_an_effect_of_the_state(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """And the likelihood, in which trials have means, does not."""
        assert self.differ(tank(0.3)) > 0.6
        monkeypatch.setattr(trial_dynamics, "trial_means", lambda basis, y, *rest: (y, np.zeros(y.shape[1])))
        assert self.differ(tank(0.3)) == 0

    @pytest.mark.parametrize("kind", [{}, {"lasting": 0.6}, {"rough": 0.3}], ids=["idle", "gusts", "misfit"])
    def test_nothing_hidden(self, kind: dict[str, float]) -> None:
        assert self.differ(tank(0, **kind)) == 0

    def test_likelihood(self) -> None:
        """Of one basis function, 1, against the density of the panel, by hand."""
        rng = np.random.default_rng(0)
        y, trial = rng.normal(size=(60, 1)), np.repeat(np.arange(20), 3)
        y += 0.5 * rng.normal(size=20)[trial, None]
        follows = np.concatenate([[False], np.diff(trial) == 0])
        _, ratio = trial_dynamics.trial_means(np.ones((60, 1)), y, trial, follows)

        def likely(kept: float, share: float) -> float:
            lag = np.abs(np.subtract.outer(range(3), range(3)))
            cov = np.kron(np.eye(20), kept**lag / (1 - kept**2) + share)
            solved = np.linalg.solve(cov, np.concatenate([y, np.ones((60, 1))], 1))
            mean = solved[:, 0].sum() / solved[:, 1].sum()
            rest = float((y[:, 0] - mean) @ (solved[:, 0] - mean * solved[:, 1]))
            return -30 * np.log(rest) - np.linalg.slogdet(cov)[1] / 2

        grid = {(k, r): likely(k, r) for k in trial_dynamics.LASTING for r in trial_dynamics.RATIOS}
        by_hand = max(grid.values()) - max(grid[k, 0.0] for k in trial_dynamics.LASTING)
        assert ratio[0] == pytest.approx(by_hand, abs=0.02)


@pytest.mark.parametrize(("trials", "within"), [(40, 0.05), (6, 0.5)])
def test_one_trial_does_not_own_a_likelihood(trials: int, within: float) -> None:
    """A fall in one of forty, or of six, a thousand nats, moves what is typical by less than the others' spread."""
    log_prob = torch.randn(1, trials, 10, generator=torch.Generator().manual_seed(0))
    batch = Batch(*(torch.zeros(1, trials, 10, 1) for _ in range(3)), torch.ones(1, trials, 10))
    before = latent.typical(log_prob, batch)
    log_prob[0, 5] -= 1000
    assert latent.typical(log_prob, batch) == pytest.approx(before, abs=within)


def test_what_is_typical_is_of_steps_that_took_place() -> None:
    log_prob, empty = torch.arange(3.0)[None, :, None].repeat(1, 1, 10), torch.zeros(1, 3, 10, 1)
    log_prob[..., 6:] += 1000
    assert latent.typical(log_prob, Batch(empty, empty, empty, (torch.arange(10) < 6).float().expand(1, 3, -1))) == 1


def test_small_units_are_no_constants() -> None:
    """A column in units of 1e-7 is scaled as it is in others; what is constant keeps its scale, rounding or not."""
    x = torch.randn(1, 50, 20, 1, generator=torch.Generator().manual_seed(0))
    mask = torch.ones(1, 50, 20)
    torch.testing.assert_close(Scaler(1e-7 * x, mask)(1e-7 * x), Scaler(x, mask)(x), rtol=1e-3, atol=1e-3)
    for constant in (0.0, 1e-7, 0.1, 0.3, 7.0, 30.1, 100.3, 1000.1, 1e4, 12345.6):
        column = torch.full((1, 500, 256, 1), constant)
        column[:, :, 200:] = 0  # padding
        assert Scaler(column, (torch.arange(256) < 200).float().expand(1, 500, -1)).std.item() == 1


class TestHeavyTails:
    """A bolus now and then, among labels of usual size."""

    x = torch.randn(1, 50, 20, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.01, 1.0])
    x[0, ::10, 3, 0] = 0.9
    mask = torch.ones(1, 50, 20)

    def test_the_usual_is_no_spike(self) -> None:
        usual = self.x[0, 1:10].flatten(0, 1)[:, 0]
        assert (LabelScaler(self.x, self.mask)(self.x)[0, 1:10, :, 0].std() / usual.std()).item() > 50
        assert Scaler(self.x, self.mask)(self.x)[0, 1:10, :, 0].std() < 0.2

    def test_padding(self) -> None:
        """It has no part in what is usual."""
        mask, x = self.mask * (torch.arange(20) < 8), self.x.clone()
        x[:, :, 8:] += 5
        padded, short = LabelScaler(x, mask), LabelScaler(x[:, :, :8], mask[:, :, :8])
        assert padded.heavy.tolist() == [[True, False]]
        torch.testing.assert_close(padded(self.x), short(self.x))

    def test_a_seed_without_a_step(self) -> None:
        """It leaves the others as they are, and its own labels, too."""
        x, mask = self.x.repeat(2, 1, 1, 1), self.mask.repeat(2, 1, 1)
        mask[1] = 0
        both, alone = LabelScaler(x, mask)(x), LabelScaler(self.x, self.mask)(self.x)
        assert torch.equal(both[:1], alone)
        assert torch.equal(both[1:], self.x)

    def test_inverse(self) -> None:
        scaler = LabelScaler(self.x, self.mask)
        torch.testing.assert_close(scaler.inverse(scaler(self.x)), self.x, rtol=1e-4, atol=1e-5)

    def test_other_columns_stay(self) -> None:
        bent, plain = (kind(self.x, self.mask)(self.x) for kind in (LabelScaler, Scaler))
        assert torch.equal(bent[..., 1], plain[..., 1])

    def test_units(self) -> None:
        other = 50 * self.x - 3
        pair = LabelScaler(self.x, self.mask)(self.x), LabelScaler(other, self.mask)(other)
        torch.testing.assert_close(*pair, rtol=1e-2, atol=1e-2)


@pytest.mark.slow
def test_a_latent_tells_no_more_of_actions_than_what_is_hidden() -> None:
    """Of 24 trials, which policies learn by heart: those given latents of other trials, whose error is no gain, most.

    Given the wind, actions have a deviation of .05; without it, of about that of the push, .4 / sqrt(3), besides.
    """
    sizes = ((24, False), (96, True))
    expert, exploration = ((world("wind", n, 0, explores), world("wind", 24, 2, explores)) for n, explores in sizes)
    cloning = MemorylessConfig(updates=600, learning_rate=3e-3)
    exploring = DeconfoundedConfig(inference_updates=200, inference_rate=5e-3, width=32)
    draws = Draws([np.random.default_rng(0)], "cpu")
    explanation = latent.from_dynamics(expert, exploration, 1, exploring, cloning, draws, Monitor())
    gain, likely = explanation.latent_gain, explanation.log_likelihood
    assert gain is not None
    assert likely is not None
    assert 0.5 < gain < np.log(np.hypot(0.05, 0.4 / 3**0.5) / 0.05) + 0.2
    best = -np.log(0.05 / expert[0].action.std()) - 0.5 * np.log(2 * np.pi * np.e)  # of standardised actions
    assert best - 0.5 < likely < best + 0.2
