"""Pictures, video and a self-contained report.html from the files of a finished run."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import jinja2
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import MaxNLocator

from deconfounded import envs
from deconfounded.benchmarks.engine.catalogue import EXACT, METHODS, REFERENCES
from deconfounded.benchmarks.engine.jobs import CLIPPED
from deconfounded.benchmarks.engine.pool import Finished
from deconfounded.benchmarks.output import film, records, score
from deconfounded.envs import outside
from deconfounded.envs.files import save_figure, write_atomically, write_json

COLOURS = {
    "expert": "black",
    "interventional": "tab:green",
    "conditional": "tab:red",
    "deconfounded": "tab:blue",
    "deconfounded_gru": "tab:cyan",
    "deconfounded_discrete": "tab:purple",
    "deconfounded_offline": "tab:olive",
    "dagger": "tab:pink",
    "naive_rnn": "tab:orange",
    "oracle_bc": "tab:gray",
    "blind_bc": "tab:brown",
    "random": "lightgray",
}


def write(task: envs.Task, about: dict[str, Any], finished: Finished, folder: Path) -> str:
    """Everything that a folder shows, from what its jobs left there; returns the table. No training happens here.

    about: what the folder is for, as its settings.json says. Numbers come first: they stand, whatever pictures do.
    """
    made = records.of_run(finished, about["preset"], about["set"], task.episodes)
    for record in made:
        records.write(folder / "records", record)
    results = {**records.gather(made, list(METHODS)), "resumed": about.get("resumed", len(finished))}
    write_json(folder / "results.json", results)
    write_atomically(folder / "rows.csv", score.csv_rows(task, results, finished))
    try:
        pictures(task, results, finished, folder)
    except Exception as error:  # a GL, a font or an encoder can fail in many ways
        print(f"no pictures: {outside.told(error)}")
    write_atomically(folder / "report.html", page(results, folder))
    head = f"{task.name}: 0 = random actions, 1 = the expert that sees theta"
    return f"\n{head}\n\n{score.table(results)}\n\n{results['wall_s']:.0f} s -> {folder / 'report.html'}"


def pictures(task: envs.Task, results: dict[str, Any], finished: Finished, folder: Path) -> None:
    """Curves, and a video where a GL works."""
    adaptation(results, folder / "adaptation.png")
    curves: dict[str, list[dict[str, Any]]] = {}
    clips: dict[str, dict[str, Any]] = {}
    for method, _, data in finished:
        curve = data["meta"]["curve"]  # of all seeds of a group
        if curve and curve not in curves.setdefault(method, []):
            curves[method].append(curve)
        for name in CLIPPED:
            if f"{name}/state" in data:
                clip = {key: data[f"{name}/{key}"] for key in ("state", "action", "episode")}
                clip["theta"] = data[f"{name}/theta"][int(data[f"{name}/trial"]), : task.episodes]
                if f"{name}/read" in data:
                    clip["belief"] = film.decoded(task, data[f"{name}/read"])
                clips[name] = clip
    learning(curves, task.name, folder / "learning.png")
    try:
        film.write(task, {name: clips[name] for name in CLIPPED if name in clips}, folder / "video.mp4")
    except Exception as error:  # no GL, or no encoder: the run is good all the same
        print(f"no video: {outside.told(error)}")


def adaptation(results: dict[str, Any], file: Path) -> None:
    """Score over the episodes of a trial, each method a line; later episodes than were trained on are shaded."""
    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    trained = 0
    for name, entry in results["methods"].items():
        values = entry["score"] + entry.get("score_beyond", [])
        trained = len(entry["score"])
        base = name.removesuffix("_episode")  # dotted: another way to deploy the same agent
        style = ":" if base != name else "--" if name in (*EXACT, *REFERENCES) else "-"
        axes.plot(range(1, len(values) + 1), values, style, marker="o", ms=4, color=COLOURS.get(base), label=name)
    longest = max(len(e["score"]) + len(e.get("score_beyond", [])) for e in results["methods"].values())
    if longest > trained:
        axes.axvspan(trained + 0.5, longest + 0.5, color="0.95", zorder=0)
        axes.text(trained + 0.6, 0.02, "longer than trained on", color="0.45", fontsize=8)
    axes.set(xlabel="episode of one hidden theta", ylabel="score (0 random, 1 expert)", title=results["task"])
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    save_figure(figure, file, 110)
    plt.close(figure)


def learning(curves: dict[str, list[dict[str, Any]]], title: str, file: Path) -> None:
    """Training losses over updates, one panel a loss; a thin line a group of seeds that trained side by side."""
    kinds = sorted({kind for seeds in curves.values() for curve in seeds for kind in curve})
    figure, panels = plt.subplots(1, max(len(kinds), 1), figsize=(4.5 * max(len(kinds), 1), 3.4), layout="constrained")
    for panel, kind in zip(np.atleast_1d(panels), kinds, strict=False):
        for name, seeds in curves.items():
            for i, curve in enumerate(curve for curve in seeds if kind in curve):
                label = name if i == 0 else None
                panel.plot(*np.array(curve[kind]).T, color=COLOURS.get(name), lw=0.9, alpha=0.8, label=label)
        panel.set(xlabel="update", title=f"{title}: {kind} loss")
        panel.legend(frameon=False, fontsize=8)
    save_figure(figure, file, 110)
    plt.close(figure)


_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>{{ results.task }}</title>
<style>body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem}
img,video{max-width:100%}table{border-collapse:collapse}td,th{padding:.2rem .8rem;text-align:right;
border-bottom:1px solid #ddd}td:first-child,th:first-child{text-align:left}</style>
<h1>{{ results.task }} (v{{ results.task_version }}), preset {{ results.preset }}</h1>
<p>Scores: 0 = random actions, 1 = the expert that sees theta. {{ results.seeds|length }} seed(s),
{{ results.eval_trials }} trials each, {{ "%.0f"|format(results.wall_s) }} s.</p>
<table><tr>{% for name in columns %}<th>{{ name }}{% endfor %}</tr>
{% for row in rows %}<tr>{% for cell in row %}<td>{{ cell }}{% endfor %}</tr>
{% endfor %}</table>
{% for name, data in pictures %}<h2>{{ name }}</h2><img alt="{{ name }}" src="data:image/png;base64,{{ data }}">
{% endfor %}{% if movie %}<h2>One hidden theta, first and last episode of a trial</h2>
<video controls loop muted src="data:video/mp4;base64,{{ movie }}"></video>{% endif %}
<h2>How it was made</h2><pre>{{ how }}</pre></html>
"""


def page(results: dict[str, Any], folder: Path) -> str:
    """The report as one HTML file that needs no other."""

    def encoded(file: Path) -> str:
        return base64.b64encode(file.read_bytes()).decode()

    pictures = [
        (p.stem.capitalize(), encoded(p)) for p in (folder / "adaptation.png", folder / "learning.png") if p.exists()
    ]
    movie = encoded(folder / "video.mp4") if (folder / "video.mp4").exists() else None
    how = json.dumps({key: value for key, value in results.items() if key != "methods"}, indent=2)
    template = jinja2.Environment(autoescape=True).from_string(_PAGE)
    cells = {"columns": score.COLUMNS, "rows": score.rows(results["methods"])}
    return template.render(results=results, pictures=pictures, movie=movie, how=how, **cells)
