"""Tasks, methods and experts from somebody's own folder, which has an envs/ and a benchmarks/ of its own; docs/'s."""

import contextlib
import errno
import hashlib
import importlib
import importlib.metadata
import json
import os
import queue
import re
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import deconfounded
from deconfounded import envs
from deconfounded.benchmarks import certify, check, play, push
from deconfounded.benchmarks.console import run_command
from deconfounded.benchmarks.engine import catalogue, identity, presets, progress, sources
from deconfounded.benchmarks.engine.benchmark import BenchmarkJob, evaluate
from deconfounded.benchmarks.engine.context import DEMOS, EVALUATION, Context, stream
from deconfounded.benchmarks.engine.guest_host import Guest
from deconfounded.benchmarks.engine.provider import Provider, fit
from deconfounded.deconf import methods, wire
from deconfounded.deconf.core.agents import LearnedAgent
from deconfounded.deconf.given import Given
from deconfounded.deconf.guest import ChannelAsk, ChannelMonitor, live, serve
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods import memoryless_bc, naive_rnn
from deconfounded.deconf.methods.sequence_bc import RecurrentConfig
from deconfounded.deconf.wall import Wall, refuse_imports
from deconfounded.envs import registry
from deconfounded.envs.streams import Array, Mask
from deconfounded.envs.support import outside
from deconfounded.envs.support.files import read_sealed, write_sealed
from deconfounded.envs.tasks.bandit import Bandit
from deconfounded.experts import policy, saved_agents
from deconfounded.experts.agent import Agent, RandomAgent
from deconfounded.experts.rollout import run_trials
from deconfounded.experts.trials import Trials
from tests import toys
from tests.tools import deconf, tiny_preset

ROOT = Path(__file__).parents[2]
CONTROL = "slippery_cartpole"
BENT = "bent_cartpole.py:BentCartpole"


def snippets(page: str, language: str = "python") -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / page).read_text(), re.S)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The task, expert and method of docs/, and packages that would be in the way."""
    made = tmp_path_factory.mktemp("own")
    task, expert = snippets("docs/own_task.md")
    (made / "bent_cartpole.py").write_text(task)
    (made / "bent_cartpole.xml").write_text(*snippets("docs/own_task.md", "xml"))
    (made / "linear.py").write_text(expert)
    (method,) = snippets("docs/own_method.md")
    (made / "my_rnn.py").write_text(method.replace('{"updates": 20}', '{"updates": 2}'))
    for name in ("envs", "benchmarks", "experts", "deconf"):
        (made / name).mkdir()
        (made / name / "__init__.py").write_text("raise RuntimeError('somebody else's')")
    return made


def deconf_process(folder: Path, *args: str) -> subprocess.CompletedProcess[str]:
    environ = {**os.environ, "MUJOCO_GL": "off", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "deconfounded", *args]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, env=environ, timeout=300)


FLAT = """
import numpy as np

from tests.toys import Push

class Flat(Push):
    name = "flat"
    observation = {"x": (-9.0, 9.0), "velocity": (-9.0, 9.0)}

    def reward(self, state, action, next_state, theta):
        return np.ones(len(state))

    def terminated(self, state):
        return state[:, 0] > 1e9
"""


def test_nothing_is_trained_where_the_expert_is_no_better(tmp_path: Path) -> None:
    """Of a reward that is the same whatever one does; random actions and the expert are rolled out before."""
    (tmp_path / "own.py").write_text(FLAT)
    small = ("--preset", "smoke", "--set", "eval_trials=4", "expert_trials=4")
    own = ("--task", "own.py:Flat", "--expert", "tests.toys:control")
    done = deconf(tmp_path, "run", *own, "--methods", "blind_bc", *small)
    assert done.returncode == 2
    assert "flat: the expert returns 7 an episode, random actions 7; scores need an expert" in done.stderr
    made = {file.name for file in (tmp_path / "results").rglob("*.npz")}
    assert made == {"demonstrations-0.npz", "expert-0.npz", "random-0.npz"}


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
def test_run_play_score(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run of one's own task with one's own expert and method; its agents are then played, and scored anew."""
    assert len([line for line in (folder / "my_rnn.py").read_text().splitlines() if line]) <= 60
    monkeypatch.setenv("MUJOCO_GL", "off")
    small = ("--preset", "smoke", "--set", "eval_trials=4", "expert_trials=8", "blind_bc.updates=5")
    mine = ("--task", BENT, "--expert", "linear.py:control")
    done = deconf_process(folder, "run", *mine, "--methods", "my_rnn.py:fit", "blind_bc", *small)
    assert done.returncode == 0, done.stderr
    run = folder / "results" / "bent_cartpole-smoke"
    results = json.loads((run / "results.json").read_text())
    assert results["set"] == ["eval_trials=4", "expert_trials=8", "blind_bc.updates=5"]
    assert results["expert"] == sources.digest([folder / "linear.py"], "control")
    assert results["methods"]["my_rnn"]["tier"] == "1"
    assert results["methods"]["my_rnn"]["budget"] == {"expert_trials": 8}
    kept = deconfounded.load(run / "agents" / "my_rnn-0")
    kept.begin(3)
    kept.reset([])
    assert kept.act(np.zeros((3, 5), np.float32)).shape == (3, 1)
    again = deconf(folder, "run", *mine, "--methods", "my_rnn.py:fit", "blind_bc", *small, "--resume")
    assert again.returncode == 0, again.stderr
    assert "seed 0:" not in again.stdout
    without = deconf(folder, "run", *mine, "--methods", "blind_bc", *small, "--resume")
    assert "my_rnn" in without.stdout, without.stderr

    agent = ("--agent", str(run / "agents" / "blind_bc-0"))
    played = deconf(folder, "play", *agent, "--task", BENT, "--theta", "0.2", "--episodes", "2")
    assert re.search(r"bend 0\.2 rad: returns [\d.]+ [\d.]+$", played.stdout.strip()), played.stderr
    scored = deconf(folder, "score", *agent, *mine, "--trials", "4", "--range", "bend=0.4:0.5", "--out", "s.json")
    assert scored.returncode == 0, scored.stderr
    scores = json.loads((folder / "s.json").read_text())
    assert len(scores["score"]) == 5
    wrong = deconf(folder, "play", *agent, "--task", "bandit")
    assert wrong.returncode == 2
    assert wrong.stderr.startswith("error: the agent in ")

    with (folder / "linear.py").open("a") as file:
        file.write("# a comment\n")
    same = deconf(folder, "run", *mine, "--methods", "blind_bc", *small, "--resume")
    assert same.returncode == 0, same.stderr
    with (folder / "linear.py").open("a") as file:
        file.write("ANOTHER = 1\n")
    changed = deconf(folder, "run", *mine, "--methods", "blind_bc", *small, "--resume")
    assert "holds a run that differs in its expert" in changed.stderr
    assert not list((ROOT / "assets").rglob("bent_cartpole*"))


@pytest.mark.slow
def test_check(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The task of docs/ holds the whole contract; one that gives theta away does not."""
    assert len((folder / "bent_cartpole.py").read_text().splitlines()) <= 60
    leaky = "from bent_cartpole import BentCartpole\nclass Leaky(BentCartpole):\n    name = 'leaky'\n"
    leaky += "    process_noise = {**BentCartpole.process_noise, 'hinge': (0, 0)}\n"
    (folder / "leaky.py").write_text(leaky)
    (folder / "leaky.xml").write_text((folder / "bent_cartpole.xml").read_text())
    for file, code in ((BENT, 0), ("leaky.py:Leaky", 1)):
        monkeypatch.setattr("sys.argv", ["deconf check", "--task", f"{folder}/{file}"])
        with pytest.raises(SystemExit) as ended:
            check.main()
        output = capsys.readouterr().out
        assert ended.value.code == code, output
        assert ("FAIL" in output) == bool(code)
    assert "FAIL noise_covers_every_coordinate_that_matters: theta moves a coordinate without process noise" in output


@pytest.mark.slow
def test_loop_of_deploy(tmp_path: Path) -> None:
    """Ten lines that deploy an agent."""
    agent = fit(Context(envs.get(CONTROL), tiny_preset(), [0]), "deconfounded")
    assert isinstance(agent, LearnedAgent)
    agent.save(tmp_path / "results" / "slippery_cartpole-default" / "agents" / "deconfounded-0")
    (code,) = snippets("docs/deploy.md")
    environ = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, env=environ)
    assert done.returncode == 0, done.stderr


def test_method_of_readme() -> None:
    """It clones: its actions are nearer to the expert's than their mean is."""
    (code,) = (code for code in snippets("README.md") if "def fit" in code)
    space: dict[str, Any] = {}
    exec(code, space)
    context = Context(envs.get(CONTROL), tiny_preset(), [0])
    trials = context.demonstrations
    agent = space["fit"](SimpleNamespace(demonstrations=trials))
    assert space["fit"].method.uses == ("demonstrations",)
    obs, action = trials.obs[:, :, :-1][trials.mask], trials.action[trials.mask]
    assert np.square(agent.act(obs) - action).mean() < 0.8 * action.var()
    assert np.abs(agent.act(10 * obs)).max() == 1


def test_readme_is_short() -> None:
    """A newcomer reads it to the end."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 160
    assert len(text.split()) <= 1300


@pytest.mark.slow
def test_task_from_outside(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is known by its name from then on, to gymnasium too; its weights are looked for beside it."""
    monkeypatch.setattr(memoryless_bc, "MemorylessConfig", partial(memoryless_bc.MemorylessConfig, updates=20))
    task = envs.get(f"{folder}/{BENT}")
    assert task.name == "bent_cartpole"
    assert task.reference == f"{folder}/{BENT}"
    assert policy.path(task) == folder / "bent_cartpole.safetensors"
    assert type(envs.get("bent_cartpole")) is type(task)
    with pytest.raises(
        envs.InputError,
        match=r"`deconf train --task .*bent_cartpole.py:BentCartpole --out .*` makes such",
    ):
        policy.load(task)
    expert = policy.load(task, f"{folder}/linear.py:control")
    result = certify.certify(task, expert, trials=4, grid=3)
    assert result["return_expert"] > 2 * result["return_random"]


def test_an_expert_s_mean_has_no_noise(tmp_path: Path) -> None:
    """The task adds it; a second noise would not be in the density of Eq. (1)."""
    noisy = "import numpy as np\nrng = np.random.default_rng(0)\ndef act(obs, theta):\n"
    (tmp_path / "noisy.py").write_text(f"{noisy}    return rng.uniform(-1, 1, (len(obs), 1))")
    with pytest.raises(envs.InputError, match=r"noisy\.py:act gave two actions for one observation"):
        policy.load(toys.Push(), f"{tmp_path}/noisy.py:act")


def test_an_error_of_own_code_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It names the place; and a module that is missing there is none of ours."""
    (tmp_path / "mine.py").write_text("def broken():\n    import pygletty\n")
    broken = outside.find("task", f"{tmp_path}/mine.py:broken")
    with pytest.raises(SystemExit) as stopped:
        run_command(broken)
    assert stopped.value.code == 2
    said = capsys.readouterr().err
    assert said == "error: No module named 'pygletty' (ModuleNotFoundError, mine.py:2)\n"


@pytest.mark.parametrize("where", ["../tank", "./tank", "here/tank"])
def test_a_file_s_path_ends_in_py(where: str) -> None:
    with pytest.raises(envs.InputError, match=rf"a file's path must end in \.py, as {re.escape(where)}\.py:LeakyTank"):
        outside.find("task", f"{where}:LeakyTank")


def test_a_file_s_name_is_no_module_s(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_tank.py").write_text("")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(envs.InputError, match=r"No module named 'own_tank'.*must end in \.py, as own_tank\.py"):
        outside.find("task", "own_tank:LeakyTank")


def test_tasks_that_packages_offer(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the name of their entry point; a name of ours is ours."""
    points = [
        SimpleNamespace(name="their_drift", value="tests.toys:Drift"),
        SimpleNamespace(name="bandit", value="no:Way"),
    ]
    monkeypatch.setattr(registry, "entry_points", lambda group: points if group == "deconfounded.tasks" else [])
    assert "their_drift" in envs.names()
    assert envs.names().count("bandit") == 1
    assert type(envs.get("their_drift")) is toys.Drift
    assert type(envs.get("bandit")) is Bandit


TOY = "from tests.toys import Push\nclass Task(Push):\n    name = 'mine'\n"


@pytest.mark.parametrize(
    ("text", "name", "says"),
    [
        ("x = 1", "Task", "has no 'Task'; it has x"),
        ("import math\nfrom pathlib import Path\nclass Mine:\n    pass", "Task", "has no 'Task'; it has Mine$"),
        ("from deconfounded.envs import InputError\nraise InputError('odd')", "Task", r"odd \(mine\.py:2\)"),
        ("Task = 3", "Task", "is 3; it must be a subclass of deconfounded.envs.Task"),
        ("import numpy as np\nTask = np.arange(3)", "Task", r"is array\(\[0, 1, 2\]\); it must be a subclass of"),
        ("1 / 0", "Task", r"division by zero \(ZeroDivisionError, mine.py:1\)"),
        ("import nonsuch", "Task", "No module named 'nonsuch'"),
        ("x = 1\ndef f(:", "Task", r"invalid syntax \(SyntaxError, mine.py:2\)"),
        ("open('gone.txt')", "Task", r"gone.txt' \(FileNotFoundError, mine.py:1\)"),
        ("raise SystemExit('bye')", "Task", r"bye \(SystemExit, mine.py:1\)"),
        ("from deconfounded.envs.tasks.cartpole import Cartpole as Task", "Task", "name of Cartpole in .* was None"),
        (
            "from deconfounded.envs import Task as T\nclass Task(T):\n    name = 'mine'",
            "Task",
            "task mine of .* lacks appl",
        ),
        (
            "from deconfounded.envs.tasks.bandit import Bandit\nclass Task(Bandit):\n    name = 'Odd name!'",
            "Task",
            "'Odd name!'; it",
        ),
        (
            "from deconfounded.envs.tasks.bandit import Bandit\nclass Task(Bandit):\n    name = 'tilted_cartpole'",
            "Task",
            "'tilted_cartpole' of .* is taken by .*; give it another name",
        ),
        (
            f"{TOY}    latents = ('force',)",
            "Task",
            r"latents of mine were \('force',\); they must be a tuple of Latent",
        ),
        (f"{TOY}    latents = ()", "Task", r"latents of mine were \(\); they must be a tuple of Latent"),
        (f"{TOY}    latents = list(Push.latents)", "Task", r"latents of mine were \[Latent.*; they must be a tuple"),
        (f"{TOY}    latents = Push.latents * 2", "Task", "latents of mine were called force, force; each must"),
    ],
)
def test_a_bad_file_is_one_line(tmp_path: Path, text: str, name: str, says: str) -> None:
    """The same where it is asked for again: it is executed anew."""
    (tmp_path / "mine.py").write_text(text)
    for _ in range(2):
        with pytest.raises(envs.InputError, match=says) as caught:
            envs.get(f"{tmp_path}/mine.py:{name}")
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("reference", "says"), [("gone.py:T", "there is no file gone.py"), (":T", "must be path/file.py:name")]
)
def test_a_bad_reference_is_one_line(reference: str, says: str) -> None:
    with pytest.raises(envs.InputError, match=says):
        envs.get(reference)


def test_an_expert_is_its_function_and_its_files(tmp_path: Path) -> None:
    """Two functions of one file are two experts; a change in what the file imports makes another one."""
    (tmp_path / "gain.py").write_text("GAIN = 1")
    text = "import gain\ndef strong(obs, theta): return obs[:, :1]\ndef weak(obs, theta): return 0 * obs[:, :1]\n"
    (tmp_path / "two.py").write_text(text)
    task = envs.get(CONTROL)
    seen = {identity.expert(task, f"{tmp_path}/two.py:{name}")["expert"] for name in ("strong", "weak")}
    (tmp_path / "gain.py").write_text("GAIN = 2")
    seen.add(identity.expert(task, f"{tmp_path}/two.py:strong")["expert"])
    assert len(seen) == 3


def test_experts_get_copies_seed_by_seed(tmp_path: Path) -> None:
    """What they do to what they are given is their own business; rows come out as they would group by group."""
    code = "seen = []\ndef control(obs, theta):\n    seen.append(len(obs))\n"
    (tmp_path / "mine.py").write_text(f"{code}    theta *= 0\n    obs *= 0\n    return obs[:, :1]\n")
    expert = policy.load(envs.get(CONTROL), f"{tmp_path}/mine.py:control")
    assert isinstance(expert, policy.CallableExpert)
    obs, theta = np.ones((6, 6)), np.ones((6, 1))
    expert.mean(obs, theta, groups=2)
    assert obs.all()
    assert theta.all()
    assert expert.call.__globals__["seen"][-2:] == [3, 3]  # type: ignore[attr-defined]


def test_an_expert_need_not_know_zeros(tmp_path: Path) -> None:
    """It is tried where an episode starts: sines and cosines of one angle, say, are never both 0."""
    code = "import numpy as np\ndef control(obs, theta):\n    unit = obs / np.square(obs).sum(-1, keepdims=True)\n"
    (tmp_path / "mine.py").write_text(f"{code}    return unit[:, :1]\n")
    policy.load(envs.get(CONTROL), f"{tmp_path}/mine.py:control")


@pytest.mark.parametrize(
    ("code", "says"),
    [
        ("return np.zeros(3)", r"gave shape \(3,\) for 2 observations; it must be \(2, 1\), finite"),
        ("return np.full((len(obs), 1), np.nan)", "gave NaN or infinity"),
        ("theta *= 0; return np.full((len(obs) + 1, 1), 0.0)", r"gave shape \(3, 1\)"),
        ("return obs.nonsuch", r"nonsuch' \(AttributeError, mine.py:3\)"),
        (
            "return np.zeros((len(obs), 1)), None",
            "gave a tuple; .* of what `predict` of Stable-Baselines3 returns, the f",
        ),
        ("return None", r"gave shape \(1,\) for 2 observations"),
    ],
)
def test_a_bad_expert_is_one_line(tmp_path: Path, code: str, says: str) -> None:
    (tmp_path / "mine.py").write_text(f"import numpy as np\ndef control(obs, theta):\n    {code}\n")
    with pytest.raises(envs.InputError, match=says):
        policy.load(envs.get(CONTROL), f"{tmp_path}/mine.py:control")


@pytest.mark.parametrize("name", ["mine.py", "model.zip"])
def test_a_file_that_is_no_expert(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("")
    with pytest.raises(envs.InputError, match=r"it must be weights.safetensors, or path/file.py:name of a callable"):
        policy.load(envs.get(CONTROL), tmp_path / name)


def test_a_plug_in_s_own_packages_come_before_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`benchmarks` of its folder is what it imports by that name, though a checkout of ours may be on the path."""
    (tmp_path / "benchmarks").mkdir()
    (tmp_path / "benchmarks" / "__init__.py").write_text("")
    (tmp_path / "benchmarks" / "gains.py").write_text("K = -3.0\n")
    text = "from benchmarks.gains import K\ndef control(obs, theta): return K * obs[:, :1]\n"
    (tmp_path / "mine.py").write_text(text)
    elsewhere = [entry for entry in sys.path if not (Path(entry) / "benchmarks").is_dir()]
    monkeypatch.setattr(sys, "path", [str(ROOT), *elsewhere])
    monkeypatch.setattr(outside, "FOLDERS", set())
    try:
        control = outside.find("expert", f"{tmp_path}/mine.py:control")
    finally:
        for name in ("benchmarks", "benchmarks.gains"):
            sys.modules.pop(name, None)
    assert control(np.ones((2, 3)), None).tolist() == [[-3.0], [-3.0]]


def test_a_method_that_died_while_it_was_answered() -> None:
    """Its end is said, as where it is listened to."""

    class Broken:
        def send(self, message: object) -> None:
            raise BrokenPipeError

    ended = subprocess.Popen([sys.executable, "-c", "import os; os._exit(3)"])
    guest = object.__new__(Guest)
    guest.name, guest.channel, guest.process = "mine", Broken(), ended  # type: ignore[assignment]
    with pytest.raises(envs.InputError, match=r"^method mine: its process ended with status 3$"):
        guest._do("act")


HEAD = """
import numpy as np
from deconfounded.deconf.method import uses
from deconfounded.experts.agent import Agent

class Still(Agent):
    def begin(self, n): self.n = n
    def reset(self, rngs): pass
    def act(self, obs): return np.zeros((len(obs), 1))

"""


def guest(folder: Path, text: str, task: str = CONTROL, *uses: str) -> tuple[Context, Guest]:
    """A method of that text, fitted."""
    (folder / "mine.py").write_text(HEAD + text)
    context = Context(envs.get(task), tiny_preset(), [0])
    return context, Guest(context, "mine", f"{folder}/mine.py:fit", uses)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("def fit(given): import sys; sys.exit(0)", r"0 \(SystemExit, mine.py:11\)"),
        ("def fit(given): raise EOFError('mine')", r"mine \(EOFError, mine.py:11\)"),
        ("def fit(given): given.progress(float('nan'))", "progress was nan, {}; it must be finite numbers"),
        ("def fit(given): given._ask('environment')", "it asked for environment, and declares"),
        ("def fit(given): open('w.npy')", r".*'w.npy' .*, mine.py:11\); a method .*: give the file's whole path"),
        ("def fit(given): open('/gone/w.npy')", r".*/gone/w.npy' \(FileNotFoundError, mine.py:11\)(?!;)"),
        ("def fit(given): return 3", "it returned 3; it must return a deconfounded.experts.agent.Agent"),
        ("def fit(given): 1 / 0", r"division by zero \(ZeroDivisionError, mine.py:11\)"),
        ("def fit(given): given.query()", "it asked for queries, and declares that it uses demonstrations"),
        ("def fit(given): import os; os._exit(3)", "its process ended with status 3$"),
        ("def fit(given): import os; 1 / os.get_inheritable(given._ask._channel.fileno())", "division by zero"),
        ("def fit(given): import os; os.kill(os.getpid(), 9)", r"its process was killed \(out of memory\?\)"),
        ("def fit(given): import os; os.kill(os.getpid(), 11)", "its process was ended by signal 11$"),
        ("def fit(given): given.explore(3)", "agent of exploration was 3; it must be an Agent, or None"),
        ("def fit(given): np.linalg.inv(np.zeros((2, 2)))", r"Singular matrix \(LinAlgError, mine.py:11\)"),
        ("def fit(given): given.explore(trials=0)", "asked for exploration, and declares"),
    ],
)
def test_a_bad_method_is_one_line(tmp_path: Path, text: str, says: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a temporary folder of a long name, too, as clusters have them; a socket's is at most 108 characters."""
    (scratch := tmp_path / ("long" * 25)).mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    with pytest.raises(envs.InputError, match=f"method mine: {says}" if "trials=0" not in text else says) as caught:
        guest(tmp_path, text, CONTROL, "demonstrations")
    assert "\n" not in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            "    def act(self, obs): return np.zeros(3)",
            r"actions of shape \(3,\) for 4 obs.*; they must be \(4, 1\), finite",
        ),
        ("    def act(self, obs): return np.full((len(obs), 1), np.nan)", "actions of NaN or infinity"),
        ("    def act(self, obs): return [[1], [1, 2]]", r"gave a list for actions; they must be an array \(4, 1\)"),
        ("    def act(self, obs): pass", "gave None for actions"),
        ("    def act(self, obs): return Thief()", "it gave Thief; it must be numbers, or arrays of them"),
        ("    def features(self): return np.full((4, 2), np.nan)", "gave features of NaN or infinity"),
        (
            "    def features(self): return np.zeros((1, 2))",
            r"of shape \(1, 2\); .* of shape \(4, F\), F from 1 up",
        ),
        ("    def features(self): return np.zeros((4, 0))", r"gave features of shape \(4, 0\)"),
        ("    def begin(self, n): raise ValueError('no')", r"no \(ValueError, mine.py:\d+\)"),
    ],
)
def test_what_an_agent_sends_is_looked_at(tmp_path: Path, text: str, says: str) -> None:
    """And never run here: an object that would do something when it is unpickled does nothing."""
    thief = f"class Thief:\n    def __reduce__(self): return (open, ({str(tmp_path / 'stolen')!r}, 'w'))\n"
    method = f"{thief}\nclass Odd(Still):\n{text}\n\ndef fit(given): return Odd()"
    context, agent = guest(tmp_path, method)
    with pytest.raises(envs.InputError, match=f"^method mine.*({says})") as caught:
        evaluate(context, agent, True)
    agent.close()
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "stolen").exists()


def test_a_stubborn_guest_goes(tmp_path: Path) -> None:
    """One that does not heed signals, too."""
    text = "import signal, threading\ndef fit(given):\n    signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
    text += "    threading.Thread(target=threading.Event().wait).start()\n    return Still()"
    _, agent = guest(tmp_path, text)
    agent.close()
    assert agent.process.poll() is not None


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="/proc lists processes")
def test_nothing_is_left_of_a_guest_whose_run_is_killed(tmp_path: Path) -> None:
    """Its standard input closes then: it, what it started in a session of its own, and its folder are gone."""
    text = "import subprocess\ndef fit(given):\n    open('log.txt', 'w').close()\n"
    text += "    left = subprocess.Popen(['sleep', '600'], start_new_session=True)\n"
    text += f"    open({str(tmp_path / 'left')!r}, 'w').write(str(left.pid))\n    return Still()"
    _, agent = guest(tmp_path, text)
    sleep, folder = os.pidfd_open(int((tmp_path / "left").read_text())), Path(agent.folder.name)
    assert (folder / "log.txt").exists()
    assert agent.process.stdin is not None
    agent.process.stdin.close()
    assert agent.process.wait(30) == -signal.SIGKILL
    assert select.select([sleep], [], [], 30)[0]  # it has ended
    os.close(sleep)
    assert not folder.exists()
    agent.close()


class TestWire:
    def test_there_and_back(self) -> None:
        arrays = [np.arange(6.0).reshape(2, 3), np.zeros((0, 2), np.float32), np.array([True, False]), np.array(3)]
        back = wire.unpack(wire.pack(["act", None, 1.5, {"a": arrays}, (1, np.float32(2))]))
        assert back[:3] == ["act", None, 1.5]
        assert back[4] == [1, 2.0]
        for one, other in zip(back[3]["a"], arrays, strict=True):
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)

    def test_damaged(self) -> None:
        whole = wire.pack(["act", np.arange(3.0)])
        for data in (b"", whole[:-1], whole[:20], b"\0" * 40, whole.replace(b"<f8", b"|O8")):
            with pytest.raises(envs.InputError, match="cannot be read"):
                wire.unpack(data)
        with pytest.raises(envs.InputError, match="it gave object"):
            wire.pack(object())

    def test_what_is_read_may_be_changed(self) -> None:
        assert wire.unpack(wire.pack(np.array(3.0))).shape == ()
        back = wire.unpack(wire.pack(np.zeros(3)))
        back += 1
        assert back.tolist() == [1, 1, 1]


class Scripted:
    """A connection whose other end says what is given; `sent` is what it hears."""

    def __init__(self, *messages: Any) -> None:
        self.messages, self.sent = list(messages), list[Any]()

    def recv(self) -> Any:
        if not self.messages:
            raise EOFError
        return self.messages.pop(0)

    def send_bytes(self, data: bytes) -> None:
        self.sent.append(wire.unpack(data))


class TestEndOfGuest:
    """A guest's end of the connection, in this process."""

    about = {
        **{"observations": 2, "action_space": Bandit.action_space, "episodes": 1, "horizon": 3, "fresh": False},
        **{"config": {}, "rng": 0},
    }

    def lived(self, folder: Path, text: str, *messages: Any, **about: Any) -> list[Any]:
        """What a method of that text sends."""
        channel: Any = Scripted(*messages)
        (folder / "mine.py").write_text(HEAD + text)
        live(f"{folder}/mine.py:fit", channel, {**self.about, **about})
        return channel.sent

    def test_progress_is_a_share(self) -> None:
        channel: Any = Scripted()
        ChannelMonitor(channel).update(3, 4, {"imitation": 0.5})
        assert channel.sent == [["progress", 0.75, {"imitation": 0.5}]]

    def test_its_agent_asks_for_nothing_while_it_is_rolled_out(self) -> None:
        """Afterwards the method may ask again."""
        channel: Any = Scripted(("act", np.zeros((1, 2))), ("over", 3))
        ask = ChannelAsk(channel)
        agent: Any = SimpleNamespace(act=lambda obs: ask("queries"))
        with pytest.raises(envs.InputError, match="queries were asked for by an agent's method"):
            ask("exploration", None, agent=agent)
        assert ask("demonstrations") == 3
        assert channel.sent == [["exploration", True, None], ["demonstrations", False]]

    def test_nothing_is_asked_for_after_fitting(self, tmp_path: Path) -> None:
        text = "class Asks(Still):\n    def __init__(self, given): self.given = given\n"
        text += "    def act(self, obs): return self.given.explore()\ndef fit(given): return Asks(given)"
        fitted, failed = self.lived(tmp_path, text, ("act", np.zeros((1, 2))))
        assert fitted == ["fitted"]
        assert failed[0] == "failed"
        assert "exploration were asked for by an agent's method, or after fitting" in failed[1]

    def test_its_configuration_is_that_of_the_run(self, tmp_path: Path) -> None:
        text = "from deconfounded.deconf.methods.memoryless_bc import MemorylessConfig\n"
        text += "@uses('demonstrations', on_control=MemorylessConfig())\n"
        text += "def fit(given): given.progress(0.0, updates=given.config.updates)"
        assert self.lived(tmp_path, text, config={"updates": 7})[0] == ["progress", 0.0, {"updates": 7}]

    def test_random_numbers_are_of_the_seeds_that_it_is_sent(self) -> None:
        drawn: list[float] = []
        agent: Any = SimpleNamespace(reset=lambda rngs: drawn.extend(rng.random() for rng in rngs))
        channel: Any = Scripted(("reset", [3, 4]), ("over", None))
        serve(channel, agent)
        assert drawn == [np.random.default_rng(seed).random() for seed in (3, 4)]

    def test_its_cost_is_cpu_time(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("time.process_time", lambda: 5.0)
        channel: Any = Scripted(("act", np.zeros((1, 2))), ("over", None))
        agent: Any = SimpleNamespace(act=lambda obs: obs)
        serve(channel, agent)
        assert channel.sent[0][2] == 5

    @pytest.mark.parametrize(
        ("module", "closed"),
        [
            *((f"deconfounded.{name}", True) for name in ("envs.task", "benchmarks.engine.context", "deconf.exact")),
            *((f"deconfounded.experts.{name}", True) for name in ("policy", "sb3", "train", "datasets.rows")),
            *((name, True) for name in ("mujoco", "dm_control.suite")),
            *((f"deconfounded.envs.{name}", False) for name in ("streams", "support.errors")),
            *((f"deconfounded.{name}", False) for name in ("experts.trials", "deconf.methods.dagger")),
        ],
    )
    def test_what_it_may_import(self, module: str, closed: bool) -> None:
        """No task, no expert, no simulator, and no exact posterior, which needs them."""
        if closed:
            with pytest.raises(ImportError, match=f"{module} cannot be imported here"):
                Wall().find_spec(module)
        else:
            Wall().find_spec(module)


def test_the_wall_is_asked_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the finder that would find the module."""
    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path])
    monkeypatch.setitem(sys.modules, "deconfounded.envs", sys.modules["deconfounded.envs"])
    monkeypatch.delitem(sys.modules, "mujoco.viewer", raising=False)
    refuse_imports()
    with pytest.raises(ImportError, match=r"mujoco\.viewer cannot be imported here"):
        importlib.import_module("mujoco.viewer")


@pytest.mark.slow
def test_methods_from_outside_may_build_on_ours() -> None:
    """Networks, beliefs and methods can be imported behind the wall, but those that need a simulator."""
    folder = Path(deconfounded.__file__).parent / "deconf"
    names = [
        f"deconf.{each.parent.name}.{each.stem}"
        for part in ("core", "methods")
        for each in (folder / part).glob("*.py")
    ]
    assert {"deconf.core.data", "deconf.methods.naive_rnn", "deconf.methods.references"} < {*names}
    program = f"""
import importlib
from deconfounded.deconf.wall import refuse_imports
refuse_imports()
for name in {sorted(names)}:
    try:
        importlib.import_module("deconfounded." + name)
    except ImportError as error:
        print(name)
"""
    closed = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert closed.split() == ["deconf.methods.gail_ppo", "deconf.methods.references"]


def test_methods_declare_what_they_use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(catalogue.METHODS, "outside", {})
    (tmp_path / "mine.py").write_text("def fit(given): pass")
    with pytest.raises(envs.InputError, match=r"must be a function declared with @uses"):
        catalogue.add(f"{tmp_path}/mine.py:fit")
    (tmp_path / "other.py").write_text(HEAD + "@uses('the_test_set')\ndef fit(given): pass")
    with pytest.raises(envs.InputError, match=r"'the_test_set'; it may use demonstrations, .*\(other\.py:\d"):
        catalogue.add(f"{tmp_path}/other.py:fit")
    for name in ("demonstrations", "deconfounded_episode"):
        (tmp_path / f"{name}.py").write_text(HEAD + "@uses()\ndef fit(given): pass")
        with pytest.raises(envs.InputError, match=f"would be called {name}, which there is already"):
            catalogue.add(f"{tmp_path}/{name}.py:fit")
    (tmp_path / "plain.py").write_text(HEAD + "@uses('environment')\ndef fit(given): pass")
    with pytest.raises(envs.InputError, match="a method uses 'environment'"):
        catalogue.add(f"{tmp_path}/plain.py:fit")
    (tmp_path / "naive_rnn.py").write_text(HEAD + "@uses()\ndef fit(given): pass")
    with pytest.raises(envs.InputError, match="would be called naive_rnn, which there is already"):
        catalogue.add(f"{tmp_path}/naive_rnn.py:fit")
    (tmp_path / "fine.py").write_text(HEAD + "@uses('queries', 'theta')\ndef best(given): pass")
    assert catalogue.add(f"{tmp_path}/fine.py:best") == "fine_best"
    assert catalogue.METHODS["fine_best"].tier == "sees theta"


@pytest.mark.slow
def test_guests_get_what_ours_get(tmp_path: Path) -> None:
    """Demonstrations, theta, explorations and queries: bit for bit those of the context, and counted."""
    text = """
@uses("demonstrations", "exploration", "queries", "theta")
def fit(given):
    demonstrations, theta = given.demonstrations, given.theta
    free, (asked, labels) = given.explore(), given.query(Still(), 3)
    np.savez("%s", demonstrations=demonstrations.obs, theta=theta, free=free.obs, asked=asked.action, labels=labels)
    given.progress(1.0, imitation=0.5)
    return Still()
"""
    out = tmp_path / "seen.npz"
    context, agent = guest(tmp_path, text % out, CONTROL, "demonstrations", "exploration", "queries", "theta")
    agent.close()
    with np.load(out) as seen:
        other = Context(envs.get(CONTROL), tiny_preset(), [0])
        np.testing.assert_array_equal(seen["demonstrations"], other.demonstrations.obs)
        np.testing.assert_array_equal(seen["theta"], other.task.encode_theta(other.demonstrated_theta))
        rngs = other.rngs
        np.testing.assert_array_equal(seen["free"], other.explore(None, rngs).obs)
        assert (seen["asked"] == 0).all()
        assert seen["labels"].shape == (3, 5, 150, 1)
        assert (seen["labels"] != 0).any()
    budget = context.monitor.budget
    assert budget["expert_trials"] == [4]
    assert budget["exploration_trials"] == [4 + 3]
    assert budget["thetas"] == [4]
    assert budget["queries"][0] > 100


HUNTER = """
import collections, sys, types

OURS = ("deconfounded", "outside_", "__mp_main__", "tests")
BOUND = ("method-wrapper", "builtin_function_or_method", "wrapper_descriptor", "method_descriptor", "getset_descriptor")

def hunt(start, skipped=(), limit=100_000):
    # Every number within reach, nearest first: attributes, containers, closures, globals, frames, our modules.
    seen, numbers, kinds, queue = {}, [], set(), collections.deque(start)
    while queue and len(seen) < limit:
        thing = queue.popleft()
        if id(thing) in seen or isinstance(thing, (bool, str, bytes, type(None))):
            continue
        seen[id(thing)] = thing  # and so alive: ids are not used again
        kinds.add(type(thing).__name__)
        if isinstance(thing, (int, float, np.number)):
            if abs(thing) < 1e30:
                numbers.append(float(thing))
        elif isinstance(thing, np.ndarray):
            if thing.dtype.kind in "iuf" and thing.size < 100_000:
                numbers.extend(thing.ravel().astype(float).tolist())
        elif isinstance(thing, dict):
            queue.extend((*thing.keys(), *thing.values()))
        elif isinstance(thing, (list, tuple, set, frozenset)):
            queue.extend(thing)
        elif isinstance(thing, types.ModuleType) and not thing.__name__.startswith(OURS):
            continue
        elif isinstance(thing, (type, types.FunctionType)) and not (thing.__module__ or "").startswith(OURS):
            continue
        else:
            names = {*dir(thing), "__dict__", "__closure__", "__globals__", "__self__", "cell_contents"}
            if type(thing).__name__ in BOUND:  # without end: each has methods of its own
                names = {"__self__"}
            for name in names - {*skipped}:
                try:
                    queue.append(getattr(thing, name))
                except Exception:
                    pass
    return numbers, kinds
"""
HIDDEN = {"BatchEnv", "Context", "Physics", "NetworkExpert", "Simulator"}


@pytest.mark.slow
def test_a_hunter_finds_no_theta(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A method that walks all that is reachable from what it is handed, and from the agent that acts in evaluation.

    It finds no theta of demonstrations, explorations or evaluation, no seed of these and no environment; the same walk
    over what this side holds finds all of them.
    """
    text = f"""{HUNTER}
class Spy(Still):
    def __init__(self, given): self.given, self.acts = given, 0
    def reset(self, rngs): self.rngs = rngs
    def act(self, obs):
        self.acts += 1
        if self.acts in (40, 80):
            write(hunt([self, obs, sys._getframe(), *sys.modules.values()]), f"act{{self.acts}}")
        return super().act(obs)

def write(hunted, name):
    numbers, kinds = hunted
    np.savez(f"{tmp_path}/{{name}}.npz", numbers=np.unique(numbers), kinds=sorted(kinds), words=sys.argv)

@uses("demonstrations", "exploration", "queries")
def fit(given):
    given.demonstrations, given.explore(Still()), given.query()
    write(hunt([given, fit, sys._getframe(), *sys.modules.values()]), "fit")
    return Spy(given)
"""
    seeds, thetas = watch_resets(monkeypatch)
    monkeypatch.setattr("sys.argv", ["run", "--salt", "4242424242"])
    context, agent = guest(tmp_path, text, CONTROL, "demonstrations", "exploration", "queries")
    evaluate(context, agent, True)
    agent.close()
    assert len({tuple(one) for one in seeds}) == 4  # of demonstrations, exploration, queries and evaluation
    hidden = np.concatenate([*thetas, *seeds, [4242424242, stream(EVALUATION, 0), stream(DEMOS, 0)]])
    for name in ("fit", "act40", "act80"):
        with np.load(tmp_path / f"{name}.npz") as hunted:
            assert len(hunted["numbers"]) > (10_000 if name == "fit" else 100)
            assert {"Given", "Generator", "Trials" if name == "fit" else "frame"} <= set(hunted["kinds"])
            assert not HIDDEN & set(hunted["kinds"])
            assert not np.isin(hidden, hunted["numbers"]).any()
            assert "--salt" not in hunted["words"]
    numbers, kinds = hunter()([context, Provider(context, ["theta"], []), stream(EVALUATION, 0)])
    assert np.isin(context.env.theta, numbers).all()
    assert np.isin(stream(EVALUATION, 0), numbers).all()
    assert HIDDEN - {"Simulator"} <= kinds


@pytest.mark.slow
def test_a_hunter_finds_no_theta_in_what_ours_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing that a method of ours is handed, or its agent, refers to theta, seeds, environments or the expert.

    It stands in the process that holds them: globals of modules and frames of callers are left out.
    """
    hunt, hidden_from = hunter(), ("__globals__", "__builtins__", "f_back", "f_globals")
    hunted: list[tuple[list[float], set[str]]] = []

    class Spy(RandomAgent):
        def __init__(self, given: Given) -> None:
            super().__init__(given.action_space)
            self.given, self.acts = given, 0

        def act(self, obs: NDArray[np.float32]) -> NDArray[np.float64]:
            self.acts += 1
            if self.acts in (40, 80):
                hunted.append(hunt([self, obs], hidden_from))
            return super().act(obs)

    @uses("demonstrations", "exploration", "queries")
    def spying(given: Given) -> Agent:
        demonstrated = given.demonstrations, given.explore(), given.query(), given.source
        environments = given.environments(0, 4)
        environments.reset()
        environments.step(np.zeros((4, 1), np.float32))
        hunted.append(hunt([given, demonstrated, environments], hidden_from))
        return Spy(given)

    seeds, thetas = watch_resets(monkeypatch)
    preset = tiny_preset()
    monkeypatch.setattr(methods, "load", lambda name: spying)
    context = Context(envs.get(CONTROL), preset, [917])
    agent = fit(context, "spying")
    evaluate(context, agent, True, "salt")
    hidden = np.concatenate([*thetas, *seeds, [917, stream(EVALUATION, 917, "salt"), stream(DEMOS, 917)]])
    assert len({tuple(each) for each in seeds}) == 5
    assert len(hunted) == 3
    for (numbers, kinds), least in zip(hunted, (1000, 20, 20), strict=True):
        assert len(numbers) > least
        assert {"Given", "Generator"} <= kinds
        assert not HIDDEN & kinds
        assert not np.isin(hidden, numbers).any()


def hunter() -> Callable[..., tuple[list[float], set[str]]]:
    """The hunter, in this process."""
    space: dict[str, Any] = {}
    exec("import numpy as np\n" + HUNTER, space)
    return space["hunt"]


def watch_resets(monkeypatch: pytest.MonkeyPatch) -> tuple[list[Any], list[Any]]:
    """Lists that grow by the seeds and the thetas of every reset of environments with seeds."""
    seeds, thetas, reset = [], [], envs.BatchEnv.reset

    def watched(self: envs.BatchEnv, seed: Any = None, *rest: Any, **more: Any) -> Any:
        obs = reset(self, seed, *rest, **more)
        if seed is not None:
            seeds.append(np.ravel(seed))
            thetas.append(self.theta.ravel().copy())
        return obs

    monkeypatch.setattr(envs.BatchEnv, "reset", watched)
    return seeds, thetas


def test_ours_get_what_they_declare() -> None:
    """A provider opens what a method declares, and nothing else; and no data after training."""
    context = Context(envs.get(CONTROL), tiny_preset(), [0])
    every = {
        **{"demonstrations": ("demonstrations",), "exploration": ("exploration", None), "queries": ("queries", None)},
        **{"theta": ("theta",), "environment": ("environment",)},
    }
    for use, asked in every.items():
        provider = Provider(context, [use], context.rngs)
        assert provider(*asked) is not None
        for other in every.keys() - {use}:
            with pytest.raises(
                envs.InputError, match=f"it asked for {every[other][0]}, and declares that it uses {use}"
            ):
                provider(*every[other])
        with pytest.raises(envs.InputError, match="it asked for exploration with theta, and declares"):
            provider("exploration with theta", None)
        provider.fitted = True
        if use != "environment":
            with pytest.raises(envs.InputError, match=f"it asked for {use} after training"):
                provider(*asked)
    trials, theta = Provider(context, ["exploration", "theta"], context.rngs)("exploration with theta", None)
    assert len(trials) == len(theta) == 4


@pytest.mark.parametrize("seed", [1, -1, "a", 0.0])
def test_environments_of_no_seed(seed: Any) -> None:
    """Nor are they made, as their use would not be counted."""
    provider = Provider(Context(envs.get(CONTROL), tiny_preset(), [7]), ["exploration"], [np.random.default_rng(0)])
    with pytest.raises(envs.InputError, match=f"asked for environments of seed {seed!r}; it has 1, numbered from 0"):
        provider("environments", seed, 4)
    for kind, rest in (("reset", ()), ("step", (np.zeros((4, 1)),))):
        with pytest.raises(envs.InputError, match=f"it asked for environments number {seed!r}; it was given 0"):
            provider(kind, seed, *rest)


class Weighted(Agent):
    """Actions are weights [A, O] times observations."""

    def __init__(self, weights: Any) -> None:
        self.weights = weights

    def act(self, obs: Any) -> Any:
        return obs @ self.weights.T

    def state(self) -> Any:
        return {}, {"weights": self.weights}

    @classmethod
    def from_state(cls, settings: Any, arrays: Any) -> "Weighted":
        return cls(arrays["weights"])


class TestSaved:
    """Agents that are kept: `deconfounded.load` in another process gives the same bits."""

    def test_missing_or_damaged(self, tmp_path: Path) -> None:
        with pytest.raises(envs.InputError, match=r"holds no agent.json"):
            deconfounded.load(tmp_path)
        (tmp_path / "agent.json").write_text("{")
        with pytest.raises(envs.InputError, match="is damaged"):
            deconfounded.load(tmp_path)
        about = {"class": "deconfounded.deconf.methods.sequence_bc:RecurrentAgent", "settings": {}}
        for arrays, says in (
            (None, "is of no agent"),
            ("0" * 64, r"agent\.safetensors is damaged, or of another agent"),
            (hashlib.sha256(b"half").hexdigest(), r"is damaged \(.*\); run the benchmark again"),
            (
                hashlib.sha256(empty := saved_agents.to_bytes({})).hexdigest(),
                "from_state of RecurrentAgent fails",
            ),
        ):
            write_sealed(tmp_path / "agent.json", {**about, "arrays": arrays})
            (tmp_path / "agent.safetensors").write_bytes(empty if "from_state" in says else b"half")
            with pytest.raises(envs.InputError, match=says):
                deconfounded.load(tmp_path)

    def test_another_agent_in_the_same_folder(self, tmp_path: Path) -> None:
        """Its own code runs, though the former one's was imported from the same file."""
        text = "from deconfounded.experts.agent import Agent\nclass Same(Agent):\n"
        text += "    def act(self, obs): return obs[:, :1] * 0 + NUMBER\n"
        text += "    def state(self): return {}, {}\n"
        text += "    @classmethod\n    def from_state(cls, *state): return cls()\n"
        for number in (1, 2):
            (tmp_path / f"{number}.py").write_text(text.replace("NUMBER", str(number)))
            agent = outside.find("agent", f"{tmp_path / f'{number}.py'}:Same")
            saved_agents.save(agent(), tmp_path / "agent")
            assert deconfounded.load(tmp_path / "agent").act(np.zeros((1, 1))) == number

    @pytest.mark.parametrize("order", ["C", "F", "reversed"])
    def test_arrays_in_any_order_of_memory(self, order: str, tmp_path: Path) -> None:
        """As `lstsq(...)[0].T` and `w[::-1]` are."""
        weights = np.arange(6.0).reshape(2, 3)
        weights = weights[::-1] if order == "reversed" else np.array(weights, order=order)  # type: ignore[call-overload]
        saved_agents.save(Weighted(weights), tmp_path)
        np.testing.assert_array_equal(deconfounded.load(tmp_path).act(np.ones((1, 3))), weights.sum(1)[None])

    def test_an_agent_of_a_script(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Another process has another script."""
        monkeypatch.setattr(RandomAgent, "__module__", "__main__")
        with pytest.raises(envs.InputError, match="RandomAgent cannot be saved; its class must be imported"):
            saved_agents.save(RandomAgent(envs.get("bandit").action_space), tmp_path)

    def test_settings_whose_keys_are_numbers(self, tmp_path: Path) -> None:
        """JSON makes them texts, and sorts 10 before 2."""
        write_sealed(tmp_path / "x.json", {"widths": {2: "a", 10: "b"}})
        assert read_sealed(tmp_path / "x.json")["widths"] == {"2": "a", "10": "b"}

    @pytest.mark.slow
    @pytest.mark.parametrize("task", ["bandit", CONTROL])
    def test_a_run_leaves_its_agents(self, task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Loaded, they return in the run's own trials what they returned in the run, though they trained two by two."""
        monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
        monkeypatch.setattr(type(envs.get(task)), "horizon", 12)
        monkeypatch.setattr(type(envs.get(task)), "episodes", 2)
        (tmp_path / "jobs").mkdir()
        for method in ("deconfounded", "naive_rnn", "deconfounded_discrete", "blind_bc"):
            job = BenchmarkJob(task, tiny_preset(), method, (0, 1), tmp_path / "jobs")
            job.run()
            for seed in (0, 1):
                wrote = job.load(seed)
                assert wrote is not None
                for name in wrote["meta"]["agents"]:
                    env, expected = envs.BatchEnv(envs.get(task), 4), wrote[f"{name}/returns"]
                    agent = play.ready(tmp_path / "agents" / f"{name}-{seed}", env.task)
                    again = run_trials(env, agent, expected.shape[1], stream(EVALUATION, seed)).returns
                    np.testing.assert_array_equal(again, expected)

    def test_no_agent_of_former_results_stays(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Where that of the new ones cannot be kept."""
        monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
        (tmp_path / "jobs").mkdir()
        job = BenchmarkJob("bandit", tiny_preset(), "blind_bc", (0,), tmp_path / "jobs")
        job.run()
        assert (tmp_path / "agents" / "blind_bc-0").is_dir()
        monkeypatch.setattr(LearnedAgent, "of_seed", lambda *_: 1 / 0)
        assert "its agent is not kept" in job.run()
        assert not (tmp_path / "agents" / "blind_bc-0").exists()

    def test_a_full_disk_loses_no_agent(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """The job fails, and is not finished: a later run goes on, and keeps it. Nothing is left of half an agent."""
        monkeypatch.setattr(progress, "_ticks", queue.Queue(), raising=False)
        (tmp_path / "jobs").mkdir()
        job, save = BenchmarkJob("bandit", tiny_preset(), "blind_bc", (0,), tmp_path / "jobs"), saved_agents.save

        def full(agent: Any, folder: Path, **about: Any) -> None:
            save(agent, folder, **about)
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(saved_agents, "save", full)
        with pytest.raises(OSError, match="No space left"):
            job.run()
        assert not job.file(0).exists()
        assert not (tmp_path / "agents" / "blind_bc-0").exists()
        monkeypatch.setattr(saved_agents, "save", save)
        job.run()
        assert deconfounded.load(tmp_path / "agents" / "blind_bc-0")

    @pytest.mark.slow
    @pytest.mark.parametrize("task", ["bandit", CONTROL])
    def test_in_another_process(self, task: str, tmp_path: Path) -> None:
        """One plain gymnasium environment: the agent of a fit and, over there, the loaded one return the same bits."""
        context = Context(envs.get(task), tiny_preset(), [0])
        agent = fit(context, "deconfounded")
        assert isinstance(agent, LearnedAgent)
        agent.save(tmp_path)
        returns, _ = play.play(agent, envs.make(task), 2, 5)
        code = (
            "import deconfounded; from deconfounded import envs; from deconfounded.benchmarks import play;"
            f"print(play.play(deconfounded.load({str(tmp_path)!r}), envs.make({task!r}), 2, 5)[0])"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
        assert done.stdout.strip() == str(returns), done.stderr

    def test_oracles_need_to_be_told(self, tmp_path: Path) -> None:
        context = Context(envs.get(CONTROL), tiny_preset(), [0])
        oracle = fit(context, "oracle_bc")
        assert isinstance(oracle, LearnedAgent)
        oracle.save(tmp_path)
        with pytest.raises(envs.InputError, match="is an oracle"):
            play.ready(tmp_path, context.task)
        agent = deconfounded.load(tmp_path)
        agent.begin(1)
        agent.reset([np.random.default_rng(0)])
        with pytest.raises(envs.InputError, match="set its `side`"):
            agent.act(np.zeros((1, 6), np.float32))

    def test_agents_of_another_version(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Whose parameters, or whose class, had other names: no mistake of the user's."""

        def fails(*given: Any) -> Any:
            raise RuntimeError("Missing key")

        agent = fit(Context(envs.get("bandit"), tiny_preset(), [0]), "blind_bc")
        assert isinstance(agent, LearnedAgent)
        agent.save(tmp_path)
        older = "another version of this package saved it; train it anew, or use that one"
        monkeypatch.setattr(type(agent), "from_state", fails)
        with pytest.raises(envs.InputError, match=rf"Missing key \(RuntimeError, .*\); {older}$"):
            deconfounded.load(tmp_path)
        monkeypatch.delattr(sys.modules[type(agent).__module__], type(agent).__name__)
        with pytest.raises(envs.InputError, match=rf"has no '{type(agent).__name__}'; it has .*; {older}$"):
            deconfounded.load(tmp_path)

    def test_without_metadata(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """A checkout on PYTHONPATH, that was never installed, keeps agents too."""

        def missing(name: str) -> Any:
            raise importlib.metadata.PackageNotFoundError(name)

        monkeypatch.setattr(importlib.metadata, "distribution", missing)
        agent = fit(Context(envs.get("bandit"), tiny_preset(), [0]), "blind_bc")
        assert isinstance(agent, LearnedAgent)
        agent.save(tmp_path)
        assert saved_agents.describe(tmp_path)["versions"]["deconfounded-imitation"] == deconfounded.__version__
        assert isinstance(deconfounded.load(tmp_path), type(agent))

    @pytest.mark.parametrize(
        ("state", "says"),
        [
            ('{"sign": np.int64(1)}, {}', "int64 is not JSON serializable"),
            ('{"sign": np.nan}, {}', "would hold NaN or infinity"),
            ('{}, {"size": [1.0]}', "must return a dictionary for json and one of arrays"),
            ("None", "must return a dictionary for json and one of arrays"),
            ("self.missing", r"no attribute 'missing' \(AttributeError, odd.py:"),
        ],
    )
    def test_what_cannot_be_kept_leaves_nothing(self, tmp_path: Path, state: str, says: str) -> None:
        """Not half an agent."""
        text = f"""
class Odd(Still):
    def state(self): return {state}
"""
        (tmp_path / "odd.py").write_text(HEAD + text)
        agent = outside.find("agent", f"{tmp_path / 'odd.py'}:Odd")()
        with pytest.raises(envs.InputError, match=says):
            saved_agents.save(agent, tmp_path / "kept")
        assert not (tmp_path / "kept").exists()

    @pytest.mark.parametrize("steps", range(7))
    def test_interrupted_over_another_agent(self, steps: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """At any of its steps, the folder holds the agent that it held, or the new one, whole; and no litter later."""

        def agent(value: float) -> Any:
            text = f"""
class Odd(Still):
    doubled = {2 * value}
    def __init__(self, value): self.value = value
    def state(self): return {{"value": self.value}}, {{"size": np.array(self.value)}}
    @classmethod
    def from_state(cls, settings, arrays): return cls(float(arrays["size"]) if settings["value"] else None)
"""
            file = tmp_path / f"odd{value}.py"
            file.write_text(HEAD + text)
            return outside.find("agent", f"{file}:Odd")(value)

        def replace(*names: Any) -> None:
            made.append(1)
            if len(made) > steps:
                raise KeyboardInterrupt
            whole(*names)

        folder, made, whole = tmp_path / "kept", list[int](), os.replace
        saved_agents.save(agent(1.0), folder)
        with monkeypatch.context() as patch, contextlib.suppress(KeyboardInterrupt):
            patch.setattr(os, "replace", replace)
            saved_agents.save(agent(2.0), folder)
        loaded: Any = deconfounded.load(folder)
        assert loaded.value == (1.0 if steps < 3 else 2.0)
        assert loaded.doubled == 2 * loaded.value
        saved_agents.save(agent(3.0), folder)
        assert {file.name for file in folder.iterdir()} - {"__pycache__"} == {*push.AGENT_FILES}

    @pytest.mark.parametrize(
        ("loaded", "says"),
        [
            ("cls(arrays['a'])", r"from_state\(\) fails \(a \(KeyError, odd.py:\d+\)\); it must undo what state"),
            ("cls(arrays['size'])", "it makes an agent of another state"),
            ("cls(-arrays['size'] * settings.pop('sign'))", "it makes an agent of another state"),
            ("cls(arrays['size'] * settings.pop('sign'))", ""),
        ],
    )
    def test_an_agent_that_would_not_come_back(self, loaded: str, says: str, tmp_path: Path) -> None:
        """It is not saved, as nobody could load it; the last is fine."""
        text = f"""
class Odd(Still):
    def __init__(self, value): self.value = value
    def state(self): return {{"sign": int(np.sign(self.value))}}, {{"size": np.array(abs(self.value))}}
    @classmethod
    def from_state(cls, settings, arrays): return {loaded}
"""
        (tmp_path / "odd.py").write_text(HEAD + text)
        agent = outside.find("agent", f"{tmp_path / 'odd.py'}:Odd")(-0.25)
        if says:
            with pytest.raises(envs.InputError, match=says):
                saved_agents.save(agent, tmp_path / "kept")
        else:
            saved_agents.save(agent, tmp_path / "kept")
        assert (tmp_path / "kept").exists() == (not says)

    @pytest.mark.parametrize(
        ("acts", "says"),
        [
            ("self.size * np.ones((len(obs), 1))", ""),
            (
                "self.gain * np.ones((len(obs), 1))",
                r"what from_state\(\) makes acts differently; state\(\) must give all",
            ),
            ("self.gain[0] * np.ones((len(obs), 1))", r"what from_state\(\) makes fails \(.*TypeError"),
            ("np.random.random((len(obs), 1))", ""),
            ("obs[:, [99]]", ""),
            ("self.rng.random((len(obs), 1))", ""),
            ("np.full((len(obs), 1), self.seen)", ""),
        ],
    )
    def test_an_agent_whose_state_forgets(self, acts: str, says: str, tmp_path: Path) -> None:
        """What acts differently from what was scored is not kept. What cannot be tried is."""
        text = f"""
class Odd(Still):
    gain, seen = 1.0, 0
    def __init__(self, size): self.size = size
    def reset(self, rngs): self.rng = rngs[0]
    def observe(self, obs, action, next_obs, alive): self.seen += 1
    def act(self, obs): return {acts}
    def state(self): return {{}}, {{"size": np.array(self.size)}}
    @classmethod
    def from_state(cls, settings, arrays): return cls(arrays["size"])
"""
        (tmp_path / "odd.py").write_text(HEAD + text)
        agent = outside.find("agent", f"{tmp_path / 'odd.py'}:Odd")(0.25)
        agent.gain = [2.0] if "[0]" in acts else 2.0
        sizes = {"observations": 3, "action": 1, "actions": 0}
        if says:
            with pytest.raises(envs.InputError, match=says):
                saved_agents.save(agent, tmp_path / "kept", spaces=sizes)
        else:
            saved_agents.save(agent, tmp_path / "kept", spaces=sizes)
        assert (tmp_path / "kept").exists() == (not says)

    def test_an_agent_whose_file_imports_another(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """That one is not kept; where it is missing, the message says what to do."""
        (tmp_path / "beside_odd.py").write_text("VALUE = 0.25")
        text = "    def state(self): return {}, {}\n    @classmethod\n    def from_state(cls, *given): return cls()\n"
        (tmp_path / "odd.py").write_text(f"import beside_odd\n{HEAD}\nclass Odd(Still):\n{text}")
        saved_agents.save(outside.find("agent", f"{tmp_path / 'odd.py'}:Odd")(), tmp_path / "kept")
        monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry != str(tmp_path)])
        monkeypatch.delitem(sys.modules, "beside_odd")
        says = r"No module named 'beside_odd' .*; modules that it imports must be importable, as by PYTHONPATH$"
        with pytest.raises(envs.InputError, match=says):
            deconfounded.load(tmp_path / "kept")

    def test_an_agent_from_outside(self, tmp_path: Path) -> None:
        """It is kept with its code, and does not need the file it came from."""
        text = """
class Constant(Still):
    def __init__(self, value): self.value = value
    def act(self, obs): return np.full((len(obs), 1), self.value)
    def state(self): return {"sign": -1}, {"size": np.array(abs(self.value))}
    @classmethod
    def from_state(cls, settings, arrays): return cls(settings["sign"] * arrays["size"])

@uses()
def fit(given): return Constant(-0.25)
"""
        context, agent = guest(tmp_path, text)
        assert agent.keep(tmp_path / "kept", {"seed": 0}) == ""
        expected = run_trials(context.env, agent, 1, 3).returns
        agent.close()
        (tmp_path / "mine.py").unlink()
        assert saved_agents.describe(tmp_path / "kept")["class"] == "agent.py:Constant"
        again = deconfounded.load(tmp_path / "kept")
        np.testing.assert_array_equal(run_trials(context.env, again, 1, 3).returns, expected)
        with (tmp_path / "kept" / "agent.py").open("a") as file:
            file.write("print('runs')\n")
        with pytest.raises(envs.InputError, match=r"agent\.py is missing, damaged, or of another agent"):
            deconfounded.load(tmp_path / "kept")


class TestPlay:
    """One trial in a gymnasium environment, as `deconf play` runs it."""

    def test_the_agent_sees_what_happens(self) -> None:
        """Each step's own observation, action and next one; and other random numbers in each episode."""
        seen: list[list[NDArray[Any]]] = []
        numbers: list[float] = []
        happened: list[list[NDArray[Any]]] = []

        class Recording(RandomAgent):
            def reset(self, rngs: Sequence[np.random.Generator]) -> None:
                super().reset(rngs)
                numbers.append(rngs[0].random())

            def observe(self, obs: Array, action: Array, next_obs: Array, alive: Mask) -> None:
                assert alive.tolist() == [True]
                seen.append([obs[0], action[0], next_obs[0]])

        class Watched(envs.GymEnv):
            def reset(self, **options: Any) -> Any:
                self.obs, info = super().reset(**options)
                return self.obs, info

            def step(self, action: Any) -> Any:
                then = super().step(action)
                happened.append([self.obs, action, then[0]])
                self.obs = then[0]
                return then

        env = Watched(toys.Push())
        returns, _ = play.play(Recording(env.task.action_space), env, 3, 5)
        assert len(returns) == len(set(numbers)) == 3
        assert len(happened) > 3
        for one, other in zip(seen, happened, strict=True):
            for x, y in zip(one, other, strict=True):
                np.testing.assert_array_equal(x, y)

    def test_all_episodes_are_under_the_trial_s_theta(self) -> None:
        """That which was drawn by the seed, or given."""
        env, thetas = envs.GymEnv(toys.Push()), list[float]()

        class Noting(RandomAgent):
            def reset(self, rngs: Sequence[np.random.Generator]) -> None:
                super().reset(rngs)
                thetas.append(env.batch.theta.item())

        agent = Noting(env.task.action_space)
        for seed, theta in ((5, None), (6, None), (6, [0.25])):
            play.play(agent, env, 3, seed, theta)
        first, second = thetas[0], thetas[3]
        assert thetas == [first] * 3 + [second] * 3 + [0.25] * 3
        assert first != second


class TestSentences:
    """What is used out of order, or is not what it should be, is told in a line."""

    def agent(self) -> LearnedAgent:
        agent = fit(Context(envs.get(CONTROL), tiny_preset(), [0]), "naive_rnn")
        assert isinstance(agent, LearnedAgent)
        return agent

    def test_agents(self) -> None:
        agent, obs = self.agent(), np.zeros((1, 6), np.float32)
        with pytest.raises(envs.InputError, match="act was called before begin and reset"):
            agent.act(obs)
        with pytest.raises(envs.InputError, match="reset was called before begin"):
            agent.reset([np.random.default_rng(0)])
        with pytest.raises(envs.InputError, match="was given 0 trials"):
            agent.begin(0)
        agent.begin(1)
        with pytest.raises(envs.InputError, match=r"come from \[0\]; give np.random.default_rng\(0\)"):
            agent.reset([0])  # type: ignore[list-item]
        agent.reset([np.random.default_rng(0)])
        with pytest.raises(envs.InputError, match=r"observations had shape \(6,\); they must be \(1, 6\)"):
            agent.act(obs[0])
        assert agent.act(obs).shape == (1, 1)

    def test_actions_that_an_agent_cannot_have_taken(self) -> None:
        """In other units than its own, or between two numbers."""
        for name, wrong, says in (
            (CONTROL, 300.0, "an action was of size 300; agents act in"),
            ("bandit", 0.97, "of 0"),
        ):
            agent = fit(Context(envs.get(name), tiny_preset(), [0]), "blind_bc")
            obs, action = np.zeros((1, len(envs.get(name).observation)), np.float32), np.full((1, 1), wrong)
            agent.begin(1)
            agent.reset([np.random.default_rng(0)])
            with pytest.raises(envs.InputError, match=says):
                agent.observe(obs, action, obs, np.ones(1, bool))
            agent.observe(obs, np.ones((1, 1)), obs, np.ones(1, bool))

    def test_what_there_is_not(self) -> None:
        """A seed; and features before there are trials."""
        agent = self.agent()
        with pytest.raises(envs.InputError, match="features was called before begin"):
            agent.features()
        for seed in (1, -1, None, "0", 0.0):
            with pytest.raises(envs.InputError, match="of an agent of 1 was asked for; it must be from 0 to 0"):
                agent.of_seed(seed)  # type: ignore[arg-type]

    def test_a_way_that_there_is_not(self) -> None:
        agent = fit(Context(envs.get("bandit"), tiny_preset(), [0]), "deconfounded")
        agent.begin(1)
        agent.reset([np.random.default_rng(0)])
        agent.way = "mod"  # type: ignore[attr-defined]
        with pytest.raises(envs.InputError, match="way was 'mod'; it must be step, episode, mode or mean"):
            agent.act(np.zeros((1, 1), np.float32))

    def test_generators(self) -> None:
        with pytest.raises(envs.InputError, match="random numbers were to come from 0; give"):
            naive_rnn.train(Context(envs.get(CONTROL), tiny_preset(), [0]).demonstrations, RecurrentConfig(), 0)  # type: ignore[arg-type]

    def test_trials(self) -> None:
        fine = {"obs": [[[[0.0], [1.0]]]], "action": [[[[0.5]]]], "mask": [[[True]]]}
        assert Trials(**fine).action.dtype == np.float32  # type: ignore[arg-type]
        with pytest.raises(envs.InputError, match=r"an action of size 1.5; actions must be in \[-1, 1\]"):
            Trials(**{**fine, "action": [[[[1.5]]]]})  # type: ignore[arg-type]
        with pytest.raises(envs.InputError, match="obs of Trials must be an array of numbers"):
            Trials(**{**fine, "obs": [[0], [1, 2]]})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("naive_rnn.updates=many", "--set naive_rnn.updates was 'many'; it must be like 1500"),
        ("naive_rnn.update=5", "did you mean 'naive_rnn.updates'"),
        ("naiv_rnn.updates=5", "--set method 'naiv_rnn' is unknown; did you mean 'naive_rnn'"),
        ("seeds=1.5", "--set seeds was '1.5'; it must be like 3"),
        ("seeds=-1", "--set seeds was '-1'"),
        ("naive_rnn.cooled=1", "--set naive_rnn.cooled was '1'; it must be like true$"),
        ("deconfounded.model=nope", "--set deconfounded.model was 'nope'; it must be one of .*linear"),
        ("seeds=0", "must be like 3"),
        ("eval_trials=3", "must be like 128, and at least 4"),
        ("blind_bc.learning_rate=NaN", "must be like"),
        ("blind_bc.device=tpu", "amount 'blind_bc.device' is unknown"),
    ],
)
def test_bad_amounts_are_one_line(change: str, says: str) -> None:
    with pytest.raises(envs.InputError, match=says):
        presets.changed(presets.preset("default", envs.get(CONTROL), "cpu"), [change])


def test_amounts() -> None:
    full = presets.preset("default", envs.get(CONTROL), "cpu")
    made = presets.changed(full, ["seeds=10", "naive_rnn.learning_rate=1e-3", "deconfounded.inference_batch=null"])
    assert made.seeds == 10
    assert made.configs["naive_rnn"]["learning_rate"] == 1e-3
    assert made.configs["deconfounded"]["inference_batch"] is None
    assert made.configs["dagger"] == full.configs["dagger"]
