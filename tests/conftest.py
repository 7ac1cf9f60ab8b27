"""Which tests are skipped for what is not installed."""

from __future__ import annotations

from importlib.util import find_spec

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Without dm_control there is no walker."""
    if find_spec("dm_control") is not None:
        return
    for item in items:
        if "slippery_walker" in getattr(getattr(item, "callspec", None), "params", {}).values():
            item.add_marker(pytest.mark.skip(reason="dm_control is not installed"))
