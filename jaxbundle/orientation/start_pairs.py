"""The pair of images from which a model starts: many common points, good intersection angles."""

import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.orientation import batched
from jaxbundle.orientation.incremental import (
    RESECTION_LIMITS,
)
from jaxbundle.orientation.rays import Sights, in_plane
from jaxbundle.orientation.settings import StartValueSettings
from jaxbundle.types import Index


def good_pairs(
    sights: Sights,
    candidates: Bool[np.ndarray, " images"],
    is_linking: Bool[np.ndarray, " images"],
    must_link: bool,
    settings: StartValueSettings,
) -> Iterator[
    tuple[
        Index,
        Index,
        Float[np.ndarray, "3 3"],
        Float[np.ndarray, "3 3"],
        Float[np.ndarray, "3"],
    ]
]:
    """Pairs, the rotations of both and the base between them, the most promising first;
    `must_link`: of an image with `is_linking` and another."""
    pairs, common = _pairs_in_common(sights, candidates, is_linking, must_link, settings)
    if not len(pairs):
        return
    common_points = [_common_points(sights, *pair) for pair in pairs]
    has_enough = [len(xy) >= settings.min_common_points for *_, xy, _ in common_points]
    common_points, pairs, common = (
        list(itertools.compress(common_points, has_enough)),
        pairs[has_enough],
        common[has_enough],
    )
    if not common_points:
        return
    R, Q, xy, other_xy = zip(*common_points)
    tolerance = sights.tolerance[pairs].mean(1)
    M, b, share, angle = batched.orient_pairs(xy, other_xy, tolerance)
    # 1/σ of the depth of a pair: with the root of the number of points and with the angle. Beyond
    # `good_angle` images differ so much that many points are seen in one only.
    worth = np.sqrt(common) * share * np.minimum(angle, settings.good_angle)
    usable = (share >= settings.agreeing_share) & (angle > RESECTION_LIMITS.min_angle)
    for k in [k for k in np.argsort(-worth) if usable[k]][: settings.max_seeds]:
        yield *pairs[k], R[k].T, Q[k].T @ M[k], b[k]


def _pairs_in_common(
    sights: Sights,
    candidates: Bool[np.ndarray, " images"],
    is_linking: Bool[np.ndarray, " images"],
    must_link: bool,
    settings: StartValueSettings,
) -> tuple[Int[np.ndarray, "pairs 2"], Int[np.ndarray, " pairs"]]:
    """Up to `max_pairs` pairs of images, and the number of their points: those with the most, and
    others with enough points and wider bases."""
    pairs, number = all_pairs(sights, candidates)
    is_usable = (number >= settings.min_common_points) & (
        (is_linking[pairs[:, 0]] != is_linking[pairs[:, 1]]) | (not must_link)
    )
    pairs, number = pairs[is_usable], number[is_usable]
    order = np.argsort(-number, kind="stable")
    # The pairs with the most points often have the shortest bases. So half of the pairs are spread
    # over all that have 0.3 of the most points: with 60 % overlap along a strip, the next image but
    # one still has 0.33 of the points of the next (20 % of the format beside 60 %).
    sufficient_pairs = order[number[order] >= 0.3 * number.max(initial=0)]
    half_number = settings.max_pairs // 2
    sample = batched.evenly_spaced(len(sufficient_pairs), settings.max_pairs - half_number)
    selected = np.unique(np.concatenate([order[:half_number], sufficient_pairs[sample]]))
    return pairs[selected], number[selected]


def all_pairs(
    sights: Sights, candidates: Bool[np.ndarray, " images"]
) -> tuple[Int[np.ndarray, "pairs 2"], Int[np.ndarray, " pairs"]]:
    """Pairs of these images that share points [pairs, 2], and how many."""
    from scipy.sparse import coo_array, triu

    rows = candidates[sights.image]
    shape = (sights.images, sights.points)
    sees = coo_array((np.ones(rows.sum(), int), (sights.image[rows], sights.point[rows])), shape)
    sees = sees.tocsr()
    common = triu(sees @ sees.T, k=1)
    return np.stack([common.row, common.col], 1), common.data


def _common_points(
    sights: Sights, image: Index, other_image: Index
) -> tuple[
    Float[np.ndarray, "3 3"],
    Float[np.ndarray, "3 3"],
    Float[np.ndarray, "common 2"],
    Float[np.ndarray, "common 2"],
]:
    """The common points of two images: of each the rotation and the coordinates of `in_plane`."""
    first_rows, second_rows = sights.rows_of(image), sights.rows_of(other_image)
    _, k, l = np.intersect1d(
        sights.point[first_rows], sights.point[second_rows], return_indices=True
    )
    (R, xy), (Q, other_xy) = (
        in_plane(sights.ray[first_rows][k]),
        in_plane(sights.ray[second_rows][l]),
    )
    is_finite = np.isfinite(xy).all(1) & np.isfinite(other_xy).all(1)
    return R, Q, xy[is_finite], other_xy[is_finite]
