"""The sdist and the wheel: what they hold, and that commands work as installed; all in folders with spaces."""

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from collections import Counter
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from filelock import FileLock

import deconfounded
from deconfounded import envs
from deconfounded.__main__ import COMMANDS, STUDIES
from deconfounded.benchmarks.engine import identity, sources

ROOT = Path(__file__).parents[2]
PACKAGES = ("assets", "benchmarks", "deconf", "envs", "experts")
PIP = (sys.executable, "-m", "pip", "-q", "--disable-pip-version-check", "--no-cache-dir")
OFFLINE = ("--no-deps", "--no-index")


def files(folder: Path) -> set[str]:
    """All but bytecode, locks and the built site, which anybody may leave."""
    found = (file for file in folder.rglob("*") if not file.is_dir() and not {"__pycache__", "_build"} & {*file.parts})
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
            aside = shutil.ignore_patterns(
                ".*", "results", "runs", "build", "_build", "dist", "__pycache__", "*.egg-info"
            )
            shutil.copytree(ROOT, made / "copy", symlinks=True, ignore=aside)  # a build writes into its own tree
            build = "from setuptools import build_meta; build_meta.build_sdist('..')"
            subprocess.run([sys.executable, "-c", build], cwd=made / "copy", check=True, capture_output=True)
            with tarfile.open(next(made.glob("*.tar.gz"))) as sdist:
                sdist.extractall(made, filter="data")
            next(made.glob("*-*/pyproject.toml")).parent.rename(made / "tree")
            options = (*OFFLINE, "--no-build-isolation", "--wheel-dir", made)
            subprocess.run([*PIP, "wheel", *options, made / "tree"], check=True)
            wheel = next(made.glob("*.whl"))
            subprocess.run(
                [*PIP, "install", "--no-compile", *OFFLINE, "--target", made / "installing", wheel], check=True
            )
            (made / "installing").rename(made / "site")
    return made


@pytest.fixture
def empty(tmp_path: Path) -> Path:
    """A folder to work in; a home and one for temporary files are beside it."""
    for name in ("at work", "home", "scratch"):
        (tmp_path / name).mkdir()
    return tmp_path / "at work"


def run(built: Path, folder: Path, *args: str | Path) -> subprocess.CompletedProcess[str]:
    environ = {"MUJOCO_GL": "off", "PYTHONPATH": str(built / "site")}
    environ |= {name: str(folder.parent / own) for name, own in (("HOME", "home"), ("TMPDIR", "scratch"))}
    environ = {**os.environ, **environ, "MPLCONFIGDIR": matplotlib.get_cachedir()}  # fonts are looked for once
    return subprocess.run([sys.executable, *args], cwd=folder, capture_output=True, text=True, env=environ, timeout=300)


@pytest.mark.slow
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
    kept = [*(ROOT / "docs").glob("records/*.jsonl"), *(ROOT / "docs").glob("certificates/*.json")]
    ours |= {f"deconfounded/{file.relative_to(ROOT)}" for file in kept}
    assert {name for name in held if ".dist-info/" not in name} == ours


@pytest.mark.slow
def test_what_needs_a_checkout_says_so(built: Path, empty: Path) -> None:
    """At once, in a line: the studies, which no wheel has."""
    before = files(built / "site")
    for name, (module, *_) in COMMANDS.items():
        there = (built / "site" / "deconfounded" / f"{module.replace('.', '/')}.py").exists()
        assert there != module.startswith(STUDIES), name
        if not there:
            done = run(built, empty, built / "site" / "bin" / "deconf", name)
            assert done.returncode == 2
            assert done.stderr.startswith(f"error: {name} makes the pages of a checkout, and ")
            assert done.stderr.count("\n") == 1
    assert files(empty.parent) == set()
    assert files(built / "site") == before


SCRIPT = """
import sys
from functools import partial
from deconfounded import __main__ as entrance, envs
from deconfounded.benchmarks.engine import identity, local, sources
from deconfounded.deconf.diagnosis import diagnose
from deconfounded.deconf.diagnosis.measures import Amounts
from deconfounded.deconf.methods import memoryless_bc
from deconfounded.deconf.methods.deconfounded import DeconfoundedConfig
from deconfounded.deconf.methods.deconfounded_offline import OfflineConfig
from deconfounded.deconf.methods.sequence_bc import RecurrentConfig

offline = OfflineConfig(offline_updates=5, online_updates=0, offline_batch=4)
networks = memoryless_bc.MemorylessConfig(updates=5), RecurrentConfig(updates=6, batch=4), offline, DeconfoundedConfig()
diagnose.DiagnoseConfig = partial(diagnose.DiagnoseConfig, refits=1, amounts=Amounts(.25, 2, 4, *networks))
memoryless_bc.MemorylessConfig = partial(memoryless_bc.MemorylessConfig, updates=50)  # of the certificate
local.cores = lambda: 1
for line in sys.argv[1].splitlines():
    sys.argv = ["deconf", *line.split()]
    try:
        entrance.main()
    except SystemExit as ended:
        assert not ended.code, line
    local.Local = local.Here  # the first line had a worker
print(identity.demonstrations(envs.get("icy_road"), None, 8, 0), sources.package())
"""  # in one process: each would import for seconds
LINES = """
run --task bandit --preset smoke --methods blind_bc --set eval_trials=4 expert_trials=8 blind_bc.updates=5
report results/bandit-smoke
score --agent results/bandit-smoke/agents/blind_bc-0 --task bandit --trials 4 --out scores/bandit.json
verify bandit blind_bc 0 --records results/bandit-smoke/records
compare results/bandit-smoke --against naive_rnn
data --task bandit --trials 24 --out sets
look --data sets/deconf/bandit/expert24s0-v0
diagnose --data sets/deconf/bandit/expert24s0-v0
check --task bandit
certify --task bandit
train --task slippery_cartpole --steps 64
push --help
pull --help
play --agent results/bandit-smoke/agents/blind_bc-0 --task bandit
version
"""


@pytest.mark.slow
def test_commands_work_as_installed(built: Path, empty: Path) -> None:
    """They write under --out or where their --help says, and not in the package, at home or in /tmp.

    Data there and in a checkout are known to be the same.
    """
    installed = {name for name, (module, *_) in COMMANDS.items() if not module.startswith(STUDIES)}
    assert {line.split()[0] for line in LINES.split("\n") if line} == installed
    before = files(built / "site")
    done = run(built, empty, "-c", SCRIPT, LINES.strip())
    assert done.returncode == 0, done.stdout + done.stderr
    *_, played, ours, libraries, _, gl, same = done.stdout.splitlines()
    assert "returns" in played
    assert ours == f"deconfounded {deconfounded.__version__} (no checkout)"
    assert f"numpy {np.__version__}" in libraries
    assert gl.startswith("GL: ")
    assert same == f"{identity.demonstrations(envs.get('icy_road'), None, 8, 0)} {sources.package()}"
    assert {name.partition("/")[0] for name in files(empty.parent)} == {"at work"}
    weights = {"slippery_cartpole.safetensors", "slippery_cartpole.json"}
    assert {name.partition("/")[0] for name in files(empty)} == {"results", "scores", "sets", *weights}
    assert {file.name for file in (empty / "results").iterdir()} == {
        "bandit-smoke",
        "certificates",
        "comparison",
        "diagnosis",
    }
    assert files(built / "site") == before
