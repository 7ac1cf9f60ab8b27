"""Fetch an agent or a data set from the Hugging Face hub: `deconf pull OWNER/NAME --out agent`

A data set is datasets/OWNER/NAME. An agent's checksums are compared, and nothing of it is run. To load an agent runs
the code of its class, which this command names: read it, or trust its owner.
"""

import os
import shutil
import tempfile
from pathlib import Path

from deconfounded import envs
from deconfounded.benchmarks.console import Parser, place
from deconfounded.benchmarks.push import AGENT, AGENT_FILES, DATA, PREFIX, data_sets, hub, repository
from deconfounded.envs.support.files import check_folder
from deconfounded.experts import saved_agents

WANTED = {AGENT: ("README.md", *AGENT_FILES), DATA: ("README.md", "data/*")}


def check(folder: Path, kind: str) -> str:
    """What was fetched, in a line. Raises InputError if it is neither an agent nor a data set, or is damaged."""
    if kind == DATA:
        if data_sets(folder) != [folder]:
            raise envs.InputError("the repository holds no Minari data set")
        return "a Minari data set; `Trials.from_minari` reads it"
    if not (folder / "agent.json").exists():
        raise envs.InputError(f"the repository holds no agent; a data set is {PREFIX}OWNER/NAME")
    about = saved_agents.describe(folder)
    saved_agents.arrays(folder, about)
    own = ", in agent.py, which comes with it" * about["class"].startswith(f"{saved_agents.CODE}:")
    named = f"{about.get('method', 'an agent')} of {about.get('task', 'data from outside')}, class {about['class']}"
    return repr(named)[1:-1] + own  # control characters, which a terminal would obey, are escaped


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("repo", metavar="[datasets/]OWNER/NAME", help="the repository on the hub")
    parser.add_argument("--revision", help="a commit, branch or tag; default: the newest commit")
    parser.add_argument("--out", type=place, help="a new folder; default: NAME")
    args = parser.parse_args()
    kind, repo = DATA if args.repo.startswith(PREFIX) else AGENT, repository(args.repo.removeprefix(PREFIX))
    out = args.out or Path(repo.partition("/")[2])
    if out.exists() or out.is_symlink():
        raise envs.InputError(f"{out} is there already; remove it, or give another --out")
    check_folder(out.parent)
    with hub(args.repo) as api:
        commit = api.repo_info(repo, repo_type=kind, revision=args.revision).sha
        with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as scratch:
            fetched = Path(scratch) / "fetched"
            api.snapshot_download(
                repo, repo_type=kind, revision=commit, local_dir=fetched, allow_patterns=list(WANTED[kind])
            )
            shutil.rmtree(fetched / ".cache", ignore_errors=True)  # the hub's notes on downloads
            described = check(fetched, kind)
            os.rename(fetched, out)
    print(f"{described}; commit {commit[:7]} -> {out}")
