"""What docs/ and README show of tasks, certificates and results: `python benchmarks/pages.py`

Writes docs/tasks.md (the card of every task, read off its class and its certificate), docs/results.md and
docs/index.html (of the records that `publish.py` kept) and the tables in README and docs/speed.md.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks.engine.catalogue import DEFAULT, METHODS, REFERENCES
from deconfounded.benchmarks.engine.presets import preset
from deconfounded.benchmarks.output import index, records, score
from deconfounded.envs.files import write_atomically

README = Path(__file__).resolve().parents[2] / "README.md"
DOCS = README.parent / "docs"
TIERS = {
    None: "none: nobody can win",
    2: "2: exploration is enough",
    3: "3: it takes queries of the expert",
}
SUMMARY = (
    *("deconfounded", "deconfounded_discrete", "deconfounded_offline", "dagger", "naive_rnn"),
    *("oracle_bc", "blind_bc", "conditional", "interventional"),
)  # methods in README's table


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Rows of cells under a head."""
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, ("---",) * len(head), *rows))


def _kept(folder: Path, name: str) -> dict[str, Any] | None:
    """What the folder's file of a task holds, if there is one."""
    file = folder / f"{name}.json"
    return json.loads(file.read_text()) if file.is_file() else None


def _certified() -> Iterator[tuple[envs.Task, dict[str, Any]]]:
    """In the registry's order, the tasks that have a certificate in docs/, and what it holds."""
    for name in envs.SUITE:
        if found := _kept(DOCS / "certificates", name):
            yield envs.get(name), found


def _published() -> Iterator[tuple[envs.Task, dict[str, Any]]]:
    """In the registry's order, the tasks that have records in docs/, and what these come to."""
    for name in envs.SUITE:
        task = envs.get(name)
        if found := records.of_task(DOCS / "records", name, task.version):
            yield task, records.gather(found, list(METHODS))


def command(task: envs.Task, results: dict[str, Any], method: str = "") -> str:
    """That makes the results, or those of one method."""
    methods = [name for name in METHODS if name in results["methods"]]
    asked = " ".join(name for name in methods if name not in REFERENCES)
    named = "" if methods == list(DEFAULT) else f" --methods {asked}"
    seeds = len(results["seeds"])
    if method and method not in REFERENCES:
        seeds = len(results["methods"][method]["seeds"])
        base = method.removesuffix("_episode")
        named = f" --methods {base if base in METHODS else f'path/{base}.py:fit'}"
    chosen = "" if results["preset"] == "default" else f" --preset {results['preset']}"
    counted = "" if seeds == preset(results["preset"], task, "cpu").seeds else f" --seeds {seeds}"
    changed = f" --set {' '.join(results['set'])}" if "set" in results else ""
    return f"python benchmarks/run.py --task {task.name}{chosen}{changed}{counted}{named}"


def section(task: envs.Task, results: dict[str, Any]) -> str:
    """A task's part of docs/results.md."""
    seeds, machine = len(results["seeds"]), results["machine"]
    versions = ", ".join(f"{name} {results['versions'][name]}" for name in ("python", "mujoco", "torch"))
    rows = []
    for row in score.rows(results["methods"]):
        beyond = results["methods"][row[0]].get("score_beyond")
        rows.append((*row, score.two_decimals(beyond[-1]) if beyond else ""))
    parts = [
        f"## {task.name}",
        f"`{command(task, results)}`",
        f"{seeds} seeds of {results['eval_trials']:,} trials; {results['wall_s']:,.0f} s; {machine}; {versions}"
        f" ([records](records/{task.name}-v{task.version}), of {', '.join(one[:7] for one in results['commits'])}).",
        markdown_table((*score.COLUMNS, "after as many again"), rows),
        f"![score by episode]({task.name}.png)",
    ]
    if old := sorted(
        folder.name
        for folder in (DOCS / "records").glob(f"{task.name}-v*")
        if folder.name != f"{task.name}-v{task.version}"
    ):
        parts.append(f"Superseded, and not to be compared: the records of {', '.join(old)}.")
    if (DOCS / f"{task.name}.webp").exists():
        parts.append(f"![expert, naive and deconfounded under one theta]({task.name}.webp)")
    return "\n\n".join(parts)


def results_page() -> str:
    """docs/results.md."""
    head = """# Results

Made by `python benchmarks/pages.py` from the [records](records) alone, one a seed. Scores: 0 = random actions, 1 = the
expert that sees theta. Return and Eq. (1), the log-likelihood of the agent's own actions under the expert that sees
theta (more is better), are of the last episode; theta R2 is of a linear probe of the belief or memory, held out.
Intervals are 95% bootstrap intervals over seeds; of three seeds that is their range, which holds the mean three times
in four. *After as many again*: the last score in a trial twice as long as those of training."""
    return "\n\n".join([head, *(section(*found) for found in _published())]) + "\n"


def summary() -> str:
    """README's table: scores in the last episode."""
    rows, column = [], score.COLUMNS.index("last")
    for task, results in _published():
        last = {row[0]: row[column] for row in score.rows(results["methods"])}
        tier = "none" if task.tier is None else str(task.tier)
        rows.append((task.name, tier, *(last.get(name, "") for name in SUMMARY), f"{results['wall_s']:,.0f}"))
    methods = (f"{name} ({METHODS[name].tier})" for name in SUMMARY)
    return markdown_table(("task", "tier", *methods, "seconds"), rows)


def certificates() -> str:
    """README's table of certificates."""
    rows, asked = [], list[str]()
    for task, found in _certified():
        measured = (f"{check['measured']:.2f}" for check in found["checks"].values())
        rows.append((task.name, *measured, *_nats(found), found["verdict"]))
        asked = [f"{name} ({check['required']})" for name, check in found["checks"].items()]
    return markdown_table(("task", *asked, "dynamics, nats a step", "actions, nats a step", "verdict"), rows)


def costs() -> str:
    """The table of docs/speed.md: CPU seconds a seed, before and now, of the tasks that were timed before."""
    before = json.loads((DOCS / "speed" / "before.json").read_text())
    shown = [(task.name, results["methods"]) for task, results in _published() if task.name in before]
    head, rows = ["method"], []
    for name, _ in shown:
        head += [f"{name}, before", "now"]
    for method in METHODS:
        cells: list[str] = []
        for name, methods in shown:
            was, now = before[name].get(method, {}).get("cpu_s"), methods.get(method, {}).get("cpu_s")
            cells += ["" if seconds is None else f"{seconds:,.1f}" for seconds in (was, now)]
        if any(cells):
            rows.append((method, *cells))
    return markdown_table(head, rows)


def speed() -> str:
    """docs/speed.md with its table."""
    return _filled((DOCS / "speed.md").read_text(), costs)


def readme() -> str:
    """README with its tables, as docs/ has them."""
    return _filled(README.read_text(), summary, certificates)


def _filled(text: str, *tables: Callable[[], str]) -> str:
    """The text with each table between `<!-- name -->` and `<!-- /name -->`."""
    for table in tables:
        marks = [f"<!-- {slash}{table.__name__} -->" for slash in ("", "/")]
        if [text.count(mark) for mark in marks] != [1, 1]:
            raise envs.InputError(f"a page lacks its marks {' and '.join(marks)}, each once; put them back")
        before, rest = text.split(marks[0])
        text = "\n".join([before + marks[0], table(), marks[1] + rest.split(marks[1])[1]])
    return text


def _nats(certificate: dict[str, Any]) -> list[str]:
    """Evidence of theta a step, along expert trajectories: from dynamics, from actions."""
    told = (certificate["evidence_nats_per_step"][kind] for kind in ("dynamics", "actions"))
    return [f"{value:,.2f}" if value < 10 else f"{value:,.0f}" for value in told]


def check_certificate(file: Path, task: envs.Task) -> None:
    """Raises InputError for a file that is no certificate of the task, as pages show it."""
    try:
        found = json.loads(file.read_bytes())
        numbers = [check["measured"] for check in found["checks"].values()] + found["conditional"]["score"]
        numbers += [found["evidence_nats_per_step"][kind] for kind in ("dynamics", "actions")]
        whole = np.isfinite(np.array(numbers, float)).all() and found["verdict"] in ("passed", "failed")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        whole = False
    if not whole or (found["task"], found["task_version"]) != (task.name, task.version):
        raise envs.InputError(f"{file} is no certificate of {task.name} v{task.version}; run certify.py again")


def _certificate(task: envs.Task) -> str:
    found = _kept(DOCS / "certificates", task.name)
    if found is None:
        return "No certificate."
    checks = (f"{name} {check['measured']:.2f} ({check['required']})" for name, check in found["checks"].items())
    dynamics, actions = _nats(found)
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
    if kept := (_kept(DOCS, "data") or {}).get(f"{task.name}-v{task.version}"):
        sets = ", ".join(f"`{sha[:16]}` ({kind})" for kind, sha in kept.items())
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

Made by `python benchmarks/pages.py` from the tasks' own classes and docs/certificates. Ideas that failed their
certificate are in [tried.md](tried.md)."""
    return "\n\n".join([head, *(card(envs.get(name)) for name in envs.SUITE)]) + "\n"


def index_page() -> str:
    """docs/index.html."""
    certified = {task.name: found for task, found in _certified()}
    tiers = {"none" if tier is None else str(tier): text.partition(": ")[2] for tier, text in TIERS.items()}
    return index.page(DOCS, list(_published()), certified, command, tiers)


def write() -> None:
    """Bring all of them up to date."""
    write_atomically(DOCS / "index.html", index_page())
    write_atomically(DOCS / "tasks.md", tasks_page())
    write_atomically(DOCS / "results.md", results_page())
    write_atomically(DOCS / "speed.md", speed())
    write_atomically(README, readme())
