"""Pictures beside what else is loaded in their process."""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from deconfounded.envs import render
from deconfounded.envs.contract.probe import gl_works

RENDER_AND_TRAIN = """
import sys
import numpy as np
from deconfounded import envs

env = envs.make("tilted_cartpole", render_mode="rgb_array")
env.reset(seed=0)
picture = env.render()
assert "torch" not in sys.modules, "pictures alone need no torch"

from deconfounded.benchmarks.engine.context import Context
from deconfounded.benchmarks.engine.provider import fit
from tests.tools import tiny_preset

fit(Context(env.task, tiny_preset(), [0]), "naive_rnn")
import triton  # as torch's optimizers do, at the latest
np.testing.assert_array_equal(env.render(), picture)
print("rendered, trained, rendered")
"""


OTHERS = "import mujoco\nmujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).render()\n"


@pytest.mark.skipif(not gl_works(), reason="no GL")
def test_others_render_too() -> None:
    """By the backend that they chose, though this package imported MuJoCo first, and without a GL library."""
    code = f"import sys\nfrom deconfounded import envs\nassert 'glfw' not in sys.modules\n{OTHERS}"
    environ = {**os.environ, "MUJOCO_GL": render.backend()}
    done = subprocess.run([sys.executable, "-c", code], env=environ, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(find_spec("triton") is None, reason="triton is not installed")
@pytest.mark.skipif(not gl_works(), reason="no GL")
@pytest.mark.parametrize("before", ["", OTHERS], ids=["first", "after another renderer"])
def test_render_then_train(before: str) -> None:
    """Mesa's LLVM and triton's in one process: torch imports triton once something has been drawn."""
    command = [sys.executable, "-c", before + RENDER_AND_TRAIN]
    environ = {**os.environ, "MUJOCO_GL": render.backend()}
    done = subprocess.run(command, cwd=Path(__file__).parents[2], env=environ, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "rendered, trained, rendered\n"), done.stderr
