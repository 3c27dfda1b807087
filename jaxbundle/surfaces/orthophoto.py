"""Orthophotos: grey values or colours of oriented images over a DSM.

Every cell's point is projected into the images; points hidden by a higher part of the surface are
left out, by steps along the line of sight over the DSM. Of several images each cell uses that with
the steepest line of sight (`mosaic`).
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from jaxbundle.io.rasters.vertical import horizontal_system
from jaxbundle.io.rasters.writing import write_raster
from jaxbundle.surfaces.dsm import Dsm
from jaxbundle.surfaces.views import OrientedImage, is_inside, line_of_sight

ToViews = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n 3"]]


def orthophoto(
    view: OrientedImage, dsm: Dsm, to_view: ToViews = lambda X: X
) -> tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, "rows columns"]]:
    """Grey values of the cells, NaN if not visible in the image; and the steepness of the
    line of sight, its vertical part.

    **Arguments:** `to_view`: from the coordinates of the DSM to those of the view, if they
    differ.
    """
    x, y = dsm.centres()
    X = np.stack([x, y, dsm.height], -1).reshape(-1, 3)
    is_known = np.isfinite(X[:, 2])
    P = to_view(X[is_known])
    uv = view.project(P)
    in_image = is_inside(view, uv)
    d = line_of_sight(view.derivative(P))
    d = d * np.where(d[:, 2:] < 0, -1.0, 1.0)
    is_seen = in_image & ~_are_hidden(dsm, X[is_known], d)
    safe = np.where(in_image[:, None], uv, 0.0)
    grey = ndimage.map_coordinates(
        np.asarray(view.grey, np.float32), [safe[:, 1], safe[:, 0]], order=1, mode="nearest"
    )
    out = np.full((2, len(X)), np.nan)
    out[0, is_known], out[1, is_known] = (
        np.where(is_seen, grey, np.nan),
        np.where(is_seen, d[:, 2], np.nan),
    )
    return out[0].reshape(x.shape), out[1].reshape(x.shape)


def mosaic(
    views: Sequence[OrientedImage], dsm: Dsm, to_view: ToViews = lambda X: X
) -> Float[np.ndarray, "rows columns"]:
    """The orthophoto of several images: every cell from that with the steepest line of sight."""
    best = np.full(dsm.height.shape, -np.inf)
    out = np.full(dsm.height.shape, np.nan)
    for view in views:
        grey, steep = orthophoto(view, dsm, to_view)
        better = np.nan_to_num(steep, nan=-np.inf) > best
        out, best = np.where(better, grey, out), np.where(better, steep, best)
    return out


def write_orthophoto(values: Float[np.ndarray, "rows columns"], dsm: Dsm, path: str | Path) -> None:
    """A GeoTIFF of the grey values, 0: none; 8 bits where they fit, else 16."""
    from rasterio.transform import Affine

    dtype = "uint8" if np.nanmax(values, initial=0) < 255.5 else "uint16"
    stored = np.nan_to_num(np.clip(np.rint(values), 1, np.iinfo(dtype).max)).astype(dtype)
    rows, columns = values.shape
    transform = Affine(dsm.size, 0, dsm.x, 0, -dsm.size, dsm.y)
    with write_raster(
        path,
        columns,
        rows,
        1,
        dtype,
        transform=transform,
        nodata=0,
        crs=horizontal_system(dsm.system),
        compress="deflate",
    ) as raster:
        raster.write(stored[None])


def _are_hidden(
    dsm: Dsm, X: Float[np.ndarray, "n 3"], d: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " n"]:
    """Whether the surface rises above the lines of sight, towards their image."""
    top = np.nanmax(dsm.height)
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.minimum(
            (top - X[:, 2]) / np.maximum(d[:, 2], 1e-9), dsm.size * max(dsm.height.shape)
        )
    height = np.where(np.isfinite(dsm.height), dsm.height, -np.inf)
    rows, columns = height.shape
    hidden = np.zeros(len(X), bool)
    # 64 points of the line of sight up to the height of the highest cell: a hidden cell is missed
    # only beside something narrower than 1/64 of that length
    for share in np.linspace(0, 1, 64 + 1)[1:]:
        points_on_ray = X + (share * reach)[:, None] * d
        row, column = (np.rint(a).astype(int) for a in dsm.place(points_on_ray))
        in_model = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        Z = height[np.where(in_model, row, 0), np.where(in_model, column, 0)]
        # Higher by a whole cell: a slope of 45° does not hide itself by the steps of its cells.
        hidden |= in_model & (Z > points_on_ray[:, 2] + dsm.size)
    return hidden
