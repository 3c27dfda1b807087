"""Transformation of models: to control and given positions, to each other, or to scale."""

import dataclasses
import itertools

import numpy as np
from jaxtyping import Float

from jaxbundle.leastsquares.quality.distributions import NORMAL_SIGMA_BY_MAD
from jaxbundle.network.tables import Network
from jaxbundle.orientation import batched
from jaxbundle.orientation.incremental import Model, are_controlled
from jaxbundle.orientation.rays import Sights
from jaxbundle.orientation.robust import OUTLIER_LIMIT
from jaxbundle.types import Index

# A and t of X' = A·X + t, A a rotation times a scale.
Similarity = tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]


def move_to_given_frame(network: Network, sights: Sights, model: Model) -> Model | None:
    """The model in the frame of control points and of images whose position is given, else of the
    rays to control points, else of the approximate coordinates of points; None without enough."""
    points, images = network.points, network.images
    control = are_controlled(points) & model.known
    stations = model.placed & np.isfinite(images.position).all(1)
    transformation = similarity(
        np.concatenate([model.X[control], model.X0[stations]]),
        np.concatenate([points.position[control], images.position[stations]]),
    )
    if transformation is None:
        transformation = _by_rays(network, sights, model)
    if transformation is None:
        tie = np.isfinite(points.position).all(1) & model.known & ~points.has_role("check")
        transformation = similarity(model.X[tie], points.position[tie])
    return None if transformation is None else model.transform(*transformation)


def _by_rays(network: Network, sights: Sights, model: Model) -> Similarity | None:
    """A and t from the rays to control points, many of which may be seen only once.

    Start values use a point at the typical distance along each ray."""
    points = network.points
    rows = np.flatnonzero(model.placed[sights.image] & are_controlled(points)[sights.point])
    # Seven unknowns: four rays have eight coordinates, hardly a check; five have three redundant
    # ones. Rays to three points at least: about a line through two the model could turn.
    if len(rows) < 5 or len(np.unique(sights.point[rows])) < 3 or not model.known.any():
        return None
    image, point = sights.image[rows], sights.point[rows]
    rays = np.einsum("nij,ni->nj", model.M[image], sights.ray[rows])
    usable = model.known[sights.point] & model.placed[sights.image]
    to_points = model.X[sights.point[usable]] - model.X0[sights.image[usable]]
    usual_distance = np.median(np.linalg.norm(to_points, axis=1))
    approximate_X = np.where(
        model.known[point, None], model.X[point], model.X0[image] + usual_distance * rays
    )
    start = similarity(points.position[point], approximate_X)
    if start is None:
        return None
    # From the control points to the model, not back: the misclosures are then angles at the
    # projection centres of the model, and the inverse is exact.
    A, t, misclosures = batched.similarity_by_rays(
        points.position[point], model.X0[image], rays, *start
    )
    if not np.median(misclosures) < np.median(sights.tolerance[image]):
        return None
    inverse = np.linalg.inv(A)
    return inverse, -inverse @ t


def to_scale(network: Network, model: Model) -> tuple[Model, str]:
    """The model with the scale of the distances, or of the bases of rigs, if any, and its
    reference."""
    scale = scale_of_lengths(network, model)
    if scale is None:
        return model, "in an arbitrary frame and scale"
    return model.transform(scale * np.eye(3), np.zeros(3)), "to scale, in an arbitrary frame"


def scale_of_lengths(network: Network, model: Model) -> float | None:
    """What the lengths of a model are multiplied by: by the distances, or by the bases of rigs."""
    scale = scale_of_distances(network, model)
    return _scale_of_other_lengths(network, model) if scale is None else scale


def scale_of_distances(network: Network, model: Model) -> float | None:
    """The median of measured distances by those in the model."""
    distances = network.distances
    is_known = model.known[distances.points].all(1) if len(distances) else np.zeros(0, bool)
    if not is_known.any():
        return None
    a, b = model.X[distances.points[is_known]].transpose(1, 0, 2)
    return float(np.median(distances.value[is_known] / np.linalg.norm(a - b, axis=1)))


def _scale_of_other_lengths(network: Network, model: Model) -> float | None:
    """The median of the given lengths of further kinds by those in the model."""
    if not network.further or not model.placed.any():
        return None
    # Kinds compute lengths, such as bases of rigs, from poses: of a network of the placed images.
    placed = np.flatnonzero(model.placed)
    images = network.images.take(placed)
    oriented = dataclasses.replace(
        images, position=model.X0[placed], angles=batched.angles(model.M[placed])
    )
    part = network.replace(images=oriented)
    ratios = [ratio for table in network.further for ratio in table.restrict_to(part).scales(part)]
    return float(np.median(ratios)) if ratios else None


def join(network: Network, sights: Sights, model: Model, part: Model) -> Model | None:
    """A model merged with a second one; None if nothing connects them.

    The similarity is found from common points, or from the pose of a common image and the distances
    to common points, without these from known lengths in either."""
    common_points = model.known & part.known
    common_images = np.flatnonzero(model.placed & part.placed)
    if not common_points.any():
        # Two pairs of a chain have an image in common and no point: the ratio of their bases is in
        # no image point, only in known lengths of both.
        model_scale, part_scale = scale_of_lengths(network, model), scale_of_lengths(network, part)
        if not len(common_images) or model_scale is None or part_scale is None:
            return None
        transformation = _by_an_image(model, part, common_images[0], part_scale / model_scale)
    elif len(common_images):
        # The common image gives all but the scale. A similarity by the points would also take
        # rotation and shift from them, and of two bundles points are known worst in depth.
        common_point_counts = np.bincount(
            sights.image, common_points[sights.point], minlength=sights.images
        )
        image = common_images[common_point_counts[common_images].argmax()]
        model_distances, part_distances = (
            np.linalg.norm(m.X[common_points] - m.X0[image], axis=1) for m in (model, part)
        )
        transformation = _by_an_image(
            model, part, image, np.median(model_distances / part_distances)
        )
    else:
        transformation = similarity(part.X[common_points], model.X[common_points])
    if transformation is None:
        return None
    part = part.transform(*transformation)
    image, point = part.placed & ~model.placed, part.known & ~model.known
    choose = lambda rows, new, old: np.where(rows.reshape(-1, *[1] * (old.ndim - 1)), new, old)
    return Model(
        choose(image, part.X0, model.X0),
        choose(image, part.M, model.M),
        model.placed | image,
        choose(point, part.X, model.X),
        model.known | point,
        model.control,
    )


def _by_an_image(model: Model, part: Model, image: Index, scale: float) -> Similarity:
    """By the pose of an image common to both: its attitude gives the rotation, its position the
    shift."""
    A = scale * model.M[image].T @ part.M[image]
    return A, model.X0[image] - A @ part.X0[image]


def similarity(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]
) -> Similarity | None:
    """A and t of X' = A·X + t from the consistent points; None: fewer than three, or collinear."""
    good = np.ones(len(source), bool)
    # The first round uses all points, the second those near its result; a third settles which.
    for _ in range(3):
        transformation = (
            batched.similarity(source, target, good.astype(float)) if good.sum() >= 3 else None
        )
        # Of fewer than six points an outlier draws the seven unknowns so far that it does not show.
        if transformation is None or len(source) < 6:
            return transformation
        A, t = transformation
        distances = np.linalg.norm(source @ A.T + t - target, axis=1)
        # The median of a distance in space is 1.54 σ of a coordinate: beyond three medians is one
        # good point in ten thousand. The 1e-9 is rounding: of exact points the median is zero.
        good = distances <= 3 * np.median(distances) + 1e-9 * np.ptp(target, axis=0).max()
    return transformation


def similarity_of_most(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]
) -> Similarity | None:
    """A and t of X' = A·X + t that fit most of the points; None: collinear.

    The least (n/2 + 2)-th smallest distance over similarities by three of n points, which
    themselves nearly fit (Rousseeuw 1984, least median of squares), then least squares for the
    points within 2.5 robust standard deviations."""
    n, rng = len(source), np.random.default_rng(0)
    # With a third of wrong points (2/3)³ of the triples are good, 44 of 150, wide triangles among
    # them.
    number = 150
    triples = list(itertools.islice(itertools.combinations(range(n), 3), number + 1))
    if len(triples) > number:
        triples = [rng.choice(n, 3, replace=False) for _ in range(number)]
    best, least_quantile = None, np.inf
    for triple in triples:
        transformation = batched.similarity(
            source, target, np.isin(np.arange(n), triple).astype(float)
        )
        if transformation is not None:
            distances = np.linalg.norm(
                source @ transformation[0].T + transformation[1] - target, axis=1
            )
            # Not the median: the three points of the triple fit nearly exactly, and would make half
            # of few points.
            if (quantile := np.sort(distances)[min(n, n // 2 + 2) - 1]) < least_quantile:
                best, least_quantile = distances, quantile
    if best is None:
        return None
    limit = max(OUTLIER_LIMIT * NORMAL_SIGMA_BY_MAD * least_quantile, np.sort(best)[2])
    return batched.similarity(source, target, (best <= limit).astype(float))
