"""Is a diagnosis right on simulators of others? `deconf foreign`

In each world (cases.py) agents are trained and their returns measured, and its logs are diagnosed. docs/diagnose/
foreign.json has a row each. It needs `pip install .[foreign]`; interrupted, it goes on where it was.
"""

import json
from collections.abc import Callable
from functools import cached_property
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from deconfounded.benchmarks.console import Parser, place
from deconfounded.benchmarks.engine import identity
from deconfounded.benchmarks.engine.catalogue import METHODS, check_names
from deconfounded.benchmarks.studies.cards import DOCS, changed
from deconfounded.benchmarks.studies.foreign.cases import CASES, EXPLORED, SEED, TRIALS, Case
from deconfounded.benchmarks.studies.foreign.report import KEPT
from deconfounded.benchmarks.studies.foreign.world import (
    LinearFilter,
    WorldExpert,
    demonstrations,
    explorer,
    roll_out,
    task,
    thetas,
)
from deconfounded.envs.streams import Array
from deconfounded.envs.support.files import write_json
from deconfounded.experts.agent import Agent, RandomAgent
from deconfounded.experts.rollout import Rollout

SIMULATORS = ("gym-electric-motor", "highway-env", "do-mpc", "casadi")  # others are ours too
SCORED, SCORING = 96, 10**6  # trials, and their seed; trial i has seed + i, and the logs begin at 11


class Bench:
    """What a world's agents are made of, made when first asked for, and the returns of those that were scored."""

    def __init__(self, case: Case, folder: Path) -> None:
        self.case, self.file = case, folder / f"measured-{SCORING}.json"
        made = json.loads(self.file.read_bytes()) if self.file.is_file() else {"returns": {}, "method_versions": {}}
        self.made: dict[str, dict[str, Any]] = made

    @cached_property
    def theta(self) -> Array:
        """Theta [N, L] of the trials in which agents are scored."""
        return thetas(self.case.world, SCORED, SCORING)

    @cached_property
    def demonstrated(self) -> Rollout:
        """The expert's trials."""
        return demonstrations(self.case.world, TRIALS, SEED)

    def encoded(self, theta: Array) -> Array:
        """Of about unit scale."""
        rest = self.demonstrated.theta
        return (theta - rest.mean((0, 1))) / np.maximum(rest.std((0, 1)), 1e-9)

    def measure(self, name: str) -> str:
        """Measure the mean return of each episode of an agent, and keep it; returns the last one, to print."""
        returns, versions = self.made["returns"], self.made["method_versions"]
        if name not in returns or (name in METHODS and versions.get(name) != METHODS[name].version):
            agent = (AGENTS | LATER)[name](self)
            if agent is None:
                return "none"
            returns[name] = roll_out(self.case.world, agent, self.theta, SCORING).returns.mean(0).tolist()
            if name in METHODS:
                versions[name] = METHODS[name].version
            write_json(self.file, self.made)
            if {"random", "expert", "wrong theta"} <= returns.keys():
                write(self.case, scores=scores(returns), **self.made)
        return f"{returns[name][-1]:.4g}"


def _naive_rnn(bench: Bench) -> Agent:
    from deconfounded.deconf.methods import naive_rnn  # torch takes seconds
    from deconfounded.deconf.methods.sequence_bc import RecurrentConfig

    return naive_rnn.train(bench.demonstrated.trials, RecurrentConfig(), rng())


def _blind(bench: Bench) -> Agent:
    from deconfounded.deconf.methods import memoryless_bc

    return memoryless_bc.train(bench.demonstrated.trials, memoryless_bc.MemorylessConfig(), rng())


def _oracle(bench: Bench) -> Agent:
    from deconfounded.deconf.methods import memoryless_bc

    trials, theta = bench.demonstrated.trials, bench.encoded(bench.demonstrated.theta)
    return memoryless_bc.train(
        trials, memoryless_bc.MemorylessConfig(), rng(), theta, lambda: bench.encoded(bench.theta)
    )


def rng() -> np.random.Generator:
    """Of initial weights and batches."""
    return np.random.default_rng(SEED)


def _deconfounded(bench: Bench) -> Agent:
    from deconfounded.deconf.methods import deconfounded

    explore = explorer(bench.case.world, EXPLORED, np.random.default_rng(SEED + 1))
    return deconfounded.train(bench.demonstrated.trials, explore, deconfounded.DeconfoundedConfig(), rng())


AGENTS: dict[str, Callable[[Bench], Agent | None]] = {
    "random": lambda bench: RandomAgent(task(bench.case.world).action_space),
    "expert": lambda bench: WorldExpert(bench.case.world, bench.theta),
    "wrong theta": lambda bench: WorldExpert(bench.case.world, np.roll(bench.theta, 1, 0)),
    "filter": lambda bench: LinearFilter(bench.case.world, TRIALS, SEED) if bench.case.world.evidence else None,
    "naive_rnn": _naive_rnn,
}
LATER: dict[str, Callable[[Bench], Agent | None]] = {
    "blind_bc": _blind,
    "oracle_bc": _oracle,
    "deconfounded": _deconfounded,
}
"""By name, how each agent is made."""


def scores(returns: dict[str, list[float]]) -> dict[str, float]:
    """Of the last episode, 1 of the expert. 0 is the expert given a wrong theta; where that costs nothing, random."""
    last = {name: values[-1] for name, values in returns.items()}
    whole = last["expert"] - last["random"]
    zero = "wrong theta" if last["expert"] - last["wrong theta"] > 0.05 * whole else "random"
    return {name: (value - last[zero]) / (last["expert"] - last[zero]) for name, value in last.items()}


def diagnosed(case: Case, folder: Path) -> str:
    """Diagnose the world's logs, and keep the verdict, and whether it is right (None: it cannot tell)."""
    from deconfounded.benchmarks.diagnose import run
    from deconfounded.benchmarks.studies.validate import predicted
    from deconfounded.deconf.diagnosis.advice import VARY_LATENT
    from deconfounded.deconf.diagnosis.diagnose import VERSION

    demonstrated, explored = case.logs(folder)
    command = f"deconf foreign --cases {case.name}"
    diagnosis, _ = run([demonstrated], [explored], {}, 0, folder / "diagnosis", command)
    harmless = diagnosis.next is VARY_LATENT or diagnosis.verdict == "nothing at stake"
    right = (case.tier == 1 and harmless) or (diagnosis.verdict, diagnosis.tier) == case.truth
    write(
        case,
        diagnosis=VERSION,
        splits=diagnosis.refits,
        agreeing=diagnosis.agreeing,
        verdict=diagnosis.verdict,
        diagnosed_tier=diagnosis.tier,
        right=None if diagnosis.verdict == "cannot tell" and not right else right,
        predicted=predicted(diagnosis),
        figures={key: figure._asdict() for key, figure in diagnosis.figures.items()},
    )
    return f"{diagnosis.verdict}, tier {diagnosis.tier}: {'right' if right else 'not right'}"


def write(case: Case, **measured: Any) -> None:
    """Put what was measured in the case's row."""
    versions = identity.versions() | {name: metadata.version(name) for name in SIMULATORS}
    about = {"commit": identity.commit(), "machine": identity.machine("cpu"), "versions": versions}
    row = {"case": case.name, "world": case.reference, "tier": case.tier, "unseen": case.unseen}

    def more(before: list[dict[str, Any]] | None) -> list[dict[str, Any]]:
        rows = {held["case"]: held for held in before or ()}
        rows[case.name] = rows.get(case.name, {}) | row | measured | about
        return [rows[each.name] for each in CASES if each.name in rows]

    changed(DOCS / f"{KEPT}.json", more)


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("--cases", nargs="+", metavar="NAME", help="some of the cases; default: all")
    parser.add_argument("--out", type=place, default=Path("results") / "foreign", help="output folder")
    args = parser.parse_args()
    check_names("case", args.cases or (), [case.name for case in CASES])
    cases = [case for case in CASES if case.name in (args.cases or [case.name])]
    benches = {case: Bench(case, args.out / case.name) for case in cases}
    for name in (*AGENTS, "diagnosis", *LATER):
        for case, bench in benches.items():
            folder = args.out / case.name
            folder.mkdir(parents=True, exist_ok=True)
            said = diagnosed(case, folder) if name == "diagnosis" else bench.measure(name)
            print(f"{case.name}: {name} {said}", flush=True)
