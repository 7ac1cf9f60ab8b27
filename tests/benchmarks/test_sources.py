"""The files that a task from outside depends on: they are its identity, and go where it goes."""

import os
import shutil
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import mujoco
import pytest

from deconfounded import envs
from deconfounded.benchmarks.engine import sources
from deconfounded.benchmarks.engine.benchmark import BenchmarkJob
from tests.tools import tiny_preset

ROOT = Path(__file__).parents[2]

MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
FIELD = struct.pack("ii", 2, 2) + bytes(16)
XML = (ROOT / "assets" / "slippery_cartpole.xml").read_text()
TEXTS: dict[str, str | bytes] = {
    "task.py": """
from pathlib import Path
import mujoco
from mypkg.helpers import Base
import beside
class Mine(Base):
    name = "mine"
    def spec(self):
        spec = super().spec()
        child = mujoco.MjSpec.from_file(str(Path(__file__).parent / "parts" / "named.xml"))
        spec.worldbody.add_frame().attach_body(child.body("named"), "a_", "")
        return spec
""",
    "mypkg/__init__.py": "from . import early\n",
    "mypkg/early.py": "",
    "mypkg/helpers.py": "from mypkg.bases import Base\n",
    "mypkg/bases.py": "import lower.deep\n"
    "from deconfounded.envs.tasks.slippery_cartpole import SlipperyCartpole as Base\n",
    "lower/deep.py": "from lower.deeper import ONE\n",  # a package without __init__.py
    "lower/deeper.py": "import last\nONE = 1\n",
    "last.py": "",
    "beside.py": "",
    "mine.xml": XML.replace(
        "<worldbody>",
        '<compiler meshdir="meshes"/><include file="more/world.xml"/>'
        '<asset><hfield name="h" file="h.bin" size="1 1 1 1"/></asset><worldbody>',
    ),
    "more/world.xml": '<mujoco><asset><mesh name="m" file="m.obj"/><mesh name="n" file="n.obj"/></asset>'
    '<include file="more/again.xml"/></mujoco>',
    "more/again.xml": '<mujoco><worldbody><geom name="m" type="mesh" mesh="m"/></worldbody></mujoco>',
    "more/n.obj": MESH,
    "meshes/m.obj": MESH,
    "meshes/h.bin": FIELD,
    "parts/named.xml": '<mujoco><worldbody><body name="named"><geom size=".1"/></body></worldbody></mujoco>',
}


@pytest.fixture
def task(tmp_path: Path) -> envs.MujocoTask:
    """The task, beside files that it does not depend on."""
    for name, content in {**TEXTS, "not_read.py": "", "meshes/not_read.obj": MESH, "not_read.xml": "<mujoco/>"}.items():
        (tmp_path / "mine" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "mine" / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    made = envs.get(f"{tmp_path}/mine/task.py:Mine")
    assert isinstance(made, envs.MujocoTask)
    return made


@pytest.fixture(autouse=True)
def clean(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Modules of one test's folder are not found in the next one's."""
    modules, path = set(sys.modules), list(sys.path)
    yield
    envs.TASKS.pop("mine", None)
    sys.path[:] = path
    for name in set(sys.modules) - modules:
        if name.partition(".")[0] in ("mypkg", "lower", "last", "beside"):
            del sys.modules[name]


def test_whatever_is_read_counts(task: envs.MujocoTask, tmp_path: Path) -> None:
    """Of packages with and without __init__.py, includes, and what is named in either; and nothing else."""
    assert {str(file.relative_to(tmp_path / "mine")) for file in sources.of_task(task)} == set(TEXTS)
    assert task.model.nmesh == 2
    first = sources.digest(sources.of_task(task))
    for name in TEXTS:
        file = tmp_path / "mine" / name
        before = file.read_bytes()
        file.write_bytes(before + (b"\nx = 2\n" if name.endswith("py") else b" "))
        assert sources.digest(sources.of_task(task)) != first, name
        file.write_bytes(before)
    assert sources.digest(sources.of_task(task)) == first


def test_paths_that_are_stripped(tmp_path: Path) -> None:
    """Of them the name alone counts: MuJoCo looks for it in meshdir."""
    for name in ("m.obj", "apart.obj"):
        (tmp_path / name).write_text(MESH)
    model = tmp_path / "model.xml"
    model.write_text(
        '<mujoco><compiler strippath="true"/><asset><mesh name="m" file="elsewhere/m.obj"/></asset>'
        '<worldbody><geom type="mesh" mesh="m"/></worldbody></mujoco>'
    )
    assert mujoco.MjModel.from_xml_path(str(model)).nmesh == 1
    assert sources.mjcf(model) == {model, tmp_path / "m.obj"}


def test_data_files_that_code_names_count(tmp_path: Path) -> None:
    """Weights and tables beside an expert, or in a folder there; not those that nobody names."""
    (tmp_path / "weights").mkdir()
    code = "import helper\nFILE, OTHER, TEXT = 'k.npy', 'gone.npy', 'see 3.5'\ndef control(obs, theta): return obs\n"
    texts = {"ex.py": code, "helper.py": "ZIP = 'ppo.zip'", "k.npy": "1", "weights/ppo.zip": "2", "not_named.npy": "3"}
    digests = []
    for changed in (None, "k.npy", "weights/ppo.zip", "not_named.npy"):
        for name, text in texts.items():
            (tmp_path / name).write_text(text + "9" * (name == changed))
        digests.append(sources.digest(sources.of_reference(f"{tmp_path}/ex.py:control")))
    assert digests[0] == digests[3]
    assert len({*digests}) == 3


def test_modules_that_a_package_s_module_imports_count(tmp_path: Path) -> None:
    """Of its own folder and of the one above, with the packages that these imports run; not the others there."""
    texts = {
        **{"pack/__init__.py": "", "pack/gains.py": "", "pack/unused.py": "", "pack/inner/__init__.py": ""},
        **{"pack/inner/mine.py": "from ..gains import K\nfrom . import beside\nimport other.deep.module\n"},
        **{"pack/inner/beside.py": "", "pack/inner/gains.py": ""},
        **{"other/__init__.py": "", "other/deep/__init__.py": "", "other/deep/module.py": "", "other/unused.py": ""},
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    reached = sources.closure([tmp_path / "pack/inner/mine.py"])
    left = {"pack/unused.py", "other/unused.py", "pack/inner/gains.py"}
    assert {str(file.relative_to(tmp_path)) for file in reached} == {*texts} - left


def test_data_files_come_and_go(tmp_path: Path) -> None:
    """Which of them there are is looked up each time; a text that no file can be called by is the name of none."""
    long = "é" * 190 + ".txt"  # more bytes than a name may have
    (tmp_path / "mine.py").write_text(f"LOG, LONG = 'log.txt', {long!r}\ndef fit(given): pass\n")
    named = []
    for change in (lambda: None, (tmp_path / "log.txt").touch, (tmp_path / "log.txt").unlink):
        change()
        named.append({file.name for file in sources.of_reference(f"{tmp_path}/mine.py:fit")})
    assert named == [{"mine.py"}, {"mine.py", "log.txt"}, {"mine.py"}]


def test_whatever_is_read_travels(task: envs.MujocoTask, tmp_path: Path) -> None:
    """To a cluster's worker, where the task is found and compiles, though its folder is gone."""
    pytest.importorskip("ray")
    from deconfounded.benchmarks.engine import cluster

    job = BenchmarkJob(task.reference, tiny_preset(), "blind_bc", (0,), tmp_path / "jobs")
    for name, file in cluster.given(job).items():
        (tmp_path / "sent" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "sent" / name).write_bytes(file.read_bytes())
    shutil.rmtree(tmp_path / "mine")
    code = f"from deconfounded import envs; print(envs.get({task.reference!r}).model.nmesh)"
    environ = {**os.environ, "DECONFOUNDED_OUTSIDE": str(tmp_path / "sent" / "outside")}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], env=environ, capture_output=True, text=True, cwd=ROOT
    )
    assert done.stdout == "2\n", done.stderr
