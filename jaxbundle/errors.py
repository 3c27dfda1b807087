"""What can go wrong, said to a person: where it is, what is wrong, what to do."""

from collections.abc import Sequence


class InputError(ValueError):
    """The input cannot be used; the message names file, row and thing, and the remedy."""


class NotSolvedError(RuntimeError):
    """The adjustment has no trustworthy answer; the message says why and what to do.

    `undetermined`: names of what the observations do not determine, where they are known.
    """

    def __init__(self, message: str, undetermined: Sequence[str] = ()):
        super().__init__(message)
        self.undetermined = tuple(undetermined)
