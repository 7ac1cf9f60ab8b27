"""Trials: the data that imitators learn from."""

from __future__ import annotations  # as a class is named in its own methods

import hashlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deconfounded.envs.streams import Array, Mask
from deconfounded.envs.support.errors import InputError
from deconfounded.envs.support.files import write_atomically
from deconfounded.envs.support.numbers import check_rounding
from deconfounded.experts.arrays import LARGEST, numbers, padded, size


def of_steps(theta: Array, steps: int) -> Array:
    """Theta of each step [B, E, T, L], from a roll-out's theta: of each episode [B, E, L], or of each step already."""
    return np.repeat(theta[:, :, None], steps, 2) if theta.ndim == 3 else theta


@dataclass(frozen=True, eq=False)
class Trials:
    """B trials of E episodes of T steps each, without theta. Arrays are read-only.

    obs [B, E, T + 1, O] float32; action [B, E, T, A] float32; mask [B, E, T] bool, whether step t took place (False
    once an episode has ended early); actions: the number of discrete actions, or 0 for actions in [-1, 1].
    What is given for steps that did not take place is replaced: by the observation before them, and by actions of 0.
    Raises InputError for shapes that do not fit each other, NaN, invalid actions, and values that float32 would lose.
    """

    obs: NDArray[np.float32]
    action: NDArray[np.float32]
    mask: Mask
    actions: int = 0

    def __post_init__(self) -> None:
        given = {name: numbers(name, getattr(self, name)) for name in ("obs", "action", "mask")}
        obs, action, mask = given.values()
        if mask.dtype != bool and not np.isin(mask, (0, 1)).all():
            raise InputError("mask of Trials held numbers other than 0 and 1; it must be bool")
        if not isinstance(self.actions, int | np.integer) or isinstance(self.actions, bool) or self.actions < 0:
            right = "the number of discrete actions, or 0 if continuous"
            raise InputError(f"actions of Trials was {self.actions!r}; it must be {right}")
        b, e, t = mask.shape if mask.ndim == 3 else (0, 0, 0)
        fit = obs.shape[:-1] == (b, e, t + 1) and action.shape[:-1] == (b, e, t)
        if not fit or 0 in (obs.shape[-1], action.shape[-1]):
            raise InputError(
                f"Trials of obs {obs.shape}, action {action.shape}, mask {mask.shape}; they must be"
                " [B, E, T + 1, O], [B, E, T, A] and [B, E, T]"
            )
        with np.errstate(over="ignore"):  # infinity is refused
            action = action.astype(np.float32)
        if not mask.any():
            raise InputError("Trials held no step that took place; their mask must be True somewhere")
        mask = mask.astype(bool)
        if not mask.all():
            obs, action = padded(obs, mask), np.where(mask[..., None], action, 0)
        if not (np.isfinite(obs).all() and np.isfinite(action).all()):
            raise InputError("Trials held NaN or infinity; every observation and action must be finite")
        if (far := size(obs)) > LARGEST:
            raise InputError(f"Trials held an observation of {far:g}; they must be at most {LARGEST:g} in size")
        if self.actions and not np.isin(action, np.arange(self.actions)).all():
            raise InputError(f"Trials held an action that is not one of 0..{self.actions - 1}")
        if not self.actions and (far := size(action)) > 1:
            right = "actions must be in [-1, 1]; discrete ones need `actions`, their number"
            raise InputError(f"Trials held an action of size {far:.9g}; {right}")
        if not np.can_cast(obs.dtype, np.float32):
            check_rounding("Trials", obs, mask)
        for name, array, dtype in (("obs", obs, np.float32), ("action", action, np.float32), ("mask", mask, bool)):
            kept = np.array(array, dtype)
            kept.setflags(write=False)
            object.__setattr__(self, name, kept)

    def __len__(self) -> int:
        return len(self.mask)

    @property
    def sha256(self) -> str:
        """SHA-256 of shapes and contents, whatever file they are in."""
        digest = hashlib.sha256(f"{self.obs.shape} {self.action.shape} {self.actions}".encode())
        for array in (self.obs, self.action, self.mask):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    @staticmethod
    def from_minari(source: Path | str) -> Trials:
        """The trials of a Minari data set's folder, without their thetas; other formats: `experts.datasets.read`."""
        from deconfounded.experts.datasets.logs import trials_of
        from deconfounded.experts.datasets.minari_sets import read_minari
        from deconfounded.experts.datasets.rows import Roles

        return trials_of([[read_minari(source)]], Roles())[0]

    def save(self, file: Path | str, made_of: str = "") -> None:
        """Write an .npz file atomically. made_of: identity of the data, which `load` compares."""
        buffer, arrays = io.BytesIO(), {"obs": self.obs, "action": self.action, "mask": self.mask}
        np.savez_compressed(buffer, **arrays, actions=self.actions, made_of=made_of)  # type: ignore[arg-type]
        write_atomically(Path(file), buffer.getvalue())

    @staticmethod
    def load(file: Path | str, made_of: str | None = None) -> Trials:
        """Read what `save` wrote. Raises InputError if the file is missing or damaged, or its `made_of` differs."""
        try:
            with np.load(file, allow_pickle=False) as data:
                if missing := {"obs", "action", "mask", "actions", "made_of"} - {*data}:
                    remedy = "Trials(obs, action, mask).save writes such a file"
                    raise InputError(f"it lacks {', '.join(sorted(missing))}; {remedy}")
                if made_of not in (None, str(data["made_of"])):
                    raise InputError("it was made of something else")
                return Trials(data["obs"], data["action"], data["mask"], int(data["actions"]))
        except (InputError, OSError) as error:
            why = " ".join(str(error).split())
        except Exception:  # a damaged zip file raises many types of errors, and another kind of file still others
            why = "it is damaged, or no .npz file of Trials.save"
        raise InputError(f"no trials could be read from {file}: {why}")


def check_trials(what: str, given: object) -> None:
    """Raises InputError for what is no Trials. what: was given it."""
    if not isinstance(given, Trials):
        right = "Trials: of deconfounded.experts.datasets.read, or of arrays"
        raise InputError(f"{what} was given a {type(given).__name__}; it must be {right}")


def joined(parts: Sequence[Trials]) -> Trials:
    """Concatenate trials of the same shape. Raises InputError where their actions are of different kinds."""
    if len(kinds := {part.actions for part in parts}) > 1:
        counts = " and ".join(map(str, sorted(kinds)))
        raise InputError(f"trials to be joined had {counts} discrete actions (0: continuous); all must have as many")
    obs, action, mask = (np.concatenate([getattr(part, key) for part in parts]) for key in ("obs", "action", "mask"))
    return Trials(obs, action, mask, parts[0].actions)
