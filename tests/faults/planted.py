"""Plant faults in a copy of this tree, one at a time, and see which test notices: `python tests/faults/planted.py`

Each fault of planted.toml is a plausible slip: a text that occurs once in a file, and what stands there in its place.
Its tests are run on the copy with `-x`; one of them must fail. Words after the command choose faults by name. It prints
`noticed by <test>` or `NOT NOTICED` for each; exit code 1 if any was not noticed.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from importlib import import_module
from pathlib import Path
from typing import NamedTuple, NoReturn

import pytest

ROOT = Path(__file__).resolve().parents[2]
LIBRARIES = ("torch", "mujoco", "gymnasium", "scipy.stats", "safetensors.numpy")


class Fault(NamedTuple):
    """tests: arguments of pytest, in the order in which they are to be tried."""

    name: str
    file: str
    old: str
    new: str
    tests: str


def faults() -> list[Fault]:
    """All of them."""
    with Path(__file__).with_suffix(".toml").open("rb") as file:
        return [Fault(**entry) for entry in tomllib.load(file)["fault"]]


def check(fault: Fault, text: str) -> None:
    """A fault's old text is there once in the text of its file."""
    count, right = text.count(fault.old), "bring `old` and `new` in tests/faults/planted.toml in step with it"
    assert count == 1, f"{fault.name}: {fault.old!r} occurs {count} times in {fault.file}; {right}"


def plant(fault: Fault, tree: Path) -> str:
    """Put the fault into a file of the tree; returns the file's text without it."""
    text = (tree / fault.file).read_text(encoding="utf-8")
    check(fault, text)
    (tree / fault.file).write_text(text.replace(fault.old, fault.new), encoding="utf-8")
    return text


def noticed(fault: Fault, tree: Path) -> str:
    """What became of a fault in a tree, which is put back as it was; begins with `noticed` if a test fails for it."""
    text = plant(fault, tree)
    try:
        code, output = run_tests(tree, shlex.split(fault.tests))
    finally:
        (tree / fault.file).write_text(text, encoding="utf-8")
    failed = re.search(r"^FAILED (\S+::.*?)(?: - |$)", output, re.M)
    if not failed:  # a file that cannot be imported, say, is no test that tells what is wrong
        return f"NOT NOTICED{f', pytest ended with {code}: {output}' if code else ''}"
    if run_tests(tree, [failed[1]])[0]:
        return f"NOT NOTICED, {failed[1]} fails without it too"
    return f"noticed by {failed[1]}"


def run_tests(tree: Path, tests: list[str]) -> tuple[int, str]:
    """Pytest's exit code and output. It runs in a fork, with libraries imported already: they take most of the time."""
    log = tree.parent / f"{tree.name}.log"
    if not (child := os.fork()):
        _run_tests(tree, log, tests)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return code, log.read_text(encoding="utf-8", errors="replace")


def _run_tests(tree: Path, log: Path, tests: list[str]) -> NoReturn:
    """Run tests in this process, which ends with pytest's code."""
    code = 1
    try:
        os.chdir(tree)
        for stream in (1, 2):
            os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | (os.O_TRUNC if stream == 1 else os.O_APPEND)), stream)
        os.environ |= {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
        sys.path[0], sys.dont_write_bytecode = str(tree), True
        code = pytest.main(["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", *tests])
    finally:
        sys.stdout.flush()
        os._exit(code)


def copied(folder: Path) -> Path:
    """A copy of what git tracks, as it is in the working tree."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    for name in filter(None, os.fsdecode(listed).split("\0")):
        if os.path.lexists(ROOT / name):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name, follow_symlinks=False)
    return folder


def main() -> None:
    """The command line."""
    chosen = [fault for fault in faults() if not sys.argv[1:] or any(word in fault.name for word in sys.argv[1:])]
    missed = 0
    for library in LIBRARIES:
        import_module(library)
    with tempfile.TemporaryDirectory(prefix="planted-") as scratch:
        tree = copied(Path(scratch))
        for fault in chosen:
            start = time.monotonic()
            said = noticed(fault, tree)
            missed += not said.startswith("noticed")
            print(f"{fault.name}: {said} ({time.monotonic() - start:.0f} s)", flush=True)
    print(f"{len(chosen) - missed} of {len(chosen)} noticed")
    sys.exit(missed > 0)


if __name__ == "__main__":
    main()
