"""The documentation site, docs/_build/html: `make docs`, with Sphinx (extra `docs`).

Its sources are staged in docs/_build/source: the pages of docs/, CONTRIBUTING and CHANGELOG, with their links resolved,
and a page for each task, method and module (site_pages.py). Sphinx then builds with warnings as errors, and every link
of the result is checked. The tutorials are executed, which trains what they train; nothing else is trained.
"""

import os
import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from urllib.parse import unquote, urlsplit

from deconfounded import envs
from deconfounded.benchmarks.console import ROOT, Parser
from deconfounded.benchmarks.studies import results, site_pages
from deconfounded.benchmarks.studies.cards import DOCS
from deconfounded.envs.support.files import write_atomically

BUILD = DOCS / "_build"
HOME, INTERACTIVE = "docs/home.md", "docs/index.html"
CONTENTS: dict[
    str, dict[str, str | None]
] = {  # caption: page: its file, from the root of the repository; None: it is generated
    "First steps": {"start": "docs/start.md", "concepts": "docs/concepts.md"},
    "Tutorials": {f"tutorials/{name}": f"docs/tutorials/{name}.md" for name in ("bandit", "lander", "logs")},
    "Benchmark": {
        **{"tasks/index": None, "methods/index": None, "results": "docs/results.md", "headroom": "docs/headroom.md"},
        **{"hard": "docs/hard.md", "protocols": "docs/protocols.md"},
        **{"baselines": "docs/baselines.md", "paper": "docs/paper.md", "spectrum": "docs/spectrum.md"},
        **{"exploration": "docs/exploration.md", "speed": "docs/speed.md"},
    },
    "How to": {
        **{"environments": "docs/environments.md", "own_task": "docs/own_task.md", "own_method": "docs/own_method.md"},
        **{"worlds": "docs/worlds.md", "core": "docs/core.md", "diagnose": "docs/diagnose.md"},
        **{"diagnose_accuracy": "docs/diagnose_accuracy.md"},
        **{"deploy": "docs/deploy.md", "sharing": "docs/sharing.md"},
        **{"cluster": "docs/cluster.md", "submit": "docs/submit.md"},
    },
    "Reference": {"commands": None, "api/index": None},
    "Project": {
        **{"contributing": "CONTRIBUTING.md", "design": "docs/design.md", "records": "docs/records/README.md"},
        **{"versions": "docs/versions.md", "faults": "docs/faults.md", "tried": "docs/tried.md"},
        **{"changelog": "CHANGELOG.md", "history": "docs/history.md"},
    },
}
PAGES = {file: page for pages in CONTENTS.values() for page, file in pages.items() if file} | {HOME: "index"}
ELSEWHERE = {  # what a link to another file of the repository becomes
    **{"README.md": "index", "docs/tasks.md": "tasks/index", "docs/certificates": "tasks/index"},
    **{"docs/records": "records", "deconf/methods": "methods/index"},
}
NOTEBOOK = "\nThis page as a notebook, with its outputs: {{nb-download}}`{}.ipynb`.\n"  # at the end of a tutorial
FENCE = re.compile(r"^(```+|~~~+).*?^\1\s*?$", re.S | re.M)
LINK = re.compile(r"(!?\[(?:[^\[\]]|\[[^\[\]]*\])*\])\(([^()\s]+)\)")


def _outside_code(text: str, change: Callable[[str], str]) -> str:
    """The text with its parts changed that are not in a fence of code."""
    done, at = [], 0
    for fence in FENCE.finditer(text):
        done += [change(text[at : fence.start()]), fence[0]]
        at = fence.end()
    return "".join([*done, change(text[at:])])


class Site:
    """Stages pages in a folder: `source` for Sphinx, and `extra`, which it copies as it is."""

    def __init__(self, folder: Path) -> None:
        self.source, self.extra = folder / "source", folder / "extra"

    def stage(self, page: str, text: str, file: str) -> None:
        """Write a page. text: Markdown, with links as in the file, from the root of the repository, that it is of."""
        target = self.source / f"{page}.md"
        target.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(target, self.resolved(text, page, file))

    def resolved(self, text: str, page: str, file: str) -> str:
        """The text with its links to files of the repository as links of the site, but for those in code."""

        def link(found: re.Match[str]) -> str:
            words, target = found.groups()
            start = words.index("[") + 1
            words = f"{words[:start]}{LINK.sub(link, words[start:-1])}]"  # a picture may be a link
            if urlsplit(target).scheme or target.startswith(("#", "/")):
                return f"{words}({target})"
            path, _, anchor = target.partition("#")
            return self._link(words, _place(path, file), anchor, page)

        return _outside_code(text, lambda part: LINK.sub(link, part))

    def _link(self, words: str, place: str, anchor: str, page: str) -> str:
        """A link to a file of the repository, and to an anchor in it. Raises InputError if it does not exist."""
        if place == INTERACTIVE:
            above = "../" * page.count("/")
            return f'<a href="{above}interactive/index.html">{words[1:-1].strip("*")}</a>'
        if place == "docs/tasks.md" and anchor:
            return f"{words}(/tasks/{re.sub(r'-v[0-9]+$', '', anchor)}.md)"
        if target := PAGES.get(place) or ELSEWHERE.get(place):
            return f"{words}(/{target}.md{'#' * bool(anchor and place in PAGES)}{anchor * (place in PAGES)})"
        if not (ROOT / place).exists():
            raise envs.InputError(f"a link of {page} leads to {place}, which does not exist")
        if (ROOT / place).is_dir():
            return f"{words[1:-1]} (`{place}`)"
        copy = self.source / "files" / place
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / place, copy)
        return f"{words}(/files/{place})"

    def write(self) -> None:
        """Stage all pages, and the interactive page of results beside them."""
        found = results.published()
        for file, page in PAGES.items():
            text = (ROOT / file).read_text("utf-8") + (_contents() if file == HOME else "")
            if page.startswith("tutorials/"):
                text += NOTEBOOK.format(page.removeprefix("tutorials/"))
            self.stage(page, text, file)
        for page, text in site_pages.pages(found).items():
            self.stage(page, text, "docs/generated.md")
        shutil.copytree(DOCS, self.extra / "interactive", ignore=_not_shown, dirs_exist_ok=True)
        html = re.sub(r'href="([^"#]*)(#[\w-]*)?"', _from_interactive, (ROOT / INTERACTIVE).read_text("utf-8"))
        write_atomically(self.extra / "interactive" / "index.html", html)


def _place(path: str, file: str) -> str:
    """A path from the root of the repository, of one as it is in a file."""
    return os.path.normpath(os.path.join(os.path.dirname(file), path)).replace(os.sep, "/")


def _from_interactive(found: re.Match[str]) -> str:
    """A link of docs/index.html, as from interactive/index.html of the site."""
    place = _place(found[1], INTERACTIVE)
    page = PAGES.get(place) or ELSEWHERE.get(place)
    return f'href="../{page}.html{found[2] or ""}"' if page else found[0]


def _not_shown(folder: str, names: list[str]) -> set[str]:
    """What the interactive page does not refer to: all but clips, certificates and records."""
    if Path(folder) == DOCS:
        kept = {"certificates", "records", *(name for name in names if name.endswith(".webp"))}
        return set(names) - kept
    return {name for name in names if name.endswith(".md")}


def _contents() -> str:
    """The tables of contents, for the home page."""
    parts = []
    for caption, pages in CONTENTS.items():
        parts.append("\n".join(["```{toctree}", ":hidden:", f":caption: {caption}", "", *pages, "```"]))
    return "\n" + "\n\n".join(parts) + "\n"


def dead_links(folder: Path) -> list[str]:
    """Of all pages in a folder, the links to a file or an anchor that it does not hold: `page: link`."""
    from lxml.etree import HTMLParser, parse

    folder, links, anchors = folder.resolve(), {}, {}
    for file in map(str, sorted(folder.rglob("*.html"))):
        page = parse(file, HTMLParser(encoding="utf-8"))
        links[file], anchors[file] = page.xpath("//@href | //@src"), set(page.xpath("//@id"))
    dead = []
    for file, targets in links.items():
        for link in targets:
            scheme, host, path, _, anchor = urlsplit(link)
            if scheme or host:  # elsewhere, or the data itself
                continue
            target = os.path.normpath(os.path.join(os.path.dirname(file), unquote(path))) if path else file
            scripted = "/interactive/" in target and "/_modules/" not in file  # its script makes anchors
            if target in anchors:
                missing = bool(anchor) and unquote(anchor) not in anchors[target] and not scripted
            else:
                missing = not os.path.isfile(target)
            if missing:
                dead.append(f"{os.path.relpath(file, folder)}: {link}")
    return dead


def execute_side_by_side(tutorials: Sequence[Path], folder: Path) -> None:
    """Execute tutorials, a process each, into a cache in the folder, from which Sphinx takes their outputs.

    Raises InputError with the traceback of one that fails.
    """
    from jupyter_cache import get_cache
    from jupyter_cache.executors import load_executor

    cache = get_cache(folder)
    for file in tutorials:
        cache.add_nb_to_project(str(file), read_data={"name": "myst_nb_md", "type": "plugin"})
    load_executor("temp-parallel", cache).run_and_cache(timeout=600)  # seconds a cell
    for notebook in cache.list_project_records():
        if notebook.traceback:
            raise envs.InputError(f"{Path(notebook.uri).name} fails:\n{notebook.traceback}")


def build(folder: Path, execute: bool = True) -> Path:
    """Stage and build the site in a folder; returns that of its html. Raises InputError for warnings and dead links.

    execute: the tutorials, so that pages show their outputs.
    """
    try:
        from sphinx.cmd.build import main as sphinx
    except ModuleNotFoundError:
        raise envs.InputError("Sphinx is not installed; `pip install .[docs]` brings it") from None
    for part in ("source", "extra", "html", "executed"):
        shutil.rmtree(folder / part, ignore_errors=True)
    site, html = Site(folder), folder / "html"
    site.write()
    places = ["-c", str(DOCS / "site"), "-d", str(folder / "doctrees"), str(site.source), str(html)]
    if execute:
        execute_side_by_side(sorted(site.source.glob("tutorials/*.md")), folder / "executed")
    notebooks = ["-D", f"nb_execution_mode={'cache' if execute else 'off'}"]
    notebooks += ["-D", f"nb_execution_cache_path={folder / 'executed'}"]
    options = ["-D", f"html_extra_path={site.extra}", *notebooks]
    if sphinx(["-W", "--keep-going", "-q", "-E", "-j", "auto", *options, *places]):
        raise envs.InputError("Sphinx had warnings, see above")
    if dead := dead_links(html):
        raise envs.InputError(f"{len(dead)} links lead nowhere: {'; '.join(dead[:20])}")
    return html


def main() -> None:
    """The command line."""
    Parser(description=__doc__).parse_args()
    print(build(BUILD) / "index.html")
