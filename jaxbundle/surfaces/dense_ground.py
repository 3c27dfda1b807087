"""A cloud of most pixels of scanner and RPC images: straightened pieces, matched densely with one
or several others, and one point of every pixel from the rays of all its matches that agree.

Every match gives a point of its own first, with the σ of its height. Of several, those that agree
are used together (`dense_cloud.consistent`), as in the cloud of photographs: one intersection of
the base's ray with all theirs (`intersection`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.surfaces.bounds import Bounds
from jaxbundle.surfaces.cloud import Cloud, empty_cloud, merge
from jaxbundle.surfaces.dense import DenseSettings, match_dense
from jaxbundle.surfaces.dense_cloud import consistent
from jaxbundle.surfaces.generic_rectification import straighten
from jaxbundle.surfaces.guide import Guide
from jaxbundle.surfaces.intersection import IntersectedPoints, intersect
from jaxbundle.surfaces.orientation import orientation_covariance
from jaxbundle.surfaces.segments import windows
from jaxbundle.surfaces.views import OrientedImage, Places, line_of_sight

# Points projected or intersected together: the temporary arrays take about 100 MB.
POINTS_AT_ONCE = 1 << 17


class _PieceMatches(NamedTuple):
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
    step: int,
    settings: DenseSettings,
) -> tuple[Cloud, list[tuple[str, float]], list[str]]:
    """The cloud, at most one point a pixel; name and variance factor of each image used; those that
    could not be used.

    All disparities between the bounds are searched, since houses may be between the nodes of a
    guide; if these are very many, only those near the guide.
    """
    clouds = []
    factors: dict[str, list[float]] = {other.name: [] for other in others}
    columns, rows = base.size
    piece = settings.ground_piece
    for u0 in range(0, columns, piece):
        for v0 in range(0, rows, piece):
            window = u0, v0, min(u0 + piece, columns) - 1, min(v0 + piece, rows) - 1
            # One grid over all pieces.
            u, v = (
                np.arange(-(-first // step) * step, last + 1, step)
                for first, last in zip(window[:2], window[2:])
            )
            uv = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2).astype(float)
            matched = (
                _match_piece(base, other, guide, bounds, window, uv, settings) for other in others
            )
            matches = [match for match in matched if match is not None]
            for match in matches:
                factors[match.other.name].append(match.factor)
            if matches:
                clouds += [
                    _intersect(
                        base, matches, uv, slice(k, k + POINTS_AT_ONCE), settings.max_difference
                    )
                    for k in range(0, len(uv), POINTS_AT_ONCE)
                ]
    used_images = [(name, float(np.mean(values))) for name, values in factors.items() if values]
    return (
        merge([*clouds, empty_cloud(base.name)]),
        used_images,
        [name for name in factors if not factors[name]],
    )


def _match_piece(
    base: OrientedImage,
    other: OrientedImage,
    guide: Guide,
    bounds: Bounds,
    window: tuple[int, int, int, int],
    pixels: Places,
    settings: DenseSettings,
) -> _PieceMatches | None:
    """What a pair says of pixels of a piece; None: it cannot be straightened."""
    u0, v0, u1, v1 = window
    row, column, uv = guide.good_nodes()
    is_in_piece = (uv >= [u0, v0]).all(1) & (uv <= [u1, v1]).all(1)
    # Fewer nodes do not determine a direction of epipolar lines and a range: the corner of an image
    if is_in_piece.sum() < 5:
        return None
    uv = uv[is_in_piece]
    ends = [base.points(uv, q) for q in bounds(uv).T]
    reach = np.linalg.norm(other.project(ends[1]) - other.project(ends[0]), axis=1)
    X = base.points(uv, guide.q[row, column][is_in_piece])
    if np.nanmedian(reach) < settings.max_ground_disparities:
        X = np.concatenate(ends)
    straightened = straighten(base, other, window, X)
    if straightened is None:
        return None
    pair, span = straightened
    disparities = match_dense(pair, span, settings)
    ab = pair.columns_rows(pixels)
    place = np.clip(np.rint(ab).astype(int), 0, np.array(disparities.disparity.shape)[::-1] - 1)
    look_up = lambda a: a[place[:, 1], place[:, 0]]
    d, sigma = look_up(disparities.disparity), look_up(disparities.sigma)
    is_known = np.isfinite(d) & np.isfinite(sigma)
    # The slope of the disparities takes the value of the nearest column to the pixel itself.
    slopes = [
        np.nan_to_num(look_up(np.gradient(disparities.disparity, axis=axis))) for axis in (1, 0)
    ]
    # A slope of more than half a pixel per pixel is a step in the surface.
    slopes = [np.where(np.abs(s) < 0.5, s, 0) for s in slopes]
    d = d + slopes[0] * (ab - place)[:, 0] + slopes[1] * (ab - place)[:, 1] + pair.lowest
    match, rows = np.full((len(pixels), 2), np.nan), np.flatnonzero(is_known)
    for k in range(0, len(rows), POINTS_AT_ONCE):
        part = rows[k : k + POINTS_AT_ONCE]
        shifted = pair.base_places(ab[part] - np.stack([d[part], np.zeros(len(part))], 1))
        match[part] = other.project(base.points(shifted, np.full(len(part), pair.q0)))
    is_known &= np.isfinite(match).all(1)
    return _PieceMatches(
        other, match, np.where(is_known, sigma, np.nan), pair.q0, disparities.factor
    )


def _intersect(
    base: OrientedImage,
    piece_matches: Sequence[_PieceMatches],
    uv: Places,
    rows: slice,
    max_difference: float,
) -> Cloud:
    """The points of some pixels: of each the rays of all matches that agree."""
    uv = uv[rows]
    sigma = np.stack([match.sigma[rows] for match in piece_matches])
    keep = np.isfinite(sigma).any(0)
    uv, sigma = uv[keep], sigma[:, keep]
    places = np.stack([uv, *(match.place[rows][keep] for match in piece_matches)], 1)
    n, views = len(uv), (base, *(match.other for match in piece_matches))
    start = base.points(uv, np.full(n, piece_matches[0].q0))
    # Half of a match's variance is of the window in the base; the other half, the same noise in the
    # other image, is stretched by A there.
    in_others = []
    for match, s in zip(piece_matches, sigma):
        A = windows(base, match.other, start).A
        A = np.where(np.isfinite(A), A, np.eye(2))
        in_others.append(0.5 * s[:, None, None] ** 2 * (A @ np.swapaxes(A, 1, 2)))
    in_others = np.stack(in_others, 1)

    def intersect_rays(matched: Bool[np.ndarray, "pairs n"]) -> IntersectedPoints:
        number = np.maximum(matched.sum(0), 1)
        shared = 0.5 * np.where(matched, sigma, 0.0) ** 2
        in_base = np.expand_dims(shared.sum(0) / number, (1, 2)) * np.eye(2)
        is_used = np.concatenate([np.expand_dims(matched.any(0), 0), matched]).T
        covariance = np.concatenate([in_base[:, None], in_others], 1)
        return intersect(views, np.nan_to_num(places), covariance, is_used, start)

    is_known = np.asarray(np.isfinite(sigma))
    if len(piece_matches) > 1:
        q, sigma_q = (np.full(sigma.shape, np.nan) for _ in range(2))
        for k in range(len(piece_matches)):
            is_of_pair = np.zeros_like(is_known)
            is_of_pair[k] = is_known[k]
            q[k], sigma_q[k] = _parameter(base, intersect_rays(is_of_pair), is_of_pair[k])
        is_known = consistent(q, sigma_q, max_difference)
    cloud = intersect_rays(is_known)
    good = np.isfinite(cloud.covariance).all((1, 2)) & np.isfinite(cloud.X).all(1) & is_known.any(0)
    is_used = np.concatenate([np.expand_dims(is_known.any(0), 0), is_known]).T[good]
    of_orientation = orientation_covariance(views, cloud.X[good], is_used)
    return Cloud(
        cloud.X[good],
        (cloud.covariance[good] + of_orientation).astype(np.float32),
        cloud.rays[good].astype(np.int16),
        np.zeros(int(good.sum()), np.int16),
        uv[good].astype(np.float32),
        (base.name,),
        shared=of_orientation[:, 2, 2].astype(np.float32),
    )


def _parameter(
    base: OrientedImage, intersected: IntersectedPoints, matched: Bool[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """q of points on their lines of sight in the base, and its σ; NaN: none."""
    X = np.where(matched[:, None], intersected.X, np.nan)
    is_known = np.isfinite(X).all(1) & np.isfinite(intersected.covariance).all((1, 2))
    safe = np.where(
        np.expand_dims(is_known, 1), X, intersected.X[is_known][:1] if is_known.any() else 0.0
    )
    d = line_of_sight(base.derivative(safe))
    with np.errstate(invalid="ignore"):
        sigma_along = np.sqrt(np.einsum("ni,nij,nj->n", d, intersected.covariance, d))
    q = base.parameter(safe)
    sigma_q = np.abs(base.parameter(safe + np.nan_to_num(sigma_along)[:, None] * d) - q)
    return np.where(is_known, q, np.nan), np.where(is_known, sigma_q, np.nan)
