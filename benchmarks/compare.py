"""Compare the methods of runs with others, over seeds and tasks: `deconf compare results/*-default`

Differences by seed and interquartile means, of the first and the last score of a trial and of its regret, and
probabilities of improvement in the last episode. The others are of the runs given, or of the records that come with the
package. A method from outside has thetas of its own, and shares no more than a seed's number with them. Written to
--out: csv, LaTeX (booktabs), pdf and png.
"""

from pathlib import Path

from deconfounded import envs
from deconfounded.benchmarks.console import Parser, place
from deconfounded.benchmarks.engine import protocols
from deconfounded.benchmarks.engine.catalogue import check_names
from deconfounded.benchmarks.output import records


def read(given: Path) -> list[records.Record]:
    """The records of a run, of a folder of records, or of a file."""
    folder = given / "records" if (given / "records").is_dir() else given
    files = [folder] if folder.is_file() else sorted(folder.glob("*.jsonl"))
    if not files:
        raise envs.InputError(f"{given} holds no records; give the folder of a run, or a file of records")
    return [record for file in files for record in records.read(file)]


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("results", nargs="+", type=Path, help="folders of runs, or files of records")
    default = ["deconfounded", "naive_rnn"]
    parser.add_argument("--against", nargs="+", metavar="NAME", default=default, help="default: deconfounded naive_rnn")
    parser.add_argument("--protocol", help="only the records of this protocol; default: all, which must be of one")
    parser.add_argument("--out", type=place, default=Path("results") / "comparison", help="default: results/comparison")
    args = parser.parse_args()
    from deconfounded.benchmarks.output import comparison  # it takes seconds

    against = list(dict.fromkeys(args.against))
    every = [record for given in dict.fromkeys(args.results) for record in read(given)]
    if args.protocol is not None:
        check_names("protocol", [args.protocol], list(protocols.PROTOCOLS))
        of = records.grouped(every, lambda record: record.get(records.NAME, protocols.STANDARD))
        if args.protocol not in of:
            raise envs.InputError(f"--protocol was {args.protocol}; the records given are of {' and '.join(of)}")
        every = of[args.protocol]
    scores = comparison.gathered(every, against)
    own = list(dict.fromkeys(records.named(record) for record in every))
    methods = [name for name in scores if name in own and (name not in against or len(against) > 1)]
    if not methods:
        raise envs.InputError(f"the records given are of {against[0]} alone; give --against another method")
    print(comparison.write(scores, methods, against, args.out))
    package = comparison.published(every, against)  # with which the runs were compared
    if package and (presets := sorted({record["preset"] for record in every} - {"default"})):
        print(f"note: runs of preset {', '.join(presets)}; the records that come with the package are of default")
    for key in ("set", "salt") if package else ():
        if changed := sorted({str(record[key]) for record in every if record[key]}):
            print(f"note: runs of {key} {', '.join(changed)}; the records that come with the package have none")
    counts = [sorted({str(record["eval_trials"]) for record in of}) for of in (every, package)]
    if package and counts[0] != counts[1]:
        given, kept = (" and ".join(of) for of in counts)
        print(f"note: runs of {given} trials a seed, the package's of {kept}: a seed's are the same only in part")
    if len(salts := sorted({record["salt"] or "none" for record in every})) > 1:
        print(f"note: runs of salts {', '.join(salts)}: a seed has other thetas in each, and nothing is paired")
    for key in () if package else ("preset", "set"):
        if len(kinds := sorted({str(record[key] or "none") for record in every})) > 1:
            print(f"note: runs of {key} {' and '.join(kinds)}: differences may come of that")
    for line in comparison.outdated(every, against):
        print(f"note: {line}")
