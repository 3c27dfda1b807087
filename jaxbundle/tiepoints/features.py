"""Features of a photograph: points recognisable from other positions, with descriptors.

A photograph is first reduced to `Detection.side` pixels; OpenCV's SIFT (Lowe, 2004) begins
by doubling it, so that the finest features are those of twice that side; least squares matching
measures in the original afterwards. The most distinct features are kept, equally
many in each cell of a grid: they cover photographs evenly, including parts with little texture.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, UInt8

from jaxbundle.arguments import integer, one_of
from jaxbundle.choices import FEATURES
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.photographs.opencv import need_opencv

CELLS = 16
"""Cells of the grid along the longer side."""
SEARCH_FACTOR = 1.6
"""Searched features, as a multiple of those kept."""
CONTRAST, FAINT_CONTRAST = 0.02, 0.008
"""SIFT's threshold of contrast, and that for photographs with fewer than `FEW` of the features to
keep: blurred ones, or of bare objects. At 800 × 600 pixels, with a blur of 2 pixels and a third of
the contrast, 476 features became 3092, and 10 of 10 pairs were verified instead of 7."""
FEW = 1 / 3
TILE = 2400
"""Side of the tiles in which a large photograph is searched, reduced pixels."""
OVERLAP = 64
MEMORY = 235
"""Bytes a pixel of the reduced photograph: SIFT doubles it (4 pixels) and keeps 6 + 5 layers of
4 bytes of it and of all smaller octaves (4/3); 225 measured."""


@dataclasses.dataclass(frozen=True)
class Detection:
    """Settings of the search: `kind`; `number` of features kept per photograph; `side`: the longer
    side to which a photograph is reduced, 0: not at all."""

    kind: str = "sift"
    number: int = 6000
    side: int = 1800

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

    def take(self, rows) -> "Features":
        """The chosen features."""
        return Features(self.xy[rows], self.size[rows], self.angle[rows], self.descriptor[rows])


def find_features(
    grey: UInt8[np.ndarray, "rows columns"], settings: Detection = Detection()
) -> Features:
    """The features of a photograph, evenly distributed."""
    cv2 = need_opencv()
    rows, columns = grey.shape
    factor = min(1.0, settings.side / max(rows, columns)) if settings.side else 1.0
    if factor < 1:
        size = max(round(columns * factor), 1), max(round(rows * factor), 1)
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    points, descriptors = _search(cv2, grey, settings, CONTRAST)
    if settings.kind == "sift" and len(points) < FEW * settings.number:
        points, descriptors = _search(cv2, grey, settings, FAINT_CONTRAST)
    if not points or not descriptors:
        return Features(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros((0, 1), np.uint8))
    xy, size, angle, response = _columns(points)
    kept = _spread(xy, size, response, grey.shape, settings.number)
    scale = np.array([columns / grey.shape[1], rows / grey.shape[0]])
    xy = (xy[kept] + 0.5) * scale - 0.5
    descriptor = np.concatenate(descriptors)[kept].astype(np.uint8)
    return Features(xy, size[kept] * scale.mean(), np.deg2rad(angle[kept]), descriptor)


def memory_of_features(rows: int, columns: int, settings: Detection) -> float:
    """Bytes that the search takes in a photograph, beside its grey values."""
    factor = min(1.0, settings.side / max(rows, columns)) if settings.side else 1.0
    tall, wide = (min(factor * side, TILE + 2 * OVERLAP) for side in (rows, columns))
    return MEMORY * tall * wide


def _search(cv2, grey, settings: Detection, contrast: float):
    """Key points and descriptors, by tiles."""
    detector = _detector(cv2, settings, contrast)
    found = [_in_tile(detector, grey, *tile) for tile in _tiles(*grey.shape)]
    points = [p for part, _ in found for p in part]
    return points, [d for _, d in found if d is not None and len(d)]


def _detector(cv2, settings: Detection, contrast: float):
    ample = int(SEARCH_FACTOR * settings.number)
    if settings.kind == "sift":
        # without precise upscaling, features are a quarter of a pixel too far right and down
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
    return cv2.AKAZE_create(threshold=0.0005)


def _tiles(rows: int, columns: int):
    """(top, left, bottom, right) of overlapping tiles, and of the part from which each is used."""
    tall, wide = (max(1, -(-n // TILE)) for n in (rows, columns))
    for i in range(tall):
        for j in range(wide):
            top, bottom = rows * i // tall, rows * (i + 1) // tall
            left, right = columns * j // wide, columns * (j + 1) // wide
            yield top, left, bottom, right


def _in_tile(detector, grey, top, left, bottom, right):
    """Key points within a tile, searched with a margin, and their descriptors."""
    t, l = max(top - OVERLAP, 0), max(left - OVERLAP, 0)
    part = np.ascontiguousarray(grey[t : bottom + OVERLAP, l : right + OVERLAP])
    points, descriptors = detector.detectAndCompute(part, None)
    if descriptors is None:
        return [], None
    keep = []
    for k, point in enumerate(points):
        x, y = point.pt[0] + l, point.pt[1] + t
        point.pt = (x, y)
        if left - 0.5 <= x < right - 0.5 and top - 0.5 <= y < bottom - 0.5:
            keep.append(k)
    return [points[k] for k in keep], descriptors[keep]


def _columns(points):
    xy = np.array([p.pt for p in points], float)
    return xy, *(
        np.array([getattr(p, name) for p in points]) for name in ("size", "angle", "response")
    )


def _spread(xy, size, response, shape, number):
    """The rows to keep, the largest features first: the most distinct ones of each cell."""
    if len(xy) <= number:
        return np.argsort(-size, kind="stable")
    side = max(shape) / CELLS
    cell = (xy[:, 1] // side).astype(int) * (CELLS + 1) + (xy[:, 0] // side).astype(int)
    order = np.lexsort((-response, cell))
    first = np.searchsorted(cell[order], cell[order])
    rank = np.empty(len(xy), int)
    rank[order] = np.arange(len(xy)) - first
    kept = np.lexsort((-response, rank))[:number]
    return kept[np.argsort(-size[kept], kind="stable")]
