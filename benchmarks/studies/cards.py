"""docs/tasks.md: the card of every task, read off its class, its models and its certificate."""

import inspect
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks.engine import published
from deconfounded.envs.patches import PatchedTask
from deconfounded.envs.support.files import write_json

DOCS = Path(__file__).resolve().parents[2] / "docs"
TIERS = {None: "none: no imitator can succeed", 2: "2: exploration is enough", 3: "3: queries of the expert are needed"}


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Rows of cells under a head."""
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, ("---",) * len(head), *rows))


def kept(name: str) -> Any:
    """What the .json file of that name in docs/ holds, if there is one."""
    file = DOCS / f"{name}.json"
    return json.loads(file.read_bytes()) if file.is_file() else None


def changed(file: Path, change: Callable[[Any], Any]) -> Any:
    """Change what a .json file holds, in one step, and return it; meanwhile other programs wait to do so.

    change: what it holds (None: there is none) -> what it is to hold.
    """
    from filelock import FileLock

    with FileLock(file.with_suffix(".lock")):
        made = change(json.loads(file.read_bytes()) if file.is_file() else None)
        write_json(file, made)
    return made


def nats(certificate: dict[str, Any]) -> list[str]:
    """Evidence of theta a step, along expert trajectories: from dynamics, from actions."""
    evidence = (certificate["evidence_nats_per_step"][kind] for kind in ("dynamics", "actions"))
    return [f"{value:,.2f}" if value < 10 else f"{value:,.0f}" for value in evidence]


def certified(names: Sequence[str] = envs.SUITE) -> dict[str, dict[str, Any]]:
    """Those of the tasks that have a certificate in docs/, and what it holds."""
    return {name: certificate for name in names if (certificate := kept(certificate_of(name)))}


def certificate_of(name: str) -> str:
    """Where in docs/ a task's certificate is kept, and its picture, without the end of their names."""
    return published.certificate(name, "").relative_to(DOCS).as_posix()


def certificates(held: dict[str, Any]) -> str:
    """The table of certificates of docs/concepts.md."""
    rows, required = [], list[str]()
    for name, certificate in held.items():
        checks = [(check["measured"], check.get("sure", True)) for check in certificate["checks"].values()]
        measured = (f"{value:.2f}{'' if sure else '?'}" for value, sure in checks)
        rows.append((name, *measured, *nats(certificate), certificate["verdict"]))
        required = [f"{name} ({check['required']})" for name, check in certificate["checks"].items()]
    return markdown_table(("task", *required, "dynamics, nats a step", "actions, nats a step", "verdict"), rows)


def _certificate(task: envs.Task) -> str:
    certificate = kept(certificate_of(task.name))
    if certificate is None:
        return "No certificate."
    checks = (f"{name} {check['measured']:.2f} ({check['required']})" for name, check in certificate["checks"].items())
    episodes, (dynamics, actions) = len(certificate["conditional"]["score"]), nats(certificate)
    return (
        f"Certificate ({episodes} episodes a trial) {certificate['verdict']}: {', '.join(checks)}."
        f" Evidence of theta along expert trajectories: dynamics {dynamics}, actions {actions} nats a step."
    )


def _moved(task: envs.MujocoTask, latent: int) -> str:
    """What of the model a latent moves, read off models that differ in it alone: arrays, and whose entries."""
    middle = np.array([lat.grid(3)[-1 if lat.distribution == "categorical" else 1] for lat in task.latents])
    thetas = np.repeat(middle[None], 2, 0)
    thetas[:, latent] = task.latents[latent].grid(9)[[0, -1]]
    simulator, moved = task.simulator(2), []
    for i, theta in enumerate(thetas):
        simulator.set_theta(i, theta)
    low, high = simulator.models
    kinds = {name: getattr(low, name) for name in ("body", "geom", "tendon", "actuator", "site")} | {"jnt": low.joint}
    for field in dir(low):
        value = None if field.startswith(("cam_", "light_")) else getattr(low, field, None)
        if isinstance(value, np.ndarray) and (differs := value != getattr(high, field)).any():
            rows = np.flatnonzero(differs.reshape(len(differs), -1).any(1))
            kind = field.split("_")[0]
            if kind == "dof":
                kind, rows = "jnt", low.dof_jntid[rows]
            names = ", ".join(kinds[kind](int(row)).name for row in rows) if kind in kinds else ""
            moved.append(f"`{field}` of {names}" if names else f"`{field}`")
    moved += [name for name in ("gravity", "wind") if (getattr(low.opt, name) != getattr(high.opt, name)).any()]
    return "; ".join(moved) or "nothing"


def card(task: envs.Task) -> str:
    """Markdown: what the docstrings say, latents, observation, noise, tier, certificate."""
    head: tuple[str, ...] = ("latent", "unit", "range", "distribution")
    latents: list[tuple[str, ...]] = []
    for lat in task.latents:
        drift = f", drifts by {lat.drift:g}" if lat.drift else ""
        switch = f", drawn anew after a step with probability {lat.switch:g}" if lat.switch else ""
        latents.append((lat.name, lat.unit, f"{lat.low:g} to {lat.high:g}", lat.distribution + drift + switch))
    more, noise = "", list[tuple[str, ...]]()
    if isinstance(task, envs.MujocoTask):
        head, latents = (
            (*head, "what it moves in the model"),
            [(*row, _moved(task, 0 if isinstance(task, PatchedTask) else i)) for i, row in enumerate(latents)],
        )
        more = f", {task.control_dt:g} s each; the expert's action noise is {task.expert_noise:g}"
        for joint, stds in task.process_noise.items():  # of a free joint, two of each: position and rotation
            half = len(stds) // 2
            noise.append((joint, *(", ".join(f"{std:g}" for std in part) for part in (stds[:half], stds[half:]))))
    parts = [f"## {task.name} (v{task.version})", inspect.getdoc(inspect.getmodule(type(task))) or ""]
    for cls in type(task).__mro__:
        if issubclass(cls, envs.Task) and cls.__module__ not in ("deconfounded.envs.task", "deconfounded.envs.physics"):
            parts.append(inspect.cleandoc(cls.__doc__ or ""))
    trial = "one episode" if task.episodes == 1 else f"{task.episodes} episodes"
    parts.append(
        f"Tier {TIERS[task.tier]}. Trials of {trial} of at most {task.horizon} steps{more}. {_certificate(task)}"
    )
    if digests := (kept("data") or {}).get(f"{task.name}-v{task.version}"):
        sets = ", ".join(f"`{sha[:16]}` ({kind})" for kind, sha in digests.items())
        parts.append(
            f"Standard sets, 256 trials of seed 0, by the sha256 of their contents: {sets}, whole in"
            f" [data.json](data.json). `deconf data --task {task.name} --out DIR`, and `--explore`."
        )
    parts.append(markdown_table(head, latents))
    bounds = ((name, f"{low:g} to {high:g}") for name, (low, high) in task.observation.items())
    parts.append(markdown_table(("observation", "bounds"), bounds))
    if isinstance(task, envs.MujocoTask):
        parts.append(markdown_table(("joint", "noise a step, m or rad", "m/s or rad/s"), noise))
    return "\n\n".join(parts)


def tasks_page() -> str:
    """docs/tasks.md: all cards, the suite's and the hard tasks'."""
    head = """# Tasks

Made by `deconf publish` from the tasks' own classes and docs/certificates. Ideas that failed their
certificate are in [tried.md](tried.md)."""
    hard = """# Hard tasks

Beside the suite (`envs.HARD`), for methods that solve it. What methods reach there: [hard.md](hard.md)."""
    suite, beside = ([card(envs.get(name)) for name in names] for names in (envs.SUITE, envs.HARD))
    return "\n\n".join([head, *suite, hard, *beside]) + "\n"
