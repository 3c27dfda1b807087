"""Common parts of all figures: axes, colours, lengths of bars, text from files.

matplotlib is imported by the drawing functions, so that the package works without it.
"""

import math
import textwrap
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import ArrayLike

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from mpl_toolkits.mplot3d import Axes3D

INK = "#26323c"
GREY = "#8d979f"
PALE = "#d5dade"
BLUE = "#2c6089"
RUST = "#c2512f"
GREEN = "#4c8267"

ROLE_STYLE = {
    "tie": {"color": BLUE, "marker": "o", "s": 12},
    "control": {"color": RUST, "marker": "^", "s": 42},
    "fixed": {"color": INK, "marker": "s", "s": 26},
    "check": {"color": GREEN, "marker": "D", "s": 26},
}
# Maximum number of points of a plan with ids, half of them images: their lines of 7 points fit
# along an axis of 6 inches with half a line between them.
MAX_LABELS = 40


def need_matplotlib() -> ModuleType:
    """matplotlib, or an error that says what to install."""
    try:
        import matplotlib
    except ImportError as error:
        raise ImportError("figures need matplotlib: pip install 'jaxbundle[plots]'") from error
    return matplotlib


def axes(ax: "Axes | None", size: tuple[float, float]) -> "Axes":
    """The axes given, or those of a new pyplot figure (shown by notebooks and `plt.show`)."""
    need_matplotlib()
    if ax is None:
        from matplotlib import pyplot

        _, ax = pyplot.subplots(figsize=size, layout="constrained")
    return ax


def axes_3d(ax: "Axes | None", size: tuple[float, float]) -> "Axes3D":
    """The 3D axes given, or those of a new pyplot figure; refuses plane axes."""
    need_matplotlib()
    from mpl_toolkits.mplot3d import Axes3D

    if ax is None:
        from matplotlib import pyplot

        ax = pyplot.figure(figsize=size, layout="constrained").add_subplot(projection="3d")
    if not isinstance(ax, Axes3D):
        raise ValueError('a perspective view needs 3D axes: add_subplot(projection="3d")')
    return ax


def quiet(ax: "Axes", grid: bool = True) -> None:
    """Thin spines, small ticks, a pale grid behind the data."""
    for spine in ax.spines.values():
        spine.set_color(GREY)
        spine.set_linewidth(0.8)
    ax.tick_params(colors=INK, labelsize=8, width=0.8, length=3)
    if grid:
        ax.grid(True, color=PALE, linewidth=0.6)
        ax.set_axisbelow(True)


def quiet_3d(ax: "Axes3D") -> None:
    """Small ticks and a pale grid on blank walls, seen from the front right and above."""
    for name in "xyz":
        axis = getattr(ax, f"{name}axis")
        axis.set_pane_color((1, 1, 1, 0))
        axis._axinfo["grid"].update(color=PALE, linewidth=0.6)  # there is no public way
        ax.tick_params(axis=name, labelsize=7, colors=INK, pad=0)
    ax.view_init(elev=24, azim=-58)


def title(ax: "Axes", text: str, detail: str = "") -> None:
    """A title with lines of detail; names from files are never read as formulas."""
    # 75 letters of 10 points are as wide as a figure
    lines = "\n".join([plain(text), *textwrap.wrap(detail, 75)])
    ax.set_title(lines, fontsize=10, color=INK, loc="left", parse_math=False)


def plain(name: object) -> str:
    """A name from a file on one line; what cannot be printed is a question mark."""
    return "".join(c if c.isprintable() else "?" for c in str(name))


def legend(ax: "Axes", **keywords: Any) -> None:
    """A legend on a pale ground."""
    keywords = {"frameon": True, "framealpha": 0.85, "edgecolor": PALE} | keywords
    ax.legend(fontsize=8, **keywords)


def label(ax: "Axes", axis: str, name: str, unit: str = "") -> None:
    """An axis label with its unit in brackets."""
    text = f"{name} [{plain(unit)}]" if unit else name
    getattr(ax, f"set_{axis}label")(text, fontsize=9, color=INK, parse_math=False)


def image_axes(ax: "Axes", unit: str) -> None:
    """The names of image coordinates: u, v in pixels, else x, y."""
    for axis, name in zip("xy", ("u", "v") if unit == "px" else ("x", "y")):
        label(ax, axis, name, unit)


def round_number(x: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above x."""
    if not (math.isfinite(x) and x > 0):
        return 1.0
    power = 10.0 ** math.floor(math.log10(x))
    # The tolerance keeps 5 at 5 where rounding made it 4.999….
    return max(step * power for step in (1, 2, 5) if step * power <= x * (1 + 1e-12))


def extent(xyz: ArrayLike) -> tuple[np.ndarray, float]:
    """Centre and size of the visible part: far outliers (nearly parallel rays) are ignored."""
    xyz = np.asarray(xyz, float)
    xyz = xyz[np.isfinite(xyz).all(1)]
    if not len(xyz):
        return np.zeros(3), 1.0
    # A few per cent of outliers do not change these quantiles.
    low, middle, high = np.quantile(xyz, [0.02, 0.5, 0.98], axis=0)
    # These quantiles of normally distributed points are 4 σ apart: 12 σ to either side hold all. A
    # network that is flat in one axis is allowed a thousandth of its extent there.
    reach = 3 * np.maximum(high - low, 1e-12 + 1e-3 * (high - low).max())
    near_points = xyz[(np.abs(xyz - middle) <= reach).all(1)]
    near_points = near_points if len(near_points) else xyz
    low, high = near_points.min(0), near_points.max(0)
    return (low + high) / 2, float(max((high - low).max(), 1e-9))


def micrometres(unit: str) -> tuple[float, str]:
    """Small image lengths are shown in µm for measurements in mm."""
    return (1e3, "µm") if unit == "mm" else (1.0, unit)
