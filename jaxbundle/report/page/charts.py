"""Charts as SVG, which print and need no script: line styles and hatching distinguish curves
without colours."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxbundle.plotting.ticks import label_ticks, offset_in_words
from jaxbundle.report.layout import significant
from jaxbundle.report.page.markup import text

WIDE, HIGH = 640, 300
LEFT, RIGHT, TOP, BOTTOM = 70, 15, 15, 45


class Curve(NamedTuple):
    """A line through x, y, with a band of y ± sigma around it; `kind` is its class of style."""

    label: str
    x: np.ndarray
    y: np.ndarray
    sigma: np.ndarray | None = None
    kind: str = "first"


class Scale(NamedTuple):
    """From numbers to positions in the drawing."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value):
        return self.start + (np.asarray(value, float) - self.low) / (self.high - self.low) * (
            self.end - self.start
        )


def draw_curves(
    curves: Sequence[Curve],
    x_label: str,
    y_label: str,
    logarithmic: str = "",
    mark: tuple[float, str] | None = None,
) -> str:
    """Curves over a common x; `logarithmic`: the axes, of x and y, whose values are log10 of what
    they say; `mark`: an x with a vertical line, and its name."""
    reach = [
        np.concatenate([c.y - band, c.y + band])
        for c in curves
        for band in [np.nan_to_num(0 if c.sigma is None else c.sigma)]
    ]
    xs, ys = np.concatenate([c.x for c in curves]), np.concatenate(reach)
    x, y = _scale(xs, LEFT, WIDE - RIGHT), _scale(ys, HIGH - BOTTOM, TOP, 0.05)
    parts = [_axes(x, y, x_label, y_label, logarithmic)]
    if mark is not None:
        at = float(x(mark[0]))
        parts.append(
            f'<line class="mark" x1="{at:.1f}" x2="{at:.1f}" y1="{TOP}" y2="{HIGH - BOTTOM}"/>\n'
        )
    for curve in curves:
        if curve.sigma is not None:
            ends = np.concatenate([curve.y - curve.sigma, (curve.y + curve.sigma)[::-1]])
            outline = _places(x, y, np.concatenate([curve.x, curve.x[::-1]]), ends)
            parts.append(f'<polygon class="band {curve.kind}" points="{outline}"/>\n')
        line = _places(x, y, curve.x, curve.y)
        parts.append(f'<polyline class="{curve.kind}" points="{line}"/>\n')
    return _svg(parts) + _legend(
        [(c.kind, c.label) for c in curves], None if mark is None else mark[1]
    )


def draw_plan(lines: Sequence[Curve], x_label: str, y_label: str, down: bool = False) -> str:
    """Lines in a plane, both axes at one scale; `down`: y grows downwards. Lines of the same label
    have one sample."""
    xs, ys = (np.concatenate([getattr(line, name) for line in lines]) for name in ("x", "y"))
    ends = [_scale(v, 0, 1, 0.03) for v in (xs, ys)]
    room = WIDE - RIGHT - LEFT, HIGH - BOTTOM - TOP
    unit = max((end.high - end.low) / size for end, size in zip(ends, room))
    # The remaining space is shared by both sides.
    low = [(end.low + end.high - unit * size) / 2 for end, size in zip(ends, room)]
    top, bottom = (HIGH - BOTTOM, TOP) if not down else (TOP, HIGH - BOTTOM)
    x = Scale(low[0], low[0] + unit * room[0], LEFT, WIDE - RIGHT)
    y = Scale(low[1], low[1] + unit * room[1], top, bottom)
    parts = [_axes(x, y, x_label, y_label)]
    parts += [
        f'<polyline class="{line.kind}" points="{_places(x, y, line.x, line.y)}"/>\n'
        for line in lines
    ]
    return _svg(parts) + _legend([*dict.fromkeys((line.kind, line.label) for line in lines)])


def draw_histogram(
    edges: np.ndarray,
    counted: np.ndarray,
    x_label: str,
    things: str,
    expected: np.ndarray | None = None,
) -> str:
    """Counts by class as bars, with the expectation of a normal distribution as steps; an
    outer class whose edge is infinite is open, and drawn as wide as its neighbour."""
    ends = np.array(edges, float)
    if np.isinf(ends[0]):
        ends[0] = 2 * ends[1] - ends[2]
    if np.isinf(ends[-1]):
        ends[-1] = 2 * ends[-2] - ends[-3]
    x = Scale(ends[0], ends[-1], LEFT, WIDE - RIGHT)
    tallest = max(counted.max(initial=1), 0 if expected is None else expected.max(initial=1))
    y = _scale(np.array([0.0, tallest]), HIGH - BOTTOM, TOP)
    base = float(y(0))
    parts = [_axes(x, y, x_label, things, whole=True)]
    parts += [
        f'<rect class="bar" x="{x(a):.1f}" y="{y(n):.1f}" width="{x(b) - x(a):.1f}" '
        f'height="{base - y(n):.1f}"/>\n'
        for a, b, n in zip(ends, ends[1:], counted)
    ]
    names = [("bar", things)]
    if expected is not None:
        steps = _places(x, y, np.repeat(ends, 2)[1:-1], np.repeat(expected, 2))
        parts.append(f'<polyline class="second" points="{steps}"/>\n')
        names.append(("second", "normal distribution"))
    return _svg(parts) + _legend(names)


def draw_field(values: np.ndarray, digits: int = 2) -> str:
    """Numbers in the cells of an image, row by row from its top, the larger the darker; a cell
    without a number is empty. `digits`: significant ones; 0: whole numbers."""
    rows, columns = values.shape
    wide, high = WIDE / columns, HIGH / rows
    there = np.isfinite(values)
    low, top = (values[there].min(), values[there].max()) if there.any() else (0.0, 1.0)
    shade = 0.6 * (values - low) / (top - low or 1.0)
    parts = []
    for i, j in np.argwhere(there):
        x, y = j * wide, i * high
        parts.append(
            f'<rect class="cell" x="{x:.1f}" y="{y:.1f}" width="{wide:.1f}" height="{high:.1f}" '
            f'fill-opacity="{shade[i, j]:.2f}"/>\n<text x="{x + wide / 2:.1f}" '
            f'class="number" y="{y + high / 2 + 4:.1f}" text-anchor="middle">'
            f"{_cell(float(values[i, j]), digits)}</text>\n"
        )
    return _svg([*parts, f'<rect class="frame" width="{WIDE}" height="{HIGH}"/>\n'])


def _cell(value: float, digits: int) -> str:
    return f"{value:.0f}" if digits == 0 else significant(value, digits)


def _scale(values: np.ndarray, start: float, end: float, margin: float = 0.0) -> Scale:
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    spread = high - low or abs(high) or 1.0
    low, high = low - margin * spread, high + margin * spread
    # less than this of the value is its rounding, for which ticks have no digits
    least = 1e-9 * max(abs(low), abs(high))
    if high - low < least:
        low, high = low - least / 2, high + least / 2
    return Scale(low, high if high > low else low + spread, start, end)


class Ticks(NamedTuple):
    """Ticks of an axis: their places on its scale, their short names, and the addition to the label
    of the axis."""

    places: np.ndarray
    names: list[str]
    offset: str = ""


def _ticks(scale: Scale, logarithmic: bool, whole: bool = False) -> Ticks:
    """About five ticks within a scale; `whole`: whole ones where it has at least two."""
    if not logarithmic:
        values = _round_values(scale.low, scale.high, whole)
        offset, names = label_ticks(values)
        return Ticks(values, names, offset_in_words(offset))
    if scale.high - scale.low < 1:  # within a decade the powers of ten say nothing
        values = _round_values(10.0**scale.low, 10.0**scale.high)
        offset, names = label_ticks(values)
        return Ticks(np.log10(values), names, offset_in_words(offset))
    decades = np.arange(np.floor(scale.low), scale.high, np.ceil((scale.high - scale.low) / 6))
    powers = np.add.outer(decades, np.log10([1, 2, 5] if scale.high - scale.low < 3 else [1]))
    powers = powers[(powers >= scale.low) & (powers <= scale.high)]
    return Ticks(powers, [f"{10.0**power:.6g}" for power in powers])


def _round_values(low: float, high: float, whole: bool = False) -> np.ndarray:
    """About five round numbers between two; `whole`: whole ones where there are at least two."""
    rough = (high - low) / 5
    if whole and np.floor(high) > np.ceil(low):
        rough = max(rough, 1.0)
    power = 10.0 ** np.floor(np.log10(rough))
    step = next(s * power for s in (1, 2, 5, 10) if s * power >= rough * (1 - 1e-9))
    first = np.ceil(low / step - 1e-9)
    return step * np.arange(first, np.floor(high / step + 1e-9) + 1)


def _axes(
    x: Scale, y: Scale, x_label: str, y_label: str, logarithmic: str = "", whole: bool = False
) -> str:
    """Axes with their ticks; `whole`: y counts."""
    parts = []
    across = _ticks(x, "x" in logarithmic)
    for at, name in zip(x(across.places), across.names):
        parts.append(
            f'<line class="grid" x1="{at:.1f}" x2="{at:.1f}" y1="{TOP}" '
            f'y2="{HIGH - BOTTOM}"/>\n'
            f'<text class="tick" x="{at:.1f}" y="{HIGH - BOTTOM + 16}" '
            f'text-anchor="middle">{name}</text>\n'
        )
    up = _ticks(y, "y" in logarithmic, whole)
    for at, name in zip(y(up.places), up.names):
        parts.append(
            f'<line class="grid" x1="{LEFT}" x2="{WIDE - RIGHT}" y1="{at:.1f}" '
            f'y2="{at:.1f}"/>\n'
            f'<text class="tick" x="{LEFT - 6}" y="{at + 4:.1f}" '
            f'text-anchor="end">{name}</text>\n'
        )
    middle = (TOP + HIGH - BOTTOM) / 2
    parts.append(
        f'<text x="{(LEFT + WIDE - RIGHT) / 2}" y="{HIGH - 8}" text-anchor="middle">'
        f"{text(x_label + across.offset)}</text>\n"
        f'<text x="14" y="{middle}" text-anchor="middle" '
        f'transform="rotate(-90 14 {middle})">{text(y_label + up.offset)}</text>\n'
    )
    return "".join(parts)


def _places(x: Scale, y: Scale, xs, ys) -> str:
    there = np.isfinite(xs) & np.isfinite(ys)
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x(xs[there]), y(ys[there])))


def _svg(parts: Sequence[str]) -> str:
    return f'<svg viewBox="0 0 {WIDE} {HIGH}" role="img">\n{"".join(parts)}</svg>\n'


def _legend(names: Sequence[tuple[str, str]], mark: str | None = None) -> str:
    """A sample of every line, and its name."""
    rows = [*names, *([] if mark is None else [("mark", mark)])]
    samples = "".join(
        f'<span><svg class="sample" viewBox="0 0 30 10"><{_sample(kind)}/></svg>'
        f"{text(name)}</span>\n"
        for kind, name in rows
    )
    return f'<p class="legend">{samples}</p>\n'


def _sample(kind: str) -> str:
    if kind == "bar":
        return 'rect class="bar" x="5" y="0" width="20" height="10"'
    return f'line class="{kind}" x1="0" x2="30" y1="5" y2="5"'
