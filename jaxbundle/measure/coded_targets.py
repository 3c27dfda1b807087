"""Coded targets: points identified by a code.

| kind | points | names |
|---|---|---|
| `aruco:DICTIONARY` | the four corners of markers, of `DICT_4X4_50` if not given | number-corner |
| `apriltag:FAMILY` | the same of AprilTags, `36h11` if no family is given | number-corner |
| `aprilgrid` | the same of boards of tags 36h11 with a border of two bits | number-corner |
| `charuco:COLUMNSxROWS` | corners of the squares of a ChArUco board | row-column |
| `ring12`, `ring14`, `ring16`, `ring20` | centres of ring-coded targets | the printed number |
| `ring14:codes`, … | the same with any code | the code |

Corners 1 to 4 go clockwise from the upper left one of the marker. Numbers and codes of rings:
`ring_targets.py`.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8

from jaxbundle.choices import CODED_TARGETS
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.measure.boards import APRILTAGS, ARUCO, Board, find_dictionary
from jaxbundle.measure.corners import find_board_points, memory_of_search
from jaxbundle.measure.marker_corners import fit_marker_corners
from jaxbundle.measure.ring_targets import (
    RingSettings,
    find_plain_discs,
    find_ring_targets,
)
from jaxbundle.measure.tag_grids import get_dictionary
from jaxbundle.network.columns import did_you_mean
from jaxbundle.photographs.opencv import need_opencv

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
    uncoded: "NamedPoints | None" = None
    """Discs without a code, if they were looked for, without names."""

    def __len__(self) -> int:
        return len(self.names)

    @property
    def sigma(self) -> Float[np.ndarray, "n 2"]:
        """Standard deviations of the coordinates, pixels."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


def find_coded_targets(
    grey: Grey, kind: str, rings: RingSettings | None = None, uncoded: bool = False
) -> NamedPoints:
    """The coded targets of a photograph, without repeated names.

    **Arguments:** `kind`: see the module; `rings`: other than the defaults of `RingSettings`;
    `uncoded`: look for discs without a code, too.

    **Raises:** `InputError` for an unknown kind, or other values than 8-bit grey ones.
    """
    check_kind(kind)
    if np.ndim(grey) != 2 or np.asarray(grey).dtype != np.uint8:
        raise InputError(
            "grey: expected 8-bit grey values [rows, columns], got "
            f"{np.asarray(grey).dtype} {list(np.shape(grey))}; `read_photograph` gives them"
        )
    # What is masked shows nothing.
    grey = np.ascontiguousarray(np.ma.filled(grey, 0))
    name, _, option = kind.partition(":")
    if name.startswith("ring"):
        return _rings(grey, int(name[4:]), option != "codes", rings or RingSettings(), uncoded)
    if name == "charuco":
        return _without_repeated(_charuco(grey, option))
    border = 2 if name == "aprilgrid" else 1
    return _markers(grey, _dictionary_of(name, option), border)


def memory_of_targets(rows: int, columns: int, kind: str) -> float:
    """Bytes that the search of targets takes in a photograph, beside its grey values."""
    if kind.startswith("ring"):
        # Bytes a pixel, measured in photographs of 6 and of 54 million pixels.
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
    if name.startswith("ring") and option not in ("", "codes"):
        raise InputError(f"coded targets {kind!r}: expected {name} or {name}:codes")
    if name == "charuco":
        _charuco_board(option)
    elif not name.startswith("ring"):
        _dictionary_of(name, option)


def _dictionary_of(name: str, option: str) -> str:
    """The dictionary of a kind of markers, `option` of its name."""
    if name == "aruco":
        return find_dictionary(option or ARUCO)
    return find_dictionary(f"DICT_APRILTAG_{option}" if option else APRILTAGS)


def _without_repeated(measured_points: Sequence[MeasuredPoint]) -> NamedPoints:
    """Points whose name occurs once: of two, one is a wrong reading, and nothing says which."""
    names = [name for name, *_ in measured_points]
    return _as_named_points([point for point in measured_points if names.count(point[0]) == 1])


def _as_named_points(points: Sequence[MeasuredPoint]) -> NamedPoints:
    return NamedPoints(
        tuple(name for name, *_ in points),
        np.array([xy for _, xy, _ in points], float).reshape(-1, 2),
        np.array([covariance for *_, covariance in points], float).reshape(-1, 2, 2),
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
    occurs_once = np.bincount(ids, minlength=1)[ids] == 1
    ids, corners_found = (
        ids[occurs_once],
        np.array([four[0] for four in corners], float).reshape(-1, 4, 2)[occurs_once],
    )
    if not len(ids):
        return _without_repeated([])
    side = words.markerSize + 2 * border
    draw = lambda id: cv2.aruco.generateImageMarker(words, id, side, borderBits=border) > 0
    fitted = fit_marker_corners(
        grey, corners_found, np.array([draw(id) for id in ids.tolist()]), border
    )
    names = np.array([[f"{id}-{k}" for k in range(1, 5)] for id in ids], dtype=object)
    good = fitted.why == ""
    return NamedPoints(
        tuple(names[good]),
        fitted.xy[good],
        fitted.covariance[good],
        tuple(zip(names[~good], fitted.why[~good])),
    )


def _charuco_board(option: str) -> Board:
    try:
        columns, rows = (int(n) for n in option.lower().split(":")[0].split("x"))
    except ValueError:
        raise InputError(f"charuco:{option}: expected COLUMNSxROWS, such as 8x6") from None
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


def _rings(
    grey: Grey, bits: int, numbered: bool, settings: RingSettings, uncoded: bool
) -> NamedPoints:
    """Ring-coded targets, light on dark or dark on light."""
    for picture in (grey, 255 - grey):
        targets = find_ring_targets(picture, bits, settings, numbered)
        if targets:
            break
    else:
        picture = grey
    points = _without_repeated([(id, t.xy, t.covariance) for id, t in targets])
    if not uncoded:
        return points
    discs = find_plain_discs(picture, [t for _, t in targets], settings)
    plain = _as_named_points([("", t.xy, t.covariance) for t in discs])
    return dataclasses.replace(points, uncoded=plain)
