"""Pictures of a line scanner in the explorer: a scene, its image, and the map made of the image.

The scene lies on the ground around the image. The true trajectory takes its image line by line
(`flight.take_image`), as `pushbroom simulate` does; the recorded one, with its errors and
interpolation, makes the map of that image (`rectification.block_places`), as `pushbroom correct`
does. Without errors the map is the scene, but for what is lost between the pixels.

The plane of scene and map touches the surface in the middle of the reference image, x east and y
north; its points are those of the ground below them along the vertical of the middle. Pictures of
large images have some of their lines and pixels only.
"""

import base64
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.choices import Resampling
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import geodetic
from jaxbundle.geometry.vectors import point_on_ray
from jaxbundle.io.rasters.scenes import SceneRaster
from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.pushbroom.error_propagation import east_north
from jaxbundle.pushbroom.flight import take_image
from jaxbundle.pushbroom.ground_to_image import make_search
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.image_to_ground import locate_points
from jaxbundle.pushbroom.rectification import (
    BLOCK_SIZE,
    NODE_STEP,
    TOLERANCE,
    MapNodes,
    block_places,
    geographic_nodes,
    local_nodes,
)
from jaxbundle.pushbroom.resampling import resample
from jaxbundle.pushbroom.search_settings import SearchSettings
from jaxbundle.pushbroom.surfaces import GroundSurface
from jaxbundle.report.layout import significant
from jaxbundle.report.page.markup import figure, paragraph
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray

FEW_POINTS = SearchSettings(with_footprint=False, piece_tolerance=1e-3, max_shared_pieces=512)
"""For the nodes of a single block, in pictures that show no thousandth of a pixel: images whose
trajectories need up to 512 pieces share compiled programs."""


class GroundFrame(NamedTuple):
    """The plane of the scene: its origin, axes east, north and up as rows, and the square pixels of
    the map, in metres: the upper left corner of the first is at (left, top)."""

    origin: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    left: float
    top: float
    size: float
    rows: int
    columns: int

    def place(self, X: Float[np.ndarray, "3 *shape"]) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of points of the ground."""
        # (0, 0) is the middle of the first pixel, as in all images; left and top are its border.
        x, y = np.tensordot(self.axes[:2], X - self.origin.reshape(3, *[1] * (X.ndim - 1)), 1)
        return (self.top - y) / self.size - 0.5, (x - self.left) / self.size - 0.5


class Taken(NamedTuple):
    """A scene [bands, rows, columns] of grey values from 0 to 255, NaN outside; its image
    [bands, lines, pixels], every `step` lines and pixels; the map of it, like the scene."""

    scene: Float[np.ndarray, "bands rows columns"]
    image: Float[np.ndarray, "bands lines pixels"]
    step: tuple[int, int]
    map: Float[np.ndarray, "bands rows columns"]

    @property
    def rms(self) -> float:
        """Map − scene where both are, RMS of the grey values; NaN where nothing is."""
        difference = self.map - self.scene
        difference = difference[np.isfinite(difference)]
        return float(np.sqrt(np.mean(difference**2))) if difference.size else float("nan")


def frame_around(
    image: PushbroomImage,
    surface: GroundSurface,
    outline: tuple[np.ndarray, np.ndarray],
    margin: float = 0.15,
) -> GroundFrame:
    """The plane of a scene around an image.

    **Arguments:** `outline`: lines and pixels around the image; `margin` on every side, of the
    longer side of the image: a tenth of a degree at 650 km, 1100 m, is within it for images of 8 km
    and more.

    **Raises:** `InputError` if the image sees no ground."""
    middle = [np.append(v, (n - 1) / 2) for v, n in zip(outline, (image.lines, image.pixels))]
    X = np.asarray(_locate(image, surface, *map(jnp.asarray, middle)))
    if not np.isfinite(X).all():
        raise InputError("not every border of the image has a point on the ground")
    O = X[:, -1]
    east, north = np.asarray(_east_north(surface, tuple(O)))
    axes = np.stack([east, north, np.cross(east, north)])
    x, y = axes[:2] @ (X - O[:, None])
    low, high = (np.array([f(x), f(y)]) for f in (np.min, np.max))
    side = float((high - low).max())
    low, high = low - margin * side, high + margin * side
    # No finer than the pixels of the picture, no more than a block of a map.
    finest = side / max(
        -(-n // step) for n, step in zip((image.lines, image.pixels), _steps(image))
    )
    size = max(float((high - low).max()) / BLOCK_SIZE, finest)
    columns, rows = (min(int(np.ceil(v / size)), BLOCK_SIZE) for v in high - low)
    left, top = float(low[0]), float(high[1])
    return GroundFrame(O, axes, left, top, size, rows, columns)


def take_pictures(
    scene: Float[np.ndarray, "bands rows columns"],
    frame: GroundFrame,
    truth: PushbroomImage,
    recorded: PushbroomImage,
    surface: GroundSurface,
    resampling: Resampling,
) -> Taken:
    """The image of a scene by the true trajectory, and its map by the recorded one.

    **Raises:** `InputError` where the recorded trajectory is too rough to be followed."""
    step = _steps(truth)
    lines, pixels = (np.arange(0.0, n, k) for n, k in zip((truth.lines, truth.pixels), step))
    image = take_image(truth, surface, jnp.asarray(scene), frame.place, lines, resampling, pixels)
    search = make_search(recorded, surface.earth, FEW_POINTS)
    nodes = _nodes_of(frame, surface)
    # Of a large image every `step`th pixel is there: a tolerance of pixels of the picture.
    places = block_places(recorded, search, surface, nodes, tolerance=TOLERANCE * min(step))
    rows, columns = frame.rows, frame.columns
    if places is None:
        return Taken(scene, image, step, np.full_like(scene, np.nan))
    line, pixel = (v[:rows, :columns] / k for v, k in zip(places, step))
    return Taken(scene, image, step, np.asarray(_resample(image, line, pixel, resampling)))


def pattern(frame: GroundFrame, cells: int = 8, fineness: int = 4) -> Float[np.ndarray, "1 r c"]:
    """A scene without a file: a chessboard of `cells` cells along the longer side, brighter towards
    the east, with a disc in the north-west by which pictures are told from their mirror images.
    Every pixel is the mean of `fineness`² samples."""
    rows, columns = frame.rows, frame.columns
    y, x = (
        ((np.arange(n * fineness) + 0.5) / fineness / max(rows, columns) * cells)
        for n in (rows, columns)
    )
    squares = (np.floor(y)[:, None] + np.floor(x)) % 2
    grey = 70 + 80 * squares + 60 * x / x[-1]
    disc = np.hypot(y[:, None] - 1.5, x - 1.5) < 0.4
    grey = np.where(disc, 255.0, grey)
    return grey.reshape(rows, fineness, columns, fineness).mean((1, 3))[None]


def scene_of_raster(
    raster: SceneRaster, frame: GroundFrame, surface: GroundSurface
) -> Float[np.ndarray, "bands rows columns"]:
    """A raster in the plane of a scene: the first three bands if there are as many, else the first;
    grey values from the lowest to the highest are 0 to 255.

    **Raises:** `InputError` if the raster shows nothing of it."""
    bands = raster.bands[: 3 if len(raster.bands) >= 3 else 1]
    X = _ground_below(frame, surface, *np.indices((frame.rows, frame.columns), float))
    row, column = raster.place(X)
    # Means of as many pixels as fit into one of the scene: single ones would be noise.
    steps = [_pixels_between(v) for v in (row, column)]
    bands = _means(bands, steps)
    row, column = ((v + 0.5) / k - 0.5 for v, k in zip((row, column), steps))
    resampled = np.asarray(_resample(bands, row, column, "bilinear"))
    if not np.isfinite(resampled).any():
        raise InputError("the scene is not where the image looks: check track and coordinates")
    low, high = np.nanmin(resampled), np.nanmax(resampled)
    return 255 * (resampled - low) / (high - low if high > low else 1.0)


def draw_pictures(taken: Taken, frame: GroundFrame, resampling: Resampling) -> str:
    """The three pictures with their captions."""
    steps_in_words = " and ".join(
        f"every {k}th {name}" for k, name in zip(taken.step, ("line", "pixel")) if k > 1
    )
    difference_in_words = (
        "nothing of the scene is on the map"
        if np.isnan(taken.rms)
        else f"RMS difference from the scene {significant(taken.rms, 3)} of 255 grey values"
    )
    size = significant(frame.size, 3)
    pictures = [
        ("scene", taken.scene, f"Scene, north at the top, pixels of {size} m"),
        (
            "distorted",
            taken.image,
            f"Image, line 0 at the top{', ' if steps_in_words else ''}{steps_in_words}",
        ),
        (
            "corrected",
            taken.map,
            f"Map by the recorded trajectory, {resampling}: {difference_in_words}",
        ),
    ]
    figures = "".join(
        figure(f'<img alt="{name}" src="data:image/png;base64,{_encode(grey)}">\n', words)
        for name, grey, words in pictures
    )
    return f'<div class="pictures">\n{figures}</div>\n'


def without_pictures(why: InputError) -> str:
    """What is shown in their place."""
    return paragraph(f"No pictures: {why}", "hint")


def _steps(image: PushbroomImage) -> tuple[int, int]:
    """Lines and pixels of an image for one of its picture."""
    return -(-image.lines // BLOCK_SIZE), -(-image.pixels // BLOCK_SIZE)


def _nodes_of(frame: GroundFrame, surface: GroundSurface) -> MapNodes:
    """The nodes of the block of a map that the frame is."""
    # Rows and columns of the nodes: the first is in the centre of the first pixel.
    along_side = NODE_STEP * np.arange(-(-(BLOCK_SIZE - 1) // NODE_STEP) + 1.0)
    X = _ground_below(frame, surface, *np.meshgrid(along_side, along_side, indexing="ij"))
    if surface.earth is None:
        return local_nodes(X[0], X[1])
    longitude, latitude, _ = (np.asarray(v) for v in geodetic(surface.earth, tuple(X)))
    return geographic_nodes(surface, longitude, latitude)


def _ground_below(
    frame: GroundFrame,
    surface: GroundSurface,
    row: Float[np.ndarray, "*shape"],
    column: Float[np.ndarray, "*shape"],
) -> Float[np.ndarray, "3 *shape"]:
    """The points of the surface on the verticals of the plane."""
    x, y = frame.left + (column + 0.5) * frame.size, frame.top - (row + 0.5) * frame.size
    # From 1000 km above: the ground is below it, and nothing of the vertical is on the far side.
    heights = np.full(x.size, 1e6)
    start = frame.origin[:, None] + frame.axes.T @ np.stack([x.ravel(), y.ravel(), heights])
    X = np.asarray(_drop(surface, jnp.asarray(start), jnp.asarray(-frame.axes[2])))
    return X.reshape(3, *x.shape)


def _pixels_between(position: Float[np.ndarray, "rows columns"]) -> int:
    """Pixels of a raster, along one of its axes, in a pixel of the scene."""
    steps = [np.nanmedian(np.abs(np.diff(position, axis=k))) for k in (0, 1)]
    return max(1, int(np.nan_to_num(max(steps))))


def _means(
    bands: Float[AnyArray, "bands rows columns"], steps: list[int]
) -> Float[np.ndarray, "bands rows2 columns2"]:
    """Means of blocks of pixels; the last rows and columns that fill no block are left out."""
    bands = np.asarray(bands, float)
    rows, columns = (n // k for n, k in zip(bands.shape[1:], steps))
    if min(rows, columns) == 0:
        return bands.mean((1, 2), keepdims=True)
    whole_blocks = bands[:, : rows * steps[0], : columns * steps[1]]
    return whole_blocks.reshape(len(bands), rows, steps[0], columns, steps[1]).mean((2, 4))


def _encode(grey: Float[np.ndarray, "bands rows columns"]) -> str:
    """A PNG picture, base64; what is NaN is white."""
    cv2 = need_opencv()
    grey_values = np.clip(np.round(np.nan_to_num(grey, nan=255.0)), 0, 255).astype(np.uint8)
    # OpenCV's colours are blue, green, red
    _, coded = cv2.imencode(".png", np.moveaxis(grey_values, 0, -1)[..., ::-1])
    return base64.b64encode(coded.tobytes()).decode("ascii")


_locate = compile_once(locate_points, ())
_east_north = compile_once(east_north, ())
_resample = compile_once(resample, 3)


@partial(compile_once, static=())
def _drop(
    surface: GroundSurface, o: Float[Array, "3 n"], d: Float[Array, "3"]
) -> Float[Array, "3 n"]:
    """The points of the surface on rays of one direction."""
    # Verticals of the plane, not of the ellipsoid: parallel rays, so that scene and map are one
    # projection of the ground.
    drop = lambda o: point_on_ray(o, d, surface.distance(o, d))
    return jnp.stack(jax.vmap(drop, in_axes=1)(o))
