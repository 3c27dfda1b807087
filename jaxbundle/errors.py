"""Errors for the user: where, what is wrong, what to do."""

import re
from collections.abc import Sequence

# Characters that end a line (`str.splitlines`), or that move the cursor of a terminal.
CONTROL = re.compile("[\0-\x1f\x7f-\x9f\u2028\u2029]+")
# A word of 300 characters or more, longer than any file name with its context.
TOO_LONG = re.compile(r"([^\s/\\]{40})[^\s/\\]{260,}")


class InputError(ValueError):
    """The input cannot be used; the message names file, row, cause and remedy.

    It is one line, whatever a file contains; extremely long words are cut to 40 characters.
    """

    def __init__(self, message: str = ""):
        super().__init__(TOO_LONG.sub(r"\1…", CONTROL.sub(" ", message)))


class NotSolvedError(RuntimeError):
    """The adjustment has no reliable solution; the message gives reason and remedy.

    `undetermined`: names of undetermined unknowns, if known.
    """

    def __init__(self, message: str, undetermined: Sequence[str] = ()):
        super().__init__(message)
        self.undetermined = tuple(undetermined)
