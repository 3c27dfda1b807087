"""Errors as rasters: of a map relative to a known truth, and over an image."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxbundle.io.rasters.map_blocks import MapBands, write_map
from jaxbundle.io.rasters.maps import MapGrid, MapSystem
from jaxbundle.io.rasters.writing import write_raster
from jaxbundle.pushbroom.ground_to_image import Search
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.map_accuracy import CovarianceLattice, interpolate_covariances
from jaxbundle.pushbroom.rectification import (
    MapNodes,
    block_errors,
    block_heights,
    block_places,
)
from jaxbundle.pushbroom.rpc.image import RpcImage
from jaxbundle.pushbroom.surfaces import GroundSurface
from jaxbundle.system.rasters import rasterio
from jaxbundle.types import Progress

SIGMAS = "sigma east [m]", "sigma north [m]", "planimetric sigma [m]"
BANDS = "east [m]", "north [m]", "error [m]"


def write_error_map(
    target: str | Path,
    image: PushbroomImage | RpcImage,
    search: Search | None,
    truth: PushbroomImage,
    truth_search: Search,
    surface: GroundSurface,
    system: MapSystem,
    grid: MapGrid,
    progress: Progress | None = None,
) -> float:
    """Write the position error of every pixel of a map relative to the true image: three bands.

    East and north (X and Y in a local frame) of map minus truth, and their length, metres;
    NaN outside the image. Returns the RMS of the length.
    """
    squares = []  # sums and numbers of each block: the map itself may not fit in memory

    def block(nodes: MapNodes) -> Float[np.ndarray, "3 rows columns"] | None:
        places = block_places(image, search, surface, nodes)
        if places is None:
            return None
        errors = block_errors(truth, truth_search, surface, nodes, places)
        length = np.hypot(*errors)
        squares.append((np.nansum(length**2), np.isfinite(length).sum()))
        return np.stack([*errors, length])

    bands = MapBands(3, "float32", names=BANDS)
    write_map(target, system, grid, surface, bands, block, progress)
    total, count = np.sum(squares, axis=0) if squares else (0.0, 0)
    return float(np.sqrt(total / count)) if count else np.nan


def write_sigma_map(
    target: str | Path,
    image: PushbroomImage | RpcImage,
    search: Search | None,
    lattice: CovarianceLattice,
    surface: GroundSurface,
    system: MapSystem,
    grid: MapGrid,
    progress: Progress | None = None,
) -> float:
    """Write the planimetric σ of every pixel of a map: east, north, and the root of the sum of
    their squares, metres; NaN outside the image. Returns the RMS of the last."""
    squares = []

    def block(nodes: MapNodes) -> Float[np.ndarray, "3 rows columns"] | None:
        places = block_places(image, search, surface, nodes)
        if places is None:
            return None
        height = block_heights(surface, nodes)
        east, north, _ = interpolate_covariances(lattice, *places, height)
        squares.append((np.nansum(east + north), np.isfinite(east).sum()))
        return np.sqrt(np.stack([east, north, east + north]))

    bands = MapBands(3, "float32", names=SIGMAS)
    write_map(target, system, grid, surface, bands, block, progress)
    total, count = np.sum(squares, axis=0) if squares else (0.0, 0)
    return float(np.sqrt(total / count)) if count else np.nan


def write_image_raster(
    target: str | Path,
    lines: Float[np.ndarray, " rows"],
    pixels: Float[np.ndarray, " columns"],
    bands: Mapping[str, Float[np.ndarray, "rows columns"]],
) -> None:
    """Write values at evenly spaced lines × pixels of an image, named bands, as a GeoTIFF.

    Its coordinates are those of the image: x the pixel, y the line, downwards.
    """
    steps = [v[1] - v[0] if len(v) > 1 else 1.0 for v in (pixels, lines)]
    transform = rasterio().transform.Affine(
        steps[0], 0, pixels[0] - steps[0] / 2, 0, steps[1], lines[0] - steps[1] / 2
    )
    with write_raster(
        target, len(pixels), len(lines), len(bands), "float32", nodata=np.nan, transform=transform
    ) as raster:
        raster.write(np.stack(list(bands.values())).astype("float32"))
        raster.describe(tuple(bands))
