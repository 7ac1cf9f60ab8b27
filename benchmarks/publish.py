"""Keep a finished run in docs/: `python benchmarks/publish.py results/slippery_cartpole-default`

Copies results.json and the adaptation picture, makes a small GIF of the video, and prints README's table.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
from PIL import Image

import envs
from envs.console import Parser, check_folder, run_command


def markdown(results: dict[str, Any]) -> str:
    """README's table of one task."""
    lines = ["| method | score of each episode | last | 95% interval | after as many again |", "|---|---|---|---|---|"]
    for name, entry in sorted(results["methods"].items(), key=lambda item: -item[1]["score_last"]):
        scores = " ".join(f"{value + 0.0:.2f}" for value in np.round(entry["score"], 2))
        interval = "-" if entry["ci95"] is None else "{:.2f} to {:.2f}".format(*entry["ci95"])
        beyond = f"{entry['score_beyond'][-1]:.2f}" if "score_beyond" in entry else ""
        lines.append(f"| {name} | {scores} | **{entry['score_last']:.2f}** | {interval} | {beyond} |")
    return "\n".join(lines)


def gif(video: Path, file: Path) -> None:
    """Every third frame at two thirds of the size."""
    frames = imageio.imread(video)[::3]
    size = (frames.shape[2] * 2 // 3, frames.shape[1] * 2 // 3)
    small = np.array([Image.fromarray(frame).resize(size) for frame in frames])
    imageio.imwrite(file, small, duration=120, loop=0)


def main() -> None:
    """The command line."""
    parser = Parser(__doc__)
    parser.add_argument("run", type=Path, help="output folder of a finished run")
    parser.add_argument("--docs", type=Path, default=Path("docs"))
    args = parser.parse_args()
    if not (args.run / "results.json").is_file():
        raise envs.InputError(f"{args.run} holds no results.json; give the output folder of a finished run")
    try:
        results = json.loads((args.run / "results.json").read_text())
    except ValueError:
        raise envs.InputError(f"{args.run / 'results.json'} is damaged; run the benchmark again") from None
    check_folder(args.docs)
    shutil.copy(args.run / "results.json", args.docs / f"{results['task']}.json")
    shutil.copy(args.run / "adaptation.png", args.docs / f"{results['task']}.png")
    if (args.run / "video.mp4").exists():
        gif(args.run / "video.mp4", args.docs / f"{results['task']}.gif")
    print(markdown(results))


if __name__ == "__main__":
    run_command(main)
