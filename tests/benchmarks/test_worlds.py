"""Commands on the black-box tasks of docs/worlds.md, in small."""

import json
import re
from functools import partial
from pathlib import Path

import pytest

from deconfounded import envs
from deconfounded.benchmarks import certify
from deconfounded.deconf.methods import memoryless_bc
from deconfounded.experts import policy
from tests.tools import deconf

WORLDS = Path(__file__).parents[2] / "docs" / "worlds"
PENDULUM, CART = f"{WORLDS}/context_pendulum.py:ContextPendulum", f"{WORLDS}/reversed_cart.py:ReversedCart"
SMALL = ("--preset", "smoke", "--set", "eval_trials=4", "expert_trials=8", "blind_bc.updates=5")


@pytest.mark.slow
@pytest.mark.parametrize("world", [PENDULUM, CART])
def test_run_play_score_data(world: str, tmp_path: Path) -> None:
    done = deconf(tmp_path, "run", "--task", world, "--methods", "blind_bc", *SMALL, "--out", "run")
    assert done.returncode == 0, done.stderr
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    assert set(results["methods"]) == {"blind_bc", "expert", "random"}
    scores = [results["methods"][name]["score"] for name in ("expert", "random")]
    assert [sum(score) / 2 for score in scores] == pytest.approx([1, 0])
    assert "no video: " in done.stdout
    assert (tmp_path / "run" / "report.html").is_file()

    agent = ("--agent", "run/agents/blind_bc-0", "--task", world)
    played = deconf(tmp_path, "play", *agent, "--seed", "1")
    assert re.search(r"returns -?[\d.]+ -?[\d.]+$", played.stdout.strip()), played.stderr
    scored = deconf(tmp_path, "score", *agent, "--trials", "4", "--out", "s.json")
    assert scored.returncode == 0, scored.stderr
    assert len(json.loads((tmp_path / "s.json").read_text())["score"]) == 2
    ranged = deconf(tmp_path, "score", *agent, "--range", "theta=0:1")
    assert ranged.stderr.startswith("error: --range was 'theta=0:1'")
    exact = deconf(tmp_path, "run", "--task", world, "--methods", "conditional", *SMALL, "--out", "exact")
    assert re.match(r"error: --methods had conditional, and \w+ has no likelihood for it", exact.stderr)


@pytest.mark.slow
def test_a_data_set(tmp_path: Path) -> None:
    pytest.importorskip("minari")
    written = deconf(tmp_path, "data", "--task", CART, "--trials", "3", "--out", "data")
    assert written.returncode == 0, written.stderr
    assert "3 trials" in written.stdout


@pytest.mark.slow
def test_a_certificate_says_that_it_is_learned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memoryless_bc, "MemorylessConfig", partial(memoryless_bc.MemorylessConfig, updates=20))
    task = envs.get(CART)
    result = certify.certify(task, policy.load(task), trials=8, grid=5)
    assert set(result["learned_dynamics"]) == {"r2", "exponent"}
    assert result["checks"]["wrong_theta"]["passed"]
    assert len(result["interventional"]["score"]) == len(result["conditional"]["score"]) == 5
