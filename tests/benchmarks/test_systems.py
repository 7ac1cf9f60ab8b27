"""What other systems do differently: the spawn start method, forks, copies, no symbolic links, an ASCII locale."""

import ast
import copy
import json
import os
import pickle
import subprocess
import sys
import tomllib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from stable_baselines3.common.vec_env import SubprocVecEnv

from deconfounded import envs
from deconfounded.benchmarks.engine import catalogue, sources
from deconfounded.benchmarks.engine.context import stream
from deconfounded.envs.contract.probe import actions, gl_works
from deconfounded.envs.support.files import write_atomically
from deconfounded.experts import datasets, policy
from deconfounded.experts.agent import RandomAgent
from deconfounded.experts.sb3 import Sb3VecEnv
from tests.toys import Push

ROOT = Path(__file__).parents[2]
CONTROL = "slippery_cartpole"
OWN = f"""
from deconfounded import envs
from deconfounded.envs.tasks.{CONTROL} import SlipperyCartpole

class Own(SlipperyCartpole):
    name = "own_cartpole"
"""


def python(*args: object, cwd: Path = ROOT, **environ: str) -> str:
    """What a fresh process prints; it has five minutes, and must end well."""
    command = [sys.executable, *map(str, args)]
    environ = {**os.environ, "PYTHONPATH": str(ROOT), **environ}
    done = subprocess.run(command, cwd=cwd, capture_output=True, env=environ, timeout=300)
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout.decode()


@pytest.fixture
def own(tmp_path: Path) -> envs.Task:
    """A task from outside, that this process alone knows by its name."""
    (tmp_path / "own.py").write_text(OWN)
    (tmp_path / "own_cartpole.xml").write_bytes((ROOT / "assets" / f"{CONTROL}.xml").read_bytes())
    return envs.get(f"{tmp_path}/own.py:Own")


class TestOtherProcesses:
    @pytest.mark.slow
    def test_spec_data_set_and_pickle(self, own: envs.Task, tmp_path: Path) -> None:
        """A task from outside is known to a process that has a spec of it, a data set, or a pickled environment."""
        env = gymnasium.make(own.gym_id)
        assert env.spec is not None
        (tmp_path / "spec.json").write_text(env.spec.to_json())
        collected = datasets.collect(own, 1, lambda env: RandomAgent(own.action_space), 5)
        data = datasets.write(tmp_path / "data", own, "random", collected, "random", (1.0, 2.0))
        vec = envs.make_vec(own.name, 2)
        vec.reset(seed=3)
        vec.step(np.ones((2, 1)))
        (tmp_path / "vec.pickle").write_bytes(pickle.dumps(vec))
        code = """
import json, pickle, sys, gymnasium
from pathlib import Path
folder, data = map(Path, sys.argv[1:])
vec = pickle.loads((folder / "vec.pickle").read_bytes())
observations = [vec.step(vec.action_space.low)[0].tolist()]
import minari
from gymnasium.envs.registration import EnvSpec
for env in (
    gymnasium.make(EnvSpec.from_json((folder / "spec.json").read_text())),
    minari.MinariDataset(data / "data").recover_environment(),
):
    observations.append(env.reset(seed=3)[0].tolist())
from deconfounded import envs
print(json.dumps([*observations, envs.get("own_cartpole").reference]))
"""
        stepped, *first, reference = json.loads(python("-c", code, tmp_path, data, cwd=tmp_path))
        np.testing.assert_array_equal(stepped, vec.step(-np.ones((2, 1)))[0])
        for obs in first:
            np.testing.assert_array_equal(obs, env.reset(seed=3)[0])
        assert reference == own.reference == f"{tmp_path}/own.py:Own"

    @pytest.mark.slow
    def test_vectors_of_spawned_processes(self, own: envs.Task) -> None:
        """gymnasium's and Stable-Baselines3's: the same bits as here."""
        first = envs.make_vec(own.name, 1).reset(seed=3)[0]
        env = gymnasium.make_vec(own.gym_id, 1, "async", vector_kwargs={"context": "spawn"})
        np.testing.assert_array_equal(env.reset(seed=3)[0], first)
        env.close()
        vec = SubprocVecEnv([partial(envs.GymEnv, own)], start_method="spawn")
        vec.seed(3)
        np.testing.assert_array_equal(vec.reset(), first)
        vec.close()

    @pytest.mark.slow
    def test_registered_by_hand(self, tmp_path: Path) -> None:
        """In a script, and in a module beside it: a spawned process, which runs both too, has one task of each name."""
        by_hand = OWN.replace("class", "@envs.register\nclass")
        (tmp_path / "beside.py").write_text(by_hand.replace("own_", "other_"))
        for name in ("own", "other"):
            xml = (ROOT / "assets" / f"{CONTROL}.xml").read_bytes()
            (tmp_path / f"{name}_cartpole.xml").write_bytes(xml)
        code = """
import beside, gymnasium
if __name__ == "__main__":
    for cls in (Own, beside.Own):
        assert type(envs.get(cls.reference)) is cls
        env = gymnasium.make_vec(cls().gym_id, 1, "async", vector_kwargs={"context": "spawn"})
        print(cls.reference, env.reset(seed=3)[0].shape)
        env.close()
"""
        (tmp_path / "script.py").write_text(by_hand + code)
        lines = python("script.py", cwd=tmp_path).splitlines()
        shape = (1, len(envs.get(CONTROL).observation))
        assert lines == [f"{tmp_path}/script.py:Own {shape}", f"beside:Own {shape}"]


@pytest.mark.slow
def test_a_fork_steps_on() -> None:
    """As a worker of torch's DataLoader does; its pool is gone with its threads. Both go on, and come to their ends."""
    code = """
import os, signal, sys
os.register_at_fork(after_in_child=lambda: signal.alarm(50))  # nobody waits for a child for ever
import numpy as np
from deconfounded import envs
vec = envs.make_vec("slippery_cartpole", 64)
vec.reset(seed=0)
vec.step(np.ones((64, 1)))
child = os.fork()
observations = vec.step(np.ones((64, 1)))[0].tobytes().hex()
if not child:
    del vec
    print(observations, flush=True)
    sys.exit(0)
assert os.waitpid(child, 0)[1] == 0
print(observations)
"""
    if not hasattr(os, "fork"):
        pytest.skip("no fork here")
    one, other = python("-c", code).splitlines()
    assert one == other


@pytest.mark.slow
@pytest.mark.skipif(not gl_works() or not hasattr(os, "fork"), reason="no GL, or no fork")
def test_a_fork_does_not_draw() -> None:
    """The GL library would wait for threads that it left behind: one line in place of that."""
    code = """
import os, signal
os.register_at_fork(after_in_child=lambda: signal.alarm(50))
from deconfounded import envs
env = envs.make("slippery_cartpole", render_mode="rgb_array")
env.reset(seed=0)
env.render()
child = os.fork()
try:
    env.render()
except envs.InputError as error:
    print(error)
if child:
    assert os.waitpid(child, 0)[1] == 0
"""
    assert (
        python("-c", code) == "pictures cannot be made in a fork of a process that has made some; start it by `spawn`\n"
    )


Steps = Callable[[Any, Any], Any]
MAKERS: dict[str, tuple[Callable[[envs.Task], Any], Steps]] = {
    "GymEnv": (lambda task: envs.GymEnv(task, render_mode="rgb_array"), lambda env, action: env.step(action[0])),
    "GymVectorEnv": (lambda task: envs.GymVectorEnv(task, 3, episodes=2), lambda env, action: env.step(action)),
    "DmEnv": (envs.DmEnv, lambda env, action: env.step(action[0])),
    "BatchEnv": (lambda task: envs.BatchEnv(task, 3), lambda env, action: env.step(action)),
    "Sb3VecEnv": (lambda task: Sb3VecEnv(task, 3, 0), lambda env, action: env.step(action)),
    "gymnasium": (lambda task: gymnasium.make(task.gym_id), lambda env, action: env.step(action[0])),
}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*after the end of an episode")
@pytest.mark.parametrize("how", ["deepcopy", "pickle"])
@pytest.mark.parametrize("kind", MAKERS)
@pytest.mark.parametrize("name", [CONTROL, "bandit", "own"])
def test_a_copy_goes_on_alone(name: str, kind: str, how: str, request: pytest.FixtureRequest) -> None:
    """State and random streams: the same steps and resets, to the bit, whatever the other has done meanwhile."""
    task = request.getfixturevalue("own") if name == "own" else envs.get(name)
    make, step = MAKERS[kind]
    env = make(task)
    acts = actions(task, 3, 30)
    acts = acts[..., 0].astype(int) if task.n_actions and kind != "BatchEnv" else acts
    reset = partial(env.reset, seed=1) if kind in ("GymEnv", "GymVectorEnv", "gymnasium") else env.reset
    reset()
    step(env, acts[0])
    if kind == "GymEnv" and gl_works():
        env.render()
    same = copy.deepcopy(env) if how == "deepcopy" else pickle.loads(pickle.dumps(env))

    def goes_on(env: Any) -> list[Any]:
        seen = [step(env, action) for action in acts[1:10]]
        seen.append(env.reset())
        return [*seen, *(step(env, action) for action in acts[10:])]

    own, its = goes_on(env), goes_on(same)
    for one, other in zip(own, its, strict=True):
        for x, y in zip(one, other, strict=True):
            np.testing.assert_equal(x, y)
    if kind == "GymEnv" and gl_works():
        np.testing.assert_array_equal(env.render(), same.render())


@pytest.mark.parametrize("name", [name for name in envs.names() if name not in (CONTROL, "bandit")])
def test_every_task_can_be_copied(name: str) -> None:
    vec = envs.make_vec(name, 2)
    vec.reset(seed=0)
    action = vec.action_space.sample()
    vec.step(action)
    same = pickle.loads(pickle.dumps(vec))
    np.testing.assert_array_equal(vec.step(action)[0], same.step(action)[0])


class TestAsGymnasiumHasIt:
    def test_seeds_of_vectors(self) -> None:
        """reset(seed=...) seeds np_random, as in gymnasium's VectorEnv; without a seed it goes on."""
        vec = envs.make_vec("bandit", 2)
        vec.reset(seed=5)
        first = vec.np_random.random()
        assert vec.np_random_seed == 5
        vec.reset()
        assert vec.np_random.random() != first
        vec.reset(seed=5)
        assert vec.np_random.random() == first

    @pytest.mark.parametrize("name", ["bandit", CONTROL])
    def test_actions_of_what_is_reset(self, name: str) -> None:
        """They are ignored, whatever numbers they are; those of the others are not."""
        vec = envs.make_vec(name, 2)
        vec.reset(seed=0)
        vec.batch.alive[:] = True, False
        wrong = 0.0 * vec.action_space.sample()
        wrong[1] = np.nan
        obs, reward, terminated, truncated, _ = vec.step(wrong)
        assert np.isfinite(obs).all()
        assert (reward[1], terminated[1], truncated[1]) == (0, False, False)
        with pytest.raises(envs.InputError, match=f"action of {name} held NaN"):
            vec.step(wrong)

    def test_spaces_of_single_environments(self) -> None:
        """Each has its own, whose samples are those of its seed, whatever is done to another's."""
        env, other = envs.make(CONTROL), envs.make(CONTROL)
        env.action_space.seed(0)
        first = env.action_space.sample()
        env.action_space.seed(0)
        other.action_space.seed(1)
        assert env.action_space.sample() == first

    def test_counts_of_stable_baselines(self) -> None:
        """A reset in the middle of episodes starts their counts, too."""
        vec = Sb3VecEnv(envs.get("bandit"), 2, 0)
        horizon, action = vec.env.task.horizon, np.zeros(2, int)
        vec.reset()
        for _ in range(3):
            vec.step(action)
        vec.reset()
        for _ in range(horizon):
            infos = vec.step(action)[3]
        assert [info["episode"]["l"] for info in infos] == [horizon, horizon]

    def test_returns_of_stable_baselines(self) -> None:
        """The rewards of the episode that is over, all of them, and how many there were."""
        vec, paid, ended, steps = Sb3VecEnv(Push(), 4, 0), np.zeros(4), 0, np.zeros(4, int)
        vec.reset()
        for _ in range(3 * Push.horizon):
            _, reward, done, infos = vec.step(np.zeros((4, 1)))
            paid += reward
            returns = [infos[i]["episode"]["r"] for i in np.flatnonzero(done)]
            np.testing.assert_allclose(returns, paid[done], rtol=1e-5)
            steps += 1
            assert [infos[i]["episode"]["l"] for i in np.flatnonzero(done)] == steps[done].tolist()
            paid[done], steps[done], ended = 0, 0, ended + done.sum()
        assert ended >= 12

    def test_seeds_of_stable_baselines(self) -> None:
        """They are those of the next reset alone, which the constructor's seed gives, too."""
        vec, same = Sb3VecEnv(Push(), 3, 5), envs.GymVectorEnv(Push(), 3, privileged=True)
        first, second = vec.reset(), vec.reset()
        np.testing.assert_array_equal(first, same.reset(seed=5)[0])
        np.testing.assert_array_equal(second, same.reset()[0])
        vec.seed(5)
        np.testing.assert_array_equal(vec.reset(), first)

    def test_time_limits_of_stable_baselines(self) -> None:
        """An episode that ran out of time is told from one that ended, whose value is 0."""
        vec, ended = Sb3VecEnv(Push(), 8, 0), list[tuple[bool, bool]]()
        vec.reset()
        for _ in range(3 * Push.horizon):
            for info in vec.step(np.zeros((8, 1)))[3]:
                if info:
                    terminated = Push().terminated(info["terminal_observation"][None])[0]
                    ended.append((bool(terminated), info["TimeLimit.truncated"]))
        assert {*ended} == {(True, False), (False, True)}


def test_a_checkout_without_symbolic_links(tmp_path: Path) -> None:
    """Where they are files of text, as on Windows, an editable install finds packages by pyproject's package-dir."""
    (tmp_path / "deconfounded").mkdir()
    for file in (ROOT / "deconfounded").iterdir():
        text = f"../{file.name}".encode() if file.is_dir() else file.read_bytes()
        if file.name != "__pycache__":
            (tmp_path / "deconfounded" / file.name).write_bytes(text)
    setup = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]
    code = """
import importlib.util, json, sys
from pathlib import Path

class Finder:
    @staticmethod
    def find_spec(name, path=None, target=None):
        folder = Path(sys.argv[1], folders[name]) if name in folders else None
        if folder and (folder / "__init__.py").is_file():
            return importlib.util.spec_from_file_location(name, folder / "__init__.py")

folders = json.loads(sys.argv[2])
sys.meta_path.insert(0, Finder)
import deconfounded.benchmarks.run
from deconfounded import envs
env = envs.make("slippery_cartpole")
env.reset(seed=0)
from deconfounded.experts import policy
policy.load(env.unwrapped.task)
print(json.dumps({name: one.__file__ for name, one in sys.modules.items() if name.partition(".")[0] == "deconfounded"}))
"""
    output = python("-c", code, ROOT, json.dumps(setup["package-dir"]), cwd=tmp_path, PYTHONPATH=str(tmp_path))
    for name, place in json.loads(output).items():
        folder = next((ROOT / name.split(".")[1] for one in setup["package-dir"] if name.startswith(one)), tmp_path)
        assert Path(place).is_relative_to(folder), name


class TestText:
    ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "ascii"}

    @pytest.mark.slow
    def test_files_name_their_encoding(self) -> None:
        """No file is read or written as text in whatever encoding the system has."""
        for folder in ("envs", "experts", "deconf", "benchmarks"):
            for file in (ROOT / folder).rglob("*.py"):
                calls = (node for node in ast.walk(ast.parse(file.read_bytes())) if isinstance(node, ast.Call))
                for call in calls:
                    method, where = getattr(call.func, "attr", ""), f"{file}:{call.lineno}"
                    if method in ("read_text", "write_text"):
                        given = len(call.args) + sum(key.arg == "encoding" for key in call.keywords)
                        assert given > (method == "write_text"), f"{where}: {method} without an encoding"
                    assert getattr(call.func, "id", "") != "open", f"{where}: open; there are read_bytes and files.py"

    @pytest.mark.slow
    def test_commands_in_the_c_locale(self, tmp_path: Path) -> None:
        """In a folder, and of a task, whose names are not ASCII: what cannot be printed is escaped."""
        home = tmp_path / "caf\u00e9"
        home.mkdir()
        (home / "\u00e9.py").write_text(
            "from deconfounded.envs.tasks.bandit import Bandit\nclass Own(Bandit):\n    name = 'own'\n"
        )
        code = """
import sys
from deconfounded import __main__ as entrance
from deconfounded.benchmarks.engine import local
local.cores = lambda: 1
for line in sys.argv[1:]:
    sys.argv = ["deconf", *line.split()]
    try:
        entrance.main()
    except SystemExit as ended:
        assert not ended.code, line
"""  # in one process: each would import for seconds
        run = f"run --task \u00e9.py:Own --methods conditional --preset smoke --out {home}/r --set eval_trials=4"
        output = python("-c", code, "--help", "run --list", run, cwd=home, MUJOCO_GL="off", **self.ASCII)
        assert "usage: deconf" in output
        assert "bandit: best_arm" in output
        assert "caf\\udcc3\\udca9/r/report.html" in output
        assert json.loads((home / "r" / "results.json").read_bytes())["task"] == "own"

    def test_names_that_the_locale_lacks(self, tmp_path: Path) -> None:
        """They are the same bytes as where it has them: files, and thetas of a salt."""
        name = b"caf\xc3\xa9"
        lacking = name.decode("ascii", "surrogateescape")
        write_atomically(tmp_path / "text", lacking)
        assert (tmp_path / "text").read_bytes() == name
        assert stream(3, 0, lacking) == stream(3, 0, name.decode())

    def test_data_are_on_the_disk_before_their_name(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """So that a loss of power leaves what a file held before, and no empty file."""
        done = list[str]()
        for name in ("fsync", "replace"):
            real = getattr(os, name)
            monkeypatch.setattr(os, name, lambda *given, name=name, real=real: (done.append(name), real(*given)))
        write_atomically(tmp_path / "file", "text")
        assert done == ["fsync", "replace"]
        assert (tmp_path / "file").read_text() == "text"

    @pytest.mark.parametrize(
        "start", [b"\xef\xbb\xbf# caf\xc3\xa9\n", b"# -*- coding: latin-1 -*-\n# caf\xe9\n"], ids=["bom", "cookie"]
    )
    def test_sources_in_other_encodings(self, start: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """As Python reads them: a task, an expert and a method; a method's name is what a record takes."""
        monkeypatch.setattr(catalogue.METHODS, "outside", {})
        (tmp_path / "own.py").write_bytes(start + OWN.encode())
        (tmp_path / "own_cartpole.xml").write_bytes((ROOT / "assets" / f"{CONTROL}.xml").read_bytes())
        (tmp_path / "expert.py").write_bytes(start + b"def control(obs, theta): return obs[:, :1]\n")
        (tmp_path / "caf\u00e9.py").write_bytes(
            start + b"from deconfounded.deconf.method import uses\n@uses()\ndef fit(given): 1 / 0\n"
        )
        task, expert = envs.get(f"{tmp_path}/own.py:Own"), f"{tmp_path}/expert.py:control"
        policy.load(task, expert)
        method = f"{tmp_path}/caf\u00e9.py:fit"
        assert catalogue.add(method) == "caf_"
        files = [sources.of_task(task), sources.of_reference(expert), sources.of_reference(method)]
        assert len({sources.digest(one) for one in files}) == 3
