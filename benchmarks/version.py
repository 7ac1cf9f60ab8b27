"""Versions, machine and GL, for a bug report: `deconf version`"""

import os
import platform
from importlib.util import find_spec

from deconfounded import __version__
from deconfounded.benchmarks.console import Parser
from deconfounded.benchmarks.engine import identity
from deconfounded.envs import render
from deconfounded.envs.support.errors import InputError


def main() -> None:
    """Print them, a line each. Without torch, the number of cores is all that is said of the machine."""
    Parser(__doc__).parse_args()
    made = identity.versions()
    machine = identity.machine("cpu").rpartition(";")[0] if find_spec("torch") else f"{os.cpu_count()} cores"
    try:
        gl = render.backend()
    except InputError as error:
        gl = str(error)
    print(f"deconfounded {__version__} ({identity.commit() or 'no checkout'})")
    print(", ".join(f"{name} {version}" for name, version in made.items()))
    print(f"{platform.platform()}; {machine}")
    print(f"GL: {gl}")
