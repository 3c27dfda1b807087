"""Coded targets: points identified by a code.

| kind | points | names |
|---|---|---|
| `aruco:DICTIONARY` | the four corners of markers, of `DICT_4X4_50` if not given | number-corner |
| `apriltag:FAMILY` | the same of AprilTags, `36h11` if no family is given | number-corner |
| `aprilgrid` | the same of boards of tags 36h11 with a border of two bits | number-corner |
| `charuco:COLUMNSxROWS` | corners of the squares of a ChArUco board | row-column |
| `ring12`, `ring14` | centres of ring-coded targets of 12 or 14 bits | the code |

Corners 1 to 4 go clockwise from the upper left one of the marker. A ring-coded target is a light
disc of radius r on dark ground, and about it a ring from 2·r to 3·r of as many sectors as bits,
light for 1; the code is the smallest number of its bits for any first sector
(Schneider and Sinnreich, 1992). Its centre is that of the ellipse of the disc (`targets.py`).
"""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float, UInt8

from jaxbundle.choices import CODED_TARGETS
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.measure.boards import APRILTAGS, ARUCO, Board, find_dictionary
from jaxbundle.measure.corners import find_board_points, memory_of_search
from jaxbundle.measure.marker_corners import fit_marker_corners
from jaxbundle.measure.tag_grids import get_dictionary
from jaxbundle.measure.targets import Target, centre_by_ellipse
from jaxbundle.network.columns import did_you_mean
from jaxbundle.photographs.opencv import need_opencv


@dataclasses.dataclass(frozen=True)
class RingSettings:
    """Which blobs are taken for the disc of a ring-coded target, and how its ring is read.

    **Fields:**

    - `min_pixels`: area within the outline of a disc, pixels: a radius of 3; the sectors of smaller
      ones, of 3 pixels, blur into each other.
    - `max_area_misfit`: of the area of a blob relative to the ellipse through its outline. By the
      raster alone discs are off by up to 0.09 at a radius of 3 and 0.03 at 5. Larger: letters and
      branches are tried as discs, which takes time, and are refused by their ring; half: small
      discs are lost.
    - `level_tolerance`: of the grey value of a sector or of the gap, in contrasts of the disc.
      Above 0.5 a sector is neither light nor dark; the smaller, the more blurred rings are refused.
    - `samples`: in every sector; a fifth at both of its ends is not used.
    """

    min_pixels: int = 20
    max_area_misfit: float = 0.12
    level_tolerance: float = 0.3
    samples: int = 20


Grey = UInt8[np.ndarray, "rows columns"]
# Name, pixels, covariance.
MeasuredPoint = tuple[str, Float[np.ndarray, "2"], Float[np.ndarray, "2 2"]]


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class NamedPoints:
    """Points found in a photograph: names, pixels and their covariance; `left_out`: names of points
    that could not be measured, and why."""

    names: tuple[str, ...]
    xy: Float[np.ndarray, "n 2"]
    covariance: Float[np.ndarray, "n 2 2"]
    left_out: tuple[tuple[str, str], ...] = ()

    def __len__(self) -> int:
        return len(self.names)

    @property
    def sigma(self) -> Float[np.ndarray, "n 2"]:
        """Standard deviations of the coordinates, pixels."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


def find_coded_targets(grey: Grey, kind: str, rings: RingSettings | None = None) -> NamedPoints:
    """The coded targets of a photograph, without repeated names.

    **Arguments:** `kind`: see the module; `rings`: other than the defaults of `RingSettings`.

    **Raises:** `InputError` for an unknown kind.
    """
    check_kind(kind)
    name, _, option = kind.partition(":")
    if name in ("ring12", "ring14"):
        bits, rings = int(name[4:]), rings or RingSettings()
        return _without_repeated(_rings(grey, bits, rings) or _rings(255 - grey, bits, rings))
    if name == "charuco":
        return _without_repeated(_charuco(grey, option))
    border = 2 if name == "aprilgrid" else 1
    return _markers(grey, _dictionary_of(name, option), border)


def memory_of_targets(rows: int, columns: int, kind: str) -> float:
    """Bytes that the search of targets takes in a photograph, beside its grey values."""
    if kind.startswith("ring"):
        # bytes a pixel, measured in photographs of 6 and of 54 million pixels
        return 13 * rows * columns
    return memory_of_search(rows, columns, "charuco")


def check_kind(kind: str) -> None:
    """Refuse unknown kinds and options.

    **Raises:** `InputError`."""
    name, _, option = kind.partition(":")
    if name not in CODED_TARGETS:
        raise InputError(
            f"coded targets {kind!r}: {', '.join(CODED_TARGETS)}{did_you_mean(name, CODED_TARGETS)}"
        )
    if name.startswith("ring") and option:
        raise InputError(f"coded targets {kind!r}: {name} has no options")
    if name == "charuco":
        _charuco_board(option)
    elif not name.startswith("ring"):
        _dictionary_of(name, option)


def _dictionary_of(name: str, option: str) -> str:
    """The dictionary of a kind of markers, `option` of its name."""
    if name == "aruco":
        return find_dictionary(option or ARUCO)
    return find_dictionary(f"DICT_APRILTAG_{option}" if option else APRILTAGS)


def _without_repeated(found: Sequence[MeasuredPoint]) -> NamedPoints:
    """Points whose name occurs once: of two, one is a wrong reading, and nothing says which."""
    names = [name for name, *_ in found]
    unique = [point for point in found if names.count(point[0]) == 1]
    return NamedPoints(
        tuple(name for name, *_ in unique),
        np.array([xy for _, xy, _ in unique], float).reshape(-1, 2),
        np.array([covariance for *_, covariance in unique], float).reshape(-1, 2, 2),
    )


def _markers(grey: Grey, dictionary: str, border: int) -> NamedPoints:
    cv2 = need_opencv()
    words = get_dictionary(dictionary)
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border
    for parameters.detectInvertedMarker in (False, True):
        corners, ids, _ = cv2.aruco.ArucoDetector(words, parameters).detectMarkers(grey)
        if ids is not None:
            break
    ids = np.zeros(0, int) if ids is None else ids.ravel().astype(int)
    once = np.bincount(ids, minlength=1)[ids] == 1
    ids, near = ids[once], np.array([four[0] for four in corners], float).reshape(-1, 4, 2)[once]
    if not len(ids):
        return _without_repeated([])
    side = words.markerSize + 2 * border
    draw = lambda id: cv2.aruco.generateImageMarker(words, id, side, borderBits=border) > 0
    found = fit_marker_corners(grey, near, np.array([draw(id) for id in ids.tolist()]), border)
    names = np.array([[f"{id}-{k}" for k in range(1, 5)] for id in ids], dtype=object)
    good = found.why == ""
    return NamedPoints(
        tuple(names[good]),
        found.xy[good],
        found.covariance[good],
        tuple(zip(names[~good], found.why[~good])),
    )


def _charuco_board(option: str) -> Board:
    try:
        columns, rows = (int(n) for n in option.lower().split(":")[0].split("x"))
    except ValueError:
        raise InputError(f"charuco:{option}: COLUMNSxROWS is expected, such as 8x6") from None
    dictionary = option.split(":")[1] if ":" in option else ARUCO
    return Board(columns, rows, 1.0, "charuco", dictionary=dictionary)


def _charuco(grey: Grey, option: str) -> list[MeasuredPoint]:
    board = _charuco_board(option)
    try:
        points = find_board_points(grey, board)
    except InputError:
        return []
    return [
        (id, xy, covariance)
        for id, xy, covariance in zip(board.ids, points.xy, points.covariance)
        if np.isfinite(xy).all()
    ]


def _rings(grey: Grey, bits: int, settings: RingSettings) -> list[MeasuredPoint]:
    found: list[tuple[float, int, Target]] = []
    for near in _discs(grey, settings):
        try:
            target = centre_by_ellipse(grey, near)
        except InputError:
            continue
        if target.bright and (read := _code(grey, target, bits, settings)) is not None:
            found.append((*read, target))
    distinct: list[tuple[int, Target]] = []
    for _, code, target in sorted(found, key=lambda read: read[0]):
        # a sector of a ring may look like a disc with a ring; the more distinct one is right
        ring = 3 * target.axes[0]
        if all(np.linalg.norm(target.xy - t.xy) > max(ring, 3 * t.axes[0]) for _, t in distinct):
            distinct.append((code, target))
    return [(str(code), target.xy, target.covariance) for code, target in distinct]


def _discs(grey: Grey, settings: RingSettings) -> Iterator[Float[np.ndarray, "2"]]:
    """Centres of light blobs that fill the ellipse of their outline."""
    cv2 = need_opencv()
    # a local threshold follows uneven light; 8 grey values above the mean of a window of a
    # twentieth of the image: noise of σ 2 exceeds it once in 30 000 pixels
    side = max(15, (min(grey.shape) // 20) | 1)
    light = cv2.adaptiveThreshold(
        grey, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, side, -8
    )
    outlines, _ = cv2.findContours(light, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    for outline in outlines:
        area = cv2.contourArea(outline)
        if area < settings.min_pixels or len(outline) < 6:  # fitEllipse needs five points
            continue
        middle, axes, _ = cv2.fitEllipse(outline)
        # the outline passes through the centres of the outermost pixels
        full = np.pi / 4 * axes[0] * axes[1]
        # a ratio of axes of 0.25: a target seen 75° from its normal
        misfit = abs(area / max(full, 1e-9) - 1)
        if min(axes) > 0.25 * max(axes) and misfit < settings.max_area_misfit:
            yield np.array(middle)


def _code(
    grey: Grey, target: Target, bits: int, settings: RingSettings
) -> tuple[float, int] | None:
    """The misfit of the ring around a disc, and its code; None if there is none."""
    from scipy.ndimage import map_coordinates

    samples, tolerance = settings.samples, settings.level_tolerance
    n = bits * samples
    t = 2 * np.pi * np.arange(n) / n
    c, s = np.cos(target.angle), np.sin(target.angle)
    turn = np.array([[c, -s], [s, c]])
    rim = target.axes * np.stack([np.cos(t), np.sin(t)], 1) @ turn.T
    # in the middle of the gap (r to 2·r) and of the ring (2·r to 3·r), and beyond it, still on
    # the dark ground
    places = target.xy + np.array([1.5, 2.5, 3.4])[:, None, None] * rim
    u, v = places[..., 0], places[..., 1]
    if u.min() < 0 or v.min() < 0 or u.max() > grey.shape[1] - 1 or v.max() > grey.shape[0] - 1:
        return None
    gap, ring, beyond = map_coordinates(grey.astype(float), [v, u], order=1)
    dark = np.median(gap)
    gap, value, beyond = ((a - dark) / target.contrast for a in (gap, ring, beyond))
    if np.abs(gap).max() > tolerance or beyond.mean() > 0.5:
        return None
    # the sectors begin where the values within them vary least; their blurred ends do not count
    by_start = np.stack([np.roll(value, -k).reshape(bits, samples) for k in range(samples)])
    inner = by_start[:, :, samples // 5 : -(samples // 5)]
    best = int(inner.var(2).sum(1).argmin())
    means = inner[best].mean(1)
    off = np.minimum(np.abs(means), np.abs(means - 1))
    if np.any(off > tolerance):
        return None
    word = (means > 0.5).astype(int)
    if not word.any() or word.all():
        return None
    weights = 1 << np.arange(bits - 1, -1, -1)
    misfit = float(off.mean() + np.abs(gap).mean())
    return misfit, min(int(np.roll(word, -k) @ weights) for k in range(bits))
