"""A page in a real browser: the Chromium of this machine without a window, driven by Playwright."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from deconfounded.envs.support.errors import InputError

if TYPE_CHECKING:
    from playwright.sync_api import Page

NAMES = ("chromium", "chromium-browser", "google-chrome")


def program() -> str | None:
    """Where Chromium is, if there is one."""
    return next(filter(None, map(shutil.which, NAMES)), None)


@contextmanager
def page(width: int, height: int, dark: bool = False) -> Iterator[Page]:
    """An empty page of that size, px. Raises InputError without a browser, without Playwright, or for what it says."""
    path = program()
    if path is None:
        raise InputError(f"no browser was found; install one of {', '.join(NAMES)}")
    try:
        from playwright.sync_api import Error, sync_playwright
    except ModuleNotFoundError:
        raise InputError("playwright is not installed; `pip install -e .[dev]` brings it") from None
    look = {"viewport": {"width": width, "height": height}, "color_scheme": "dark" if dark else "light"}
    try:
        with sync_playwright() as playwright, playwright.chromium.launch(executable_path=path) as browser:
            yield browser.new_page(**look, is_mobile=width < 600)
    except Error as error:
        raise InputError(f"the browser says: {error.message.splitlines()[0]}") from None
