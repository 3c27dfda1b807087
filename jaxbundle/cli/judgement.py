"""Acceptance and certificate of a command's result: what its options ask, checked before the work,
judged after it."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxbundle.certificates.acceptance import (
    Acceptance,
    accept_known,
    check_criteria,
    length_test_of,
)
from jaxbundle.certificates.details import NO_DETAILS, CertificateDetails, read_details
from jaxbundle.certificates.document import Certificate, certificate
from jaxbundle.certificates.lengths import (
    CalibratedLengths,
    LengthTest,
    read_lengths,
    read_mpe,
    require_points,
)
from jaxbundle.certificates.page import acceptance_section, lengths_section
from jaxbundle.cli.acceptance import end_unmet
from jaxbundle.cli.certificate_options import ACCEPTANCE_FILE, LENGTHS_FILE, CertificateOptions
from jaxbundle.cli.outputs import HTML, check_content, check_file
from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import table_rows, write_csv, write_text
from jaxbundle.network.tables import Network
from jaxbundle.report.page import UNKNOWN, Addition, Finding, Origin
from jaxbundle.report.page.adjustment import NO_ADDITION
from jaxbundle.report.verdict import BAD, GOOD


@dataclasses.dataclass(frozen=True)
class Judgement:
    """What was asked of a result, and what was found; nothing without options. `refused`: why
    lengths, or a certificate, cannot be of this result."""

    acceptance: Acceptance | None = None
    lengths: LengthTest | None = None
    document: Certificate | None = None
    refused: str = ""

    @property
    def json(self) -> dict[str, Any]:
        """Entries of the JSON."""
        entries: dict[str, Any] = {}
        if self.acceptance is not None:
            entries["acceptance"] = self.acceptance.to_dict()
        if self.lengths is not None:
            entries["length_errors"] = self.lengths.to_dict()
        return entries

    @property
    def text(self) -> str:
        """What follows the report."""
        parts = [part for part in (self.lengths, self.acceptance) if part is not None]
        return "".join(f"\n{part}\n" for part in parts)

    @property
    def addition(self) -> Addition:
        """Findings and sections of the page."""
        findings, sections = [], []
        if self.acceptance is not None:
            state = GOOD if self.acceptance.met else BAD
            findings.append(Finding("Acceptance", state, self.acceptance.sentence))
            sections.append(acceptance_section(self.acceptance))
        if self.lengths is not None:
            sections.append(lengths_section(self.lengths))
        return NO_ADDITION._replace(findings=tuple(findings), sections=tuple(sections))

    def fill(self, folder: Path) -> None:
        """Write the tables into a folder."""
        for part, name in ((self.acceptance, ACCEPTANCE_FILE), (self.lengths, LENGTHS_FILE)):
            if part is not None:
                columns = part.table()
                write_csv(folder / name, list(columns), table_rows(columns))


WITHOUT_RESULT = Judgement()


@dataclasses.dataclass(frozen=True)
class Judge:
    """The options of a command: `criteria`, the file of the `certificate`, its `details`, and
    calibrated `lengths`, read and checked."""

    criteria: tuple[str, ...] = ()
    certificate: str = ""
    details: CertificateDetails = NO_DETAILS
    lengths: CalibratedLengths | None = None

    def judge(self, result: Any, origin: Origin = UNKNOWN) -> Judgement:
        """The judgement of a result; none of one without a solution."""
        if not np.all(result.converged):
            return WITHOUT_RESULT
        test, document, acceptance, refused = None, None, None, ""
        # The result of hours is written first: what cannot be judged is refused by `end`.
        try:
            if self.lengths is not None:
                details = self.details
                test = length_test_of(
                    result,
                    self.lengths,
                    mpe=details.mpe or None,
                    rule=details.rule,
                    volume=details.volume,
                )
            if self.certificate:
                document = certificate(result, details=self.details, lengths=test, origin=origin)
        except InputError as error:
            refused = str(error)
        if self.criteria:
            acceptance = accept_known(result, self.criteria, test)
        if document is not None:
            document = dataclasses.replace(document, acceptance=acceptance)
        return Judgement(acceptance, test, document, refused)

    def write(self, judgement: Judgement) -> None:
        """Write the certificate."""
        if judgement.document is not None:
            write_text(Path(self.certificate), judgement.document.pieces())

    def end(self, judgement: Judgement) -> None:
        """End the command with a line for each criterion that is not met.

        **Raises:** `InputError` for what cannot be judged, though the result is written;
        `typer.Exit` with status 4 if criteria are not met."""
        if judgement.refused:
            raise InputError(judgement.refused)
        end_unmet(judgement.acceptance)


def make_judge(
    command: str,
    options: CertificateOptions,
    outputs: Mapping[str, str],
    out: Path | None,
    inputs: Iterable[str | Path],
    *,
    network: Network | None = None,
    models: Sequence[str] = (),
    camera_names: Sequence[str] = (),
    force: bool = False,
) -> Judge:
    """The judge of a command's result, with everything that can be checked before it is there.

    **Arguments:** `outputs`: the files of its other options, by option; `inputs`: its files.

    **Raises:** `InputError`."""
    check_criteria(options.accept, command, network, models, camera_names)
    details = read_details(options.details)
    known_lengths = None if options.lengths is None else read_lengths(options.lengths)
    if known_lengths is not None and network is not None:
        require_points(known_lengths, network.points.id)
    if details.mpe:
        read_mpe(details.mpe, "m" if network is None else network.object_unit)
    if options.details is not None and not options.certificate and known_lengths is None:
        raise InputError("--details: it is for --certificate or --lengths; give one of them")
    target = options.certificate
    if target == "-":
        raise InputError("--certificate -: a page cannot be written to standard output")
    certificate_inputs = [
        source for source in (options.details, options.lengths) if source is not None
    ]
    check_file("--certificate", target, None, [*inputs, *certificate_inputs])
    if not force:
        check_content("--certificate", target, HTML, "HTML", "")
    for option, file in outputs.items():
        if target and file and Path(file).resolve() == Path(target).resolve():
            raise InputError(f"--certificate {target}: is also the file of {option}")
    if target and out is not None and Path(target).resolve().parent == out.resolve():
        raise InputError(
            f"--certificate {target}: is inside --out, which is replaced as a whole; give a file "
            "beside it"
        )
    return Judge(tuple(options.accept or ()), target, details, known_lengths)
