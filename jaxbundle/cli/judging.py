"""The judge of a command's result, imported only where an option asks for one."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from jaxbundle.cli.certificate_options import CertificateOptions


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
