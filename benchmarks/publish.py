"""Keep a finished run in docs/: `python benchmarks/publish.py results/slippery_cartpole-default`

Copies results.json, the adaptation picture and, from `certificates` beside the run's folder, the task's certificate;
makes a small GIF of the video; and brings the pages up to date that show them (`pages.py`).
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
from PIL import Image

from deconfounded import envs
from deconfounded.benchmarks.console import Parser, run_command
from deconfounded.benchmarks.output import pages
from deconfounded.benchmarks.output.pages import DOCS


def gif(video: Path, file: Path) -> None:
    """Every third frame at half of the size."""
    frames = imageio.imread(video)[::3]
    size = (frames.shape[2] // 2, frames.shape[1] // 2)
    small = np.array([Image.fromarray(frame).resize(size) for frame in frames])
    imageio.imwrite(file, small, duration=120, loop=0)


def keep(run: Path) -> None:
    """Copy what is worth keeping of a finished run. Raises InputError if there is none."""
    wanted = [run / name for name in ("results.json", "adaptation.png")]
    if not all(file.is_file() for file in wanted):
        raise envs.InputError(f"{run} holds no results.json and adaptation.png of a finished run of run.py")
    try:
        results = json.loads(wanted[0].read_text())
        pages.section(envs.get(results["task"]), results)
    except envs.InputError:  # another task's
        raise
    except (ValueError, KeyError):
        raise envs.InputError(f"{wanted[0]} is damaged; run the benchmark again") from None
    if results["preset"] == "smoke":
        raise envs.InputError(f"{run} is a smoke run, whose figures mean nothing; give one of another preset")
    name, certificates = results["task"], run.parent / "certificates"
    for file, suffix in zip(wanted, ("json", "png"), strict=True):
        shutil.copy(file, DOCS / f"{name}.{suffix}")
    (DOCS / f"{name}.gif").unlink(missing_ok=True)
    if (run / "video.mp4").exists():
        gif(run / "video.mp4", DOCS / f"{name}.gif")
    for file in certificates.glob(f"{name}.*"):
        shutil.copy(file, DOCS / "certificates")


def main() -> None:
    """The command line."""
    parser = Parser(__doc__)
    parser.add_argument("run", type=Path, help="output folder of a finished run")
    keep(parser.parse_args().run)
    pages.write()
    print(pages.summary())


if __name__ == "__main__":
    run_command(main)
