"""Templates of pages: the results, a run's report, a diagnosis."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jinja2


def template(name: str, filters: Mapping[str, Callable[..., Any]] | None = None) -> jinja2.Template:
    """The template of that name, beside this file; filters: those of the page."""
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    made = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    made.filters.update(filters or {})
    return made.get_template(name)
