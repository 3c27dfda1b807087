"""Matching and intersection of points of a base image: from pixels to points with covariance.

    guide → position in all images at once → least squares matching in each → bending corrected
    → checks → intersection

The residuals across the epipolar lines are errors of the same matching that gives the heights: the
median of vᵀC⁻¹v over its expectation is the variance factor by which all covariances are
multiplied. It includes error sources unknown to the matching, such as small errors of orientation.
Below 1 it means that the differences of the windows are finer than those that shift them. But the
shape of the surface within the windows shifts all matches of a point along its line of sight, which
no residual shows. The scatter of the points (`scatter.py`) does: what it has beyond their
covariances is added, the same for all points in pixels. Where it is not known, the factor is at
least 1.
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
from jaxbundle.surface.scatter import missing_sigma
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
            back @ np.where(good[:, None, None], uncertain, 0) @ np.swapaxes(back, 1, 2),
            0,
        )
        used[:, k] = good
    enough = used.sum(1) + 1 >= settings.least_rays
    lost["not confirmed by least squares matching"] += int((~enough).sum())
    take = lambda *arrays: [a[enough] for a in arrays]
    uv, X, places, used, covariance, own, rhos = take(uv, X, places, used, covariance, own, rhos)
    mean = own.sum(1) / np.maximum(used.sum(1), 1)[:, None, None]
    table = _Rays(
        (base, *others),
        np.concatenate([uv[:, None], places], 1),
        np.concatenate([mean[:, None], np.where(used[..., None, None], covariance, 1)], 1) / 2,
        np.concatenate([np.ones((len(uv), 1), bool), used], 1),
    )
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
    shape = _shape_variance(table, found, factor, settings) if factor < 1 else None
    if shape is None:
        factor, shape = max(factor, 1.0), np.zeros_like(found.covariance)
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
        rho = (
            np.nanmin(np.where(table.used[good][:, 1:], rhos[good], np.nan), axis=1)
            if (good.any())
            else np.zeros(0)
        )
    covariance = factor * found.covariance[good] + shape[good]
    covariance += orientation_covariance(table.views, found.X[good], table.used[good])
    return Matches(
        uv[good],
        found.X[good],
        covariance,
        found.rays[good],
        found.angle[good],
        rho,
        np.where(table.used[good][:, 1:, None], table.uv[good][:, 1:], np.nan),
        factor,
        {reason: number for reason, number in lost.items() if number},
    )


def variance_factor(
    vtpv: Float[np.ndarray, " n"], redundancy: Int[np.ndarray, " n"], least: int = 30
) -> float:
    """The median of vᵀPv over that of its distribution, 1 for fewer than `least` points."""
    good = np.isfinite(vtpv) & (redundancy > 0)
    if good.sum() < least:
        return 1.0
    return float(np.median(vtpv[good] / stats.chi2.median(redundancy[good])))


def _shape_variance(table, found, factor, settings) -> Float[np.ndarray, "n 3 3"] | None:
    """The variance along the lines of sight that points on a grid have, by their scatter, beyond
    the covariances of their matches; None if it is not known."""
    good = np.isfinite(found.covariance).all((1, 2)) & np.isfinite(found.X).all(1)
    if good.sum() < BLOCK_SIDE**2:
        return None
    base, *others = table.views
    X, place = found.X[good], table.uv[good, 0].astype(int)
    step = int(np.gcd.reduce(np.diff(np.unique(place[:, 0])))) or 1
    column, row = ((place - place.min(0)) // step).T
    d = line_of_sight(base.derivative(X))
    along = np.sqrt(factor * np.einsum("ni,nij,nj->n", d, found.covariance[good], d))
    moved = [np.linalg.norm(o.derivative(X) @ d[:, :, None], axis=(1, 2)) for o in others]
    pixel = 1 / np.max(np.where(table.used[good, 1:], np.stack(moved, 1), 0), 1)
    q = base.parameter(X)
    rate = np.abs(base.parameter(X + along[:, None] * d) - q) / along

    def on_grid(values):
        grid = np.full((row.max() + 1, column.max() + 1), np.nan)
        grid[row, column] = values
        return grid

    apart = -(-(2 * settings.fine + 1) // step)
    missing = missing_sigma(
        on_grid(q), on_grid(rate * along), on_grid(rate * pixel), apart, BLOCK_SIDE, SMOOTH
    )
    if missing is None:
        return None
    # what is more than the matches have without a factor is the surface itself
    missing = min(missing, np.sqrt(1 / factor - 1) * np.median(along / pixel))
    C = np.zeros_like(found.covariance)
    C[good] = ((missing * pixel) ** 2)[:, None, None] * d[:, :, None] * d[:, None]
    return C


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
