"""Parts of a diagnosis by what they mean: what a figure is of, and which of two explanations is believed."""

from dataclasses import replace
from itertools import cycle
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from deconfounded.benchmarks.output import diagnosis as page
from deconfounded.deconf.core.data import Batch, Draws, Signature
from deconfounded.deconf.core.linear_model import LinearModel
from deconfounded.deconf.core.models import new_model
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.deconf.core.nets import ActionHead, Inputs, Scales
from deconfounded.deconf.diagnosis import advice, diagnose, fits, labels, latent, measures, state, trait
from deconfounded.deconf.diagnosis.deviation import paired_score
from deconfounded.deconf.diagnosis.diagnose import DiagnoseConfig
from deconfounded.deconf.diagnosis.held_out import Best, PartMonitor, Report
from deconfounded.deconf.diagnosis.judgement import judge
from deconfounded.deconf.diagnosis.latent import Explanation
from deconfounded.deconf.diagnosis.learned_env import LatentPolicy, LearnedEnv, Rollout
from deconfounded.deconf.diagnosis.measures import Amounts, Findings, split
from deconfounded.deconf.diagnosis.thresholds import GOOD, MISFIT, NEGLIGIBLE, STAKES
from deconfounded.deconf.diagnosis.verdict import Diagnosis
from deconfounded.deconf.methods import memoryless_bc, naive_rnn
from deconfounded.deconf.methods.memoryless_bc import MemorylessConfig
from deconfounded.envs.support.errors import InputError
from deconfounded.experts.trials import Trials
from tests.deconf.ball import streams
from tests.deconf.test_deviation import lines, walks
from tests.deconf.test_diagnose import CLEAR
from tests.deconf.test_latent import CLONING, EXPLORING, world
from tests.deconf.test_meaning_beliefs import FLAT, numbered
from tests.deconf.test_meaning_learning import poisoned
from tests.deconf.test_termination import Walker


def test_a_memory_that_did_not_fit_in_a_single_split_stops_the_verdict() -> None:
    """Though it fitted in the mean of all."""
    diagnosis = judge([CLEAR, CLEAR, CLEAR._replace(memory_gain=-1.5 * MISFIT)])
    assert diagnosis.figures["memory_gain"].value > 0
    assert "did not fit" in diagnosis.conclusion
    assert (diagnosis.verdict, diagnosis.next) == ("cannot tell", advice.MORE_TRIALS)


def test_half_of_the_splits_are_enough() -> None:
    """A verdict falls where fewer than half of them give it alone."""
    diagnosis = judge([CLEAR, CLEAR._replace(over_memory=1.0)])
    assert (diagnosis.verdict, diagnosis.agreeing, diagnosis.refits) == ("confounded", 1, 2)


def test_a_bar_of_the_page_is_of_the_figure_beside_it(figures: list[Any]) -> None:
    """From 0 to its mean, with a line from its least to its greatest over splits, and the threshold that decides."""
    made = judge([CLEAR, CLEAR._replace(memory_gain=1.5, stakes=4.0, exploration_evidence=0.4, naive_by_actions=0.3)])
    page._findings(made.figures)
    names = {
        "memory": "memory_gain",
        "latent from dynamics": "latent_gain",
        "dynamics, in exploration": "exploration_evidence",
        "dynamics, in expert trials": "expert_evidence",
        "the expert's actions": "action_evidence",
        "from all with right latents": "stakes",
        "paired by latent and start": "paired_stakes",
        "naive clone": "naive",
        "infers the latent": "latent",
        "naive clone, Eq. (1)": "naive_by_actions",
        "infers the latent, Eq. (1)": "latent_by_actions",
    }
    labels = list[str]()
    for drawn, threshold in zip(figures, (NEGLIGIBLE, NEGLIGIBLE, STAKES, GOOD), strict=True):
        (axes,) = drawn.axes
        *ranges, zero, decides = axes.lines
        assert [line.get_xdata()[0] for line in (zero, decides)] == [0, threshold]
        for i, text in enumerate(axes.get_yticklabels()):
            value, low, high = made.figures[names[text.get_text()]]
            bar = axes.patches[i]
            assert bar.get_y() < axes.get_yticks()[i] < bar.get_y() + bar.get_height()
            assert (bar.get_x(), bar.get_width()) == (0, value)
            assert list(ranges[i].get_xdata()) == [low, high]
            labels.append(text.get_text())
    assert labels == list(names)


def test_clones_are_trained_without_the_trials_that_judge_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those with a memory and those without, on the same three quarters of the trials."""
    number = np.arange(16.0)
    obs = np.broadcast_to(number[:, None, None, None], (16, 1, 6, 1))
    given: list[set[float]] = []

    def note(trials: Trials, *_: Any, **__: Any) -> None:
        given.append({*trials.obs.ravel().tolist()})
        if len(given) == 2:
            raise StopIteration

    judged: list[Batch] = []
    monkeypatch.setattr(measures, "BestMonitor", lambda *rest: judged.append(rest[-1]))
    for method in (memoryless_bc, naive_rnn):
        monkeypatch.setattr(method, "train", note)
    trials = Trials(obs, np.random.default_rng(0).uniform(-1, 1, (16, 1, 5, 1)), np.ones((16, 1, 5)))
    with pytest.raises(StopIteration):
        measures.measure(trials, None, Amounts(), np.random.default_rng(0))
    rest = {*judged[0].obs.ravel().tolist()}
    assert given == [{*number} - rest] * 2
    assert len(rest) == 4


def test_a_latent_and_a_memory_are_compared_at_the_same_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those from which the latent is not inferred: every other one, where the memory has 3 nats, of 0 at the rest."""
    remembered = 3.0 * (torch.arange(10) % 2).expand(1, 6, 10)
    best = cycle((SimpleNamespace(log_prob=torch.zeros(1, 6, 10)), SimpleNamespace(log_prob=remembered)))
    monkeypatch.setattr(measures, "BestMonitor", lambda *rest: SimpleNamespace(best=next(best)))
    for method in (memoryless_bc, naive_rnn):
        monkeypatch.setattr(method, "train", lambda *rest, **named: SimpleNamespace(scales=SimpleNamespace(obs=None)))
    monkeypatch.setattr(measures.termination, "fit", lambda *rest: None)
    explanation = Explanation(None, None, torch.zeros(1, 1, 1), latent_gain=9.0, log_likelihood=2.0)  # type: ignore[arg-type]
    monkeypatch.setattr(measures, "_explain", lambda *rest: explanation)
    monkeypatch.setattr(measures, "_rollouts", lambda *rest: (1.0,) * 8)
    rng = np.random.default_rng(0)
    trials = Trials(rng.normal(size=(24, 1, 11, 1)), rng.uniform(-1, 1, (24, 1, 10, 1)), np.ones((24, 1, 10)))
    findings = measures.measure(trials, trials, Amounts(), rng)
    assert (findings.memory_gain, findings.latent_gain, findings.over_memory) == (1.5, 9.0, -1.0)
    monkeypatch.setattr(latent, "from_expert_trials", lambda *rest: explanation._replace(log_likelihood=None))
    assert measures.measure(trials, None, Amounts(), rng).over_memory is None


def test_the_length_of_rollouts_is_over_that_of_the_data() -> None:
    """Rollouts of 5 steps are as long as trials that ended after 5 of 10."""
    paths = torch.randn(1, 8, 10, 1, generator=torch.Generator().manual_seed(0))
    env: Any = SimpleNamespace(rollout=lambda *_: Rollout(torch.zeros(1), paths, torch.full((1, 8), 5.0)))
    rng, taken = np.random.default_rng(0), np.broadcast_to(np.arange(10) < 5, (6, 1, 10))
    episodes = Batch.of(Trials(rng.normal(size=(6, 1, 11, 1)), np.zeros((6, 1, 10, 1)), taken), 1)
    explanation = Explanation(None, None, torch.arange(4.0)[None, :, None])  # type: ignore[arg-type]
    figures = measures._rollouts(explanation, lambda _: env, None, episodes, Amounts(rollouts=8), [rng])  # type: ignore[arg-type]
    assert figures[Findings._fields.index("model_length") - Findings._fields.index("stakes")] == 1


def test_printed_lines_explore_by_the_log_of_exploration() -> None:
    """It is read beside the expert's; where there is none, the expert's own log is all that there is."""
    units = {"obs": ("x",), "action": ("a",), "low": (-1.0,), "high": (1.0,), "values": ()}
    about = {"trials": {"from": "expert.npz"}, "explore": {"from": "explored.npz"}, "columns": {}, "units": units}
    made = Diagnosis("confounded", {}, (), 2, advice.EXPLORE)
    lines = page._code(made, about)
    assert "trials, explored = datasets.read_together(['expert.npz', 'explored.npz'])" in lines
    assert "    return explored\n" in lines
    lines = page._code(made, about | {"explore": None})
    assert "trials = datasets.read('expert.npz')\n" in lines
    assert "    return trials\n" in lines
    lines = page._code(made, about | {"units": units | {"obs": ("speed\n(m/s)", "slope")}})
    assert "; obs: speed (m/s), slope\n" in lines


@pytest.mark.parametrize(
    ("gain", "evidence", "single"), [(1.0, 1.0, True), (1.0, 0.0, False), (0.0, 1.0, False), (0.0, 0.0, False)]
)
def test_latents_of_episodes_explain_dynamics_and_actions(
    gain: float, evidence: float, single: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More of one alone is no reason to believe that something hidden changes between episodes."""
    of_trials, of_episodes = (
        Explanation(None, None, torch.zeros(1, 1, 1), latent_gain=1 + by[0], expert_evidence=1 + by[1])  # type: ignore[arg-type]
        for by in ((0.0, 0.0), (gain, evidence))
    )
    explanations, batches = iter((of_trials, of_episodes)), list[int]()
    monkeypatch.setattr(measures, "_differ", lambda explored: (0.0, 1.0))
    next_one = lambda *given: (batches.append(given[3].inference_batch), next(explanations))[1]  # noqa: E731
    monkeypatch.setattr(latent, "from_dynamics", next_one)
    data = world(0.2, False, 8, 0, 2), world(0.2, False, 8, 1, 2)
    amounts = Amounts(exploring=EXPLORING, cloning=CLONING)
    explanation = measures._explain(data, data, amounts, streams(), lambda share: None)
    assert explanation is (of_episodes if single else of_trials)
    assert batches == [EXPLORING.inference_batch, 2 * (EXPLORING.inference_batch or 0)]  # as many steps


def test_what_a_fit_of_each_trial_leaves_of_noise_is_its_variance() -> None:
    """Though a fit of four coefficients to 40 steps leaves a tenth less of each trial: 20,000 numbers."""
    rng, trials, steps = np.random.default_rng(0), 500, 40
    x, y = rng.normal(size=(trials * steps, 3)), rng.normal(size=(trials * steps, 1))
    left, own = fits.residual(y, x, np.repeat(np.arange(trials), steps))
    assert own
    assert left.var() == pytest.approx(1, abs=0.03)


def test_the_noise_of_dynamics_is_that_of_the_expert_s_trials() -> None:
    """Explorers meet more of it: beyond |s| = 1.5 it is twenty times as large."""
    rng = np.random.default_rng(0)
    expert, explored = (split(world(0.2, kind, 64, seed), 0.25, rng) for seed, kind in enumerate((True, False)))
    few = replace(EXPLORING, inference_updates=20)
    explanation = latent.from_dynamics(expert, explored, 1, few, replace(CLONING, updates=2), streams(), Monitor())
    data, head = Batch.of(expert[0], 1), explanation.dynamics
    with torch.no_grad():
        own = latent.each_step(data, explanation.latents)
        expected = head(data.obs, data.action, own)[..., 0, :]
        left = head.change(data.next_obs - data.obs) - expected
    torch.testing.assert_close(head.log_std.exp().flatten(), left.square().mean().sqrt().reshape(1))


@pytest.mark.slow
def test_a_trait_is_of_the_half_before() -> None:
    """Where nothing of it shows there, in trials that are held out, there is no gain in the second half."""
    rng = np.random.default_rng(0)
    side, obs = rng.choice([-1, 1], (48, 1, 1, 1)), rng.uniform(-1, 1, (48, 1, 41, 1))
    action = 0.4 * side + 0.05 * rng.standard_normal((48, 1, 40, 1))
    action[36:, :, :20] -= 0.4 * side[36:]
    train, held_out = (
        Trials(obs[i], action[i], np.ones((len(obs[i]), 1, 40), bool)) for i in (slice(0, 36), slice(36, None))
    )
    config = MemorylessConfig(updates=100, batch=256, width=32, learning_rate=6e-3)
    fitted = trait.fit(Batch.of(train, 1), Batch.of(held_out, 1), Signature.of(train), config, streams())
    assert fitted.gain < 0.1


class TestSplits:
    """A diagnosis measures several splits of the trials, each by random numbers of its own."""

    def test_each_is_another(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """And another one with another generator; progress goes from 0 to 1 over all of them."""
        drawn, shares = list[float](), list[float]()

        def measure(trials: Trials, explore: object, amounts: Amounts, rng: np.random.Generator, report: Report) -> Any:
            drawn.append(rng.random())
            report(0.5)
            return CLEAR

        monkeypatch.setattr(diagnose, "measure", measure)
        data = world(0.2, True, 24, 0)
        for seed in range(2):
            diagnose.diagnose(data, None, DiagnoseConfig(refits=3), np.random.default_rng(seed), shares.append)
        assert len({*drawn}) == 6
        assert shares == pytest.approx([1 / 6, 3 / 6, 5 / 6] * 2)

    def test_columns_are_judged_by_exploration(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Where there is any: an expert's actions go with what is hidden."""
        judged = list[Trials]()
        for module, name in ((labels, "of_dynamics"), (state, "incomplete")):
            monkeypatch.setattr(module, name, lambda data: judged.append(data) or [])
        expert, explore = (world(0.2, kind, 24, seed) for seed, kind in enumerate((True, False)))
        diagnose.conclude([CLEAR], expert, explore)
        assert [data is explore for data in judged] == [True, True]
        diagnose.conclude([CLEAR], expert, None)
        assert [data is expert for data in judged[2:]] == [True]


def test_exploration_has_the_expert_s_kind_of_actions() -> None:
    """Numbers 0 and 1 that are names, and numbers."""
    data = world(0.2, False, 24, 0)
    action = (data.action > 0).astype(float)
    numbers, names = (Trials(data.obs, action, data.mask, actions) for actions in (0, 2))
    with pytest.raises(InputError, match="exploration has other observations or actions"):
        diagnose.check(numbers, names, DiagnoseConfig())


def test_the_progress_of_a_part_ends_where_the_part_does() -> None:
    shares = list[float]()
    monitor = PartMonitor(shares.append, 0.25, 0.8)
    for done in (0, 1, 2):
        monitor.update(done, 2, {})
    assert shares == pytest.approx([0.25, 0.525, 0.8])


def test_stakes_are_1_by_chance() -> None:
    """In the mean of 40 draws of 32 trajectories: the largest of 16 deviations is compared with the largest, too."""
    stakes = [measures.stakes_of([walks(32, 4 * draw + i) for i in range(4)]) for draw in range(40)]
    assert np.mean(stakes, 0) == pytest.approx([1, 1], abs=0.1)


def test_exploration_counts_where_the_expert_goes_in_all_columns() -> None:
    """A step that is far off in one of them is left out."""
    rng = np.random.default_rng(0)
    shape = (6, 1, 20)
    expert = Trials(rng.uniform(-1, 1, (6, 1, 21, 2)), rng.uniform(-1, 1, (*shape, 1)), np.ones(shape, bool))
    obs, inside = expert.obs.copy(), np.ones(shape, bool)
    obs[2, 0, 3, 1], inside[2, 0, 3] = 50, False
    explored = Trials(obs, expert.action, expert.mask)
    np.testing.assert_array_equal(measures.near(expert, explored).mask, inside)
    masked = latent.in_range(Batch.of(expert, 1), Batch.of(explored, 1)).mask
    np.testing.assert_array_equal(masked[0], inside[:, 0])


def test_padding_is_not_outside_of_the_expert_s_range() -> None:
    """Exploration whose episodes end after one step of a hundred is where the expert goes all the time."""
    rng = np.random.default_rng(0)
    obs, action = rng.uniform(-1, 1, (6, 1, 101, 2)), rng.uniform(-1, 1, (6, 1, 100, 1))
    expert = Trials(obs, action, np.ones((6, 1, 100), bool))
    explored = Trials(obs, action, np.broadcast_to(np.arange(100) < 1, (6, 1, 100)))
    assert latent.in_range(Batch.of(expert, 1), Batch.of(explored, 1)).mask.sum() == 6


def test_a_held_out_trait_is_of_the_early_half(monkeypatch: pytest.MonkeyPatch) -> None:
    """Actions of the late half are predicted by it, and are no part of what it is inferred from."""
    read, forward = list[torch.Tensor](), trait.Encoder.forward
    monkeypatch.setattr(trait.Encoder, "forward", lambda self, x: (read.append(x.mask), forward(self, x))[1])
    trials, held_out = (Batch.of(world(0.2, True, n, n), 1) for n in (12, 5))
    config = MemorylessConfig(updates=2, width=8)
    trait.fit(trials, held_out, Signature.of(world(0.2, True, 12, 12)), config, streams())
    assert torch.equal(read[-1], trait.halves(held_out)[0].mask)


def test_learning_that_fails_is_kept_to_be_said(monkeypatch: pytest.MonkeyPatch) -> None:
    best = Best(Batch.of(world(0.2, True, 5, 0), 1))
    assert best.check(1, 1, lambda: torch.full((1, 5, 40), torch.nan))
    assert best.log_prob.isnan().all()


def test_few_steps_of_a_set_are_from_anywhere_in_its_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    """And not the first ones, by which a latent would tell the time."""
    read, loss = list[torch.Tensor](), LinearModel.loss_on_sets
    spy = lambda self, data, *rest: (read.append(data.obs), loss(self, data, *rest))[1]  # noqa: E731
    monkeypatch.setattr(LinearModel, "loss_on_sets", spy)
    data = numbered(4, 39)
    few = replace(EXPLORING, inference_updates=4, shortest=0.25)
    latent._train_dynamics(data, Scales.of(FLAT, data), few, streams(), Monitor())
    shortest = min(read, key=lambda obs: obs.shape[2])
    assert (shortest % 40).max() > 20 > shortest.shape[2]


def test_a_policy_is_as_it_was_when_held_out_actions_were_likeliest() -> None:
    """Their log-likelihoods are those of the policy that is returned with them, though it was trained on."""
    data, held_out = numbered(4, 20), numbered(2, 20)
    held_out.action = -held_out.action
    model = new_model("linear", 2, 8, Scales.of(FLAT, data), streams())
    config, latents = MemorylessConfig(updates=24, batch=64, learning_rate=0.1), torch.zeros(1, 2, 2)
    belief = model.belief(model.final_memory(data))
    policy, log_prob = latent._train_policy(model, data, belief, held_out, latents, config, streams())
    own = latent._log_action(model, policy)(held_out, latent.each_step(held_out, latents))
    torch.testing.assert_close(log_prob, own)


class TestTraitOfAHalf:
    """A trait is of the steps of a half that took place."""

    @pytest.fixture
    def half(self) -> Batch:
        """64 of 80 steps."""
        made = numbered(3, 80)
        made.mask[:, :, 64:] = 0
        return made

    def test_encoder(self, half: Batch) -> None:
        encoder = trait.Encoder(8, Scales.of(FLAT, half), streams())
        torch.testing.assert_close(encoder(poisoned(half)), encoder(half))

    def test_drawn_steps(self, half: Batch) -> None:
        assert trait._draw(half, streams()).mask.all()


def test_nothing_is_lost_where_wrong_latents_lead_nowhere_else() -> None:
    """In the mean of 30 draws: one repeat is chance for the clone, and another for wrong latents."""
    scores = []
    for draw in range(30):
        right, *repeats, paths, wrong = (lines(32, 5 * draw + i) for i in range(5))
        scores.append(paired_score(paths, wrong, right, tuple(repeats)))
    assert np.mean(scores) > 0.8


class Noisy(Walker):
    """Reference and actor: both stay where they are, in noise."""

    def next_obs(self, obs: torch.Tensor, action: torch.Tensor, draws: Draws) -> torch.Tensor:
        return obs + 0.1 * draws.normal(*obs.shape[1:])


class TestLearnedEnv:
    def test_a_repeat_is_another_rollout(self) -> None:
        """From the same starts, by other random numbers; and the same again from the same generator."""
        expert = Batch.of(world(0.2, True, 24, 0), 1)
        make: Any = LearnedEnv
        actor = Noisy()
        env, paths = make(actor, expert, [expert], 2, 5, None), []
        for _ in range(2):
            rngs = [np.random.default_rng(0)]
            paths += [env.rollout(actor, rngs).paths, env.rollout(actor, rngs).paths]
        assert torch.equal(paths[0], paths[2])
        assert (paths[0] != paths[1]).all()

    def test_episodes_start_where_the_expert_s_do(self) -> None:
        """Each where one of its trials starts, of all of them."""
        expert = Batch.of(world(0.2, True, 24, 0), 1)
        make: Any = LearnedEnv
        env = make(Noisy(), expert, [expert], 2, 5, None)
        starts = {float(start) for obs in env.starts for start in obs.ravel()}
        assert starts <= {*expert.obs[0, :, 0, 0].tolist()}
        assert len(starts) > 2

    def test_errors_of_actions_are_in_units_of_what_latents_do(self) -> None:
        """Of what two latents differ by on average, .2 here; more than that is 1."""
        signature = SimpleNamespace(policy=SimpleNamespace(signature=SimpleNamespace(actions=0)), theta_hat=None)
        reference = SimpleNamespace(point=lambda obs, latent: torch.zeros(1, 1, 2), **vars(signature))
        env: Any = SimpleNamespace(reference=reference, scale=torch.tensor([[0.2]]))
        for action, error in ((0.0, 0.0), (0.05, 0.5), (0.3, 1.0)):
            measured = LearnedEnv._action_error(env, torch.zeros(1, 1, 1), torch.full((1, 1, 2), action))
            assert measured.item() == pytest.approx(error)

    def test_the_unit_is_the_mean_distance_of_actions_under_two_latents(self) -> None:
        """Of actions of -.1 and .1, half of all pairs are .2 apart."""
        signature = SimpleNamespace(signature=SimpleNamespace(actions=0))
        latents = torch.tensor([-0.1, 0.1]).repeat(32)[None, :, None]
        env: Any = SimpleNamespace(
            reference=SimpleNamespace(policy=signature, theta_hat=latents, point=lambda obs, latent: latent)
        )
        assert LearnedEnv._scale(env, numbered()).item() == pytest.approx(0.1, abs=0.01)

    def test_a_point_is_the_mean_action(self) -> None:
        """In the units of actions, as they are drawn: 20,000 of them."""
        data = numbered()
        data.action = 0.2 + 0.05 * data.action
        scales, dynamics = Scales.of(FLAT, data), SimpleNamespace()
        dynamics.inputs = Inputs(scales)
        made: Any = LatentPolicy
        actor = made(dynamics, ActionHead(2, 8, scales, streams()), torch.ones(1, 20_000, 1))
        actor.begin(20_000, [np.random.default_rng(0)])
        obs = torch.full((1, 20_000, 1), 30.0)
        assert actor.choose(obs).mean().item() == pytest.approx(
            actor.point(obs, actor.theta_hat).mean().item(), abs=2e-3
        )
