"""Errors for the user: where, what is wrong, what to do."""

import re
from collections.abc import Sequence

TOO_LONG = re.compile(r"([^\s/\\]{40})[^\s/\\]{260,}")
"""A word of 300 characters or more, longer than any file name with its context."""


class InputError(ValueError):
    """The input cannot be used; the message names file, row, cause and remedy.

    Extremely long words are cut to 40 characters.
    """

    def __init__(self, message: str = ""):
        super().__init__(TOO_LONG.sub(r"\1…", message))


class NotSolvedError(RuntimeError):
    """The adjustment has no reliable solution; the message gives reason and remedy.

    `undetermined`: names of undetermined unknowns, if known.
    """

    def __init__(self, message: str, undetermined: Sequence[str] = ()):
        super().__init__(message)
        self.undetermined = tuple(undetermined)
