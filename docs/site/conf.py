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


def as_rst(app, what, name, obj, options, lines):
    """Docstrings are plain text with `code`: code becomes literal, and nothing else is markup."""
    text = "\n".join(lines)
    parts = re.split(r"(`+[^`]+`+)", text)
    for i, part in enumerate(parts):
        parts[i] = f"``{part.strip('`')}``" if i % 2 else re.sub(r"([*|\\_])", r"\\\1", part)
    lines[:] = "".join(parts).split("\n")


def short_arrays(app, what, name, obj, options, signature, returns):
    """`ndarray[floating]`, not what numpy.typing makes of it."""
    long = r"ndarray\[tuple\[[^\]]*\.\.\.\], [~.\w]*dtype\[[~.]*(?:\w+\.)*(\w+)(?:\[[^\]]*\])?\]\]"
    return tuple(text and re.sub(long, r"ndarray[\1]", text) for text in (signature, returns))


def mathml(block):
    """A renderer of formulas as MathML, which browsers show without a network."""

    def visit(self, node):
        self.body.append(latex2mathml.tex2mathml(node.astext(), as_block=block))
        raise nodes.SkipNode

    return visit


def setup(app):
    app.add_html_math_renderer("mathml", (mathml(False), None), (mathml(True), None))
    app.connect("autodoc-process-signature", short_arrays)
    app.connect("autodoc-process-docstring", as_rst)
