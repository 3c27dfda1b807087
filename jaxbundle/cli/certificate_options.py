"""Options of acceptance criteria and certificates."""

from pathlib import Path
from typing import Annotated, NamedTuple

import typer

Accept = Annotated[
    list[str] | None,
    typer.Option(
        metavar="CRITERION",
        help="criterion such as 'sigma(c) < 2 um', 'sigma(fx) < 1 px' or 'check.rms < 5 mm'; "
        "status 4 if not met; repeatable",
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
        return [file for file in (self.details, self.lengths) if file is not None]


NOT_JUDGED = CertificateOptions()
