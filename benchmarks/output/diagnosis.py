"""A diagnosis for people: index.html, which needs no other file, and diagnosis.json for programs."""

import io
import re
from pathlib import Path
from typing import Any

from deconfounded.benchmarks.output.pictures import colour, encoded, panels
from deconfounded.benchmarks.output.templates import template
from deconfounded.deconf.diagnosis.thresholds import GOOD, NEGLIGIBLE, STAKES
from deconfounded.deconf.diagnosis.verdict import Diagnosis, Figure
from deconfounded.envs.support.files import write_atomically, write_json
from deconfounded.experts.datasets.units import Units

Rows = dict[str, tuple[Figure, str]]
"""Bars by what stands beside them, each with its colour."""

WIDE = 30  # times the threshold: what is further off goes on a logarithmic axis


def write(diagnosis: Diagnosis, about: dict[str, Any], folder: Path) -> str:
    """Both files; returns what to print."""
    code = _code(diagnosis, about)
    made = {
        "verdict": diagnosis.verdict,
        "tier": diagnosis.tier,
        "headline": diagnosis.headline,
        **{key: getattr(diagnosis, key) for key in ("conclusion", "cost", "sure", "wrong", "agreeing", "dissenting")},
        "reasons": list(diagnosis.reasons),
        "next": {"advice": diagnosis.next.advice, "code": code},
        "figures": {key: figure._asdict() for key, figure in diagnosis.figures.items()},
    }
    write_json(folder / "diagnosis.json", {**made, **about})
    findings = _findings(diagnosis.figures)
    page = template("diagnosis.html.jinja").render(diagnosis=diagnosis, findings=findings, code=code, about=about)
    write_atomically(folder / "index.html", page + "\n")
    how = f"\n\n{code}" if code else ""
    plain = {
        "Conclusion": diagnosis.conclusion,
        "Cost of cloning": diagnosis.cost,
        "How sure": f"{diagnosis.sure} {diagnosis.wrong}".strip(),
        "Next": f"{diagnosis.next.advice}{how}",
    }
    text = "\n".join([diagnosis.headline.upper(), *(f"{title}: {said}" for title, said in plain.items())])
    return f"{text}\n-> {folder / 'index.html'}"


WRITTEN = {  # functions of the user's own, until they are written
    "explore": """
def explore(agent):  # blind to theta; better than the log are trials in which the agent acts (None at first)
    return {log}


""",
    "query": """
def query(agent):  # trials in which the agent acts (None, at first: random actions), and the expert's actions in them
    raise NotImplementedError("ask the expert: return trials, actions")


""",
}


def _code(diagnosis: Diagnosis, about: dict[str, Any]) -> str:
    """Lines of Python that do what is to be done next, if a method does it."""
    if not diagnosis.next.fit:
        return ""
    method = diagnosis.next.fit.partition(".")[0]
    columns = "".join(f", {name}={value!r}" for name, value in about["columns"].items())
    source = repr(about["trials"]["from"])
    read = f"trials = datasets.read({source}{columns})\n"
    if about["explore"]:
        sources = f"[{source}, {about['explore']['from']!r}]"
        read = f"trials, explored = datasets.read_together({sources}{columns})  # actions on the same scale\n"
    asked = next((name for name in WRITTEN if name in re.findall(r"\w+", diagnosis.next.fit)), "")
    own = WRITTEN[asked].format(log="explored" if about["explore"] else "trials") if asked else ""
    raw = "agent = trials.units.agent(agent)  # acts in the units of the log\n" if Units(**about["units"]).raw else ""
    names = ", ".join(" ".join(name.split()) for name in about["units"]["obs"])  # a line break would end the comment
    return f"""import numpy as np
from deconfounded.deconf.methods import {method}
from deconfounded.experts import datasets

{read}{own}agent = {diagnosis.next.fit}  # takes minutes, prints nothing
{raw}agent.save("agent")

# In your own program, after `import deconfounded`; obs: {names}
# agent = deconfounded.load("agent")
# agent.begin(1)  # when a trial starts
# agent.reset([np.random.default_rng()])  # when an episode starts
# action = agent.act(obs[None])[0]  # at each step; and when next_obs is there:
# agent.observe(obs[None], action[None], next_obs[None], np.ones(1, bool))
"""


def _findings(figure: dict[str, Figure]) -> list[tuple[str, str, str]]:
    """Title, two sentences, and a picture."""
    memory, naive, latent = (figure[key] for key in ("memory_gain", "naive", "latent"))
    stakes, paired = figure["stakes"], figure["paired_stakes"]
    predictors: Rows = {"memory": (memory, colour("naive_rnn"))}
    source = "Exploration would show how much of that is evidence of the dynamics, and how much of past actions alone."
    if "latent_gain" in figure:
        gain = figure["latent_gain"]
        predictors["latent from dynamics"] = (gain, colour("interventional"))
        source = (
            f"A latent that is inferred from the dynamics alone improves the prediction by {gain} over latents of other"
            " trials (0 or less: not at all). What a memory knows beyond that comes, for the most part, from the"
            " expert's past actions, and a clone's own actions are no evidence."
        )
    sections = [
        (
            "Is there a latent, and where is its evidence?",
            f"A memory of the trial predicts the expert's action {memory} nats a step better than the present"
            f" observation alone; {NEGLIGIBLE} is negligible. {source}",
            _bars(predictors, "improvement of the prediction, nats a step", NEGLIGIBLE),
        )
    ]
    if "exploration_evidence" in figure:
        sources = ("exploration_evidence", "expert_evidence", "action_evidence")
        in_exploration, in_trials, in_actions = (figure[key] for key in sources)
        evidence: Rows = {
            "dynamics, in exploration": (in_exploration, colour("interventional")),
            "dynamics, in expert trials": (in_trials, colour("expert")),
            "the expert's actions": (in_actions, colour("naive_rnn")),
        }
        sections.append(
            (
                "Are the dynamics evidence of it?",
                f"A trial's own latent makes next observations {in_exploration} nats a step more likely than another"
                f" trial's in exploration, whose actions do not depend on it, and {in_trials} in expert trials. If the"
                f" latter is below {NEGLIGIBLE}, and the latent explains next to none of the actions, expert trials do"
                f" not identify it. The expert's actions are evidence of it by {in_actions} nats a step,"
                f" {figure['ratio']} times as much: this is the false confidence of a clone that takes its own actions"
                " for the expert's.",
                _bars(evidence, "nats a step", NEGLIGIBLE),
            )
        )
    hue = colour("expert")
    deviations: Rows = {"from all with right latents": (stakes, hue), "paired by latent and start": (paired, hue)}
    sections.append(
        (
            "What is at stake?",
            f"In the learned dynamics, trajectories of an expert policy given a wrong latent deviate {stakes} times as"
            f" much as by chance from those given right latents, and {paired} times as much when paired by latent and"
            f" start; below {STAKES} that may be chance. Trajectories in the learned dynamics deviate from the data's"
            f" {figure['model_deviation']} times as much as by chance, and last {figure['model_length']} times as"
            " long.",
            _bars(deviations, "deviation under a wrong latent, times chance", STAKES),
        )
    )
    actors = [("naive clone", "naive", "naive_rnn"), ("infers the latent", "latent", "deconfounded")]
    scores: Rows = {actor: (figure[key], colour(hue)) for actor, key, hue in actors}
    scores |= {f"{actor}, Eq. (1)": (figure[f"{key}_by_actions"], colour(hue)) for actor, key, hue in actors}
    sections.append(
        (
            "What will it cost?",
            f"From 0 for the expert policy given a wrong latent to 1 for the right one, a naive clone scores {naive} by"
            f" trajectories, and a policy that infers the latent from the dynamics {latent}. Eq. (1) scores actions.",
            _bars(scores, "predicted score, last episode", GOOD),
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
