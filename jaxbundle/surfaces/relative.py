"""The relative error of the orientation of two scanner or RPC images, across their epipolar lines.

Coefficients of two images taken minutes or years apart differ by pixels. The part
along the epipolar lines is a height, determined only by control; the part across
them would prevent matching, and is estimated from the images: at some
hundred corners the best correlation along segments is searched at several distances beside them,
then least squares matching gives the rest.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxbundle.measure.least_squares_matching import MatchingStatus
from jaxbundle.surfaces.bounds import Bounds
from jaxbundle.surfaces.correlation import Pyramid, make_pyramid
from jaxbundle.surfaces.guide import GuideSettings, ImagePyramids, search
from jaxbundle.surfaces.interest import interest_points
from jaxbundle.surfaces.scanner_views import GroundView
from jaxbundle.surfaces.segments import positions, visible_range, windows
from jaxbundle.surfaces.subpixel_matching import refine
from jaxbundle.surfaces.views import Places


@dataclasses.dataclass(frozen=True)
class AlignmentSettings:
    """The search for the error across the epipolar lines; pixels of the full images."""

    points: int = 400
    """Corners that are compared: the median of 400 matches of 0.3 pixel has a σ of 0.02 pixel."""
    search_width: int = 16
    """Largest error that is found, pixels on each side. Coefficients of satellite images have
    errors of up to some ten pixels. The time grows with it."""
    half_window: int = 6
    """Half the side of the windows of least squares matching, pixels."""
    levels: int = 2
    """Levels of the pyramids: at the coarsest, shifts of 4 pixels are tried."""
    min_reported: float = 0.1
    """Minimum shift that is reported, pixels: less does not matter for matching."""
    min_matches: int = 12
    """Minimum matches for an error; one third may be wrong, and the median is still good."""
    likely_correlation: float = 0.75
    """ρ above which a corner counts for a shift. Higher than `min_correlation`: by chance, the best
    of many positions has a high ρ, too."""
    min_correlation: float = 0.6
    """Minimum ρ of a match for the rest, as for points of the surface."""


def align(
    base: GroundView,
    other: GroundView,
    pyramids: tuple[Pyramid, Pyramid],
    bounds: Bounds,
    settings: AlignmentSettings = AlignmentSettings(),
) -> float | None:
    """Shift the projections of the other image; returns the shift in pixels, None if too few points
    match."""
    grey = base.grey
    point_spacing = max(8, int(np.sqrt(grey.size / settings.points)))
    uv = interest_points(grey, "corners", point_spacing)
    q = visible_range(base, other, uv, bounds(uv), margin=2 * settings.half_window)
    is_seen = np.isfinite(q).all(1) & (q[:, 0] < q[:, 1])
    chosen_points = np.flatnonzero(is_seen)[:: max(1, -(-int(is_seen.sum()) // settings.points))]
    uv, q = uv[chosen_points], q[chosen_points]
    if len(uv) < settings.min_matches:
        return None
    shape = windows(base, other, base.points(uv, q.mean(1)))
    if not shape.usable.any():
        return None
    axis_along = np.median(shape.other_axis[shape.usable], axis=0)
    axis_across = np.array([-axis_along[1], axis_along[0]]) / np.linalg.norm(axis_along)
    both_pyramids, guide_settings = (pyramids[0], [pyramids[1]]), GuideSettings()
    first_shift = np.array(other.shift, float)
    levels = len(pyramids[0].levels) - 1
    best, step = 0.0, 2.0**levels
    width = settings.search_width
    tries = np.arange(-width, width + 1, step)
    for level in range(levels, -1, -1):
        scores = []
        for t in tries:
            other.shift = tuple(first_shift + t * axis_across)
            _, rho, _ = search(base, [other], both_pyramids, uv, q, None, level, guide_settings)
            scores.append(float(np.mean(np.nan_to_num(rho) > settings.likely_correlation)))
        best = float(tries[int(np.argmax(scores))])
        step /= 2
        tries = best + step * np.arange(-2, 3)
    other.shift = tuple(first_shift + best * axis_across)
    # Twice: the first matches may start a pixel beside.
    for _ in range(2):
        remaining_offset = _median_offset(base, other, both_pyramids, uv, q, axis_across, settings)
        if remaining_offset is None:
            other.shift = tuple(first_shift)
            return None
        best += remaining_offset
        other.shift = tuple(first_shift + best * axis_across)
    return best


def _median_offset(
    base: GroundView,
    other: GroundView,
    pyramids: ImagePyramids,
    uv: Places,
    q: Float[np.ndarray, "n 2"],
    axis_across: Float[np.ndarray, "2"],
    settings: AlignmentSettings,
) -> float | None:
    """The median distance of matches from their epipolar lines; None for too few."""
    q_found, rho, _ = search(base, [other], pyramids, uv, q, None, 0, GuideSettings())
    with np.errstate(invalid="ignore"):
        good = np.isfinite(q_found) & (rho > settings.min_correlation)
    uv, q_found = uv[good], q_found[good]
    if len(uv) < settings.min_matches:
        return None
    shape = windows(base, other, base.points(uv, q_found))
    start = positions(base, other, uv, q_found[:, None])[:, 0]
    match = refine(base, other, uv, start, shape.A, settings.half_window)
    good = match.status == int(MatchingStatus.CONVERGED)
    good &= match.rho > settings.min_correlation
    if good.sum() < settings.min_matches:
        return None
    return float(np.median((match.uv - start)[good] @ axis_across))


def align_all(
    views: Sequence[GroundView],
    bounds: Sequence[Bounds],
    settings: AlignmentSettings = AlignmentSettings(),
) -> tuple[str, ...]:
    """Align every image with the first; returns messages."""
    messages = []
    pyramids = [make_pyramid(view.grey, settings.levels) for view in views]
    for k in range(1, len(views)):
        shift = align(views[0], views[k], (pyramids[0], pyramids[k]), bounds[0], settings)
        pair = f"{views[k].name} and {views[0].name}"
        if shift is None:
            messages.append(f"{pair}: too few matches to align them across the epipolar lines")
        elif abs(shift) > settings.min_reported:
            messages.append(
                f"{pair}: {shift:.3g} pixels between them across the epipolar lines, taken "
                "off the second"
            )
    return tuple(messages)
