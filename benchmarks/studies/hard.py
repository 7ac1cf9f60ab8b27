"""docs/hard.md: the hard tasks, what exact policies and the best learners reach there, and for whom they are hard."""

from typing import Any

from deconfounded import envs
from deconfounded.benchmarks.output import index, scoring
from deconfounded.benchmarks.output.scoring import two_decimals
from deconfounded.benchmarks.studies import headroom, results
from deconfounded.benchmarks.studies.cards import markdown_table

SOLVED = 0.8  # of the expert's score: a task is hard in an episode where the best learner has no more


def hard_in(best: dict[str, float]) -> str:
    """The episodes (by name) in which a task is hard, of the best learner's score in each."""
    return ", ".join(end for end, score in best.items() if score <= SOLVED) or "no"


def page(found: index.Found, certified: dict[str, Any]) -> str:
    """found: what `results.published` gives of the hard tasks; certified: their certificates by name."""
    head = f"""# Hard tasks

Tasks beside the suite (`envs.HARD`), for methods that solve the suite. Made by `deconf publish` from the
[records](records) and the certificates alone. *Exact* is the interventional policy in the task's certificate. *Best* is
the best learner that never sees theta, its tier in brackets: first (*no queries*) of the learners that do not query the
expert, then of *all*. A task is *hard* in the episodes in which the best learner has at most {SOLVED:g} of the expert's
score; the [history](history.md) says how hard it was when it was admitted. What each task is: [tasks.md](tasks.md).
Records: `deconf table --tasks hard`."""
    by_task = {task.name: of["methods"] for task, of in found}
    rows = [_row(envs.get(name), certified.get(name), by_task.get(name, {})) for name in envs.HARD]
    columns = ["task", "latents", "certificate", *(f"exact, {end}" for end in headroom.ENDS)]
    for who in ("no queries", "all"):
        columns += [*(f"{who}: best, {end}" for end in headroom.ENDS), f"{who}: hard in"]
    parts = [head, markdown_table(columns, rows), scoring.INTERVALS.strip()]
    return "\n\n".join([*parts, *(results.section(*of) for of in found)]) + "\n"


def _row(task: envs.Task, certificate: dict[str, Any] | None, methods: dict[str, Any]) -> list[str]:
    exact = [two_decimals(certificate["interventional"]["score"][i]) for i in (0, -1)] if certificate else ["", ""]
    latents = ", ".join(lat.name for lat in task.latents)
    row = [f"[{task.name}](tasks.md#{task.name}-v{task.version})", latents]
    row += [certificate["verdict"] if certificate else "none", *exact]
    for tiers in ("12", "123"):
        best = {end: ranked[0] for end in headroom.ENDS if (ranked := headroom.best_of(methods, end, tiers))}
        row += [f"{two_decimals(score)} {name} ({methods[name]['tier']})" for name, score in best.values()] or ["", ""]
        row.append(hard_in({end: score for end, (_, score) in best.items()}) if best else "")
    return row
