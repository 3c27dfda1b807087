"""An error budget as a section of a page."""

from typing import TYPE_CHECKING

from jaxbundle.report.budget import HEADER, LEGEND, TITLE, select_rows
from jaxbundle.report.page.adjustment import NO_ADDITION, Addition
from jaxbundle.report.page.document import Section
from jaxbundle.report.page.markup import grid, paragraph

if TYPE_CHECKING:
    from jaxbundle.adjustment.error_budget import Budget


def describe_budget(budget: "Budget | None") -> Addition:
    """The error budget on the page of an adjustment, if there is one."""
    if budget is None:
        return NO_ADDITION
    rows, number_of_others = select_rows(budget)
    content = grid(HEADER, rows, "words")
    if number_of_others:
        content += paragraph(f"… and {number_of_others} more: all are in budget.csv.")
    content += paragraph(LEGEND)
    return Addition(sections=(Section("budget", TITLE, content, "Budget"),))
