"""An error budget in a protocol and in a page."""

from jaxbundle.report.layout import heading, paragraph, table

TITLE = "Error budget"
HEADER = ("result", "error of", "σ of it", "effect", "share %")
LEGEND = (
    "Effect: of an error of one σ in something that was held fixed, on the result; of the "
    "measurements σ. Share: of the square of all together. Several independent errors (×) add in "
    "squares."
)
MOST_ROWS = 400


def budget_lines(budget) -> list[str]:
    """The budget as a section of the protocol."""
    rows = budget.rows()
    lines = [*heading(TITLE), *table(HEADER, rows[:MOST_ROWS], "llrrr")]
    if len(rows) > MOST_ROWS:
        lines.append(f"and {len(rows) - MOST_ROWS} more rows, see budget.csv")
    return [*lines, "", *paragraph(LEGEND)]
