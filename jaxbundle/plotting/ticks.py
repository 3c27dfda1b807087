"""Ticks of axes in figures and pages: short texts, and one offset for what all have in common."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxbundle.plotting.style import label

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Largest number of digits of a tick: as many as fit beside an axis.
TICK_DIGITS = 6


def label_ticks(ticks: Sequence[float] | Float[np.ndarray, " n"]) -> tuple[float, list[str]]:
    """A common offset of evenly spaced ticks, and the short text of each without it.

    Neighbours differ in their text. The offset is 0, or a round number where ticks would need more
    than `TICK_DIGITS` digits because they are far from 0, as in map coordinates.
    """
    values = np.asarray(ticks, float)
    if len(values) < 2:
        return 0.0, name_ticks(values)
    span, largest = float(values[-1] - values[0]), float(np.abs(values).max())
    digits = math.log10(max(largest, 1.0)) + max(_places(values), 0)
    # Within ten spans of 0 an offset would save one digit, and is not worth its label.
    if largest <= 10 * span or digits < TICK_DIGITS:
        return 0.0, name_ticks(values)
    # The smallest power of ten not below the span, by a logarithm that rounding may raise.
    unit = 10.0 ** math.ceil(math.log10(span) - 1e-9)
    offset = math.floor(values[0] / unit + 1e-6) * unit
    return offset, name_ticks(values - offset)


def name_ticks(values: Float[np.ndarray, " n"]) -> list[str]:
    """The text of evenly spaced ticks, with the decimal places that their step needs."""
    if len(values) < 2:
        return [f"{value:.{TICK_DIGITS}g}" for value in values]
    places, largest = _places(values), float(np.abs(values).max())
    # + 0.0: no minus before a zero
    # a sum of steps that passes 0 misses it by rounding
    values = np.where(np.abs(values) < 1e-6 * (values[1] - values[0]), 0.0, values) + 0.0
    if 1e-4 <= largest < 10.0**TICK_DIGITS:  # as Python's format `g`, which needs no exponent there
        return [f"{value:.{max(places, 0)}f}" for value in values]
    exponent = math.floor(math.log10(largest) + 1e-9)  # one for all ticks of an axis
    decimals = max(exponent + places, 0)
    return [
        f"{value / 10.0**exponent:.{decimals}f}e{exponent:+03d}" if value else "0"
        for value in values
    ]


def _places(values: Float[np.ndarray, " n"]) -> int:
    """Decimal places of the step, which is 1, 2, 2.5 or 5 times a power of ten; negative for tens,
    hundreds, …"""
    step = float(values[1] - values[0])
    digits = -math.floor(math.log10(step) + 1e-9)
    scaled = step * 10.0**digits
    return digits if abs(scaled - round(scaled)) < 1e-3 else digits + 1


def offset_in_words(offset: float) -> str:
    """What is to be added to the ticks of an axis, for its label; digits in groups of three."""
    return f" ({offset:+,.12g})".replace(",", " ").replace("-", "−") if offset else ""


def label_coordinates(ax: "Axes", axis: str, unit: str) -> None:
    """The label and the ticks of a coordinate axis in the limits it has: X, Y or Z."""
    from matplotlib.ticker import Formatter

    coordinate_axis = getattr(ax, f"{axis}axis")
    low, high = sorted(coordinate_axis.get_view_interval())
    offset, _ = label_ticks(
        [tick for tick in coordinate_axis.get_majorticklocs() if low <= tick <= high]
    )

    class WithoutOffset(Formatter):
        def __call__(self, value: float, _: int | None = None) -> str:
            """The whole coordinate, at the pointer."""
            return f"{value:.10g}"

        def format_ticks(self, values: Sequence[float]) -> list[str]:
            return name_ticks(np.array(values) - offset)

    coordinate_axis.set_major_formatter(WithoutOffset())
    label(ax, axis, axis.upper(), unit)
    coordinate_axis.set_label_text(coordinate_axis.get_label_text() + offset_in_words(offset))
