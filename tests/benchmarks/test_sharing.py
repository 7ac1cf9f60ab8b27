"""push and pull, against a stub of the hub's API: what was pushed comes back, with a card of its record."""

import importlib.util
import inspect
import json
import re
import sys
from dataclasses import dataclass
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from deconfounded.benchmarks import pull, push
from deconfounded.benchmarks.console import run_command
from deconfounded.benchmarks.output import aggregation, card, records
from deconfounded.deconf.core.data import Draws, Signature
from deconfounded.deconf.core.nets import Scales
from deconfounded.deconf.methods.sequence_bc import RecurrentAgent
from deconfounded.envs.support.errors import InputError
from deconfounded.experts import saved_agents

ROOT = Path(__file__).parents[2]
REAL = importlib.util.find_spec("huggingface_hub") is not None
SIZES = {"observations": 1, "action": 1, "actions": 5}


class RefusedError(Exception):
    """The hub's, of a status."""

    def __init__(self, status: int) -> None:
        super().__init__(f"{status} Client Error\nRequest id 7")
        self.response = SimpleNamespace(status_code=status)


@dataclass
class Add:
    path_in_repo: str
    path_or_fileobj: Any


class Hub(ModuleType):
    """A stub of `huggingface_hub`: repositories are folders, by type and name. `calls` holds what was called."""

    def __init__(self, folder: Path) -> None:
        super().__init__("huggingface_hub")
        self.__spec__ = ModuleSpec("huggingface_hub", None)
        self.folder, self.calls, self.status = folder, list[tuple[str, tuple[Any, ...], dict[str, Any]]](), 0
        self.HfApi, self.CommitOperationAdd = (lambda library_name: self), Add

    def _of(self, call: str, repo: str, args: tuple[Any, ...] = (), **options: Any) -> Path:
        self.calls.append((call, (repo, *args), options))
        if self.status:
            raise RefusedError(self.status)
        return self.folder / options["repo_type"] / repo

    def create_repo(self, repo: str, **options: Any) -> str:
        self._of("create_repo", repo, **options).mkdir(parents=True, exist_ok=options["exist_ok"])
        return f"https://hub/{repo}"

    def create_commit(self, repo: str, operations: list[Add], **options: Any) -> SimpleNamespace:
        place = self._of("create_commit", repo, (operations,), **options)
        for one in operations:
            (place / one.path_in_repo).parent.mkdir(parents=True, exist_ok=True)
            content = one.path_or_fileobj
            content = content if isinstance(content, bytes) else Path(content).read_bytes()
            (place / one.path_in_repo).write_bytes(content)
        return SimpleNamespace(oid="c0ffee" * 6)

    def repo_info(self, repo: str, **options: Any) -> SimpleNamespace:
        if not self._of("repo_info", repo, **options).is_dir():
            raise RefusedError(404)
        return SimpleNamespace(sha="c0ffee" * 6)

    def snapshot_download(self, repo: str, *, allow_patterns: list[str], local_dir: Path, **options: Any) -> None:
        place = self._of("snapshot_download", repo, allow_patterns=allow_patterns, local_dir=local_dir, **options)
        for file in (file for file in place.rglob("*") if file.is_file()):
            name = file.relative_to(place)
            if any(name.match(pattern) for pattern in allow_patterns):
                (local_dir / name).parent.mkdir(parents=True, exist_ok=True)
                (local_dir / name).write_bytes(file.read_bytes())
        (local_dir / ".cache").mkdir()


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Hub:
    made = Hub(tmp_path / "hub")
    monkeypatch.setitem(sys.modules, "huggingface_hub", made)
    return made


@pytest.fixture
def agent(tmp_path: Path) -> Path:
    """An agent of a run, untrained."""
    signature = Signature(**{"obs": 1, "action": 1, "actions": 5, "binary": True})
    made = RecurrentAgent.new(4, Scales.plain(signature, 1), Draws([np.random.default_rng(0)], "cpu"))
    about = {"task": "bandit", "method": "naive_rnn", "seed": 1, "spaces": SIZES}
    saved_agents.save(made, tmp_path / "run/agents/naive_rnn-1", **about)
    return tmp_path / "run/agents/naive_rnn-1"


def call(monkeypatch: pytest.MonkeyPatch, command: ModuleType, *args: str | Path) -> int:
    """The exit code of a command."""
    monkeypatch.setattr("sys.argv", ["deconf", *map(str, args)])
    try:
        run_command(command.main)
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


@pytest.mark.slow
def test_an_agent_comes_back(
    agent: Path, hub: Hub, monkeypatch: pytest.MonkeyPatch, capsys: Any, tmp_path: Path
) -> None:
    """The same bytes; the card has the score of its own record, and a loop that acts."""
    back = tmp_path / "agent"
    kept = records.of_task(ROOT / "docs/records", "bandit")
    of = {name: [each for each in kept if each["method"] == name] for name in ("random", "expert", "naive_rnn")}
    records.write(tmp_path / "run/records", of["naive_rnn"])
    assert call(monkeypatch, push, agent, "me/naive-bandit", "--private") == 0
    assert hub.calls[0][2]["private"] is True
    (hub.folder / "model/me/naive-bandit/evil.py").write_text("")
    assert call(monkeypatch, pull, "me/naive-bandit", "--out", back) == 0
    assert {file.name for file in back.iterdir()} == {"README.md", "agent.json", "agent.safetensors"}
    assert all((agent / file.name).read_bytes() == file.read_bytes() for file in back.iterdir() if file.stem == "agent")
    assert "naive_rnn of bandit, class deconfounded.deconf.methods" in capsys.readouterr().out
    text = (back / "README.md").read_text()
    random, expert = (np.mean([each["returns"][0] for each in of[name]]) for name in ("random", "expert"))
    own = {each["seed"]: (each["returns"][0] - random) / (expert - random) for each in of["naive_rnn"]}
    assert f"The {len(own)} seeds of its run: {np.mean([*own.values()]):.2f}" in text
    score = own[1]
    assert f"in the last episode: {score:.2f}, 95% interval" in text
    front = dict(line.split(": ", 1) for line in text.split("---")[1].strip().splitlines())
    [metric] = json.loads(front["model-index"])[0]["results"][0]["metrics"]
    assert metric["value"] == pytest.approx(score, abs=1e-4)
    monkeypatch.chdir(tmp_path)
    [loop] = re.findall(r"```python\n(.*?)```", text, re.S)
    acted: dict[str, Any] = {}
    exec(loop, acted)
    assert acted["over"]


def test_the_calls_are_those_of_the_library(
    agent: Path, hub: Hub, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Each binds to the signature of the method that it stands for."""
    if not REAL:
        pytest.skip("huggingface_hub is not installed")
    assert call(monkeypatch, push, agent, "me/x") == 0
    assert call(monkeypatch, pull, "me/x", "--out", tmp_path / "x", "--revision", "main") == 0
    monkeypatch.undo()
    real = importlib.import_module("huggingface_hub")
    for name, args, options in hub.calls:
        inspect.signature(getattr(real.HfApi, name)).bind(None, *args, **options)
    inspect.signature(real.HfApi).bind(library_name="x")
    inspect.signature(real.CommitOperationAdd).bind("README.md", b"")


def test_what_is_fetched_is_of_the_revision_that_was_asked_for(
    agent: Path, hub: Hub, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Its commit is looked up, and the files are those of that commit."""
    assert call(monkeypatch, push, agent, "me/x") == 0
    assert call(monkeypatch, pull, "me/x", "--out", tmp_path / "x", "--revision", "audited") == 0
    revisions = {name: options["revision"] for name, _, options in hub.calls if "revision" in options}
    assert revisions == {"repo_info": "audited", "snapshot_download": "c0ffee" * 6}


def test_a_data_set_comes_back(hub: Hub, monkeypatch: pytest.MonkeyPatch, capsys: Any, tmp_path: Path) -> None:
    """From the folder that `deconf data` wrote, however deep the data set is in it."""
    place = tmp_path / "data/deconf/bandit/expert2s0-v0/data"
    place.mkdir(parents=True)
    about = {"dataset_id": "deconf/bandit/expert2s0-v0", "total_steps": 200, "ref_min_score": 20.0}
    (place / "metadata.json").write_text(json.dumps(about))
    (place / "main_data.hdf5").write_bytes(b"\x89HDF")
    assert call(monkeypatch, push, tmp_path / "data", "me/bandit") == 0
    assert call(monkeypatch, pull, "datasets/me/bandit", "--out", tmp_path / "back") == 0
    assert (tmp_path / "back/data/main_data.hdf5").read_bytes() == b"\x89HDF"
    assert "| steps | 200 |" in (tmp_path / "back/README.md").read_text()
    assert call(monkeypatch, pull, "me/bandit") == 2
    assert "there is no such repository" in capsys.readouterr().err


def test_what_is_amiss_is_one_line(
    agent: Path, hub: Hub, monkeypatch: pytest.MonkeyPatch, capsys: Any, tmp_path: Path
) -> None:
    """And nothing is pushed, or left behind."""
    out = tmp_path / "out"
    (tmp_path / "empty").mkdir()

    def refused(command: ModuleType, *args: str | Path) -> str:
        assert call(monkeypatch, command, *args) == 2
        error = capsys.readouterr().err
        assert len(error.strip().splitlines()) == 1
        return error

    for repo in ("me", "me/a/b", "me/a--b", "../x", "me/a b", "me/"):
        assert "it must be OWNER/NAME" in refused(push, agent, repo)
    assert "no agent.json, and 0 Minari data sets" in refused(push, tmp_path / "empty", "me/x")
    assert "is there already" in refused(pull, "me/x", "--out", tmp_path / "empty")
    for status, hint in ((401, "hf auth login"), (403, "your token may not do that")):
        hub.status = status
        assert hint in refused(push, agent, "me/x")
    hub.status = 0
    assert call(monkeypatch, push, agent, "me/x") == 0
    (hub.folder / "model/me/x/agent.safetensors").write_bytes(b"other")
    assert "is damaged, or of another agent" in refused(pull, "me/x", "--out", out)
    (hub.folder / "model/me/x/agent.json").unlink()
    assert "holds no agent" in refused(pull, "me/x", "--out", out)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["empty", "hub", "run"]
    (agent / "agent.safetensors").rename(tmp_path / "elsewhere")
    (agent / "agent.safetensors").symlink_to(tmp_path / "elsewhere")
    assert "is a link" in refused(push, agent, "me/x")
    monkeypatch.setattr(push, "find_spec", lambda name: None)
    assert "pip install deconfounded-imitation[hub]" in refused(pull, "me/x", "--out", out)


def test_which_of_several_data_sets_is_for_the_user_to_say(tmp_path: Path) -> None:
    """None is pushed of a folder that holds two; each is, by its own folder."""
    for name in ("first", "second"):
        (tmp_path / name / "data").mkdir(parents=True)
        (tmp_path / name / "data" / "metadata.json").write_text(json.dumps({"dataset_id": name}))
    with pytest.raises(InputError, match="and 2 Minari data sets; give a folder"):
        push.contents(tmp_path, "me/x")
    kind, name, files, _ = push.contents(tmp_path / "second", "me/x")
    assert (kind, name) == (push.DATA, "second")
    assert files == {"data/metadata.json": tmp_path / "second" / "data" / "metadata.json"}


def test_interval_of_a_card() -> None:
    """1.96 standard errors on either side, which are of as many trials as there were, whatever their episodes.

    The mean beside it is of the last episode too.
    """
    kept = records.of_task(ROOT / "docs/records", "slippery_cartpole")
    [own] = [each for each in kept if (records.named(each), each["seed"]) == ("naive_rnn", 1)]
    _, section = card._scores(own, kept)
    by_random, by_expert = aggregation.references(own, kept)
    last, unit = own["episodes"] - 1, by_expert - by_random
    score, sd = (own["returns"][last] - by_random) / unit, own["returns_sd"][last] / unit
    low, high = (score + side * 1.96 * sd / np.sqrt(own["eval_trials"]) for side in (-1, 1))
    assert own["episodes"] > 1
    assert f"95% interval {low:.2f} to {high:.2f}" in section
    returns = [each["returns"][last] for each in kept if records.named(each) == "naive_rnn"]
    mean = (np.mean(returns) - by_random) / unit
    assert f"The {len(returns)} seeds of its run: {mean:.2f}, " in section


def test_card_of_a_data_set() -> None:
    """Each number stands beside what it is of; what the metadata lack is left out."""
    text = card.of_data({"dataset_id": "me/x-v0", "total_episodes": 7, "ref_min_score": 1, "ref_max_score": 9}, "me/x")
    for row in ("episodes | 7", "mean return of random actions | 1", "mean return of the expert | 9"):
        assert f"| {row} |" in text
    assert "| steps |" not in text


def test_a_card_has_the_versions_of_its_own_record() -> None:
    """Of the task, the method and the expert, which count apart."""
    record = records.of_task(ROOT / "docs/records", "curling")[0]
    made = card._made({**record, "method": "x", "deployment": "", "task_version": 3, "method_version": 5})
    assert "| task | curling, version 3 |" in made
    assert f"| method | x, version 5, tier {record['tier']} |" in made
    made = card._made({**record, "expert_version": 7, "expert": "0123456789abcdef" * 4, "seed": 9})
    assert "| expert | version 7, sha256 0123456789abcdef |" in made
    assert "| seed | 9 |" in made


def test_card_without_a_record(tmp_path: Path) -> None:
    """An agent trained on data from outside has no score; of a task's file the name alone is shown."""
    about = {"class": "agent.py:Mine", "task": "/home/me/own.py:Own"}
    text = card.of_agent(tmp_path / "a/b/agent", about, "me/x")
    assert "no record" in text
    assert "/home/me" not in text
    assert "agent.py` here: read it first" in text
