"""The film of a run: agents side by side under one theta, and under each what it believes of theta as time goes by."""

import base64
import io
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from deconfounded import envs
from deconfounded.envs.streams import Array
from deconfounded.envs.support.files import write_atomically
from deconfounded.experts.agent import Agent
from deconfounded.experts.rollout import run_trials

WIDTH, HEIGHT, HEAD, STRIP = 320, 240, 30, 80  # of a pane, px; a strip for each latent, under its label
FRAMES = 240  # of a whole film, at most
INK, GREY, TRUTH, BELIEF, RIGHT = (25, 25, 30), (150, 150, 155), (30, 150, 70), (205, 60, 40), (40, 90, 200)
NAMES = {"expert": "expert, sees theta", "naive_rnn": "naive clone", "deconfounded": "deconfounded"}
Clips = dict[str, dict[str, NDArray[Any]]]
"""By agent, see Pane."""


def frame_rate(task: envs.Task) -> int:
    """Of a video, a second: real time, but no more than 25; 5 where steps have no time of their own."""
    return min(25, round(1 / task.control_dt)) if task.control_dt < 1 else 5


class Pane:
    """One agent's trial: state [M, S], action [M, A], episode [M], theta [E, L], and belief [M, L] if it has one.

    A row is a step, or the start of an episode, which has no action.
    """

    def __init__(self, task: envs.Task, name: str, clip: dict[str, NDArray[Any]]) -> None:
        self.task, self.name, self.clip = task, name, clip
        self.starts = np.flatnonzero(np.diff(clip["episode"], prepend=-1))
        self._renderers: dict[int, Any] = {}
        state, action, theta = clip["state"], clip["action"], clip["theta"][clip["episode"]]
        reward = np.append(0.0, task.reward(state[:-1], action[1:], state[1:], theta[1:]))
        total = reward.cumsum()  # what a start has, which is no step, is subtracted below
        self.earned = total - np.repeat(total[self.starts], np.diff(np.append(self.starts, len(total))))

    def row(self, episode: int, t: int) -> tuple[int, bool]:
        """The row of step t of an episode, its last one if it ended before; and whether it did."""
        end = np.append(self.starts, len(self.clip["episode"]))[episode + 1]
        row = min(self.starts[episode] + t, end - 1)
        return int(row), bool(self.starts[episode] + t > row and t <= self.task.horizon)

    def picture(self, episode: int, t: int) -> Image.Image:
        """The whole pane at a step."""
        row, over = self.row(episode, t)
        if episode not in self._renderers:
            self._renderers = {episode: self.task.renderer(self.clip["theta"][episode])}
        seen = Image.fromarray(self._renderers[episode](self.clip["state"][row], self.clip["action"][row]))
        latents = self.task.latents
        pane = Image.new("RGB", (WIDTH, HEAD + HEIGHT + STRIP * len(latents)), "white")
        pane.paste(seen.resize((WIDTH, HEIGHT)), (0, HEAD))
        draw = ImageDraw.Draw(pane)
        draw.text((8, 6), NAMES.get(self.name, self.name), fill=INK, font_size=17)
        digits = 0 if np.abs(self.earned).max() >= 10 else 2
        earned = f"earned {self.earned[row]:z.{digits}f}" + " - over" * over
        draw.text((WIDTH - 8, 8), earned, fill=INK, font_size=14, anchor="ra")
        for i in range(len(latents)):
            self._strip(draw, i, HEAD + HEIGHT + STRIP * i, episode, t)
        return pane

    def _strip(self, draw: ImageDraw.ImageDraw, i: int, top: int, episode: int, t: int) -> None:
        """What is believed of the i-th latent up to now (thick), against the truth (thin)."""
        latent, episodes = self.task.latents[i], len(self.starts)
        left, right, low, high = 8, WIDTH - 8, top + STRIP - 8, top + 24

        def at(e: int, step: float, theta: float) -> tuple[float, float]:
            share = (e + min(step / self.task.horizon, 1)) / episodes
            up = (theta - latent.low) / (latent.high - latent.low)
            return left + share * (right - left), low + np.clip(up, 0, 1) * (high - low)

        draw.rectangle((left, high, right, low), outline=(225, 225, 230))
        for e in range(1, episodes):
            x = at(e, 0, latent.low)[0]
            draw.line((x, high, x, low), fill=(225, 225, 230))
        for e in range(episodes):
            truth = self.clip["theta"][e, i]
            draw.line((*at(e, 0, truth), *at(e, self.task.horizon, truth)), fill=TRUTH, width=2)
        belief = self.clip.get("belief")
        colour = BELIEF if self.name == "naive_rnn" else RIGHT
        unit = f"{latent.name}, {latent.low:g} to {latent.high:g} {latent.unit}".strip()
        draw.text((left, top + 6), unit, fill=GREY, font_size=13)
        draw.text((right - (65 if belief is not None else 0), top + 6), "true", fill=TRUTH, font_size=13, anchor="ra")
        if belief is None:
            return
        draw.text((right, top + 6), "believed", fill=colour, font_size=13, anchor="ra")
        line = []
        for e in range(episode + 1):
            last = t if e == episode else self.task.horizon
            line += [at(e, step, belief[self.row(e, step)[0], i]) for step in range(0, last + 1)]
        if len(line) > 1:
            draw.line(line, fill=colour, width=3)
        x, y = line[-1]
        draw.ellipse((x - 4, y - 4, x + 4, y + 4), fill=colour)


class Film:
    """Pictures [H, W, 3], which notebooks show as an animation."""

    def __init__(self, pictures: Sequence[NDArray[Any]], rate: float) -> None:
        """rate: pictures a second."""
        self.pictures: list[Any] = list(pictures)
        self.rate = rate

    def webp(self) -> bytes:
        """The animation as a .webp file."""
        buffer, (first, *others) = io.BytesIO(), map(Image.fromarray, self.pictures)
        times = {"duration": round(1000 / self.rate), "loop": 0}
        first.save(buffer, "webp", save_all=True, append_images=others, quality=40, **times)
        return buffer.getvalue()

    def _repr_html_(self) -> str:
        data = base64.b64encode(self.webp()).decode()
        return f'<img alt="animation of agents side by side" src="data:image/webp;base64,{data}">'


def film(task: envs.Task, clips: Clips, most: int = FRAMES) -> Film:
    """The first and the last episode of a trial, all agents side by side; most: pictures.

    Raises InputError where no GL works.
    """
    panes = [Pane(task, name, clip) for name, clip in clips.items()]
    episodes = min(len(pane.starts) for pane in panes)
    longest = {e: max(pane.row(e, task.horizon)[0] - pane.starts[e] for pane in panes) for e in (0, episodes - 1)}
    stride = max(1, -(-sum(longest.values()) // most))
    pictures = []
    for e in longest:
        truth = panes[0].clip["theta"][e]
        pairs = zip(task.latents, truth.tolist(), strict=True)
        named = ", ".join(f"{lat.name} {value:.3g} {lat.unit}".strip() for lat, value in pairs)
        for t in range(0, longest[e] + 1, stride):
            parts = [pane.picture(e, t) for pane in panes]
            whole = Image.new("RGB", (sum(part.width for part in parts), HEAD + parts[0].height), "white")
            for k, part in enumerate(parts):
                whole.paste(part, (k * WIDTH, HEAD))
            head = f"{task.name}: hidden {named}, episode {e + 1} of {episodes}"
            ImageDraw.Draw(whole).text((8, 7), head, fill=INK, font_size=18)
            pictures.append(np.asarray(whole))
    return Film(pictures, frame_rate(task) / stride)


def save(pictures: Sequence[NDArray[Any]], rate: float, file: Path) -> None:
    """Pictures [H, W, 3], so many a second, as .mp4; written in one step."""
    with tempfile.TemporaryDirectory() as scratch:
        made = Path(scratch) / "film.mp4"
        imageio.mimsave(made, list(pictures), fps=rate, quality=7, macro_block_size=2)
        write_atomically(file, made.read_bytes())


def write(task: envs.Task, clips: Clips, file: Path) -> None:
    """The film as .mp4. Raises InputError where no GL works."""
    made = film(task, clips)
    save(made.pictures, made.rate, file)


def record(env: envs.BatchEnv, agent: Agent, episodes: int, seed: int, theta: Array | None = None) -> dict[str, Any]:
    """The clip of an agent, of the trial that `Recorder` films; theta [N, L], or None: then it is drawn."""
    from deconfounded.benchmarks.engine.benchmark import Recorder

    recorder = Recorder(agent, env, filmed=True)
    hidden = run_trials(env, recorder, episodes, seed, theta).theta[recorder.trial]
    clip = {key: np.array(value) for key, value in recorder.clip.items() if key != "known"}
    return {**clip, "theta": hidden[:, 0] if env.task.switches else hidden}


def decoded(task: envs.Task, features: Array) -> Array:
    """Encoded thetas [M, F], as a probe reads them -> theta [M, L]; of more than two categories the likeliest."""
    theta = []
    parts = np.split(features, np.cumsum([latent.features for latent in task.latents])[:-1], -1)
    for latent, part in zip(task.latents, parts, strict=True):
        if latent.distribution != "categorical":
            theta.append(latent.ppf(np.clip((part[:, 0] + 1) / 2, 0, 1)))
        elif latent.features == 2:
            theta.append(latent.low + np.clip((1 + part[:, 1] - part[:, 0]) / 2, 0, 1))
        else:
            theta.append(latent.low + part.argmax(-1))
    return np.stack(theta, -1)
