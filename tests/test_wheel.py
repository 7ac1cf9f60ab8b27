"""The sdist and the wheel: what they hold, and that commands work as installed; all in folders with spaces."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from collections import Counter
from pathlib import Path

import matplotlib
import pytest
from filelock import FileLock

from deconfounded import envs
from deconfounded.__main__ import COMMANDS, STUDIES
from deconfounded.benchmarks.engine import identity, sources

ROOT = Path(__file__).parents[1]
PACKAGES = ("assets", "benchmarks", "deconf", "envs", "experts")
PIP = (sys.executable, "-m", "pip", "-q", "--disable-pip-version-check", "--no-cache-dir")
OFFLINE = ("--no-deps", "--no-index")


def files(folder: Path) -> set[str]:
    """All but bytecode and locks, which anybody may leave."""
    found = (file for file in folder.rglob("*") if not file.is_dir() and "__pycache__" not in file.parts)
    found = (file for file in found if file.name != ".lock")
    return {str(file.relative_to(folder)) for file in found}


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sdist, `tree` (the same, unpacked), the wheel made of it, and `site` (that, installed)."""
    own = tmp_path_factory.getbasetemp()
    made = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "as installed"  # one for all workers
    with FileLock(made.with_suffix(".lock")):
        if not (made / "site").exists():
            shutil.rmtree(made, ignore_errors=True)
            aside = shutil.ignore_patterns(".*", "results", "runs", "build", "dist", "__pycache__", "*.egg-info")
            shutil.copytree(ROOT, made / "copy", symlinks=True, ignore=aside)  # a build writes into its own tree
            build = "from setuptools import build_meta; build_meta.build_sdist('..')"
            subprocess.run([sys.executable, "-c", build], cwd=made / "copy", check=True, capture_output=True)
            with tarfile.open(next(made.glob("*.tar.gz"))) as sdist:
                sdist.extractall(made, filter="data")
            next(made.glob("*-*/pyproject.toml")).parent.rename(made / "tree")
            options = (*OFFLINE, "--no-build-isolation", "--wheel-dir", made)
            subprocess.run([*PIP, "wheel", *options, made / "tree"], check=True)
            wheel = next(made.glob("*.whl"))
            subprocess.run([*PIP, "install", *OFFLINE, "--target", made / "installing", wheel], check=True)
            (made / "installing").rename(made / "site")
    return made


@pytest.fixture
def empty(tmp_path: Path) -> Path:
    """A folder to work in, and a home beside it."""
    for name in ("at work", "home"):
        (tmp_path / name).mkdir()
    return tmp_path / "at work"


def run(built: Path, folder: Path, *args: str | Path) -> subprocess.CompletedProcess[str]:
    environ = {"MUJOCO_GL": "off", "PYTHONPATH": str(built / "site"), "HOME": str(folder.parent / "home")}
    environ = {**os.environ, **environ, "MPLCONFIGDIR": matplotlib.get_cachedir()}  # fonts are looked for once
    return subprocess.run([sys.executable, *args], cwd=folder, capture_output=True, text=True, env=environ, timeout=300)


def deconf(built: Path, folder: Path, *args: str) -> str:
    """What the installed console script says."""
    done = run(built, folder, built / "site" / "bin" / "deconf", *args)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_they_are_whole(built: Path) -> None:
    """The sdist has all that its tests need, the wheel all that is imported and read; neither has it twice."""
    with tarfile.open(next(built.glob("*.tar.gz"))) as sdist:
        members = [member for member in sdist.getmembers() if not member.isdir()]
    assert all(member.isfile() for member in members)
    assert max(Counter(member.name for member in members).values()) == 1
    names = {member.name.partition("/")[2] for member in members}
    for folder in (*PACKAGES, "docs", "tests"):
        assert {f"{folder}/{name}" for name in files(ROOT / folder)} <= names
    assert {"Makefile", "README.md", "constraints.txt", "pyproject.toml", "CHANGELOG.md", "LICENSE"} <= names
    assert not [name for name in names if name.startswith(tuple(f"deconfounded/{folder}/" for folder in PACKAGES))]

    with zipfile.ZipFile(next(built.glob("*.whl"))) as wheel:
        held = wheel.namelist()
    assert max(Counter(held).values()) == 1
    ours = {f"deconfounded/{name}" for name in ("__init__.py", "__main__.py", "py.typed")}
    ours |= {f"deconfounded/{folder}/{name}" for folder in PACKAGES for name in files(ROOT / folder)}
    ours = {name for name in ours if "/studies/" not in name}
    assert {name for name in held if ".dist-info/" not in name} == ours


def test_what_needs_a_checkout_says_so(built: Path, empty: Path) -> None:
    """At once, in a line: the studies, which no wheel has."""
    before = files(built / "site")
    for name, (module, _) in COMMANDS.items():
        there = (built / "site" / "deconfounded" / f"{module.replace('.', '/')}.py").exists()
        assert there != module.startswith(STUDIES), name
        if not there:
            done = run(built, empty, built / "site" / "bin" / "deconf", name)
            assert done.returncode == 2
            assert done.stderr.startswith(f"error: {name} makes the pages of a checkout, and ")
            assert done.stderr.count("\n") == 1
    assert files(empty.parent) == set()
    assert files(built / "site") == before


def test_commands_work_as_installed(built: Path, empty: Path) -> None:
    """They read and write nothing but the folder they are in; data there and in a checkout are known to be the same."""
    before = files(built / "site")
    small = ("--preset", "smoke", "--set", "eval_trials=4", "expert_trials=8", "blind_bc.updates=5")
    deconf(built, empty, "run", "--task", "bandit", "--methods", "blind_bc", *small)
    agent = ("--agent", "results/bandit-smoke/agents/blind_bc-0", "--task", "bandit")
    assert "returns" in deconf(built, empty, "play", *agent)
    deconf(built, empty, "data", "--task", "bandit", "--trials", "2", "--out", "data sets")
    code = "from deconfounded import envs; from deconfounded.benchmarks.engine import identity, sources;"
    code += "print(identity.demonstrations(envs.get('icy_road'), None, 8, 0), sources.package())"
    expected = f"{identity.demonstrations(envs.get('icy_road'), None, 8, 0)} {sources.package()}\n"
    assert run(built, empty, "-c", code).stdout == expected
    assert {name.partition("/")[0] for name in files(empty.parent)} == {"at work"}
    assert {name.partition("/")[0] for name in files(empty)} == {"results", "data sets"}
    assert files(built / "site") == before
