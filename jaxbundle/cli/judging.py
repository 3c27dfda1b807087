"""The judge of a command's result, imported only where an option asks for one."""

import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from jaxbundle.cli.app import NOT_ACCEPTED
from jaxbundle.cli.certificate_options import CertificateOptions

if TYPE_CHECKING:
    from jaxbundle.certificates.acceptance import Acceptance


class NoJudge:
    """In place of a judge where no option asks for one."""

    def judge(self, result: Any, origin: Any = None) -> None:  # noqa: ARG002 - as a judge
        return None

    def write(self, judgement: None) -> None:
        pass

    def end(self, judgement: None) -> None:
        pass


def judge_of(
    command: str,
    options: CertificateOptions,
    outputs: Mapping[str, str],
    out: Path | None,
    inputs: Iterable[str | Path],
    **known: Any,
) -> Any:
    """The `Judge` of a command's result (`jaxbundle.cli.judgement`), with everything that can be
    checked before it is there; a `NoJudge` without options, so that a command without them does not
    wait for what it does not need.

    **Raises:** `InputError`."""
    if not any(options):
        return NoJudge()
    from jaxbundle.cli.judgement import make_judge

    return make_judge(command, options, outputs, out, inputs, **known)


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


def end_unmet(accepted: "Acceptance | None") -> None:
    """End the command with a line for each criterion that is not met.

    **Raises:** `typer.Exit` with status 4 if there are any."""
    if accepted is not None and not accepted.met:
        for line in accepted.unmet:
            print(f"jaxbundle: {line}", file=sys.stderr)
        raise typer.Exit(NOT_ACCEPTED)
