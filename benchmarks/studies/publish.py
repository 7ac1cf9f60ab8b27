"""Keep a finished run in docs/, and write the pages anew: `deconf publish results/slippery_cartpole-default`

Copies the run's records and, from `certificates` beside the run's folder, the task's certificate; makes a small
animated picture of the video; and brings the pages and their pictures up to date from what docs/ keeps. All of it is
looked at before anything is changed. Without a run it writes the pages alone; with --still also docs/index.png,
the picture of docs/index.html on docs/results.md, which takes Chromium.
"""

import hashlib
import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import imageio.v3 as imageio
import numpy as np
from PIL import Image

from deconfounded import envs
from deconfounded.benchmarks.console import Parser
from deconfounded.benchmarks.engine import sources
from deconfounded.benchmarks.engine.catalogue import DEFAULT, METHODS
from deconfounded.benchmarks.output import aggregation, index, records
from deconfounded.benchmarks.output.pictures import mark, mark_of, still
from deconfounded.benchmarks.studies import (
    cards,
    exploration,
    findings,
    gap,
    hard,
    headroom,
    protocol_scores,
    results,
    spectrum,
    validate,
)
from deconfounded.benchmarks.studies.cards import DOCS, TIERS
from deconfounded.envs.support.files import write_atomically

if TYPE_CHECKING:
    from playwright.sync_api import Page

README = DOCS.parent / "README.md"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
LOOK: dict[str, Any] = {"duration": 150, "loop": 0, "quality": 30, "method": 4}  # of clips


def clip(video: Path, file: Path, mark: str) -> None:
    """Every third frame, as an animated .webp: all clips together are to stay small."""
    first, *others = (Image.fromarray(frame) for frame in imageio.imread(video)[::3])
    first.save(file, save_all=True, append_images=others, xmp=mark.encode(), **LOOK)


def copy(source: Path, file: Path) -> None:
    """Copy a picture, unless the one that is there was made of the same."""
    if not mark_of(source) or mark_of(source) != mark_of(file):
        write_atomically(file, source.read_bytes())


def check_certificate(file: Path, task: envs.Task) -> None:
    """Raises InputError for a file that is no certificate of the task, as pages show it."""
    try:
        made = json.loads(file.read_bytes())
        numbers = [check["measured"] for check in made["checks"].values()] + made["conditional"]["score"]
        numbers += [made["evidence_nats_per_step"][kind] for kind in ("dynamics", "actions")]
        whole = np.isfinite(np.array(numbers, float)).all() and made["verdict"] in ("passed", "failed")
        right = whole and (made["task"], made["task_version"]) == (task.name, task.version)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        right = False
    if not right:
        raise envs.InputError(f"{file} is no certificate of {task.name} v{task.version}; run `deconf certify` again")


def keep(run: Path) -> None:
    """Copy what is worth keeping of a finished run. Raises InputError, and changes nothing, if something is amiss."""
    files = sorted((run / "records").glob("*.jsonl"))
    if links := [file for file in (*files, run / "video.mp4") if file.is_symlink()]:
        raise envs.InputError(f"{links[0]} is a link; give a run's folder as run.py left it")
    if len(files) != 1:
        raise envs.InputError(f"{run} holds no records of a finished run of run.py")
    made = records.read(files[0])
    results = aggregation.gather(made, list(METHODS))
    if results["preset"] != "default" or {"set", "salt", records.NAME} & set(results):
        wrong = f"of preset {results['preset']}, or changed, or of another protocol"
        raise envs.InputError(f"{run} is {wrong}; pages show the default preset and the standard protocol alone")
    if results["task"] not in envs.SUITE:
        raise envs.InputError(f"{run} is of {results['task']}; docs/ shows tasks of the suite, {', '.join(envs.SUITE)}")
    task = envs.get(results["task"])
    if results["task_version"] != task.version:
        raise envs.InputError(f"{run} is of {task.name} v{results['task_version']}, which v{task.version} supersedes")
    newest = {records.named(record): record for record in records.of_task(DOCS / "records", task.name)}
    by_name = [(records.named(record), record) for record in made]
    if older := [name for name, record in by_name if records.outdone(record, newest.get(name))]:
        raise envs.InputError(f"{run} has {', '.join(dict.fromkeys(older))} of older versions than docs/; run it again")
    certificates = [file for file in (run.parent / "certificates").glob(f"{task.name}.*") if not file.is_symlink()]
    for file in certificates:
        if file.suffix == ".json":
            check_certificate(file, task)
    with tempfile.TemporaryDirectory() as scratch:
        small = Path(scratch) / "clip.webp"
        if (run / "video.mp4").exists():
            try:
                looks = mark(hashlib.sha256((run / "video.mp4").read_bytes()).hexdigest(), LOOK)
                kept = DOCS / f"{task.name}.webp"
                shutil.copy(kept, small) if mark_of(kept) == looks else clip(run / "video.mp4", small, looks)
            except Exception as error:
                raise envs.InputError(f"{run / 'video.mp4'} is no video ({type(error).__name__})") from None
        records.write(DOCS / "records", made)
        aggregation.forget()
        if small.exists():
            copy(small, DOCS / f"{task.name}.webp")
        else:
            (DOCS / f"{task.name}.webp").unlink(missing_ok=True)
    for file in certificates:
        write_atomically(DOCS / "certificates" / file.name, file.read_bytes())


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


def texts(found: index.Found, hard_tasks: index.Found, by_protocol: Mapping[str, index.Found]) -> dict[Path, str]:
    """By its file, what each page is to say.

    found, hard_tasks: what `results.published` gives of the suite and of the hard tasks; by_protocol: what
    `results.other_protocols` gives.
    """
    certified = cards.certified()
    tiers = {"none" if tier is None else str(tier): text.partition(": ")[2] for tier, text in TIERS.items()}
    tables = {
        DOCS / "diagnose.md": {"right": findings.right()},
        DOCS / "diagnose_accuracy.md": {"validation": findings.validated(), "foreign": findings.foreign()},
        DOCS / "baselines.md": {"fared": results.fared(found, certified), "tuning": findings.tuning()},
        DOCS / "spectrum.md": {"noises": findings.noises()},
        DOCS / "exploration.md": {"exploration": findings.explored()},
        DOCS / "speed.md": {"costs": results.costs(found), "rates": findings.rates()},
        DOCS / "paper.md": {"controls": results.controls(found)},
        DOCS / "concepts.md": {"certificates": cards.certificates(certified), "beliefs": findings.beliefs()},
        README: {"summary": results.summary(found, certified)},
    }
    return {
        DOCS / "index.html": index.page(DOCS, found, certified, results.command, tiers),
        DOCS / "tasks.md": cards.tasks_page(),
        DOCS / "results.md": results.results_page(found, certified),
        DOCS / "hard.md": hard.page(hard_tasks, cards.certified(envs.HARD)),
        DOCS / "headroom.md": headroom.page(found, certified, by_protocol),
        DOCS / "protocols.md": protocol_scores.page([*found, *hard_tasks], by_protocol),
        **{file: _filled(file, of) for file, of in tables.items()},
    }


def write() -> str:
    """Bring all of them up to date, and their pictures; what has not changed is not written.

    Returns README's table of results.
    """
    from deconfounded.benchmarks.output.run_report import adaptation  # torch takes seconds

    found, hard_tasks, by_protocol = results.published(), results.published(names=envs.HARD), results.other_protocols()
    small = index.stills(DOCS)
    for name, file in small.items():
        still(DOCS / name, file)
    for file in {*(DOCS / "stills").rglob("*.webp")} - {*small.values()}:
        file.unlink()
    for file, text in texts(found, hard_tasks, by_protocol).items():
        if not file.exists() or file.read_text(encoding="utf-8") != text:
            write_atomically(file, text)
    for task, of_task in found:
        redraw(DOCS / f"{task.name}.png", adaptation, curves(of_task))
    redraw(DOCS / "gap.png", gap.picture, [(one.task.name, *one[1:]) for one in results.gaps(found)])
    redraw(DOCS / "headroom.png", headroom.picture, headroom.points(found, cards.certified()))
    under = protocol_scores.points([*found, *hard_tasks], by_protocol)
    if under:
        redraw(DOCS / "protocols.png", protocol_scores.picture, under)
    redraw(DOCS / "diagnose" / "validation.png", validate.picture, cards.kept(validate.KEPT))
    redraw(DOCS / "spectrum.png", spectrum.picture, cards.kept("spectrum")["points"])
    redraw(DOCS / "exploration.png", exploration.picture, cards.kept("exploration"))
    return results.summary(found, cards.certified())


def curves(results: dict[str, Any]) -> dict[str, Any]:
    """What the picture of a task has: scores of a default run's methods, each deployed in every way."""
    keys = ("method", "deployment", "score", "score_beyond", "band")
    default = {name: entry for name, entry in results["methods"].items() if entry["method"] in DEFAULT}
    methods = {name: {key: entry[key] for key in keys if key in entry} for name, entry in default.items()}
    return {"task": results["task"], "methods": methods}


def redraw(file: Path, draw: Callable[..., None], data: Any) -> None:
    """Draw a picture of data (json) again, if these or the module that draws it have changed since it was drawn."""
    made_of = mark(data, sources.of_code(draw))
    if mark_of(file) != made_of:
        draw(data, file, mark=made_of)


def chromium() -> str | None:
    """Where Chromium is, if there is one."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


@contextmanager
def browser(width: int, height: int, dark: bool = False) -> "Iterator[Page]":
    """An empty page of that size, px. Raises InputError without a browser, without Playwright, or for what it says."""
    path = chromium()
    if path is None:
        raise envs.InputError(f"no browser was found; install one of {', '.join(BROWSERS)}")
    try:
        from playwright.sync_api import Error, sync_playwright
    except ModuleNotFoundError:
        raise envs.InputError("playwright is not installed; `pip install -e .[dev]` brings it") from None
    look = {"viewport": {"width": width, "height": height}, "color_scheme": "dark" if dark else "light"}
    try:
        with sync_playwright() as playwright, playwright.chromium.launch(executable_path=path) as browser:
            yield browser.new_page(**look, is_mobile=width < 600)
    except Error as error:
        raise envs.InputError(f"the browser says: {error.message.splitlines()[0]}") from None


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("run", type=Path, nargs="?", help="output folder of a finished run")
    parser.add_argument("--still", action="store_true", help="docs/index.png too, by Chromium")
    args = parser.parse_args()
    if args.run is not None:
        keep(args.run)
    print(write())
    if args.still:
        with browser(1280, 960) as page:
            page.goto((DOCS / "index.html").as_uri())
            write_atomically(DOCS / "index.png", page.screenshot())
