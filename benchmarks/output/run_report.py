"""Pictures, video and a self-contained report.html from the files of a finished run."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from deconfounded import envs
from deconfounded.benchmarks.engine import published
from deconfounded.benchmarks.engine.benchmark import CLIPPED
from deconfounded.benchmarks.engine.catalogue import EXACT, METHODS, REFERENCES
from deconfounded.benchmarks.engine.job_files import Finished
from deconfounded.benchmarks.output import aggregation, film, records, scoring
from deconfounded.benchmarks.output.pictures import colour, colours, encoded, panels
from deconfounded.benchmarks.output.templates import template
from deconfounded.envs.support.errors import error_line
from deconfounded.envs.support.files import write_atomically, write_json


def check_references(task: envs.Task, about: dict[str, Any], finished: Finished) -> None:
    """Raises InputError if no score can be made with these results of random actions and of the expert."""
    made = records.of_run(finished, about["preset"], about["set"], task.episodes)
    aggregation.references(made[0], made)


def check_kept(task: envs.Task, folder: Path) -> None:
    """Raises InputError if the records of an earlier report in a run's folder are damaged."""
    file = folder / "records" / records.place(task.name)
    try:
        records.held(file)
    except envs.InputError as error:
        raise envs.InputError(f"{error}; remove that file, and `deconf report` makes it again from jobs/") from None


def write(task: envs.Task, about: dict[str, Any], finished: Finished, folder: Path) -> str:
    """Everything that a folder shows, from what its jobs left there; returns the table. No training happens here.

    about: what the folder is for, as its settings.json says. Numbers come first: they stand, whatever pictures do.
    """
    made = records.of_run(finished, about["preset"], about["set"], task.episodes)
    check_kept(task, folder)
    records.write(folder / "records", made)
    results = {**aggregation.gather(made, list(METHODS)), "resumed": about.get("resumed", len(finished))}
    write_json(folder / "results.json", results)
    write_atomically(folder / "rows.csv", scoring.csv_rows(task, results, finished))
    try:
        pictures(task, results, finished, folder)
    except Exception as error:  # a GL, a font or an encoder can fail in many ways
        print(f"no pictures: {error_line(error)}")
    write_atomically(folder / "report.html", page(results, folder))
    under = f", protocol {results[records.NAME]}" if records.NAME in results else ""
    head = f"{task.name}{under}: 0 = random actions, 1 = the expert that sees theta"
    table = scoring.plain_table(scoring.COLUMNS, scoring.rows(results["methods"]), scoring.DROPPED)
    note = f"{scoring.INTERVALS}\n\n" if len(results["seeds"]) > 1 else ""
    return f"\n{head}\n\n{table}\n\n{note}{results['wall_s']:.0f} s"


def pictures(task: envs.Task, results: dict[str, Any], finished: Finished, folder: Path) -> None:
    """Curves, and a video where a GL works; those of earlier results are gone, whatever becomes of the new ones."""
    for name in (*PICTURES, "video.mp4"):
        (folder / name).unlink(missing_ok=True)
    adaptation(results, folder / "adaptation.png")
    learning(results, folder / "learning.png")
    clips: film.Clips = {}
    for name, data in ((name, data) for name in CLIPPED for *_, data in finished if f"{name}/state" in data):
        clips[name] = {key: data[f"{name}/{key}"] for key in ("state", "action", "episode")}
        clips[name]["theta"] = data[f"{name}/theta"][int(data[f"{name}/trial"]), : task.episodes]
        if f"{name}/read" in data:
            clips[name]["belief"] = film.decoded(task, data[f"{name}/read"])
    beliefs(task, {name: clip for name, clip in clips.items() if "belief" in clip}, folder / "beliefs.png")
    try:
        film.write(task, clips, folder / "video.mp4")
    except Exception as error:  # no GL, or no encoder: the run is good all the same
        print(f"no video: {error_line(error)}")


DEPLOYED: Mapping[str, Any] = {"episode": ":", "mode": "-.", "mean": (0, (1, 3))}  # lines of other ways to deploy


def adaptation(results: dict[str, Any], file: Path, mark: str = "") -> None:
    """Score over the episodes of a trial, each method a line in its band; later episodes than trained on shaded."""
    with panels(file, size=(7, 4.2), mark=mark) as [[axes]]:
        trained, longest = 0, 0
        hues = colours(entry["method"] for entry in results["methods"].values())
        for name, entry in results["methods"].items():
            values, hue = entry["score"] + entry.get("score_beyond", []), hues[entry["method"]]
            trained, longest, at = len(entry["score"]), max(longest, len(values)), range(1, len(values) + 1)
            style: Any = DEPLOYED.get(entry["deployment"], "--" if name in (*EXACT, *REFERENCES) else "-")
            axes.plot(at, values, linestyle=style, marker="o", ms=4, color=hue, label=name)
            if entry["band"]:
                axes.fill_between(at, *np.transpose(entry["band"]), color=hue, alpha=0.12, lw=0)
                if len(values) == 1:
                    axes.vlines(at, *np.transpose(entry["band"]), color=hue)
        if longest > trained:
            axes.axvspan(trained + 0.5, longest + 0.5, color="0.95", zorder=0)
            axes.text(trained + 0.6, 0.02, "longer than trained on", color="0.45", fontsize=8)
        axes.set(xlabel="episode of one hidden theta", ylabel="score (0 random, 1 expert)", title=results["task"])
        axes.set_xlim(0.5, longest + 0.5)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False, handlelength=3.5)


def learning(results: dict[str, Any], file: Path) -> None:
    """Training losses over updates, one panel a kind of loss, the mean over seeds; none where a round did another."""
    trained = {name: entry for name, entry in results["methods"].items() if not entry["deployment"]}
    curves = [(kind, name, curve) for name, entry in trained.items() for kind, curve in entry.get("curve", {}).items()]
    kinds = list(dict.fromkeys(kind for kind, *_ in curves))
    hues = colours(entry["method"] for entry in results["methods"].values())
    if not kinds:
        return
    with panels(file, 1, len(kinds), size=(4.5 * len(kinds), 3.4)) as [row]:
        for kind, name, curve in curves:
            panel, loss = row[kinds.index(kind)], np.array(curve["loss"], float)
            panel.plot(curve["update"], loss, color=hues[name], lw=1.2, label=name)
        for panel, kind in zip(row, kinds, strict=True):
            panel.set(xlabel="update", title=f"{kind} loss")
            panel.legend(frameon=False, fontsize=8)


def beliefs(task: envs.Task, clips: film.Clips, file: Path) -> None:
    """What agents believed of theta in the trial that is filmed, step by step, and the truth; a panel a latent."""
    if not clips:
        return
    count = len(task.latents)
    theta = next(iter(clips.values()))["theta"]
    with panels(file, count, size=(8, 2.6 * count), sharex=True) as axes:
        for i, (panel, latent) in enumerate(zip(axes[:, 0], task.latents, strict=True)):
            for episode, truth in enumerate(theta[:, i]):
                label = "true" if episode == 0 else None
                panel.plot([episode, episode + 1], [truth] * 2, color=colour("expert"), lw=1, ls="--", label=label)
                panel.axvline(episode + 1, color="0.9", lw=0.8)
            for name, clip in clips.items():
                for episode in range(len(theta)):
                    belief = clip["belief"][clip["episode"] == episode, i]
                    at = episode + np.arange(len(belief)) / task.horizon
                    panel.plot(at, belief, color=colour(name), lw=1.4, label=None if episode else name)
            panel.set(ylabel=f"{latent.name}{f', {latent.unit}' if latent.unit else ''}", xlim=(0, len(theta)))
            panel.set_xticks(np.arange(len(theta)) + 0.5, range(1, len(theta) + 1))
            panel.tick_params(axis="x", length=0)
        axes[-1, 0].set(xlabel="episode")
        axes[0, 0].legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)


PICTURES = {
    "adaptation.png": ("Score by episode", "Bands: intervals of the mean over seeds, as in the table."),
    "beliefs.png": (
        "What the agents believed of theta",
        "In the trial that is filmed, as a linear probe, fitted at the end of trials, reads it off belief or memory.",
    ),
    "learning.png": ("Learning", "Means over seeds. A line stops where a method trains something else for a while."),
}


def certificate(task: str, version: int, run: Path, text: str | None = None) -> Path | None:
    """The picture of a task's certificate: beside the run, as certify.py leaves it, or in a checkout's docs/.

    text: the digest of the files of a task from outside, which has no version.
    """
    beside = run.absolute().parent / "certificates" / f"{task}.png"
    for picture in (beside, published.certificate(task, ".png")):
        try:
            certified = json.loads(picture.with_suffix(".json").read_bytes())
            of = (certified["task"], certified["task_version"], certified.get("text"))
            if of == (task, version, text) and picture.is_file():
                return picture
        except (OSError, ValueError, KeyError, TypeError):
            pass
    return None


def page(results: dict[str, Any], folder: Path) -> str:
    """The report as one HTML file that needs no other."""
    pictures = [(*texts, encoded(folder / name)) for name, texts in PICTURES.items() if (folder / name).exists()]
    if certified := certificate(results["task"], results["task_version"], folder, results.get("text")):
        command = f"deconf certify --task {results['task']}"
        pictures.append(("Is it confounded?", f"The task's certificate, of {command}.", encoded(certified)))
    movie = encoded(folder / "video.mp4") if (folder / "video.mp4").exists() else None
    filters: dict[str, Callable[..., Any]] = {
        "two_decimals": scoring.two_decimals,
        "interval": scoring.interval,
        "cpu_seconds": scoring.cpu_seconds,
        "height": lambda value: 23 - 20 * min(max(value, -0.1), 1.1),
        "last_mean": lambda returns: np.mean(returns, 0)[-1],
    }
    parts = {
        "outcome": scoring.outcome(results["methods"]),
        "intervals": scoring.INTERVALS,
        "methods": sorted(results["methods"].items(), key=lambda item: -item[1]["score_last"]),
        "how": json.dumps({key: value for key, value in results.items() if key != "methods"}, indent=2),
    }
    run = {"results": results, "pictures": pictures, "certified": certified, "movie": movie}
    return template("report.html.jinja", filters).render(**parts, **run)
