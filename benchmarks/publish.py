"""Keep a finished run in docs/: `python benchmarks/publish.py results/slippery_cartpole-default`

Copies results.json and the adaptation picture, makes a small GIF of the video, and prints README's table.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
from PIL import Image

import envs
from benchmarks import score
from envs.console import Parser, check_folder, run_command


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Rows of cells under a head."""
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, ("---",) * len(head), *rows))


def markdown(results: dict[str, Any]) -> str:
    """README's table of one task."""
    rows = []
    for row in score.rows(results["methods"]):
        beyond = results["methods"][row[0]].get("score_beyond")
        rows.append((*row, f"{beyond[-1]:.2f}" if beyond else ""))
    return markdown_table((*score.COLUMNS, "after as many again"), rows)


def gif(video: Path, file: Path) -> None:
    """Every third frame at half of the size."""
    frames = imageio.imread(video)[::3]
    size = (frames.shape[2] // 2, frames.shape[1] // 2)
    small = np.array([Image.fromarray(frame).resize(size) for frame in frames])
    imageio.imwrite(file, small, duration=120, loop=0)


def main() -> None:
    """The command line."""
    parser = Parser(__doc__)
    parser.add_argument("run", type=Path, help="output folder of a finished run")
    parser.add_argument("--docs", type=Path, default=Path("docs"))
    args = parser.parse_args()
    wanted = [args.run / name for name in ("results.json", "adaptation.png")]
    if not all(file.is_file() for file in wanted):
        raise envs.InputError(f"{args.run} holds no results.json and adaptation.png of a finished run of run.py")
    try:
        results = json.loads(wanted[0].read_text())
        text = markdown(results)
    except (ValueError, KeyError):
        raise envs.InputError(f"{wanted[0]} is damaged; run the benchmark again") from None
    if results["preset"] == "smoke":
        raise envs.InputError(f"{args.run} is a smoke run, whose figures mean nothing; give one of another preset")
    check_folder(args.docs)
    shutil.copy(args.run / "results.json", args.docs / f"{results['task']}.json")
    shutil.copy(args.run / "adaptation.png", args.docs / f"{results['task']}.png")
    if (args.run / "video.mp4").exists():
        gif(args.run / "video.mp4", args.docs / f"{results['task']}.gif")
    print(text)


if __name__ == "__main__":
    run_command(main)
