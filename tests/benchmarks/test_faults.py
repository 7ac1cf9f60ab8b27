"""A few of what the programs in tests/faults/ do at length; see docs/faults.md."""

from __future__ import annotations

from pathlib import Path

import pytest

from deconfounded.benchmarks.engine import jobs, progress
from deconfounded.benchmarks.engine.benchmark import CurveMonitor
from tests.faults import flips, inputs


def test_odd_calls_are_told() -> None:
    for what, call in inputs.calls().items():
        became = inputs.called(call)
        assert became.startswith("told") or what in inputs.ACCEPTED, f"{what} -> {became}"


def test_flipped_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of each kind of file that is read back: noticed, or harmless."""
    monkeypatch.setattr(progress, "_ticks", None, raising=False)
    monkeypatch.setattr(jobs, "SAVE_EVERY_S", jobs.SAVE_EVERY_S)
    monkeypatch.setattr(CurveMonitor, "close", CurveMonitor.close)
    for kind, (file, read) in flips.files(tmp_path).items():
        found = flips.flip(file, read, 12, seed=1)
        assert set(found) <= {"noticed", "harmless"}, (kind, found)
