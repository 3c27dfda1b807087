"""What the rays of a network determine, within their noise: points, and the images of points.

**Points.** The rays of a point determine it unless they are one line. With their unit directions dᵢ
in the object frame, p = 1/σᵢ² of these (radians), u the common direction, the first eigenvector of
Σ pᵢ·dᵢ·dᵢᵀ, and rᵢ the distance, across u, of projection centre i from their mean, a point at the
distance sᵢ misses the rays by the angles of

    T(s) = Σ pᵢ·|rᵢ/sᵢ + dᵢ⊥|²,        dᵢ⊥ = dᵢ − (dᵢ·u)·u,

which is χ² of 2n − 2 if the point is there. sᵢ is the median distance from image i to its points.
If half of it, all of it and twice of it pass the test, the rays say nothing about the distance: the
images were taken from one place, or the point lies on the line through their projection centres.
Parallel rays from places apart fail it: such a point is far away, its direction determined, and a
least distance.

Orientations have errors too. At the distances of its n points those of an image have, on average,
3/n of the variance of a ray (six unknowns from 2n coordinates), which is added; at infinity they
would have much more, if rotation and position compensate each other.

**Images.** Points on a line leave a rotation of their image about this line open. They are on it if
their distances eᵢ from it are seen at angles within the noise, Σ pᵢ·(|eᵢ|/sᵢ)² below the quantile
for 2n − 4; two points always are.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.leastsquares.quality.distributions import chi2_quantile
from jaxbundle.orientation.incremental import Model
from jaxbundle.orientation.rays import Sights


def rays_coincide(
    sights: Sights,
    model: Model,
    points: Bool[np.ndarray, " points"],
    factor: float = 1.0,
    significance: float = 0.001,
) -> tuple[Bool[np.ndarray, " points"], Bool[np.ndarray, " points"]]:
    """Which of these points have two or more rays from placed images that are one line, and which
    of them because the images were taken from one place.

    **Arguments:** `factor`: of the a priori σ of the rays, such as σ0; `significance`: probability
    that parallel rays are taken for converging ones, that of the tests of single observations."""
    no_points = np.zeros(sights.points, bool)
    rows = np.flatnonzero(model.placed[sights.image] & points[sights.point] & (sights.sigma > 0))
    image, point = sights.image[rows], sights.point[rows]
    number = np.bincount(point, minlength=sights.points)
    if not (number > 1).any() or not factor > 0:
        return no_points, no_points
    total = lambda values: np.stack(
        [np.bincount(point, v, sights.points) for v in values.reshape(len(rows), -1).T], 1
    )
    d = np.einsum("nij,ni->nj", model.M[image], sights.ray[rows])
    measured = np.bincount(sights.image[sights.sigma > 0], minlength=sights.images)[image]
    p = 1 / ((factor * sights.sigma[rows]) ** 2 * (1 + 3 / measured))
    S = total(p[:, None, None] * d[:, :, None] * d[:, None, :]).reshape(-1, 3, 3)
    u = np.linalg.eigh(S)[1][:, :, 2]
    sum_of_p = np.maximum(np.bincount(point, p, sights.points), 1e-300)[:, None]
    centred_X0 = model.X0[image] - (total(p[:, None] * model.X0[image]) / sum_of_p)[point]
    u = u[point]
    perpendicular = lambda v: v - (v * u).sum(1, keepdims=True) * u
    r, d_perpendicular = (
        perpendicular(centred_X0),
        perpendicular(d) * np.sign((d * u).sum(1, keepdims=True)),
    )
    usual_distance = usual_distances(sights, model)[image, None]
    weighted_squares = lambda v: np.bincount(point, p * np.square(v).sum(1), sights.points)
    limit = _quantiles(2 * number - 2, significance)
    one_line = number > 1
    # One value of s is not enough: rays that converge at the usual distance by chance, or because
    # the point is there, pass its test too.
    for distance in (0.5 * usual_distance, usual_distance, 2 * usual_distance):
        one_line &= weighted_squares(r / distance + d_perpendicular) < limit
    return one_line, one_line & (weighted_squares(centred_X0 / usual_distance) < limit)


def see_collinear_points(
    sights: Sights, model: Model, factor: float = 1.0, significance: float = 0.001
) -> Bool[np.ndarray, " images"]:
    """Which images see known points on a line only, or fewer than three. Images that are not placed
    count as at the usual distance.

    **Arguments:** as of `rays_coincide`."""
    rows = np.flatnonzero(model.known[sights.point] & (sights.sigma > 0))
    image = sights.image[rows]
    number = np.bincount(image, minlength=sights.images)
    if not factor > 0:
        return (number > 0) & (number < 3)
    X, placed = model.X[sights.point[rows]], model.placed[image]
    distance = np.linalg.norm(X - model.X0[image], axis=1)
    distance = np.where(placed, distance, usual_distances(sights, model)[image])
    # Distances of the points from the image weigh their offsets; the line is that of least squares.
    sqrt_p = 1 / (factor * sights.sigma[rows] * distance)
    total = lambda values: np.stack(
        [np.bincount(image, v, sights.images) for v in values.reshape(len(rows), -1).T], 1
    )
    sum_of_p = np.maximum(np.bincount(image, sqrt_p**2, sights.images), 1e-300)[:, None]
    centred_X = X - (total(sqrt_p[:, None] ** 2 * X) / sum_of_p)[image]
    scaled = sqrt_p[:, None] * centred_X
    C = total(scaled[:, :, None] * scaled[:, None, :]).reshape(-1, 3, 3)
    squared_offsets = np.linalg.eigvalsh(C)[:, :2].sum(1)
    return (number > 0) & (squared_offsets < _quantiles(2 * number - 4, significance))


def usual_distances(sights: Sights, model: Model) -> Float[np.ndarray, " images"]:
    """The median distance from every image to its known points; where it has none, that of all."""
    rows = np.flatnonzero(model.placed[sights.image] & model.known[sights.point])
    image = sights.image[rows]
    s = np.linalg.norm(model.X[sights.point[rows]] - model.X0[image], axis=1)
    median_distance = np.full(sights.images, np.median(s) if len(s) else np.inf)
    order = np.lexsort((s, image))
    begin, number = np.unique(image[order], return_index=True, return_counts=True)[1:]
    median_distance[image[order][begin]] = s[order][begin + number // 2]
    return median_distance


def _quantiles(degrees: Int[np.ndarray, " n"], significance: float) -> Float[np.ndarray, " n"]:
    """χ² quantiles of whole degrees of freedom; infinite for none."""
    values, index = np.unique(degrees, return_inverse=True)
    quantile = lambda k: chi2_quantile(1 - significance, int(k)) if k > 0 else np.inf
    return np.array([quantile(k) for k in values])[index]
