"""Gross errors: solutions from random minimal samples, RANSAC and least median of squares.

Every minimal sample gives one or several models; each is tested on all observations by their
absolute errors e. The best one has

    RANSAC   least Σ min(e², t²)         Fischler and Bolles (1981); Torr and Zisserman (2000)
    LMedS    least median of e²          Rousseeuw (1984); needs no threshold, up to 50 % errors

With a part ε of gross errors, k samples of n observations contain a good one with the probability
P = 1 − (1 − (1 − ε)ⁿ)ᵏ. All samples are drawn from one key and solved at once by vmap: the same key
gives the same answer.
"""

from collections.abc import Callable
from math import ceil, log
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, PyTree

from jaxbundle.geometry import transform_point
from jaxbundle.leastsquares.quality.distributions import NORMAL_SIGMA_BY_MAD
from jaxbundle.orientation.absolute import AbsoluteOrientation, absolute_orientation
from jaxbundle.orientation.dlt import direct_linear_transformation
from jaxbundle.orientation.essential import five_solutions, orientations
from jaxbundle.orientation.homography import apply_homography, homography
from jaxbundle.orientation.intersection import Intersection, intersection
from jaxbundle.orientation.linear import ones_unless
from jaxbundle.orientation.pose import CameraPose, image_of, ray_of, to_camera
from jaxbundle.orientation.relative import (
    RelativeOrientation,
    distances_along_rays,
    relative_orientation,
    sampson_distance,
)
from jaxbundle.orientation.resection import Resection, refine_resection
from jaxbundle.orientation.status import Status
from jaxbundle.orientation.three_points import three_points
from jaxbundle.types import AnyArray, Scalar

# Error of an observation that is impossible in a model (a point behind the camera, NaN): above
# every threshold in use.
IMPOSSIBLE_ERROR = 1e6
# Observations beyond this number of robust standard deviations are gross errors (LMedS): the value
# of Rousseeuw and Leroy (1987), beyond which 1.2 % of good normal observations are. The norm of two
# coordinates has a larger median, and the limit is 4.4 σ of one of them (0.007 %); of three, 5.7 σ.
OUTLIER_LIMIT = 2.5


class Consensus(eqx.Module):
    """The best model, the observations that agree with it, and their greatest accepted error."""

    model: PyTree
    inliers: Bool[AnyArray, " n"]
    threshold: Float[AnyArray, ""]


def samples_needed(size: int, gross: float = 0.4, confidence: float = 0.999) -> int:
    """Number of samples of `size` observations of which at least one is free of gross errors, with
    the probability `confidence`.

    The functions below draw 1.2 to 2.1 times as many by default: a sample free of gross errors may
    still be a poor one, of points close together. 0.4: a share of gross errors well below the half
    at which the median breaks down; 0.999: one failure in a thousand calls.
    """
    return ceil(log(1 - confidence) / log(1 - (1 - gross) ** size))


def consensus(
    key: AnyArray,
    solve: Callable,
    errors: Callable,
    data: tuple,
    size: int,
    samples: int,
    threshold: Scalar | None = None,
    weights: Float[AnyArray, " n"] | None = None,
) -> Consensus:
    """The best of the models of `samples` random samples of `size` observations.

    **Arguments:** `data`: arrays with the observations along their first axis; `solve(*sample)`:
    models with a leading axis of slots, and which of them are valid; `errors(model, *data)` [n],
    not negative. `threshold`: RANSAC with this greatest error of a good observation; without it
    LMedS. `weights`: 0: the observation is absent.
    """
    present = ones_unless(weights, data[0]) > 0
    n = present.shape[0]
    draws = jax.random.uniform(key, (samples, n))
    # The `size` largest of uniform numbers: a sample without repetition; absent ones come last.
    _, sample_rows = jax.lax.top_k(jnp.where(present, draws, -1), size)
    models, valid = jax.vmap(lambda k: solve(*(a[k] for a in data)))(sample_rows)
    models = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), models)

    def score(model: PyTree, valid: Bool[Array, ""]) -> Float[Array, ""]:
        e = _bound_errors(errors(model, *data))
        if threshold is None:
            value = _median(e, present)
        else:
            value = jnp.sum(jnp.where(present, jnp.minimum(e, threshold) ** 2, 0))
        return jnp.where(valid, value, jnp.inf)

    best = jnp.argmin(jax.vmap(score)(models, valid.reshape(-1)))
    model = jax.tree.map(lambda a: a[best], models)
    e = _bound_errors(errors(model, *data))
    limit = robust_limit(e, present, size) if threshold is None else jnp.asarray(threshold)
    return Consensus(model, present & (e <= limit), limit)


def robust_limit(
    e: Float[AnyArray, " n"], present: Bool[AnyArray, " n"], size: int
) -> Float[Array, ""]:
    """OUTLIER_LIMIT·σ with σ = 1.4826·(1 + 5/(n − size))·median e (Rousseeuw and Leroy, 1987, p.
    202)."""
    redundancy = jnp.maximum(jnp.sum(present) - size, 1)
    # The bracket corrects for the median being too small in a sample chosen to minimise it. At
    # least 1e-11, a hundred thousand roundings of coordinates of size 1: of exact data the median
    # is rounding, and half would be gross errors.
    sigma = jnp.maximum(NORMAL_SIGMA_BY_MAD * (1 + 5 / redundancy) * _median(e, present), 1e-11)
    return OUTLIER_LIMIT * sigma


def robust_resection(
    key: AnyArray,
    xy: Float[AnyArray, "n 2"],
    X: Float[AnyArray, "n 3"],
    weights: Float[AnyArray, " n"] | None = None,
    samples: int = 60,
    threshold: Scalar | None = None,
) -> tuple[Resection, Bool[Array, " n"]]:
    """Resection of points with up to 40 % gross errors, and which points are good.

    Arguments as in `resection` and `consensus`; the threshold is a length in the image, c = 1.
    """
    p = ones_unless(weights, xy)

    def errors(
        pose: CameraPose, xy: Float[AnyArray, "n 2"], X: Float[AnyArray, "n 3"]
    ) -> Float[Array, " n"]:
        e = jnp.linalg.norm(jax.vmap(image_of, (None, 0))(pose, X) - xy, axis=1)
        q = jax.vmap(to_camera, (None, 0))(pose, X)[:, 2]
        return jnp.where(q < 0, e, IMPOSSIBLE_ERROR)

    solve = lambda xy, X: three_points(jax.vmap(ray_of)(xy), X)
    sample_fit = consensus(key, solve, errors, (xy, X), 3, samples, threshold, p)
    pose, good = sample_fit.model, sample_fit.inliers

    def adjust(pose: CameraPose, good: Bool[AnyArray, " n"]) -> tuple[Resection, Bool[Array, " n"]]:
        resected = refine_resection(pose, xy, X, p * good)
        return resected, _are_good(errors(resected.pose, xy, X), p > 0, 3, threshold)

    return _repeat(adjust, good, pose, lambda resected: resected.pose)


def robust_relative_orientation(
    key: AnyArray,
    xy1: Float[AnyArray, "n 2"],
    xy2: Float[AnyArray, "n 2"],
    weights: Float[AnyArray, " n"] | None = None,
    samples: int = 150,
    threshold: Scalar | None = None,
) -> tuple[RelativeOrientation, Bool[Array, " n"]]:
    """Relative orientation of points with up to 40 % gross errors, and which points are good.

    Arguments as in `relative_orientation` and `consensus`; the threshold is a Sampson distance,
    c = 1. A gross error along the epipolar line is not detectable.
    """
    p = ones_unless(weights, xy1)

    def errors(
        pair: tuple[AnyArray, AnyArray], xy1: Float[AnyArray, "n 2"], xy2: Float[AnyArray, "n 2"]
    ) -> Float[Array, " n"]:
        M, b = pair
        e = jnp.abs(jax.vmap(sampson_distance, (None, None, 0, 0))(M, b, xy1, xy2))
        s = jax.vmap(distances_along_rays, (None, None, 0, 0))(M, b, xy1, xy2)
        return jnp.where(jnp.all(s > 0, 1), e, IMPOSSIBLE_ERROR)

    def solve(
        xy1: Float[AnyArray, "5 2"], xy2: Float[AnyArray, "5 2"]
    ) -> tuple[tuple[Array, Array], Bool[Array, "10"]]:
        """Of the four orientations of an E that with most of the five points in front."""

        def in_front(E: Float[Array, "3 3"]) -> tuple[Array, Array]:
            pairs = orientations(E)
            distances = lambda M, b: jax.vmap(distances_along_rays, (None, None, 0, 0))(
                M, b, xy1, xy2
            )
            best = jnp.argmax(jnp.sum(jax.vmap(distances)(*pairs) > 0, (1, 2)))
            return jax.tree.map(lambda a: a[best], pairs)

        E, valid = five_solutions(xy1, xy2)
        return jax.vmap(in_front)(E), valid

    sample_fit = consensus(key, solve, errors, (xy1, xy2), 5, samples, threshold, p)

    def adjust(
        _: None, good: Bool[AnyArray, " n"]
    ) -> tuple[RelativeOrientation, Bool[Array, " n"]]:
        result = relative_orientation(xy1, xy2, p * good)
        return result, _are_good(errors((result.M, result.b), xy1, xy2), p > 0, 5, threshold)

    return _repeat(adjust, sample_fit.inliers)


def robust_homography(
    key: AnyArray,
    source: Float[AnyArray, "n 2"],
    target: Float[AnyArray, "n 2"],
    weights: Float[AnyArray, " n"] | None = None,
    samples: int = 60,
    threshold: Scalar | None = None,
) -> tuple[tuple[Float[Array, "3 3"], Array], Bool[Array, " n"]]:
    """(H, status) of points with up to 40 % gross errors, and which points are good.

    Arguments as in `homography` and `consensus`; the threshold is a length of the target.
    """

    def errors(
        solution: tuple[Array, Array],
        source: Float[AnyArray, "n 2"],
        target: Float[AnyArray, "n 2"],
    ) -> Float[Array, " n"]:
        image = jax.vmap(apply_homography, (None, 0))(solution[0], source)
        return jnp.linalg.norm(image - target, axis=1)

    data = (source, target)
    return _robust_weighted(key, homography, errors, data, weights, 4, samples, threshold)


def robust_absolute_orientation(
    key: AnyArray,
    source: Float[AnyArray, "n 3"],
    target: Float[AnyArray, "n 3"],
    weights: Float[AnyArray, " n"] | None = None,
    samples: int = 40,
    threshold: Scalar | None = None,
) -> tuple[AbsoluteOrientation, Bool[Array, " n"]]:
    """Absolute orientation of points with up to 40 % gross errors, and which points are good.

    Arguments as in `absolute_orientation` and `consensus`; the threshold is a length of the target.
    """

    def errors(
        solution: AbsoluteOrientation,
        source: Float[AnyArray, "n 3"],
        target: Float[AnyArray, "n 3"],
    ) -> Float[Array, " n"]:
        transformed = jax.vmap(transform_point, (None, 0))(solution.tau, source)
        return jnp.linalg.norm(transformed - target, axis=1)

    data = (source, target)
    return _robust_weighted(key, absolute_orientation, errors, data, weights, 3, samples, threshold)


def robust_direct_linear_transformation(
    key: AnyArray,
    xy: Float[AnyArray, "n 2"],
    X: Float[AnyArray, "n 3"],
    weights: Float[AnyArray, " n"] | None = None,
    samples: int = 300,
    threshold: Scalar | None = None,
) -> tuple[tuple[Float[Array, "3 4"], Array], Bool[Array, " n"]]:
    """(P, status) of points with up to 40 % gross errors, and which points are good.

    Arguments as in `direct_linear_transformation` and `consensus`; the threshold is a length in the
    image.
    """

    def errors(
        solution: tuple[Array, Array], xy: Float[AnyArray, "n 2"], X: Float[AnyArray, "n 3"]
    ) -> Float[Array, " n"]:
        x, y, w = solution[0] @ jnp.pad(X, ((0, 0), (0, 1)), constant_values=1).T
        return jnp.where(w > 0, jnp.hypot(x / w - xy[:, 0], y / w - xy[:, 1]), IMPOSSIBLE_ERROR)

    solve = direct_linear_transformation
    return _robust_weighted(key, solve, errors, (xy, X), weights, 6, samples, threshold)


def robust_intersection(
    key: AnyArray,
    X0: Float[AnyArray, "n 3"],
    rays: Float[AnyArray, "n 3"],
    weights: Float[AnyArray, " n"] | None = None,
    samples: int = 30,
    threshold: Scalar | None = None,
) -> tuple[Intersection, Bool[Array, " n"]]:
    """The point of rays of which up to 40 % are wrong, and which rays are good.

    Arguments as in `intersection` and `consensus`; the threshold is an angle, radians.
    """

    def errors(
        solution: Intersection, X0: Float[AnyArray, "n 3"], rays: Float[AnyArray, "n 3"]
    ) -> Float[Array, " n"]:
        d = solution.X - X0
        distance = jnp.sum(d * rays, 1)
        angle = jnp.arctan2(jnp.linalg.norm(jnp.cross(d, rays), axis=1), distance)
        return jnp.where(distance > 0, angle, IMPOSSIBLE_ERROR)

    return _robust_weighted(key, intersection, errors, (X0, rays), weights, 2, samples, threshold)


def _robust_weighted(
    key: AnyArray,
    solve: Callable,
    errors: Callable,
    data: tuple[AnyArray, AnyArray],
    weights: Float[AnyArray, " n"] | None,
    size: int,
    samples: int,
    threshold: Scalar | None,
) -> tuple[Any, Bool[Array, " n"]]:
    """Consensus of a solution that takes the weights of its observations as its last argument."""
    p = ones_unless(weights, data[0])

    def solve_sample(*sample: AnyArray) -> tuple[PyTree, Bool[Array, "1"]]:
        solution = solve(*sample)
        status = solution[1] if isinstance(solution, tuple) else solution.status
        models = jax.tree.map(lambda a: jnp.asarray(a)[None], solution)
        return models, (status == int(Status.SOUND))[None]

    good = consensus(key, solve_sample, errors, data, size, samples, threshold, p).inliers

    def adjust(_: None, good: Bool[AnyArray, " n"]) -> tuple[PyTree, Bool[Array, " n"]]:
        solution = solve(*data, p * good)
        return solution, _are_good(errors(solution, *data), p > 0, size, threshold)

    return _repeat(adjust, good)


def _repeat(
    adjust: Callable[[Any, Bool[AnyArray, " n"]], tuple[Any, Bool[Array, " n"]]],
    good: Bool[AnyArray, " n"],
    model: PyTree = None,
    model_of: Callable[[Any], PyTree] = lambda _: None,
) -> tuple[Any, Bool[Array, " n"]]:
    """The solution by the good observations, after these were chosen anew three times, and which
    they are.

    `adjust(model, good)`: the solution by the good ones, from a model, and which are good then.
    """

    def choose_again(
        state: tuple[PyTree, Bool[AnyArray, " n"]], _: None
    ) -> tuple[tuple[PyTree, Bool[Array, " n"]], tuple[Any, Bool[AnyArray, " n"]]]:
        model, good = state
        solution, better = adjust(model, good)
        return (model_of(solution), better), (solution, good)

    # Of 100 resections of 30 points with 35 % of gross errors, without a round 1 % of the good
    # points were missed; one, three and six gave the same points. Three are for the few that move
    # on.
    _, history = jax.lax.scan(choose_again, (model, good), length=3 + 1)
    return jax.tree.map(lambda rounds: rounds[-1], history)


def _are_good(
    e: Float[Array, " n"], present: Bool[Array, " n"], size: int, threshold: Scalar | None
) -> Bool[Array, " n"]:
    e = _bound_errors(e)
    return present & (e <= (robust_limit(e, present, size) if threshold is None else threshold))


def _bound_errors(e: Float[Array, " n"]) -> Float[Array, " n"]:
    return jnp.where(jnp.isfinite(e), e, IMPOSSIBLE_ERROR)


def _median(e: Float[AnyArray, " n"], present: Bool[AnyArray, " n"]) -> Float[Array, ""]:
    """The median of those present, the upper one of two."""
    ordered = jnp.sort(jnp.where(present, e, jnp.inf))
    return ordered[jnp.minimum(jnp.sum(present) // 2, e.shape[0] - 1)]
