"""The documentation site: every task and method has its page, links lead somewhere, and Sphinx has no warnings."""

import re
from pathlib import Path

import pytest

from deconfounded import envs
from deconfounded.benchmarks.studies import site
from deconfounded.deconf import methods


def test_links(tmp_path: Path) -> None:
    """Links lead to pages of the site, or to copies of files; those in code and to other sites are left alone."""
    made = site.Site(tmp_path)
    for file, link, becomes in (
        ("docs/speed.md", "[a](results.md#bandit)", "[a](/results.md#bandit)"),
        ("docs/speed.md", "[a](tasks.md#bandit)", "[a](/tasks/bandit.md)"),
        ("docs/speed.md", "[a](../CONTRIBUTING.md#tests)", "[a](/contributing.md#tests)"),
        ("docs/speed.md", "[a](../deconf/exact.py)", "[a](/files/deconf/exact.py)"),
        ("README.md", "![a [b] c](docs/gap.png)", "![a [b] c](/files/docs/gap.png)"),
        ("docs/a.md", "[![a](gap.png)](speed.md)", "[![a](/files/docs/gap.png)](/speed.md)"),
        ("docs/paper.md", "[a](paper/preset)", "a (`docs/paper/preset`)"),
        ("README.md", "[a](docs/index.html)", '<a href="interactive/index.html">a</a>'),
        *(("README.md", same, same) for same in ("[a](https://b.c)", "[a](#b)", "```\n[a](b)\n```")),
    ):
        assert made.resolved(link, "speed", file) == becomes
    assert (tmp_path / "source/files/docs/gap.png").is_file()
    with pytest.raises(envs.InputError, match=r"a link of speed leads to docs/absent\.md, which does not exist"):
        made.resolved("[a](absent.md)", "speed", "docs/speed.md")


@pytest.mark.parametrize(
    ("link", "becomes"),
    [
        ("results.md#bandit", "../results.html#bandit"),
        ("hard.md", "../hard.html"),
        ("tasks.md", "../tasks/index.html"),
        ("records/bandit.jsonl", "records/bandit.jsonl"),
        ("#curling", "#curling"),
    ],
)
def test_links_of_the_interactive_page(link: str, becomes: str) -> None:
    """They lead to the site's pages, one folder up, and to their anchors; what lies beside it stays there."""
    match = re.fullmatch(r'href="([^"#]*)(#[\w-]*)?"', f'href="{link}"')
    assert match is not None
    assert site._from_interactive(match) == f'href="{becomes}"'


def test_what_lies_beside_the_interactive_page() -> None:
    """Of docs/ its clips, certificates and records; of these no page."""
    names = ["bandit.webp", "bandit.md", "certificates", "records", "tutorials", "speed.json"]
    assert site._not_shown(str(site.DOCS), names) == {"bandit.md", "tutorials", "speed.json"}
    assert site._not_shown(str(site.DOCS / "records"), ["README.md", "bandit.jsonl"]) == {"README.md"}


def test_dead_links(tmp_path: Path) -> None:
    """Files and anchors that are not there, by page."""
    pytest.importorskip("lxml", reason="the extra docs is not installed")
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b.html").write_text('<p id="x"><a href="../c.html#y"><a href="#x"><a href="https://d.e/f">')
    film = f"data:image/webp;base64,{'A' * 5000}"
    (tmp_path / "c.html").write_text(f'<a href="a/b.html#x"><img src="g.png"><img src="{film}"><a href="a/b.html#z">')
    assert site.dead_links(tmp_path) == ["a/b.html: ../c.html#y", "c.html: g.png", "c.html: a/b.html#z"]


def test_every_page_is_listed() -> None:
    """Each page of docs/ is one of the site, but for tasks.md, of which each task has its own part."""
    listed = {Path(file).name for file in site.PAGES if file.startswith("docs/")}
    written = [*site.DOCS.glob("*.md"), *site.DOCS.glob("tutorials/*.md")]
    assert {file.name for file in written} - listed == {"tasks.md"}


@pytest.mark.slow
def test_build(tmp_path: Path) -> None:
    """Without a warning or a dead link; a page for each task and method, with what such a page must have."""
    pytest.importorskip("myst_nb", reason="the extra docs is not installed")
    html = site.build(tmp_path, execute=False)
    for name in (*envs.SUITE, *envs.HARD):
        page = (html / "tasks" / f"{name}.html").read_text("utf-8")
        parts = ("latent", "observation", "Action", "results", "expert", "versions")
        assert all(part in page for part in parts), name
    for name in methods.METHODS:
        page = (html / "methods" / f"{name}.html").read_text("utf-8")
        assert 'id="results"' in page, name
        assert 'id="source"' in page, name
    assert (html / "interactive" / "index.html").is_file()
