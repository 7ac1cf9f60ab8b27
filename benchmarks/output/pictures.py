"""Pictures: panels to draw in, the colour of each method, and marks in files that say what they are made of."""

import base64
import colorsys
import hashlib
import io
import itertools
import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from deconfounded.envs.streams import Array
from deconfounded.envs.support.files import write_atomically

COLOURS = {
    "expert": "#222222",
    "interventional": "#2ca02c",
    "conditional": "#d62728",
    "deconfounded": "#1f77b4",
    "deconfounded_gru": "#17becf",
    "deconfounded_forgetting": "#1b9e77",
    "deconfounded_discrete": "#9467bd",
    "deconfounded_large": "#0b3d91",
    "deconfounded_offline": "#a8a91e",
    "dagger": "#e377c2",
    "naive_rnn": "#ff7f0e",
    "oracle_bc": "#7f7f7f",
    "blind_bc": "#8c564b",
    "random": "#b8b8b8",
    "deconfounded_mean": "#5254a3",
    "gail": "#637939",
    "rma": "#7b4173",
    "palr": "#31a354",
    "dml_il": "#00868b",
    "dadp": "#c51b8a",
    "naive_obs": "#e6ab02",
    "naive_dropout": "#ad494a",
    "naive_transformer": "#e6550d",
    "dpt": "#7a0177",
    "flow_bc": "#d95f0e",
}
OTHERS = ("#d6006e", "#00857c", "#8c6d31", "#3b3bd1", "#b35900", "#66a61e", "#a020f0", "#843c39", "#0a6ebd", "#555500")

STILL = {"width": 640, "quality": 60, "colours": 64}  # of films, of films, of charts


def colour(method: str) -> str:
    """A method's own, or the first of OTHERS: for pictures of several from outside see `colours`."""
    return colours([method])[method]


def colours(methods: Iterable[str]) -> dict[str, str]:
    """A colour for each method of a picture, none twice: its own, else one of OTHERS, then of hues far apart."""
    left = itertools.chain(OTHERS, (_hue(0.618034 * i % 1) for i in itertools.count()))
    return {name: COLOURS.get(name) or next(left) for name in dict.fromkeys(methods)}


def _hue(share: float) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in colorsys.hsv_to_rgb(share, 0.6, 0.65))


@contextmanager
def panels(
    file: Path | io.BytesIO,
    rows: int = 1,
    columns: int = 1,
    *,
    size: tuple[float, float],
    dpi: int = 110,
    mark: str = "",
    pdf: bool = False,
    **shared: Any,
) -> Iterator[Any]:
    """Panels [rows, columns] to draw in, saved as .png at the end; pdf: and as .pdf. mark: what for, see `mark_of`."""
    from matplotlib.figure import Figure  # not pyplot, which has a backend, and a notebook's would be switched

    figure = Figure(figsize=size, layout="constrained")
    yield figure.subplots(rows, columns, squeeze=False, **shared)
    save_figure(figure, file, dpi, mark)
    if pdf and isinstance(file, Path):
        buffer = io.BytesIO()
        figure.savefig(buffer, format="pdf")
        write_atomically(file.with_suffix(".pdf"), buffer.getvalue())


PLACES = (*((across, up) for up in (1, -1, 3, -3, 5, -5) for across in (1, -1)), (1, 1))
"""Of a name beside its point: across and up, in 4 points of type."""


def label(axes: Any, names: Sequence[str], points: Array) -> None:
    """Write names beside points [N, 2], each at the first place around its point where it hides no other name or point.

    If there is none, it stands above to the right. The limits of the axes must be set.
    """
    from matplotlib.transforms import Bbox

    axes.figure.draw_without_rendering()  # it lays out the axes, by which distances on the page are known
    taken = [Bbox.from_bounds(x - 3, y - 3, 6, 6) for x, y in axes.transData.transform(points)]
    for name, point in zip(names, points, strict=True):
        text = axes.annotate(name, point, xytext=(0, 0), textcoords="offset points", fontsize=8)
        for across, up in PLACES:
            text.set(ha="left" if across > 0 else "right", va="bottom" if up > 0 else "top")
            text.set_position((4 * across, 4 * up))
            box = text.get_window_extent()
            within = (axes.bbox.min <= box.min).all() and (box.max <= axes.bbox.max).all()
            if within and not box.count_overlaps(taken):
                break
        taken.append(box)


def save_figure(figure: Any, file: Path | io.BytesIO, dpi: int, mark: str = "") -> None:
    """A matplotlib figure as .png; a file is written atomically."""
    buffer = io.BytesIO() if isinstance(file, Path) else file
    figure.savefig(buffer, dpi=dpi, metadata={"Comment": mark} if mark else None)
    if isinstance(file, Path):
        write_atomically(file, buffer.getvalue())


def encoded(file: Path | io.BytesIO) -> str:
    """In base64, for a page that needs no other file."""
    return base64.b64encode(file.read_bytes() if isinstance(file, Path) else file.getvalue()).decode()


def still(picture: Path, file: Path) -> None:
    """Make a small .webp of a picture, for pages that hold it: a film's middle frame, or a chart in few colours.

    Nothing is done if the file was made of this picture before.
    """
    from PIL import Image

    made_of = mark(hashlib.sha256(picture.read_bytes()).hexdigest(), STILL)
    if mark_of(file) == made_of:
        return
    with Image.open(picture) as image:
        frames, buffer = getattr(image, "n_frames", 1), io.BytesIO()
        image.seek(frames // 2)
        whole = image.convert("RGB")
        if frames > 1:
            whole.thumbnail((STILL["width"], whole.height))
        else:
            whole = whole.quantize(STILL["colours"]).convert("RGB")
        look = {"quality": STILL["quality"]} if frames > 1 else {"lossless": True}
        whole.save(buffer, "webp", xmp=made_of.encode(), method=6, **look)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(file, buffer.getvalue())


def mark(*made_of: Any) -> str:
    """A picture's mark: the SHA-256 of what it is made of, which json can hold."""
    return hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()


def mark_of(picture: Path) -> str:
    """The mark that a .png or .webp was saved with; empty if it has none, or is no picture."""
    from PIL import Image

    try:
        with Image.open(picture) as image:
            return str(image.info.get("Comment") or image.info.get("xmp", b"").decode())
    except (OSError, ValueError):
        return ""
