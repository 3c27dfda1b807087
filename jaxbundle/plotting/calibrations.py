"""Calibrations without an adjustment: distortion curves, the difference of two as a map."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxbundle.cameras.compare import Comparison
from jaxbundle.plotting.style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    RUST,
    axes,
    image_axes,
    label,
    legend,
    micrometres,
    plain,
    quiet,
    round_number,
    title,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def radial_curves(
    tables: Mapping[str, Mapping[str, np.ndarray]], unit: str, ax: "Axes | None" = None
) -> "Axes":
    """Radial distortion of cameras over the radius; matplotlib axes.

    **Arguments:** `tables` by name, from `jaxbundle.cameras.distortion_table`, all in
    `unit`.
    """
    ax = axes(ax, (6.5, 4.2))
    factor, small = micrometres(unit)
    colours, styles = (BLUE, RUST, GREEN, INK), ("-", "--", ":")
    for k, (name, table) in enumerate(tables.items()):
        style = styles[k // len(colours) % len(styles)]
        r, dr = (np.concatenate([[0.0], table[key]]) for key in ("r", "radial"))
        ax.plot(r, factor * dr, style, color=colours[k % len(colours)], label=plain(name), lw=1.4)
    ax.axhline(0, color=GREY, lw=0.8)
    quiet(ax)
    label(ax, "x", "radius in the measured image", unit)
    label(ax, "y", "measured − ideal", small)
    legend(ax)
    title(ax, "Radial distortion")
    return ax


def difference_map(
    comparison: Comparison, ax: "Axes | None" = None, name: str = "Difference of two calibrations"
) -> "Axes":
    """Lengths of the differences in colour, the differences as arrows; matplotlib axes.

    Every other point of the grid has an arrow; the key gives their scale.
    """
    ax = axes(ax, (7.5, 6))
    factor, unit = micrometres(comparison.unit)
    _draw_map(ax, comparison, factor * comparison.length, f"length of the difference [{unit}]")
    every_second = np.s_[::2, ::2]
    is_known = np.isfinite(comparison.length[every_second])
    x, y = (grid[every_second][is_known] for grid in np.meshgrid(comparison.x, comparison.y))
    u, v = np.moveaxis(factor * comparison.difference[every_second][is_known], -1, 0)
    key = round_number(factor * comparison.largest)
    arrows = ax.quiver(
        x, y, u, v, angles="xy", color="white", scale=12 * key, scale_units="width", width=0.002
    )
    ax.quiverkey(
        arrows, 0.9, 1.02, key, f"{key:g} {unit}", labelpos="E", color=INK, coordinates="axes"
    )
    rotation_note = ", rotation removed" if comparison.rotation.any() else ""
    title(ax, name, f"RMS {factor * comparison.rms:.3g} {unit}{rotation_note}")
    return ax


def expected_map(
    comparison: Comparison,
    covariance: Float[np.ndarray, "rows columns 2 2"],
    ax: "Axes | None" = None,
    name: str = "Expected by their σ",
) -> "Axes":
    """σ of the length of a difference over the image, √(σx² + σy²); matplotlib axes.

    **Arguments:** `covariance` [rows, columns, 2, 2] of the differences, from
    `jaxbundle.adjustment.quality.expected_difference.expected_difference`.
    """
    ax = axes(ax, (7.5, 6))
    factor, unit = micrometres(comparison.unit)
    sigma = factor * np.sqrt(np.trace(covariance, axis1=2, axis2=3))
    _draw_map(ax, comparison, sigma, f"σ of the difference [{unit}]")
    title(ax, name, f"RMS {np.sqrt(np.nanmean(sigma**2)):.3g} {unit}")
    return ax


def _draw_map(
    ax: "Axes", comparison: Comparison, values: Float[np.ndarray, "rows columns"], name: str
) -> None:
    """Values on the grid of a comparison in colour, oriented like the image."""
    mesh = ax.pcolormesh(comparison.x, comparison.y, values, shading="nearest", cmap="viridis")
    label(ax.figure.colorbar(mesh, ax=ax, shrink=0.8).ax, "y", name)
    if comparison.unit == "px":
        ax.invert_yaxis()  # rows are counted downwards
    ax.set_aspect("equal")
    quiet(ax, grid=False)
    image_axes(ax, comparison.unit)


def difference_maps(
    comparison: Comparison, covariance: Float[np.ndarray, "rows columns 2 2"] | None, ax: "Axes"
) -> "Axes":
    """The difference map, and beside it the expected differences if there is a covariance."""
    if covariance is None:
        return difference_map(comparison, ax)
    figure = ax.figure
    ax.remove()  # its place goes to the two
    left_axes, right_axes = figure.subplots(1, 2)
    difference_map(comparison, left_axes)
    return expected_map(comparison, covariance, right_axes)
