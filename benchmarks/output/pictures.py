"""Picture files, and the marks in them that say what they are made of."""

from __future__ import annotations

import hashlib
import io
import json
from pathlib import Path
from typing import Any

from deconfounded.envs.support.files import write_atomically


def save_figure(figure: Any, file: Path, dpi: int, mark: str = "") -> None:
    """A matplotlib figure as .png, atomically. mark: of what it is made of, for `mark_of`."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=dpi, metadata={"Comment": mark} if mark else None)
    write_atomically(file, buffer.getvalue())


def mark(*made_of: Any) -> str:
    """A picture's mark: the SHA-256 of what it is made of, which json can hold."""
    return hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()


def mark_of(picture: Path) -> str:
    """The mark that a .png or .webp was saved with; empty if it has none, or is no picture."""
    from PIL import Image

    try:
        with Image.open(picture) as image:
            value = image.info.get("Comment") or image.info.get("xmp", b"").decode()
    except (OSError, ValueError):
        return ""
    return str(value)
