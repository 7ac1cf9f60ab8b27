"""What comes with the package, in a checkout and installed alike: certificates of tasks, and records of methods."""

import json
from pathlib import Path

from deconfounded import envs
from deconfounded.benchmarks.console import ROOT

CERTIFICATES, RECORDS = ROOT / "docs" / "certificates", ROOT / "docs" / "records"
GROUPS = ("certified", "suite", "hard")  # names for several tasks


def certificate(name: str, suffix: str = ".json") -> Path:
    """Where a task's certificate is kept, or its picture (.png)."""
    return CERTIFICATES / ("hard" if name in envs.HARD else "") / f"{name}{suffix}"


def certified() -> list[str]:
    """Names of the suite's tasks whose certificate is passed."""

    def passed(name: str) -> bool:
        file = certificate(name)
        return file.is_file() and json.loads(file.read_bytes())["verdict"] == "passed"

    return [name for name in envs.SUITE if passed(name)]


def tasks(asked: list[str]) -> list[envs.Task]:
    """Tasks by names, references and GROUPS, each once. Raises InputError for a name that is unknown."""
    groups = {"certified": certified, "suite": lambda: list(envs.SUITE), "hard": lambda: list(envs.HARD)}
    names = [name for each in asked for name in (groups[each]() if each in groups else [each])]
    return [envs.get(name) for name in dict.fromkeys(names)]
