"""Is a diagnosis right, where the truth is known? `deconf validate`

It diagnoses expert trials, with exploration, of every task of the suite, of three that are not confounded
(unconfounded.py), and of two under more and less process noise (noise.py), which were not looked at when the
thresholds were set. Each row of docs/diagnose/validation.json has the verdict, the task's certificate, and the scores
that were measured; a case that is diagnosed again takes its row's place. Interrupted, it goes on where it was.
"""

from __future__ import annotations

if __name__ == "__main__":  # Ctrl-C while the rest is imported is one line too
    from deconfounded.benchmarks.console import stop_at_once

    stop_at_once()

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks.console import Parser, place, run_command
from deconfounded.benchmarks.engine.catalogue import check_names
from deconfounded.benchmarks.studies import noise, runs, unconfounded, validation
from deconfounded.benchmarks.studies.cards import DOCS
from deconfounded.benchmarks.studies.spectrum import variants
from deconfounded.envs.support.files import write_json
from deconfounded.envs.task import ASSETS

if TYPE_CHECKING:
    from deconfounded.deconf.diagnosis.diagnose import Diagnosis

CASES: dict[str, str | None] = {
    **dict.fromkeys(envs.SUITE),
    **unconfounded.EXPERTS,
    **{
        case: str(ASSETS / "experts" / f"{base}.safetensors")
        for base, kind, factor, case in (one for base in noise.BASES for one in variants(base))
        if kind == "process" and factor != 1
    },
}
"""Each task, and its expert if that is not its own."""

TRIALS, SEED = {"bandit": 2000}, 11  # trials: 256 of all others
LEARNED = ("naive_rnn", "deconfounded")


def right(task: envs.Task, certified: bool, diagnosis: Diagnosis) -> bool:
    """Whether a diagnosis says what is so; of a certified task, that Tier 2 cures it.

    That of a task without latent may be that trials are alike: those of one theta look no other.
    """
    from deconfounded.deconf.diagnosis.diagnose import VARY_LATENT

    if task.tier in (None, 3) and not certified and task.name in envs.SUITE:
        return bool(diagnosis.verdict == "confounded" and diagnosis.tier == 3)
    alike = task.name == "nothing_hidden" and diagnosis.next is VARY_LATENT
    expected = ("confounded", 2) if certified else ("not confounded", 1)
    return bool(alike or (diagnosis.verdict, diagnosis.tier) == expected)


def predicted(diagnosis: Diagnosis) -> float:
    """The gap that Tier 2 could close, in scores; 0 where nothing is confounded, or alike, or queries are needed."""
    from deconfounded.deconf.diagnosis.diagnose import VARY_LATENT

    nothing = diagnosis.verdict == "not confounded" or diagnosis.tier == 3 or diagnosis.next is VARY_LATENT
    return 0.0 if nothing else diagnosis.figures["gap"].value


def data(task: envs.Task, source: str | None, folder: Path) -> tuple[Path, Path]:
    """Files of expert trials, and of exploration: half at random, half by a clone without memory that tries things."""
    from deconfounded.benchmarks.engine import identity
    from deconfounded.benchmarks.engine.catalogue import METHODS
    from deconfounded.benchmarks.engine.context import Context
    from deconfounded.benchmarks.engine.presets import preset
    from deconfounded.deconf.diagnosis import exploration
    from deconfounded.experts.rollout import Trials, joined

    count = TRIALS.get(task.name, 256)
    settings = replace(preset("default", task, "cpu"), expert_trials=count, explore_trials=count // 4)
    context = Context(task, settings, (SEED,), folder=folder, expert=source)
    shown, file = context.demonstrations, folder / "explored.npz"
    made_of = f"{shown.sha256} {settings.explore_trials} {identity.PROTOCOL}"
    try:
        Trials.load(file, made_of)
    except envs.InputError:
        rngs = context.rngs  # once: each exploration draws thetas of its own
        policy = exploration.fit(shown, METHODS["blind_bc"].config(settings.configs["blind_bc"]), rngs)
        joined([context.explore(agent, rngs) for agent in (None, policy)]).save(file, made_of)
    return folder / f"demonstrations-{SEED}.npz", file


def point(task: envs.Task) -> dict[str, Any] | None:
    """What `spectrum.py` found of a task of noise.py; None of others."""
    points = json.loads((DOCS / "spectrum.json").read_bytes())["points"]
    titles = (noise.title(one["task"], one["kind"], one["factor"]) for one in points)
    return dict(zip(titles, points, strict=True)).get(type(task).__name__)


def measured(task: envs.Task, source: str | None, folder: Path) -> dict[str, float]:
    """Scores of the last episode: of the records in docs/, of docs/spectrum.json, or of a run made here."""
    from deconfounded.benchmarks.engine.catalogue import REFERENCES
    from deconfounded.benchmarks.engine.presets import preset
    from deconfounded.benchmarks.output import records

    if of := point(task):
        return {name: float(np.mean(of["scores"][name])) for name in LEARNED}
    kept = records.of_task(DOCS / "records", task.name)
    if not kept:
        settings, methods = preset("default", task, "cpu"), (*REFERENCES, *LEARNED)
        kept = runs.run(task, settings, methods, range(3), folder, expert=source)
    found = records.gather(kept)["methods"]
    return {name: float(found[name]["score_last"]) for name in LEARNED if name in found}


def certificate(task: envs.Task, source: str | None, folder: Path) -> bool:
    """Whether it is passed: docs/ says so of the suite and of its variants; of others it is made here."""
    if task.name in envs.SUITE:
        file = DOCS / "certificates" / f"{task.name}.json"
        return file.is_file() and json.loads(file.read_bytes())["verdict"] == "passed"
    if of := point(task):
        return bool(of["certificate"]["verdict"] == "passed")
    return bool(runs.certificate(task, source, folder)["verdict"] == "passed")


def main() -> None:
    """The command line."""
    parser = Parser(__doc__)
    parser.add_argument("--tasks", nargs="+", metavar="NAME", help="some of the cases; default: all")
    parser.add_argument("--out", type=place, default=Path("results") / "validation", help="output folder")
    args = parser.parse_args()
    known = {case.rpartition(":")[2]: case for case in CASES}
    check_names("task", args.tasks or (), list(known))
    from deconfounded.benchmarks.diagnose import run
    from deconfounded.benchmarks.engine import identity

    kept = DOCS / "diagnose" / "validation.json"
    about = {"commit": identity.commit(), "machine": identity.machine("cpu"), "versions": identity.versions()}
    for name in args.tasks or known:
        task, source = envs.get(known[name]), CASES[known[name]]
        folder = args.out / task.name
        folder.mkdir(parents=True, exist_ok=True)
        diagnosis, _ = run(*data(task, source, folder), 0, folder / "diagnosis", f"deconf validate --tasks {name}")
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
            "found": {key: figure._asdict() for key, figure in diagnosis.figures.items()},
            **about,
        }
        rows = {one["case"]: one for one in validation.rows(kept)} | {name: row}
        write_json(kept, [rows[case] for case in known if case in rows])
        print(f"{task.name}: {diagnosis.verdict}, {'right' if row['right'] else 'WRONG'}")
    validation.picture(validation.rows(kept), kept.with_suffix(".png"))
    print(f"{validation.told(validation.rows(kept))} -> {kept.parent}")


if __name__ == "__main__":
    run_command(main, "what was finished is kept, and the same command goes on")
