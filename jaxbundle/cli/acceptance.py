"""Acceptance criteria of a command (`--accept`): checked before the work, decided after it."""

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import typer

from jaxbundle.cli.app import NOT_ACCEPTED

if TYPE_CHECKING:
    from jaxbundle.certificates.acceptance import Acceptance


def check_accept(criteria: Sequence[str] | None, command: str) -> None:
    """Refuse criteria that cannot be decided of a command's result, before the work.

    **Raises:** `InputError`."""
    if criteria:
        from jaxbundle.certificates.acceptance import check_criteria

        check_criteria(criteria, command)


def accept_result(result: Any, criteria: Sequence[str] | None) -> "Acceptance | None":
    """The criteria and what was found; a criterion about what the result does not have is not met,
    so that a mistake in its name loses no result."""
    if not criteria:
        return None
    from jaxbundle.certificates.acceptance import accept_known

    return accept_known(result, criteria)


def end_unmet(acceptance: "Acceptance | None") -> None:
    """End the command with a line for each criterion that is not met.

    **Raises:** `typer.Exit` with status 4 if there are any."""
    if acceptance is not None and not acceptance.met:
        for line in acceptance.unmet:
            print(f"jaxbundle: {line}", file=sys.stderr)
        raise typer.Exit(NOT_ACCEPTED)
