"""Tasks under more and less noise, and the pictures over tasks."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from deconfounded import envs
from deconfounded.benchmarks.engine.catalogue import EXACT
from deconfounded.benchmarks.output.pictures import label, panels
from deconfounded.benchmarks.studies import gap, noise, spectrum, validate
from deconfounded.envs.task import ASSETS
from deconfounded.experts import policy
from tests.tools import dots

PNG = b"\x89PNG"
TIMES = ("0.25", "0.5", "1", "2", "4", "8")


@pytest.mark.parametrize("base", noise.BASES)
def test_noise_is_scaled_and_nothing_else(base: str) -> None:
    """Each kind alone, in the order of its factors; the same starts and outcomes, and the suite's expert."""
    task, weights = envs.get(base), str(ASSETS / "experts" / f"{base}.safetensors")
    assert isinstance(task, envs.MujocoTask)
    names = set[str]()
    for _, kind, factor, reference in spectrum.variants(base):
        other = envs.get(reference)
        assert isinstance(other, envs.MujocoTask)
        names.add(other.name)
        by = {"process": 1.0, "expert": 1.0} | {kind: factor}
        assert other.expert_noise == pytest.approx(by["expert"] * task.expert_noise)
        for joint, stds in task.process_noise.items():
            assert other.process_noise[joint] == pytest.approx(tuple(by["process"] * std for std in stds))
        one, same = envs.BatchEnv(task, 3), envs.BatchEnv(other, 3)
        np.testing.assert_array_equal(one.reset(1), same.reset(1))
        action = np.full((3, task.action_width), 0.3)
        outcomes = [env.task.outcome(env.state, action, env.theta) for env in (one, same)]
        np.testing.assert_array_equal(*outcomes)
        theirs, ours = policy.load(other, weights), policy.load(task)
        assert isinstance(theirs, policy.BoxExpert)
        assert isinstance(ours, policy.BoxExpert)
        np.testing.assert_array_equal(theirs.mean(one.observe(), one.theta), ours.mean(one.observe(), one.theta))
    assert len(names) == sum(map(len, noise.FACTORS.values()))


@pytest.mark.slow
def test_spectrum_is_shown(tmp_path: Path) -> None:
    """A column for each task and kind of noise: its factors in order, with what both kinds have in common in each."""
    points: list[dict[str, Any]] = []
    for base in noise.BASES:
        for _, kind, factor, _ in spectrum.variants(base):
            nats = {"evidence_nats_per_step": {"dynamics": 0.5, "actions": 700.0}, "verdict": "passed"}
            scores = {name: [factor, factor + 0.2] for name in (*EXACT, *spectrum.LEARNED)}
            points.append({"task": base, "kind": kind, "factor": factor, "certificate": nats, "scores": scores})
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in spectrum.table(points).splitlines()[2:]]
    head = [[base, kind, times] for base in noise.BASES for kind in spectrum.KINDS.values() for times in TIMES]
    assert [row[:3] for row in rows] == head
    for row in rows:
        assert row[3:6] == ["0.50", "700", "passed"]
        assert [float(cell) for cell in row[6:]] == pytest.approx([float(row[2]) + 0.1] * 5, abs=0.0051)
    spectrum.picture(points, tmp_path / "spectrum.png")
    assert (tmp_path / "spectrum.png").read_bytes().startswith(PNG)
    for point in points:  # as of `--methods naive_rnn dagger`
        del point["scores"]["deconfounded"]
    assert spectrum.table(points).splitlines()[0].endswith("| conditional | interventional | naive_rnn | dagger |")
    spectrum.picture(points, tmp_path / "some.png")
    assert (tmp_path / "some.png").read_bytes().startswith(PNG)


@pytest.mark.slow
def test_scores_above_and_evidence_below(figures: list[Any], tmp_path: Path) -> None:
    """Of one task: each method's mean, and both sources of evidence; it is green where the certificate is passed."""
    points: list[dict[str, Any]] = []
    for _, kind, factor, _ in spectrum.variants("icy_road"):
        nats = {"dynamics": factor, "actions": 7 * factor}
        scores = {name: [i + factor, i + factor + 0.2] for i, name in enumerate((*EXACT, *spectrum.LEARNED))}
        verdict = "passed" if factor >= 1 else "failed"
        about = {"certificate": {"evidence_nats_per_step": nats, "verdict": verdict}, "scores": scores}
        points.append({"task": "icy_road", "kind": kind, "factor": factor, **about})
    spectrum.picture(points, tmp_path / "spectrum.png")
    factors = [float(times) for times in TIMES]
    above, below = figures[0].axes[0], figures[0].axes[2]
    assert above.get_title() == "icy_road\nprocess noise"
    green = [patch.get_facecolor()[:3] == to_rgb("tab:green") for patch in above.patches]
    assert green == [factor >= 1 for factor in factors]
    for i, (name, line) in enumerate(zip((*EXACT, *spectrum.LEARNED), above.lines, strict=True)):
        assert line.get_label() == name
        np.testing.assert_allclose(line.get_xydata(), [(factor, i + factor + 0.1) for factor in factors])
    for line, (source, by) in zip(below.lines, {"dynamics": 1, "actions": 7}.items(), strict=True):
        assert line.get_label() == f"of {source}"
        np.testing.assert_allclose(line.get_ydata(), by * np.array(factors))


def test_what_the_certificate_predicted() -> None:
    """Of each point once: the least and the most that deconfounded is ahead; and that there is none."""
    points = [
        {"certificate": {"verdict": verdict}, "scores": {"deconfounded": [0.8, 1.0], "naive_rnn": [naive, naive + 0.2]}}
        for verdict, naive in (("passed", 0.1), ("passed", 0.4), ("failed", 0.9))
    ]
    sentence = spectrum.predictions(points)
    assert "passed, on 2, by 0.40 to 0.70; where it is failed, on 1, by -0.10 to -0.10." in sentence
    assert "failed, on 0, by (none)" in spectrum.predictions(points[:2])


def test_predicted_and_measured_gap(tmp_path: Path) -> None:
    """Exact less exact, learned less learned. The first correlation leaves Tier 3 out: by hand it is 1, and with it

    -.1825 / sqrt(.0875 * .6275).
    """

    def methods(*scores: float) -> dict[str, Any]:
        names = ("interventional", "conditional", "deconfounded", "naive_rnn")
        return {name: {"score_last": score} for name, score in zip(names, scores, strict=True)}

    made = {
        "bandit": methods(1, 0.5, 0.9, 0.7),
        "icy_road": methods(1, 0.4, 0.9, 0.6),
        "curling": methods(1, 0.3, 0.9, 0.5),
        "forked_path": methods(1, 0.1, 0.3, 0.9),
    }
    gaps = [each for name, of in made.items() if (each := gap.gap(envs.get(name), of))]
    np.testing.assert_allclose([each[1:] for each in gaps[::3]], [(0.5, 0.2), (0.9, -0.6)])
    assert gap.gap(envs.get("bandit"), {"naive_rnn": {"score_last": 1.0}}) is None
    text = gap.section(gaps)
    assert "is 1.00 over 3 tasks" in text
    assert "it is -0.78 over 4 tasks" in text
    assert "| forked_path | 0.90 | -0.60 |" in text
    assert gap.section(gaps[:2]) == ""
    gap.picture([(each.task.name, *each[1:]) for each in gaps], tmp_path / "gap.png")
    assert (tmp_path / "gap.png").read_bytes().startswith(PNG)


def test_a_dot_is_at_its_predicted_and_measured_gap(figures: list[Any], tmp_path: Path) -> None:
    """Across what was predicted, up what was measured; dots near the origin bear no name."""
    gap.picture([("a", 0.6, 0.2), ("b", 0.03, 0.02)], tmp_path / "gap.png", "the diagnosis")
    axes = figures[0].axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()[:8]) == ("predicted: the diagnosis", "measured")
    assert dots(axes)[-2:] == [(0.6, 0.2), (0.03, 0.02)]
    assert [(text.get_text(), text.xy[0]) for text in axes.texts] == [("a", 0.6)]


def test_dots_of_validation(figures: list[Any], tmp_path: Path) -> None:
    """Red where the certificate is passed, hollow where the thresholds were set without it."""
    rows = [
        {"case": case, "task": case, "certified": certified, "predicted": 0.5, "measured": 0.4}
        for case, certified in (("bandit", True), (noise.title("icy_road", "process", 2), False))
    ]
    validate.picture(rows, tmp_path / "validation.png")
    styles = [(line.get_color(), line.get_fillstyle()) for line in figures[0].axes[0].lines[-2:]]
    assert styles == [("tab:red", "full"), ("tab:green", "none")]


def test_validation_has_what_the_spectrum_found() -> None:
    """Every case is a task with an expert; those under other noise have their own certificate and scores."""
    unseen = 0
    for case, source in validate.CASES.items():
        task = envs.get(case)
        policy.load(task, source)
        if point := validate.point(task):
            unseen += 1
            assert task.name == f"{point['task']}_process_{point['factor']:g}".replace(".", "_")
            assert validate.certificate(task, source, Path()) is (point["certificate"]["verdict"] == "passed")
            scores = validate.measured(task, source, Path())
            assert scores["naive_rnn"] == np.mean(point["scores"]["naive_rnn"])
    assert unseen == sum(factor != 1 for factor in noise.FACTORS["process"]) * len(noise.BASES)


def test_names_of_points_hide_no_other() -> None:
    """Of points that lie close, and at the edges, names lie within the axes, apart from each other and all points."""
    points = np.array([(0, 0), (0.02, 0), (0.04, 0.01), (1, 1), (0.99, 0.97), (1, 0), (0.5, 0.5)])
    with panels(io.BytesIO(), size=(6.4, 5.2)) as [[axes]]:
        axes.set(xlim=(-0.05, 1.05), ylim=(-0.05, 1.05))
        label(axes, [f"a_longer_name {i}" for i in range(7)], points)
        assert [text.get_text() for text in axes.texts] == [f"a_longer_name {i}" for i in range(7)]
        boxes = [text.get_window_extent() for text in axes.texts]
        dots = axes.transData.transform(points)
        for i, box in enumerate(boxes):
            assert not box.count_overlaps(boxes[:i])
            assert not any(box.contains(*dot) for dot in dots)
            assert (axes.bbox.min <= box.min).all()
            assert (box.max <= axes.bbox.max).all()


def test_validation_counts_apart_what_thresholds_were_set_by(tmp_path: Path) -> None:
    def row(case: str, right: bool, predicted: float, measured: float) -> dict[str, Any]:
        verdict = {"verdict": "confounded", "tier": 2, "right": right, "certified": right}
        figures = {"stakes": {"value": 2 * predicted}}
        return {"case": case, "task": case, **verdict, "predicted": predicted, "measured": measured, "figures": figures}

    seen = [row("bandit", True, 0.1, 0.2), row("curling", False, 0.2, 0.9), row("icy_road", True, 0.3, 1.0)]
    ranked = "verdicts are right; the rank correlation of predicted and measured gaps is"
    assert validate.summary(seen) == f"Of cases by which thresholds were set, 2 of 3 {ranked} 1.00."
    other = [row(noise.title("icy_road", "process", factor), True, factor, -factor) for factor in (2, 4, 8)]
    assert validate.summary([*seen, *other]).endswith(f" Of cases added later, 3 of 3 {ranked} -1.00.")
    unsure = row("rolling_deck", False, 0.0, 2.0) | {"verdict": "cannot tell", "tier": None}
    assert f"{ranked} 1.00 (-0.20 with those of which it cannot tell" in validate.summary([*seen, unsure])
    table = validate.table([*seen, *other]).splitlines()
    assert table[3].startswith("| curling | failed | confounded, Tier 2 | wrong |")
    assert table[-1].endswith("| 16.00 |  |  |  | 8.00 | -8.00 |")
    validate.picture([*seen, *other], tmp_path / "validation.png")
    assert (tmp_path / "validation.png").read_bytes().startswith(PNG)
