"""docs/hard.md: the hard tasks, what exact policies and the best learners reach there, and which are admitted."""

from typing import Any

from deconfounded import envs
from deconfounded.benchmarks.output import index, scoring
from deconfounded.benchmarks.output.scoring import two_decimals
from deconfounded.benchmarks.studies import headroom, results
from deconfounded.benchmarks.studies.cards import markdown_table

REACHABLE, SOLVED = 0.9, 0.8  # of the expert's score: the exact policy's in the last episode, the best learner's


def admitted(certificate: dict[str, Any] | None, first: float, last: float) -> str:
    """By which episode a task is hard, or why it is not; first, last: scores of the best theta-blind learner there."""
    if certificate is None or certificate["verdict"] != "passed":
        return "no: not certified"
    if certificate["interventional"]["score"][-1] < REACHABLE:
        return "no: the exact policy does not reach it"
    ends = [end for end, score in (("first", first), ("last", last)) if score <= SOLVED]
    return f"yes, by the {' and the '.join(ends)} episode" if ends else "no: solved"


def page(found: index.Found, certified: dict[str, Any]) -> str:
    """found: what `results.published` gives of the hard tasks; certified: their certificates by name."""
    head = f"""# Hard tasks

Tasks beside the suite (`envs.HARD`), for methods that solve it. Made by `deconf publish` from the [records](records)
and the certificates alone. A task is *admitted* if its certificate is passed, the exact interventional policy has at
least {REACHABLE:g} in the last episode of it, and the best theta-blind learner at most {SOLVED:g} in the first or in
the last episode; its tier stands in brackets. What each task is: [tasks.md](tasks.md#hard-tasks). Records:
`deconf table --tasks hard`."""
    by_task = {task.name: of for task, of in found}
    rows = []
    for name in envs.HARD:
        certificate = certified.get(name)
        exact = [two_decimals(certificate["interventional"]["score"][i]) for i in (0, -1)] if certificate else ["", ""]
        verdict = certificate["verdict"] if certificate else "none"
        latents = ", ".join(lat.name for lat in envs.get(name).latents)
        best = _best(by_task[name]["methods"]) if name in by_task else None
        cells = [f"{two_decimals(score)} {method}" for method, score in best] if best else ["", ""]
        hard = admitted(certificate, best[0][1], best[1][1]) if best else "not measured"
        rows.append((f"[{name}](tasks.md#{name}-v{envs.get(name).version})", latents, verdict, *exact, *cells, hard))
    ends = ("exact, first", "exact, last", "best learner, first", "best learner, last")
    table = markdown_table(("task", "latents", "certificate", *ends, "admitted"), rows)
    parts = [head, table, scoring.INTERVALS.strip()]
    return "\n\n".join([*parts, *(results.section(*of) for of in found)]) + "\n"


def _best(methods: dict[str, Any]) -> list[tuple[str, float]] | None:
    """The best theta-blind learner in the first and in the last episode, and its score; None without learners."""
    tiers = {name: entry["tier"] for name, entry in methods.items()}
    made = [headroom.best_of(methods, end) for end in headroom.ENDS]
    return [(f"{of[0][0]} ({tiers[of[0][0]]})", of[0][1]) for of in made] if all(made) else None
