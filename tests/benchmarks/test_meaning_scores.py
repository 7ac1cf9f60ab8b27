"""Scores by what they mean: worked out again from records or returns, or simulated."""

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from deconfounded import envs
from deconfounded.benchmarks import certify
from deconfounded.benchmarks import score as score_command
from deconfounded.benchmarks.engine import benchmark
from deconfounded.benchmarks.engine.benchmark import evaluate, objective
from deconfounded.benchmarks.engine.catalogue import METHODS
from deconfounded.benchmarks.engine.context import EVALUATION, Context, stream
from deconfounded.benchmarks.output import (
    aggregation,
    certificate,
    records,
    run_report,
    scoring,
    statistics,
    trial_scores,
)
from deconfounded.benchmarks.output.index import Found
from deconfounded.benchmarks.studies import results
from deconfounded.deconf import learned_reference
from deconfounded.deconf.exact import Grid
from deconfounded.deconf.methods import memoryless_bc
from deconfounded.envs.streams import Array, Streams
from deconfounded.experts.agent import Agent, ExpertAgent, RandomAgent
from deconfounded.experts.policy import CallableExpert
from deconfounded.experts.rollout import Rollout, run_trials, thetas
from deconfounded.experts.trials import Trials
from tests import toys
from tests.tools import tiny_preset

ROOT = Path(__file__).parents[2]
PUSH = toys.Push()
EXPERT = CallableExpert(PUSH, toys.control, "control")


class Late(Agent):
    """Random in a trial's first episode, and the expert in those after."""

    def __init__(self, env: envs.BatchEnv) -> None:
        self.agents = RandomAgent(PUSH.action_space), ExpertAgent(env, EXPERT)

    def begin(self, n: int) -> None:
        self.episode = -1

    def reset(self, rngs: Any) -> None:
        self.episode += 1
        for agent in self.agents:
            agent.reset(rngs)

    def act(self, obs: Any) -> Array:
        return self.agents[self.episode > 0].act(obs)


@pytest.mark.parametrize("salt", ["", "any text"])
def test_evaluation_is_under_the_salt_s_thetas(salt: str) -> None:
    context = Context(PUSH, tiny_preset(), [0, 1], expert="tests.toys:control")
    measured = evaluate(context, RandomAgent(PUSH.action_space), False, salt)[0]
    np.testing.assert_array_equal(measured["theta"], thetas(PUSH, 8, 2, [stream(EVALUATION, s, salt) for s in (0, 1)]))


def test_a_kept_agent_s_score() -> None:
    """0 is random actions, 1 the expert, over all episodes of the same thetas; the interval is of the last episode."""
    env = envs.BatchEnv(PUSH, 64)
    agents = {"late": Late(env), "expert": ExpertAgent(env, EXPERT), "random": RandomAgent(PUSH.action_space)}
    # `rescore` steps environments of its own, whose theta an expert among the agents would have to see.
    returns = {name: run_trials(env, agent, 2, 7).returns for name, agent in agents.items()}
    random_return, expert_return = returns["random"].mean(), returns["expert"].mean()
    result = score_command.rescore(agents["random"], PUSH, EXPERT, 64, 7, PUSH)
    assert np.mean(result["score"]) == pytest.approx(0, abs=1e-4)
    assert result["return"]["expert"] == pytest.approx(returns["expert"].mean(0), abs=1e-4)
    replayed = Replayed(run_trials(env, agents["late"], 2, 7).trials.action)
    result = score_command.rescore(replayed, PUSH, EXPERT, 64, 7, PUSH)
    by_trial = (returns["late"] - random_return) / (expert_return - random_return)
    assert result["score"] == pytest.approx(by_trial.mean(0), abs=1e-4)
    assert result["score"][0] < 0.3 < 0.8 < result["score"][1]
    last = by_trial[:, 1].mean()
    own, zero, one = returns["late"][:, 1], returns["random"].mean(1), returns["expert"].mean(1)
    half = 1.96 * (own - last * one - (1 - last) * zero).std() / (expert_return - random_return) / 8  # delta method
    assert result["ci95_last"] == pytest.approx((last - half, last + half), abs=0.02)


def test_an_interval_over_trials_holds_that_of_the_references() -> None:
    """An agent that does as the expert does has 1 for sure; one whose returns are another's does not."""
    rng = np.random.default_rng(0)
    random, expert, other = rng.normal(0, 1, 200), rng.normal(9, 3, 200), rng.normal(9, 3, 200)
    assert trial_scores.bootstrap_score(expert, random, expert) == pytest.approx([1, 1])
    error = 3 * (2 / 200) ** 0.5 / 9  # of the difference of two means
    interval = trial_scores.bootstrap_score(other, random, expert)
    assert interval is not None
    assert np.ptp(interval) == pytest.approx(2 * 1.96 * error, rel=0.15)
    assert trial_scores.bootstrap_score(np.ones(1), np.zeros(1), np.ones(1)) is None


class Lower(toys.Push):
    """Push, which draws the lower half of its thetas by a function of its own."""

    def sample_theta(self, rng: Streams) -> Array:
        return -np.abs(super().sample_theta(rng))


def test_no_score_where_it_would_mean_nothing() -> None:
    """Not if the expert is worse than random actions, nor of a range that the task's own `sample_theta` ignores."""
    away = CallableExpert(PUSH, lambda obs, theta: np.sign(obs[:, :1]), "away")
    with pytest.raises(envs.InputError, match=r"push: the expert returns .*; scores need an expert that is better"):
        score_command.rescore(RandomAgent(PUSH.action_space), PUSH, away, 64, 7, PUSH)
    assert score_command.with_ranges(PUSH, ["force=0:.5"]).latents[0].high == 0.5
    with pytest.raises(envs.InputError, match="draws theta by its own sample_theta alone"):
        score_command.with_ranges(Lower(), ["force=0:.5"])


class Replayed(Agent):
    """Actions [N, E, T, A] that were taken before, again."""

    def __init__(self, action: Array) -> None:
        self.action, self.episode = action, -1

    def reset(self, rngs: Any) -> None:
        self.episode, self.step = self.episode + 1, -1

    def act(self, obs: Any) -> Array:
        self.step += 1
        return self.action[:, self.episode, self.step]


def test_eq_1_is_over_the_steps_that_took_place() -> None:
    """By hand, of episodes that end early: the log-density of the expert's normal noise of .1 about its mean."""
    env = envs.BatchEnv(PUSH, 16)
    trials, _, theta = run_trials(env, RandomAgent(PUSH.action_space), 2, 3)
    by_episode = objective(EXPERT, trials, theta)
    for b in range(16):
        for e in range(2):
            n = int(trials.mask[b, e].sum())
            mean = toys.control(trials.obs[b, e, :n], np.tile(theta[b, e], (n, 1)))
            by_hand = norm.logpdf(trials.action[b, e, :n], mean, 0.1).sum()
            assert by_episode[b, e] == pytest.approx(by_hand, rel=1e-4)


@pytest.mark.slow
def test_intervals_over_tasks_are_of_95_percent() -> None:
    """Of the interquartile mean over two tasks of 20 seeds each: they hold the truth about as often, in 150 tries."""
    rng, held = np.random.default_rng(1), []
    for _ in range(150):
        figure = statistics.over_tasks(statistics.iqm, {name: rng.standard_normal(20) for name in "ab"})
        assert figure is not None
        assert figure.interval is not None
        held.append(figure.interval[0] <= 0 <= figure.interval[1])
    assert 0.89 < np.mean(held) < 0.98


def seeds_of_records(episode: int) -> dict[str, dict[str, tuple[Array, Array]]]:
    """By task and method, the scores and returns of seeds, in their order, in an episode: from docs/records alone."""
    by_task: dict[str, dict[str, tuple[Array, Array]]] = {}
    for file in (ROOT / "docs" / "records" / f"{name}.jsonl" for name in envs.SUITE):
        lines = sorted(map(json.loads, file.read_text().splitlines()), key=lambda line: line["seed"])
        lines = [line for line in lines if "protocol_name" not in line]  # of the standard protocol
        newest = max(line["task_version"] for line in lines)
        by_method: dict[str, list[Any]] = {}
        for line in lines:
            if line["task_version"] == newest and line["preset"] == "default" and not line["set"] and not line["salt"]:
                name = f"{line['method']}_{line['deployment']}" if line["deployment"] else line["method"]
                by_method.setdefault(name, []).append(line["returns"][: line["episodes"]])
        low, high = np.mean(by_method["random"]), np.mean(by_method["expert"])
        made = {name: np.array(returns)[:, episode] for name, returns in by_method.items()}
        by_task[file.stem] = {name: ((values - low) / (high - low), values) for name, values in made.items()}
    return by_task


def last_of_records() -> dict[str, dict[str, tuple[float, float]]]:
    """By task and method, the mean score in the last episode and the mean return there."""
    seeds = seeds_of_records(-1)
    return {task: {name: (s.mean(), r.mean()) for name, (s, r) in of.items()} for task, of in seeds.items()}


def tables(text: str) -> list[list[list[str]]]:
    """The cells of each table of a page in Markdown, its head first."""
    blocks = re.findall(r"(?:^\|.*\|\n)+", text + "\n", re.M)
    return [[[x.strip() for x in line.strip("|").split("|")] for line in table.splitlines()] for table in blocks]


@pytest.fixture(scope="module")
def some() -> Found:
    """Two tasks as the pages are made of them today."""
    tasks = [envs.get(name) for name in ("swapped_lander", "curling")]
    kept = [records.of_task(ROOT / "docs" / "records", task.name) for task in tasks]
    return [(task, aggregation.gather(of, list(METHODS))) for task, of in zip(tasks, kept, strict=True)]


@pytest.mark.slow
def test_a_number_in_readme_is_its_method_s() -> None:
    """Each row has the interquartile means, first and last episode, of its method over all tasks with a certificate."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (table,) = [table for table in tables(text) if table[0][:2] == ["method", "what it is"]]
    made = {file.stem: json.loads(file.read_text()) for file in (ROOT / "docs" / "certificates").glob("*.json")}
    passed = [name for name, certificate in made.items() if certificate["verdict"] == "passed"]
    first, last = seeds_of_records(0), seeds_of_records(-1)
    assert f"over {len(passed)} tasks" in text
    assert len(table) == 2 + 10
    for row in table[2:]:
        name = row[0][1:].partition("]")[0]
        for cell, of in zip(row[3:5], (first, last), strict=True):
            right = statistics.iqm([of[task][name][0] for task in passed])
            assert float(cell.split()[0]) == pytest.approx(right, abs=0.0051), name


def test_the_demo_in_readme_is_of_the_present_version() -> None:
    """Its rows of deconfounded are what the record of the first seed scores."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^(deconfounded\w*) +2 +[\d.]+ +((?:[\d.]+ ){4}[\d.]+)", text, re.M)
    first = [r for r in records.of_task(ROOT / "docs" / "records", "curling") if r["seed"] == 0]
    methods = aggregation.gather(first)["methods"]
    assert {name for name, _ in rows} >= {"deconfounded", "deconfounded_mode"}
    for name, scores in rows:
        assert np.array(scores.split(), float) == pytest.approx(methods[name]["score"], abs=0.0051)


@pytest.mark.slow
def test_a_number_in_the_table_of_tasks_is_its_method_s(some: Found) -> None:
    """Each cell is the mean score of the task in its row, of the method over its column: on the page, and made anew.

    Of the first seeds, of which all methods of the row have as many.
    """
    expected, seen = seeds_of_records(-1), 0
    for text in ((ROOT / "docs" / "results.md").read_text(encoding="utf-8"), results.by_task(some)):
        (table,) = [table for table in tables(text) if "deconfounded (2)" in table[0]]
        for row in table[2:]:
            of = expected[row[0][1:].partition("]")[0]]
            scores = {name: of[name.split(" (")[0]][0] for name in table[0][2:-2]}
            fewest = min(map(len, scores.values()))
            assert row[-2] == str(fewest)
            for (name, score), cell in zip(scores.items(), row[2:-2], strict=True):
                assert float(cell) == pytest.approx(score[:fewest].mean(), abs=0.0051), (row[0], name)
                seen += 1
    assert seen == 11 * (len(expected) + 2)


@pytest.mark.slow
def test_a_number_in_results_is_its_method_s(some: Found) -> None:
    """Score and return of the last episode, best first: on the page, and made anew."""
    expected, seen = last_of_records(), 0
    page = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    parts = [*re.split(r"^(?=## )", page, flags=re.M), *(results.section(*one) for one in some)]
    for part in parts:
        name = part.partition("\n")[0].removeprefix("## ")
        if name not in expected:
            continue
        seen += 1
        head, _, *rows = tables(part)[0]
        assert {row[0] for row in rows} == set(expected[name])
        for row in rows:
            cells = dict(zip(head, row, strict=True))
            last, value = expected[name][row[0]]
            assert float(cells["last"]) == pytest.approx(last, abs=0.0051), (name, row[0])
            episodes = cells["score of each episode"].split()
            assert (episodes[0], episodes[-1]) == (cells["first"], cells["last"])
            assert float(cells["regret"]) == pytest.approx(sum(1 - float(score) for score in episodes), abs=0.031)
            assert float(cells["return"].replace(",", "")) == pytest.approx(value, abs=0.051)
        scores = [float(row[head.index("last")]) for row in rows]
        assert scores == sorted(scores, reverse=True)
    assert seen == len(expected) + 2


def test_twice_as_long_is_the_last_of_twice_as_many_episodes(some: Found) -> None:
    """Its cell is empty where agents were not run for that long."""
    task, made = some[1]
    head, _, *rows = tables(results.section(task, made))[0]
    assert head[-1] == "twice as long"
    for row in rows:
        beyond = made["methods"][row[0]].get("score_beyond")
        assert row[-1] == (scoring.two_decimals(beyond[task.episodes - 1]) if beyond else "")


def entry(first: float, last: float) -> dict[str, Any]:
    """A method's part of results.json that scores `first` in the first episode and `last` in the second."""
    return {
        **{"method": "x", "deployment": "", "tier": "1", "budget": {}, "cpu_s": 1.0, "ci95": [last - 0.1, last + 0.1]},
        **{"score": [first, last], "score_first": first, "score_last": last, "regret": 2 - first - last},
        **{"ci95_first": [first - 0.1, first], "ci95_regret": None, "theta_r2": [0.0, 0.5], "objective": [-9.0, -5.0]},
        **{"return": [[10 * first, 10 * last], [10 * first, 10 * last]], "seeds": [0, 1], "band": None},
    }


def test_tables_are_best_first_and_of_the_last_episode(tmp_path: Path) -> None:
    methods = {"bad": entry(0.9, 0.1), "best": entry(0.2, 0.8), "middle": entry(0.5, 0.5)}
    rows = scoring.rows(methods)
    assert [row[0] for row in rows] == ["best", "middle", "bad"]
    best = dict(zip(scoring.COLUMNS, rows[0], strict=True))
    assert (best["return"], best["last"], best["interval"], best["Eq. (1)"]) == (
        "8.00",
        "0.80",
        "0.70 to 0.90 (51%)",
        "-5",
    )
    assert scoring.rows({"far": entry(0.2, 8.0)})[0][scoring.COLUMNS.index("return")] == "80.0"
    beside = ("first", "interval of first", "regret", "interval of regret")
    assert [best[key] for key in beside] == ["0.20", "0.10 to 0.20", "1.00", "-"]
    about = {"task": "bandit", "task_version": 0, "preset": "default", "seeds": [0, 1], "wall_s": 1.0, "machine": "x"}
    about |= {"versions": dict.fromkeys(("python", "mujoco", "torch"), "1"), "eval_trials": 4, "episodes": 2}
    text = run_report.page({**about, "commits": ["0"], "expert": "x", "methods": methods}, tmp_path)
    assert '<path d="M4.0 19.0L74.0 7.0"/>' in text  # the best, from .2 to .8: 0 is at 23, and 1 above it, at 3
    places = [re.search(rf"<td[^>]*>\s*(?:<[^>]*>\s*)*{name}\b", text).start() for name in ("best", "middle", "bad")]  # type: ignore[union-attr]
    assert places == sorted(places)


def test_cpu_seconds_are_of_a_cpu() -> None:
    """What a GPU trained says nothing of the CPU seconds that a training takes."""
    seeds = [{"cpu_s": 9.0, "machine": "x, trained on cpu"}, {"cpu_s": 1.0, "machine": "x, trained on cuda"}]
    assert scoring._cpu_seconds(seeds) == 9
    assert scoring._cpu_seconds(seeds[1:]) is None
    assert [scoring.cpu_seconds({"cpu_s": each}) for each in (1234.5, None)] == ["1,234", "by GPU"]


def test_a_certificate_asks_for_what_it_says() -> None:
    """The thresholds that the certificates in docs/ were judged by, the pages name, and a task is certified by."""
    required = {"blind_bc": "<= 0.7", "wrong_theta": "<= 0.65", "conditional_last": "<= 0.7"}
    required["interventional_last"] = ">= 0.95"
    assert {name: f"{relation} {bound}" for name, (relation, bound) in certify.THRESHOLDS.items()} == required
    for file in (ROOT / "docs" / "certificates").glob("*.json"):
        checks = json.loads(file.read_text())["checks"]
        assert {name: check["required"] for name, check in checks.items()} == required
        for check in checks.values():
            relation, bound = check["required"].split()
            holds = check["measured"] <= float(bound) if relation == "<=" else check["measured"] >= float(bound)
            assert check["passed"] == holds


def record(method: str, returns: list[float]) -> dict[str, Any]:
    """Of one seed, as far as scores go."""
    return {
        **{"seed": 0, "returns": returns, "objective": returns, "theta_r2": returns, "budget": {}, "cpu_s": 1.0},
        **{"tier": "1", "method_version": 1, "method": method, "deployment": ""},
    }


def test_episodes_beyond_training_move_no_score() -> None:
    """Zero, one, the score and its interval are of the two episodes trained on; those beyond are told apart."""
    seeds = {"random": [0.0, 0.0, 9.0, 9.0], "expert": [10.0, 10.0, 50.0, 50.0]}
    by_method = {name: [record(name, returns)] * 2 for name, returns in seeds.items()}
    by_method["other"] = [record("other", [2.0, 4.0, 30.0, 40.0]), record("other", [2.0, 6.0, 30.0, 40.0])]
    beside = [{**each, "task": "mine", "episodes": 2} for of in by_method.values() for each in of]
    references = aggregation.references(beside[0], beside)
    summary = scoring.summarise(by_method, 2, references)["other"]
    assert (summary["score"], summary["score_last"], summary["score_beyond"]) == ([0.2, 0.5], 0.5, [3.0, 4.0])
    assert summary["ci95"] == pytest.approx([0.4, 0.6])
    assert (summary["score_first"], summary["ci95_first"]) == (0.2, pytest.approx([0.2, 0.2]))
    assert summary["regret"] == pytest.approx(0.8 + 0.5)
    assert summary["ci95_regret"] == pytest.approx([0.8 + 0.4, 0.8 + 0.6])
    assert scoring.summarise(by_method, 2, references)["expert"]["regret"] == 0


def test_data_that_a_seed_did_not_use_is_none() -> None:
    """A mean over seeds is of all of them."""
    assert scoring.mean_budget([{"queries": 4}, {"queries": 2, "thetas": 6}]) == {"queries": 3, "thetas": 3}


def test_rows_csv_is_row_by_row_what_came_of_it() -> None:
    """Theta, return, score and Eq. (1) of each trial and episode, which count from 0 and from 1."""
    task, returns = toys.Drift(), np.array([[5.0, 10.0], [0.0, 2.5]])
    theta, objective_ = np.array([[[0.1], [0.2]], [[0.3], [0.4]]]), np.array([[-1.0, -2.0], [-3.0, -4.0]])
    data = {"meta": {"agents": {"x": ""}}, "x/returns": returns, "x/objective": objective_, "x/theta": theta}
    about = {"methods": {"random": {"reference": 0.0}, "expert": {"reference": 10.0}}}
    lines = scoring.csv_rows(task, about, [("x", 7, data)]).splitlines()
    assert lines[0] == "method,seed,trial,force,episode,return,score,objective"
    assert lines[1:] == [
        *("x,7,0,0.1,1,5.0,0.5,-1.0", "x,7,0,0.2,2,10.0,1.0,-2.0"),
        *("x,7,1,0.3,1,0.0,0.0,-3.0", "x,7,1,0.4,2,2.5,0.25,-4.0"),
    ]


class Remembering(RandomAgent):
    """Its features are one array, which it overwrites in every episode."""

    def begin(self, n: int) -> None:
        self.memory = np.full((n, 1), -1.0, np.float32)

    def reset(self, rngs: Any) -> None:
        super().reset(rngs)
        self.memory += 1

    def features(self) -> Any:
        return self.memory


def test_features_are_kept_as_they_were_when_overwritten(monkeypatch: pytest.MonkeyPatch) -> None:
    """After each of twice as many episodes as a trial of training has, if the agent has learned."""
    seen: list[Any] = []
    monkeypatch.setattr(benchmark, "probe", lambda features, theta: (seen.append(features[0, 0]), (0.0, None))[1])
    context = Context(PUSH, tiny_preset(), [0], expert="tests.toys:control")
    measured = evaluate(context, Remembering(PUSH.action_space), True)[0]
    assert seen == [0, 1, 2, 3]
    assert measured["returns"].shape == measured["objective"].shape == measured["theta"].shape[:2] == (4, 4)


@pytest.mark.parametrize(("first", "says"), [(0, "None after episode 3"), (1, "an array after episode 2")])
def test_features_are_of_every_episode_or_none(first: int, says: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of some would be taken for the first episodes'."""
    has_features = iter([first == 0, True, False])
    monkeypatch.setattr(Remembering, "features", lambda self: self.memory if next(has_features) else None)
    context = Context(PUSH, tiny_preset(), [0], expert="tests.toys:control")
    with pytest.raises(envs.InputError, match=f"features of Remembering were {says}, and .*; they must"):
        evaluate(context, Remembering(PUSH.action_space), True)


def test_the_filmed_trial_is_near_the_upper_end() -> None:
    """Of the first seed's 20 trials the one whose force is nearest the .85 quantile: the fourth from the top."""
    context = Context(PUSH, replace(tiny_preset(), eval_trials=20), [0, 1], expert="tests.toys:control")
    measured, _, clip = evaluate(context, RandomAgent(PUSH.action_space), False, "", True)
    theta = measured["theta"][:20, 0, 0]
    assert theta.argsort().argsort()[clip["trial"]] == 16
    assert [*clip["episode"]] == sorted(clip["episode"])
    assert {*clip["episode"]} == {0, 1}


def test_beliefs_are_read_as_at_the_end_of_training_s_last_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the probe of the second of four episodes, of the first seed, whose trial is filmed."""
    made: list[int] = []

    def probe(features: Array, theta: Array) -> Any:
        made.append(number := len(made))
        return 0.0, lambda known: np.full(len(known), number)

    monkeypatch.setattr(benchmark, "probe", probe)
    context = Context(PUSH, tiny_preset(), [0, 1], expert="tests.toys:control")
    clip = evaluate(context, Remembering(PUSH.action_space), True, "", True)[2]
    assert len(made) == 8
    assert {*clip["read"]} == {1}


class Many(toys.Push):
    """Push, with four more latents, which do nothing."""

    name = "many"
    latents = (*toys.Push.latents, *(envs.Latent(f"other_{i}", "", -1.0, 1.0) for i in range(4)))


def test_levels_of_many_latents_are_from_all_combinations() -> None:
    """Some of 32: each latent is at both of its values."""
    task = Many()
    expert = CallableExpert(task, lambda obs, theta: toys.control(obs, theta[:, :1]), "control")
    levels = certify.stakes(task, expert, certify.PARTS).levels
    assert levels.shape == (certify.MOST, 5)
    assert (np.ptp(levels, 0) > 0).all()


def test_pairs_far_apart_are_so_in_some_latent() -> None:
    """By half of the range, in quantiles; kinds are far from each other."""
    continuous = envs.Latent("a", "", 1.0, 16.0, "loguniform"), envs.Latent("b", "", 0.0, 1.0)
    kind = envs.Latent("c", "", 0, 2, "categorical")
    task: Any = SimpleNamespace(latents=continuous)
    levels = np.array([[1.0, 0.0], [3.9, 0.4], [4.0, 0.4], [1.0, 0.5]])
    assert certify.far_pairs(task, levels)[0].tolist() == [False, False, True, True]
    task = SimpleNamespace(latents=(kind,))
    assert certify.far_pairs(task, np.array([[0.0], [1.0], [0.0]]))[0].tolist() == [False, True, False]


def test_how_well_theta_is_inferred() -> None:
    """R^2, in units of the truth's variance, which is 1.25; of kinds the share that is right."""
    latents = envs.Latent("a", "", 0.0, 4.0), envs.Latent("b", "", 0, 2, "categorical")
    task: Any = SimpleNamespace(latents=latents)
    truth = np.array([[0.0, 0], [1.0, 1], [2.0, 2], [3.0, 0]])
    estimate = np.array([[0.0, 0], [1.0, 1], [2.0, 2], [2.0, 1]])
    assert certify.inferability(task, estimate, truth) == {"a": pytest.approx(1 - 0.25 / 1.25), "b": 0.75}


def test_stakes_are_of_a_true_theta_and_another_that_is_told() -> None:
    """An expert that is told the opposite force leans the wrong way; one that is told the truth scores 1.

    Where there is no force, random actions are as good as the expert's none, and there is no score.
    """
    levels, scores, returns, *_ = certify.stakes(PUSH, EXPERT, 32)
    assert np.diag(scores) == pytest.approx([1, 1, np.nan, 1, 1], nan_ok=True)
    assert np.isnan(scores[2]).all()
    assert levels[2] == 0
    assert returns[0, -1] < 0.6 * returns[0, 0]
    assert returns[-1, 0] < 0.6 * returns[-1, -1]


@pytest.mark.slow
def test_the_error_of_a_certificate_s_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    """How much they scatter over other trials, within a factor of 1.6."""
    rng = np.random.default_rng(0)
    random, expert = rng.normal(0, 2, (200, 50)), rng.normal(5, 2, (200, 50))
    for share in (0.8, 0.2):  # of the expert's returns: where it is little, random actions' scatter matters most
        returns = share * expert + rng.normal(0, 1, (200, 50))
        made = scoring.normalise(returns.mean(1), random.mean(1), expert.mean(1))
        said = np.mean([trial_scores.standard_error(*of) for of in zip(returns, random, expert, strict=True)])
        assert said == pytest.approx(made.std(), rel=0.15)
    task, measured = type("Forced", (toys.Push,), {"latents": (envs.Latent("force", "", 0.5, 1.0),)})(), []
    for seed in range(12):
        monkeypatch.setattr(certify, "SEED", 1000 * seed)
        measured.append(certify.stakes(task, CallableExpert(task, toys.control, "control"), 32))
    error = float(np.mean([of.error for of in measured]))
    assert 1 / 1.6 < error / np.std([of.wrong for of in measured]) < 1.6


def test_a_picture_of_stakes_has_the_true_theta_in_its_rows(figures: list[Any], tmp_path: Path) -> None:
    """And beside it each exact policy's own scores, and the evidence of each source."""
    policies = {
        name: {"score": [i / 10] * certify.EPISODES} for i, name in enumerate(("interventional", "conditional"))
    }
    result = {
        **{"task": "push", "verdict": "passed", "checks": {"blind_bc": {"measured": 0.3}}, **policies},
        **{"stakes": {"score": [[1.0, 0.1], [0.2, 0.9]], "levels": [[-1.0], [1.0]]}},
        **{"evidence_nats_per_step": {"dynamics": 0.5, "actions": 2.0, "delusion_ratio": 4.0}},
    }
    certificate.picture(result, tmp_path / "push.png")
    left, middle, right = figures[0].axes[:3]
    assert (left.get_xlabel(), left.get_ylabel()) == ("theta given", "true theta")
    assert {text.get_position(): text.get_text() for text in left.texts} == {
        **{(0, 0): "1.00", (1, 0): "0.10"},  # x is the column
        **{(0, 1): "0.20", (1, 1): "0.90"},
    }
    np.testing.assert_array_equal(left.images[0].get_array(), result["stakes"]["score"])
    for line, name in zip(middle.lines, policies, strict=False):
        assert line.get_label() == f"exact {name}"
        assert [*line.get_ydata()] == policies[name]["score"]
    assert [bar.get_height() for bar in right.patches] == [0.5, 2.0]


def test_a_certificate_s_belief_goes_on_after_an_early_end() -> None:
    """Theta switches in the steps that an episode lacks too: by hand, one step in ten draws it anew, here for four."""
    env, k = envs.BatchEnv(toys.Switch(), 5), 6
    expert = CallableExpert(env.task, toys.control, "control")
    recorder = certify.EvidenceRecorder(env, expert, Grid(env, expert, k))
    obs = env.reset(0)
    recorder.begin(5)
    recorder.reset([np.random.default_rng(0)])
    for _ in range(PUSH.horizon - 4):
        alive, action = env.alive, recorder.act(obs)
        following = env.step(action)[0]
        recorder.observe(obs, action, following, alive)
        obs = following
    before = np.exp(recorder.log_belief)
    recorder.reset([np.random.default_rng(1)])
    stays = 0.9**4
    np.testing.assert_allclose(np.exp(recorder.log_belief), stays * before + (1 - stays) / k, atol=1e-9)


def test_a_certificate_s_scores_are_of_its_returns(monkeypatch: pytest.MonkeyPatch) -> None:
    """0 is its random actions, 1 its expert; checks are of the last episode; a clone that learned nothing is at 0."""
    cloned: list[Trials] = []
    monkeypatch.setattr(
        memoryless_bc, "train", lambda trials, *_: (cloned.append(trials), RandomAgent(PUSH.action_space))[1]
    )
    certificate = certify.certify(PUSH, EXPERT, trials=12, grid=5)
    scored = run_trials(envs.BatchEnv(PUSH, 12), RandomAgent(PUSH.action_space), certify.EPISODES, certify.SEED).trials
    assert not np.isin(cloned[0].obs[:, 0, 0], scored.obs[:, 0, 0]).any(), "the clone has seen trials it is scored in"
    for name in ("interventional", "conditional"):
        random_return, expert_return = certificate["return_random"], certificate["return_expert"]
        scores = [(value - random_return) / (expert_return - random_return) for value in certificate[name]["return"]]
        assert certificate[name]["score"] == pytest.approx(scores)
        assert certificate["checks"][f"{name}_last"]["measured"] == pytest.approx(scores[-1], abs=1e-4)
    assert certificate["checks"]["blind_bc"]["measured"] == 0


def test_learned_dynamics_are_of_other_thetas_than_a_certificate_scores(monkeypatch: pytest.MonkeyPatch) -> None:
    trained: list[Array] = []

    def stop(rollouts: list[Rollout], which: Any) -> None:
        trained.extend(rollout.theta for rollout in rollouts)
        raise InterruptedError

    monkeypatch.setattr(learned_reference, "steps", stop)
    monkeypatch.setattr(toys.Push, "has_likelihood", False)
    with pytest.raises(InterruptedError):
        certify.certify(PUSH, EXPERT, trials=12)
    assert len(trained) == 3
    scored = thetas(PUSH, 12, certify.EPISODES, certify.SEED)
    assert not np.isin(np.concatenate(trained), scored).any()
