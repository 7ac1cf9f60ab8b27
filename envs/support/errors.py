"""The error for bad input, and how other errors are reported in one line."""

import traceback
from pathlib import Path

from deconfounded.envs.support.origin import is_library, is_ours

LONGEST = 1000  # of an error, in characters: what was given may be an array, or a file


class InputError(ValueError):
    """Bad input from outside: one line that says what was given and what would be right."""

    def __str__(self) -> str:
        text = " ".join(super().__str__().split())  # arrays print in several
        return text if len(text) <= LONGEST else f"{text[: LONGEST // 2]} ... {text[-LONGEST // 2 :]}"


def error_line(error: BaseException) -> str:
    """An error in one line: its message, its type and its place in the source; of an InputError the message alone.

    The place is the innermost line that is neither this package's nor a library's, if there is one.
    """
    text = " ".join(str(error.args[0] if isinstance(error, KeyError) and error.args else error).split())
    if isinstance(error, InputError):
        return text
    if isinstance(error, SyntaxError) and error.filename:
        return f"{error.msg} ({type(error).__name__}, {Path(error.filename).name}:{error.lineno})"
    line = users_line(error) or _line(traceback.extract_tb(error.__traceback__)[-1])
    return f"{text} ({type(error).__name__}, {line})"


def users_line(error: BaseException) -> str:
    """The innermost line of the user's own files that an error went through, file.py:12; "" if there is none."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if _is_users(frame.filename)]
    return _line(frames[-1]) if frames else ""


def _line(frame: traceback.FrameSummary) -> str:
    return f"{Path(frame.filename).name}:{frame.lineno}"


def _is_users(name: str) -> bool:
    """Whether a file is the user's own: neither of this package nor of a library."""
    file = Path(name).resolve()
    installed = is_library(file) or {"site-packages", "dist-packages"} & {*file.parts}  # also of other environments
    return not name.startswith("<") and not is_ours(file) and not installed
