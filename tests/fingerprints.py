"""Fingerprints: numbers of tiny deterministic runs, which move when a task, an expert, a method or a score does.

    python -m tests.fingerprints                     # what differs from tests/fingerprints.json
    python -m tests.fingerprints --write method:rma  # after its version was raised; `all`: whatever is new

Records are kept as long as versions stay (`benchmarks/engine/identity.py`), so that a change of numbers must raise one;
`test_fingerprints.py` checks that. Methods are trained for a few updates on the tasks of `toys.py`, in double
precision: then threads and CPU kernels move a number by some 1e-12, and a change of behaviour by far more.
"""

import argparse
import contextlib
import datetime
import hashlib
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from deconfounded import envs
from deconfounded.benchmarks.engine import benchmark, identity
from deconfounded.benchmarks.engine.benchmark import Recorder
from deconfounded.benchmarks.engine.catalogue import EXACT, METHODS, REFERENCES
from deconfounded.benchmarks.engine.context import EVALUATION, Context, stream
from deconfounded.benchmarks.engine.presets import Preset, preset
from deconfounded.benchmarks.output import index, scoring, statistics
from deconfounded.deconf.diagnosis import diagnose, measures
from deconfounded.envs.support.files import write_atomically
from deconfounded.experts import policy
from deconfounded.experts.agent import RandomAgent
from deconfounded.experts.rollout import run_trials
from tests import toys

FILE = Path(__file__).with_suffix(".json")
TOLERANCE = 2e-8  # of a number's size
SINGLE = 2e-6  # for experts, whose networks are of single precision
LIBRARIES = ("mujoco", "numpy", "torch")  # which may move numbers too
CONTROL = "tests.toys:control"
PRESET_FOR = ("bandit", "icy_stop", "ant_goal", "patchy_road", "rolling_deck")  # few numbers, many, latents, drift
Numbers = dict[str, list[float]]
FEW = {  # updates, rounds, batches and widths of every method: a second each
    **dict.fromkeys(("updates", "inference_updates", "offline_updates", "online_updates", "teacher_updates"), 3),
    **dict.fromkeys(("imitation_updates", "final_updates", "rounds", "refresh", "discriminator_updates"), 2),
    **dict.fromkeys(("epochs", "envs", "heads", "layers"), 2),
    **dict.fromkeys(("batch", "inference_batch", "offline_batch", "online_batch", "synthetic"), 4),
    **dict.fromkeys(("imitation_batch", "inference_steps", "online_steps", "steps", "samples"), 16),
    **dict.fromkeys(("teacher_batch", "minibatch", "discriminator_batch"), 16),
    **{"chunk": 5, "width": 8, "ahead": 3, "offline_steps": 10, "grid": 5},
}


def sums(values: Any) -> list[float]:
    """An array as three numbers: two weighted sums of its entries, no two weights alike, and their size."""
    x = np.asarray(values, float).ravel()
    at = np.arange(1, len(x) + 1)
    weights = np.stack([np.sin(at), np.cos(np.sqrt(2) * at)])
    return [*(weights @ x / np.sqrt(len(x))).tolist(), float(np.sqrt((x**2).mean()))]


class Double(TorchFunctionMode):
    """Meanwhile every float32 tensor of torch is a float64 one."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if kwargs.get("dtype") is torch.float32:
            kwargs["dtype"] = torch.float64
        out = func(*args, **kwargs)
        return out.double() if isinstance(out, Tensor) and out.dtype is torch.float32 else out


@contextlib.contextmanager
def double() -> Iterator[None]:
    """Train in double precision."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        with Double():
            yield
    finally:
        torch.set_default_dtype(before)


def of_task(name: str) -> Numbers:
    """Two episodes under given thetas, seeds and actions, and all that the task's class says in numbers."""
    task, n, steps = envs.get(name), 3, 20
    quantiles = np.array([0.1, 0.5, 0.9])[:, None]
    theta = np.concatenate([lat.ppf(quantiles) for lat in task.latents], -1)
    env, wrong = envs.BatchEnv(task, n), task.simulator(n)
    for i, row in enumerate(theta[::-1]):
        wrong.set_theta(i, row)
    rng, rows = np.random.default_rng(1), []
    for episode in range(2):
        env.reset(7, {"theta": theta}) if episode == 0 else env.reset(options={"keep_theta": True})
        for _ in range(steps):
            before, alive, held = env.state.copy(), env.alive.copy(), env.theta.copy()
            draw = rng.random((n, task.action_width))
            action = np.floor(draw * task.n_actions) if task.n_actions else 1.4 * draw - 0.7
            right, other = (s.outcome(before, action, None).copy() for s in (env.simulator, wrong))
            obs, reward, terminated, truncated = env.step(action)
            likely = [task.log_prob(env.state, out) for out in (right, other)]
            sensed = [task.log_sense(env.state, one) for one in (held, theta[::-1])]
            ends = np.stack([terminated, truncated], -1)
            columns = (obs, reward[:, None], ends, np.stack(likely, -1), np.stack(sensed, -1), held, env.state)
            rows.append([np.where(alive[:, None], column, 0) for column in columns])
    obs, reward, ends, likely, sensed, held, state = (np.stack(column) for column in zip(*rows, strict=True))
    numbers = {f"observation {key}": sums(obs[..., i]) for i, key in enumerate(task.observation)}
    numbers |= {"reward": sums(reward), "ends": sums(ends), "log-likelihood": sums(likely), "state": sums(state)}
    numbers |= {"log-likelihood of readings": sums(sensed), "theta": sums(held)}
    latents = [[lat.low, lat.high, lat.drift, *lat.grid(4), *lat.encode(lat.grid(4)).ravel()] for lat in task.latents]
    numbers["latents"] = sums(np.concatenate(latents))
    drawn = task.sample_theta(envs.streams.Streams([np.random.default_rng(i) for i in range(4)]))
    numbers["draws of theta"] = sums(drawn)
    numbers["transition"] = sums(task.transition(5))
    numbers["bounds of observations"] = sums(list(task.observation.values()))
    about = (task.horizon, task.episodes, task.control_dt, task.expert_noise, task.tier or 0, task.moves_state)
    numbers["horizon, episodes, control_dt, expert_noise, tier, moves_state"] = [float(x) for x in about]
    return numbers


def of_expert(name: str) -> Numbers:
    """Actions and log-probabilities on given inputs, and its weights' checksum."""
    task, rng = envs.get(name), np.random.default_rng(2)
    expert, space = policy.load(task), task.observation_space
    obs = (0.5 * rng.standard_normal((32, len(task.observation)))).clip(space.low, space.high).astype(np.float32)
    theta = np.concatenate([lat.ppf(rng.random((32, 1))) for lat in task.latents], -1)
    action = expert.act(obs, theta, envs.streams.Streams([rng]))
    numbers = {"action": sums(action), "log-probability": sums(expert.log_prob(obs, action, theta))}
    if isinstance(expert, policy.BoxExpert):
        numbers["mean action"] = sums(expert.mean(obs, theta))
    weights = policy.fingerprint(task)
    numbers["sha256 of weights"] = [float(int(weights[:12], 16) if weights != "closed form" else 0)]
    return numbers


def few(values: dict[str, Any]) -> dict[str, Any]:
    """A configuration with few updates, and all else as it is."""
    return {name: FEW.get(name, value) for name, value in values.items()}


def small(amounts: Preset) -> Preset:
    """A preset with few trials and updates."""
    configs = {name: few(values) for name, values in amounts.configs.items()}
    return replace(amounts, expert_trials=5, explore_trials=4, query_trials=4, eval_trials=4, configs=configs)


def amounts_of(name: str, task: str) -> list[float]:
    """A number that stands for a method's hyperparameters on a task, of which `few` leaves little."""
    config = preset("default", envs.get(task), "cpu", [name]).configs.get(name, {})
    text = json.dumps({key: value for key, value in config.items() if key != "device"}, sort_keys=True)
    return [float(int(hashlib.sha256(text.encode()).hexdigest(), 16) % 10**6)]


def of_method(name: str) -> Numbers:
    """A few updates on each toy task; what the agent then does there, and what it remembers."""
    from deconfounded.benchmarks.engine.catalogue import label
    from deconfounded.benchmarks.engine.provider import deployed, fit

    numbers = {f"amounts on {task}": amounts_of(name, task) for task in PRESET_FOR}
    for task in (toys.Push(), toys.Arms(), toys.Drift()):
        amounts = small(preset("default", task, "cpu", [name]))
        if task.drifts and name not in EXACT and "drifts" not in amounts.configs.get(name, {}):
            continue
        source = None if task.n_actions else CONTROL
        with double():
            context = Context(task, amounts, (0,), expert=source)
            for way, agent in deployed(name, fit(context, name)).items():
                recorder = Recorder(agent, context.env)
                seeds = [stream(EVALUATION, 0, "fingerprint")]
                trials, returns, _ = run_trials(context.env, recorder, task.episodes, seeds)
                recorder.note()
                where = f"{label(name, way)} on {task.name}"
                numbers |= {f"actions of {where}": sums(trials.action), f"returns of {where}": sums(returns)}
                if recorder.features_after:
                    numbers[f"memory of {where}"] = sums(np.stack(recorder.features_after))
    return numbers


def of_protocol(name: str) -> Numbers:
    """Seeds by purpose, and what is measured of an agent beside its returns."""
    task, rng = toys.Push(), np.random.default_rng(3)
    expert = policy.load(task, CONTROL)
    env = envs.BatchEnv(task, 4)
    seeds = [stream(purpose, seed, salt) for purpose in (1, 2, 3, 4) for seed in (0, 1) for salt in ("", "salt")]
    trials, returns, _ = run_trials(env, RandomAgent(task.action_space), 2, seeds[:2])
    theta = rng.uniform(-1, 1, (4, 2, 1))
    features = rng.standard_normal((40, 6))
    r2, _ = benchmark.probe(features, features[:, :2] + 0.3 * rng.standard_normal((40, 2)))
    return {
        "seeds": sums(np.array(seeds) / 2**31),
        "observations": sums(trials.obs),
        "actions": sums(trials.action),
        "mask": sums(trials.mask),
        "returns": sums(returns),
        "Eq. (1)": sums(benchmark.objective(expert, trials, theta)),
        "probe R2": [r2],
    }


def of_scores(name: str) -> Numbers:
    """Scores, intervals and figures over tasks, of a fixed set of returns on two tasks."""
    rng, numbers = np.random.default_rng(4), Numbers()
    last = {}
    for task, (zero, one) in {"first": (1.0, 9.0), "second": (-40.0, -5.0)}.items():
        level = {"random": zero, "expert": one, "deconfounded": one - 0.1 * (one - zero), "naive_rnn": (zero + one) / 2}
        records = {
            method: [
                {
                    "method": method,
                    "deployment": "",
                    "seed": seed,
                    "returns": (mean + 0.1 * (one - zero) * rng.standard_normal(4)).tolist(),
                    "objective": rng.standard_normal(4).tolist(),
                    "theta_r2": rng.random(4).tolist(),
                    "tier": "1",
                    "method_version": 1,
                    "budget": {"expert_trials": 4 + seed},
                    "cpu_s": 1.0 + seed,
                }
                for seed in range(4)
            ]
            for method, mean in level.items()
        }
        own = (float(np.mean([seed["returns"][:2] for seed in records[name]])) for name in REFERENCES)
        methods = scoring.summarise(records, 2, tuple(own))
        last[task] = index.last_scores(methods)
        for key in ("score", "score_last", "score_beyond", "ci95", "band", "objective", "theta_r2", "cpu_s", "return"):
            numbers[f"{key} of the {task} task"] = sums(
                np.stack([np.asarray(entry[key]) for entry in methods.values()])
            )
    runs = {method: {task: np.array([*of[method].values()]) for task, of in last.items()} for method in last["first"]}
    ours, naive = runs["deconfounded"], runs["naive_rnn"]
    for key, figure in {
        "interquartile mean": statistics.over_tasks(statistics.iqm, ours),
        "probability of improvement": statistics.over_tasks(statistics.improvement, ours, naive),
        "profile": statistics.over_tasks(lambda x: statistics.profile(x, index.THRESHOLDS), ours),
        "paired difference": statistics.paired(last["first"]["deconfounded"], last["first"]["naive_rnn"]),
    }.items():
        assert figure is not None
        assert figure.interval is not None
        numbers[key] = sums(np.concatenate([np.ravel(figure.value), *map(np.ravel, figure.interval)]))
    return numbers


def of_diagnosis(name: str) -> Numbers:
    """What a diagnosis measures of a few trials of a toy task, with few updates."""
    task = toys.Push()
    with double():
        context = Context(task, replace(small(preset("default", task, "cpu")), expert_trials=12), (0,), expert=CONTROL)
        trials, explored = context.demonstrations, context.explore(None, context.rngs, 12)
        env = envs.BatchEnv(task, 72)  # enough to see that they are alike
        alike = run_trials(env, RandomAgent(task.action_space), 8, 0, np.zeros((env.n, 1))).trials
        amounts = diagnose.DiagnoseConfig().amounts
        parts = {part: getattr(amounts, part) for part in ("cloning", "naive", "offline", "exploring")}
        less = {part: replace(config, **few(asdict(config))) for part, config in parts.items()}
        amounts = replace(amounts, **less, candidates=4, rollouts=8)
        measured = {
            label: measures.measure(trials, exploration, amounts, np.random.default_rng(5))
            for label, exploration in (
                ("with exploration", explored),
                ("with exploration that is alike", alike),
                ("of expert trials alone", None),
            )
        }
    return {
        f"{key} {label}": sums(np.asarray(value, float))
        for label, figures in measured.items()
        for key, value in figures._asdict().items()
        if value is not None
    }


NAMES = [*envs.SUITE, *envs.HARD]
Kind = tuple[Callable[[str], Numbers], Callable[[str], int], list[str], str]
KINDS: dict[str, Kind] = {
    "task": (
        of_task,
        lambda name: envs.get(name).version,
        NAMES,
        "`version` of its class in envs/tasks",
    ),
    "expert": (
        of_expert,
        lambda name: policy.version(envs.get(name)),
        NAMES,
        "`version` in its card under assets/experts (of a closed form, of its task)",
    ),
    "method": (
        of_method,
        lambda name: METHODS[name].version,
        list(METHODS),
        "`version` in its file in deconf/methods",
    ),
    "protocol": (of_protocol, lambda name: identity.PROTOCOL, ["all"], "PROTOCOL in benchmarks/engine/identity.py"),
    "scores": (of_scores, lambda name: scoring.VERSION, ["all"], "VERSION in benchmarks/output/scoring.py"),
    "diagnosis": (of_diagnosis, lambda name: diagnose.VERSION, ["all"], "VERSION in deconf/diagnosis/diagnose.py"),
}
EVERY = [f"{kind}:{name}" for kind, (_, _, names, _) in KINDS.items() for name in names]


def numbers(label: str) -> Numbers:
    """Those of task:bandit, say, as they are today."""
    kind, _, name = label.partition(":")
    return {key: [float(f"{x:.9g}") for x in values] for key, values in KINDS[kind][0](name).items()}


def version(label: str) -> int:
    """Today's version."""
    kind, _, name = label.partition(":")
    return KINDS[kind][1](name)


def moved(before: Numbers, now: Numbers, tolerance: float = TOLERANCE) -> list[str]:
    """Which numbers differ: `reward was 1.2, is 1.3`. What had none is not among them: see `added`."""
    changes = []
    for key, was in before.items():
        today = now.get(key)
        if today is None or len(was) != len(today):
            changes.append(f"{key} was {was}, is {today}")
            continue
        size = max(1e-9, *map(abs, was))
        for x, y in zip(was, today, strict=True):
            if not abs(x - y) <= tolerance * size:
                changes.append(f"{key} was {x:.9g}, is {y:.9g}")
                break
    return changes


def added(before: Numbers, now: Numbers) -> list[str]:
    """What has numbers now and had none: another deployment of an agent, say, which changes no record that is kept."""
    return [key for key in now if key not in before]


def libraries() -> dict[str, str]:
    """Versions of what may move numbers; of torch without its build."""
    versions = identity.versions()
    return {name: versions[name].partition("+")[0] for name in LIBRARIES}


def kept() -> dict[str, Any]:
    """The file: by label, its version, since when, and numbers."""
    return json.loads(FILE.read_text(encoding="utf-8")) if FILE.is_file() else {}


def problem(label: str, entry: dict[str, Any] | None) -> str:
    """In a sentence, how a fingerprint differs from the one kept, and what to do; empty if it does not."""
    where, tolerance = KINDS[label.partition(":")[0]][3], SINGLE if label.startswith("expert:") else TOLERANCE
    renew = f"run `python -m tests.fingerprints --write {label}`"
    if entry is None:
        return f"{label} has no fingerprint yet: {renew}"
    try:
        now, today = numbers(label), version(label)
    except envs.InputError as error:  # weights that are not those of their card, say
        return f"{label} of {entry['since']} cannot be computed: {error}"
    if today != entry["version"]:
        return f"{label} is v{today} now, and its fingerprint, of {entry['since']}, is of v{entry['version']}: {renew}"
    changes, new = moved(entry["numbers"], now, tolerance), added(entry["numbers"], now)
    if not changes:
        return f"{label} has no fingerprint yet of {', '.join(new)}: {renew}" if new else ""
    more = f" and {len(changes) - 1} more" if len(changes) > 1 else ""
    return (
        f"{label} v{today} does otherwise than since {entry['since']}: {changes[0]}{more}. Undo that; or, if it is"
        f" meant, raise {where}, which supersedes its records, and {renew}"
    )


def renewed(label: str, entry: dict[str, Any] | None) -> dict[str, Any] | None:
    """The fingerprint to keep: of a new version, or with what had no numbers; None where numbers moved without one."""
    now = numbers(label)
    if entry is None or entry["version"] != version(label):
        today = datetime.datetime.now(tz=datetime.UTC).date().isoformat()
        return {"version": version(label), "since": today, "libraries": libraries(), "numbers": now}
    tolerance = SINGLE if label.startswith("expert:") else TOLERANCE
    if moved(entry["numbers"], now, tolerance):
        return None
    return {**entry, "numbers": entry["numbers"] | {key: now[key] for key in added(entry["numbers"], now)}}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", nargs="+", metavar="LABEL", default=[], help="task:bandit, say, or all")
    wanted = parser.parse_args().write
    if unknown := [label for label in wanted if label not in (*EVERY, "all")]:
        sys.exit(f"error: {unknown[0]!r} is unknown; there are {', '.join(EVERY)}")
    entries, problems = kept(), 0
    for label in EVERY:
        entry = entries.get(label)
        if not (said := problem(label, entry)):
            continue
        if {label, "all"} & set(wanted) and (again := renewed(label, entry)):
            entries[label] = again
            print(f"{label}: written")
            continue
        problems += 1
        print(said)
    lines = [f"{json.dumps(label)}: {json.dumps(entries[label])}" for label in EVERY if label in entries]
    write_atomically(FILE, "{\n" + ",\n".join(lines) + "\n}\n")
    sys.exit(problems > 0)


if __name__ == "__main__":
    main()
