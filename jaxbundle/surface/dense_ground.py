"""A cloud of most pixels of scanner and RPC images: straightened pieces, matched densely with one
or several others, and one point of every pixel from the rays of all its matches that agree.

Every match gives a point of its own first, with the σ of its height. Of several, those that agree
are used together (`dense_cloud.consistent`), as in the cloud of photographs: one intersection of
the base's ray with all theirs (`intersection`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.surface.bounds import Bounds
from jaxbundle.surface.cloud import Cloud, merge
from jaxbundle.surface.dense import match_dense
from jaxbundle.surface.dense_cloud import consistent
from jaxbundle.surface.generic_rectification import straighten
from jaxbundle.surface.guide import Guide
from jaxbundle.surface.intersection import Intersected, intersect
from jaxbundle.surface.segments import windows
from jaxbundle.surface.views import OrientedImage, line_of_sight

PIECE = 1500
"""Side of a piece of the base image, pixels."""
POINTS_AT_ONCE = 1 << 17
"""Points intersected together."""
MOST_DISPARITIES = 200


class _Matches(NamedTuple):
    """Positions in another image of pixels of a piece, σ of their disparities (NaN: no match); the
    parameter at which their search starts; the variance factor of the pair."""

    other: OrientedImage
    place: Float[np.ndarray, "n 2"]
    sigma: Float[np.ndarray, " n"]
    q0: float
    factor: float


def dense_ground_cloud(
    base: OrientedImage,
    others: Sequence[OrientedImage],
    guide: Guide,
    bounds: Bounds,
    step: int = 1,
) -> tuple[Cloud, list[tuple[str, float]], list[str]]:
    """The cloud, at most one point a pixel; name and variance factor of each image used; those that
    could not be used.

    All disparities between the bounds are searched, since houses may be between the nodes of a
    guide; if these are very many, only those near the guide.
    """
    clouds = []
    factors: dict[str, list[float]] = {other.name: [] for other in others}
    columns, rows = base.size
    for u0 in range(0, columns, PIECE):
        for v0 in range(0, rows, PIECE):
            window = u0, v0, min(u0 + PIECE, columns) - 1, min(v0 + PIECE, rows) - 1
            # one grid over all pieces
            u, v = (
                np.arange(-(-first // step) * step, last + 1, step)
                for first, last in zip(window[:2], window[2:])
            )
            uv = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2).astype(float)
            tried = (_match(base, other, guide, bounds, window, uv) for other in others)
            found = [one for one in tried if one is not None]
            for one in found:
                factors[one.other.name].append(one.factor)
            if found:
                clouds += [
                    _points(base, found, uv, slice(k, k + POINTS_AT_ONCE))
                    for k in range(0, len(uv), POINTS_AT_ONCE)
                ]
    used = [(name, float(np.mean(values))) for name, values in factors.items() if values]
    none = np.zeros
    empty = Cloud(
        none((0, 3)), none((0, 3, 3)), none(0, int), none(0, int), none((0, 2)), (base.name,)
    )
    return merge([*clouds, empty]), used, [name for name in factors if not factors[name]]


def _match(base, other, guide, bounds, window, pixels) -> _Matches | None:
    """What a pair says of pixels of a piece; None: it cannot be straightened."""
    u0, v0, u1, v1 = window
    row, column = np.nonzero(guide.good)
    uv = np.stack([column, row], 1) * guide.step + guide.first
    inside = (uv >= [u0, v0]).all(1) & (uv <= [u1, v1]).all(1)
    if inside.sum() < 5:
        return None
    uv = uv[inside]
    ends = [base.points(uv, q) for q in bounds(uv).T]
    reach = np.linalg.norm(other.project(ends[1]) - other.project(ends[0]), axis=1)
    X = base.points(uv, guide.q[row, column][inside])
    if np.nanmedian(reach) < MOST_DISPARITIES:
        X = np.concatenate(ends)
    straightened = straighten(base, other, window, X)
    if straightened is None:
        return None
    pair, span = straightened
    found = match_dense(pair, span)
    ab = pair.columns_rows(pixels)
    place = np.clip(np.rint(ab).astype(int), 0, np.array(found.disparity.shape)[::-1] - 1)
    at = lambda a: a[place[:, 1], place[:, 0]]
    d, sigma = at(found.disparity), at(found.sigma)
    known = np.isfinite(d) & np.isfinite(sigma)
    # the slope of the disparities takes the value of the nearest column to the pixel itself
    slopes = [np.nan_to_num(at(np.gradient(found.disparity, axis=axis))) for axis in (1, 0)]
    slopes = [np.where(np.abs(s) < 0.5, s, 0) for s in slopes]
    d = d + slopes[0] * (ab - place)[:, 0] + slopes[1] * (ab - place)[:, 1] + pair.lowest
    match, rows = np.full((len(pixels), 2), np.nan), np.flatnonzero(known)
    for k in range(0, len(rows), POINTS_AT_ONCE):
        part = rows[k : k + POINTS_AT_ONCE]
        shifted = pair.base_places(ab[part] - np.stack([d[part], np.zeros(len(part))], 1))
        match[part] = other.project(base.points(shifted, np.full(len(part), pair.q0)))
    known &= np.isfinite(match).all(1)
    return _Matches(other, match, np.where(known, sigma, np.nan), pair.q0, found.factor)


def _points(base, found: Sequence[_Matches], uv, rows) -> Cloud:
    """The points of some pixels: of each the rays of all matches that agree."""
    uv = uv[rows]
    sigma = np.stack([one.sigma[rows] for one in found])
    keep = np.isfinite(sigma).any(0)
    uv, sigma = uv[keep], sigma[:, keep]
    places = np.stack([uv, *(one.place[rows][keep] for one in found)], 1)
    n, views = len(uv), (base, *(one.other for one in found))
    start = base.points(uv, np.full(n, found[0].q0))
    # half of a match's variance is of the window in the base
    own = np.stack(
        [
            0.5 * s[:, None, None] ** 2 * _to_other(base, one.other, start)
            for one, s in zip(found, sigma)
        ],
        1,
    )

    def rays(matched) -> Intersected:
        number = np.maximum(matched.sum(0), 1)
        shared = 0.5 * np.where(matched, sigma, 0.0) ** 2
        at_base = (shared.sum(0) / number)[:, None, None] * np.eye(2)
        used = np.concatenate([matched.any(0)[None], matched]).T
        covariance = np.concatenate([at_base[:, None], own], 1)
        return intersect(views, np.nan_to_num(places), covariance, used, start)

    known = np.asarray(np.isfinite(sigma))
    if len(found) > 1:
        q, spread = (np.full(sigma.shape, np.nan) for _ in range(2))
        for k in range(len(found)):
            only = np.zeros_like(known)
            only[k] = known[k]
            q[k], spread[k] = _parameter(base, rays(only), only[k])
        known = consistent(q, spread)
    cloud = rays(known)
    good = np.isfinite(cloud.covariance).all((1, 2)) & np.isfinite(cloud.X).all(1) & known.any(0)
    return Cloud(
        cloud.X[good],
        cloud.covariance[good].astype(np.float32),
        cloud.rays[good].astype(np.int16),
        np.zeros(int(good.sum()), np.int16),
        uv[good].astype(np.float32),
        (base.name,),
    )


def _to_other(base, other, X) -> Float[np.ndarray, "n 2 2"]:
    """A·Aᵀ of the windows around points."""
    A = windows(base, other, X).A
    A = np.where(np.isfinite(A), A, np.eye(2))
    return A @ np.swapaxes(A, 1, 2)


def _parameter(base, found: Intersected, matched):
    """q of points on their lines of sight in the base, and its σ; NaN: none."""
    X = np.where(matched[:, None], found.X, np.nan)
    known = np.isfinite(X).all(1) & np.isfinite(found.covariance).all((1, 2))
    safe = np.where(np.expand_dims(known, 1), X, found.X[known][:1] if known.any() else 0.0)
    d = line_of_sight(base.derivative(safe))
    with np.errstate(invalid="ignore"):
        along = np.sqrt(np.einsum("ni,nij,nj->n", d, found.covariance, d))
    q = base.parameter(safe)
    spread = np.abs(base.parameter(safe + np.nan_to_num(along)[:, None] * d) - q)
    return np.where(known, q, np.nan), np.where(known, spread, np.nan)
