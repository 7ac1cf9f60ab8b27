"""A diagnosis for people: index.html, which needs no other file, and diagnosis.json for programs."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from deconfounded.benchmarks.output.index import template
from deconfounded.benchmarks.output.pictures import colour, encoded, panels
from deconfounded.deconf.diagnosis.diagnose import FINE, LITTLE, STAKES, Diagnosis, Figure
from deconfounded.envs.support.files import write_atomically, write_json

Rows = dict[str, tuple[Figure, str]]
"""Bars by what stands beside them, each with its colour."""

WIDE = 30  # times the threshold: what is further off goes on a logarithmic axis


def write(diagnosis: Diagnosis, about: dict[str, Any], folder: Path) -> str:
    """Both files; returns what to print."""
    code = _code(diagnosis, about)
    made = {
        "verdict": diagnosis.verdict,
        "tier": diagnosis.tier,
        "reasons": list(diagnosis.reasons),
        "next": {"advice": diagnosis.next.advice, "code": code},
        "found": {key: figure._asdict() for key, figure in diagnosis.found.items()},
    }
    write_json(folder / "diagnosis.json", {**made, **about})
    findings = _findings(diagnosis.found)
    page = template("diagnosis.html.jinja").render(diagnosis=diagnosis, findings=findings, code=code, about=about)
    write_atomically(folder / "index.html", page + "\n")
    how = f"\n\n{code}" if code else ""
    text = "\n".join([diagnosis.verdict.upper(), *diagnosis.reasons, f"Next: {diagnosis.next.advice}{how}"])
    return f"{text}\n-> {folder / 'index.html'}"


def _code(diagnosis: Diagnosis, about: dict[str, Any]) -> str:
    """Lines of Python that do what is to be done next, if a method does it."""
    if not diagnosis.next.fit:
        return ""
    source = about["trials"]["from"]
    read = f"Trials.{'from_minari' if Path(source).is_dir() else 'load'}(Path({source!r}))"
    method = diagnosis.next.fit.partition(".")[0]
    return f"""from pathlib import Path
import numpy as np
from deconfounded.deconf.methods import {method}
from deconfounded.experts.rollout import Trials

trials = {read}
agent = {diagnosis.next.fit}
agent.save("agent")
"""


def _findings(figure: dict[str, Figure]) -> list[tuple[str, str, str]]:
    """Title, two sentences, and a picture."""
    memory, naive, latent = (figure[key] for key in ("memory", "naive", "latent"))
    stakes, strayed = figure["stakes"], figure["strayed"]
    predictors: Rows = {"memory": (memory, colour("naive_rnn"))}
    whence = "Exploration would show how much of that the world's answers tell, and how much past actions alone."
    if "explained" in figure:
        world = figure["explained"]
        predictors["the world's answers"] = (world, colour("interventional"))
        whence = (
            f"A latent that is read off the world's answers alone tells {world} of it (below 0, less than the present"
            " observation does). What is left memory reads off the expert's past actions, for the most part, and a"
            " clone that acts by itself learns nothing from its own."
        )
    sections = [
        (
            "Is there a hidden context, and where does it show?",
            f"Memory of a trial predicts the expert's action {memory} nats a step better than the present observation"
            f" alone; {LITTLE} is nothing. {whence}",
            _bars(predictors, "nats a step over the present observation", LITTLE),
        )
    ]
    if "explored" in figure:
        explored, expert, acted = (figure[key] for key in ("explored", "shown", "acted"))
        evidence: Rows = {
            "world, in exploration": (explored, colour("interventional")),
            "world, where the expert went": (expert, colour("expert")),
            "the expert's actions": (acted, colour("naive_rnn")),
        }
        sections.append(
            (
                "Does the world tell it?",
                f"A trial's own latent makes what the world answers {explored} nats a step more likely than another"
                f" trial's in exploration, whose actions are blind to it, and {expert} where the expert went. If the"
                f" latter is below {LITTLE}, and explains next to none of the actions, expert trials do not say which"
                f" latent was theirs. The expert's actions tell it by {acted} nats a step, {figure['ratio']} times as"
                " much: so sure is a clone that takes its own actions for the expert's.",
                _bars(evidence, "nats a step", LITTLE),
            )
        )
    hue = colour("expert")
    ways: Rows = {"among those who know": (stakes, hue), "from that very expert's": (strayed, hue)}
    sections.append(
        (
            "What is at stake?",
            f"In the learned dynamics, the ways of one who acts on another latent are {stakes} times as strange, among"
            f" those of experts who know theirs, as by chance, and {strayed} times as far from those of the expert who"
            f" knows it; below {STAKES} that may be chance. Dreams are {figure['unlike']} times as strange as data.",
            _bars(ways, "ways of the mistaken one, times chance", STAKES),
        )
    )
    actors = [("naive clone", "naive", "naive_rnn"), ("infers the latent", "latent", "deconfounded")]
    scores: Rows = {who: (figure[key], colour(hue)) for who, key, hue in actors}
    scores |= {f"{who}, Eq. (1)": (figure[f"{key}_judged"], colour(hue)) for who, key, hue in actors}
    sections.append(
        (
            "What will it cost?",
            f"Between one who acts on another latent, 0, and the expert who knows it, 1, a naive clone scores {naive}"
            f" by where it goes, and one that infers the latent from the world {latent}. Eq. (1) is the same by what"
            " they do, as that expert judges it.",
            _bars(scores, "predicted score, last episode", FINE),
        )
    )
    return sections


def _bars(rows: Rows, label: str, threshold: float) -> str:
    """A picture for the page: a bar a row, its range over refits, and the threshold that decides."""
    with panels(picture := io.BytesIO(), size=(7, 1.9)) as [[axes]]:
        for i, (value, hue) in enumerate(rows.values()):
            axes.barh(i, value.value, color=hue, height=0.55, alpha=0.85)
            axes.plot([value.low, value.high], [i, i], color="0.15", lw=1.5)
        axes.axvline(0, color="0.4", lw=0.8)
        axes.axvline(threshold, color="0.4", lw=1, ls=":")
        if max(abs(value.value) for value, _ in rows.values()) > WIDE * threshold:
            axes.set_xscale("symlog", linthresh=threshold)
        axes.set_yticks(range(len(rows)), list(rows))
        axes.set_ylim(max(len(rows), 2) - 0.5, -0.5)
        axes.set(xlabel=label)
        axes.spines[["top", "right"]].set_visible(False)
    return encoded(picture)
