"""Share an agent or a Minari data set on the Hugging Face hub: `deconf push results/RUN/agents/deconfounded-0 ME/NAME`

The repository is created if there is none, and gets a commit with the files and a card, made of the agent's record:
task, versions, method, score, how to load it. Log in first: `hf auth login`, or a token in HF_TOKEN.
"""

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from deconfounded import envs
from deconfounded.benchmarks.console import Parser, place
from deconfounded.experts import saved_agents

AGENT, DATA = "model", "dataset"  # the hub's types of repositories
AGENT_FILES = ("agent.json", saved_agents.ARRAYS, saved_agents.CODE)
PREFIX = "datasets/"  # of a data set's repository, as in the hub's addresses
HINTS = {
    401: "log in with `hf auth login`, or set HF_TOKEN; or there is no such repository",
    403: "your token may not do that",
    404: "there is no such repository or revision",
}


def repository(text: str) -> str:
    """The id of a repository, OWNER/NAME. Raises InputError for anything else."""
    part = r"[A-Za-z0-9](?:[\w.-]*[A-Za-z0-9_])?"
    if not re.fullmatch(f"{part}/{part}", text, re.ASCII) or "--" in text or ".." in text or len(text) > 96:
        raise envs.InputError(f"repository was {text!r}; it must be OWNER/NAME, of letters, digits, -, _ and .")
    return text


@contextmanager
def hub(repo: str) -> Iterator[Any]:
    """The hub's API; what fails there raises InputError, in a line."""
    if not find_spec("huggingface_hub"):
        raise envs.InputError("the hub needs huggingface_hub; `pip install deconfounded-imitation[hub]` brings it")
    from huggingface_hub import HfApi  # it takes a second; bad input is refused at once

    try:
        yield HfApi(library_name="deconfounded-imitation")
    except envs.InputError:
        raise
    except Exception as error:  # its own types, those of its HTTP client, and OSError
        status = getattr(getattr(error, "response", None), "status_code", None)
        line = (str(error).strip().splitlines() or [type(error).__name__])[0]
        hint = f"; {HINTS[status]}" if status in HINTS else ""
        raise envs.InputError(f"the hub failed on {repo}: {line}{hint}") from None


def data_sets(folder: Path) -> list[Path]:
    """Folders of Minari data sets in a folder, at any depth."""
    return [file.parents[1] for file in sorted(folder.rglob("metadata.json")) if file.parent.name == "data"]


def contents(folder: Path, repo: str) -> tuple[str, str, dict[str, Path], str]:
    """What to push of a folder: the type of repository, a name, the files by their paths there, and the card.

    Raises InputError for a folder that holds neither an agent nor one data set, and for damaged ones.
    """
    sets = data_sets(folder)
    if (folder / "agent.json").exists():
        about = saved_agents.describe(folder)
        saved_agents.arrays(folder, about)
        kind, name = AGENT, str(about.get("method") or about["class"].rpartition(":")[2])
        files = {part: folder / part for part in AGENT_FILES if (folder / part).exists()}
    elif len(sets) == 1:
        try:
            about = json.loads((sets[0] / "data" / "metadata.json").read_bytes())
            kind, name = DATA, str(about["dataset_id"])
        except (OSError, ValueError, TypeError, KeyError):
            raise envs.InputError(f"{sets[0]} is no Minari data set, or is damaged") from None
        parts = [file for file in sorted((sets[0] / "data").rglob("*")) if not file.is_dir()]
        files = {file.relative_to(sets[0]).as_posix(): file for file in parts}
    else:
        held = f"no agent.json, and {len(sets)} Minari data sets"
        raise envs.InputError(f"{folder} holds {held}; give a folder that holds an agent, or one data set")
    if links := [file for file in files.values() if file.is_symlink()]:
        raise envs.InputError(f"{links[0]} is a link; only plain files are shared")
    from deconfounded.benchmarks.output import card  # it takes a second

    text = card.of_agent(folder, about, repo) if kind == AGENT else card.of_data(about, PREFIX + repo)
    return kind, name, files, text


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("folder", type=place, help="of a saved agent, or of a data set that `deconf data` wrote")
    parser.add_argument("repo", metavar="OWNER/NAME", help="the repository on the hub")
    parser.add_argument("--private", action="store_true", help="if the repository is new: only its owner sees it")
    args = parser.parse_args()
    repo = repository(args.repo.removeprefix(PREFIX))
    kind, name, files, text = contents(args.folder, repo)
    with hub(repo) as api:
        from huggingface_hub import CommitOperationAdd

        place_of = api.create_repo(repo, repo_type=kind, private=args.private or None, exist_ok=True)
        added = [CommitOperationAdd("README.md", text.encode())]
        added += [CommitOperationAdd(path, str(file)) for path, file in files.items()]
        commit = api.create_commit(repo, added, repo_type=kind, commit_message=f"{name}, by deconf push")
    print(f"{name}: {len(added)} files, commit {commit.oid[:7]} -> {place_of}")
