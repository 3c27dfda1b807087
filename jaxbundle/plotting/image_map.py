"""Values over an image of a line scanner, as colours."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxbundle.plotting.style import axes, label, quiet, title

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def image_map(
    lines: Float[np.ndarray, " rows"],
    pixels: Float[np.ndarray, " columns"],
    values: Float[np.ndarray, "rows columns"],
    name: str,
    unit: str = "m",
    detail: str = "",
    ax: "Axes | None" = None,
) -> "Axes":
    """Values at lines × pixels in colour, line 0 at the top; matplotlib axes."""
    ax = axes(ax, (7.5, 6))
    mesh = ax.pcolormesh(pixels, lines, values, shading="nearest", cmap="viridis")
    bar = ax.figure.colorbar(mesh, ax=ax, shrink=0.8)
    label(bar.ax, "y", name, unit)
    ax.invert_yaxis()
    quiet(ax, grid=False)
    label(ax, "x", "pixel")
    label(ax, "y", "line")
    title(ax, name, detail)
    return ax
