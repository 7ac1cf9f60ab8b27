"""The site's pages of tasks, methods, commands and modules, made of classes, declarations, docstrings and records."""

import importlib
import inspect
import json
import re
from collections.abc import Iterable
from typing import Any

from deconfounded import envs
from deconfounded.__main__ import COMMANDS, STUDIES
from deconfounded.benchmarks.console import ROOT
from deconfounded.benchmarks.engine.catalogue import DEFAULT, METHODS
from deconfounded.benchmarks.engine.presets import preset
from deconfounded.benchmarks.output import index, scoring
from deconfounded.benchmarks.studies import cards, results
from deconfounded.benchmarks.studies.cards import DOCS, markdown_table
from deconfounded.deconf import methods
from deconfounded.deconf.method import ENVIRONMENT, USES

TASKS = (*envs.SUITE, *envs.HARD)
MODULES = {  # of the API reference
    "Environments": (
        *("deconfounded", "deconfounded.envs", "deconfounded.envs.task"),
        *("deconfounded.envs.theta", "deconfounded.envs.latent"),
        *("deconfounded.envs.physics", "deconfounded.envs.edits", "deconfounded.envs.noise", "deconfounded.envs.batch"),
        *("deconfounded.envs.adapters", "deconfounded.envs.registry", "deconfounded.envs.streams"),
        *("deconfounded.envs.blackbox", "deconfounded.envs.contract.check", "deconfounded.envs.support.errors"),
    ),
    "Experts and trials": (
        *("deconfounded.experts.policy", "deconfounded.experts.rollout", "deconfounded.experts.saved_agents"),
        *("deconfounded.experts.datasets.logs", "deconfounded.experts.datasets.minari_sets"),
        *("deconfounded.experts.train", "deconfounded.experts.sb3"),
    ),
    "Beliefs and methods": (
        *("deconfounded.deconf.method", "deconfounded.deconf.given", "deconfounded.deconf.equations"),
        *("deconfounded.deconf.exact", "deconfounded.deconf.learned_reference", "deconfounded.deconf.core.data"),
        *("deconfounded.deconf.core.agents", "deconfounded.deconf.core.beliefs", "deconfounded.deconf.core.models"),
        *("deconfounded.deconf.core.latent_model", "deconfounded.deconf.core.linear_model"),
        *("deconfounded.deconf.core.nets", "deconfounded.deconf.core.monitor", "deconfounded.deconf.methods"),
    ),
    "Methods": tuple(
        dict.fromkeys(
            f"{methods.__name__}.{place.partition(':')[0]}"
            for place in (*methods.METHODS.values(), "sequence_bc", "memoryless_bc")
        )
    ),
    "Tasks": tuple(f"deconfounded.envs.tasks.{name}" for name in TASKS),
    "Diagnosis": tuple(
        f"deconfounded.deconf.diagnosis.{name}" for name in ("diagnose", "look", "exploration", "measures", "latent")
    ),
    "Results": tuple(
        f"deconfounded.benchmarks.output.{name}"
        for name in ("records", "aggregation", "scoring", "statistics", "comparison")
    ),
}
TYPICAL = {"control": "slippery_cartpole", "bandit": "bandit"}  # tasks whose amounts a method's page shows


def pages(found: index.Found) -> dict[str, str]:
    """Markdown of each generated page, by its name; links are as in files of docs/."""
    hard, certified = results.published(names=envs.HARD), cards.certified()
    by_task = {task.name: made for task, made in (*found, *hard)}
    made = {"tasks/index": _tasks(by_task), "methods/index": _methods(found, certified), "commands": _commands()}
    made |= {f"tasks/{name}": task_page(envs.get(name), by_task.get(name)) for name in TASKS}
    made |= {f"methods/{name}": method_page(name, found) for name in methods.METHODS}
    return made | _api()


def _toctree(names: Iterable[str]) -> str:
    return "\n".join(["```{toctree}", ":hidden:", "", *names, "```"])


def _bullets(text: str, name: str) -> list[str]:
    """The items of a page's lists in which `name` stands."""
    items = re.findall(r"^- .*?(?=^- |^\n|^#|\Z)", text, re.S | re.M)
    return [item.strip() for item in items if re.search(rf"`{name}`", item)]


def _headline(module: Any) -> str:
    """The first paragraph of a docstring, on one line."""
    return (inspect.getdoc(module) or "").split("\n\n")[0].replace("\n", " ")


def _tasks(by_task: dict[str, Any]) -> str:
    """The table of tasks."""
    rows = []
    for name in TASKS:
        task = envs.get(name)
        latents = ", ".join(f"{lat.name} ({lat.unit})" if lat.unit else lat.name for lat in task.latents)
        scores = (by_task.get(name, {}).get("methods", {}).get(method) for method in ("deconfounded", "naive_rnn"))
        last = (scoring.two_decimals(entry["score_last"]) if entry else "" for entry in scores)
        rows.append(
            (f"[{name}](tasks.md#{name})", _headline(inspect.getmodule(type(task))), latents, task.tier_name, *last)
        )
    head = ("task", "what", "latents", "tier needed", "deconfounded", "naive_rnn")
    table = markdown_table(head, rows)
    text = "Tier needed: the lowest at which the interventional policy is identified. Scores are of the last episode."
    about = "Each page is made from the task's class, its certificate and its [records](records)."
    return "\n\n".join(["# Tasks", f"{text} {about}", table, _toctree(TASKS)]) + "\n"


def task_page(task: envs.Task, made: dict[str, Any] | None) -> str:
    """A task: clip, latents, observation, action, noise, certificate, results, expert, versions."""
    card = re.sub(r"^## ", "# ", cards.card(task), count=1)
    head, _, rest = card.partition("\n\n")
    parts = [head]
    if (DOCS / f"{task.name}.webp").exists():
        parts += [f"![expert, naive clone and deconfounded agent under one theta]({task.name}.webp)"]
        parts += ["*The expert, the naive clone and the deconfounded agent, under the same theta.*"]
    parts += [rest, f"Action: {_action(task)} Gymnasium id: `{task.gym_id}`."]
    if (DOCS / f"{(certificate := cards.certificate_of(task.name))}.png").exists():
        files = f"[json]({certificate}.json)"
        parts += ["## Certificate", f"![certificate of {task.name}]({certificate}.png)"]
        parts += [
            f"Made by `deconf certify --task {task.name}` ({files}); [what it measures](concepts.md#certificate)."
        ]
    if made:
        section = results.section(task, made).split("\n\n")
        parts += ["## Results", scoring.outcome(made["methods"])]
        parts += [part for part in section[1:] if not part.startswith("![expert, naive")]
    parts += ["## Expert", _expert(task), "## Versions", _history(task)]
    parts += ["## Source", f"{{py:mod}}`{type(task).__module__}`"]
    return "\n\n".join(parts) + "\n"


def _action(task: envs.Task) -> str:
    if task.n_actions:
        return f"one of {task.n_actions} (discrete)."
    return f"{task.action_width} number{'s' * (task.action_width > 1)} in [-1, 1]."


def _expert(task: envs.Task) -> str:
    file = ROOT / "assets" / "experts" / f"{task.name}.json"
    if not file.is_file():
        return f"The expert has a closed form, `{'expert_probs' if task.n_actions else 'expert_mean'}` of the class."
    card = json.loads(file.read_text("utf-8"))
    rows = [("algorithm", card["algorithm"]), ("made by", f"`{card['command']}`"), ("version", str(card["version"]))]
    mean, error = card["return_mean"], card["return_standard_error"]
    rows.append(("return", f"{mean:g} ± {error:g} over {card['episodes_scored']} episodes"))
    rows += [("return of random actions", f"{card['return_random']:g}"), ("sha256", f"`{card['sha256'][:16]}`")]
    return markdown_table(("expert", f"[card](../assets/experts/{task.name}.json)"), rows)


def _history(task: envs.Task) -> str:
    """Today's version, and the items of the changelogs that name the task."""
    text = f"Version {task.version}. A task's version is raised when its scores stop being comparable."
    items = [_as_in_docs(item) for item in _bullets((ROOT / "CHANGELOG.md").read_text("utf-8"), task.name)]
    items += _bullets((DOCS / "history.md").read_text("utf-8"), task.name)
    return "\n".join([f"{text} The [changelogs](history.md) on {task.name}:\n", *items]) if items else text


def _as_in_docs(text: str) -> str:
    """Links of a file in the root of the repository, as from docs/."""
    return re.sub(r"\]\((?!https?:|#)", "](../", text)


def _methods(found: index.Found, certified: dict[str, Any]) -> str:
    """The table of methods."""
    table = results.fared(found, certified)
    table = re.sub(
        r"^\| (\w+) \|",
        lambda row: f"| [{row[1]}](/methods/{row[1]}.md) |" if row[1] in METHODS else row[0],
        table,
        flags=re.M,
    )
    text = "Scores in the last episode, with 95% intervals, over the tasks whose certificate is passed. A *tier* is the"
    text += " data that a method may use: 1, demonstrations; 2, also exploration; 3, also queries of the expert."
    about = "Each page is made from the method's module, its declaration and its [records](records)."
    return "\n\n".join(["# Methods", f"{text} {about}", table, _toctree(methods.METHODS)]) + "\n"


def method_page(name: str, found: index.Found) -> str:
    """A method: idea, paper, tier, data, results, failures, amounts, source."""
    method, fit = METHODS[name], methods.load(name)
    module = importlib.import_module(fit.__module__)
    baselines = (DOCS / "baselines.md").read_text("utf-8")
    own = f"*{inspect.getdoc(fit)}*" if fit.__name__ != "fit" else ""
    parts = [f"# {name}", own, inspect.getdoc(module) or ""]
    if row := re.search(rf"^\| {name} \| ([^|]+) \| ([^|]+) \|", baselines.partition("\n## ")[0], re.M):
        parts += [f"In short: {row[1]}. After: {row[2]}."]
    uses = {**USES, ENVIRONMENT: "the environments of evaluation, and the expert: for references alone"}
    used = "; ".join(f"*{kind}*, {uses[kind]}" for kind in method.uses) or "nothing"
    parts += [f"Tier: {method.tier}. It uses {used}. Version {method.version}."]
    if method.deployments:
        deployments = ", ".join(f"`{name}_{way}`" for way in method.deployments)
        parts += [f"Its agent is also scored in another deployment: {deployments}."]
    asked = "" if name in DEFAULT else f" --methods {name}"
    parts += [f"```bash\ndeconf run --task slippery_cartpole{asked}\n```", "## Results", _scores(name, found)]
    items = [item for item in _bullets(baselines, name) if item.startswith(f"- `{name}`")]
    if behind := _behind(name, found):
        parts += ["## Strengths and failures", behind, "\n".join(items)]
    parts += ["## Amounts", _amounts(name)]
    parts += ["## Source", f"{{py:mod}}`{module.__name__}`"]
    return "\n\n".join(filter(None, parts)) + "\n"


def _scores(name: str, found: index.Found) -> str:
    """A row for each task: the score in the last episode, its interval, and what it takes."""
    rows = []
    for task, made in found:
        if entry := made["methods"].get(name):
            best = made["methods"].get("interventional")
            exact = scoring.two_decimals(best["score_last"]) if best else ""
            interval = scoring.interval(entry["ci95"], len(entry["seeds"]))
            last = scoring.two_decimals(entry["score_last"])
            link = f"[{task.name}](tasks.md#{task.name})"
            rows.append((link, last, interval, exact, scoring.budget(entry["budget"]), scoring.cpu_seconds(entry)))
    head = ("task", "last", "interval", "exact interventional", "data, a seed", "CPU s, a seed")
    text = "Scores in the last episode of a trial: 0 = random actions, 1 = the expert that sees theta."
    return f"{text} {scoring.INTERVALS}\n\n{markdown_table(head, rows)}" if rows else "There are no records."


def _behind(name: str, found: index.Found) -> str:
    """The tasks on which a method is furthest behind the exact interventional policy."""
    gaps = list[tuple[float, str]]()
    for task, made in found:
        if "interventional" in (of := made["methods"]) and name in of and METHODS[name].learned:
            score, exact = (of[one]["score_last"] for one in (name, "interventional"))
            words = f"`{task.name}`, {scoring.two_decimals(score)} of {scoring.two_decimals(exact)}"
            gaps.append((score - exact, words))
    worst = "; ".join(words for gap, words in sorted(gaps)[:3] if gap < 0)
    return f"Furthest behind the exact interventional policy, in the last episode: {worst}." if worst else ""


def _amounts(name: str) -> str:
    """Hyperparameters in the default preset, and the data of a seed."""
    settings = {kind: preset("default", envs.get(task), "cpu", [name]) for kind, task in TYPICAL.items()}
    configs = [made.configs.get(name, {}) for made in settings.values()]
    if not any(configs):
        return "It has no hyperparameters."
    keys = [
        key for key in dict.fromkeys(key for config in configs for key in config) if key not in ("device", "drifts")
    ]
    rows = [(f"`{key}`", *(f"{config.get(key, '')}" for config in configs)) for key in keys]
    text = "Hyperparameters in the preset `default`, on control tasks and on the bandit;"
    text += (
        f" `--set {name}.{keys[0]}=VALUE` changes one. The configuration's class, see *Source*, says what they mean."
    )
    return f"{text}\n\n{markdown_table(('hyperparameter', *TYPICAL), rows)}"


def _commands() -> str:
    """The table of commands."""
    rows = (
        (f"`deconf {name}`", text, "a checkout" if module.startswith(STUDIES) else "")
        for name, (module, text, _) in COMMANDS.items()
    )
    text = (
        "`deconf COMMAND --help` shows a command's options. Invalid input ends a command with one line and exit code 2."
    )
    return f"# Commands\n\n{text}\n\n{markdown_table(('command', 'what it does', 'needs'), rows)}\n"


def _api() -> dict[str, str]:
    """A page for each module of the reference, and their table."""
    made, parts = (
        {},
        ["# API reference", "Made from docstrings. Shape letters are those of {py:mod}`deconfounded.envs.task`."],
    )
    for caption, names in MODULES.items():
        for name in names:
            module = importlib.import_module(name)
            offered = [each for each in getattr(module, "__all__", ()) if callable(getattr(module, each))]
            members = "" if offered else "\n   :members:\n   :show-inheritance:"
            body = f"```{{eval-rst}}\n.. automodule:: {name}{members}\n```"
            if offered:  # they are documented where they are defined
                places = ((each, getattr(module, each).__module__) for each in offered)
                rows = ((f"`{each}`", f"{{py:obj}}`{where}.{each}`") for each, where in places)
                body += f"\n\nIts names:\n\n{markdown_table(('name', 'defined as'), rows)}"
            made[f"api/{name}"] = f"# {name}\n\n{body}\n"
        lines = ((f"[{name}](/api/{name}.md)", _headline(importlib.import_module(name))) for name in names)
        parts += [f"## {caption}", markdown_table(("module", "what"), lines), _toctree(names)]
    return made | {"api/index": "\n\n".join(parts) + "\n"}
