"""The card of a shared agent or data set: README.md of its repository on the Hugging Face hub, made of the record."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deconfounded import envs
from deconfounded.benchmarks.output import aggregation, records, scoring

LIBRARY = "deconfounded-imitation"
ABOUT = f"`{LIBRARY}`, a benchmark of [deconfounded imitation learning](https://arxiv.org/abs/2211.02667)"
TAGS = ("imitation-learning", "reinforcement-learning", "causal-inference")
NORMAL_95 = 1.96  # standard errors on either side of a mean


def record_of(agent: Path, about: dict[str, Any]) -> tuple[records.Record, list[records.Record]] | None:
    """The record of an agent that is in the folder of its run, and all records of that run; None elsewhere."""
    folder = agent.resolve().parent.parent / "records"
    every = [record for file in sorted(folder.glob("*.jsonl")) for record in records.read(file)]
    wanted = (about.get("method"), about.get("seed"))
    own = [record for record in every if (records.named(record), record["seed"]) == wanted]
    return (own[0], every) if own else None


def _front(**entries: Any) -> str:
    """The metadata that the hub reads: YAML, whose values are JSON."""
    return "\n".join(["---", *(f"{key}: {json.dumps(value)}" for key, value in entries.items()), "---", ""])


def _table(rows: dict[str, Any]) -> str:
    """Two columns without heads; rows of None are left out."""
    lines = [f"| {name} | {value} |" for name, value in rows.items() if value is not None]
    return "\n".join(["| | |", "| --- | --- |", *lines]) + "\n"


def _scores(record: records.Record, every: Sequence[records.Record]) -> tuple[float, str]:
    """The score in the last episode of a trial, and the section on scores."""
    zero, one = aggregation.references(record, every)
    episodes = record["episodes"]
    score = scoring.normalise(np.array(record["returns"][:episodes]), zero, one)
    error = np.array(record["returns_sd"][:episodes]) / (one - zero) / record["eval_trials"] ** 0.5
    rows = [f"| episode | {' | '.join(str(e + 1) for e in range(episodes))} |", "| --- |" + " --- |" * episodes]
    rows += [f"| score | {' | '.join(map(scoring.two_decimals, score))} |"]
    ends = " to ".join(scoring.two_decimals(score[-1] + side * NORMAL_95 * error[-1]) for side in (-1, 1))
    of_seed = f"This agent, in the last episode: {scoring.two_decimals(score[-1])}, 95% interval {ends}"
    text = f"{of_seed} (normal, over {record['eval_trials']} trials with fresh thetas; 0 and 1 are taken to be exact)."
    name = records.named(record)
    seeds = [each["returns"][episodes - 1] for each in every if records.named(each) == name]
    if (interval := scoring.bootstrap(scoring.normalise(np.array(seeds), zero, one))) is not None:
        mean = scoring.two_decimals(float(scoring.normalise(np.mean(seeds), zero, one)))
        text += f" The {len(seeds)} seeds of its run: {mean}, {scoring.interval(interval.tolist(), len(seeds))}."
    note = "0 is the mean return of random actions, 1 that of the expert, which sees theta."
    return float(score[-1]), f"## Score\n\n{text} {note}\n\n" + "\n".join(rows) + "\n"


def _made(record: records.Record) -> str:
    """The section on what made the agent."""
    changes = " ".join(record["set"])
    rows = {
        "task": f"{record['task']}, version {record['task_version']}",
        "method": f"{records.named(record)}, version {record['method_version']}, tier {record['tier']}",
        "seed": record["seed"],
        "preset": f"{record['preset']}{' with ' * bool(changes)}{changes}",
        "data": scoring.budget(record["budget"]),
        "expert": f"version {record['expert_version']}, sha256 {str(record['expert'])[:16]}",
        "commit": records.short_commit(record["commit"]),
        "versions": ", ".join(f"{name} {version}" for name, version in record["versions"].items()),
        "machine": record["machine"],
    }
    return "## What made it\n\n" + _table(rows)


LOOP = """```python
import gymnasium
import numpy as np

import deconfounded

agent = deconfounded.load("agent")
env = gymnasium.make("deconfounded.envs:{gym_id}")
agent.begin(1)  # one trial: one hidden theta
for episode in range({episodes}):
    obs, _ = env.reset(options={{"keep_theta": True}} if episode else None)
    agent.reset([np.random.default_rng(episode)])
    over = False
    while not over:
        action = agent.act(obs[None])
        then, reward, terminated, truncated, _ = env.step({step})
        agent.observe(obs[None], action, then[None], np.ones(1, bool))
        obs, over = then, terminated or truncated
```
"""


def of_agent(folder: Path, about: dict[str, Any], repo: str) -> str:
    """The card of a saved agent; about: its agent.json. Without a record it has no score, and says so."""
    reference = str(about.get("task") or "")
    task = reference.rpartition(":")[2] or "data from outside"  # without the folder of a task's file
    method = str(about.get("method") or about["class"].rpartition(":")[2])
    ours = envs.get(reference) if reference in envs.names() else None
    entries: dict[str, Any] = {"library_name": LIBRARY, "tags": [LIBRARY, *TAGS, *([task] if ours else [])]}
    parts = [f"# {method} on {task}\n"]
    parts += [f"An agent of {ABOUT}.\n"]
    if found := record_of(folder, about):
        score, section = _scores(*found)
        metric = {"type": "score", "name": "score in the last episode", "value": round(score, 4)}
        kind = {"type": "reinforcement-learning", "name": "imitation learning"}
        result = {"task": kind, "dataset": {"name": task, "type": task}, "metrics": [metric]}
        entries["model-index"] = [{"name": method, "results": [result]}]
        parts += [section, _made(found[0])]
    else:
        parts += ["There is no record of it beside it, and so no score.\n"]
    lines = [f'pip install "{LIBRARY}[bench,hub]"', f"deconf pull {repo} --out agent"]
    if reference:
        own = "" if ours else "  # the task's file is not in this repository"
        lines += [f"deconf score --agent agent --task {task if ours else f'path/file.py:{task}'}{own}"]
    parts += ["## Load it, and act\n", "```bash\n" + "\n".join(lines) + "\n```\n"]
    if ours:
        step = "int(action[0, 0])" if ours.n_actions else "action[0]"
        parts += [LOOP.format(gym_id=ours.gym_id, episodes=ours.episodes, step=step)]
    code = " It is in `agent.py` here: read it first." if about["class"].startswith("agent.py:") else ""
    parts += [f"Loading an agent runs the code of its class, `{about['class']}`.{code}\n"]
    return _front(**entries) + "\n" + "\n".join(parts)


def of_data(about: dict[str, Any], repo: str) -> str:
    """The card of a Minari data set; about: its metadata.json."""
    entries = {"task_categories": ["reinforcement-learning"], "tags": [LIBRARY, "minari", *TAGS]}
    rows = {
        "data set": about.get("dataset_id"),
        "behaviour": about.get("algorithm_name"),
        "episodes": about.get("total_episodes"),
        "steps": about.get("total_steps"),
        "mean return of random actions": about.get("ref_min_score"),
        "mean return of the expert": about.get("ref_max_score"),
        "Minari": about.get("minari_version"),
    }
    use = [f'pip install "{LIBRARY}[data,hub]"', f"deconf pull {repo} --out data", "deconf look --data data"]
    parts = [
        f"# {about.get('dataset_id', repo)}\n",
        f"{about.get('description') or 'Trials'}. Made with {ABOUT}.\n",
        _table(rows),
        "## Load it\n",
        "```bash\n" + "\n".join(use) + "\n```\n",
        '```python\nfrom deconfounded.experts.trials import Trials\n\ntrials = Trials.from_minari("data")\n```\n',
        "Metadata of episodes may hold theta, for scoring. `Trials.from_minari` leaves it out, as imitators must not\n"
        "see it.\n",
    ]
    return _front(**entries) + "\n" + "\n".join(parts)
