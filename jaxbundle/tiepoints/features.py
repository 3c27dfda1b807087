"""Features of a photograph: points recognisable from other positions, with descriptors.

A photograph is first reduced to `FeatureSettings.side` pixels; OpenCV's SIFT (Lowe, 2004) begins
by doubling it, so that the finest features are those of a photograph of twice that side; least
squares matching measures in the original afterwards. The most distinct features are kept, equally
many in each cell of a grid as far as it has them: they cover photographs evenly, including parts
with little texture.
"""

import dataclasses
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxbundle.arguments import integer, one_of
from jaxbundle.choices import FEATURES
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.photographs.opencv import need_opencv

# Side of the tiles in which a large photograph is searched, reduced pixels: at 235 bytes a pixel
# (`memory_of_features`) the search then takes 1.5 GB at most, however large the photograph is.
TILE = 2400
# Pixels around a tile that are searched too, so that its border does not change descriptors:
# OpenCV's reach 3·√2·2.5 = 10.6 σ from a feature, so this holds up to σ = 6 pixels.
TILE_MARGIN = 64


@dataclasses.dataclass(frozen=True)
class FeatureSettings:
    """Settings of the search for features."""

    kind: str = "sift"
    """Detector: `sift`, `akaze` or `orb`."""
    number: int = 6000
    """Features kept per photograph."""
    side: int = 1800
    """Longer side, pixels, to which a photograph is reduced; 0: not at all."""
    cells: int = 16
    """Cells of the grid along the longer side; each keeps the same number. More: features also
    where there is little texture, but weaker ones; fewer: the textured parts get most of them."""
    search_factor: float = 1.6
    """Searched features, as a multiple of those kept: the surplus of textured cells, from which the
    grid chooses. SIFT computes a descriptor for each, so time grows with it."""
    contrast: float = 0.02
    """SIFT's threshold of contrast, half of OpenCV's default: the grid, not the threshold, decides
    what is kept."""
    faint_contrast: float = 0.008
    """The threshold for photographs with few features: blurred ones, or of bare objects. At 800 ×
    600 pixels, with a blur of 2 pixels and a third of the contrast, 476 features became 3092, and
    10 of 10 pairs were verified instead of 7."""
    faint_share: float = 1 / 3
    """Share of `number` below which a photograph has few features. The second search doubles the
    time of such a photograph; with 1, all photographs of simple objects would be searched twice."""

    def __post_init__(self):
        one_of("features", self.kind, FEATURES)
        integer("features: number", self.number)


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Features:
    """`xy`: pixels of the original; `size`: diameter, in them; `angle`: radians from x to y;
    `descriptor`: 128 counts of SIFT, bits of the others; the largest features first."""

    xy: Float[np.ndarray, "n 2"]
    size: Float[np.ndarray, " n"]
    angle: Float[np.ndarray, " n"]
    descriptor: UInt8[np.ndarray, "n bytes"]

    def __len__(self) -> int:
        return len(self.xy)

    def take(self, rows: Int[np.ndarray, " m"] | Bool[np.ndarray, " n"] | slice) -> "Features":
        """The chosen features."""
        return Features(self.xy[rows], self.size[rows], self.angle[rows], self.descriptor[rows])


def find_features(
    grey: UInt8[np.ndarray, "rows columns"], settings: FeatureSettings = FeatureSettings()
) -> Features:
    """The features of a photograph, evenly distributed."""
    cv2 = need_opencv()
    rows, columns = grey.shape
    factor = min(1.0, settings.side / max(rows, columns)) if settings.side else 1.0
    if factor < 1:
        size = max(round(columns * factor), 1), max(round(rows * factor), 1)
        # The mean over the area of a pixel: the other interpolations alias when they reduce.
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    points, descriptors = _search(cv2, grey, settings, settings.contrast)
    # A low threshold for all would fill sharp photographs with features of noise.
    if settings.kind == "sift" and len(points) < settings.faint_share * settings.number:
        points, descriptors = _search(cv2, grey, settings, settings.faint_contrast)
    if not points or not descriptors:
        return Features(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros((0, 1), np.uint8))
    xy = np.array([p.pt for p in points], float)
    size, angle, response = (
        np.array([getattr(p, name) for p in points]) for name in ("size", "angle", "response")
    )
    chosen_rows = _choose_evenly(xy, size, response, grey.shape, settings)
    scale = np.array([columns / grey.shape[1], rows / grey.shape[0]])
    # (0, 0) is the centre of the first pixel, so a reduction scales about (−0.5, −0.5)
    xy = (xy[chosen_rows] + 0.5) * scale - 0.5
    descriptor = np.concatenate(descriptors)[chosen_rows].astype(np.uint8)
    return Features(
        xy, size[chosen_rows] * scale.mean(), np.deg2rad(angle[chosen_rows]), descriptor
    )


def memory_of_features(rows: int, columns: int, settings: FeatureSettings) -> float:
    """Bytes that the search takes in a photograph, beside its grey values."""
    factor = min(1.0, settings.side / max(rows, columns)) if settings.side else 1.0
    tall, wide = (min(factor * side, TILE + 2 * TILE_MARGIN) for side in (rows, columns))
    # SIFT doubles the photograph (4 pixels for one) and keeps 6 + 5 layers of float32, of it and of
    # all smaller octaves (1 + 1/4 + 1/16 … = 4/3): 235 bytes a pixel; 225 were measured
    return 4 * (6 + 5) * 4 * (4 / 3) * tall * wide


def _search(
    cv2: ModuleType,
    grey: UInt8[np.ndarray, "rows columns"],
    settings: FeatureSettings,
    contrast: float,
) -> tuple[list[Any], list[np.ndarray]]:
    """Key points of OpenCV and their descriptors, by tiles."""
    detector = _make_detector(cv2, settings, contrast)
    parts = [_search_tile(detector, grey, *tile) for tile in _tiles(*grey.shape)]
    points = [p for part, _ in parts for p in part]
    return points, [d for _, d in parts if d is not None and len(d)]


def _make_detector(cv2: ModuleType, settings: FeatureSettings, contrast: float) -> Any:
    ample = int(settings.search_factor * settings.number)
    if settings.kind == "sift":
        # Without precise upscaling, features are a quarter of a pixel too far right and down.
        return cv2.SIFT_create(
            nfeatures=ample, contrastThreshold=contrast, enable_precise_upscale=True
        )
    if settings.kind == "orb":
        return cv2.ORB_create(nfeatures=ample)
    if not hasattr(cv2, "AKAZE_create"):
        raise InputError(
            f"OpenCV {cv2.__version__} is built without AKAZE: take features sift, or install "
            "opencv-contrib-python-headless"
        )
    # Half of OpenCV's default threshold, as for the contrast of SIFT.
    return cv2.AKAZE_create(threshold=0.0005)


def _tiles(rows: int, columns: int) -> Iterator[tuple[int, int, int, int]]:
    """(top, left, bottom, right) of the parts of a photograph, at most `TILE` wide and high."""
    tall, wide = (max(1, -(-n // TILE)) for n in (rows, columns))
    for i in range(tall):
        for j in range(wide):
            top, bottom = rows * i // tall, rows * (i + 1) // tall
            left, right = columns * j // wide, columns * (j + 1) // wide
            yield top, left, bottom, right


def _search_tile(
    detector: Any,
    grey: UInt8[np.ndarray, "rows columns"],
    top: int,
    left: int,
    bottom: int,
    right: int,
) -> tuple[list[Any], UInt8[np.ndarray, "n bytes"] | Float[np.ndarray, "n 128"] | None]:
    """Key points within a tile, searched with a margin, and their descriptors."""
    t, l = max(top - TILE_MARGIN, 0), max(left - TILE_MARGIN, 0)
    part = np.ascontiguousarray(grey[t : bottom + TILE_MARGIN, l : right + TILE_MARGIN])
    points, descriptors = detector.detectAndCompute(part, None)
    if descriptors is None:
        return [], None
    rows_inside = []
    for k, point in enumerate(points):
        x, y = point.pt[0] + l, point.pt[1] + t
        point.pt = (x, y)
        # Half-open, so that a feature in the margin of two tiles is taken once.
        if left - 0.5 <= x < right - 0.5 and top - 0.5 <= y < bottom - 0.5:
            rows_inside.append(k)
    return [points[k] for k in rows_inside], descriptors[rows_inside]


def _choose_evenly(
    xy: Float[np.ndarray, "n 2"],
    size: Float[np.ndarray, " n"],
    response: Float[np.ndarray, " n"],
    shape: tuple[int, ...],
    settings: FeatureSettings,
) -> Int[np.ndarray, " m"]:
    """The rows to keep, the largest features first: the most distinct ones of each cell."""
    if len(xy) <= settings.number:
        return np.argsort(-size, kind="stable")
    side = max(shape) / settings.cells
    column, row = (xy // side).astype(int).T
    cell = row * (settings.cells + 1) + column
    order = np.lexsort((-response, cell))
    first_in_cell = np.searchsorted(cell[order], cell[order])
    # The rank of each feature within its cell: all first ones are taken, then all second ones, …
    rank = np.empty(len(xy), int)
    rank[order] = np.arange(len(xy)) - first_in_cell
    chosen_rows = np.lexsort((-response, rank))[: settings.number]
    return chosen_rows[np.argsort(-size[chosen_rows], kind="stable")]
