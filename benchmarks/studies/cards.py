"""docs/tasks.md: the card of every task, read off its class, its models and its certificate."""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deconfounded import envs

DOCS = Path(__file__).resolve().parents[2] / "docs"
TIERS = {None: "none: nobody can win", 2: "2: exploration is enough", 3: "3: it takes queries of the expert"}


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Rows of cells under a head."""
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, ("---",) * len(head), *rows))


def kept(folder: Path, name: str) -> dict[str, Any] | None:
    """What the folder's file of a task holds, if there is one."""
    file = folder / f"{name}.json"
    return json.loads(file.read_bytes()) if file.is_file() else None


def nats(certificate: dict[str, Any]) -> list[str]:
    """Evidence of theta a step, along expert trajectories: from dynamics, from actions."""
    told = (certificate["evidence_nats_per_step"][kind] for kind in ("dynamics", "actions"))
    return [f"{value:,.2f}" if value < 10 else f"{value:,.0f}" for value in told]


def certified() -> dict[str, dict[str, Any]]:
    """In the registry's order, the tasks that have a certificate in docs/, and what it holds."""
    return {name: found for name in envs.SUITE if (found := kept(DOCS / "certificates", name))}


def certificates(held: dict[str, Any]) -> str:
    """README's table of certificates."""
    rows, asked = [], list[str]()
    for name, found in held.items():
        measured = (f"{check['measured']:.2f}" for check in found["checks"].values())
        rows.append((name, *measured, *nats(found), found["verdict"]))
        asked = [f"{name} ({check['required']})" for name, check in found["checks"].items()]
    return markdown_table(("task", *asked, "dynamics, nats a step", "actions, nats a step", "verdict"), rows)


def _certificate(task: envs.Task) -> str:
    found = kept(DOCS / "certificates", task.name)
    if found is None:
        return "No certificate."
    checks = (f"{name} {check['measured']:.2f} ({check['required']})" for name, check in found["checks"].items())
    dynamics, actions = nats(found)
    return (
        f"Certificate ({len(found['conditional']['score'])} episodes a trial) {found['verdict']}: {', '.join(checks)}."
        f" Evidence of theta along expert trajectories: dynamics {dynamics}, actions {actions} nats a step."
    )


def _moved(task: envs.MujocoTask, latent: int) -> str:
    """What of the model a latent moves, read off models that differ in it alone: arrays, and whose entries."""
    middle = np.array([lat.grid(3)[-1 if lat.distribution == "categorical" else 1] for lat in task.latents])
    thetas = np.repeat(middle[None], 2, 0)
    thetas[:, latent] = task.latents[latent].grid(9)[[0, -1]]
    simulator, found = task.simulator(2), []
    for i, theta in enumerate(thetas):
        simulator.set_theta(i, theta)
    one, other = simulator.models
    kinds = {"body": one.body, "geom": one.geom, "dof": one.joint, "jnt": one.joint, "tendon": one.tendon}
    kinds |= {"actuator": one.actuator, "site": one.site}
    for field in dir(one):
        value = None if field.startswith(("cam_", "light_")) else getattr(one, field, None)
        if isinstance(value, np.ndarray) and (differs := value != getattr(other, field)).any():
            rows = np.flatnonzero(differs.reshape(len(differs), -1).any(1)).tolist()
            kind = field.split("_")[0]
            named = [kinds[kind](one.dof_jntid[i] if kind == "dof" else i).name for i in rows] if kind in kinds else []
            found.append(f"`{field}`{' of ' + ', '.join(named) if named else ''}")
    if (one.opt.gravity != other.opt.gravity).any():
        found.append("gravity")
    return "; ".join(found) or "nothing"


def card(task: envs.Task) -> str:
    """Markdown: what the docstrings say, latents, observation, noise, tier, certificate."""
    physics = isinstance(task, envs.MujocoTask)
    latents: list[tuple[str, ...]] = [
        (
            lat.name,
            lat.unit,
            f"{lat.low:g} to {lat.high:g}",
            lat.distribution + f", drifts by {lat.drift:g}" * bool(lat.drift),
        )
        for lat in task.latents
    ]
    if isinstance(task, envs.MujocoTask):
        latents = [(*row, _moved(task, i)) for i, row in enumerate(latents)]
    parts = [f"## {task.name} (v{task.version})", inspect.getdoc(inspect.getmodule(type(task))) or ""]
    for cls in type(task).__mro__:
        if issubclass(cls, envs.Task) and cls.__module__ not in ("deconfounded.envs.task", "deconfounded.envs.physics"):
            parts.append(inspect.cleandoc(cls.__doc__ or ""))
    trial = "one episode" if task.episodes == 1 else f"{task.episodes} episodes"
    more = f", {task.control_dt:g} s each; the expert's action noise is {task.expert_noise:g}" if physics else ""
    parts.append(
        f"Tier {TIERS[task.tier]}. Trials of {trial} of at most {task.horizon} steps{more}. {_certificate(task)}"
    )
    if known := (kept(DOCS, "data") or {}).get(f"{task.name}-v{task.version}"):
        sets = ", ".join(f"`{sha[:16]}` ({kind})" for kind, sha in known.items())
        parts.append(
            f"Standard sets, 256 trials of seed 0, by the sha256 of their contents: {sets}, whole in"
            f" [data.json](data.json). `deconf data --task {task.name} --out DIR`, and `--explore`."
        )
    moves = ("what it moves in the model",) if physics else ()
    parts.append(markdown_table(("latent", "unit", "range", "distribution", *moves), latents))
    bounds = ((name, f"{low:g} to {high:g}") for name, (low, high) in task.observation.items())
    parts.append(markdown_table(("observation", "bounds"), bounds))
    if isinstance(task, envs.MujocoTask):
        noise = []  # of a free joint, two of each: position and rotation, and their velocities
        for joint, stds in task.process_noise.items():
            halves = stds[: len(stds) // 2], stds[len(stds) // 2 :]
            noise.append((joint, *(", ".join(f"{std:g}" for std in half) for half in halves)))
        parts.append(markdown_table(("joint", "noise a step, m or rad", "m/s or rad/s"), noise))
    return "\n\n".join(parts)


def tasks_page() -> str:
    """docs/tasks.md: all cards."""
    head = """# Tasks

Made by `deconf publish` from the tasks' own classes and docs/certificates. Ideas that failed their
certificate are in [tried.md](tried.md)."""
    return "\n\n".join([head, *(card(envs.get(name)) for name in envs.SUITE)]) + "\n"
