"""An error budget in a report and a page."""

from jaxbundle.report.layout import heading, paragraph, table

TITLE = "Error budget"
HEADER = ("result", "error of", "σ of it", "effect", "share %")
LEGEND = (
    "Effect on the result of an error of one σ in a held quantity; for the "
    "measurements σ. Share: of the squared total. Several independent errors (×) add in "
    "squares."
)
MOST_ROWS = 400


def budget_lines(budget) -> list[str]:
    """The budget as a section of the report."""
    rows = budget.rows()
    lines = [*heading(TITLE), *table(HEADER, rows[:MOST_ROWS], "llrrr")]
    if len(rows) > MOST_ROWS:
        lines.append(f"and {len(rows) - MOST_ROWS} more rows, see budget.csv")
    return [*lines, "", *paragraph(LEGEND)]
