"""Every measurement of a track by least squares matching, with individual covariances.

One photograph of a track gives the window (the template), around the pixel nearest to its feature:
the point is this pixel. The window is matched in the others (`measure.least_squares_matching`),
starting from the similarity of the two features, on the level of the pyramid with equal scale. Half
of the variance of a match is due to the noise of the window, which shifts all of its matches: the
measurement in the template's photograph has the mean of these halves, every other one its own half.

The prior σ of terms of second order is that of perspective and curved surfaces. Without them, the
RMS of errors on hills was 2 σ at 400 × 300 pixels; neighbours within 40 pixels agreed.

Unmatched measurements are where their feature predicts the point: the pixel of the window,
transformed by the similarity of the two features. Without any match in a track, all are at the
positions of their features. Their σ grows with the size of the feature.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int, UInt8

from jaxbundle.errors import InputError
from jaxbundle.measure.least_squares_matching import MatchingStatus, match_least_squares
from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.system.programs import compile_once
from jaxbundle.tiepoints.features import Features
from jaxbundle.tiepoints.tracks import flatten

# Matches in one run of the compiled program. The last run repeats a match to fill it: more lanes
# waste more, fewer call the program more often.
LANES = 128


@dataclasses.dataclass(frozen=True)
class TrackMatchingSettings:
    """Settings of the least squares matching of tracks."""

    window: int = 17
    """Side of the window, pixels, odd. Larger: smaller σ, by the root of the number of pixels, but
    more surfaces that are no plane within it, and more occlusions; smaller: repeated texture is
    mistaken, and the 8 unknowns absorb a larger part of the noise."""
    search_window: int = 41
    """Side of the part of another photograph in which it is matched, pixels, odd. Half of it, 20,
    holds half of the window, 8, turned by 45 degrees and larger by √2 (as between two levels), and
    `max_shift`: 8 · √2 · √2 + 3 = 19."""
    finest_size: float = 7.0
    """Diameter, pixels, of features matched in the original; larger ones are matched on a coarser
    level, with about this size: the window then holds the feature and its surroundings, of 2.4
    times the diameter."""
    levels: int = 6
    """Maximum level of the pyramid: features of up to 2⁶ · 7 = 450 pixels."""
    min_correlation: float = 0.75
    """Minimum correlation ρ of a match: ρ² = 0.56 of the variance of the grey values is then
    explained. Smaller: windows at an occlusion match; larger: those with noise or reflections do
    not, and the positions of their features, several times less exact, take their place."""
    max_shift: float = 3.0
    """Maximum distance of a match from where the features predict it, pixels of its level: 2.5 σ of
    the difference of two features of 7 pixels (`feature_sigma`). Larger: matches with the next
    period of a texture."""
    max_sigma: float = 0.4
    """Maximum σ of a match, pixels of its level: half of the σ of a feature of 7 pixels, 0.84
    (`feature_sigma`), whose position is taken instead above it."""
    correlation_length: int = 7
    """Pixels over which residuals within a window are correlated; less than half the window, since
    Σ Jᵀv over all of it vanishes at the minimum, and with it the estimated covariance. On
    photographs of objects 3 to 40 m away this covariance reduced errors above 4 σ from 3.4 to
    0.9 %. Smaller: occlusions within a window are taken for noise; larger: fewer independent parts
    of the window, and σ too small."""
    added_sigma: float = 0.01
    """Floor of σ, pixels of its level, added in quadrature: interpolation and sampling add as much.
    By noise alone strong edges have σ of thousandths of a pixel, and would outweigh the others."""
    second_order_sigma: float = 1.0
    """σ of the terms of second order at the edge of a window, in units of (half its side)²/(longer
    side of the photograph), all in pixels of the original: perspective and curvature of the surface
    bend a window by about (half its side)²/(principal distance)."""
    feature_sigma: float = 0.12
    """σ of the position of a feature relative to its diameter. Only a start: the variance component
    of this kind (`reconstruction.adjusting`) replaces it where there are 60 of them."""

    def __post_init__(self):
        if not 0 < self.correlation_length < self.window / 2:
            raise InputError(
                "correlation_length: expected a positive number less than half the window, "
                f"{self.window / 2:g}, got {self.correlation_length}"
            )


@dataclasses.dataclass(frozen=True)
class Measurements:
    """Measurements: track and photograph; `xy`, `sigma`: pixels; `level`: of the pyramid,
    −1: the position of the feature; `is_template`: whether it gave the window; `colour`: RGB
    there."""

    track: Int[np.ndarray, " n"]
    image: Int[np.ndarray, " n"]
    xy: Float[np.ndarray, "n 2"]
    sigma: Float[np.ndarray, "n 2"]
    level: Int[np.ndarray, " n"]
    is_template: Bool[np.ndarray, " n"]
    colour: UInt8[np.ndarray, "n 3"]

    def __len__(self) -> int:
        return len(self.track)

    def take(self, rows: Int[np.ndarray, " m"] | Bool[np.ndarray, " n"]) -> "Measurements":
        """The chosen measurements."""
        return Measurements(*(getattr(self, f.name)[rows] for f in dataclasses.fields(self)))


def no_measurements() -> Measurements:
    """No measurements."""
    empty = np.zeros(0, int)
    places = np.zeros((0, 2))
    return Measurements(
        empty, empty, places, places, empty, np.zeros(0, bool), np.zeros((0, 3), np.uint8)
    )


@dataclasses.dataclass(frozen=True)
class _TrackFeatures:
    """The features of all tracks, by measurement; `is_template`, `level` as of `Measurements`;
    `template`: the measurement that gives the window of its track; `corner`: the first column and
    row of its window or search window, and `start`: A, from pixels about the centre of the window
    to those of the search window."""

    track: Int[np.ndarray, " n"]
    image: Int[np.ndarray, " n"]
    xy: Float[np.ndarray, "n 2"]
    size: Float[np.ndarray, " n"]
    is_template: Bool[np.ndarray, " n"]
    level: Int[np.ndarray, " n"]
    template: Int[np.ndarray, " n"]
    corner: Float[np.ndarray, "n 2"]
    start: Float[np.ndarray, "n 2 3"]

    @property
    def scale(self) -> Float[np.ndarray, " n"]:
        """Pixels of the original to one of its level."""
        return 2.0**self.level


@dataclasses.dataclass(frozen=True)
class _TrackWindows:
    """Windows by track; search windows, whether they are inside, and the colours of the points by
    measurement; the longer sides of the photographs."""

    windows: UInt8[np.ndarray, "tracks w w"]
    pieces: UInt8[np.ndarray, "n p p"]
    inside: Bool[np.ndarray, " n"]
    colour: UInt8[np.ndarray, "n 3"]
    longer: Float[np.ndarray, " photographs"]


def measure_tracks(
    tracks: Sequence[Sequence[tuple[int, int]]],
    features: Sequence[Features],
    read_photograph: Callable[[int], UInt8[np.ndarray, "rows columns 3"]],
    advance: Callable[[], object] = lambda: None,
    settings: TrackMatchingSettings = TrackMatchingSettings(),
) -> Measurements:
    """Measure all points of every track; each photograph is read once.

    **Arguments:** `read_photograph(k)`: its colours; `advance`: called after each of them.
    """
    track_features = _place_windows(tracks, features, settings)
    cutouts = _cut_out(track_features, len(features), read_photograph, advance, settings)
    is_inside = cutouts.inside
    # The window inside its own photograph, and a place for it in the other.
    to_match = np.flatnonzero(
        ~track_features.is_template & is_inside & is_inside[track_features.template]
    )
    half_window = settings.window // 2
    # (half_window·scale)²/longer pixels of the original (`second_order_sigma`), in those of the
    # level.
    bend = (
        settings.second_order_sigma
        * half_window**2
        * track_features.scale
        / cutouts.longer[track_features.image]
    )
    matches = _match_in_chunks(
        cutouts.windows[track_features.track[to_match]],
        cutouts.pieces,
        to_match,
        track_features.start[to_match].astype(np.float32),
        bend[to_match].astype(np.float32),
        settings.correlation_length,
    )
    return _collect(track_features, to_match, matches, cutouts.colour, settings)


def prepare(settings: TrackMatchingSettings = TrackMatchingSettings()) -> None:
    """Compile the matching, ahead of its data."""
    window, side = settings.window, settings.search_window
    pieces = np.random.default_rng(0).integers(0, 255, (LANES, side, side), np.uint8)
    start = np.tile(np.array([[1, 0, side // 2], [0, 1, side // 2]], np.float32), (LANES, 1, 1))
    windows, bend = pieces[:, :window, :window], np.ones(LANES, np.float32)
    _match(windows, pieces, start, bend, settings.correlation_length)


def _place_windows(
    tracks: Sequence[Sequence[tuple[int, int]]],
    features: Sequence[Features],
    settings: TrackMatchingSettings,
) -> _TrackFeatures:
    """Where the windows of all tracks are cut out, and where they are expected in the others."""
    track, image, feature = flatten(tracks)
    n = len(track)
    xy, size, angle = np.zeros((n, 2)), np.zeros(n), np.zeros(n)
    for k, of_image in enumerate(features):
        rows = image == k
        xy[rows], size[rows] = of_image.xy[feature[rows]], of_image.size[feature[rows]]
        angle[rows] = of_image.angle[feature[rows]]
    is_template, level = _choose_templates(track, size, settings)
    template = np.flatnonzero(is_template)[track]
    scale = 2.0**level
    centre = np.rint(xy / scale[:, None])
    start = _predict_affine(xy, size, angle, scale, centre, template)
    corner = np.rint(start[:, :, 2]) - settings.search_window // 2
    corner[is_template] = centre[is_template] - settings.window // 2
    start[:, :, 2] -= corner
    return _TrackFeatures(track, image, xy, size, is_template, level, template, corner, start)


def _choose_templates(
    track: Int[np.ndarray, " n"], size: Float[np.ndarray, " n"], settings: TrackMatchingSettings
) -> tuple[Bool[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """The measurement of a track that gives the window, and the levels.

    The window is that of the feature of median size: the scales of the others differ from it least.
    Its level is at least so coarse that the smallest feature of the track has a level, too: the
    original, or a coarser one."""
    order = np.lexsort((size, track))
    begin = np.searchsorted(track[order], np.arange(track.max(initial=-1) + 1))
    length = np.bincount(track)
    is_template = np.zeros(len(track), bool)
    is_template[order[begin + length // 2]] = True
    smallest = size[order[begin]]
    of_window = size[is_template][np.argsort(track[is_template])]
    coarse = np.maximum(np.log2(of_window / settings.finest_size), np.log2(of_window / smallest))
    base = np.clip(np.rint(coarse), 0, settings.levels).astype(int)
    level = np.rint(base[track] + np.log2(size / of_window[track]))
    level = np.clip(level, 0, settings.levels).astype(int)
    return is_template, np.where(is_template, base[track], level)


def _predict_affine(
    xy: Float[np.ndarray, "n 2"],
    size: Float[np.ndarray, " n"],
    angle: Float[np.ndarray, " n"],
    scale: Float[np.ndarray, " n"],
    centre: Float[np.ndarray, "n 2"],
    template: Int[np.ndarray, " n"],
) -> Float[np.ndarray, "n 2 3"]:
    """A of every measurement, from pixels about the centre of the window to those of its level: the
    similarity between the feature and that of the template."""
    w = template
    turn = angle - angle[w]
    grown = size / scale / (size[w] / scale[w])
    c, s = grown * np.cos(turn), grown * np.sin(turn)
    start = np.zeros((len(xy), 2, 3))
    start[:, 0, 0], start[:, 0, 1], start[:, 1, 0], start[:, 1, 1] = c, -s, s, c
    # The point is the centre pixel of the window, a fraction of a pixel from the feature.
    offset = centre[w] - xy[w] / scale[w, None]
    start[:, :, 2] = xy / scale[:, None] + np.einsum("nij,nj->ni", start[:, :, :2], offset)
    return start


def _cut_out(
    track_features: _TrackFeatures,
    photographs: int,
    read_photograph: Callable[[int], UInt8[np.ndarray, "rows columns 3"]],
    advance: Callable[[], object],
    settings: TrackMatchingSettings,
) -> _TrackWindows:
    """Windows and search windows of all photographs, each of which is in memory only once."""
    cv2 = need_opencv()
    n, is_template = len(track_features.image), track_features.is_template
    window, side = settings.window, settings.search_window
    # One pixel for interpolation and one for the last step, beyond the window that moves within.
    margins = {window: window // 2, side: window // 2 + 2}
    windows = np.zeros((int(is_template.sum()), window, window), np.uint8)
    row_of_window = np.cumsum(is_template) - 1
    pieces = np.zeros((n, side, side), np.uint8)
    is_inside, colour = np.zeros(n, bool), np.zeros((n, 3), np.uint8)
    longer = np.ones(photographs)
    order = np.argsort(track_features.image, kind="stable")
    for k in range(photographs):
        rows = order[slice(*np.searchsorted(track_features.image[order], [k, k + 1]))]
        if len(rows):
            picture = read_photograph(k)
            longer[k] = max(picture.shape[:2])
            last_pixel = np.array(picture.shape[1::-1]) - 1
            u, v = np.clip(np.rint(track_features.xy[rows]), 0, last_pixel).astype(int).T
            colour[rows] = picture[v, u]
            pyramid = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
            for step in range(track_features.level[rows].max() + 1):
                pyramid = cv2.pyrDown(pyramid) if step else pyramid
                rows_of_level = rows[track_features.level[rows] == step]
                templates, search_windows = (
                    rows_of_level[is_template[rows_of_level]],
                    rows_of_level[~is_template[rows_of_level]],
                )
                windows[row_of_window[templates]], is_inside[templates] = _cut_squares(
                    pyramid, track_features.corner[templates].astype(int), window, margins[window]
                )
                pieces[search_windows], is_inside[search_windows] = _cut_squares(
                    pyramid, track_features.corner[search_windows].astype(int), side, margins[side]
                )
        advance()
    return _TrackWindows(windows, pieces, is_inside, colour, longer)


def _cut_squares(
    picture: UInt8[np.ndarray, "rows columns"],
    corner: Int[np.ndarray, "n 2"],
    side: int,
    margin: int,
) -> tuple[UInt8[np.ndarray, "n side side"], Bool[np.ndarray, " n"]]:
    """Squares of a photograph, and which of their centres are in it, `margin` from its edge; edge
    pixels are repeated."""
    rows, columns = picture.shape
    offset = np.arange(side)
    v = np.clip(corner[:, 1, None] + offset, 0, rows - 1)
    u = np.clip(corner[:, 0, None] + offset, 0, columns - 1)
    middle = corner + side // 2
    is_inside = np.all((middle >= margin) & (middle < np.array([columns, rows]) - margin), axis=1)
    return picture[v[:, :, None], u[:, None, :]], is_inside


# A, covariance, correlation and status of matches.
Matched = tuple[
    Float[np.ndarray, "n 2 3"],
    Float[np.ndarray, "n 2 2"],
    Float[np.ndarray, " n"],
    Int[np.ndarray, " n"],
]


@partial(compile_once, static=4)
def _match(
    windows: UInt8[Array, "lanes w w"],
    pieces: UInt8[Array, "lanes p p"],
    start: Float32[Array, "lanes 2 3"],
    bend: Float32[Array, " lanes"],
    correlation_length: int,
) -> tuple[Array, Array, Array, Array]:
    # float32 at twice the speed: grey values have 8 bits, positions are needed to 1e-3 pixels.
    match = lambda window, piece, start, bend: match_least_squares(
        window.astype(np.float32),
        piece.astype(np.float32),
        start,
        reach=correlation_length,
        bend=bend,
    )
    matched = jax.vmap(match)(windows, pieces, start, bend)
    return matched.affine, matched.covariance, matched.correlation, matched.status


def _match_in_chunks(
    windows: UInt8[np.ndarray, "m w w"],
    pieces: UInt8[np.ndarray, "n p p"],
    to_match: Int[np.ndarray, " m"],
    start: Float32[np.ndarray, "m 2 3"],
    bend: Float32[np.ndarray, " m"],
    correlation_length: int,
) -> Matched:
    """The matches of the measurements `to_match`, whose search windows are among `pieces`."""
    parts = []
    for begin in range(0, len(to_match), LANES):
        rows = np.minimum(np.arange(begin, begin + LANES), len(to_match) - 1)
        parts.append(
            _match(
                windows[rows], pieces[to_match[rows]], start[rows], bend[rows], correlation_length
            )
        )
    if not parts:
        return np.zeros((0, 2, 3)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0, int)
    affine, covariance, rho, status = (
        np.concatenate([np.asarray(p) for p in column])[: len(to_match)] for column in zip(*parts)
    )
    return affine, covariance, rho, status


def _collect(
    track_features: _TrackFeatures,
    to_match: Int[np.ndarray, " m"],
    matches: Matched,
    colour: UInt8[np.ndarray, "n 3"],
    settings: TrackMatchingSettings,
) -> Measurements:
    """Measurements by the good matches, and by the positions of features without one."""
    affine, covariance, rho, status = matches
    track, scale, corner = track_features.track, track_features.scale, track_features.corner
    place = affine[:, :, 2] + corner[to_match]
    # From where the features predict the point, the centre pixel of the window: it lies up to 0.7
    # pixels beside the feature of the window.
    shift = np.linalg.norm(affine[:, :, 2] - track_features.start[to_match, :, 2], axis=1)
    # Half of the variance of a match belongs to each of its two windows.
    sigma = np.sqrt(np.maximum(covariance[:, [0, 1], [0, 1]], 0) / 2)
    good = (status == int(MatchingStatus.CONVERGED)) & (rho > settings.min_correlation)
    good &= (shift < settings.max_shift) & (sigma < settings.max_sigma).all(1)
    sigma = np.hypot(sigma, settings.added_sigma)
    rows = to_match[good]
    sigma_of = np.repeat(settings.feature_sigma * track_features.size[:, None], 2, 1)
    sigma_of[rows] = sigma[good] * scale[rows, None]
    matched = np.zeros(len(track), bool)
    matched[rows] = True
    templates = np.flatnonzero(track_features.is_template)
    number = np.bincount(track[rows], minlength=len(templates))
    # The point is the centre of the window, if that is matched, else the feature.
    from_window = (track_features.start[:, :, 2] + corner) * scale[:, None]
    xy = np.where(number[track, None] > 0, from_window, track_features.xy)
    xy[rows] = place[good] * scale[rows, None]
    # The share of the window, from each of its matches, and their mean.
    sums = [np.bincount(track[rows], sigma[good, i] ** 2, len(templates)) for i in (0, 1)]
    square = np.stack(sums, 1)
    use = number > 0
    w = templates[use]
    xy[w] = (corner[w] + settings.window // 2) * scale[w, None]
    sigma_of[w] = np.sqrt(square[use] / number[use, None]) * scale[w, None]
    matched[w] = True
    level = np.where(matched, track_features.level, -1)
    return Measurements(
        track, track_features.image, xy, sigma_of, level, track_features.is_template, colour
    )
