"""The page of an adjustment, and of a command based on one."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from jaxbundle.errors import NotSolvedError
from jaxbundle.report import head
from jaxbundle.report.layout import clean
from jaxbundle.report.page import sections
from jaxbundle.report.page.document import NOTHING, Listing, Page, Section, write
from jaxbundle.report.page.markup import facts, paragraph
from jaxbundle.report.page.origin import UNKNOWN, Origin
from jaxbundle.report.page.overview import explain_failure, give_verdict, list_messages
from jaxbundle.report.page.scene import describe_frames, describe_network
from jaxbundle.report.page.tables import collect_tables
from jaxbundle.report.summary import summary
from jaxbundle.report.verdict import Finding, Verdict, conclude

if TYPE_CHECKING:
    from jaxbundle.adjustment.result import Adjustment

SIGMA_NOTE = (
    "Standard deviations are a posteriori, σ0 times those of the a priori weights, unless "
    "called a priori."
)


class Addition(NamedTuple):
    """Additions of a command to the page of its adjustment.

    **Fields:** `kind`, for the title, empty if the name of the network is enough; `findings` before
    those of the adjustment; `without`: findings of the adjustment to omit; `warnings` before its
    own; `overview`: HTML below the tests; `sections` after the verdict; `tables` before the others;
    `name`, in place of that of the network.
    """

    kind: str = "bundle adjustment"
    findings: tuple[Finding, ...] = ()
    without: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    overview: str = ""
    sections: tuple[Section, ...] = ()
    tables: Mapping[str, Listing] = NOTHING
    name: str = ""

    def followed_by(self, other: "Addition") -> "Addition":
        """This addition with the findings and sections of another one after its own."""
        return self._replace(
            findings=(*self.findings, *other.findings),
            sections=(*self.sections, *other.sections),
        )

    def conclude(self, adjustment: "Adjustment") -> Verdict:
        """The verdict of the command on its adjustment."""
        return conclude(adjustment, self.findings, self.without, len(self.warnings))


NO_ADDITION = Addition()
# Lines of the summary that are repeated below it.
REPEATED_LINES = ("Note", "Verdict", "Redundancy", "σ0", "Image precision", "χ² test")


def compose(
    adjustment: "Adjustment",
    origin: Origin = UNKNOWN,
    *,
    date: str | None = None,
    also: Addition = NO_ADDITION,
) -> Iterator[str]:
    """The page of an adjustment as HTML, in pieces; for an unsolved one, the reason.

    **Arguments:**

    - `origin`: the files that were read, with their fingerprints (`fingerprint_files`), and
      settings to show.
    - `date`: of the computation, printed as given; by default that of `origin`, else now.
    - `also`: additions to the page.
    """
    yield from write(describe(adjustment, origin, also), date)


def compose_failure(
    error: NotSolvedError, origin: Origin = UNKNOWN, kind: str = NO_ADDITION.kind
) -> Iterator[str]:
    """The page of an adjustment that ended before there was a result."""
    rows = [("Why", str(error)), *(("Not determined", name) for name in error.undetermined)]
    first_section = explain_failure(rows, ())
    yield from write(Page(f"no result: {kind}", [first_section], origin))


def describe(
    adjustment: "Adjustment", origin: Origin = UNKNOWN, also: Addition = NO_ADDITION
) -> Page:
    """The page of an adjustment, as a `Page`."""
    name = clean(also.name or adjustment.network.name) or "network"
    title = f"{name}: {also.kind}" if also.kind else name
    settings = head.setting_facts(adjustment)
    warnings = (*also.warnings, *head.warnings(adjustment))
    if not adjustment.converged:
        first_section = explain_failure(head.failure_facts(adjustment), warnings, also.overview)
        return Page(title, [first_section, *also.sections], origin, settings, also.tables)
    noted = list_messages("Notes", adjustment.notes)
    findings = also.conclude(adjustment).findings
    first_section = give_verdict(findings, warnings, also.overview, noted, *_result(adjustment))
    drawings: dict[str, Any] = {
        "network-data": describe_network(adjustment),
        "frames": describe_frames(adjustment),
    }
    sections_shown = [first_section, *also.sections, *sections.collect(adjustment)]
    tables = {**also.tables, **collect_tables(adjustment)}
    return Page(title, sections_shown, origin, settings, tables, drawings)


def _result(adjustment: "Adjustment") -> list[str]:
    """The main values, and what their σ are."""
    return [
        "<h3>Result</h3>\n",
        facts(row for row in summary(adjustment) if row[0] not in REPEATED_LINES),
        paragraph(SIGMA_NOTE),
        paragraph(head.LARGER_SIGMA) if adjustment.error_model is not None else "",
    ]
