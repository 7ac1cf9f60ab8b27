"""The pages of docs/ and the tables of README, brought up to date from what docs/ keeps.

docs/tasks.md (the card of every task, read off its class and its certificate), docs/results.md and docs/index.html (of
the records), and what stands between marks in README and in the other pages.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from deconfounded import envs
from deconfounded.benchmarks.engine import sources
from deconfounded.benchmarks.output import index
from deconfounded.benchmarks.output.pictures import mark, mark_of
from deconfounded.benchmarks.studies import cards, findings, gap, results, spectra, validation
from deconfounded.benchmarks.studies.cards import DOCS, TIERS
from deconfounded.envs.support.files import write_atomically

README = DOCS.parent / "README.md"


def _filled(file: Path, tables: dict[str, str]) -> str:
    """The page with each table between `<!-- its name -->` and `<!-- /its name -->`."""
    text = file.read_text("utf-8")
    for name, table in tables.items():
        marks = [f"<!-- {slash}{name} -->" for slash in ("", "/")]
        if [text.count(mark) for mark in marks] != [1, 1]:
            raise envs.InputError(f"{file.name} lacks its marks {' and '.join(marks)}, each once; put them back")
        before, rest = text.split(marks[0])
        text = "\n".join([before + marks[0], table, marks[1] + rest.split(marks[1])[1]])
    return text


def texts(found: index.Found) -> dict[Path, str]:
    """By its file, what each page is to say. found: what `results.published` gives."""
    certified = cards.certified()
    tiers = {"none" if tier is None else str(tier): text.partition(": ")[2] for tier, text in TIERS.items()}
    tables = {
        DOCS / "diagnose.md": {"validation": findings.validated()},
        DOCS / "opponents.md": {"fared": results.fared(found, certified), "tuning": findings.tuning()},
        DOCS / "spectrum.md": {"noises": findings.noises()},
        DOCS / "speed.md": {"costs": results.costs(found), "rates": findings.rates()},
        DOCS / "paper.md": {"controls": results.controls(found)},
        README: {"summary": results.summary(found), "certificates": cards.certificates(certified)},
    }
    return {
        DOCS / "index.html": index.page(DOCS, found, certified, results.command, tiers),
        DOCS / "tasks.md": cards.tasks_page(),
        DOCS / "results.md": results.results_page(found, certified),
        **{file: _filled(file, of) for file, of in tables.items()},
    }


def write() -> str:
    """Bring all of them up to date, and their pictures; what has not changed is not written.

    Returns README's table of results.
    """
    found = results.published()
    for file, text in texts(found).items():
        if file.read_text(encoding="utf-8") != text:
            write_atomically(file, text)
    redraw(DOCS / "gap.png", gap.picture, [(one.task.name, *one[1:]) for one in results.gaps(found)])
    redraw(DOCS / "diagnose" / "validation.png", validation.picture, findings.diagnosed())
    redraw(DOCS / "spectrum.png", spectra.picture, findings.spectrum()["points"])
    return results.summary(found)


def redraw(file: Path, draw: Callable[..., None], data: Any) -> None:
    """Draw a picture of data (json) again, if these or the module that draws it have changed since it was drawn."""
    made_of = mark(data, sources.of_code(draw))
    if mark_of(file) != made_of:
        draw(data, file, mark=made_of)
