"""What a first look at logs says: a remark, and how many things it names."""

from collections.abc import Sequence
from typing import NamedTuple

LISTED = 8  # columns, trials, that are named


class Remark(NamedTuple):
    """A sentence or two. kind: what it is about; odd: whether it may mislead a diagnosis, and should be mended."""

    kind: str
    text: str
    odd: bool = False

    def __str__(self) -> str:
        return f"{'!' if self.odd else '-'} {self.text}"


def listed(names: Sequence[str]) -> str:
    """The first names, and how many more there are."""
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return ", ".join(names[:LISTED]) + more
