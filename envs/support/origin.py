"""Where a file is from: of this package, of an installed library, or of the user's own."""

import sysconfig
from pathlib import Path

import deconfounded

ROOT = Path(__file__).resolve().parents[2]
OURS = tuple(ROOT / name for name in ("envs", "experts", "deconf", "benchmarks", "assets"))
ENTRANCE = Path(deconfounded.__file__).resolve().parent  # of an import and of the command line
LIBRARIES = {Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib", "purelib", "platlib")}


def is_ours(file: Path) -> bool:
    """Whether a file belongs to this package."""
    return file.parent == ENTRANCE or any(file.is_relative_to(folder) for folder in OURS)


def is_library(file: Path) -> bool:
    """Whether a file is in a folder of installed libraries, or of Python's own."""
    return any(file.is_relative_to(folder) for folder in LIBRARIES)
