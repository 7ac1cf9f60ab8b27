"""Deconfounded imitation learning: `envs`, `experts`, `deconf` and `benchmarks` under one name.

Each of the four is a folder at the top of the repository; the links here are for type checkers and editors, and an
install goes without. Importing this package imports none of them, so that those who want only the environments need no
more than these.
"""

from pathlib import Path
from typing import TYPE_CHECKING

__version__ = "0.1.0"

if TYPE_CHECKING:
    from deconfounded.experts.agent import Agent


def load(folder: Path | str) -> "Agent":
    """The agent that `agent.save(folder)` or a run left in a folder; see `experts.saved_agents`."""
    from deconfounded.experts import saved_agents

    return saved_agents.load(folder)
