"""Every measurement of a track by least squares matching, with individual covariances.

One photograph of a track gives the window, around the pixel nearest to its feature: the point is
this pixel. The window is matched in the others (`measure.least_squares_matching`), starting from
the similarity of the two features, on the level of the pyramid with equal scale. Half of
the variance of a match is due to the noise of the window, which shifts all of its matches: the
measurement in the first photograph has the mean of these halves, every other one its own half.

The prior σ of terms of second order (`BEND`) is that of perspective and curved surfaces. Without
them, the RMS of errors on hills was 2 σ at 400 × 300 pixels; neighbours within 40 pixels agreed.

Unmatched measurements are at the position of their feature, with σ `FEATURE` times its size.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from jaxbundle.measure.least_squares_matching import MatchingStatus, match_least_squares
from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.system.programs import compile_once
from jaxbundle.tiepoints.features import Features
from jaxbundle.tiepoints.tracks import flatten

WINDOW, PIECE = 17, 41
"""Sides of the window, and of the part of another photograph in which it is matched."""
FINEST = 7.0
"""Diameter, pixels, of features matched in the original; larger ones are matched on a coarser
level, with about this size."""
LEVELS = 6
LANES = 128
SMALLEST_CORRELATION = 0.75
"""Minimum correlation of a match."""
SHIFT = 3.0
"""Maximum distance of a match from its feature, pixels of its level."""
LARGEST_SIGMA = 0.4
"""Maximum σ of a match, pixels of its level."""
CORRELATED_OVER = 7
"""Pixels over which residuals within a window are correlated."""
LEAST_SIGMA = 0.01
"""Minimum σ, pixels of its level: interpolation and sampling add as much."""
BEND = 1.0
"""σ of the terms of second order of a match, times the longer side of the photograph: perspective
and curvature of the surface bend a window by about (half its side)²/(principal distance)."""
FEATURE = 0.12
"""σ of the position of a feature relative to its diameter."""


@dataclasses.dataclass(frozen=True)
class Measurements:
    """Measurements: track and photograph; `xy`, `sigma`: pixels; `level`: of the pyramid,
    −1: the position of the feature; `first`: whether it gave the window; `colour`: RGB there."""

    track: Int[np.ndarray, " n"]
    image: Int[np.ndarray, " n"]
    xy: Float[np.ndarray, "n 2"]
    sigma: Float[np.ndarray, "n 2"]
    level: Int[np.ndarray, " n"]
    first: Bool[np.ndarray, " n"]
    colour: UInt8[np.ndarray, "n 3"]

    def __len__(self) -> int:
        return len(self.track)

    def take(self, rows) -> "Measurements":
        """The chosen measurements."""
        return Measurements(*(getattr(self, f.name)[rows] for f in dataclasses.fields(self)))


def measure_tracks(
    tracks: Sequence[Sequence[tuple[int, int]]],
    features: Sequence[Features],
    read: Callable[[int], UInt8[np.ndarray, "rows columns 3"]],
    advance: Callable[[], None] = lambda: None,
) -> Measurements:
    """Measure all points of every track; each photograph is read once.

    **Arguments:** `read(k)`: colours of a photograph; `advance`: called after each of them.
    """
    track, image, feature = flatten(tracks)
    n = len(track)
    xy, size, angle = np.zeros((n, 2)), np.zeros(n), np.zeros(n)
    for k, found in enumerate(features):
        rows = image == k
        xy[rows], size[rows] = found.xy[feature[rows]], found.size[feature[rows]]
        angle[rows] = found.angle[feature[rows]]
    first, level = _roles(track, size)
    window_of = np.flatnonzero(first)[track]
    scale = 2.0**level
    centre = np.rint(xy / scale[:, None])
    start = _starts(xy, size, angle, scale, centre, window_of)
    corner = np.rint(start[:, :, 2]) - PIECE // 2
    corner[first] = centre[first] - WINDOW // 2
    windows, pieces, inside, colour, longer = _cut_out(
        len(features), image, first, level, corner, xy, read, advance
    )
    others = np.flatnonzero(~first & inside & inside[window_of])
    start[:, :, 2] -= corner
    bend = BEND * (WINDOW // 2) ** 2 * scale / longer[image]
    found = _match_in_portions(windows[track[others]], pieces, others, start, bend)
    return _collect(track, image, xy, size, first, level, corner, colour, others, start, found)


def prepare() -> None:
    """Compile the matching, ahead of its data."""
    pieces = np.random.default_rng(0).integers(0, 255, (LANES, PIECE, PIECE), np.uint8)
    start = np.tile(np.array([[1, 0, PIECE // 2], [0, 1, PIECE // 2]], np.float32), (LANES, 1, 1))
    _match(pieces[:, :WINDOW, :WINDOW], pieces, start, np.ones(LANES, np.float32))


def _roles(track, size):
    """The measurement of a track that gives the window, of medium size; and the levels."""
    order = np.lexsort((size, track))
    begin = np.searchsorted(track[order], np.arange(track.max(initial=-1) + 1))
    length = np.bincount(track)
    first = np.zeros(len(track), bool)
    first[order[begin + length // 2]] = True
    smallest = size[order[begin]]
    of_window = size[first][np.argsort(track[first])]
    coarse = np.maximum(np.log2(of_window / FINEST), np.log2(of_window / smallest))
    base = np.clip(np.rint(coarse), 0, LEVELS).astype(int)
    level = np.rint(base[track] + np.log2(size / of_window[track]))
    return first, np.where(first, base[track], np.clip(level, 0, LEVELS)).astype(int)


def _starts(xy, size, angle, scale, centre, window_of):
    """A of every measurement, from pixels of the window to those of its level."""
    w = window_of
    turn = angle - angle[w]
    grown = size / scale / (size[w] / scale[w])
    c, s = grown * np.cos(turn), grown * np.sin(turn)
    start = np.zeros((len(xy), 2, 3))
    start[:, 0, 0], start[:, 0, 1], start[:, 1, 0], start[:, 1, 1] = c, -s, s, c
    offset = centre[w] - xy[w] / scale[w, None]
    start[:, :, 2] = xy / scale[:, None] + np.einsum("nij,nj->ni", start[:, :, :2], offset)
    return start


def _cut_out(photographs, image, first, level, corner, xy, read, advance):
    """Windows by track, parts by measurement, which are inside, the colours of the points, and the
    longer sides of the photographs."""
    cv2 = need_opencv()
    n = len(image)
    windows = np.zeros((int(first.sum()), WINDOW, WINDOW), np.uint8)
    track_of = np.cumsum(first) - 1
    pieces = np.zeros((n, PIECE, PIECE), np.uint8)
    inside, colour = np.zeros(n, bool), np.zeros((n, 3), np.uint8)
    longer = np.ones(photographs)
    order = np.argsort(image, kind="stable")
    for k in range(photographs):
        rows = order[slice(*np.searchsorted(image[order], [k, k + 1]))]
        if len(rows):
            picture = read(k)
            longer[k] = max(picture.shape[:2])
            at = np.clip(np.rint(xy[rows]), 0, np.array(picture.shape[1::-1]) - 1).astype(int)
            colour[rows] = picture[at[:, 1], at[:, 0]]
            pyramid = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
            for step in range(level[rows].max() + 1):
                pyramid = cv2.pyrDown(pyramid) if step else pyramid
                here = rows[level[rows] == step]
                for chosen, side in ((here[first[here]], WINDOW), (here[~first[here]], PIECE)):
                    cut, inside[chosen] = _pieces(pyramid, corner[chosen].astype(int), side)
                    if side == WINDOW:
                        windows[track_of[chosen]] = cut
                    else:
                        pieces[chosen] = cut
        advance()
    return windows, pieces, inside, colour, longer


def _pieces(picture, corner, side):
    """Squares of a photograph, and which of their centres are in it; edge pixels are repeated."""
    rows, columns = picture.shape
    offset = np.arange(side)
    v = np.clip(corner[:, 1, None] + offset, 0, rows - 1)
    u = np.clip(corner[:, 0, None] + offset, 0, columns - 1)
    reach = side // 2 if side == WINDOW else side // 2 - WINDOW // 2 - 2
    middle = corner + side // 2
    inside = np.all((middle >= reach) & (middle < np.array([columns, rows]) - reach), axis=1)
    return picture[v[:, :, None], u[:, None, :]], inside


@partial(compile_once, static=())
def _match(windows: Array, pieces: Array, start: Array, bend: Array):
    match = lambda window, piece, start, bend: match_least_squares(
        window.astype(np.float32), piece.astype(np.float32), start, reach=CORRELATED_OVER, bend=bend
    )
    found = jax.vmap(match)(windows, pieces, start, bend)
    return found.affine, found.covariance, found.correlation, found.status


def _match_in_portions(windows, pieces, others, start, bend):
    """A, covariance, correlation and status of the matches."""
    parts = []
    for begin in range(0, len(others), LANES):
        rows = np.minimum(np.arange(begin, begin + LANES), len(others) - 1)
        some = others[rows]
        begin_at, second = (a[some].astype(np.float32) for a in (start, bend))
        parts.append(_match(windows[rows], pieces[some], begin_at, second))
    if not parts:
        return np.zeros((0, 2, 3)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0, int)
    columns = (np.concatenate([np.asarray(p) for p in column]) for column in zip(*parts))
    return tuple(column[: len(others)] for column in columns)


def _collect(track, image, xy, size, first, level, corner, colour, others, start, found):
    affine, covariance, rho, status = found
    scale = 2.0**level
    place = affine[:, :, 2] + corner[others]
    away = np.linalg.norm(place - xy[others] / scale[others, None], axis=1)
    own = np.sqrt(np.maximum(covariance[:, [0, 1], [0, 1]], 0) / 2)
    good = (status == int(MatchingStatus.CONVERGED)) & (rho > SMALLEST_CORRELATION) & (away < SHIFT)
    good &= (own < LARGEST_SIGMA).all(1)
    own = np.hypot(own, LEAST_SIGMA)
    rows = others[good]
    sigma = np.repeat(FEATURE * size[:, None], 2, 1)
    sigma[rows] = own[good] * scale[rows, None]
    matched = np.zeros(len(track), bool)
    matched[rows] = True
    windows = np.flatnonzero(first)
    number = np.bincount(track[rows], minlength=len(windows))
    # the point is the centre of the window, if that is matched, else the feature
    from_window = (start[:, :, 2] + corner) * scale[:, None]
    place_of = np.where(number[track, None] > 0, from_window, xy)
    place_of[rows] = place[good] * scale[rows, None]
    sums = [np.bincount(track[rows], own[good, i] ** 2, len(windows)) for i in (0, 1)]
    square = np.stack(sums, 1)
    use = number > 0
    w = windows[use]
    place_of[w] = (corner[w] + WINDOW // 2) * scale[w, None]
    sigma[w] = np.sqrt(square[use] / number[use, None]) * scale[w, None]
    matched[w] = True
    return Measurements(track, image, place_of, sigma, np.where(matched, level, -1), first, colour)
