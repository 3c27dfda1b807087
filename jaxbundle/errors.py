"""What can go wrong, said to a person: where it is, what is wrong, what to do."""


class InputError(ValueError):
    """The input cannot be used; the message names file, row and thing, and the remedy."""


class NotSolvedError(RuntimeError):
    """The adjustment has no trustworthy answer; the message says why and what to do."""
