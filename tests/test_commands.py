"""Commands as a user runs them: bad input, resuming, and the examples in the documents."""

from __future__ import annotations

import importlib
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from deconfounded import envs
from deconfounded.benchmarks import certify, publish
from deconfounded.benchmarks.console import run_command
from deconfounded.benchmarks.output import pages, records, score
from deconfounded.envs.task import Array
from deconfounded.envs.tasks.cartpole import Cartpole
from deconfounded.experts.policy import Expert

ROOT = Path(__file__).parents[1]


def command(*args: str, **environ: str) -> subprocess.CompletedProcess[str]:
    import os

    return subprocess.run(
        [sys.executable, *args], cwd=ROOT, capture_output=True, text=True, env={**os.environ, **environ}, timeout=300
    )


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("benchmarks/run.py", "--task", "slipery_cartpole"), "did you mean 'slippery_cartpole'?"),
        (("benchmarks/run.py", "--task", "bandit", "--methods", "naive"), "did you mean 'naive_rnn'?"),
        (("benchmarks/run.py", "--task", "bandit", "--preset", "smok"), "did you mean 'smoke'?"),
        (("benchmarks/run.py", "--task", "bandit", "--seeds", "0"), "must be at least 1"),
        (("benchmarks/run.py", "--task", "bandit", "--device", "cuda:99"), "cpu always can"),
        (("benchmarks/run.py", "--task", "bandit", "--out", "/proc/none"), "cannot be written"),
        (("benchmarks/run.py",), "--task is missing"),
        (("benchmarks/run.py", "--list", "--task", "nonsense"), "it lists all, and goes by itself"),
        (("benchmarks/run.py", "--task", "bandit", "--out", ""), "argument --out: it must be a name"),
        (("benchmarks/run.py", "--task", "bandit", "--seeds", "1000000000"), "at most 1,000"),
        (("benchmarks/run.py", "--task", "bandit", "--set", "seeds=0"), "--set seeds was '0'; it must be like 5"),
        (("benchmarks/run.py", "--task", "slippery_cartpole", "--expert", "gone.py:f"), "there is no file gone.py"),
        (("benchmarks/run.py", "--task", "bandit", "--methods", "gone.py:fit"), "there is no file gone.py"),
        (("benchmarks/play.py", "--agent", "nowhere", "--task", "bandit"), "nowhere holds no agent.json"),
        (("benchmarks/rescore.py", "--agent", "nowhere", "--task", "bandit"), "nowhere holds no agent.json"),
        (("benchmarks/verify.py", "nowhere.json"), "record nowhere.json cannot be read: No such file"),
        (("benchmarks/report.py", "nowhere"), "nowhere holds no settings.json of a run"),
        (
            ("benchmarks/data.py", "--task", "bandit", "--out", "x", "--trials", "0"),
            "they must be from 1 and from 0 up",
        ),
        (("benchmarks/check.py", "--task", "bandid"), "did you mean 'bandit'?"),
        (("benchmarks/run.py", "--task", "bandit", "--seeds", "many"), "invalid int value: 'many'"),
        (("benchmarks/run.py", "--task", "bandit", "--seed", "1"), "unrecognized arguments: --seed 1"),
        (("benchmarks/run.py", "--task", "leaning_beam"), "your own is path/file.py:Class"),
        (("benchmarks/paper.py", "--methods", "oracle_bc"), "method 'oracle_bc' is unknown"),
        (("benchmarks/seeds.py", "--seeds", "0"), "must be at least 1"),
        (("benchmarks/publish.py", "nowhere"), "holds no records and adaptation.png"),
        (("benchmarks/certify.py", "--task", "bandid"), "did you mean 'bandit'?"),
        (("-m", "deconfounded.benchmarks.train", "--task", "bandit"), "nothing to train"),
        (("benchmarks/speed.py", "--task", "bandit"), "no physics to time"),
    ],
)
def test_bad_input_is_one_line(
    args: tuple[str, ...], says: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    name = args[1] if args[0] == "-m" else "deconfounded." + args[0].removesuffix(".py").replace("/", ".")
    monkeypatch.setattr("sys.argv", [args[0], *args[2 if args[0] == "-m" else 1 :]])
    with pytest.raises(SystemExit) as ended:
        run_command(importlib.import_module(name).main)
    assert ended.value.code == 2
    told = capsys.readouterr().err
    assert says in told
    assert len(told.strip().splitlines()) == 1


def test_bad_input_from_the_shell() -> None:
    """As above, in a process of its own; and what only lists or checks does not import what takes seconds."""
    done = command("benchmarks/run.py", "--task", "slipery_cartpole")
    assert done.returncode == 2
    assert done.stderr.startswith("error: task 'slipery_cartpole' is unknown; did you mean 'slippery_cartpole'?")
    assert len(done.stderr.strip().splitlines()) == 1
    code = (
        "import sys; from deconfounded.benchmarks import run;"
        " sys.argv = ['run.py', '--list']; run.main(); print(*sys.modules)"
    )
    loaded = command("-c", code).stdout.splitlines()[-1].split()
    assert "mujoco" in loaded
    assert not {"torch", "stable_baselines3", "sklearn", "matplotlib", "scipy.stats"} & set(loaded)


def test_smoke_run_resumes(tmp_path: Path) -> None:
    """The whole command on the bandit; then a finished job is lost, and --resume makes the same numbers again."""
    out, args = tmp_path / "out", ("benchmarks/run.py", "--task", "bandit", "--preset", "smoke", "--out")
    first = command(*args, str(out), "--methods", "blind_bc", "conditional", "interventional", MUJOCO_GL="off")
    assert first.returncode == 0, first.stderr
    results = json.loads((out / "results.json").read_text())
    for file in ("rows.csv", "adaptation.png", "learning.png", "report.html"):
        assert (out / file).stat().st_size > 0
    assert {"task", "task_version", "preset", "seeds", "versions", "wall_s", "methods"} <= set(results)
    assert set(results["methods"]) == {"random", "expert", "blind_bc", "conditional", "interventional"}
    for entry in results["methods"].values():
        assert {"return", "score", "score_last", "ci95"} <= set(entry)
    assert results["methods"]["interventional"]["score_last"] == pytest.approx((54.1 - 20) / 40, abs=0.05)
    assert results["methods"]["conditional"]["score_last"] == pytest.approx((32.3 - 20) / 40, abs=0.05)
    header, *lines = (out / "rows.csv").read_text().splitlines()
    assert header == "method,seed,trial,best_arm,episode,return,score,objective"
    assert len(lines) == results["eval_trials"] * 5

    again = command(*args, str(out))
    assert again.returncode == 2
    assert "--resume" in again.stderr
    other = command(*args[:-2], "default", "--out", str(out), "--resume")
    assert other.returncode == 2
    assert "another preset" in other.stderr

    (out / "jobs" / "blind_bc-0.npz").unlink()
    (out / "jobs" / "random-0.npz").write_bytes(b"half a file")
    resumed = command(*args, str(out), "--resume", "--methods", "blind_bc", "conditional", "interventional")
    assert resumed.returncode == 0, resumed.stderr
    repeated = json.loads((out / "results.json").read_text())
    for entry in (*repeated["methods"].values(), *results["methods"].values()):
        assert entry.pop("cpu_s") >= 0
    assert repeated["methods"] == results["methods"]
    assert repeated["resumed"] == 3

    (out / "settings.json").unlink()
    assert "not their settings.json" in command(*args, str(out), "--resume").stderr


def test_time_worked_counts_overlaps_once() -> None:
    assert records.covered([(5, 6), (0, 2), (1, 3)]) == 4


@pytest.mark.parametrize("backend", ["off", "nonsense"])
def test_no_gl_is_only_a_note(backend: str) -> None:
    """Without a GL, pictures raise InputError, which run.py turns into a note."""
    made = "envs.make('slippery_cartpole', render_mode='rgb_array')"
    code = f"from deconfounded import envs; e = {made}; e.reset(seed=0); e.render()"
    done = command("-c", code, MUJOCO_GL=backend)
    assert "InputError: no GL for pictures" in done.stderr


class TestScore:
    def test_by_hand(self) -> None:
        """Random 10, expert 30: a return of 25 scores .75, and the interval of two seeds .7 and .8 holds both."""
        by_method = {}
        for name, by_seed in {"random": (10.0, 10.0), "expert": (30.0, 30.0), "other": (24.0, 26.0)}.items():
            by_method[name] = [
                {
                    **{"seed": seed, "returns": [value] * 2, "objective": [-value] * 2, "theta_r2": [1.0] * 2},
                    **{"budget": {}, "cpu_s": 1.5, "tier": "1"},
                }
                for seed, value in enumerate(by_seed)
            ]
        methods = score.summarise(by_method, 2)
        assert methods["other"]["objective"] == [-25, -25]
        assert methods["other"]["score"] == [0.75, 0.75]
        assert methods["other"]["return"] == [[24.0, 24.0], [26.0, 26.0]]
        assert methods["other"]["ci95"] == pytest.approx([0.7, 0.8])
        assert methods["expert"]["score_last"] == 1

    def test_bootstrap_covers(self) -> None:
        """The 95% interval of 30 normal values holds the mean about as often as it says: 200 tries, 85% at least."""
        rng = np.random.default_rng(0)
        held = [low <= 0 <= high for low, high in (score.bootstrap(rng.standard_normal(30)) for _ in range(200))]
        assert 0.85 < np.mean(held) < 0.99
        assert score.bootstrap(np.array([1.0])) is None


class NoStakes(Cartpole):
    """Hold a point against Coulomb friction of the rail: feedback alone is enough, so nothing is confounded."""

    name = "no_stakes"
    latents = (envs.Latent("friction", "N", 0.0, 3.0),)

    def spec(self):
        spec = envs.get("slippery_cartpole").spec()
        for tendon in spec.tendons:
            spec.delete(tendon)
        tendon = spec.add_tendon(name="rail")
        tendon.wrap_joint("slider", 1.0)
        spec.actuator("spin").ctrlrange = [0, 0]
        return spec

    process_noise = envs.get("slippery_cartpole").process_noise
    observation = envs.get("tilted_cartpole").observation

    def control(self, action: Array) -> Array:
        return np.concatenate([action, np.zeros_like(action)], -1)

    def apply_latent(self, edit, theta: Array) -> None:
        edit.tendon_friction("rail", float(theta[0]))


class Feedback(Expert):
    """A linear controller that adds what friction it is told of, in the direction of motion."""

    def mean(self, obs: Array, theta: Array) -> Array:
        x, _, sin, velocity, pole_velocity = obs.T
        force = 1.0 * x + 12 * sin + 1.5 * velocity + 3.0 * pole_velocity
        return np.clip(force[:, None] / 3 + 0.1 * theta * np.tanh(20 * velocity)[:, None], -1, 1)

    def act(self, obs: Array, theta: Array, rng: np.random.Generator) -> Array:
        mean = self.mean(obs, theta)
        return np.clip(mean + 0.02 * rng.standard_normal(mean.shape), -1, 1)

    def log_prob(self, obs: Array, action: Array, theta: Array) -> Array:
        return -0.5 * (((action - self.mean(obs, theta)) / 0.02) ** 2).sum(-1)


def test_certificate_fails_what_deserves_it() -> None:
    """A cartpole without stakes: an expert told the wrong friction does as well, and so does cloning without memory."""
    result = certify.certify(NoStakes(), Feedback(), trials=12, grid=7)
    assert result["return_expert"] > 4 * result["return_random"]
    assert result["verdict"] == "failed"
    assert not result["checks"]["told_wrong_theta"]["passed"]
    assert not result["checks"]["blind_bc"]["passed"]


def test_publish_keeps_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Records, picture and certificate go to docs; a clip of an older run does not stay beside them.

    What is amiss is told in a line, and nothing is changed.
    """
    run, docs = tmp_path / "results" / "bandit-default", tmp_path / "docs"
    for folder in (run, docs / "certificates", run.parent / "certificates"):
        folder.mkdir(parents=True)
    shown = records.of_task(ROOT / "docs" / "records", "bandit", 0)
    for record in shown:
        records.write(run / "records", record)
    (run / "adaptation.png").write_bytes(b"a picture")
    (run.parent / "certificates" / "bandit.json").write_text("{}")
    (docs / "bandit.webp").write_bytes(b"an old clip")
    (run / "video.mp4").write_bytes(b"junk")
    monkeypatch.setattr(publish, "DOCS", docs)

    def kept() -> list[str]:
        return sorted(str(file.relative_to(docs)) for file in docs.rglob("*") if file.is_file())

    for says, record in (("is no video", shown[0]), ("is not json", {**shown[0], "returns": [float("nan")]})):
        file = run / "records" / records.place(shown[0])
        file.write_text(json.dumps(record))
        with pytest.raises(envs.InputError, match=says):
            publish.keep(run)
        assert kept() == ["bandit.webp"]
    file.write_text(json.dumps(shown[0]))
    (run / "video.mp4").unlink()
    publish.keep(run)
    assert kept() == sorted(
        [*(f"records/{records.place(one)}" for one in shown), "bandit.png", "certificates/bandit.json"]
    )
    with pytest.raises(envs.InputError, match="holds no records"):
        publish.keep(tmp_path)


@pytest.mark.parametrize("file", sorted((ROOT / "docs" / "records").rglob("*.json")), ids=lambda file: file.stem)
def test_records_hold_the_schema(file: Path) -> None:
    """And lie where they belong."""
    assert file == ROOT / "docs" / "records" / records.place(records.read(file))


def test_pages_are_up_to_date() -> None:
    """What pages.py writes of tasks, certificates and results; README has a row for each of the latter two."""
    readme, docs = (ROOT / "README.md").read_text(), ROOT / "docs"
    for text, now in (
        ((docs / "tasks.md").read_text(), pages.tasks_page()),
        ((docs / "results.md").read_text(), pages.results_page()),
        ((docs / "index.html").read_text(), pages.index_page()),
        ((docs / "speed.md").read_text(), pages.speed()),
        (readme, pages.readme()),
    ):
        assert text == now, "run `python benchmarks/pages.py`"
    rows = re.findall(r"^\| (\w+) \|", readme, re.M)
    tasks = {file.parents[1].name.rpartition("-v")[0] for file in (docs / "records").rglob("*.json")}
    kept = [*tasks, *(file.stem for file in (docs / "certificates").glob("*.json"))]
    assert sorted(name for name in rows if name != "task") == sorted(kept)


@pytest.mark.parametrize("marked", ["envs.make_vec", "def simulate"])
def test_readme_snippets_run(marked: str) -> None:
    """What README shows is what runs; its own task, expert, method and loop are in test_outside.py."""
    snippets = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    assert len(snippets) == 7
    code = "\n".join(code for code in snippets if marked in code or (marked == "def simulate" and "Monitor" in code))
    done = command("-c", code)
    assert done.returncode == 0, done.stderr
