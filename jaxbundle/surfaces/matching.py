"""Matching and intersection of points of a base image: from pixels to points with covariance.

    guide → position in all images at once → least squares matching in each → bending corrected
    → checks → intersection

The residuals across the epipolar lines are errors of the same matching that gives the heights: the
median of vᵀC⁻¹v over that of its χ² distribution is the variance factor by which all covariances
are multiplied. It includes error sources unknown to the matching, such as small errors of
orientation. A factor below 1 means that the windows differ in detail too fine to shift a match. But
the shape of the surface within the windows shifts all matches of a point along its line of sight,
which no residual shows. The scatter of the points (`scatter.py`) does: with a factor below 1, what
the scatter has beyond the covariances is added, the same for all points in pixels. Where the
scatter is not known, the factor is at least 1.
"""

import dataclasses
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import special

from jaxbundle.display import print_in_one_screen
from jaxbundle.measure.least_squares_matching import MatchingStatus
from jaxbundle.surfaces.bending import BendingSettings, correct_bending, sharpen
from jaxbundle.surfaces.guide import Guide, GuideSettings, ImagePyramids, search
from jaxbundle.surfaces.intersection import IntersectedPoints, intersect
from jaxbundle.surfaces.orientation import orientation_covariance
from jaxbundle.surfaces.scatter import missing_sigma
from jaxbundle.surfaces.segments import positions, windows
from jaxbundle.surfaces.subpixel_matching import (
    SubpixelMatches,
    WindowSettings,
    has_texture,
    refine,
)
from jaxbundle.surfaces.views import OrientedImage, Places, is_inside, line_of_sight


@dataclasses.dataclass(frozen=True)
class MatchingSettings:
    """How points are matched in the other images, and which are kept; pixels are those of the full
    images.

    Figures "half …, double …" are of `benchmarks/surface_settings.py` (scene "no texture", every
    fifth pixel): 2251 points, RMS of errors over σ 0.999, 0.04 % wrong by more than a pixel.
    """

    edge_margin: int = 8
    """Minimum distance of a point from the edge of its image, pixels: at least the `half_window` of
    the guide and `half_fine_window`."""
    half_fine_window: int = 6
    """Half the side of the windows of least squares matching, pixels. In large ones a curved
    surface leaves its plane."""
    min_rays: int = 2
    """Minimum rays of a point."""
    min_angle: float = np.radians(1.0)
    """Minimum of the widest angle between the rays of a point, radians: there σ along the line of
    sight is 80 times that across it (√2/tan 1°)."""
    search_margin: float = 2.0
    """Pixels searched beyond the range of the guide. Half: only a third of the points are found;
    double: 9 more, in more time."""
    min_correlation: float = 0.6
    """Minimum ρ, of the search and of least squares matching. 0.3: no difference, since other tests
    reject the same points; 0.8: 12 points fewer."""
    added_sigma: float = 0.012
    """σ added to a match by interpolation and sampling, pixels. Half: 99.5 % of the errors within 3
    σ (99.6); double: RMS 1.01, since the variance factor falls from 0.59 to 0.34."""
    max_sigma: float = 0.5
    """σ of a match above which the texture does not determine it, pixels. Half: 4 points fewer, the
    only one wrong by a pixel among them; double: 1 more."""
    max_second_ratio: float = 0.95
    """Maximum ratio of ρ of the second best separate position to that of the best. 0.9: 10 points
    fewer; 0.98: 7 more."""
    max_guide_distance: float = 1.5
    """Maximum distance of a point from the guide of the other image, pixels: of hidden points it is
    larger. Half and double: no difference for two photographs."""
    max_shift: float = 2.5
    """Maximum distance of least squares matching from the position of the correlation, pixels. Half
    and double: no difference."""
    block_side: int = 16
    """Points per side of a block for the scatter. Half: blocks have fewer than 100 values, the
    scatter is not known, and σ is too large (RMS 0.77); double: no difference."""
    scatter_quantile: float = 0.45
    """Quantile of the blocks that is used, in the smoother direction. Half: no difference, since
    the scatter adds nothing in both cases; 0.9: it adds 0.011 pixel, RMS 0.87."""
    significance: float = 1e-3
    """Level of the test of a point's residuals. Half: 3 points more; double: 1 fewer."""
    windows: WindowSettings = WindowSettings()
    """Least squares matching of single windows."""
    bending: BendingSettings = BendingSettings()
    """The correction for curved surfaces."""


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class SurfaceMatches:
    """Points of a base image: pixels in it, object points with covariance, numbers of rays.

    `factor`: the variance factor of the covariances; `rejected`: numbers of points by reason;
    `shared`: of the variance of Z that of the orientations.
    """

    uv: Float[np.ndarray, "n 2"]
    X: Float[np.ndarray, "n 3"]
    covariance: Float[np.ndarray, "n 3 3"]
    rays: Int[np.ndarray, " n"]
    factor: float
    rejected: dict[str, int]
    shared: Float[np.ndarray, " n"] | None = None


def match_points(
    base: OrientedImage,
    others: Sequence[OrientedImage],
    pyramids: ImagePyramids,
    guide: Guide,
    uv: Places,
    guides: Sequence[Guide | None],
    guide_settings: GuideSettings,
    settings: MatchingSettings = MatchingSettings(),
) -> SurfaceMatches:
    """Match whole pixels of the base in the others, from its guide; `guides` of the others, if
    any, identify hidden points."""
    losses: Counter[str] = Counter()
    inner = is_inside(base, uv, settings.edge_margin)
    losses["at the edge"] += int((~inner).sum())
    uv = uv[inner]
    # q: the parameter along the line of sight (`views`), first its bounds, then its value.
    _, reach, normal, _ = guide.look_up(uv, settings.search_margin)
    q, rho, second_peak = search(base, others, pyramids, uv, reach, normal, 0, guide_settings)
    with np.errstate(invalid="ignore"):
        is_found = np.isfinite(q) & (rho >= settings.min_correlation)
        ambiguous = is_found & (second_peak > settings.max_second_ratio * rho)
    losses["in no other image at a similar scale"] += int((~np.isfinite(rho)).sum())
    losses["low correlation"] += int((~is_found & np.isfinite(rho)).sum())
    losses["not unique"] += int(ambiguous.sum())
    rows = np.flatnonzero(is_found & ~ambiguous)
    uv, q, normal = uv[rows], q[rows], normal[rows]
    X = base.points(uv, q)
    matches = _match_windows(base, others, guide, (uv, q, normal), guides, settings)
    has_enough = matches.is_used.sum(1) + 1 >= settings.min_rays
    losses["not confirmed by least squares matching"] += int((~has_enough).sum())
    uv, X = uv[has_enough], X[has_enough]
    places, is_used, covariance, in_base = (a[has_enough] for a in matches)
    mean = in_base.sum(1) / np.maximum(is_used.sum(1), 1)[:, None, None]
    table = _Rays(
        (base, *others),
        np.concatenate([uv[:, None], places], 1),
        # Half of a match's variance is due to the window in the base, half to the other window.
        np.concatenate([mean[:, None], covariance], 1) / 2,
        np.concatenate([np.ones((len(uv), 1), bool), is_used], 1),
    )
    return _accept(table, X, settings, losses)


class WindowMatches(NamedTuple):
    """Positions of points in the other images; which are used; their covariances, and these carried
    over to the base image."""

    places: Float[np.ndarray, "n others 2"]
    is_used: Bool[np.ndarray, "n others"]
    covariance: Float[np.ndarray, "n others 2 2"]
    in_base: Float[np.ndarray, "n others 2 2"]


def _match_windows(
    base: OrientedImage,
    others: Sequence[OrientedImage],
    guide: Guide,
    start: tuple[Places, Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]],
    guides: Sequence[Guide | None],
    settings: MatchingSettings,
) -> WindowMatches:
    """Least squares matching in each of the other images, from pixels, their q and normals."""
    uv, q, normal = start
    X, half_window = base.points(uv, q), settings.half_fine_window
    nodes = sharpen(base, others, guide, half_window, settings.bending, settings.windows)
    n, m = len(uv), len(others)
    out = WindowMatches(
        np.full((n, m, 2), np.nan),
        np.zeros((n, m), bool),
        np.zeros((n, m, 2, 2)),
        np.zeros((n, m, 2, 2)),
    )
    for k, other in enumerate(others):
        window = windows(base, other, X, normal)
        begin = positions(base, other, uv, q[:, None])[:, 0]
        match = refine(base, other, uv, begin, window.A, half_window, settings.windows)
        pair = base, other
        place, uncertain = correct_bending(pair, nodes, uv, q, match, half_window, settings.bending)
        uncertain = uncertain + settings.added_sigma**2 * np.eye(2)
        good = window.usable & is_confirmed(match, begin, settings)
        good &= _agrees(other, guides[k], X, settings.max_guide_distance)
        good &= has_texture(base.grey, uv, match.sigma0, half_window, settings.windows.min_texture)
        inverse_A = np.linalg.inv(np.where(good[:, None, None], match.A, np.eye(2)))
        safe = np.where(good[:, None, None], uncertain, 0)
        shifted = inverse_A @ safe @ np.swapaxes(inverse_A, 1, 2)
        out.places[:, k], out.is_used[:, k] = place, good
        out.covariance[:, k] = uncertain
        out.in_base[:, k] = np.where(good[:, None, None], shifted, 0)
    return out


def is_confirmed(
    match: SubpixelMatches, start: Places, settings: MatchingSettings
) -> Bool[np.ndarray, " n"]:
    """Whether least squares matching has converged near its start, to a similar window."""
    good = match.status == int(MatchingStatus.CONVERGED)
    good &= match.rho >= settings.min_correlation
    good &= np.linalg.norm(match.uv - start, axis=1) <= settings.max_shift
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(np.trace(match.covariance, axis1=1, axis2=2))
        return good & (sigma < settings.max_sigma)


@dataclasses.dataclass(frozen=True)
class _Rays:
    """Positions of points in the base image and the others, with their covariances."""

    views: tuple[OrientedImage, ...]
    uv: Float[np.ndarray, "n views 2"]
    covariance: Float[np.ndarray, "n views 2 2"]
    is_used: Bool[np.ndarray, "n views"]

    def intersect(self, start: Float[np.ndarray, "n 3"]) -> IntersectedPoints:
        return intersect(self.views, self.uv, self.covariance, self.is_used, start)


def _accept(
    table: _Rays,
    X: Float[np.ndarray, "n 3"],
    settings: MatchingSettings,
    losses: Counter[str],
) -> SurfaceMatches:
    """Intersect; an inconsistent point with rays to spare loses its worst one, and is rejected if
    it stays inconsistent."""
    intersected = table.intersect(X)
    factor = variance_factor(intersected.vtpv, intersected.redundancy)
    shape = _shape_variance(table, intersected, factor, settings) if factor < 1 else None
    if shape is None:
        factor, shape = max(factor, 1.0), np.zeros_like(intersected.covariance)
    bad = _find_misfits(intersected, factor, settings.significance)
    # With two rays it cannot be told which is wrong.
    has_several = bad & (intersected.rays > max(settings.min_rays, 2))
    if has_several.any():
        table, intersected = _drop_worst_rays(table, intersected, has_several)
        bad = _find_misfits(intersected, factor, settings.significance)
    narrow = ~(intersected.angle >= settings.min_angle)
    undetermined = ~np.isfinite(intersected.covariance).all((1, 2)) | ~np.isfinite(
        intersected.X
    ).all(1)
    losses["undetermined"] += int(undetermined.sum())
    losses["narrow angle"] += int((narrow & ~undetermined).sum())
    losses["rays do not meet"] += int((bad & ~narrow & ~undetermined).sum())
    good = ~(bad | narrow | undetermined)
    covariance = factor * intersected.covariance[good] + shape[good]
    of_orientation = orientation_covariance(table.views, intersected.X[good], table.is_used[good])
    covariance += of_orientation
    return SurfaceMatches(
        table.uv[good, 0],
        intersected.X[good],
        covariance,
        intersected.rays[good],
        factor,
        {reason: number for reason, number in losses.items() if number},
        of_orientation[:, 2, 2],
    )


def variance_factor(
    vtpv: Float[np.ndarray, " n"], redundancy: Int[np.ndarray, " n"], min_points: int = 30
) -> float:
    """The median of vᵀPv over that of its distribution, 1 for fewer than `min_points`: of 30 values
    of χ²₁ the median has a standard deviation of 43 %, and a factor from fewer says nothing."""
    good = np.isfinite(vtpv) & (redundancy > 0)
    if good.sum() < min_points:
        return 1.0
    return float(np.median(vtpv[good] / special.chdtri(redundancy[good], 0.5)))


def _shape_variance(
    table: _Rays, intersected: IntersectedPoints, factor: float, settings: MatchingSettings
) -> Float[np.ndarray, "n 3 3"] | None:
    """The variance along the lines of sight that points on a grid have, by their scatter, beyond
    the covariances of their matches; None if it is not known."""
    good = np.isfinite(intersected.covariance).all((1, 2)) & np.isfinite(intersected.X).all(1)
    if good.sum() < settings.block_side**2:
        return None
    base, *others = table.views
    X, place = intersected.X[good], table.uv[good, 0].astype(int)
    step = int(np.gcd.reduce(np.diff(np.unique(place[:, 0])))) or 1
    column, row = ((place - place.min(0)) // step).T
    # Along the line of sight d: σ of each point, and the length that moves it by one pixel in the
    # other image where it moves most.
    d = line_of_sight(base.derivative(X))
    sigma_along = np.sqrt(factor * np.einsum("ni,nij,nj->n", d, intersected.covariance[good], d))
    pixels_per_length = [
        np.linalg.norm(o.derivative(X) @ d[:, :, None], axis=(1, 2)) for o in others
    ]
    length_of_pixel = 1 / np.max(
        np.where(table.is_used[good, 1:], np.stack(pixels_per_length, 1), 0), 1
    )
    q = base.parameter(X)
    rate = np.abs(base.parameter(X + sigma_along[:, None] * d) - q) / sigma_along

    def on_grid(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, "r c"]:
        grid = np.full((row.max() + 1, column.max() + 1), np.nan)
        grid[row, column] = values
        return grid

    # Points whose windows do not overlap.
    window_distance = -(-(2 * settings.half_fine_window + 1) // step)
    missing_noise = missing_sigma(
        on_grid(q),
        on_grid(rate * sigma_along),
        on_grid(rate * length_of_pixel),
        window_distance,
        settings.block_side,
        settings.scatter_quantile,
    )
    if missing_noise is None:
        return None
    # Scatter beyond the σ that the matches have without the factor is the shape of the surface.
    missing_noise = min(
        missing_noise, np.sqrt(1 / factor - 1) * np.median(sigma_along / length_of_pixel)
    )
    C = np.zeros_like(intersected.covariance)
    C[good] = ((missing_noise * length_of_pixel) ** 2)[:, None, None] * d[:, :, None] * d[:, None]
    return C


def _find_misfits(
    intersected: IntersectedPoints, factor: float, significance: float
) -> Bool[np.ndarray, " n"]:
    """Points whose rays do not meet: vᵀPv beyond its distribution, or not known."""
    limit = special.chdtri(np.maximum(intersected.redundancy, 1), significance)
    return ~(intersected.vtpv <= limit * factor)


def _drop_worst_rays(
    table: _Rays, intersected: IntersectedPoints, has_several: Bool[np.ndarray, " n"]
) -> tuple[_Rays, IntersectedPoints]:
    """Intersect some points again without the ray of the largest residual; the base ray stays."""
    is_used = table.is_used.copy()
    rows = np.flatnonzero(has_several)
    misfit = np.where(is_used[rows][:, 1:], intersected.misfit[rows][:, 1:], -1)
    is_used[rows, 1 + misfit.argmax(1)] = False
    table = dataclasses.replace(table, is_used=is_used)
    intersected_again = dataclasses.replace(
        table, uv=table.uv[rows], covariance=table.covariance[rows], is_used=is_used[rows]
    ).intersect(intersected.X[rows])
    fields = {}
    for field in dataclasses.fields(intersected):
        values = getattr(intersected, field.name).copy()
        values[rows] = getattr(intersected_again, field.name)
        fields[field.name] = values
    return table, IntersectedPoints(**fields)


def _agrees(
    other: OrientedImage, guide: Guide | None, X: Float[np.ndarray, "n 3"], max_distance: float
) -> Bool[np.ndarray, " n"]:
    """Whether the guide of the other image has its surface at X, within `max_distance` pixels of
    the images that the guide was matched with."""
    if guide is None:
        return np.ones(len(X), bool)
    uv = other.project(X)
    is_in_image = is_inside(other, uv)
    safe = np.where(is_in_image[:, None], uv, 0.0)
    _, reach, _, _ = guide.look_up(safe, max_distance)
    with np.errstate(invalid="ignore"):
        q = other.parameter(X)
        return is_in_image & (q >= reach[:, 0]) & (q <= reach[:, 1])
