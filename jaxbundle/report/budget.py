"""An error budget in a report and a page."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from jaxbundle.report.layout import heading, paragraph, table

if TYPE_CHECKING:
    from jaxbundle.adjustment.error_budget import Budget

TITLE = "Error budget"
HEADER = ("result", "error of", "σ of it", "effect", "share %")
LEGEND = (
    "Effect on the result of an error of one σ in a held quantity; for the "
    "measurements σ. Share: of the squared total. Several independent errors (×) add in "
    "squares."
)


def select_rows(budget: "Budget", max_rows: int = 400) -> tuple[Sequence[tuple[str, ...]], int]:
    """The rows that a report and a page show, and the number of the others: a budget has a row for
    each result and cause, of which a reader looks up a few; budget.csv has all."""
    rows = budget.rows()
    return rows[:max_rows], max(len(rows) - max_rows, 0)


def budget_lines(budget: "Budget") -> list[str]:
    """The budget as a section of the report."""
    rows, number_of_others = select_rows(budget)
    lines = [*heading(TITLE), *table(HEADER, rows, "llrrr")]
    if number_of_others:
        lines.append(f"and {number_of_others} more rows, see budget.csv")
    return [*lines, "", *paragraph(LEGEND)]
