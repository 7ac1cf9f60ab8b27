"""The tutorials of docs/tutorials: every cell runs, with small amounts, and they become notebooks."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import pytest

from deconfounded import envs
from deconfounded.benchmarks.output.film import Film
from deconfounded.deconf.methods import memoryless_bc
from deconfounded.envs import render
from deconfounded.experts.agent import Agent
from deconfounded.experts.trials import Trials

TUTORIALS = Path(__file__).parents[2] / "docs" / "tutorials"
CELL = re.compile(r"^```\{code-cell\} ipython3\n(:tags: \[parameters\]\n)?(.*?)^```$", re.S | re.M)
FEW = {  # fewer of what `AMOUNTS` says
    "bandit": {"trials": 16, "clone": 2, "inference": 2, "imitation": 2, "deployed": 16},
    "lander": {
        **{"certify": 4, "grid": 3, "trials": 8, "explored": 4, "clone": 2, "rounds": 2, "inference": 2},
        **{"imitation": 2, "final": 2, "deployed": 4, "pictures": 2},
    },
    "logs": {
        **{"trips": 24, "explored": 24, "fit": 2, "naive": 2, "refits": 1, "rollouts": 4, "candidates": 2},
        **{"clone": 2, "rounds": 2, "inference": 2, "imitation": 2, "final": 2, "deployed": 4},
    },
}


def test_each_is_run() -> None:
    """With few amounts; a page without them would run for minutes."""
    assert {file.stem for file in TUTORIALS.glob("*.md")} == {*FEW}


@pytest.mark.slow
@pytest.mark.parametrize("page", FEW)
def test_every_cell_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In order, in one namespace, as in a notebook; the film of the lander is one."""
    if page == "lander":
        try:
            render.backend()
        except envs.InputError as error:
            pytest.skip(str(error))
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    train = memoryless_bc.train  # of the certificate, which has no amount for it

    def few(trials: Trials, config: memoryless_bc.MemorylessConfig, *rest: Any, **more: Any) -> Agent:
        return train(trials, replace(config, updates=2), *rest, **more)

    monkeypatch.setattr(memoryless_bc, "train", few)
    text = (TUTORIALS / f"{page}.md").read_text("utf-8")
    cells = CELL.findall(text)
    assert len(cells) == text.count("```{code-cell}")
    assert [bool(tagged) for tagged, _ in cells].index(True) == 0
    names: dict[str, Any] = {}
    exec(cells[0][1], names)
    assert names["AMOUNTS"].keys() == FEW[page].keys()
    names["AMOUNTS"].update(FEW[page])
    for _, code in cells[1:]:
        *_, last = code.strip().splitlines()
        if last.startswith("film.film("):
            code = code.replace(last, f"shown = {last}")
        exec(code, names)
    if page == "lander":
        assert isinstance(names["shown"], Film)
        assert 'src="data:image/webp;base64,UklGR' in names["shown"]._repr_html_()  # RIFF


def test_they_become_notebooks() -> None:
    """With the cells of the page."""
    jupytext = pytest.importorskip("jupytext")
    for page in FEW:
        text = (TUTORIALS / f"{page}.md").read_text("utf-8")
        made = jupytext.reads(text, fmt="md:myst")
        code = [cell.source for cell in made.cells if cell.cell_type == "code"]
        assert code == [cell.rstrip("\n") for _, cell in CELL.findall(text)]
