"""A few of what the programs in tests/faults/ do at length; see docs/faults.md."""

from pathlib import Path

import pytest

from deconfounded.benchmarks.engine import jobs, progress
from deconfounded.benchmarks.engine.benchmark import CurveMonitor
from tests.faults import flips, inputs, planted


def test_planted_faults_are_in_step_with_the_code() -> None:
    """What a fault replaces is there once, and so are the files of its tests; names are its own."""
    every = planted.faults()
    assert len({fault.name for fault in every}) == len(every)
    for fault in every:
        planted.check(fault, (planted.ROOT / fault.file).read_text(encoding="utf-8"))
        files = [word.partition("::")[0] for word in fault.tests.split() if word.startswith("tests/")]
        assert files, fault.name
        assert all((planted.ROOT / name).is_file() for name in files), fault.name


@pytest.mark.slow
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
        outcomes = flips.flip(file, read, 12, seed=1)
        assert set(outcomes) <= {"noticed", "harmless"}, (kind, outcomes)
