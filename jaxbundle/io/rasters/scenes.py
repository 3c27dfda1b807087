"""Scenes for simulation: a raster with map coordinates, and its simulated image."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from jaxbundle.choices import Resampling
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid
from jaxbundle.io.rasters.maps import MapSystem
from jaxbundle.io.rasters.writing import write_raster
from jaxbundle.pushbroom.flight import take_image
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.surfaces import GroundSurface
from jaxbundle.system.file_content import naming_file
from jaxbundle.system.rasters import as_type, check_georeference, open_raster, read_values
from jaxbundle.types import Progress


class SceneRaster(NamedTuple):
    """Bands, their type, and `place(X)`, the row and column of points of the ground."""

    bands: Float[np.ndarray, "bands rows columns"]
    dtype: str
    place: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def read_scene(path: str | Path, earth: Ellipsoid | None) -> SceneRaster:
    """A raster in any coordinate system; for a local frame its coordinates are X and Y."""
    with open_raster(path) as source:
        check_georeference(path, source)
        transform, crs, dtype = source.transform, source.crs, source.dtypes[0]
        bands = read_values(path, source)
        scale, offset = (np.array(v, float)[:, None, None] for v in (source.scales, source.offsets))
    if (scale != 1).any() or (offset != 0).any():
        bands, dtype = scale * bands + offset, "float32"
    if earth is not None and crs is None:
        raise InputError(f"{path}: the raster has no coordinate system; add one")
    with naming_file(path):
        system = MapSystem(earth, None if earth is None else crs.to_wkt())
    inverse = ~transform
    middle = transform.c + transform.a * bands.shape[2] / 2 + transform.b * bands.shape[1] / 2

    def place(
        X: Float[np.ndarray, "3 *shape"],
    ) -> tuple[Float[np.ndarray, "*shape"], Float[np.ndarray, "*shape"]]:
        x, y = system.from_ground(X)
        x = system.unwrap(x, middle)
        column = inverse.a * x + inverse.b * y + inverse.c
        row = inverse.d * x + inverse.e * y + inverse.f
        return row - 0.5, column - 0.5

    return SceneRaster(bands, dtype, place)


def write_scene_image(
    path: Path,
    image: PushbroomImage,
    surface: GroundSurface,
    bands: Float[Array, "bands rows columns"],
    place: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    dtype: np.dtype | str,
    resampling: Resampling,
    progress: Progress | None = None,
    portion: int = 64,
) -> None:
    """Write the image of a scene, `portion` lines at a time; 0 or NaN outside the scene.

    More lines at a time take more memory, fewer more calls; 64 lines of 10 000 pixels are 5 MB of
    doubles a band.

    **Raises:** `InputError` if the scene is not in the image.
    """
    has_values = False
    with write_raster(path, image.pixels, image.lines, len(bands), dtype) as target:
        for begin in range(0, image.lines, portion):
            lines = np.arange(begin, begin + portion, dtype=float)
            # The last portion is as long as the others, so that it needs no program of its own.
            clipped_lines = np.minimum(lines, image.lines - 1)
            values = take_image(image, surface, bands, place, clipped_lines, resampling)
            values = values[:, : image.lines - begin]
            has_values |= bool(np.isfinite(values).any())
            target.write(as_type(values, dtype), begin)
            if progress:
                progress("lines", begin + values.shape[1], image.lines)
        if not has_values:
            raise InputError("the image shows nothing of the scene: check track and coordinates")
