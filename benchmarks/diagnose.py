"""Is your data confounded? `deconf diagnose --data logs.csv --trial vehicle --obs 'speed*' --action throttle`

It reads an expert's logs, and logs of exploration (--explore), without which the verdict is never "confounded". Each
trial is under a hidden condition of its own, theta, which the logs need not have; no simulator is needed. `deconf look
--help` says which data can be read; a look at them comes first. It takes minutes, and writes index.html, diagnosis.json
and the trials as .npz. If it was interrupted, the same command goes on.
"""

import json
import shlex
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deconfounded.benchmarks import commands, look
from deconfounded.benchmarks.console import Parser, place, whole
from deconfounded.envs.support.files import write_json

if TYPE_CHECKING:
    from deconfounded.deconf.diagnosis.measures import Amounts, Findings
    from deconfounded.deconf.diagnosis.verdict import Diagnosis


@dataclass(frozen=True)
class Refit:
    """One split of the data, measured in a worker process, and kept in a file."""

    trials: Path
    explore: Path | None
    amounts: "Amounts"
    index: int
    seed: int
    refits: int
    folder: Path

    method = "refit"
    ticks = 1000

    @property
    def seeds(self) -> tuple[int, ...]:
        return (self.index,)

    @property
    def file(self) -> Path:
        return self.folder / "jobs" / f"refit-{self.index}.json"

    def findings(self) -> "Findings | None":
        """What was measured; None if nothing was, or the file is damaged."""
        from deconfounded.deconf.diagnosis.measures import Findings

        try:
            return Findings(**json.loads(self.file.read_bytes()))
        except (OSError, ValueError, TypeError):
            return None

    def run(self) -> str:
        """Measure, and keep it; returns a line that says how it went."""
        import numpy as np

        from deconfounded.benchmarks.engine import progress
        from deconfounded.deconf.diagnosis.judgement import check_finite
        from deconfounded.deconf.diagnosis.measures import measure
        from deconfounded.experts.trials import Trials

        start, ticked = time.time(), 0

        def tell(share: float) -> None:
            nonlocal ticked
            progress.tick(int(share * self.ticks) - ticked)
            ticked = int(share * self.ticks)

        rng = np.random.default_rng(self.seed).spawn(self.refits)[self.index]
        explore = None if self.explore is None else Trials.load(self.explore)
        findings = measure(Trials.load(self.trials), explore, self.amounts, rng, tell)
        check_finite(findings)
        write_json(self.file, findings._asdict())
        return f"measured in {time.time() - start:.0f} s"


def run(
    data: list[Path], exploration: list[Path] | None, columns: dict[str, Any], seed: int, folder: Path, command: str
) -> "tuple[Diagnosis, str]":
    """Diagnose, and write the page and the json; returns what to print too. An interrupted diagnosis goes on.

    columns: arguments of `datasets.read`. Raises InputError for data that cannot be judged, and for a folder that holds
    another diagnosis.
    """
    trials, explore = look.read(data, exploration, columns)
    from deconfounded.benchmarks.engine import identity
    from deconfounded.benchmarks.engine.job_files import prepare
    from deconfounded.benchmarks.engine.scheduler import run_jobs
    from deconfounded.benchmarks.output import diagnosis as page
    from deconfounded.deconf.diagnosis.diagnose import VERSION, DiagnoseConfig, check, conclude

    config, start = DiagnoseConfig(), time.time()
    remarks = look.look(trials, explore)
    print(*remarks, sep="\n", flush=True)
    check(trials, explore, config)
    about: dict[str, Any] = {
        "trials": {"from": paths(data), "sha256": trials.sha256, "shape": trials.mask.shape},
        "explore": explore and {"from": paths(exploration), "sha256": explore.sha256, "shape": explore.mask.shape},
        "config": asdict(config),
        "seed": seed,
        "versions": identity.versions(),
        "version": VERSION,
    }
    files = folder / "trials.npz", None if explore is None else folder / "explored.npz"
    refits = [Refit(*files, config.amounts, i, seed, config.refits, folder) for i in range(config.refits)]
    with commands.locked(folder), commands.local() as engine:
        prepare(folder, about, resume=True)
        for log, file in zip((trials, explore), files, strict=True):
            if log is not None and file is not None:
                log.save(file)
        if failed := run_jobs([refit for refit in refits if refit.findings() is None], "diagnosis", engine.run):
            raise failed[0]
    found = [findings for refit in refits if (findings := refit.findings()) is not None]
    diagnosis = conclude(found, trials, explore)
    about |= {"columns": columns, "units": asdict(trials.units), "look": [remark._asdict() for remark in remarks]}
    about |= {"command": command, "machine": identity.machine("cpu"), "wall_s": round(time.time() - start)}
    return diagnosis, page.write(diagnosis, about, folder)


def paths(given: list[Path] | None) -> str | list[str]:
    """Names of files; of one alone, its name."""
    names = [str(path) for path in given or ()]
    return names[0] if len(names) == 1 else names


def main() -> None:
    parser = Parser(__doc__)
    look.add_data(parser)
    parser.add_argument("--seed", type=whole(0), default=0, help="of the splits and of training")
    parser.add_argument(
        "--out", type=place, default=Path("results") / "diagnosis", help="output folder; default: results/diagnosis"
    )
    args = parser.parse_args()
    asked = shlex.join(["deconf", "diagnose", *sys.argv[1:]])
    print(run(args.data, args.explore, look.columns(args), args.seed, args.out, asked)[1])
