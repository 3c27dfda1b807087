"""A cloud of most pixels of scanner and RPC images: straightened pieces, matched densely, their
rays intersected.
"""

from collections.abc import Sequence

import numpy as np

from jaxbundle.surface.bounds import Bounds
from jaxbundle.surface.cloud import Cloud, merge
from jaxbundle.surface.dense import match_dense
from jaxbundle.surface.generic_rectification import straighten
from jaxbundle.surface.guide import Guide
from jaxbundle.surface.intersection import intersect
from jaxbundle.surface.segments import windows
from jaxbundle.surface.views import OrientedImage

PIECE = 1500
"""Side of a piece of the base image, pixels."""
POINTS_AT_ONCE = 1 << 17
"""Points intersected together."""
MOST_DISPARITIES = 200


def dense_ground_cloud(
    base: OrientedImage, others: Sequence[OrientedImage], guide: Guide, bounds: Bounds,
    step: int = 1,
) -> tuple[Cloud, list[tuple[str, float]], list[str]]:
    """The cloud; name and variance factor of each image used; those that could not be used.

    All disparities between the bounds are searched, since houses may be between the nodes of a
    guide; if these are very many, only those near the guide.
    """
    clouds, used, left_out = [], [], []
    columns, rows = base.size
    for other in others:
        factors = []
        for u0 in range(0, columns, PIECE):
            for v0 in range(0, rows, PIECE):
                window = u0, v0, min(u0 + PIECE, columns) - 1, min(v0 + PIECE, rows) - 1
                found = _piece(base, other, guide, bounds, window, step)
                if found is not None:
                    clouds.append(found[0])
                    factors.append(found[1])
        if factors:
            used.append((other.name, float(np.mean(factors))))
        else:
            left_out.append(other.name)
    none = np.zeros
    empty = Cloud(none((0, 3)), none((0, 3, 3)), none(0, int), none(0, int), none((0, 2)),
                  (base.name,))  # fmt: skip
    return merge([*clouds, empty]), used, left_out


def _piece(base, other, guide, bounds, window, step):
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
    v, u = np.mgrid[v0 : v1 + 1 : step, u0 : u1 + 1 : step].reshape(2, -1)
    uv = np.stack([u, v], 1).astype(float)
    ab = pair.columns_rows(uv)
    place = np.clip(np.rint(ab).astype(int), 0, np.array(found.disparity.shape)[::-1] - 1)
    at = lambda a: a[place[:, 1], place[:, 0]]
    d, sigma = at(found.disparity), at(found.sigma)
    keep = np.isfinite(d) & np.isfinite(sigma)
    # the slope of the disparities takes the value of the nearest column to the pixel itself
    slopes = [np.nan_to_num(at(np.gradient(found.disparity, axis=axis))) for axis in (1, 0)]
    slopes = [np.where(np.abs(s) < 0.5, s, 0) for s in slopes]
    d = d + slopes[0] * (ab - place)[:, 0] + slopes[1] * (ab - place)[:, 1]
    uv, ab, d, sigma = uv[keep], ab[keep], d[keep] + pair.lowest, sigma[keep]
    parts = [
        _intersect(base, other, pair, *(a[k : k + POINTS_AT_ONCE] for a in (uv, ab, d, sigma)))
        for k in range(0, len(uv), POINTS_AT_ONCE)
    ]
    if not parts:
        return None
    return merge(parts), found.factor


def _intersect(base, other, pair, uv, ab, d, sigma):
    shifted = pair.base_places(ab - np.stack([d, np.zeros_like(d)], 1))
    seen_at = base.points(shifted, np.full(len(shifted), pair.q0))
    match = other.project(seen_at)
    start = base.points(uv, np.full(len(uv), pair.q0))
    shape = windows(base, other, start)
    A = np.where(np.isfinite(shape.A), shape.A, np.eye(2))
    variance = sigma[:, None, None] ** 2 / 2
    covariance = np.stack([variance * np.eye(2), variance * (A @ np.swapaxes(A, 1, 2))], 1)
    used = np.ones((len(uv), 2), bool) & np.isfinite(match).all(1)[:, None]
    found = intersect((base, other), np.stack([uv, match], 1), covariance, used, start)
    good = np.isfinite(found.covariance).all((1, 2)) & np.isfinite(found.X).all(1)
    return Cloud(
        found.X[good], found.covariance[good].astype(np.float32),
        found.rays[good].astype(np.int16), np.zeros(int(good.sum()), np.int16),
        uv[good].astype(np.float32), (base.name,),
    )  # fmt: skip
