"""Charts as SVG, which print and need no script: line styles and hatching distinguish curves
without colours."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.plotting.ticks import label_ticks, offset_in_words
from jaxbundle.report.layout import significant
from jaxbundle.report.page.markup import text


class ChartLayout(NamedTuple):
    """Size of a drawing and of its margins, in the units of its SVG; the page scales it to its
    width, at which a unit is about a CSS pixel.

    `left` holds ticks of seven characters and the turned label of y, `bottom` the ticks and the
    label of x; `right` and `top` half a tick that stands at the end of an axis.
    """

    width: int = 640
    height: int = 300
    left: int = 70
    right: int = 15
    top: int = 15
    bottom: int = 45

    @property
    def plot_right(self) -> int:
        """The right end of the axis of x."""
        return self.width - self.right

    @property
    def plot_bottom(self) -> int:
        """The lower end of the axis of y."""
        return self.height - self.bottom


LAYOUT = ChartLayout()


class Curve(NamedTuple):
    """A line through x, y, with a band of y ± sigma around it; `kind` is its class of style."""

    label: str
    x: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"] | None = None
    kind: str = "first"


class Scale(NamedTuple):
    """From numbers to positions in the drawing."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: float | Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        return self.start + (np.asarray(value, float) - self.low) / (self.high - self.low) * (
            self.end - self.start
        )


def draw_curves(
    curves: Sequence[Curve],
    x_label: str,
    y_label: str,
    logarithmic: str = "",
    mark: tuple[float, str] | None = None,
    layout: ChartLayout = LAYOUT,
) -> str:
    """Curves over a common x; `logarithmic`: the axes, of x and y, whose values are log10 of what
    they say; `mark`: an x with a vertical line, and its name. Curves of one label have one
    sample."""
    reach = [
        np.concatenate([c.y - band, c.y + band])
        for c in curves
        for band in [np.nan_to_num(0 if c.sigma is None else c.sigma)]
    ]
    xs, ys = np.concatenate([c.x for c in curves]), np.concatenate(reach)
    x = _scale(xs, layout.left, layout.plot_right)
    y = _scale(ys, layout.plot_bottom, layout.top, 0.05)
    parts = [_axes(x, y, x_label, y_label, layout, logarithmic)]
    if mark is not None:
        where = float(x(mark[0]))
        parts.append(
            f'<line class="mark" x1="{where:.1f}" x2="{where:.1f}" y1="{layout.top}" '
            f'y2="{layout.plot_bottom}"/>\n'
        )
    for curve in curves:
        if curve.sigma is not None:
            ends = np.concatenate([curve.y - curve.sigma, (curve.y + curve.sigma)[::-1]])
            outline = _places(x, y, np.concatenate([curve.x, curve.x[::-1]]), ends)
            parts.append(f'<polygon class="band {curve.kind}" points="{outline}"/>\n')
        line = _places(x, y, curve.x, curve.y)
        parts.append(f'<polyline class="{curve.kind}" points="{line}"/>\n')
    return _svg(parts, layout) + _legend(
        [*dict.fromkeys((c.kind, c.label) for c in curves)], None if mark is None else mark[1]
    )


def draw_plan(
    lines: Sequence[Curve],
    x_label: str,
    y_label: str,
    y_down: bool = False,
    layout: ChartLayout = LAYOUT,
) -> str:
    """Lines in a plane, both axes at one scale; `y_down`: y grows downwards. Lines of the same
    label have one sample."""
    xs, ys = (np.concatenate([getattr(line, name) for line in lines]) for name in ("x", "y"))
    ends = [_scale(v, 0, 1, 0.03) for v in (xs, ys)]
    room = layout.plot_right - layout.left, layout.plot_bottom - layout.top
    unit = max((end.high - end.low) / size for end, size in zip(ends, room))
    # The remaining space is shared by both sides.
    low = [(end.low + end.high - unit * size) / 2 for end, size in zip(ends, room)]
    ends_of_y = (layout.plot_bottom, layout.top)  # SVG counts y from above
    start, end = ends_of_y[::-1] if y_down else ends_of_y
    x = Scale(low[0], low[0] + unit * room[0], layout.left, layout.plot_right)
    y = Scale(low[1], low[1] + unit * room[1], start, end)
    parts = [_axes(x, y, x_label, y_label, layout)]
    parts += [
        f'<polyline class="{line.kind}" points="{_places(x, y, line.x, line.y)}"/>\n'
        for line in lines
    ]
    names = [*dict.fromkeys((line.kind, line.label) for line in lines)]
    return _svg(parts, layout) + _legend(names)


def draw_histogram(
    edges: Float[np.ndarray, " edges"],
    counted: Int[np.ndarray, " classes"],
    x_label: str,
    y_label: str,
    expected: Float[np.ndarray, " classes"] | None = None,
    layout: ChartLayout = LAYOUT,
) -> str:
    """Counts by class as bars, with the expectation of a normal distribution as steps; an
    outer class whose edge is infinite is open, and drawn as wide as its neighbour."""
    ends = np.array(edges, float)
    if np.isinf(ends[0]):
        ends[0] = 2 * ends[1] - ends[2]
    if np.isinf(ends[-1]):
        ends[-1] = 2 * ends[-2] - ends[-3]
    x = Scale(ends[0], ends[-1], layout.left, layout.plot_right)
    tallest = max(counted.max(initial=1), 0 if expected is None else expected.max(initial=1))
    y = _scale(np.array([0.0, tallest]), layout.plot_bottom, layout.top)
    base = float(y(0))
    parts = [_axes(x, y, x_label, y_label, layout, whole_numbers=True)]
    parts += [
        f'<rect class="bar" x="{x(a):.1f}" y="{y(n):.1f}" width="{x(b) - x(a):.1f}" '
        f'height="{base - y(n):.1f}"/>\n'
        for a, b, n in zip(ends, ends[1:], counted)
    ]
    names = [("bar", y_label)]
    if expected is not None:
        steps = _places(x, y, np.repeat(ends, 2)[1:-1], np.repeat(expected, 2))
        parts.append(f'<polyline class="second" points="{steps}"/>\n')
        names.append(("second", "normal distribution"))
    return _svg(parts, layout) + _legend(names)


def draw_field(
    values: Float[np.ndarray, "rows columns"], digits: int = 2, layout: ChartLayout = LAYOUT
) -> str:
    """Numbers in the cells of an image, row by row from its top, the larger the darker; a cell
    without a number is empty. `digits`: significant ones; 0: whole numbers."""
    rows, columns = values.shape
    wide, high = layout.width / columns, layout.height / rows
    is_finite = np.isfinite(values)
    low, top = (values[is_finite].min(), values[is_finite].max()) if is_finite.any() else (0.0, 1.0)
    shade = 0.6 * (values - low) / (top - low or 1.0)  # the numbers stay legible on the darkest
    format_cell = lambda value: f"{value:.0f}" if digits == 0 else significant(value, digits)
    parts = []
    for i, j in np.argwhere(is_finite):
        x, y = j * wide, i * high
        parts.append(
            f'<rect class="cell" x="{x:.1f}" y="{y:.1f}" width="{wide:.1f}" height="{high:.1f}" '
            f'fill-opacity="{shade[i, j]:.2f}"/>\n<text x="{x + wide / 2:.1f}" '
            f'class="number" y="{y + high / 2 + 4:.1f}" text-anchor="middle">'
            f"{format_cell(float(values[i, j]))}</text>\n"
        )
    frame = f'<rect class="frame" width="{layout.width}" height="{layout.height}"/>\n'
    return _svg([*parts, frame], layout)


def _scale(values: np.ndarray, start: float, end: float, margin: float = 0.0) -> Scale:
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    extent = high - low or abs(high) or 1.0
    low, high = low - margin * extent, high + margin * extent
    # Less than this of the value is its rounding, for which ticks have no digits.
    smallest_extent = 1e-9 * max(abs(low), abs(high))
    if high - low < smallest_extent:
        low, high = low - smallest_extent / 2, high + smallest_extent / 2
    return Scale(low, high if high > low else low + extent, start, end)


class Ticks(NamedTuple):
    """Ticks of an axis: their places on its scale, their short names, and the addition to the label
    of the axis."""

    places: np.ndarray
    names: list[str]
    offset: str = ""


def _ticks(scale: Scale, logarithmic: bool, whole_numbers: bool = False) -> Ticks:
    """About five ticks within a scale; `whole_numbers`: whole ones where it has at least two."""
    if not logarithmic:
        values = _round_values(scale.low, scale.high, whole_numbers)
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


def _round_values(low: float, high: float, whole_numbers: bool = False) -> np.ndarray:
    """About five round numbers between two; `whole_numbers`: whole ones where there are at least
    two."""
    rough = (high - low) / 5
    if whole_numbers and np.floor(high) > np.ceil(low):
        rough = max(rough, 1.0)
    power = 10.0 ** np.floor(np.log10(rough))
    step = next(s * power for s in (1, 2, 5, 10) if s * power >= rough * (1 - 1e-9))
    first_value = np.ceil(low / step - 1e-9)
    return step * np.arange(first_value, np.floor(high / step + 1e-9) + 1)


def _axes(
    x: Scale,
    y: Scale,
    x_label: str,
    y_label: str,
    layout: ChartLayout,
    logarithmic: str = "",
    whole_numbers: bool = False,
) -> str:
    """Axes with their ticks; `whole_numbers`: y counts."""
    parts = []
    left, right = layout.left, layout.plot_right
    top, bottom = layout.top, layout.plot_bottom
    ticks_x = _ticks(x, "x" in logarithmic)
    for tick, name in zip(x(ticks_x.places), ticks_x.names):
        parts.append(
            f'<line class="grid" x1="{tick:.1f}" x2="{tick:.1f}" y1="{top}" '
            f'y2="{bottom}"/>\n'
            f'<text class="tick" x="{tick:.1f}" y="{bottom + 16}" '
            f'text-anchor="middle">{name}</text>\n'
        )
    ticks_y = _ticks(y, "y" in logarithmic, whole_numbers)
    for tick, name in zip(y(ticks_y.places), ticks_y.names):
        parts.append(
            f'<line class="grid" x1="{left}" x2="{right}" y1="{tick:.1f}" '
            f'y2="{tick:.1f}"/>\n'
            f'<text class="tick" x="{left - 6}" y="{tick + 4:.1f}" '
            f'text-anchor="end">{name}</text>\n'
        )
    middle = (top + bottom) / 2
    parts.append(
        f'<text x="{(left + right) / 2}" y="{layout.height - 8}" text-anchor="middle">'
        f"{text(x_label + ticks_x.offset)}</text>\n"
        f'<text x="14" y="{middle}" text-anchor="middle" '
        f'transform="rotate(-90 14 {middle})">{text(y_label + ticks_y.offset)}</text>\n'
    )
    return "".join(parts)


def _places(x: Scale, y: Scale, xs: Float[np.ndarray, " n"], ys: Float[np.ndarray, " n"]) -> str:
    is_finite = np.isfinite(xs) & np.isfinite(ys)
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x(xs[is_finite]), y(ys[is_finite])))


def _svg(parts: Sequence[str], layout: ChartLayout) -> str:
    size = f"{layout.width} {layout.height}"
    return f'<svg viewBox="0 0 {size}" role="img">\n{"".join(parts)}</svg>\n'


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
