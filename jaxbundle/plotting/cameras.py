"""A camera: its distortion over the radius, the correlations of its parameters."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxbundle.plotting.distortion import (
    distortion_profile,
    farthest_measurement,
    principal_point,
)
from jaxbundle.plotting.frame import image_frame
from jaxbundle.plotting.style import (
    BLUE,
    GREY,
    INK,
    RUST,
    axes,
    label,
    legend,
    micrometres,
    quiet,
    title,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from jaxbundle.adjustment.result import Adjustment


def distortion_curve(adjustment: "Adjustment", camera: str, ax: "Axes | None" = None) -> "Axes":
    """Radial distortion and decentring of a camera over the radius, each with its ±σ.

    measured − ideal, so that pincushion distortion is positive for every model; from the
    principal point to the farthest corner of the image, if its size is known; a line marks the
    farthest measurement, beyond which the curve is extrapolated (see `distortion_profile`).

    **Returns:** matplotlib `Axes`; distortion in µm for a camera in mm, else in its unit.
    """
    ax = axes(ax, (6.5, 4.2))
    adjustment.camera_parameters(camera)  # refuses an unknown camera
    measured, reach = curve_reach(adjustment, camera)
    profile = distortion_profile(adjustment, camera, reach=reach)
    scale, unit = micrometres(profile.unit)
    for value, sigma, colour, name in (
        (profile.radial, profile.radial_sigma, BLUE, "symmetric radial"),
        (profile.decentring, profile.decentring_sigma, RUST, "decentring"),
    ):
        if not (np.abs(value) > 0).any() and not (sigma > 0).any() and colour == RUST:
            continue  # a model without decentring
        low, high = scale * (value - sigma), scale * (value + sigma)
        if (sigma > 0).any():
            name += f", σ up to {scale * np.nanmax(sigma):.2g} {unit}"
        ax.fill_between(profile.radius, low, high, color=colour, alpha=0.2, linewidth=0, zorder=2)
        ax.plot(profile.radius, scale * value, color=colour, linewidth=1.5, label=name, zorder=3)
    ax.axhline(0, color=INK, linewidth=0.6, zorder=1)
    if reach > measured:
        ax.axvline(measured, color=GREY, linewidth=0.9, linestyle=":", label="farthest measurement")
    quiet(ax)
    ax.set_xlim(0, profile.radius[-1] or 1.0)
    bottom, top = ax.get_ylim()
    # Rounding, far below 0.1 µm or px, must not look like distortion.
    ax.set_ylim(min(bottom, -0.1), max(top, 0.1))
    label(ax, "x", "distance from the principal point", profile.unit)
    label(ax, "y", "distortion, measured − ideal", unit)
    model = adjustment.cameras[camera]["model"]
    has_sigma = np.nanmax(profile.radial_sigma, initial=0) > 0
    band = "without σ" if not has_sigma else "bands: ±σ (a posteriori)"
    title(ax, f"Camera {camera}: distortion ({model})", band)
    legend(ax)
    return ax


def curve_reach(adjustment: "Adjustment", camera: str) -> tuple[float, float]:
    """Radii of the farthest measurement of a camera and, where the size of the image is known, of
    its farthest corner, if that is farther; in the unit of the model."""
    low, high, is_known = image_frame(adjustment, camera)
    measured = farthest_measurement(adjustment, camera)
    if not is_known:
        return measured, measured
    centre = principal_point(adjustment, camera)
    return measured, max(measured, float(np.hypot(*np.maximum(high - centre, centre - low))))


def correlation_size(parameters: int) -> tuple[float, float]:
    """Width and height of a correlation matrix, inches; the colour bar makes it wider."""
    # 0.42 inches hold a number of three digits; beyond 12 inches the cells shrink
    side = float(np.clip(2.2 + 0.42 * parameters, 4, 12))
    return side + 0.8, side


def correlation_matrix(
    adjustment: "Adjustment", camera: str | None = None, ax: "Axes | None" = None
) -> "Axes":
    """Correlations of the free parameters of a camera, or of all cameras together, in %.

    **Returns:** matplotlib `Axes`.

    **Raises:** `ValueError` if no parameter is free.
    """
    names, C = _correlations(adjustment, camera)
    n = len(names)
    if not n:
        which = "no camera" if camera is None else f"camera {camera!r}: nothing"
        raise ValueError(f"{which} is free: there are no correlations to show")
    ax = axes(ax, correlation_size(n))
    image = ax.imshow(100 * C, cmap="RdBu_r", vmin=-100, vmax=100)
    ax.set_xticks(range(n), names, rotation=90 if n > 8 or camera is None else 0, parse_math=False)
    ax.set_yticks(range(n), names, parse_math=False)
    quiet(ax, grid=False)
    ax.tick_params(length=0)
    if n <= 20:  # in the cells of more, three digits and a sign have no room
        for i in range(n):
            for j in range(n):
                colour = "white" if abs(C[i, j]) > 0.6 else INK
                text = f"{round(100 * C[i, j])}" if np.isfinite(C[i, j]) else "–"
                ax.text(j, i, text, ha="center", va="center", fontsize=7, color=colour)
    bar = ax.figure.colorbar(image, ax=ax, shrink=0.8, pad=0.02)
    bar.set_label("correlation [%]", fontsize=9, color=INK)
    bar.ax.tick_params(labelsize=8, width=0.8, length=3)
    bar.outline.set_visible(False)
    label(ax, "x", "parameter")
    label(ax, "y", "parameter")
    which = adjustment.network.name if camera is None else f"Camera {camera}"
    title(ax, f"{which}: correlations in %")
    return ax


def _correlations(
    adjustment: "Adjustment", camera: str | None
) -> tuple[Sequence[str], Float[np.ndarray, "n n"]]:
    """Names and correlation matrix of the free parameters of one camera or of all."""
    tables = adjustment.cameras
    if camera is None and len(tables) == 1:
        camera = next(iter(tables))
    if camera is not None:
        adjustment.camera_parameters(camera)
        return tables[camera]["free"], tables[camera]["correlations"]
    free_parameters = [(name, p) for name, entry in tables.items() for p in entry["free"]]
    if not free_parameters:
        return [], np.zeros((0, 0))
    Q = adjustment.covariance(*(("camera", name, p) for name, p in free_parameters))
    sigma = np.sqrt(np.diagonal(Q))
    return [f"{name}: {p}" for name, p in free_parameters], Q / np.outer(sigma, sigma)
