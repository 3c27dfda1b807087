"""Plain text for reports: headings, aligned tables, numbers with significant digits.

Lines are at most `WIDTH` characters wide; a wider table reduces its gaps and then
shortens its names.
"""

import math
import textwrap
from collections.abc import Iterable, Sequence

import numpy as np

from jaxbundle.types import Numbers

# Characters of a line of a report, a part of its format (docs: at most 100).
WIDTH = 100
MISSING = "–"
# Significant digits of a value whose precision is not known: a camera of 6000 pixels to 0.01 pixel.
DIGITS_WITHOUT_SIGMA = 6


# --- numbers --------------------------------------------------------------------------------


def decimals_of(sigma: float, digits: int = 3) -> int:
    """Decimal places that show `digits` significant digits of σ (negative: tens, hundreds, …)."""
    exponent = int(f"{sigma:.{digits - 1}e}".split("e")[1])
    return digits - 1 - exponent


def digits_of(value: float, sigma: float | None = None, digits: int = 3) -> int:
    """Significant digits of a value: to the decimal place where its σ has `digits` digits, at least
    one; without σ `DIGITS_WITHOUT_SIGMA`."""
    if sigma is None or not (math.isfinite(sigma) and sigma > 0 and math.isfinite(value)):
        return DIGITS_WITHOUT_SIGMA
    if value == 0:
        return 1
    return max(decimals_of(sigma, digits) + math.floor(math.log10(abs(value))) + 1, 1)


def estimate(value: float, sigma: float | None, digits: int = 3) -> tuple[str, str]:
    """A value and its σ as text: σ with `digits` digits, the value to the same decimal place.

    Small numbers get an exponent each.
    """
    if not math.isfinite(value):
        return MISSING, MISSING
    if sigma is None or not math.isfinite(sigma) or sigma <= 0:
        return significant(value, DIGITS_WITHOUT_SIGMA), MISSING
    places = decimals_of(sigma, digits)
    # Beyond seven decimals, or three zeros after the point, exponents are easier to read.
    if 0 <= places <= 7 and max(abs(value), sigma) >= 1e-3:
        return f"{value:.{places}f}", f"{sigma:.{places}f}"
    if places < 0 and abs(value) < 1e9:
        return f"{value:.0f}", f"{sigma:.0f}"
    if value == 0:
        return "0", f"{sigma:.{digits - 1}e}"
    exponent = math.floor(math.log10(abs(value)))
    return f"{value:.{max(0, min(exponent + places, 15))}e}", f"{sigma:.{digits - 1}e}"


def to_place_of(value: float, sigma: float, digits: int = 3) -> str:
    """A value to the decimal place where its σ has `digits` digits."""
    if not (math.isfinite(value) and math.isfinite(sigma) and sigma > 0):
        return significant(value, digits)
    places = decimals_of(sigma, digits)
    return f"{value:.{max(places, 0)}f}" if places <= 7 else significant(value, digits)


def significant(value: float | None, digits: int = 3) -> str:
    """A number with this many significant digits, without an exponent if readable."""
    if value is None or not math.isfinite(value):
        return MISSING
    if value == 0:
        return "0"
    if 1e-5 <= abs(value) < 10.0 ** max(digits, 6):
        places = decimals_of(abs(value), digits)
        text = f"{value:.{max(places, 0)}f}"
        return (
            text.rstrip("0").rstrip(".") if digits >= DIGITS_WITHOUT_SIGMA and "." in text else text
        )
    return f"{value:.{digits - 1}e}"


def fixed(value: float | None, places: int) -> str:
    """A number with fixed decimal places; a dash if missing."""
    if value is None or not math.isfinite(value):
        return MISSING
    # + 0.0: no minus before a zero
    return f"{round(float(value), places) + 0.0:.{places}f}"


def column_decimals(sigma: Numbers, digits: int = 3, max_decimals: int = 9) -> int:
    """One number of decimal places for a whole column: `digits` digits of nearly every σ in it.

    The smallest tenth of the σ may show fewer, so that one odd value does not widen all rows.
    """
    sigma = np.asarray(sigma, float)
    sigma = sigma[np.isfinite(sigma) & (sigma > 0)]
    if not len(sigma):  # a column of held values
        return 4
    return int(np.clip(decimals_of(np.quantile(sigma, 0.1), digits), 0, max_decimals))


def coordinate_decimals(sigma: Numbers) -> int:
    """Decimal places of a column of coordinates: two digits of nearly every σ in it, which suffice
    for an uncertainty (GUM, JCGM 100:2008, 7.2.6); map coordinates have many digits before them."""
    return column_decimals(sigma, 2)


# --- words ----------------------------------------------------------------------------------


def clean(name: object) -> str:
    """A name from a file without characters that would break a line of text."""
    return "".join(c if c.isprintable() else "?" for c in str(name))


def shorten(text: str, width: int) -> str:
    """Text of at most this width, shortened in the middle by an ellipsis."""
    if len(text) <= width:
        return text
    head = (width - 1) // 2
    return text[:head] + "…" + text[len(text) - (width - 1 - head) :]


def paragraph(text: str, indent: int = 0, hanging: int = 0) -> list[str]:
    """Text wrapped to the width."""
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=" " * indent,
        subsequent_indent=" " * (indent + hanging),
        break_on_hyphens=False,
    )


def heading(text: str) -> list[str]:
    """A section's heading, set off by an empty line."""
    return ["", text, "-" * len(text)]


def facts(rows: Iterable[tuple[str, str]], indent: int = 0) -> list[str]:
    """Names and their descriptions in two columns."""
    rows = list(rows)
    width = max((len(name) for name, _ in rows), default=0)
    lines = []
    for name, text in rows:
        start = f"{' ' * indent}{name:<{width}}  "
        lines += textwrap.wrap(
            text or MISSING,
            WIDTH,
            initial_indent=start,
            subsequent_indent=" " * len(start),
            break_on_hyphens=False,
        )
    return lines


# --- tables ---------------------------------------------------------------------------------


def table(header: Sequence[str], rows: Iterable[Sequence[str]], align: str) -> list[str]:
    """Rows of text in aligned columns under a header.

    `align`: one letter a column, `l` or `r`; columns aligned left are names and may be shortened
    where the table would be wider than the page.
    """
    rows = [[clean(cell) for cell in row] for row in rows]
    widths = [max(len(cell) for cell in column) for column in zip(header, *rows, strict=True)]
    gap = 2 if sum(widths) + 2 * (len(widths) - 1) <= WIDTH else 1
    excess = sum(widths) + gap * (len(widths) - 1) - WIDTH
    names = [i for i, kind in enumerate(align) if kind == "l"]
    while excess > 0 and names:
        widest = max(names, key=lambda i: widths[i])
        if widths[widest] <= 6:  # shorter names cannot be told apart: the table is wider then
            break
        widths[widest] -= 1
        excess -= 1

    def line(row: Sequence[str]) -> str:
        cells = [
            f"{shorten(cell, width):<{width}}" if kind == "l" else f"{cell:>{width}}"
            for cell, width, kind in zip(row, widths, align, strict=True)
        ]
        return (" " * gap).join(cells).rstrip()

    return [line(header), *(line(row) for row in rows)]


def cut_lines(lines: Sequence[str], max_lines: int, note: str) -> list[str]:
    """A list cut after `max_lines` lines, with a note if it was cut."""
    lines = list(lines)
    return lines if len(lines) <= max_lines else [*lines[:max_lines], note]


def bar(count: float, largest: float, width: int = 40) -> str:
    """A bar of a histogram in text; never empty for a positive count."""
    if count <= 0 or largest <= 0:
        return ""
    return "#" * max(1, round(width * count / largest))
