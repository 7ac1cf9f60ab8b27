"""A first look names what would mislead a diagnosis, and nothing in data that are as they should be."""

import csv
import json
import re
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deconfounded import envs
from deconfounded.benchmarks import diagnose as command
from deconfounded.benchmarks import look as look_command
from deconfounded.benchmarks.console import run_command
from deconfounded.benchmarks.output.diagnosis import WRITTEN
from deconfounded.deconf.diagnosis import advice as advices
from deconfounded.deconf.diagnosis import columns, diagnose, fits, trial_dynamics
from deconfounded.deconf.diagnosis.look import Remark, look
from deconfounded.deconf.diagnosis.verdict import Diagnosis
from deconfounded.deconf.methods import deconfounded, naive_rnn
from deconfounded.deconf.methods.deconfounded_offline import OfflineConfig
from deconfounded.deconf.methods.sequence_bc import RecurrentConfig
from deconfounded.experts import datasets, policy
from deconfounded.experts.agent import ExpertAgent, RandomAgent
from deconfounded.experts.datasets import Log
from deconfounded.experts.datasets.table import Odd
from deconfounded.experts.datasets.units import Units
from deconfounded.experts.rollout import run_trials
from deconfounded.experts.trials import Trials, joined
from tests.deconf.test_diagnose import _tiny_init

B, E, T = 48, 2, 60


@pytest.mark.slow
def test_a_log_that_is_mostly_at_rest() -> None:
    """It pauses; that nothing ever changes would be untrue."""
    trials = driven()
    obs, action = trials.obs.copy(), trials.action.copy()
    obs[:, :, 5:], action[:, :, 5:] = obs[:, :, 5:6], 0
    remarks = [remark.text for remark in look(changed(trials, obs=obs, action=action)) if remark.kind == "pause"]
    assert len(remarks) == 1
    assert "No observation ever changes" not in remarks[0]
    still = np.repeat(obs[:, :, :1], T + 1, 2)
    texts = [remark.text for remark in look(changed(trials, obs=still)) if remark.kind == "pause"]
    assert texts == ["No observation ever changes within an episode."]


def driven(lasting: float = 0.0, noise: float = 0.1, reaction: int = 0, same: bool = False, goals: float = 0) -> Trials:
    """A cart in a hidden wind, which its driver feels.

    lasting: correlation of the driver's noise from step to step. reaction: steps by which the driver answers late.
    same: one wind for all trials. goals: how far apart the drivers' goals are.
    """
    rng, goal = np.random.default_rng(0), goals * np.linspace(-1, 1, B)
    wind = 0 * rng.uniform(-1, 1, B) + 0.5 if same else rng.uniform(-1, 1, B)
    obs, action = np.zeros((B, E, T + 1, 2)), np.zeros((B, E, T, 1))
    for e in range(E):
        x, v, shaken = rng.uniform(-1, 1, B), rng.uniform(-1, 1, B), np.zeros(B)
        obs[:, e, 0] = np.stack([x, v], 1)
        for t in range(T):
            shaken = lasting * shaken + np.sqrt(1 - lasting**2) * noise * rng.standard_normal(B)
            seen = obs[:, e, max(0, t - reaction)]
            action[:, e, t, 0] = (0.5 * (goal - seen[:, 0]) - 0.5 * seen[:, 1] - 0.3 * wind + shaken).clip(-1, 1)
            v = v + 0.2 * action[:, e, t, 0] + 0.06 * wind + 0.05 * rng.standard_normal(B)
            x = x + 0.2 * v + 0.02 * rng.standard_normal(B)
            obs[:, e, t + 1] = np.stack([x, v], 1)
    return Trials(obs, action, np.ones((B, E, T), bool))


def changed(trials: Trials, **arrays: Any) -> Trials:
    return Trials(**{"obs": trials.obs, "action": trials.action, "mask": trials.mask, "actions": 0} | arrays)


def test_trials_without_a_step() -> None:
    """They are left out, and others keep their numbers."""
    trials = driven()
    mask, obs = trials.mask.copy(), trials.obs.copy()
    mask[0] = False
    obs[5] += 1000
    remarks = look(changed(trials, obs=obs, mask=mask))
    assert any(remark.kind == "outlier" and "Trial 5 is unlike" in remark.text for remark in remarks)


def test_trials_that_are_long(monkeypatch: pytest.MonkeyPatch) -> None:
    """Enough of them are looked at, by their beginnings, to see how they differ."""
    trials = driven()
    whole = look(trials)
    monkeypatch.setattr(fits, "MOST", B * E * T // 3)
    part = fits.sample(trials)
    assert part.mask.shape[:2] == (fits.FEWEST, E)
    assert part.mask.shape[2] == T // 2
    for remarks in (whole, look(trials)):
        assert said(remarks, "dynamics").startswith("Trials differ in their dynamics")


def test_memory_of_long_trials() -> None:
    """It does not grow with the square of their length: that would be 288 MB here."""
    rng = np.random.default_rng(0)
    trials = Trials(rng.normal(size=(2, 1, 3001, 4)), rng.uniform(-1, 1, (2, 1, 3000, 1)), np.ones((2, 1, 3000), bool))
    tracemalloc.start()
    fits.lasting(trials, fits.Steps.of(trials))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6


def odd(remarks: list[Remark]) -> list[str]:
    return [remark.kind for remark in remarks if remark.odd]


def said(remarks: list[Remark], kind: str) -> str:
    return " ".join(remark.text for remark in remarks if remark.kind == kind)


@pytest.mark.slow
@pytest.mark.parametrize("rows", [4, 5, 7])
def test_actions_that_are_many_rows_late(rows: int) -> None:
    trials = driven()
    for _ in range(rows):
        trials = late(trials)
    assert f"they are probably logged late. Move actions up by {rows} rows." in said(look(trials), "late")


@pytest.mark.slow
def test_a_column_of_the_last_action_is_named() -> None:
    """The log has commands, and the dynamics tell; but a clone reads its own past actions there."""
    trials = driven()
    last = np.concatenate([0 * trials.action[:, :, :1], trials.action], 2)
    remarks = look(changed(trials, obs=np.concatenate([trials.obs, last], -1)))
    says = "The action action 0 is the next observation 2, to 0.0% of its spread: that column is the last action, which"
    assert said(remarks, "state").startswith(says)
    assert "tell nothing" not in said(remarks, "state")


def test_the_column_that_an_action_equals_is_named() -> None:
    """That of the next row, beside another that is near to the action in the present one."""
    rng = np.random.default_rng(0)
    action, none = rng.uniform(-1, 1, (B, E, T, 1)), np.zeros((B, E, 1, 1))
    near = np.concatenate([action + 0.3 * rng.standard_normal(action.shape), none], 2)
    last = np.concatenate([none, action], 2)
    remarks = look(Trials(np.concatenate([near, last], -1), action, np.ones((B, E, T), bool)))
    assert said(remarks, "state").startswith("The action action 0 is the next observation 1, to 0.0% of its spread")


def test_what_never_moves_is_said_to_be_so() -> None:
    trials = driven()
    remarks = look(changed(trials, obs=0 * trials.obs + 3))
    assert said(remarks, "pause").startswith("No observation ever changes within an episode")


def test_empty_trials_are_no_copies_of_each_other() -> None:
    trials = driven()
    mask, obs, action = trials.mask.copy(), trials.obs.copy(), trials.action.copy()
    for array in (mask, obs, action):
        array[[3, 5, 8]] = 0
    assert not said(look(changed(trials, mask=mask, obs=obs, action=action)), "duplicate")


def test_what_the_own_row_tells_of_actions() -> None:
    """Beside what an earlier one does; by the fit of that row."""
    trials = driven(reaction=2)
    window = fits.Window.of(trials, 10)  # as of lags up to 8
    left = {lag: window.unexplained([lag]) for lag in (-1, 0, 2)}
    assert f"({1 - left[2]:.0%} of their variance, and {1 - left[0]:.0%} by that of their" in said(look(trials), "late")
    assert left[-1] - left[0] > 0.02


def late(trials: Trials) -> Trials:
    action = np.concatenate([0 * trials.action[:, :, :1], trials.action[:, :, :-1]], 2)
    return changed(trials, action=action)


def with_pauses(trials: Trials) -> Trials:
    """Each episode begins with 8 steps at rest; some rest later too, where a sensor's noise goes on."""
    obs, action = trials.obs.copy(), trials.action.copy()
    obs[:, :, :9], action[:, :, :8] = obs[:, :, 8:9], 0
    obs[::2, 0, 30:38] = obs[::2, 0, 30:31]
    obs[::4, 0, 45:53] = obs[::4, 0, 45:46]
    obs[..., 0] += 1e-4 * np.random.default_rng(0).standard_normal(obs.shape[:-1])
    return changed(trials, obs=obs, action=action)


def with_copies(trials: Trials) -> Trials:
    obs, action = trials.obs.copy(), trials.action.copy()
    obs[7], action[7] = obs[3], action[3]
    return changed(trials, obs=obs, action=action)


def with_replays(trials: Trials) -> Trials:
    action = trials.action.copy()
    action[7] = action[3]
    return changed(trials, action=action)


def with_an_episode_twice(trials: Trials) -> Trials:
    obs, action = trials.obs.copy(), trials.action.copy()
    obs[9, 1], action[9, 1] = obs[3, 0], action[3, 0]
    return changed(trials, obs=obs, action=action)


def with_an_outlier(trials: Trials) -> Trials:
    obs = trials.obs.copy()
    obs[5, ..., 0] += 5
    return changed(trials, obs=obs)


def more(trials: Trials, column: Any) -> Trials:
    """Trials with one observation more, of shape [B, E, T + 1]."""
    return changed(trials, obs=np.concatenate([trials.obs, column[..., None]], -1))


def with_heavy_tails(trials: Trials) -> Trials:
    return more(trials, np.random.default_rng(0).standard_t(1.5, trials.obs.shape[:-1]))


def with_codes(trials: Trials) -> Trials:
    """A sensor that fails in one step of twenty."""
    rng = np.random.default_rng(0)
    return more(trials, np.where(rng.random((B, E, T + 1)) < 0.05, -9999, rng.normal(size=(B, E, T + 1))))


def with_a_heading(trials: Trials) -> Trials:
    """A compass that turns, from 0 to 360 degrees."""
    turned = np.random.default_rng(0).normal(10, 10, (B, E, T + 1)).cumsum(-1)
    return more(trials, turned % 360)


def with_two_units(trials: Trials) -> Trials:
    """Every third trial has its first observation in another unit."""
    obs = trials.obs.copy()
    obs[::3, ..., 0] *= 57.3
    return changed(trials, obs=obs)


def with_a_label(trials: Trials) -> Trials:
    return more(trials, np.broadcast_to(np.arange(B)[:, None, None] % 2, (B, E, T + 1)))


def with_the_next_state(trials: Trials) -> Trials:
    action = trials.obs[:, :, 1:, :1].astype(float)
    log = Log.of(changed(trials, action=action / 20))
    return replace(log, units=replace(log.units, low=(-20.0,), high=(20.0,)))


def with_the_present_state(trials: Trials) -> Trials:
    log = Log.of(changed(trials, action=trials.obs[:, :, :-1, :1].astype(float) / 20))
    return replace(log, units=replace(log.units, low=(-20.0,), high=(20.0,)))


PLANTED: dict[str, tuple[Any, set[str], str, str]] = {  # trials; what is odd; a kind, and words of it
    "nothing": (driven, set(), "lag", "Actions match the observation of their own row better"),
    "late": (lambda: late(driven()), {"late"}, "late", "they are probably logged late. Move actions up by 1 row."),
    "two late": (lambda: late(late(driven())), {"late"}, "late", "they are probably logged late. Move actions up by 2"),
    "reaction": (lambda: driven(reaction=2), {"late"}, "late", "move what follows their own: a reaction time."),
    "pauses": (
        lambda: with_pauses(driven()),
        {"pause"},
        "pause",
        "at the start of 96 of 96 episodes, and 36 times later",
    ),
    "AR(1)": (lambda: driven(0.95, 0.3), {"lasting"}, "lasting", "Noise that lasts, AR(1), or the expert's own memory"),
    "copies": (lambda: with_copies(driven()), {"duplicate"}, "duplicate", "1 of 48 trials repeats another: 3 = 7."),
    "replays": (lambda: with_replays(driven()), {"duplicate"}, "duplicate", "another in its actions: 3 = 7."),
    "episode": (
        lambda: with_an_episode_twice(driven()),
        {"duplicate"},
        "duplicate",
        "1 episodes repeat others, in trials 3, 9",
    ),
    "outlier": (
        lambda: with_an_outlier(driven()),
        {"outlier"},
        "outlier",
        "Trial 5 is unlike the others: its median of obs",
    ),
    "tails": (lambda: with_heavy_tails(driven()), {"tails"}, "tails", "arcsinh((observation 2 - "),
    "code": (lambda: with_codes(driven()), {"code"}, "code", "observation 2 is -9999 in "),
    "angle": (lambda: with_a_heading(driven()), {"angle"}, "angle", "observation 2 jumps by about 360 in "),
    "units": (
        lambda: with_two_units(driven()),
        {"unit", "outlier"},
        "unit",
        f"times more in 16 of {B} trials than in the others: another unit? These are 0, 3, 6",
    ),
    "label": (
        lambda: with_a_label(driven()),
        {"label"},
        "label",
        "in others, as what is hidden would be: observation 2",
    ),
    "next": (lambda: with_the_next_state(driven()), {"state"}, "state", "action 0 is the next observation 0, to 0.0%"),
    "present": (lambda: with_the_present_state(driven()), {"state"}, "state", "action 0 is the present observation 0"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", PLANTED)
def test_what_is_planted_is_named(case: str) -> None:
    """And nothing else is, but that actions which are states, or paused, repeat themselves."""
    made, kinds, kind, words = PLANTED[case]
    remarks = look(made())
    assert set(odd(remarks)) - {"repeat"} == kinds
    assert words in said(remarks, kind)
    assert ("repeat" in odd(remarks)) <= (case in ("next", "present", "pauses"))


@pytest.mark.slow
def test_amounts_in_remarks_are_those_of_the_data() -> None:
    """The steps with a code, the share of actions at an end of the range, and how long what lasts takes to halve."""
    coded = with_codes(driven())
    count = int((coded.obs[:, :, :-1, 2] == -9999).sum())
    assert f"observation 2 is -9999 in {count:,} steps" in said(look(coded), "code")
    action = np.where(np.arange(T) % 4 == 0, 1.0, 0.2)[:, None] * np.ones((B, E, T, 1))
    assert "(25% at an end of the range)" in said(look(changed(driven(), action=action)), "range")
    text = said(look(driven(0.95, 0.3)), "lasting")
    lasts = re.search(r"step to step is (0\.\d+), so that it halves in (\d+) steps", text)
    assert lasts is not None
    assert float(lasts[1]) ** int(lasts[2]) == pytest.approx(0.5, abs=0.05)


def test_what_is_recommended_where_nothing_mends_a_column() -> None:
    """The best of the transforms; what is 0 now and then has no logarithm."""
    x = np.concatenate([np.zeros(985), np.ones(12), np.full(3, 1000.0)])
    how, left = fits.mended("x", x)
    assert "clipped to 0 and 1" in how
    assert left == pytest.approx(fits.kurtosis(x.clip(0, 1)))


def test_what_lasts_is_no_misfit() -> None:
    """Noise that lasts is alike in steps that follow each other, and not where a trial comes by once more."""
    trials = driven(0.95, 0.3)
    lasts, _, alike = fits.lasting(trials, fits.Steps.of(trials)) or (0, 0, 1)
    assert lasts > 0.8
    assert alike < 0.3


def test_a_few_alike_actions_are_no_replay() -> None:
    """Of ten steps or more they are."""
    trials = with_replays(driven())
    for steps, groups in ((9, []), (10, [[3, 7]])):
        mask = trials.mask & (np.arange(E * T).reshape(E, T) < steps)
        assert fits.copies(changed(trials, mask=mask, action=trials.action * mask[..., None]))[1] == groups


def test_codes_of_actions_are_in_the_log_s_units() -> None:
    action = np.where(np.arange(T) % 20 == 7, 0.999, 0.1 * np.sin(np.arange(T)))[:, None] * np.ones((B, E, T, 1))
    log = Log.of(changed(driven(), action=action))
    log = replace(log, units=replace(log.units, low=(-1000.0,), high=(1000.0,)))
    texts = [remark.text for remark in columns.extremes(log, fits.Steps.of(log))]
    assert any("action 0 is 999 in" in text for text in texts)


@pytest.mark.slow
def test_units_of_actions_and_what_is_no_other_unit() -> None:
    """A latent may change how widely trials vary, by a few times; some trials may be at rest."""
    action, obs = driven().action.copy(), driven().obs.copy()
    action[::2] *= 0.01
    assert "action 0 varies" in said(look(changed(driven(), action=action)), "unit")
    obs[..., 0] *= np.where(np.arange(B) % 2, 1, 10.0)[:, None, None]
    obs[::4, ..., 1] *= 1e-8
    assert "unit" not in odd(look(changed(driven(), obs=obs)))


@pytest.mark.parametrize(
    "column",
    [
        np.where(np.arange(T + 1) == 7, 99.0, np.linspace(0, 60, T + 1)),  # as near as others are to each other
        np.where(np.arange(T + 1) % 20, np.arange(T + 1) % 3, -12.0),  # no code
        np.linspace(0, 6.3, T + 1),  # turns once, and does not jump
        np.array([0.0, 200.0, 360.0, 200.0])[np.arange(T + 1) % 4],  # jumps by little more than half a turn
        np.array([0.0, 5.2])[np.arange(T + 1) % 2],  # jumps by most of a turn, and covers no more than that
    ],
)
def test_what_is_no_code_and_no_angle(column: Any) -> None:
    remarks = look(more(driven(), np.broadcast_to(column, (B, E, T + 1))))
    assert not {"code", "angle"} & set(odd(remarks))


def test_what_are_no_trials() -> None:
    with pytest.raises(envs.InputError, match="look was given a ndarray; it must be Trials"):
        look(np.zeros((3, 4)))  # type: ignore[arg-type]


@pytest.mark.parametrize("unit", [1e-12, 1e6])
def test_units_do_not_matter(unit: float) -> None:
    """Fits are of standardised columns, however small these are."""
    x = np.random.default_rng(0).normal(size=(100, 2))
    np.testing.assert_allclose(fits.features(x * [1, unit]), fits.features(x), atol=1e-9)
    assert not fits.features(np.full((100, 1), 0.1) * unit).any()


def test_what_was_misread_is_odd() -> None:
    """That time runs backwards, or that files share trials, is marked; what is merely said is not."""
    notes = (
        Odd("step runs backwards 3 times; ..."),
        Odd("Several files have a trial 0: ..."),
        "2 trials of 1 episode.",
    )
    log = replace(Log.of(driven()), notes=notes)
    assert [remark.odd for note in notes for remark in look(log) if remark.text == note] == [True, True, False]


@pytest.mark.slow
def test_one_action_alone() -> None:
    """Of a log whose every action has the same text: there is nothing to match."""
    trials = driven()
    remarks = look(changed(trials, action=np.zeros(trials.action.shape), actions=1))
    assert "Actions used: 0 100%." in [remark.text for remark in remarks]
    assert not {"lag", "lasting"} & {remark.kind for remark in remarks}


@pytest.mark.slow
def test_how_far_simple_guesses_get() -> None:
    """By hand: of slow noise, nearly all by repeating; of a constant for each trial, all by its mean."""
    rng = np.random.default_rng(0)
    trials = driven()
    own = np.broadcast_to(rng.uniform(-1, 1, (B, 1, 1, 1)), trials.action.shape)
    text = said(look(changed(trials, action=own)), "repeat")
    assert f"errs by {own.std():.2g} (rms" in text
    assert "the last action predicts 100%, the mean action of each trial 100%" in text
    white = rng.uniform(-1, 1, trials.action.shape)
    text = said(look(changed(trials, action=white)), "repeat")
    assert "predicts -10" in text or "predicts -9" in text
    discrete = changed(trials, action=np.arange(T)[:, None] * np.ones(trials.action.shape) % 4 // 3, actions=2)
    assert "is right in 75% of steps, the last action in 49%" in said(look(discrete), "repeat").replace("51%", "49%")


@pytest.mark.slow
@pytest.mark.parametrize(("name", "differ"), [("slippery_cartpole", True), ("hidden_goal", False), ("icy_stop", True)])
def test_dynamics_of_exploration(name: str, differ: bool) -> None:
    """Where theta is in the dynamics, and where it is not; and once episodes of all trials are shuffled."""
    env = envs.BatchEnv(envs.get(name), 32)
    trials = run_trials(env, RandomAgent(env.task.action_space), 4, 3).trials
    assert ("Trials differ in their dynamics" in said(look(trials, blind=True), "dynamics")) is differ
    assert ("dynamics" in odd(look(trials, blind=True))) is not differ
    order = np.random.default_rng(0).permutation(32 * 4)
    obs, action, mask = (
        x.reshape(-1, *x.shape[2:])[order].reshape(x.shape) for x in (trials.obs, trials.action, trials.mask)
    )
    assert "Trials do not differ" in said(look(Trials(obs, action, mask), blind=True), "dynamics")


@pytest.mark.slow
def test_copies_do_not_differ_in_their_dynamics(monkeypatch: pytest.MonkeyPatch) -> None:
    """A look counts each trial once, and names it as the log does."""
    counted: list[int] = []
    monkeypatch.setattr(trial_dynamics, "own_dynamics", lambda trials, steps: counted.append(len(trials)))
    log = Log.of(driven())
    look(joined([log] * 3), blind=True)
    assert counted == [len(log)]
    order = [0, *range(len(log) - 1)]
    kept = fits.distinct(replace(log, obs=log.obs[order], action=log.action[order]))
    assert isinstance(kept, Log)
    assert kept.names == (log.names[0], *log.names[2:])


def test_dynamics_of_an_expert() -> None:
    assert "Trials differ in their dynamics" in said(look(driven()), "dynamics")
    assert "No difference in dynamics is seen" in said(look(driven(same=True)), "dynamics")
    assert "No difference in dynamics is seen" in said(look(driven(same=True, goals=1)), "dynamics")
    few = driven()
    few = Trials(few.obs[:9], few.action[:9], few.mask[:9])
    assert "cannot be seen" in said(look(few), "dynamics")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bandit", "tilted_cartpole"])
def test_our_own_tasks_are_not_late_or_noisy(name: str) -> None:
    env = envs.BatchEnv(envs.get(name), 24)
    remarks = look(run_trials(env, ExpertAgent(env, policy.load(env.task)), env.task.episodes, 5).trials)
    assert not {"late", "lasting", "pause", "duplicate", "state"} & set(odd(remarks))


@pytest.mark.slow
def test_small_data() -> None:
    """One trial of one step, and actions or observations that never change."""
    look(Trials(np.zeros((1, 1, 2, 1)), np.zeros((1, 1, 1, 1)), np.ones((1, 1, 1), bool)))
    still = changed(driven(), obs=np.zeros((B, E, T + 1, 2)))
    assert not {"late", "tails"} & set(odd(look(still)))
    look(changed(driven(), action=np.zeros((B, E, T, 1))))


def write_csv(file: Path, trials: Trials, scale: float) -> None:
    with file.open("w", newline="") as opened:
        writer = csv.writer(opened)
        writer.writerow(("vehicle", "lap", "speed_x", "speed_y", "throttle"))
        for b in range(len(trials)):
            for e in range(trials.mask.shape[1]):
                for t in range(trials.mask.shape[2] + 1):
                    done = scale * trials.action[b, e, t, 0] if t < trials.mask.shape[2] else ""
                    writer.writerow((f"v{b}", e, *trials.obs[b, e, t], done))


OPTIONS = ["--trial", "vehicle", "--episode", "lap", "--obs", "speed*", "--action", "throttle"]


@pytest.mark.slow
@pytest.mark.usefixtures("here")
def test_from_csv_to_a_verdict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In one command; a look comes first, in print, page and json; and the lines that it prints run as they stand."""
    monkeypatch.setattr(diagnose.DiagnoseConfig, "__init__", _tiny_init)
    judge = diagnose.judge
    monkeypatch.setattr(diagnose, "judge", lambda *given: replace(judge(*given), next=advices.EXPLORE))
    monkeypatch.chdir(tmp_path)
    short = driven()
    short = Trials(short.obs[:24, :, :9], short.action[:24, :, :8], short.mask[:24, :, :8])
    write_csv(tmp_path / "logs.csv", short, 100)
    write_csv(tmp_path / "explored.csv", short, 200)
    given = ["--data", "logs.csv", "--explore", "explored.csv", *OPTIONS]
    monkeypatch.setattr("sys.argv", ["look", *given])
    look_command.main()
    looked = capsys.readouterr().out.strip().splitlines()
    monkeypatch.setattr("sys.argv", ["diagnose", *given, "--out", "out"])
    command.main()
    out = capsys.readouterr().out
    assert out.splitlines()[: len(looked)] == looked
    assert looked[0] == "- logs.csv: 24 trials of 2 episodes, each of 8 steps, 384 in all."
    made = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert [f"{'!' if entry['odd'] else '-'} {entry['text']}" for entry in made["look"]] == looked
    assert looked[0][2:] in (tmp_path / "out" / "index.html").read_text()
    assert made["units"]["high"][0] == pytest.approx(200 * short.action.max())
    code = made["next"]["code"]
    assert code in out
    held: dict[str, Any] = {}
    config = deconfounded.DeconfoundedConfig(rounds=1, inference_updates=2, imitation_updates=2, final_updates=2)
    monkeypatch.setattr(deconfounded, "DeconfoundedConfig", lambda: config)
    exec(code, held)
    assert held["trials"].sha256 == datasets.read_together(["logs.csv", "explored.csv"], **_roles())[0].sha256
    assert type(held["agent"]).__name__ == "RawAgent"
    assert (tmp_path / "agent" / "agent.json").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("advice", [advices.CLONE, advices.CLONE_HABITS, advices.EXPLORE_FIRST, advices.QUERY])
def test_printed_lines_run(advice: advices.Next, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an .npz too; what only the user can write says so."""
    from deconfounded.benchmarks.output.diagnosis import _code
    from deconfounded.deconf.methods import deconfounded_offline

    monkeypatch.chdir(tmp_path)
    driven().save(tmp_path / "expert.npz")
    units = {"obs": ("x", "v"), "action": ("a",), "low": (-1.0,), "high": (1.0,), "values": ()}
    assert units == vars(Units(**units))
    about = {"trials": {"from": "expert.npz"}, "explore": None, "columns": {}, "units": units}
    monkeypatch.setattr(naive_rnn, "RecurrentConfig", lambda: RecurrentConfig(updates=1, batch=2))
    few = OfflineConfig(offline_updates=1, online_updates=0, offline_batch=2)
    monkeypatch.setattr(deconfounded_offline, "OfflineConfig", lambda: few)
    code = _code(Diagnosis("cannot tell", {}, (), None, advice), about)
    if advice is advices.QUERY:
        assert WRITTEN["query"] in code
        with pytest.raises(NotImplementedError, match="ask the expert"):
            exec(code, {})
        return
    exec(code, {})
    assert (tmp_path / "agent" / "agent.json").is_file()


@pytest.mark.parametrize(("odd_action", "odd_flag"), [(None, None), (2, None), (None, 1)])
def test_flags_and_numbers_of_actions_have_shares(odd_action: int | None, odd_flag: int | None) -> None:
    """And no medians: trials of coins and of random actions are alike, whatever their quartiles are."""
    rng = np.random.default_rng(0)
    obs = (rng.random((60, 1, 41, 1)) < 0.3).astype(np.float32)
    action = rng.integers(0, 3, (60, 1, 40, 1)).astype(float)
    if odd_action is not None:
        action[7] = odd_action
    if odd_flag is not None:
        obs[7] = odd_flag
    remarks = look(Trials(obs, action, np.ones((60, 1, 40), bool), 3))
    assert len([each for each in remarks if each.kind == "outlier"]) == (odd_action, odd_flag).count(None) % 2
    if odd_action is not None:
        assert "Trial 7 is unlike the others: its share of 2 in action 0 is 1" in said(remarks, "outlier")
    if odd_flag is not None:
        assert "Trial 7 is unlike the others: its share of 1 in observation 0 is 1" in said(remarks, "outlier")


def test_an_expert_is_no_explorer(tmp_path: Path) -> None:
    """The same trials twice, though from two files, are refused."""
    files = tmp_path / "a.csv", tmp_path / "b.csv"
    for file in files:
        write_csv(file, driven(), 1)
    with pytest.raises(envs.InputError, match="--data and --explore hold the same trials"):
        look_command.read([files[0]], [files[1]], _roles())


def test_a_look_at_exploration_is_one_at_exploration(monkeypatch: pytest.MonkeyPatch) -> None:
    """It does not matter how its actions are chosen; remarks on it say that they are."""

    def remark(log: str, blind: bool = False) -> list[Any]:
        return [Remark("size", f"{log}{' as exploration' * blind}")]

    monkeypatch.setattr("deconfounded.deconf.diagnosis.look.look", remark)
    log, explored = "the expert's", "the explorer's"
    made = [each.text for each in look_command.look(log, explored)]  # type: ignore[arg-type]
    assert made == [log, f"Exploration: {explored} as exploration"]
    assert [each.text for each in look_command.look(log, None)] == [log]  # type: ignore[arg-type]


def _roles() -> dict[str, Any]:
    return {"trial": "vehicle", "episode": "lap", "obs": ["speed*"], "action": ["throttle"]}


@pytest.mark.parametrize("module", [look_command, command])
def test_bad_input_is_one_line(
    module: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_csv(tmp_path / "logs.csv", driven(), 1)
    options = [word.replace("throttle", "throtle") for word in OPTIONS]
    monkeypatch.setattr("sys.argv", ["look", "--data", str(tmp_path / "logs.csv"), *options])
    with pytest.raises(SystemExit) as ended:
        run_command(module.main)
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("error: action 'throtle' is no column of ")
    assert error.endswith("; did you mean 'throttle'?\n")
