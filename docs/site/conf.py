"""Sphinx's settings. The pages are staged by benchmarks/studies/site.py; `make docs` builds them."""

import re

from docutils import nodes
from docutils.utils.math import latex2mathml

from deconfounded import __version__

project, author, copyright = "Deconfounded imitation", "The deconfounded-imitation contributors", "Apache-2.0"
version = release = __version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.viewcode", "sphinx_copybutton"]
html_theme, html_title = "furo", "Deconfounded imitation"
html_copy_source = html_show_sourcelink = False
html_theme_options = {"navigation_with_keys": True}
smartquotes = False
html_static_path, html_css_files = ["static"], ["site.css"]
exclude_patterns = ["files"]
myst_enable_extensions = ["dollarmath"]
html_math_renderer = "mathml"
myst_heading_anchors = 4
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_inherit_docstrings = False  # of gymnasium and dm_env, which are written in another markup
viewcode_follow_imported_members = False
nb_execution_in_temp = nb_execution_raise_on_error = nb_execution_show_tb = True
nb_execution_timeout = 600  # seconds a cell
copybutton_selector = "div:not(.output) > div.highlight pre"
copybutton_exclude = ".linenos, .gp, .go"


CODE, ITALIC = r"(`+[^`]+`+)", r"((?<![\w*])\*\w(?:[\w ,-]*\w)?\*(?![\w*]))"


def as_rst(app, what, name, obj, options, lines):
    """Docstrings are plain text with `code`, *italics* and indented blocks, whose columns stay; no other markup."""
    blocks = []
    for block in "\n".join(lines).split("\n\n"):
        if blocks and block.strip() and all(line.startswith("    ") for line in block.split("\n") if line):
            blocks += ["::", block]
            continue
        parts = re.split(f"{CODE}|{ITALIC}", block)
        for i, part in enumerate(parts):  # text, code, italics, text, ...
            kind, part = i % 3, part or ""
            parts[i] = part if kind == 2 or not part else f"``{part.strip('`')}``" if kind else _plain(part)
        blocks.append("".join(parts))
    lines[:] = "\n\n".join(blocks).split("\n")


def _plain(text):
    return re.sub(r"([*|\\_])", r"\\\1", text)


def mark_numbers(app, tree, page):
    """Cells of tables that hold numbers, or an amount and its unit, get a class: they are not wrapped."""
    for cell in tree.findall(nodes.entry):
        if re.fullmatch(r"[-+]?\d[-+\w., ±%()/:]{0,80}", cell.astext()):
            cell["classes"].append("number")


def collapse_contents(app, page, template, context, tree):
    """The navigation shows a page's own branch and the top of all others; whole trees were a third of the build."""
    whole = context["toctree"]
    context["toctree"] = lambda **options: whole(**options | {"collapse": True})


def short_arrays(app, what, name, obj, options, signature, returns):
    """`ndarray[floating]`, not what numpy.typing makes of it."""
    long = r"ndarray\[tuple\[[^\]]*\.\.\.\], [~.\w]*dtype\[[~.]*(?:\w+\.)*(\w+)(?:\[[^\]]*\])?\]\]"
    return tuple(text and re.sub(long, r"ndarray[\1]", text) for text in (signature, returns))


def mathml(block):
    """A renderer of formulas as MathML, which browsers show without a network."""

    def visit(self, node):
        formula = latex2mathml.tex2mathml(node.astext(), as_block=block)
        self.body.append(f'<div class="formula">{formula}</div>' if block else formula)
        raise nodes.SkipNode

    return visit


def setup(app):
    app.add_html_math_renderer("mathml", (mathml(False), None), (mathml(True), None))
    app.connect("doctree-resolved", mark_numbers)
    app.connect("html-page-context", collapse_contents, priority=400)  # before furo's, of 500
    app.connect("autodoc-process-signature", short_arrays)
    app.connect("autodoc-process-docstring", as_rst)
