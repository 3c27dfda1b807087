"""The result of a command as one page of HTML, for a browser and for paper.

    pieces = jaxbundle.report.page.compose(adjustment)
    Path("report.html").write_text("".join(pieces))

An adjustment has its page here, and so has a refinement of scanner images (`refinement`);
calibrations, reconstructions and batches declare theirs in their subpackages.
"""

from jaxbundle.report.page.adjustment import Addition, compose, compose_failure
from jaxbundle.report.page.document import Listing, Page, Section, write
from jaxbundle.report.page.origin import (
    UNKNOWN,
    InputFile,
    Origin,
    fingerprint_files,
    head_line,
    stamp,
)
from jaxbundle.report.page.overview import give_verdict
from jaxbundle.report.verdict import Finding

__all__ = [
    "Addition",
    "Finding",
    "InputFile",
    "Listing",
    "Origin",
    "Page",
    "Section",
    "UNKNOWN",
    "compose",
    "compose_failure",
    "fingerprint_files",
    "give_verdict",
    "head_line",
    "stamp",
    "write",
]
