"""The error for bad input, and how other errors are reported in one line."""

import traceback
from pathlib import Path

LONGEST = 1000  # of an error, in characters: what was given may be an array, or a file


class InputError(ValueError):
    """Bad input from outside: one line that says what was given and what would be right."""

    def __str__(self) -> str:
        text = " ".join(super().__str__().split())  # arrays print in several
        return text if len(text) <= LONGEST else f"{text[: LONGEST // 2]} ... {text[-LONGEST // 2 :]}"


def error_line(error: BaseException, *folders: Path | None) -> str:
    """An error in one line: its message, its type and its place in the source; of an InputError the message alone.

    folders: of code from outside. The place is the innermost line of a file in them, if there is one.
    """
    text = " ".join(str(error.args[0] if isinstance(error, KeyError) and error.args else error).split())
    if isinstance(error, InputError):
        return text
    if isinstance(error, SyntaxError) and error.filename:
        return f"{error.msg} ({type(error).__name__}, {Path(error.filename).name}:{error.lineno})"
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if any(folder and _is_in(Path(frame.filename), folder) for folder in folders)]
    frame = (own or frames)[-1]
    return f"{text} ({type(error).__name__}, {Path(frame.filename).name}:{frame.lineno})"


def _is_in(file: Path, folder: Path) -> bool:
    """Whether a file is in a folder, but in no environment of installed packages there."""
    file, folder = file.resolve(), folder.resolve()
    return file.is_relative_to(folder) and "site-packages" not in file.relative_to(folder).parts
