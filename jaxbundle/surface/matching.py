"""Matching and intersection of points of a base image: from pixels to points with covariance.

    guide → position in all images at once → least squares matching in each → bending corrected
    → checks → intersection

The residuals across the epipolar lines are errors of the same matching that gives the heights: the
median of vᵀC⁻¹v over its expectation is the variance factor by which all covariances are
multiplied. It includes error sources unknown to the matching, such as small errors of orientation.
Below 1 it means that the differences of the windows are finer than those that shift them; but
errors along the epipolar lines may be larger, due to the shape of the surface, so that it
is used only as far as the scatter of the surface agrees (`scatter.py`).
"""

import dataclasses
from collections import Counter
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

from jaxbundle.display import print_in_one_screen
from jaxbundle.measure.least_squares_matching import MatchingStatus
from jaxbundle.surface.bending import correct_bending, sharpen
from jaxbundle.surface.correlation import Pyramid
from jaxbundle.surface.guide import Guide, search
from jaxbundle.surface.intersection import Intersected, intersect
from jaxbundle.surface.orientation import orientation_covariance
from jaxbundle.surface.refinement import has_texture, refine
from jaxbundle.surface.scatter import scatter_factor
from jaxbundle.surface.segments import positions, windows
from jaxbundle.surface.views import OrientedImage, is_inside, line_of_sight

SEARCH = 2.0
"""Pixels of the full image searched beyond the guide's range."""
LEAST_CORRELATION = 0.6
LEAST_SIGMA, MOST_SIGMA = 0.012, 0.5
"""Pixels: σ added to a match by interpolation and sampling, and the limit above which the texture
does not determine it."""
LARGEST_SECOND = 0.95
"""Maximum ratio of ρ of the second best separate position to that of the best."""
CONSISTENT = 1.5
"""Maximum distance of a point from the guide of the other image, pixels."""
LARGEST_SHIFT = 2.5
"""Maximum distance of least squares matching from the position of the correlation, pixels."""
BLOCK_SIDE, SMOOTH = 16, 0.45
"""Points per side of a block for the scatter; the quantile of the blocks used, in
the smoother direction."""
SIGNIFICANCE = 1e-3
"""Level of the test of a point's residuals."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """What is matched: windows of 2·`half` + 1 pixels for correlation, 2·`fine` + 1 for least
    squares matching, whose plane a bent surface leaves in large ones; rays and angle (radians) of a
    point.
    """

    half: int = 8
    fine: int = 6
    least_correlation: float = LEAST_CORRELATION
    least_rays: int = 2
    least_angle: float = np.radians(1.0)


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Matches:
    """Points from a base image: their pixels, points, and rejected ones by reason.

    `factor`: the variance factor of the covariances.
    """

    uv: Float[np.ndarray, "n 2"]
    X: Float[np.ndarray, "n 3"]
    covariance: Float[np.ndarray, "n 3 3"]
    rays: Int[np.ndarray, " n"]
    angle: Float[np.ndarray, " n"]
    rho: Float[np.ndarray, " n"]
    places: Float[np.ndarray, "n others 2"]
    factor: float
    rejected: dict[str, int]


def match_points(
    base: OrientedImage,
    others: Sequence[OrientedImage],
    pyramids: tuple[Pyramid, Sequence[Pyramid]],
    guide: Guide,
    uv: Float[np.ndarray, "n 2"],
    guides: Sequence[Guide | None],
    settings: Settings = Settings(),
) -> Matches:
    """Match whole pixels of the base in the others, from its guide; `guides` of the others, if
    any, identify hidden points."""
    lost: Counter = Counter()
    half = settings.half
    keep = is_inside(base, uv, half)
    lost["at the edge"] += int((~keep).sum())
    uv = uv[keep]
    q, reach, normal, rate = guide.around(uv, SEARCH)
    q, rho, second = search(base, others, pyramids, uv, reach, normal, 0, half)
    with np.errstate(invalid="ignore"):
        found = np.isfinite(q) & (rho >= settings.least_correlation)
        double = found & (second > LARGEST_SECOND * rho)
    lost["low correlation"] += int((~found).sum())
    lost["not unique"] += int(double.sum())
    rows = np.flatnonzero(found & ~double)
    uv, q, normal, rate = uv[rows], q[rows], normal[rows], rate[rows]
    X = base.points(uv, q)
    sharp = sharpen(base, others, guide, settings.fine)
    n, m = len(uv), len(others)
    places, used = np.full((n, m, 2), np.nan), np.zeros((n, m), bool)
    covariance, own = np.zeros((n, m, 2, 2)), np.zeros((n, m, 2, 2))
    rhos = np.full((n, m), np.nan)
    for k, other in enumerate(others):
        shape = windows(base, other, X, normal)
        start = positions(base, other, uv, q[:, None])[:, 0]
        match = refine(base, other, uv, start, shape.A, settings.fine)
        place, uncertain = correct_bending((base, other), sharp, uv, q, match, settings.fine)
        uncertain = uncertain + LEAST_SIGMA**2 * np.eye(2)
        places[:, k], covariance[:, k], rhos[:, k] = place, uncertain, match.rho
        good = shape.usable & (match.status == int(MatchingStatus.CONVERGED))
        good &= match.rho >= settings.least_correlation
        good &= np.linalg.norm(match.uv - start, axis=1) <= LARGEST_SHIFT
        with np.errstate(invalid="ignore"):
            good &= np.sqrt(np.trace(match.covariance, axis1=1, axis2=2)) < MOST_SIGMA
        good &= _agrees(base, other, guides[k], X)
        good &= has_texture(base.grey, uv, match.sigma0, settings.fine)
        safe = np.where(good[:, None, None], match.A, np.eye(2))
        back = np.linalg.inv(safe)
        own[:, k] = np.where(
            good[:, None, None],
            back @ np.where(good[:, None, None], uncertain, 0) @ np.swapaxes(back, 1, 2), 0
        )  # fmt: skip
        used[:, k] = good
    enough = used.sum(1) + 1 >= settings.least_rays
    lost["not confirmed by least squares matching"] += int((~enough).sum())
    take = lambda *arrays: [a[enough] for a in arrays]
    uv, X, places, used, covariance, own, rhos = take(
        uv, X, places, used, covariance, own, rhos
    )
    mean = own.sum(1) / np.maximum(used.sum(1), 1)[:, None, None]
    table = _Rays(
        (base, *others), np.concatenate([uv[:, None], places], 1),
        np.concatenate([mean[:, None], np.where(used[..., None, None], covariance, 1)], 1) / 2,
        np.concatenate([np.ones((len(uv), 1), bool), used], 1),
    )  # fmt: skip
    return _accept(table, X, uv, rhos, settings, lost)


@dataclasses.dataclass(frozen=True)
class _Rays:
    views: tuple
    uv: Float[np.ndarray, "n views 2"]
    covariance: Float[np.ndarray, "n views 2 2"]
    used: Bool[np.ndarray, "n views"]

    def intersect(self, start) -> Intersected:
        return intersect(self.views, self.uv, self.covariance, self.used, start)


def _accept(table, X, uv, rhos, settings, lost) -> Matches:
    """Intersect; inconsistent rays are left out, inconsistent points are rejected."""
    found = table.intersect(X)
    factor = variance_factor(found.vtpv, found.redundancy)
    if factor < 1:
        factor = min(1.0, max(factor, _scatter(table.views[0], uv, found, settings)))
    bad = _misfits(found, factor)
    several = bad & (found.rays > max(settings.least_rays, 2))
    if several.any():
        table, found = _without_the_worst(table, found, several)
        bad = _misfits(found, factor)
    narrow = ~(found.angle >= settings.least_angle)
    undetermined = ~np.isfinite(found.covariance).all((1, 2)) | ~np.isfinite(found.X).all(1)
    lost["undetermined"] += int(undetermined.sum())
    lost["narrow angle"] += int((narrow & ~undetermined).sum())
    lost["rays do not meet"] += int((bad & ~narrow & ~undetermined).sum())
    good = ~(bad | narrow | undetermined)
    with np.errstate(invalid="ignore"):
        rho = np.nanmin(np.where(table.used[good][:, 1:], rhos[good], np.nan), axis=1) if (
            good.any()
        ) else np.zeros(0)
    covariance = factor * found.covariance[good]
    covariance += orientation_covariance(table.views, found.X[good], table.used[good])
    return Matches(
        uv[good], found.X[good], covariance, found.rays[good],
        found.angle[good], rho,
        np.where(table.used[good][:, 1:, None], table.uv[good][:, 1:], np.nan), factor,
        {reason: number for reason, number in lost.items() if number},
    )  # fmt: skip


def variance_factor(
    vtpv: Float[np.ndarray, " n"], redundancy: Int[np.ndarray, " n"], least: int = 30
) -> float:
    """The median of vᵀPv over that of its distribution, 1 for fewer than `least` points."""
    good = np.isfinite(vtpv) & (redundancy > 0)
    if good.sum() < least:
        return 1.0
    return float(np.median(vtpv[good] / stats.chi2.median(redundancy[good])))


def _scatter(base, uv, found, settings) -> float:
    """The variance factor of points on a grid by their scatter, 1 if they are not on a grid."""
    good = np.isfinite(found.covariance).all((1, 2)) & np.isfinite(found.X).all(1)
    if good.sum() < BLOCK_SIDE**2:
        return 1.0
    X, C, place = found.X[good], found.covariance[good], uv[good].astype(int)
    step = int(np.gcd.reduce(np.diff(np.unique(place[:, 0])))) or 1
    column, row = ((place - place.min(0)) // step).T
    q = base.parameter(X)
    d = line_of_sight(base.derivative(X))
    scale = np.sqrt(np.einsum("ni,nij,nj->n", d, C, d))
    rate = np.abs(base.parameter(X + scale[:, None] * d) - q)
    values, sigma = np.full((2, row.max() + 1, column.max() + 1), np.nan)
    values[row, column], sigma[row, column] = q, rate
    apart = -(-(2 * settings.fine + 1) // step)
    return min(scatter_factor(values, sigma, apart, BLOCK_SIDE, SMOOTH), default=1.0)


def _misfits(found: Intersected, factor: float) -> Bool[np.ndarray, " n"]:
    limit = stats.chi2.isf(SIGNIFICANCE, np.maximum(found.redundancy, 1))
    return ~(found.vtpv <= limit * factor)


def _without_the_worst(table, found, several):
    """The points again without the ray with the largest residual, other than the base ray."""
    used = table.used.copy()
    rows = np.flatnonzero(several)
    misfit = np.where(used[rows][:, 1:], found.misfit[rows][:, 1:], -1)
    used[rows, 1 + misfit.argmax(1)] = False
    table = dataclasses.replace(table, used=used)
    again = dataclasses.replace(
        table, uv=table.uv[rows], covariance=table.covariance[rows], used=used[rows]
    ).intersect(found.X[rows])
    fields = {}
    for f in dataclasses.fields(found):
        values = getattr(found, f.name).copy()
        values[rows] = getattr(again, f.name)
        fields[f.name] = values
    return table, Intersected(**fields)


def _agrees(base, other, guide, X) -> Bool[np.ndarray, " n"]:
    """Whether the guide of the other image has its surface at X, within pixels of the base."""
    if guide is None:
        return np.ones(len(X), bool)
    uv = other.project(X)
    there = is_inside(other, uv)
    safe = np.where(there[:, None], uv, 0.0)
    _, reach, _, rate = guide.around(safe, CONSISTENT)
    with np.errstate(invalid="ignore"):
        q = other.parameter(X)
        return there & (q >= reach[:, 0]) & (q <= reach[:, 1])
