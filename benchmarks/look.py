"""A look at logs, before any diagnosis: `deconf look --data logs.csv --trial vehicle --obs 'speed*' --action throttle`

What is in them, in plain words, and, marked with !, what would mislead a diagnosis. Data are csv, parquet, HDF5 (of
robomimic or D4RL) and npz (of Trials.save) files, and folders of LeRobot and Minari data sets; several files of the
same columns are read as one. It takes seconds.
"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deconfounded.benchmarks.console import Parser, place

if TYPE_CHECKING:
    from deconfounded.deconf.diagnosis.look import Remark
    from deconfounded.experts.datasets import Log

COLUMNS = ("trial", "episode", "obs", "action")


def add_data(parser: argparse.ArgumentParser) -> None:
    """Arguments that say what to read."""
    parser.add_argument("--data", type=place, nargs="+", required=True, metavar="PATH", help="logs of the expert")
    blind = "logs of exploration, which does not know what the expert knows; same columns"
    parser.add_argument("--explore", type=place, nargs="+", metavar="PATH", help=blind)
    parser.add_argument("--trial", metavar="COLUMN", help="says which trial a row is of; else each episode is a trial")
    parser.add_argument("--episode", metavar="COLUMN", help="says which episode of the trial a row is of")
    parser.add_argument("--obs", nargs="+", metavar="COLUMN", default=[], help="observations; 'speed*' is a pattern")
    parser.add_argument("--action", nargs="+", metavar="COLUMN", default=[], help="actions")


def columns(args: argparse.Namespace) -> dict[str, Any]:
    """Columns that were given, as arguments of `datasets.read`."""
    return {name: getattr(args, name) for name in COLUMNS if getattr(args, name) not in (None, [])}


def read(data: list[Path], explore: list[Path] | None, chosen: dict[str, Any]) -> "tuple[Log, Log | None]":
    """Logs of the expert, and of exploration if there are any. Raises InputError for what cannot be read."""
    from deconfounded.envs.support.errors import InputError
    from deconfounded.experts import datasets

    logs = datasets.read_together([data] if explore is None else [data, explore], **chosen)
    if explore is not None and logs[0].sha256 == logs[1].sha256:
        raise InputError(
            "--data and --explore hold the same trials; --explore is for trials of a policy that does not see theta"
        )
    return logs[0], logs[1] if len(logs) > 1 else None


def look(trials: "Log", explore: "Log | None") -> "list[Remark]":
    """Remarks on both."""
    from deconfounded.deconf.diagnosis.doubts import doubts
    from deconfounded.deconf.diagnosis.look import look as look_at
    from deconfounded.deconf.diagnosis.remark import Remark

    blind = [] if explore is None else look_at(explore, blind=True)
    if explore is not None and any(remark.kind == "dynamics" and remark.odd for remark in blind):
        blind += [Remark("doubt", text, True) for text in doubts(trials, explore)]
    return look_at(trials) + [remark._replace(text=f"Exploration: {remark.text}") for remark in blind]


def main() -> None:
    parser = Parser(__doc__)
    add_data(parser)
    args = parser.parse_args()
    print(*look(*read(args.data, args.explore, columns(args))), sep="\n")
