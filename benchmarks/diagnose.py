"""Is your data confounded? `deconf diagnose --trials expert.npz`

It reads trials of an expert, and of exploration if you have some; it needs no theta and no simulator. Each file is an
.npz as `Trials.save` writes it, or a Minari data set's folder; each trial is under a hidden theta of its own. It writes
index.html and diagnosis.json. If it was interrupted, the same command goes on.
"""

import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deconfounded import envs
from deconfounded.benchmarks import commands
from deconfounded.benchmarks.console import Parser, place, whole
from deconfounded.envs.support.files import write_json

if TYPE_CHECKING:
    from deconfounded.deconf.diagnosis.diagnose import Diagnosis
    from deconfounded.deconf.diagnosis.measures import Amounts, Findings
    from deconfounded.experts.rollout import Trials


def trials_of(source: Path) -> "Trials":
    """What a file or a data set's folder holds. Raises InputError if that is no trials."""
    from deconfounded.experts.rollout import Trials

    if not source.exists():
        raise envs.InputError(f"there is no {source}; give a Minari data set's folder, or an .npz of Trials.save")
    return Trials.from_minari(source) if source.is_dir() else Trials.load(source)


@dataclass(frozen=True)
class Refit:
    """One split of the data, measured in a worker process, and kept in a file."""

    trials: Path
    explore: Path | None
    amounts: "Amounts"
    index: int
    seed: int
    refits: int
    made_of: str
    folder: Path

    method = "refit"
    ticks = 1000

    @property
    def seeds(self) -> tuple[int, ...]:
        return (self.index,)

    @property
    def file(self) -> Path:
        return self.folder / f"refit-{self.index}.json"

    def findings(self) -> "Findings | None":
        """What was measured, if it was of the same."""
        from deconfounded.deconf.diagnosis.measures import Findings

        try:
            kept = json.loads(self.file.read_bytes())
            return Findings(**kept["figures"]) if kept["made_of"] == self.made_of else None
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def run(self) -> str:
        """Measure, and keep it; returns a line that says how it went."""
        import numpy as np

        from deconfounded.benchmarks.engine import progress
        from deconfounded.deconf.diagnosis.measures import measure

        start, ticked = time.time(), 0

        def tell(share: float) -> None:
            nonlocal ticked
            progress.tick(int(share * self.ticks) - ticked)
            ticked = int(share * self.ticks)

        rng = np.random.default_rng(self.seed).spawn(self.refits)[self.index]
        explore = None if self.explore is None else trials_of(self.explore)
        findings = measure(trials_of(self.trials), explore, self.amounts, rng, tell)
        write_json(self.file, {"made_of": self.made_of, "figures": findings._asdict()})
        return f"measured in {time.time() - start:.0f} s"


def run(source: Path, exploration: Path | None, seed: int, folder: Path, command: str) -> "tuple[Diagnosis, str]":
    """Diagnose, and write the page and the json; returns what to print too. What the folder has of the same, stays.

    Raises InputError for data that cannot be judged.
    """
    trials = trials_of(source)
    explore = None if exploration is None else trials_of(exploration)
    from deconfounded.benchmarks.engine import identity
    from deconfounded.benchmarks.engine.local import Local
    from deconfounded.benchmarks.engine.scheduler import run_jobs
    from deconfounded.benchmarks.output import diagnosis as page
    from deconfounded.deconf.diagnosis.diagnose import VERSION, DiagnoseConfig, check, judge

    config, start = DiagnoseConfig(), time.time()
    check(trials, explore, config)
    about: dict[str, Any] = {
        "trials": {"from": str(source), "sha256": trials.sha256, "shape": trials.mask.shape},
        "explore": explore and {"from": str(exploration), "sha256": explore.sha256, "shape": explore.mask.shape},
        "config": asdict(config),
        "seed": seed,
        "versions": identity.versions(),
        "version": VERSION,
    }
    shared = (seed, config.refits, json.dumps(about), folder)
    refits = [Refit(source, exploration, config.amounts, i, *shared) for i in range(config.refits)]
    with commands.locked(folder), Local() as engine:
        run_jobs([refit for refit in refits if refit.findings() is None], "diagnosis", engine.run)
    diagnosis = judge([findings for refit in refits if (findings := refit.findings()) is not None])
    about |= {"command": command, "machine": identity.machine("cpu"), "wall_s": round(time.time() - start)}
    return diagnosis, page.write(diagnosis, about, folder)


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("--trials", type=place, required=True, metavar="FILE", help="trials of the expert")
    parser.add_argument(
        "--explore",
        type=place,
        metavar="FILE",
        help="trials of theta-blind exploration",
    )
    parser.add_argument("--seed", type=whole(0), default=0, help="of the splits and of training")
    parser.add_argument("--out", type=place, default=Path("results") / "diagnosis", help="output folder")
    args = parser.parse_args()
    asked = " ".join(["deconf diagnose", *sys.argv[1:]])
    print(run(args.trials, args.explore, args.seed, args.out, asked)[1])
