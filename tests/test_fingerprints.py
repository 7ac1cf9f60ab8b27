"""What is kept in fingerprints.json is what today's code does, on any CPU; and a change of behaviour moves it."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from deconfounded import envs
from deconfounded.deconf import equations, methods
from deconfounded.deconf.core import adam
from deconfounded.deconf.methods import deconfounded_offline
from tests import fingerprints

LEARNED = ("deconfounded", "deconfounded_offline", "dagger", "naive_rnn", "blind_bc")


@pytest.mark.slow
@pytest.mark.parametrize("label", fingerprints.EVERY)
def test_nothing_does_otherwise(label: str) -> None:
    entry = fingerprints.kept().get(label)
    said = fingerprints.problem(label, entry)
    if said and entry and entry["libraries"] != fingerprints.libraries():
        pytest.skip(f"{label} moves under {fingerprints.libraries()}; its fingerprint is of {entry['libraries']}")
    assert not said, said


def test_the_file_holds_nothing_else() -> None:
    assert list(fingerprints.kept()) == fingerprints.EVERY


def test_amounts_of_a_preset_are_in_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of methods alone which they are changed for; the tiny runs have amounts of their own."""
    before = {name: fingerprints.amounts_of(name, "icy_stop") for name in ("naive_rnn", "palr", "random")}
    declared = fingerprints.METHODS["palr"]
    more = replace(declared.on_control, updates=declared.on_control.updates + 1)
    monkeypatch.setattr(methods.load("palr"), "method", replace(declared, on_control=more))
    after = {name: fingerprints.amounts_of(name, "icy_stop") for name in before}
    assert [name for name in before if before[name] != after[name]] == ["palr"]


SOME = ["task:ant_goal", "expert:ant_goal", "method:deconfounded_gru", "method:naive_transformer", "method:palr"]


@pytest.mark.slow
def test_the_same_on_another_cpu() -> None:
    """With two threads and the kernels of a CPU without vector extensions."""
    code = f"""
import torch
from tests.fingerprints import kept, problem
torch.set_num_threads(2)
assert torch.backends.cpu.get_cpu_capability() == "DEFAULT"
print(*filter(None, (problem(label, kept()[label]) for label in {SOME})), sep="\\n")
"""
    other = {"ATEN_CPU_CAPABILITY": "default", "OPENBLAS_CORETYPE": "Haswell"}
    other |= {"OMP_NUM_THREADS": "2", "OMP_WAIT_POLICY": "PASSIVE"}  # threads that wait do not spin
    root = Path(__file__).resolve().parents[1]
    environ = {**os.environ, **other, "PYTHONPATH": str(root)}
    done = subprocess.run([sys.executable, "-c", code], env=environ, cwd=root, capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, "", "")


def moved(*labels: str) -> set[str]:
    """Those of the labels that differ from what is kept."""
    return {label for label in labels if fingerprints.problem(label, fingerprints.kept()[label])}


class TestChangesAreNoticed:
    """Each small change of behaviour moves the fingerprints that depend on it, and no others."""

    def test_noise_of_one_joint(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """1% more of it, of one task."""
        cls: Any = type(envs.get("weak_thruster"))
        joint, (position, velocity) = next(iter(cls.process_noise.items()))
        monkeypatch.setattr(cls, "process_noise", {**cls.process_noise, joint: (position, 1.01 * velocity)})
        tasks = ("task:weak_thruster", "task:curling", "expert:weak_thruster", "method:interventional")
        assert moved(*tasks) == {"task:weak_thruster"}

    @pytest.mark.slow
    def test_adams_epsilon(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Ten times as much: whatever trains with Adam."""
        monkeypatch.setattr(adam, "EPSILON", 1e-7)
        labels = {f"method:{name}" for name in LEARNED}
        assert moved(*labels, "method:conditional", "task:bandit", "scores:all") == labels

    @pytest.mark.slow
    def test_a_mask_that_is_ignored(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(
            deconfounded_offline,
            "offline_loss",
            lambda *given: equations.offline_loss(*given[:-1], torch.ones_like(given[-1])),
        )
        assert moved("method:deconfounded_offline", "method:deconfounded") == {"method:deconfounded_offline"}

    @pytest.mark.slow
    def test_beta_of_one_method(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """10% more."""
        amounts = fingerprints.preset

        def other(*given: Any) -> Any:
            made = amounts(*given)
            config = made.configs.get("deconfounded_offline")
            return made.configured("deconfounded_offline", beta=1.1 * config["beta"]) if config else made

        monkeypatch.setattr(fingerprints, "preset", other)
        assert moved("method:deconfounded_offline", "method:deconfounded") == {"method:deconfounded_offline"}

    def test_a_zero_of_another_task(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Scores whose zero is taken once for all tasks."""
        returns, first = fingerprints.index.last_scores, dict[str, Any]()

        def last_scores(methods: dict[str, Any]) -> Any:
            return returns({**methods, "random": first.setdefault("random", methods["random"])})

        monkeypatch.setattr(fingerprints.index, "last_scores", last_scores)
        assert moved("scores:all", "protocol:all") == {"scores:all"}

    def test_a_weight_of_one_expert(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Its least bit: the weights' checksum is part of the fingerprint."""
        policy = fingerprints.policy
        load, fingerprint = policy.load, policy.fingerprint

        def changed(task: envs.Task, *rest: Any) -> Any:
            return "0" * 64 if task.name == "curling" else fingerprint(task, *rest)

        monkeypatch.setattr(policy, "fingerprint", changed)
        assert moved("expert:curling", "expert:icy_stop", "task:curling") == {"expert:curling"}
        monkeypatch.undo()

        def heavier(task: envs.Task, *rest: Any) -> Any:
            expert = load(task, *rest)
            expert.weights["0.weight"] = expert.weights["0.weight"] * 1.0001  # type: ignore[union-attr]
            return expert

        monkeypatch.setattr(policy, "load", heavier)
        assert moved("expert:curling") == {"expert:curling"}


def test_what_is_said() -> None:
    """Which, since when, and what to do."""
    label = "method:naive_rnn"
    entry = fingerprints.kept()[label]
    key = next(iter(entry["numbers"]))
    other = {**entry, "numbers": {**entry["numbers"], key: [0.0, 0.0, 1.0]}}
    said = fingerprints.problem(label, other)
    assert said.startswith(f"{label} v{entry['version']} does otherwise than since {entry['since']}: {key} was ")
    assert said.endswith(
        "Undo that; or, if it is meant, raise `version` in its file in deconf/methods, which"
        " supersedes its records, and run `python -m tests.fingerprints --write method:naive_rnn`"
    )
    assert f"is v{entry['version']} now, and its fingerprint" in fingerprints.problem(label, {**entry, "version": 0})
    assert "has no fingerprint yet" in fingerprints.problem(label, None)
    less = {**entry, "numbers": {name: of for name, of in entry["numbers"].items() if name != key}}
    assert fingerprints.problem(label, less).startswith(f"{label} has no fingerprint yet of {key}: run `python -m")
    assert fingerprints.renewed(label, less)["numbers"][key] == pytest.approx(entry["numbers"][key], rel=1e-6)  # type: ignore[index]
    assert fingerprints.renewed(label, other) is None
