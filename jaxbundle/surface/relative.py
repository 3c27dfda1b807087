"""The relative error of the orientation of two scanner or RPC images, across their epipolar lines.

Coefficients of two images taken minutes or years apart differ by pixels. The part
along the epipolar lines is a height, determined only by control; the part across
them would prevent matching, and is estimated from the images: at some
hundred corners the best correlation along segments is searched at several distances beside them,
then least squares matching gives the rest.
"""

from collections.abc import Sequence

import numpy as np

from jaxbundle.measure.least_squares_matching import MatchingStatus
from jaxbundle.surface.bounds import Bounds
from jaxbundle.surface.correlation import Pyramid, make_pyramid
from jaxbundle.surface.guide import search
from jaxbundle.surface.interest import interest_points
from jaxbundle.surface.refinement import refine
from jaxbundle.surface.segments import positions, visible_range, windows

POINTS = 400
SEARCH_WIDTH = 16
"""Pixels searched across the epipolar lines."""
HALF_WINDOW = 6
LEVELS = 2
SMALLEST_REPORTED = 0.1
"""Minimum shift that is reported, pixels."""
FEWEST_MATCHES = 12
"""Minimum matches for the rest."""
SMALLEST_CORRELATION = 0.6
LIKELY_CORRELATION = 0.75
"""Minimum ρ of a match."""


def align(base, other, pyramids: tuple[Pyramid, Pyramid], bounds: Bounds) -> float | None:
    """Shift the projections of the other image; returns the shift in pixels, None if too few points
    match."""
    grey = base.grey
    spread = max(8, int(np.sqrt(grey.size / POINTS)))
    uv = interest_points(grey, "corners", spread)
    q = visible_range(base, other, uv, bounds(uv), margin=2 * HALF_WINDOW)
    seen = np.isfinite(q).all(1) & (q[:, 0] < q[:, 1])
    chosen = np.flatnonzero(seen)[:: max(1, -(-int(seen.sum()) // POINTS))]
    uv, q = uv[chosen], q[chosen]
    if len(uv) < FEWEST_MATCHES:
        return None
    shape = windows(base, other, base.points(uv, q.mean(1)))
    along = np.median(shape.other_along[shape.usable], axis=0)
    across = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    first = np.array(other.shift, float)
    levels = len(pyramids[0].levels) - 1
    best, step = 0.0, 2.0**levels
    tries = np.arange(-SEARCH_WIDTH, SEARCH_WIDTH + 1, step)
    for level in range(levels, -1, -1):
        scores = []
        for t in tries:
            other.shift = tuple(first + t * across)
            _, rho, _ = search(
                base, [other], (pyramids[0], [pyramids[1]]), uv, q, None, level, HALF_WINDOW
            )
            scores.append(float(np.mean(np.nan_to_num(rho) > LIKELY_CORRELATION)))
        best = float(tries[int(np.argmax(scores))])
        step /= 2
        tries = best + step * np.arange(-2, 3)
    other.shift = tuple(first + best * across)
    for _ in range(2):
        rest = _rest(base, other, pyramids, uv, q, across)
        if rest is None:
            other.shift = tuple(first)
            return None
        best += rest
        other.shift = tuple(first + best * across)
    return best


def _rest(base, other, pyramids, uv, q, across) -> float | None:
    """The median distance of matches from their epipolar lines."""
    found, rho, _ = search(base, [other], (pyramids[0], [pyramids[1]]), uv, q, None, 0, HALF_WINDOW)
    with np.errstate(invalid="ignore"):
        good = np.isfinite(found) & (rho > SMALLEST_CORRELATION)
    uv, found = uv[good], found[good]
    if len(uv) < FEWEST_MATCHES:
        return None
    shape = windows(base, other, base.points(uv, found))
    start = positions(base, other, uv, found[:, None])[:, 0]
    match = refine(base, other, uv, start, shape.A, HALF_WINDOW)
    good = (match.status == int(MatchingStatus.CONVERGED)) & (match.rho > SMALLEST_CORRELATION)
    if good.sum() < FEWEST_MATCHES:
        return None
    return float(np.median((match.uv - start)[good] @ across))


def align_all(views: Sequence, bounds: Sequence[Bounds]) -> tuple[str, ...]:
    """Align every image with the first; returns messages."""
    said = []
    pyramids = [make_pyramid(view.grey, LEVELS) for view in views]
    for k in range(1, len(views)):
        found = align(views[0], views[k], (pyramids[0], pyramids[k]), bounds[0])
        pair = f"{views[k].name} and {views[0].name}"
        if found is None:
            said.append(f"{pair}: too few matches to align them across the epipolar lines")
        elif abs(found) > SMALLEST_REPORTED:
            said.append(
                f"{pair}: {found:.3g} pixels between them across the epipolar lines, taken "
                "off the second"
            )
    return tuple(said)
