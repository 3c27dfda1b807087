"""An error budget as a section of a page."""

from jaxbundle.report.budget import HEADER, LEGEND, MOST_ROWS, TITLE
from jaxbundle.report.page.adjustment import ALONE, Addition
from jaxbundle.report.page.document import Section
from jaxbundle.report.page.markup import grid, paragraph


def describe_budget(budget) -> Addition:
    """The error budget on the page of an adjustment, if there is one."""
    if budget is None:
        return ALONE
    content = grid(HEADER, budget.rows()[:MOST_ROWS], "words") + paragraph(LEGEND)
    return Addition(sections=(Section("budget", TITLE, content, "Budget"),))
