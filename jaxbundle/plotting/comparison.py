"""The difference of two calibrations as a map over the image."""

import numpy as np

from jaxbundle.cameras.compare import Comparison
from jaxbundle.plotting.style import INK, axes, label, micrometres, quiet, round_number, title


def difference_map(comparison: Comparison, ax=None, name: str = "Difference of two calibrations"):
    """Lengths of the differences in colour, the differences themselves as arrows; matplotlib axes.

    Every other point of the grid has an arrow; the key says how long one is.
    """
    ax = axes(ax, (7.5, 6))
    factor, unit = micrometres(comparison.unit)
    mesh = ax.pcolormesh(
        comparison.x, comparison.y, factor * comparison.length, shading="nearest", cmap="viridis"
    )
    bar = ax.figure.colorbar(mesh, ax=ax, shrink=0.8)
    label(bar.ax, "y", "length of the difference", unit)
    every = np.s_[::2, ::2]
    known = np.isfinite(comparison.length[every])
    x, y = (grid[every][known] for grid in np.meshgrid(comparison.x, comparison.y))
    u, v = np.moveaxis(factor * comparison.difference[every][known], -1, 0)
    if comparison.unit == "px":
        ax.invert_yaxis()
    key = round_number(factor * comparison.largest) or 1.0
    arrows = ax.quiver(
        x, y, u, v, angles="xy", color="white", scale=12 * key, scale_units="width", width=0.002
    )
    ax.quiverkey(
        arrows, 0.9, 1.02, key, f"{key:g} {unit}", labelpos="E", color=INK, coordinates="axes"
    )
    ax.set_aspect("equal")
    quiet(ax, grid=False)
    for axis in "xy":
        label(ax, axis, axis, comparison.unit)
    title(ax, name, f"RMS {factor * comparison.rms:.3g} {unit}, rotation removed")
    return ax
