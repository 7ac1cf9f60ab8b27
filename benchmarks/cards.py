"""The card of every task, read off its class and its certificate: `python benchmarks/cards.py` writes docs/tasks.md."""

from __future__ import annotations

import inspect
import json
from pathlib import Path

import envs
from benchmarks.publish import markdown_table
from envs.console import Parser, run_command, write_atomically

DOCS = Path(__file__).parents[1] / "docs"
TIERS = {
    None: "none: nobody can win",
    2: "2: exploration is enough",
    3: "3: it takes queries of the expert",
}


def _certificate(task: envs.Task) -> str:
    file = DOCS / "certificates" / f"{task.name}.json"
    if not file.is_file():
        return "No certificate."
    found = json.loads(file.read_text())
    checks = (f"{name} {check['measured']:.2f} ({check['required']})" for name, check in found["checks"].items())
    evidence = found["evidence_nats_per_step"]
    return (
        f"Certificate {found['verdict']}: {', '.join(checks)}. Evidence of theta along expert trajectories: dynamics"
        f" {evidence['dynamics']:.2g}, actions {evidence['actions']:.2g} nats a step."
    )


def card(task: envs.Task) -> str:
    """Markdown: what the docstrings say, latents, observation, noise, tier, certificate."""
    latents = [(lat.name, lat.unit, f"{lat.low:g} to {lat.high:g}", lat.distribution) for lat in task.latents]
    parts = [f"## {task.name} (v{task.version})", inspect.getdoc(inspect.getmodule(type(task))) or ""]
    for cls in type(task).__mro__:
        if issubclass(cls, envs.Task) and cls.__module__ not in ("envs.task", "envs.physics"):
            parts.append(inspect.cleandoc(cls.__doc__ or ""))
    step = f", {task.control_dt:g} s each" if isinstance(task, envs.MujocoTask) else ""
    parts.append(
        f"Tier {TIERS[task.tier]}. Trials of {task.episodes} episodes of at most {task.horizon} steps{step}; the"
        f" expert's action noise is {task.expert_noise:g}. {_certificate(task)}"
    )
    parts.append(markdown_table(("latent", "unit", "range", "distribution"), latents))
    bounds = ((name, f"{low:g} to {high:g}") for name, (low, high) in task.observation.items())
    parts.append(markdown_table(("observation", "bounds"), bounds))
    if isinstance(task, envs.MujocoTask):
        noise = ((joint, *(f"{std:g}" for std in stds)) for joint, stds in task.process_noise.items())
        parts.append(markdown_table(("joint", "noise a step, m or rad", "m/s or rad/s"), noise))
    return "\n\n".join(parts)


def page() -> str:
    """All cards."""
    head = "# Tasks\n\nMade by `python benchmarks/cards.py` from the tasks' own classes and docs/certificates."
    return "\n\n".join([head, *(card(envs.get(name)) for name in envs.names())]) + "\n"


def main() -> None:
    """The command line."""
    Parser(__doc__).parse_args()
    write_atomically(DOCS / "tasks.md", page())
    print(f"{len(envs.names())} tasks -> {DOCS / 'tasks.md'}")


if __name__ == "__main__":
    run_command(main)
