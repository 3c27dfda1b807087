"""What the rays of a network determine, within their noise: points, and the images of points.

**Points.** The rays of a point determine it unless they are one line. With the unit directions dᵢ
in the object frame, the projection centres X0ᵢ, p = 1/σᵢ² of the directions (radians), and u the
common direction, the first eigenvector of Σ pᵢ·dᵢ·dᵢᵀ,

    T = Σ pᵢ·|dᵢ × u|²              the angles between rays, χ² of 2n − 2 if all are parallel
    B = Σ pᵢ·(|rᵢ|/sᵢ)²             the angles that there would be if the point were as far away
                                    as is usual, rᵢ = X0ᵢ − X̄0 across u, sᵢ the median distance
                                    from image i to its points

Rays are parallel if T is below the quantile of χ². If B is above it, the point is far away: its
direction is determined, and a least distance. If B is below it too, the rays say nothing about the
distance: the images were taken from one place, or the point lies on the line through their
projection centres.

**Images.** Points on a line leave a rotation of their image about this line open. They are on it if
their distances eᵢ from it are seen at angles within the noise, Σ pᵢ·(|eᵢ|/sᵢ)² below the quantile
for 2n − 4; two points always are.
"""

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.leastsquares.quality.distributions import chi2_quantile
from jaxbundle.orientation.growth import Model
from jaxbundle.orientation.sights import Sights

SIGNIFICANCE = 0.001
"""Probability that parallel rays are taken for converging ones: the level of the tests of
single observations."""


def have_one_line(
    seen: Sights, model: Model, points: Bool[np.ndarray, " points"], factor: float = 1.0
) -> tuple[Bool[np.ndarray, " points"], Bool[np.ndarray, " points"]]:
    """Which of these points have two or more rays from placed images that are one line, and which
    of them because the images were taken from one place.

    **Arguments:** `factor`: of the a priori σ of the rays, such as σ0."""
    none = np.zeros(seen.points, bool)
    rows = np.flatnonzero(model.placed[seen.image] & points[seen.point] & (seen.sigma > 0))
    image, point = seen.image[rows], seen.point[rows]
    number = np.bincount(point, minlength=seen.points)
    if not (number > 1).any() or not factor > 0:
        return none, none
    total = lambda values: np.stack(
        [np.bincount(point, v, seen.points) for v in values.reshape(len(rows), -1).T], 1
    )
    d = np.einsum("nij,ni->nj", model.M[image], seen.ray[rows])
    p = 1 / (factor * seen.sigma[rows]) ** 2
    S = total(p[:, None, None] * d[:, :, None] * d[:, None, :]).reshape(-1, 3, 3)
    u = np.linalg.eigh(S)[1][:, :, 2]
    weight = np.maximum(np.bincount(point, p, seen.points), 1e-300)[:, None]
    away = model.X0[image] - (total(p[:, None] * model.X0[image]) / weight)[point]
    across = np.cross(away, u[point])
    of_angles = np.bincount(point, p * np.square(np.cross(d, u[point])).sum(1), seen.points)
    usual = usual_distances(seen, model)[image]
    seen_at = lambda v: np.bincount(point, p * np.square(v / usual[:, None]).sum(1), seen.points)
    limit = _quantiles(2 * number - 2)
    one_line = (number > 1) & (of_angles < limit) & (seen_at(across) < limit)
    return one_line, one_line & (seen_at(away) < limit)


def see_a_line(
    seen: Sights, model: Model, factor: float = 1.0
) -> Bool[np.ndarray, " images"]:
    """Which placed images see points on a line only, or fewer than three points."""
    rows = np.flatnonzero(
        model.placed[seen.image] & model.known[seen.point] & (seen.sigma > 0)
    )
    image = seen.image[rows]
    number = np.bincount(image, minlength=seen.images)
    X = model.X[seen.point[rows]]
    # Distances of the points from the image weigh their offsets; the line is that of least squares.
    root = 1 / (factor * seen.sigma[rows] * np.linalg.norm(X - model.X0[image], axis=1))
    total = lambda values: np.stack(
        [np.bincount(image, v, seen.images) for v in values.reshape(len(rows), -1).T], 1
    )
    weight = np.maximum(np.bincount(image, root**2, seen.images), 1e-300)[:, None]
    away = X - (total(root[:, None] ** 2 * X) / weight)[image]
    scaled = root[:, None] * away
    C = total(scaled[:, :, None] * scaled[:, None, :]).reshape(-1, 3, 3)
    off = np.linalg.eigvalsh(C)[:, :2].sum(1)
    return model.placed & (number > 0) & (off < _quantiles(2 * number - 4))


def usual_distances(seen: Sights, model: Model) -> Float[np.ndarray, " images"]:
    """The median distance from every image to its known points; where it has none, that of all."""
    rows = np.flatnonzero(model.placed[seen.image] & model.known[seen.point])
    image = seen.image[rows]
    s = np.linalg.norm(model.X[seen.point[rows]] - model.X0[image], axis=1)
    found = np.full(seen.images, np.median(s) if len(s) else np.inf)
    order = np.lexsort((s, image))
    first, number = np.unique(image[order], return_index=True, return_counts=True)[1:]
    found[image[order][first]] = s[order][first + number // 2]
    return found


def _quantiles(degrees) -> np.ndarray:
    """χ² quantiles of whole degrees of freedom; infinite for none."""
    values, index = np.unique(degrees, return_inverse=True)
    return np.array([
        chi2_quantile(1 - SIGNIFICANCE, int(k)) if k > 0 else np.inf for k in values
    ])[index]  # fmt: skip
