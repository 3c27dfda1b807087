"""Options of acceptance criteria and certificates."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

Accept = Annotated[
    list[str] | None,
    typer.Option(
        metavar="CRITERION",
        help="criterion such as 'sigma(c) < 2 um' or 'check.rms < 5 mm'; status 4 if not met; "
        "repeatable",
    ),
]
CertificateFile = Annotated[
    str, typer.Option("--certificate", metavar="FILE.html", help="write a certificate for print")
]
Details = Annotated[
    Path | None,
    typer.Option(help="TOML: laboratory, object, MPE, and held inputs, for the certificate"),
]
Lengths = Annotated[
    Path | None,
    typer.Option(
        help="table from,to,value,sigma[,line] of calibrated lengths that are only compared: "
        "length measurement errors"
    ),
]


# Files of --out, with criteria and with calibrated lengths.
ACCEPTANCE_FILE, LENGTHS_FILE = JUDGEMENT_FILES = "acceptance.csv", "lengths.csv"


class CertificateOptions(NamedTuple):
    """The values of these options."""

    accept: list[str] | None = None
    certificate: str = ""
    details: Path | None = None
    lengths: Path | None = None

    @property
    def settings(self) -> dict[str, object]:
        """Options and their values, for the page."""
        return {
            "--accept": "; ".join(self.accept or ()),
            "--details": self.details,
            "--lengths": self.lengths,
        }

    @property
    def files(self) -> list[Path]:
        """The files that are read."""
        return [one for one in (self.details, self.lengths) if one is not None]


NOT_JUDGED = CertificateOptions()


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
