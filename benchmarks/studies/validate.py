"""Is a diagnosis right, where the truth is known? `deconf validate`

It diagnoses expert trials, with exploration, of every task of the suite, of three that are not confounded
(unconfounded.py), and of two under more and less process noise (noise.py), which were not looked at when the
thresholds were set. Each row of docs/diagnose/validation.json has the verdict, the task's certificate, and the scores
that were measured; a case that is diagnosed again takes its row's place. Interrupted, it goes on where it was.
"""

from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from deconfounded import envs
from deconfounded.benchmarks.console import Parser, place
from deconfounded.benchmarks.engine.catalogue import check_names
from deconfounded.benchmarks.output.scoring import two_decimals
from deconfounded.benchmarks.studies import gap, noise, runs, spectrum, unconfounded
from deconfounded.benchmarks.studies.cards import DOCS, certificate_of, changed, kept, markdown_table
from deconfounded.deconf.diagnosis.advice import VARY_LATENT
from deconfounded.deconf.diagnosis.verdict import Diagnosis, with_tier
from deconfounded.envs.task import ASSETS

CASES: dict[str, str | None] = {
    **dict.fromkeys(envs.SUITE),
    **unconfounded.EXPERTS,
    **{
        case: str(ASSETS / "experts" / f"{base}.safetensors")
        for base, kind, factor, case in chain(*map(spectrum.variants, noise.BASES))
        if kind == "process" and factor != 1
    },
}
"""Each task, and its expert if that is not its own."""

TRIALS, SEED = {"bandit": 2000}, 11  # trials: 256 of all others
LEARNED = ("naive_rnn", "deconfounded")
KEPT = "diagnose/validation"
FIGURES = (  # of the table
    *("memory_gain", "latent_gain", "exploration_evidence", "expert_evidence", "ratio"),
    *("dynamics_differ", "stakes", "paired_stakes", "model_deviation", "model_length"),
)


def right(task: envs.Task, certified: bool, diagnosis: Diagnosis) -> bool:
    """Whether a diagnosis says what is so; of a certified task, that Tier 2 cures it.

    That of a task without latent may be that trials are alike: those of one theta look no other.
    """
    truth = ("confounded", 2) if certified else ("not confounded", 1)
    if task.tier in (None, 3) and not certified and task.name in envs.SUITE:
        truth = ("confounded", 3)
    alike = task.name == "nothing_hidden" and diagnosis.next is VARY_LATENT
    verdict = "not confounded" if diagnosis.verdict == "nothing at stake" else diagnosis.verdict
    return alike or (verdict, diagnosis.tier) == truth


def predicted(diagnosis: Diagnosis) -> float:
    """The gap that Tier 2 could close, in scores; 0 where nothing is confounded, or alike, or queries are needed."""
    nothing = (
        diagnosis.verdict in ("not confounded", "nothing at stake")
        or diagnosis.tier == 3
        or diagnosis.next is VARY_LATENT
    )
    return 0.0 if nothing else diagnosis.figures["gap"].value


def data(task: envs.Task, source: str | None, folder: Path) -> tuple[Path, Path]:
    """Files of expert trials, and of exploration: half at random, half by a clone without memory that tries things."""
    from deconfounded.benchmarks.engine import identity
    from deconfounded.benchmarks.engine.catalogue import METHODS
    from deconfounded.benchmarks.engine.context import Context, demonstrations_file
    from deconfounded.benchmarks.engine.presets import preset
    from deconfounded.deconf.diagnosis import exploration
    from deconfounded.experts.trials import Trials, joined

    count = TRIALS.get(task.name, 256)
    settings = replace(preset("default", task, "cpu"), expert_trials=count, explore_trials=count // 4)
    context = Context(task, settings, (SEED,), folder=folder, expert=source)
    demonstrations, file = context.demonstrations, folder / "explored.npz"
    made_of = f"{demonstrations.sha256} {settings.explore_trials} {identity.PROTOCOL}"
    try:
        Trials.load(file, made_of)
    except envs.InputError:
        rngs = context.rngs  # once: each exploration draws thetas of its own
        explorer = exploration.fit(demonstrations, METHODS["blind_bc"].config(settings.configs["blind_bc"]), rngs)
        joined([context.explore(agent, rngs) for agent in (None, explorer)]).save(file, made_of)
    return demonstrations_file(folder, SEED), file


def point(task: envs.Task) -> dict[str, Any] | None:
    """What `spectrum.py` found of a task of noise.py; None of others."""
    points = kept("spectrum")["points"]
    titles = (noise.title(*(point[key] for key in ("task", "kind", "factor"))) for point in points)
    return dict(zip(titles, points, strict=True)).get(type(task).__name__)


def measured(task: envs.Task, source: str | None, folder: Path) -> dict[str, float]:
    """Scores of the last episode: of the records in docs/, of docs/spectrum.json, or of a run made here."""
    from deconfounded.benchmarks.engine.catalogue import REFERENCES
    from deconfounded.benchmarks.engine.presets import preset
    from deconfounded.benchmarks.output import aggregation, records

    if of := point(task):
        return {name: float(np.mean(of["scores"][name])) for name in LEARNED}
    made = records.of_task(DOCS / "records", task.name) or runs.run(
        task, preset("default", task, "cpu"), (*REFERENCES, *LEARNED), range(3), folder / "run", expert=source
    )
    methods = aggregation.gather(made)["methods"]
    return {name: float(methods[name]["score_last"]) for name in LEARNED}


def certificate(task: envs.Task, source: str | None, folder: Path) -> bool:
    """Whether it is passed: docs/ says so of the suite and of its variants; of others it is made here."""
    if task.name in envs.SUITE:
        made = kept(certificate_of(task.name))
    elif of := point(task):
        made = of["certificate"]
    else:
        made = runs.certificate(task, source, folder)
    return made is not None and bool(made["verdict"] == "passed")


def unseen(row: dict[str, Any]) -> bool:
    """Whether the thresholds were set without looking at it."""
    return hasattr(noise, row["case"])


def summary(rows: list[dict[str, Any]]) -> str:
    """How many are right, and Spearman's correlation of the predicted and the measured gap."""
    sentences = []
    for what, later in (("by which thresholds were set", False), ("added later", True)):
        of = [row for row in rows if unseen(row) is later]
        if len(of) > 2:
            share = f"{sum(row['right'] for row in of)} of {len(of)} verdicts are right"
            gaps = [(row["predicted"], row["measured"], row["right"] or row["verdict"] != "cannot tell") for row in of]
            sentences.append(f"Of cases {what}, {share}{rank_correlation(gaps)}.")
    return " ".join(sentences)


def rank_correlation(gaps: list[tuple[float, float, bool]]) -> str:
    """Spearman's, of predicted and measured gaps, where the diagnosis predicts one (the flag), and of all; in words."""
    sure = [(predicted, measured) for predicted, measured, predicts in gaps if predicts]
    every = [pair[:2] for pair in gaps]
    groups = [sure] if len(sure) == len(every) else [sure, every]
    ranks = [two_decimals(stats.spearmanr(*zip(*of, strict=True)).statistic) for of in groups if len(of) > 2]
    said = f"; the rank correlation of predicted and measured gaps is {' ('.join(ranks)}" * bool(ranks)
    return said + " with those of which it cannot tell, and predicts none)" * (len(ranks) == 2)


def table(rows: list[dict[str, Any]]) -> str:
    """A row a case."""
    lines = []
    for row in rows:
        verdict = with_tier(row["verdict"], row["tier"])
        figures = (row["figures"][key]["value"] if key in row["figures"] else None for key in FIGURES)
        cells = ("" if value is None else two_decimals(value) for value in (*figures, row["predicted"]))
        certified, judged = "passed" if row["certified"] else "failed", "" if row["right"] else "wrong"
        lines.append((row["task"], certified, verdict, judged, *cells, two_decimals(row["measured"])))
    return markdown_table(("task", "certificate", "diagnosis", "", *FIGURES, "predicted gap", "measured"), lines)


def picture(rows: list[dict[str, Any]], file: Path, mark: str = "") -> None:
    """A dot a case: red where the certificate is passed, hollow where the thresholds were set without it."""
    points = []
    for row in rows:
        name = row["task"].replace("_process_", " x").replace("x0_", "x.").replace("0_", ".")
        style = "tab:red" if row["certified"] else "tab:green", "none" if unseen(row) else "full"
        points.append((name, row["predicted"], row["measured"], *style))
    gap.picture(points, file, "the diagnosis", mark)


def keep(row: dict[str, Any], order: list[str]) -> None:
    """Among the rows in docs/, in place of the one of the same case."""

    def more(before: list[dict[str, Any]] | None) -> list[dict[str, Any]]:
        rows = {held["case"]: held for held in (*(before or ()), row)}
        return [rows[case] for case in order if case in rows]

    changed(DOCS / f"{KEPT}.json", more)


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("--tasks", nargs="+", metavar="NAME", help="some of the cases; default: all")
    parser.add_argument("--out", type=place, default=Path("results") / "validation", help="output folder")
    args = parser.parse_args()
    cases = {case.rpartition(":")[2]: case for case in CASES}
    check_names("task", args.tasks or (), list(cases))
    from deconfounded.benchmarks.diagnose import run
    from deconfounded.benchmarks.engine import identity
    from deconfounded.deconf.diagnosis.diagnose import VERSION

    about = {
        "diagnosis": VERSION,
        "commit": identity.commit(),
        "machine": identity.machine("cpu"),
        "versions": identity.versions(),
    }
    for name in args.tasks or cases:
        task, source = envs.get(cases[name]), CASES[cases[name]]
        folder = args.out / task.name
        folder.mkdir(parents=True, exist_ok=True)
        expert, explored = data(task, source, folder)
        diagnosis, _ = run([expert], [explored], {}, 0, folder / "diagnosis", f"deconf validate --tasks {name}")
        certified, scores = certificate(task, source, folder), measured(task, source, folder)
        row = {
            "case": name,
            "task": task.name,
            "certified": certified,
            "verdict": diagnosis.verdict,
            "tier": diagnosis.tier,
            "right": right(task, certified, diagnosis),
            "predicted": predicted(diagnosis),
            "measured": scores["deconfounded"] - scores["naive_rnn"],
            "figures": {key: figure._asdict() for key, figure in diagnosis.figures.items()},
            **about,
        }
        keep(row, list(cases))
        print(f"{task.name}: {diagnosis.verdict}, {'right' if row['right'] else 'WRONG'}")
    picture(kept(KEPT), DOCS / f"{KEPT}.png")
    print(f"{summary(kept(KEPT))} -> {DOCS / KEPT}.png")
