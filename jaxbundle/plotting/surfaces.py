"""Pictures of surfaces: a cloud in perspective coloured by σ, a DSM as relief."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxbundle.plotting.style import axes, axes_3d, quiet_3d
from jaxbundle.plotting.ticks import label_coordinates

if TYPE_CHECKING:  # with them come scanners and matching, which an adjustment does without
    from matplotlib.axes import Axes
    from mpl_toolkits.mplot3d import Axes3D

    from jaxbundle.surfaces.cloud import Cloud
    from jaxbundle.surfaces.dsm import Dsm


def cloud_perspective(
    cloud: Cloud, ax: Axes3D | None = None, axis: str = "Z", max_points: int = 40_000
) -> Axes3D:
    """The points in perspective, coloured by σ of one axis, up to its 95th percentile.

    Of more than `max_points` points, every nth is drawn, so that at most `max_points` remain.

    **Returns:** matplotlib `Axes3D`, in the object unit.
    """
    view = axes_3d(ax, (7.5, 6.0))
    drawn_points = cloud.take(np.arange(0, len(cloud), max(1, -(-len(cloud) // max_points))))
    sigma = drawn_points.sigma[:, "XYZ".index(axis)]
    limit = np.nanpercentile(sigma, 95) if np.isfinite(sigma).any() else 1.0
    # Marks that touch their neighbours: of an area of about 300 by 300 typographical points.
    mark = np.clip(300**2 / max(len(drawn_points), 1), 1.0, 16.0)
    scatter = view.scatter(
        *drawn_points.X.T, c=sigma, s=mark, cmap="viridis", vmin=0, vmax=limit, linewidths=0
    )
    view.set_box_aspect(np.maximum(np.ptp(drawn_points.X, axis=0), 1e-9))
    quiet_3d(view)
    view.figure.colorbar(scatter, ax=view, label=f"σ{axis}", shrink=0.6)
    for name in "xyz":
        label_coordinates(view, name, "")
    return view


def dsm_relief(dsm: Dsm, ax: Axes | None = None) -> Axes:
    """The heights in colours under a light from the upper left; cells without height are blank.

    **Returns:** matplotlib `Axes`, in the coordinates of the map.
    """
    from matplotlib import colormaps

    ax = axes(ax, (7.0, 6.0))
    Z = np.where(np.isfinite(dsm.height), dsm.height, np.nan)
    slopes = np.gradient(Z, dsm.size) if min(Z.shape) > 1 else (0 * Z, 0 * Z)
    # Beside a cell without height the slope is not known: drawn as level.
    slope_down, slope_right = (np.nan_to_num(slope) for slope in slopes)
    # From the upper left, as in maps: under light from below, valleys look like ridges.
    # In full shadow a third of the colour remains, so that heights can be told there.
    azimuth, elevation, ambient = np.radians(315.0), np.radians(45.0), 0.35
    # The normal (−∂Z/∂x, −∂Z/∂y, 1), y against the rows.
    light = np.array(
        [
            np.sin(azimuth) * np.cos(elevation),
            np.cos(azimuth) * np.cos(elevation),
            np.sin(elevation),
        ]
    )
    shade = (-slope_right * light[0] + slope_down * light[1] + light[2]) / np.sqrt(
        1 + slope_right**2 + slope_down**2
    )
    # Colours without the ends of the map: white is that of cells without height.
    low, high = np.nanpercentile(dsm.height, [1, 99])
    colour = colormaps["terrain"](np.clip((Z - low) / max(high - low, 1e-9), 0, 1) * 0.8 + 0.1)
    colour[..., :3] *= (ambient + (1 - ambient) * np.clip(shade, 0, 1))[..., None]
    colour[..., 3] = np.isfinite(dsm.height)
    rows, columns = Z.shape
    ax.imshow(colour, extent=(dsm.x, dsm.x + columns * dsm.size, dsm.y - rows * dsm.size, dsm.y))
    ax.set_aspect("equal")
    for name in "xy":
        label_coordinates(ax, name, "")
    return ax
