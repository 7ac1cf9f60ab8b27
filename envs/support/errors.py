"""The error for bad input, and how other errors are reported in one line."""

import traceback
from pathlib import Path


class InputError(ValueError):
    """Bad input from outside: one line that says what was given and what would be right."""

    def __str__(self) -> str:
        return " ".join(super().__str__().split())  # arrays print in several


def error_line(error: BaseException) -> str:
    """An error in one line: its message, its type and its place in the source; of an InputError the message alone."""
    text = " ".join(str(error.args[0] if isinstance(error, KeyError) and error.args else error).split())
    if isinstance(error, InputError):
        return text
    if isinstance(error, SyntaxError) and error.filename:
        return f"{error.msg} ({type(error).__name__}, {Path(error.filename).name}:{error.lineno})"
    frame = traceback.extract_tb(error.__traceback__)[-1]
    return f"{text} ({type(error).__name__}, {Path(frame.filename).name}:{frame.lineno})"
