"""Over all tasks: the gap that the exact policies predict, against the one measured between learned agents."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks.output.pictures import label, panels
from deconfounded.benchmarks.output.scoring import two_decimals
from deconfounded.benchmarks.studies.cards import markdown_table

PREDICTOR = "exact interventional less conditional"


class Gap(NamedTuple):
    """Of a task, in scores of the last episode: as something foretells it, and deconfounded less naive_rnn."""

    task: envs.Task
    predicted: float
    measured: float


def gap(task: envs.Task, methods: dict[str, Any]) -> Gap | None:
    """PREDICTOR and measured, from the `methods` of results.json; None if one of the four is not there."""
    if not {"interventional", "conditional", "deconfounded", "naive_rnn"} <= set(methods):
        return None
    last = {name: float(methods[name]["score_last"]) for name in methods}
    return Gap(task, last["interventional"] - last["conditional"], last["deconfounded"] - last["naive_rnn"])


def _correlation(gaps: Sequence[Gap]) -> str:
    """Pearson's, and over how many tasks."""
    r = np.corrcoef([one.predicted for one in gaps], [one.measured for one in gaps])[0, 1]
    return f"{two_decimals(r)} over {len(gaps)} tasks"


def section(gaps: Sequence[Gap]) -> str:
    """Its part of docs/results.md."""
    explored = [one for one in gaps if one.task.tier != 3]  # of Tier 3, expert trials hold no evidence of theta
    if len(explored) < 3:
        return ""
    text = f"""## Predicted and measured

What naive cloning loses in score, in the last episode: predicted by the exact policies (interventional less
conditional), and measured (`deconfounded` less `naive_rnn`). Without the tasks of Tier 3, Pearson's correlation
is {_correlation(explored)}. With those, whose gap only queries of the expert can close, it is {_correlation(gaps)}."""
    rows = [(one.task.name, two_decimals(one.predicted), two_decimals(one.measured)) for one in gaps]
    table = markdown_table(("task", "predicted", "measured"), rows)
    return "\n\n".join([text, table, "![predicted and measured gap](gap.png)"])


def picture(points: Sequence[Sequence[Any]], file: Path, predictor: str = PREDICTOR, mark: str = "") -> None:
    """A dot for each name, predicted and measured gap, and its colour and fill if dots differ.

    predictor: what the prediction is. Dots within 0.05 of the origin, where there is nothing to tell, bear no name.
    """
    with panels(file, size=(6.4, 5.2), dpi=100, mark=mark) as [[axes]]:
        axes.axline((0, 0), slope=1, color="0.8", lw=1)
        for _, predicted, measured, *style in points:
            hue, fill = style or ("tab:blue", "full")
            axes.plot(predicted, measured, "o", color=hue, fillstyle=fill)
        axes.set(xlabel=f"predicted: {predictor}", ylabel="measured: deconfounded less naive_rnn")
        axes.margins(0.14, 0.08)
        axes.set_title("what cloning loses, score in the last episode", fontsize=11)
        named = [point for point in points if np.hypot(point[1], point[2]) > 0.05]
        label(axes, [point[0] for point in named], np.array([point[1:3] for point in named], float).reshape(-1, 2))
