"""The error for bad input, and how other errors are reported in one line."""

from __future__ import annotations


class InputError(ValueError):
    """Bad input from outside: one line that says what was given and what would be right."""
