"""Quality of a calibration: distribution of measured points, uncertainty of a projected point."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxbundle.plotting.style import (
    BLUE,
    GREY,
    INK,
    RUST,
    axes,
    label,
    legend,
    quiet,
    title,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.contour import QuadContourSet

    from jaxbundle.calibration.quality import Coverage, UncertaintyMap


def _frame(ax: "Axes", image_size: tuple[int, int]) -> None:
    """An image's frame and axes, v down."""
    w, h = image_size
    ax.set_xlim(-0.5, w - 0.5)
    ax.set_ylim(h - 0.5, -0.5)
    ax.set_aspect("equal")
    quiet(ax, grid=False)
    label(ax, "x", "u", "px")
    label(ax, "y", "v", "px")


def coverage_map(
    coverage: "Coverage",
    uv: Float[np.ndarray, "n 2"],
    image_size: tuple[int, int],
    name: str = "camera",
    ax: "Axes | None" = None,
) -> "Axes":
    """Points measured in all photographs [n, 2], and their number in each cell of the image.

    **Returns:** matplotlib `Axes`, pixels.
    """
    ax = axes(ax, (7, 5.6))
    w, h = image_size
    drawn_map = ax.imshow(
        np.ma.masked_equal(coverage.counts, 0),
        cmap="Blues",
        vmin=0,
        alpha=0.85,
        extent=(-0.5, w - 0.5, h - 0.5, -0.5),
        interpolation="nearest",
    )
    ax.plot(*uv.T, ".", color=INK, markersize=1.2, alpha=0.5)
    _frame(ax, image_size)
    bar = ax.figure.colorbar(drawn_map, ax=ax, shrink=0.8, pad=0.02)
    bar.set_label("points in a cell", fontsize=9, color=INK)
    bar.ax.tick_params(labelsize=8)
    missing_corners = [corner for corner, is_there in coverage.corners.items() if not is_there]
    detail = f"{100 * coverage.part:.0f} % of the cells hold points"
    detail += f"; none in the {', '.join(missing_corners)} corner" if missing_corners else ""
    title(ax, f"Camera {name}: coverage", detail)
    return ax


def _smooth(
    u: np.ndarray, v: np.ndarray, sigma: Float[np.ndarray, "rows columns"], times: int = 8
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """σ over a finer grid: a cubic spline of its logarithm, if it is known everywhere."""
    if not (np.isfinite(sigma) & (sigma > 0)).all() or min(sigma.shape) < 4:
        return u, v, sigma
    from scipy.interpolate import RectBivariateSpline

    spline = RectBivariateSpline(v, u, np.log(sigma))
    fine = [np.linspace(a[0], a[-1], times * (len(a) - 1) + 1) for a in (u, v)]
    return *fine, np.exp(spline(fine[1], fine[0]))


def _label_places(lines: "QuadContourSet", size: np.ndarray) -> list[tuple[float, ...]]:
    """Where the contours have their labels: in the middle of the longest piece of each, away from
    the frame of the image and from one another."""
    # Two digits of σ, 7 points high, are about 0.08 of an image as wide as the figure.
    margin, places = 0.08 * size, []
    for pieces in lines.allsegs:
        for vertices in sorted(pieces, key=len, reverse=True)[:1]:
            is_inside = ((vertices > margin) & (vertices < size - 1 - margin)).all(1)
            is_apart = [np.abs((vertices - place) / margin).max(1) > 1 for place in places]
            good = vertices[np.all([is_inside, *is_apart], axis=0)]
            if len(good):
                places.append(tuple(good[len(good) // 2]))
    return places


def uncertainty_image(
    uncertainty: "UncertaintyMap",
    image_size: tuple[int, int],
    unit: str = "m",
    name: str = "camera",
    ax: "Axes | None" = None,
) -> "Axes":
    """σ of a projected point over the image, with the larger axis of its error ellipse.

    **Returns:** matplotlib `Axes`, pixels.
    """
    ax = axes(ax, (7, 5.6))
    from matplotlib.colors import LogNorm

    sigma = uncertainty.sigma
    finite = sigma[np.isfinite(sigma)]
    low = 0.02  # px: a logarithmic scale has an end even if no σ is known
    if len(finite):
        low = max(float(finite.min(initial=np.inf)), low / 10)  # nor does it reach a σ of 0
    high = max(float(finite.max(initial=0.0)), 1.01 * low)
    u, v = uncertainty.uv[0, :, 0], uncertainty.uv[:, 0, 1]
    levels = np.geomspace(low, high, 13)
    u, v, sigma = _smooth(u, v, sigma)
    contours = ax.contourf(
        u,
        v,
        np.ma.masked_invalid(sigma),
        levels,
        cmap="viridis",
        norm=LogNorm(low, high),
        extend="both",
    )
    lines = ax.contour(
        u, v, np.ma.masked_invalid(sigma), levels[2:-1:3], colors="white", linewidths=0.7
    )
    places = _label_places(lines, np.array(image_size))
    if places:
        ax.clabel(lines, fmt="%.2g", fontsize=7, manual=places)
    _frame(ax, image_size)
    bar = ax.figure.colorbar(contours, ax=ax, shrink=0.8, pad=0.02, format="%.2g")
    bar.set_label("σ of a projected point [px]", fontsize=9, color=INK)
    bar.ax.tick_params(labelsize=8)
    where = {
        "scene": f"points at {uncertainty.distance:.3g} {unit}, held in the scene",
        "rotation": "rays, the implied rotation removed",
        "camera": "rays held in the camera frame",
        "rig": f"points at {uncertainty.distance:.3g} {unit}, held in the rig",
    }[uncertainty.frame]
    if np.isinf(uncertainty.distance) and uncertainty.frame in ("scene", "rig"):
        where = f"points at infinity, held in the {uncertainty.frame}"
    title(ax, f"Camera {name}: uncertainty of projection", where)
    return ax


def uncertainty_curve(
    distances: Float[np.ndarray, " n"],
    middle: Float[np.ndarray, " n"],
    corners: Float[np.ndarray, " n"],
    range_: tuple[float, float] | None = None,
    unit: str = "m",
    name: str = "camera",
    ax: "Axes | None" = None,
    reported: Sequence[np.ndarray] | None = None,
) -> "Axes":
    """σ of a projected point over its distance, in the middle and in the corners of the image.

    **Arguments:** `range_`: nearest and farthest distance of the object the camera was calibrated
    from, drawn as a band; `reported`: distances, middle and corners [n] each that a report states,
    marked.

    **Returns:** matplotlib `Axes`: pixels over the object unit, both logarithmic.
    """
    ax = axes(ax, (6.5, 4.2))
    if range_ is not None:
        ax.axvspan(*range_, color=GREY, alpha=0.2, linewidth=0, label="distances of the board")
    ax.loglog(distances, middle, color=BLUE, linewidth=1.5, label="middle of the image")
    if np.isfinite(corners).any():  # A wide lens may have no rays there.
        ax.loglog(distances, corners, color=RUST, linewidth=1.5, label="worst corner")
    if reported is not None:
        distance, *sigma_of_both = reported
        for values, colour in zip(sigma_of_both, (BLUE, RUST)):
            has_sigma, is_finite = np.isfinite(values), np.isfinite(distance)
            ax.plot(
                distance[is_finite & has_sigma],
                values[is_finite & has_sigma],
                "o",
                color=colour,
                markersize=5,
            )
            for x, y in zip(distance[is_finite & has_sigma], values[is_finite & has_sigma]):
                ax.annotate(
                    f"{y:.3g}",
                    (x, y),
                    xytext=(5, 5),
                    textcoords="offset points",
                    fontsize=7,
                    color=colour,
                )
            for y in values[has_sigma & ~is_finite]:
                ax.axhline(y, color=colour, linewidth=0.8, linestyle=":")
                ax.annotate(
                    f"{y:.3g} at infinity",
                    (1, y),
                    xycoords=("axes fraction", "data"),
                    xytext=(-4, 3),
                    textcoords="offset points",
                    ha="right",
                    fontsize=7,
                    color=colour,
                )
    quiet(ax)
    label(ax, "x", "distance", unit)
    label(ax, "y", "σ of a projected point", "px")
    title(ax, f"Camera {name}: uncertainty over distance")
    legend(ax)
    return ax
