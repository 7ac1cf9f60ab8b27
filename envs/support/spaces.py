"""What is asked of spaces of actions."""

from __future__ import annotations

from typing import Any

from gymnasium import spaces


def action_sizes(space: spaces.Space[Any]) -> tuple[int, int]:
    """A, the width of an action (1 if discrete), and the number of discrete actions (0 if continuous)."""
    return (space.shape or (1,))[0], int(space.n) if isinstance(space, spaces.Discrete) else 0
