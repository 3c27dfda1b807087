"""Residuals: as vectors in an image, and all of them as a histogram."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxbundle.cameras import get_model
from jaxbundle.plotting.distortion import principal_point
from jaxbundle.plotting.frame import image_frame, image_index, measured
from jaxbundle.plotting.style import (
    BLUE,
    GREY,
    INK,
    MAX_LABELS,
    RUST,
    axes,
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

    from jaxbundle.adjustment.result import Adjustment


def residual_vectors(
    adjustment: "Adjustment", image: str, ax: "Axes | None" = None, large_tau: float = 3.0
) -> "Axes":
    """The residuals v = computed − observed of an image as vectors, with a scale bar.

    Vectors begin at the measured coordinates, in the unit of the camera's model; y is drawn as
    in the visible image. Those with |τ| > `large_tau` are coloured. The image frame is drawn if its
    size is known.

    **Returns:** matplotlib `Axes`.
    """
    ax = axes(ax, (7, 6))
    points, xy, v, tau = measured(adjustment, image)
    network = adjustment.problem.network
    network_camera = network.cameras[network.images.camera[image_index(adjustment, image)]]
    model = get_model(network_camera.model)
    low, high, is_known = image_frame(adjustment, network_camera.id)
    low = np.minimum(low, xy.min(0, initial=np.inf))
    high = np.maximum(high, xy.max(0, initial=-np.inf))
    diagonal = float(np.hypot(*(high - low)))
    longest = np.fmax.reduce(np.hypot(*v.T), initial=0.0)  # v of a removed coordinate is NaN
    factor = round_number(0.1 * diagonal / longest) if longest > 0 else 1.0
    large = (np.abs(tau) > large_tau).any(1)
    scale, unit = micrometres(model.unit)
    bar = round_number(scale * 0.1 * diagonal / factor) / scale
    _draw_arrows(ax, xy, v, np.where(large, RUST, BLUE), factor, (bar, f"{scale * bar:g} {unit}"))
    if is_known:
        _draw_frame(ax, low, high)
    if len(points) <= MAX_LABELS // 2:
        _write_names(ax, points, xy)
    centre = principal_point(adjustment, network_camera.id)
    if (low <= centre).all() and (centre <= high).all():
        ax.plot(*centre, "+", color=GREY, markersize=9, zorder=2)
    margin = 0.07 * diagonal
    ax.set_xlim(low[0] - margin, high[0] + margin)
    ax.set_ylim(low[1] - margin, high[1] + margin)
    if model.axes == "down":
        ax.invert_yaxis()
    ax.set_aspect("equal")
    quiet(ax)
    names = ("u", "v") if model.axes == "down" else ("x", "y")
    label(ax, "x", names[0], model.unit)
    label(ax, "y", names[1], model.unit)
    rms = float(np.sqrt((v**2).mean())) if len(v) else 0.0
    detail = f"{len(points)} points, RMS {scale * rms:.3g} {unit}, vectors × {factor:g}"
    if large.any():
        detail += f", |τ| > {large_tau:g} coloured"
    title(ax, f"Image {image}: residuals ({network.residuals})", detail)
    return ax


def _draw_arrows(
    ax: "Axes",
    xy: Float[np.ndarray, "n 2"],
    v: Float[np.ndarray, "n 2"],
    colours: np.ndarray,
    factor: float,
    bar: tuple[float, str],
) -> None:
    """Residuals enlarged by `factor`, each with a dot at its begin; above them a bar of the
    residual `bar`, with its name."""
    arrows = ax.quiver(
        *xy.T,
        *v.T,
        angles="xy",
        scale_units="xy",
        scale=1 / factor,
        width=0.0028,
        headwidth=3.5,
        headlength=4.5,
        headaxislength=4,
        minlength=0,
        color=colours,
        zorder=3,
    )
    ax.scatter(*xy.T, s=5, color=INK, linewidths=0, zorder=4)
    ax.quiverkey(
        arrows,
        0.9,
        1.035,
        *bar,
        coordinates="axes",
        labelpos="N",
        color=INK,
        labelcolor=INK,
        labelsep=0.05,
        fontproperties={"size": 8},
    )


def _draw_frame(ax: "Axes", low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"]) -> None:
    """The frame of the image, between its corners."""
    from matplotlib.patches import Rectangle

    sides = high - low
    ax.add_patch(
        Rectangle((low[0], low[1]), *sides, fill=False, edgecolor=GREY, linewidth=1.2, zorder=2)
    )


def _write_names(ax: "Axes", points: Iterable[object], xy: Float[np.ndarray, "n 2"]) -> None:
    """The names of points beside their dots."""
    for point, place in zip(points, xy):
        ax.annotate(
            plain(point),
            place,
            xytext=(4, 4),
            textcoords="offset points",
            fontsize=7,
            color=GREY,
            parse_math=False,
        )


def residual_histogram(adjustment: "Adjustment", ax: "Axes | None" = None) -> "Axes":
    """The normalised residuals τ = w/σ0 of all observations, with the normal curve.

    **Returns:** matplotlib `Axes`: number of observations over τ; those beyond ±6 are counted in
    the outermost bars.
    """
    ax = axes(ax, (6.5, 4.2))
    tau = adjustment.residuals["tau"]
    tau = tau[np.isfinite(tau)]
    # Bars of a few observations are ragged: fewer, wider ones.
    step = 0.5 if len(tau) < 400 else 0.25
    reach = float(np.clip(np.ceil(np.abs(tau).max(initial=0.0)), 4, 6))
    edges = np.arange(-reach, reach + step / 2, step)
    counted = np.histogram(np.clip(tau, -reach, reach), edges)[0]
    ax.bar(
        edges[:-1],
        counted,
        step,
        align="edge",
        color=BLUE,
        alpha=0.55,
        edgecolor="white",
        linewidth=0.6,
        label=f"{len(tau)} observations",
        zorder=2,
    )
    t = np.linspace(-reach, reach, 241)
    normal = len(tau) * step * np.exp(-0.5 * t**2) / np.sqrt(2 * np.pi)
    ax.plot(t, normal, color=RUST, linewidth=1.4, label="normal distribution", zorder=3)
    quiet(ax)
    ax.set_xlim(-reach, reach)
    ax.set_ylim(0, 1.08 * max(counted.max(initial=0), normal.max(initial=0.0), 1))
    label(ax, "x", "normalised residual τ = w/σ0", "–")
    label(ax, "y", f"observations per {step:g}", "number")
    rms = float(np.sqrt((tau**2).mean())) if len(tau) else 0.0
    beyond = int((np.abs(tau) > reach).sum())
    detail = f"RMS {rms:.3f}" + (f", {beyond} beyond ±{reach:g}" if beyond else "")
    title(ax, f"{adjustment.network.name}: residuals", detail)
    legend(ax)
    return ax
