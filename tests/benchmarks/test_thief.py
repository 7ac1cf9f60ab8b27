"""Attacks of a method from outside on what it did not declare: each must fail."""

import json
import os
import queue
import select
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deconfounded import envs
from deconfounded.benchmarks.engine import catalogue, job_files, progress
from deconfounded.benchmarks.engine.benchmark import BenchmarkJob
from deconfounded.benchmarks.engine.context import DEMOS, EVALUATION, Context, stream
from deconfounded.benchmarks.output import records
from deconfounded.experts.rollout import thetas
from tests.tools import tiny_preset

CONTROL, SALT = "slippery_cartpole", "a reviewer's own"
HEAD = """
import json, os, subprocess, sys
import numpy as np
from deconfounded.deconf.method import uses
from deconfounded.experts.agent import Agent

class Still(Agent):
    def act(self, obs): return np.zeros((len(obs), 1))

def say(name, what):
    with open(os.path.join(os.path.dirname(os.path.abspath(__file__)), name), "w") as file:
        json.dump(what, file)

@uses("demonstrations")
def fit(given):
    steal(given)
    return Still()

"""


def run(folder: Path, steal: str, monkeypatch: pytest.MonkeyPatch, seed: int = 0) -> dict[str, Any]:
    """A run of a method that steals; returns what its job wrote."""
    (folder / "thief.py").write_text(f"{HEAD}def steal(given):\n{steal}")
    (folder / "jobs").mkdir(exist_ok=True)
    monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
    monkeypatch.setattr(catalogue.METHODS, "outside", {})
    name = catalogue.add(f"{folder}/thief.py:fit")
    guest = catalogue.guest(name)
    job = BenchmarkJob(CONTROL, tiny_preset(), name, (seed,), folder / "jobs", None, SALT, guest)
    job.run()
    data = job_files.read(job.file(seed))
    assert data is not None
    return data


@pytest.mark.slow
def test_the_suite_cannot_be_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither tasks, experts, benchmarks nor a simulator are in the process, and importing them says why not."""
    steal = """    import importlib
    refused = {}
    ours = ("envs.registry", "envs.tasks.slippery_cartpole", "experts.policy", "experts.sb3", "benchmarks",
            "benchmarks.engine.context", "deconf.exact")
    for name in (*("deconfounded." + each for each in ours), "mujoco", "dm_control"):
        try:
            importlib.import_module(name)
        except ImportError as error:
            refused[name] = str(error)
    try:
        from deconfounded import envs
        envs.get("slippery_cartpole")
    except ImportError as error:
        refused["envs.get"] = str(error)
    say("refused", refused)
    say("modules", [name for name, module in sys.modules.items() if module is not None])
"""
    run(tmp_path, steal, monkeypatch)
    refused = json.loads((tmp_path / "refused").read_text())
    assert len(refused) == 10
    assert all("no tasks, experts or simulators" in why for why in refused.values())
    modules = json.loads((tmp_path / "modules").read_text())
    assert "deconfounded.experts.agent" in modules
    loaded = [name for name in modules if name.startswith(("deconfounded.envs", "deconfounded.benchmarks", "mujoco"))]
    inside = "deconfounded.envs.support"
    assert [name for name in loaded if not name.startswith((inside, "deconfounded.envs.streams"))] == [
        "deconfounded.envs"
    ]


@pytest.mark.slow
def test_no_theta_can_be_drawn_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Thetas of demonstrations and evaluation come from salts that are drawn, and recorded: no seed gives them away."""
    steal = """    shown = given.demonstrations
    np.savez(os.path.join(os.path.dirname(os.path.abspath(__file__)), "shown"), obs=shown.obs)
    say("state", str(given.rng.bit_generator.state))
"""
    data, task = run(tmp_path, steal, monkeypatch), envs.get(CONTROL)
    training, evaluation = data["meta"]["salts"]
    theta, n = data["thief/theta"][:, : task.episodes], len(data["thief/theta"])
    np.testing.assert_array_equal(thetas(task, n, task.episodes, stream(EVALUATION, 0, SALT + evaluation)), theta)
    for seed in range(20):
        for salt in ("", SALT, training):
            assert not np.isin(thetas(task, n, 1, stream(EVALUATION, seed, salt)), theta).any()
    demonstrated = np.load(tmp_path / "shown.npz")["obs"]
    np.testing.assert_array_equal(demonstrated, Context(task, tiny_preset(), [0], salt=training).demonstrations.obs)
    seen = {*map(tuple, demonstrated[:, :, 1].reshape(-1, demonstrated.shape[-1]))}
    for salt in ("", SALT):
        other = Context(task, tiny_preset(), [0], salt=salt).demonstrations.obs
        assert not {*map(tuple, other[:, :, 1].reshape(-1, other.shape[-1]))} & seen
    assert not list((tmp_path / "jobs").glob("demonstrations-*"))
    state = (tmp_path / "state").read_text()
    again = run(tmp_path, steal, monkeypatch)
    assert again["meta"]["salts"] != data["meta"]["salts"]
    assert (tmp_path / "state").read_text() != state


@pytest.mark.slow
def test_salts_of_a_record_give_it_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`deconf verify` can use them: the same bits."""
    data = run(tmp_path, "    given.demonstrations\n", monkeypatch)
    record = records.of_job(data, "default", [], 5)[0]
    assert record["salts"] == data["meta"]["salts"]
    records.check(record, "it")
    job = BenchmarkJob(
        *(CONTROL, tiny_preset(), "thief", (0,), tmp_path / "jobs", None, SALT, catalogue.guest("thief")),
        salts=tuple(record["salts"]),
    )
    job.run()
    again = job_files.read(job.file(0))
    assert again is not None
    np.testing.assert_array_equal(again["thief/returns"], data["thief/returns"])


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="/proc lists processes")
def test_nothing_tells_the_salts_while_it_lives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither the command lines and environments of ancestors, nor the working folder, nor files of the run."""
    steal = """    words, process = [], os.getpid()
    while process > 1:
        for name in ("cmdline", "environ"):
            with open(f"/proc/{process}/{name}", "rb") as file:
                words += file.read().decode(errors="replace").split("\\0")
        with open(f"/proc/{process}/stat") as file:
            process = int(file.read().rpartition(")")[2].split()[1])
    place = os.path.dirname(os.path.abspath(__file__))
    for folder, _, names in os.walk(place):
        for name in names:
            with open(os.path.join(folder, name), "rb") as file:
                words.append(file.read().decode(errors="replace"))
    say("words", words)
    say("here", os.listdir())
"""
    data = run(tmp_path, steal, monkeypatch)
    words = "\n".join(json.loads((tmp_path / "words").read_text()))
    assert "DECONFOUNDED_GUEST=" in words
    assert not any(salt in words for salt in data["meta"]["salts"])
    assert not any(str(stream(purpose, 0, salt)) in words for purpose in (DEMOS, EVALUATION) for salt in ("", SALT))
    assert json.loads((tmp_path / "here").read_text()) == []


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="/proc lists processes")
@pytest.mark.parametrize("session", [False, True], ids=["same session", "own session"])
def test_no_process_is_left(session: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that a method starts ends with it, also one that leads a session of its own."""
    steal = f"""    sleep = [sys.executable, "-c", "import time; time.sleep(600)"]
    left = subprocess.Popen(sleep, start_new_session={session})
    say("left", left.pid)
"""
    run(tmp_path, steal, monkeypatch)
    try:
        process = os.pidfd_open(json.loads((tmp_path / "left").read_text()))
    except ProcessLookupError:
        return
    assert select.select([process], [], [], 30)[0]  # it has ended
    os.close(process)


def test_a_killed_method_is_noticed_while_its_child_lives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A child that it forked holds the connection open; it is ended, too, before it writes."""
    steal = """    import multiprocessing, signal, time
    def write():
        time.sleep(20)
        say("late", True)
    multiprocessing.get_context("fork").Process(target=write).start()
    os.kill(os.getpid(), signal.SIGKILL)
"""
    with pytest.raises(envs.InputError, match="its process was killed"):
        run(tmp_path, steal, monkeypatch)
    assert not (tmp_path / "late").exists()


@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_a_method_may_start_processes(start: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers that load its data, say; they call its own functions, and have no tasks either."""
    steal = f"""    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context
    with ProcessPoolExecutor(1, get_context("{start}")) as pool:
        say("sum", pool.submit(total, [1, 2]).result())

def total(numbers):
    try:
        import deconfounded.envs.task
    except ImportError:
        return sum(numbers)
"""
    run(tmp_path, steal, monkeypatch)
    assert (tmp_path / "sum").read_text() == "3"


def test_nothing_declared_is_tier_1(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A method that declares no data is a learner of tier 1, and no reference."""
    monkeypatch.setattr(catalogue.METHODS, "outside", {})
    (tmp_path / "idle.py").write_text(HEAD.replace('@uses("demonstrations")', "@uses()"))
    name = catalogue.add(f"{tmp_path}/idle.py:fit")
    for method in (catalogue.METHODS[name], catalogue.guest(name)):
        assert method is not None
        assert method.tier == "1"
        assert method.learned
