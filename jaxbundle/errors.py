"""What can go wrong, said to a person: where it is, what is wrong, what to do."""

import re
from collections.abc import Sequence

TOO_LONG = re.compile(r"([^\s/\\]{40})[^\s/\\]{260,}")
"""A word of 300 characters or more: a name of a file, with what stands around it, has less."""


class InputError(ValueError):
    """The input cannot be used; the message names file, row and thing, and the remedy.

    Of a word without end, which no person wrote, the message has the first 40 characters.
    """

    def __init__(self, message: str = ""):
        super().__init__(TOO_LONG.sub(r"\1…", message))


class NotSolvedError(RuntimeError):
    """The adjustment has no trustworthy answer; the message says why and what to do.

    `undetermined`: names of what the observations do not determine, where they are known.
    """

    def __init__(self, message: str, undetermined: Sequence[str] = ()):
        super().__init__(message)
        self.undetermined = tuple(undetermined)
