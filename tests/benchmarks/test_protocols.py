"""Protocols: what each changes of data, trials and thetas, and that records of two never stand in one table."""

import json
import queue
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deconfounded import envs
from deconfounded.benchmarks import commands, compare, report
from deconfounded.benchmarks.engine import progress, protocols, scheduler
from deconfounded.benchmarks.engine.benchmark import BenchmarkJob, evaluate
from deconfounded.benchmarks.engine.catalogue import METHODS
from deconfounded.benchmarks.engine.context import Context
from deconfounded.benchmarks.engine.identity import identity
from deconfounded.benchmarks.engine.local import Here
from deconfounded.benchmarks.engine.presets import preset
from deconfounded.benchmarks.engine.published import RECORDS
from deconfounded.benchmarks.output import aggregation, comparison, records
from deconfounded.benchmarks.studies import table
from deconfounded.envs.streams import Array, Streams
from deconfounded.envs.support.files import write_sealed
from deconfounded.experts.agent import RandomAgent
from tests import toys
from tests.tools import deconf, tiny_preset

PUSH = toys.Push()


def context(task: envs.Task, protocol: str, **amounts: int) -> Context:
    settings = replace(tiny_preset(), **amounts)
    return Context(task, settings, [0, 1], expert="tests.toys:control", protocol=protocol)


def inside(theta: Array) -> Array:
    """Whether thetas are in the middle half of their distribution."""
    quantile = PUSH.latents[0].cdf(theta)
    return (quantile >= 0.25) & (quantile <= 0.75)


def test_scarce_amounts() -> None:
    """On control 16 expert trials and, over the rounds of deconfounded, 32 of exploration; evaluation as before."""
    plain = preset("default", envs.get("curling"), "cpu")
    made = protocols.amounts("scarce", plain)
    rounds = made.configs["deconfounded"]["rounds"]
    assert (made.expert_trials, made.explore_trials * rounds, made.query_trials) == (16, 32, 3)
    assert replace(made, **{name: getattr(plain, name) for name in protocols.AMOUNTS}) == plain
    assert protocols.amounts("once", plain) == plain


def test_scarce_is_evaluated_as_the_standard_protocol() -> None:
    """So that who learns from no data has the same record under both."""
    amounts = {"expert_trials": 32, "explore_trials": 16}
    scarce, standard = (
        evaluate(context(PUSH, name, **amounts), RandomAgent(PUSH.action_space), False)[0]["returns"]
        for name in ("scarce", "standard")
    )
    assert np.array_equal(scarce, standard)


def test_scarce_is_scarce_for_every_method() -> None:
    """Demonstrations are not drawn anew; and a method that says itself how much it explores is refused."""
    bandit = preset("paper", envs.get("bandit"), "cpu")
    assert bandit.fresh
    assert protocols.amounts("scarce", bandit).fresh == 0
    with pytest.raises(envs.InputError, match="--protocol scarce is not for gail: its own settings say how much"):
        protocols.check_methods("scarce", ["dagger", "gail"])
    protocols.check_methods("once", ["dagger", "gail"])
    assert protocols.possible("once", ["dagger", "gail"]) == ["dagger", "gail"]
    args = commands.parser("", "", 1).parse_args(["--methods", "all"])
    args.protocol = "scarce"
    assert "gail" not in commands.check(args, [*METHODS], [])


class OwnThetas(toys.Push):
    def sample_theta(self, rng: Streams) -> Array:
        return super().sample_theta(rng) ** 3


def test_unseen_thetas() -> None:
    """All that training sees is of the middle half, all that is scored of the rest, on both sides."""
    made = context(PUSH, "unseen", expert_trials=32, explore_trials=16, query_trials=16, eval_trials=32)
    made.demonstrations  # noqa: B018
    explored = made._roll_out(16, None, made.rngs).theta
    assert inside(made.demonstrated_theta).all()
    assert inside(explored).all()
    scored = evaluate(made, RandomAgent(PUSH.action_space), False)[0]["theta"]
    assert not inside(scored).any()
    assert scored.min() < made.demonstrated_theta.min()
    assert scored.max() > made.demonstrated_theta.max()
    standard = context(PUSH, "standard", expert_trials=32).demonstrated_theta
    assert 0.2 < inside(standard).mean() < 0.8
    grids = [protocols.applied("unseen", PUSH, evaluation).theta_grid(5) for evaluation in (False, True)]
    assert all((grid == PUSH.theta_grid(5)).all() for grid in grids), "p(theta) is the same to exact policies"


@pytest.mark.parametrize(
    ("name", "says"), [("bandit", "best_arm is categorical"), ("rolling_deck", "moves"), ("gusty_drone", "moves")]
)
def test_tasks_without_unseen_thetas(name: str, says: str) -> None:
    with pytest.raises(envs.InputError, match=f"--protocol unseen is not for {name}: .*{says}"):
        protocols.applied("unseen", envs.get(name))
    with pytest.raises(envs.InputError, match="it draws theta by its own sample_theta"):
        protocols.applied("unseen", OwnThetas())
    assert [task.name for task in table.fitting("unseen", [envs.get(name), PUSH])] == ["push"]
    with pytest.raises(envs.InputError, match="protocol 'onec' is unknown; did you mean 'once'"):
        protocols.applied("onec", envs.get(name))


def test_trials_of_one_episode() -> None:
    made = context(toys.Drift(), "once")
    assert not made.task.drifts
    assert made.demonstrations.mask.shape[:2] == (8, 1)
    assert evaluate(made, RandomAgent(PUSH.action_space), True)[0]["returns"].shape == (8, 1)
    assert envs.get("rolling_deck").episodes == protocols.applied("scarce", envs.get("rolling_deck")).episodes == 5


def test_demonstrations_in_a_folder_are_of_their_protocol(tmp_path: Path) -> None:
    """Those of the standard protocol are not taken for those without unseen thetas, which are as many and as long."""
    standard, unseen = (context(PUSH, name) for name in ("standard", "unseen"))
    standard.folder = unseen.folder = tmp_path
    first = standard.demonstrations
    assert standard.has_demonstrations(0)
    assert not unseen.has_demonstrations(0)
    assert unseen.demonstrations.sha256 != first.sha256


def test_demonstrations_of_a_run_are_of_its_protocol(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are made before any method asks for them, which finds them."""
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    monkeypatch.setattr(BenchmarkJob, "run", lambda self: "")
    job = BenchmarkJob("curling", tiny_preset(), "blind_bc", (0,), tmp_path, protocol="once")
    scheduler.run_all([job], "cpu", "", Here())
    assert job.context().has_demonstrations(0)
    assert not replace(job, protocol="standard").context().has_demonstrations(0)


def test_no_other_protocol_is_asked_of_a_task() -> None:
    """Not even what would not do under it."""
    odd = PUSH.changed(latents=("force",))
    assert protocols.applied("standard", odd) is odd


def test_a_job_s_record_names_its_protocol(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And that of the standard protocol is as it was."""
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    job = BenchmarkJob("weak_thruster", tiny_preset(), "random", (0,), tmp_path, protocol="once")
    job.run()
    data = job.load(0)
    assert data is not None
    (made,) = records.of_job(data, "default", [], 1)
    assert made["protocol_name"] == "once"
    assert len(made["returns"]) == 1
    records.write(tmp_path / "records", [made])
    assert records.read(tmp_path / "records" / "weak_thruster.jsonl") == [json.loads(json.dumps(made))]
    assert "protocol_name" not in identity(replace(job, protocol="standard"))
    assert replace(job, protocol="standard").unfit(0, data) == "it differs in its protocol_name (was once, is none)"


@pytest.mark.usefixtures("no_pictures")
def test_a_report_is_of_the_run_s_protocol(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one episode where the run was, and not of as many as the task's trials have."""
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    (tmp_path / "jobs").mkdir()
    for method in ("random", "expert"):
        BenchmarkJob("weak_thruster", tiny_preset(), method, (0,), tmp_path / "jobs", protocol="once").run()
    about = {"reference": "weak_thruster", "kind": "BenchmarkJob", "preset": "default", "set": []}
    write_sealed(tmp_path / "settings.json", {**about, "protocol_name": "once"})
    monkeypatch.setattr("sys.argv", ["report", str(tmp_path)])
    report.main()
    results = json.loads((tmp_path / "results.json").read_text())
    assert (results["protocol_name"], results["episodes"]) == ("once", 1)


@pytest.fixture(scope="module")
def both() -> tuple[list[Any], list[Any]]:
    """Some records of a task under the standard protocol, and the same as if they were of another.

    These are of an expert whose records do not come with the package.
    """
    kept = records.of_task(RECORDS, "curling")
    kept = [record for record in kept if record["method"] in ("random", "expert", "dagger") and record["seed"] < 2]
    return kept, [{**record, "protocol_name": "once", "expert": "0" * 64} for record in kept]


class TestTables:
    def test_they_lie_side_by_side(self, both: tuple[list[Any], list[Any]], tmp_path: Path) -> None:
        """In a task's file, each with its own 0 and 1; what asks for no protocol gets the standard one, as it is."""
        standard, once = both
        salted = [{**record, "salt": "x"} for record in standard]
        records.write(tmp_path, [*standard, *once, *salted, *({**record, "set": ["x=1"]} for record in standard)])
        assert records.of_task(tmp_path, "curling") == standard
        assert records.of_task(tmp_path, "curling", protocol="once") == once
        assert not (tmp_path / "superseded").exists()
        with pytest.raises(envs.InputError, match="protocol_name standard and once do not belong in one table"):
            aggregation.gather([*standard, *once])
        assert aggregation.gather(once)["protocol_name"] == "once"
        less = [{**record, "returns": [value - 1 for value in record["returns"]]} for record in once]
        own = [value + 1 for value in aggregation.references(less[0], less)]
        assert own == pytest.approx(aggregation.references(once[0], once))

    @pytest.mark.parametrize(("protocol", "name"), [("standard", None), ("once", "once")])
    def test_compare_takes_those_of_one(
        self,
        protocol: str,
        name: str | None,
        both: tuple[list[Any], list[Any]],
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        """With --protocol, of a file that holds records of two."""

        def of_one(every: list[Any], _: list[str]) -> None:
            assert [record.get("protocol_name") for record in every] == [name] * len(both[0])
            raise InterruptedError

        monkeypatch.setattr(comparison, "gathered", of_one)
        records.write(tmp_path, [*both[0], *both[1]])
        monkeypatch.setattr("sys.argv", ["compare", str(tmp_path), "--protocol", protocol])
        with pytest.raises(InterruptedError):
            compare.main()

    def test_compare_with_itself(
        self, both: tuple[list[Any], list[Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        records.write(tmp_path / "mine", both[0])
        monkeypatch.setattr("sys.argv", ["compare", str(tmp_path / "mine"), "--against", "dagger"])
        with pytest.raises(envs.InputError, match="the records given are of dagger alone; give --against another"):
            compare.main()

    def test_compare_refuses_two(self, both: tuple[list[Any], list[Any]]) -> None:
        standard, once = both
        with pytest.raises(envs.InputError, match="records of protocols standard and once are not to be compared"):
            comparison.gathered([*standard, *once], [])
        assert set(comparison.gathered(once, [])) == {"dagger"}
        with pytest.raises(envs.InputError, match="--against naive_rnn: no record is of it"):
            comparison.gathered(once, ["naive_rnn"])

    def test_what_is_missing(self, both: tuple[list[Any], list[Any]]) -> None:
        """A deployment without record, or a record of another protocol or preset, is missing."""
        task = envs.get("curling")
        job = BenchmarkJob("curling", preset("default", task, "cpu", ["random"]), "random", (0, 1), Path())
        today = identity(job)
        fresh = [{**one, **{key: today[key] for key in today if key in one}} for one in both[0]]
        fresh = [one for one in fresh if one["method"] == "random"]
        assert table.missing(job, "default", fresh) == ()
        assert table.missing(replace(job, protocol="once"), "default", fresh) == (0, 1)
        assert table.missing(job, "default", [{**record, "preset": "paper"} for record in fresh]) == (0, 1)
        deployed = replace(METHODS["random"], deployments={"mode": lambda agent: agent})
        assert table.missing(replace(job, guest=deployed), "default", fresh) == (0, 1)

    def test_what_scarce_data_do_not_change_is_not_made_twice(self, both: tuple[list[Any], list[Any]]) -> None:
        """Records of the standard protocol are also those of a policy that learns from no data, and of no other."""

        def copied(method: str, protocol: str, kept_of: str = "standard", **change: Any) -> list[Any]:
            task = envs.get("curling")

            def job(under: str) -> BenchmarkJob:
                settings = protocols.amounts(under, preset("default", task, "cpu", [method]))
                return BenchmarkJob("curling", settings, method, (0, 1), Path(), protocol=under)

            today = identity(job(kept_of))
            of = {**both[0][0], **{key: today[key] for key in records.MADE_OF if key in today}, "method": method}
            return table.copied(job(protocol), "default", [{**of, "seed": seed, **change} for seed in (0, 1, 2)])

        assert [(one["seed"], one["protocol_name"]) for one in copied("random", "scarce")] == [
            (0, "scarce"),
            (1, "scarce"),
        ]
        assert copied("random", "once") == copied("random", "unseen") == []  # others in evaluation
        assert copied("oracle_bc", "scarce") == copied("rma", "scarce") == []  # learn from fewer trials
        assert copied("random", "scarce", method_version=-1) == []
        assert [one.get("protocol_name") for one in copied("random", "standard", "scarce")] == [None, None]
        assert copied("random", "standard", "once") == copied("oracle_bc", "standard", "scarce") == []


@pytest.mark.parametrize("protocol", ["scarce", "unseen", "once"])
def test_a_table_is_of_the_methods_that_are_compared(protocol: str, tmp_path: Path) -> None:
    """Five seeds of each, where there are no records yet."""
    listed = deconf(tmp_path, "table", "--protocol", protocol, "--tasks", "curling", "--set", "eval_trials=8", "--list")
    *lines, total = listed.stdout.splitlines()
    missing = dict(line.removeprefix("curling, ").split(": seeds ") for line in lines)
    assert {*missing} == {*protocols.COMPARED, "random", "expert"}
    assert {*missing.values()} == {"0 1 2 3 4"}
    assert total == f"{5 * len(missing)} seeds are missing or stale"


def test_quantiles() -> None:
    """Halves of the probability, uniform in each, without a gap."""
    u = (np.arange(1000) + 0.5) / 1000
    assert np.histogram(protocols.edges(u), 4, (0, 1))[0].tolist() == [500, 0, 0, 500]
    assert np.histogram(protocols.middle(u), 4, (0, 1))[0].tolist() == [0, 500, 500, 0]
    for quantiles in (protocols.edges(u), protocols.middle(u)):
        assert np.diff(np.sort(quantiles)).min() == pytest.approx(0.0005)
