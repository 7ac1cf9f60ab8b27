"""Odd inputs to every command and to the API: `python -m tests.faults.inputs` (8 CPU seconds)

Each command with each of its options at odd values, one at a time, in this process; what would train, measure or write
is replaced by a mark that it was reached. *told*: one line and exit code 2 (of a call: an InputError of one line).
*accepted*: taken as it is, which the case must say is right. Anything else is a traceback, or accepted in silence.
"""

import argparse
import contextlib
import importlib
import io
import resource
import shutil
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import deconfounded
from deconfounded import envs
from deconfounded.__main__ import COMMANDS
from deconfounded.benchmarks.console import run_command
from deconfounded.benchmarks.engine.benchmark import spaces
from deconfounded.benchmarks.engine.context import Context
from deconfounded.deconf.core.agents import LearnedAgent
from deconfounded.deconf.methods.memoryless_bc import MemorylessConfig, train
from deconfounded.experts import policy, saved_agents
from deconfounded.experts.rollout import run_trials
from deconfounded.experts.trials import Trials
from tests.tools import tiny_preset

REACHED = (  # where a command's work begins
    *("benchmarks.engine.scheduler.run_all", "benchmarks.certify.certify", "experts.train.train"),
    *("benchmarks.studies.stepping.seconds", "benchmarks.studies.performance.update_seconds"),
    *("experts.datasets.collect", "benchmarks.score.rescore", "benchmarks.verify.rerun"),
    *("benchmarks.output.run_report.write", "benchmarks.studies.publish.write"),
    *("benchmarks.check.check_task",),
)
MOST = 4 << 30  # bytes of memory, so that what asks for more is seen here
CONTROL = "slippery_cartpole"
COUNTS = ("-1", "0", "1.5", "1e20", "nan", "inf", "", "many", "1" + 20 * "0", "0x10", "1 2", "True")
SEEDS = ("-1", "1.5", "nan", "", "a", "0x10")
TASKS = (
    "",
    " ",
    "bandid",
    "Bandit",
    "nonsense",
    "gone.py:T",
    ":",
    "a:b:c",
    "/etc/passwd:X",
    "../..",
    "os:path",
    "é",
    "json:loads",
)
DEVICES = ("", "hpu", "cuda:99", "meta", "gpu", "cpu:x", "-1")
FOLDERS = ("", " ", "/proc/none", "/dev/null", "/dev/null/x", "{file}", "{file}/x", "x" * 300)
EXPERTS = ("", "gone.safetensors", "gone.py:f", "{file}", "{folder}", ":", "os:nothing", "os:sep", "{junk}")
AGENTS = ("", "nowhere", "/proc/none", "{file}", "{folder}")
OF_NAIVE = ("", "=", "=-1", "=1e400", "=NaN", "=true", "=1.5", "=" + "9" * 30)
SETS = (
    *("", "=", "x", "x=1", "naive", "nonsense.updates=1", "a.b.c=1"),
    *(f"naive_rnn.updates{rest}" for rest in OF_NAIVE),
    *("seeds=0", "seeds=1000000000", "seeds=[1]", "device=cuda", "deconfounded.model=tree"),
    *("eval_trials=0", "expert_trials=", "expert_trials=99999999999999"),
    *(f"naive_rnn.{amount}" for amount in ("x=1", "width=0", "learning_rate=-1", "learning_rate=fast", "cooled=1")),
    "naive_rnn.device=cuda",
)
ODD: dict[str, tuple[tuple[str, ...], dict[str, tuple[str, ...]]]] = {  # command: what it is given beside, and options
    "run": (
        ("--task", "bandit", "--out", "{new}"),
        {
            **{"--task": TASKS, "--seeds": (*COUNTS, "1000000000"), "--device": DEVICES, "--out": FOLDERS},
            **{"--methods": ("", "naive", "all,", "gone.py:fit", "os:path", "{junk}:fit", "-"), "--set": SETS},
            **{"--preset": ("", "smok", "DEFAULT", "1"), "--expert": EXPERTS, "--track": ("", "wandb")},
            **{"--seed": ("1",), "--list": ("x",), "--resume": ("yes",)},
        },
    ),
    "paper": (
        ("--out", "{new}"),
        {"--seeds": COUNTS, "--methods": ("oracle_bc", ""), "--out": FOLDERS, "--set": SETS[:8]},
    ),
    "certify": (("--task", CONTROL, "--out", "{new}"), {"--task": TASKS, "--expert": EXPERTS, "--out": FOLDERS}),
    "check": ((), {"--task": TASKS}),
    "train": (
        ("--task", CONTROL, "--out", "{new}/e.safetensors"),
        {
            **{"--task": (*TASKS, "bandit"), "--steps": COUNTS, "--seed": (*SEEDS, "4294967296")},
            "--out": (*FOLDERS, "{folder}", "{new}/e.npz", "/proc/none/e.safetensors", "{file}/e.safetensors"),
        },
    ),
    "data": (
        ("--task", "bandit", "--out", "{new}"),
        {"--task": TASKS[:6], "--trials": COUNTS, "--seed": SEEDS, "--out": FOLDERS, "--expert": EXPERTS},
    ),
    "play": (
        ("--agent", "{agent}", "--task", "bandit"),
        {
            **{"--agent": AGENTS, "--task": (*TASKS[:6], CONTROL), "--episodes": COUNTS, "--seed": SEEDS},
            **{
                "--theta": ("nan", "", "-1", "9", "0.5", "1e400", "x"),
                "--video": (*FOLDERS, "{new}/x.gif", "/proc/x.mp4"),
            },
        },
    ),
    "score": (
        ("--agent", "{agent}", "--task", "bandit"),
        {
            **{"--agent": AGENTS, "--trials": (*COUNTS, "1"), "--seed": SEEDS, "--out": (*FOLDERS, "{folder}")},
            "--range": (
                "",
                "x",
                "best_arm",
                "best_arm=",
                "best_arm=0",
                "best_arm=nan:1",
                "best_arm=1:0",
                "best_arm=0:9",
                "x=0:1",
            ),
        },
    ),
    "verify": ((), {"record": ("", "nowhere.json", "{folder}", "{file}", "{junk}", "/proc/none")}),
    "push": (("{agent}",), {"repo": ("", "me", "me/", "me/a b", "../x", "me/a/b", "datasets/")}),
    "pull": (("--out", "{folder}"), {"repo": ("", "me", "me/", "me/a b", "../x", "me/a/b", "datasets/")}),
    "report": ((), {"run": ("", "nowhere", "{file}", "{folder}", "/proc/none")}),
    "publish": ((), {"run": ("", "nowhere", "{file}", "{folder}", "/proc/none")}),
    "performance": (
        ("--tasks", CONTROL, "--out", "{new}"),
        {"parts": ("", "sped", "-1"), "--tasks": (*TASKS[:6], "bandit"), "--device": DEVICES, "--out": FOLDERS},
    ),
}


class Reached(BaseException):
    """The command began its work."""


def ran(command: str, args: list[str]) -> str:
    """What became of a command with these arguments, in this process: told, accepted, or what else."""
    main = importlib.import_module(f"deconfounded.{COMMANDS[command][0]}").main
    out, err = io.StringIO(), io.StringIO()
    with (
        mock.patch("sys.argv", [command, *args]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            run_command(main)
        except Reached:
            return "accepted"
        except SystemExit as ended:
            lines = err.getvalue().strip().splitlines()
            if ended.code == 2 and len(lines) == 1 and lines[0].startswith("error: "):
                return "told"
            return f"exit {ended.code}, {len(lines)} lines: {lines[-1:]}"
        except BaseException as error:
            at = traceback.extract_tb(error.__traceback__)[-1]
            return f"traceback: {type(error).__name__}: {str(error)[:100]} ({Path(at.filename).name}:{at.lineno})"
    return "accepted"


def commands(folder: Path) -> Iterator[tuple[str, str]]:
    """Each command with each option at each odd value: what was run, and what became of it."""
    made = {name: str(folder / name) for name in ("file", "folder", "new", "agent", "junk")}
    (folder / "file").write_text("x")
    (folder / "folder").mkdir()
    (folder / "junk").write_bytes(b"\xff\x00 junk {")
    preset = tiny_preset()
    demonstrations = Context(envs.get("bandit"), preset, [0]).demonstrations
    agent = train(demonstrations, MemorylessConfig(updates=3, batch=64), [np.random.default_rng(0)])
    assert isinstance(agent, LearnedAgent)
    saved_agents.save(agent, folder / "agent", spaces=spaces(envs.get("bandit")))
    for command, (base, options) in ODD.items():
        for option, values in options.items():
            for value in values:
                shutil.rmtree(folder / "new", ignore_errors=True)
                given, rest = [one.format(**made) for one in base], value.format(**made)
                if option.startswith("--"):
                    if option in given:
                        at = given.index(option)
                        del given[at : at + 2]
                    given += [option, rest]
                else:
                    given.append(rest)
                yield f"{command} {option} {value[:40]!r}", ran(command, given)


def calls() -> dict[str, Callable[[], Any]]:
    """Calls of the API with something odd; all must be told."""
    env, vec, dm = envs.make(CONTROL), envs.make_vec(CONTROL, 2), envs.make_dm(CONTROL, seed=0)
    arm = envs.make("bandit")
    for one in (env, vec, arm):
        one.reset(seed=0)
    dm.reset()
    rng = np.random.default_rng(0)
    obs, action, mask = np.zeros((2, 1, 4, 3)), np.zeros((2, 1, 3, 1)), np.ones((2, 1, 3), bool)
    trials = Trials(obs, action, mask)
    agent = train(trials, MemorylessConfig(updates=1, batch=4), [rng])
    batch, task = envs.BatchEnv(envs.get("bandit"), 4), envs.get(CONTROL)
    odd: dict[str, Callable[[], Any]] = {}
    for name in (None, 3, b"bandit", "", [], "bandid", True, 1.5, ("bandit",), np.zeros((2, 1))):
        odd |= {
            f"make({name!r})": lambda n=name: envs.make(n),
            f"make_vec({name!r}, 2)": lambda n=name: envs.make_vec(n, 2),
        }
        odd |= {f"make_dm({name!r})": lambda n=name: envs.make_dm(n), f"get({name!r})": lambda n=name: envs.get(n)}
    for n in (0, -1, 1.5, None, "2", True, np.nan, 10**20, [2], 2.0):
        odd[f"make_vec(n={n!r})"] = lambda n=n: envs.make_vec(CONTROL, n)
        odd[f"make_vec(episodes={n!r})"] = lambda n=n: envs.make_vec(CONTROL, 2, episodes=n)
        odd[f"BatchEnv(n={n!r})"] = lambda n=n: envs.BatchEnv(task, n)
    for seed in ("a", -1, 1.5, [1], np.nan, b"", (1, -2), {}, "1", True, [None, []]):
        odd[f"make_dm(seed={seed!r})"] = lambda s=seed: envs.make_dm(CONTROL, seed=s)
        odd[f"vec.reset(seed={seed!r})"] = lambda s=seed: vec.reset(seed=s)
        odd[f"BatchEnv.reset({seed!r})"] = lambda s=seed: batch.reset(s)
    for mode in ("human", "", 1, "ansi", True):
        odd[f"make(render_mode={mode!r})"] = lambda m=mode: envs.make(CONTROL, render_mode=m)
    for keep in ("False", "True", 1, 0, None, [1, 0], [True], [[True, False]], {}, np.nan):
        odd[f"vec.reset(keep_theta={keep!r})"] = lambda k=keep: vec.reset(options={"keep_theta": k})
        odd[f"env.reset(keep_theta={keep!r})"] = lambda k=keep: env.reset(options={"keep_theta": k})
    for theta in ("a", [], [np.nan], [9.0], [[0.1, 0.2]], {}, [None], "0.1", [np.inf], [-1], object()):
        odd[f"env.reset(theta={theta!r})"] = lambda t=theta: env.reset(options={"theta": t})
        odd[f"vec.reset(theta={theta!r})"] = lambda t=theta: vec.reset(options={"theta": t})
    for options in ({"thetas": 1}, {1: 2}, "theta", [1], 3, {"theta": [0.1], "keep_theta": True}):
        odd[f"env.reset(options={options!r})"] = lambda o=options: env.reset(options=o)
        odd[f"vec.reset(options={options!r})"] = lambda o=options: vec.reset(options=o)
        odd[f"dm.reset(options={options!r})"] = lambda o=options: dm.reset(options=o)
    wrong = ("left", ["0.1"], None, [np.nan], [np.inf], [0.1, 0.2], [[0.1, 0.2]], {}, object(), b"1", [[]], [1j])
    for act in (*wrong, [None, []]):
        odd[f"env.step({act!r})"] = lambda a=act: env.step(a)
        odd[f"vec.step({act!r})"] = lambda a=act: vec.step(a)
        odd[f"dm.step({act!r})"] = lambda a=act: dm.step(a)
    for pull in (5, -1, 0.5, np.nan, "1", [0, 1], None, [[0]] * 2):
        odd[f"bandit.step({pull!r})"] = lambda p=pull: arm.step(p)
    for what, value in (
        *(("obs", one) for one in ("x", None, [], np.zeros((2, 1, 3, 3)), obs * np.nan, [[1], [1, 2]])),
        *(("action", one) for one in ("x", None, [], action + 2, action * np.nan, np.zeros((2, 1, 3)))),
        *(("mask", one) for one in ("x", [], mask & False, mask[0], np.ones((2, 1, 4), bool))),
        *(("actions", one) for one in (-1, "2", 1.5, None)),
    ):
        given = {"obs": obs, "action": action, "mask": mask, "actions": 0, what: value}
        odd[f"Trials({what}={str(value)[:20]!r})"] = lambda g=given: Trials(**g)
    for file in ("nowhere", "", "/proc/none", ".", None, 3):
        odd[f"load({file!r})"] = lambda f=file: deconfounded.load(f)
        odd[f"Trials.load({file!r})"] = lambda f=file: Trials.load(f)
        odd[f"policy.load({file!r})"] = lambda f=file: policy.load(task, f) if f else policy.load(task, "gone")
    for n in (0, -1, 3.5, None, "4"):
        odd[f"agent.begin({n!r})"] = lambda n=n: agent.begin(n)
    for rngs in ([], [rng, rng], None, 3, [3]):
        odd[f"agent.reset({str(rngs)[:20]!r})"] = lambda r=rngs: (
            agent.begin(2),
            agent.reset(r),
            agent.act(np.zeros((2, 3), "f4")),
        )
    for seen in (np.zeros(3), np.zeros((1, 3)), np.zeros((2, 4)), None, "x"):
        odd[f"agent.act({str(seen)[:20]!r})"] = lambda s=seen: (agent.begin(2), agent.reset([rng]), agent.act(s))
    odd["run_trials(seeds that do not divide)"] = lambda: run_trials(batch, agent, 1, [0, 1, 2])
    return odd


def called(call: Callable[[], Any]) -> str:
    """What became of a call."""
    try:
        call()
    except envs.InputError as error:
        return "told" if "\n" not in str(error) else "more than a line"
    except BaseException as error:
        at = traceback.extract_tb(error.__traceback__)[-1]
        theirs = "gymnasium" in at.filename or type(error).__module__.startswith("gymnasium")
        line = f"{type(error).__name__}: {str(error)[:100]} ({Path(at.filename).name}:{at.lineno})"
        return "told by gymnasium" if theirs else f"traceback: {line}"
    return "accepted"


def main() -> None:
    """The command line."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (MOST, MOST))
    outcomes: Counter[str] = Counter()
    bad = []
    with tempfile.TemporaryDirectory() as scratch, contextlib.ExitStack() as marks, contextlib.chdir(scratch):
        for name in REACHED:
            place, _, attribute = f"deconfounded.{name}".rpartition(".")
            importlib.import_module(place)
            marks.enter_context(mock.patch(f"{place}.{attribute}", side_effect=Reached))
        for what, became in commands(Path(scratch)):
            outcomes[f"commands: {became.partition(':')[0]}"] += 1
            if became != "told" and what not in ACCEPTED:
                bad.append(f"{what} -> {became}")
                print(bad[-1], flush=True)
    for what, call in calls().items():
        became = called(call)
        outcomes[f"calls: {became.partition(':')[0]}"] += 1
        if not became.startswith("told") and what not in ACCEPTED:
            bad.append(f"{what} -> {became}")
            print(bad[-1], flush=True)
    print(f"{outcomes.total()} odd inputs: {', '.join(f'{count} {what}' for what, count in sorted(outcomes.items()))}")
    print(f"{len(bad)} to be mended")
    sys.exit(bool(bad))


ACCEPTED = {  # rightly, though they look odd
    *(
        "score --out '{file}'",
        "make_vec(episodes=100000000000000000000)",
        "make_dm(seed=[1])",
        "vec.step([0.1, 0.2])",
    ),
    "env.reset(keep_theta=[True])",
}

if __name__ == "__main__":
    main()
