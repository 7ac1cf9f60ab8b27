"""What comes with the package, in a checkout and installed alike: certificates of tasks, and records of methods."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from deconfounded import envs
from deconfounded.benchmarks.console import ROOT
from deconfounded.envs.support import outside

CERTIFICATES, RECORDS = ROOT / "docs" / "certificates", ROOT / "docs" / "records"
GROUPS = ("certified", "suite", "hard")  # names for several tasks


def certificate(name: str, suffix: str = ".json") -> Path:
    """Where a task's certificate is kept, or its picture (.png)."""
    return CERTIFICATES / ("hard" if name in envs.HARD else "") / f"{name}{suffix}"


def certified() -> list[str]:
    """Names of the suite's tasks whose certificate is passed."""
    files = {name: certificate(name) for name in envs.SUITE}
    return passed({name: json.loads(file.read_bytes()) for name, file in files.items() if file.is_file()})


def passed(certificates: Mapping[str, Any]) -> list[str]:
    """Names of the tasks whose certificate is passed, given the certificates by name."""
    return [name for name, certificate in certificates.items() if certificate["verdict"] == "passed"]


def tasks(asked: list[str]) -> list[envs.Task]:
    """Tasks by names, references and GROUPS, each once. Raises InputError for a name that is unknown."""
    groups = {"certified": certified, "suite": lambda: list(envs.SUITE), "hard": lambda: list(envs.HARD)}
    for each in asked:
        if each not in (choices := [*envs.names(), *groups]) and not outside.is_outside(each):
            raise envs.closest("task", each, choices, "; your own is path/file.py:Class")
    names = [outside.absolute(name) for each in asked for name in (groups[each]() if each in groups else [each])]
    return [envs.get(name) for name in dict.fromkeys(names)]
