"""An ellipse through edge points, and the image of a circle's centre in it.

The conic A·x² + B·xy + C·y² + D·x + E·y + F = 0 of least Σ F(x, y)² under 4AC − B² = 1 is an
ellipse for any points (Fitzgibbon, Pilu and Fisher, 1999), computed by the stable method of Halíř
and Flusser (1998): D, E, F are eliminated; then, with T the reduced scatter matrix = L·Lᵀ,

    C₁·a = μ·T·a,   C₁ = [[0, 0, 2], [0, −1, 0], [2, 0, 0]],   a = L⁻ᵀ·(eigenvector of L⁻¹·C₁·L⁻ᵀ
                                                              with the greatest eigenvalue)

The distance of a point is F/|∇F| to first order (Sampson, 1982). Its root mean square over n − 5
is σ0, and with its derivatives by the five free coefficients it gives the covariance of the centre.

The image of a circle's centre is not the centre of its image. A circle of radius ρ about X, with n
the normal of its plane, a and b two perpendicular unit vectors in it (all in the camera frame,
z = (0, 0, 1)), has the dual conic H·diag(−ρ², −ρ², 1)·Hᵀ with H = [a b X]; the centre of its image
is the pole of the line at infinity, the image of the direction

    H·diag(−ρ², −ρ², 1)·Hᵀ·z = q·X − ρ²·(z − n_q·n)

since a·aᵀ + b·bᵀ = 1 − n·nᵀ (compare Ahn, Warnecke and Kotowski, 1999; Dold, 1996). If the
distortion varies over the circle's image, it is not an ellipse: `rim_centre_shift` fits one to
it, as in the measurement.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbundle.cameras import CameraModel, project
from jaxbundle.orientation.pose import CameraPose, to_camera
from jaxbundle.types import AnyArray, Scalar


class Ellipse(eqx.Module):
    """Centre, semi-axes (the longer first), the longer one's angle to x; σ0 of the distances of the
    points and the covariance of the centre, all in the unit of the points and radians."""

    centre: Float[Array, "2"]
    axes: Float[Array, "2"]
    angle: Float[Array, ""]
    sigma0: Float[Array, ""]
    covariance: Float[Array, "2 2"]


def fit_ellipse(
    xy: Float[AnyArray, "n 2"], weights: Float[AnyArray, " n"] | None = None
) -> Ellipse:
    """The ellipse nearest to n > 5 points; differentiable, batched by `jax.vmap`.

    **Arguments:** `weights`: 0: the point is absent.

    **Returns:** NaN if the points determine no ellipse.
    """
    p = jnp.ones(xy.shape[0]) if weights is None else jnp.asarray(weights)
    xy = jnp.where(p[:, None] > 0, xy, 0.0)
    middle = p @ xy / jnp.sum(p)
    size = jnp.sqrt(p @ jnp.sum((xy - middle) ** 2, 1) / jnp.sum(p))
    x, y = ((xy - middle) / size).T
    square, linear = jnp.stack([x * x, x * y, y * y], 1), jnp.stack([x, y, jnp.ones_like(x)], 1)
    S1, S2, S3 = (
        a.T @ (p[:, None] * b) for a, b in ((square, square), (square, linear), (linear, linear))
    )
    linear_from_quadratic = -jnp.linalg.solve(S3, S2.T)
    T = S1 + S2 @ linear_from_quadratic
    # Points exactly on an ellipse leave T singular: rounding, some hundred ε, is added.
    T = T + 1e-13 * jnp.trace(S1) * jnp.eye(3)
    L = jnp.linalg.cholesky(T)
    inverse = jax.scipy.linalg.solve_triangular(L, jnp.eye(3), lower=True)
    constraint = jnp.array([[0, 0, 2.0], [0, -1, 0], [2, 0, 0]])
    M = inverse @ constraint @ inverse.T
    a = inverse.T @ jnp.linalg.eigh((M + M.T) / 2)[1][:, -1]
    conic = jnp.concatenate([a, linear_from_quadratic @ a])
    conic = conic / jnp.linalg.norm(conic)
    conic = conic * jnp.sign(conic[0])

    rows = jnp.concatenate([square, linear], 1)
    A, B, C, D, E, _ = conic
    slope = jnp.hypot(2 * A * x + B * y + D, B * x + 2 * C * y + E)
    distance = rows @ conic / slope
    redundancy = jnp.maximum(jnp.sum(p > 0) - 5, 1)
    sigma0 = jnp.sqrt(jnp.sum(p * distance**2) / redundancy)
    design = jnp.sqrt(p)[:, None] * rows / slope[:, None]
    # The length of the conic's coefficients has no meaning: it is held.
    N = design.T @ design + jnp.trace(design.T @ design) * jnp.outer(conic, conic)
    J = jax.jacfwd(_centre)(conic)
    covariance = sigma0**2 * J @ jnp.linalg.solve(N, J.T)

    centre = _centre(conic)
    # F at the centre: about it A·x² + B·xy + C·y² = depth, with semi-axes √(depth/eigenvalue)
    x, y = centre
    depth = -(conic @ jnp.array([x * x, x * y, y * y, x, y, 1.0]))
    values, vectors = jnp.linalg.eigh(jnp.array([[A, B / 2], [B / 2, C]]))
    axes = jnp.sqrt(depth / values)
    angle = jnp.arctan2(vectors[1, 0], vectors[0, 0])
    angle = jnp.remainder(angle + jnp.pi / 2, jnp.pi) - jnp.pi / 2
    return Ellipse(middle + size * centre, size * axes, angle, size * sigma0, size**2 * covariance)


def circle_centre_shift(
    model: CameraModel,
    p: Float[AnyArray, " parameters"],
    pose: CameraPose,
    centre: Float[AnyArray, "3"],
    normal: Float[AnyArray, "3"],
    radius: Scalar,
) -> Float[Array, "2"]:
    """Centre of the image of a circle minus image of its centre: the eccentricity of projection.

    Subtract it from the measured centre of the ellipse. Distortion is assumed linear over the
    circle's image.

    **Arguments:** `p`: parameters of the camera; `centre`, `radius` of the circle in the object
    unit; `normal` of its plane, length 1.

    **Returns:** in the unit and axes of the model.
    """
    X, n = to_camera(pose, centre), pose.M @ normal
    middle = X[2] * X - radius**2 * (jnp.array([0, 0, 1.0]) - n[2] * n)
    image = lambda ray: jnp.stack(project(model, tuple(p), *ray))
    return image(middle) - image(X)


def rim_centre_shift(
    model: CameraModel,
    p: Float[AnyArray, " parameters"],
    pose: CameraPose,
    centre: Float[AnyArray, "3"],
    normal: Float[AnyArray, "3"],
    radius: Scalar,
) -> Float[Array, "2"]:
    """Centre of the ellipse through the image of a circle's rim minus image of its centre: as
    `circle_centre_shift`, with the actual distortion along the rim."""
    aside = jnp.where(jnp.abs(normal[0]) < 0.8, jnp.array([1.0, 0, 0]), jnp.array([0, 1.0, 0]))
    a = jnp.cross(normal, aside)
    a = a / jnp.linalg.norm(a)
    n = 32  # points: the ellipse has 5 coefficients; distortion over a circle is of low degree
    t = 2 * jnp.pi * (jnp.arange(n) + 0.5) / n
    rim = centre + radius * (jnp.cos(t)[:, None] * a + jnp.sin(t)[:, None] * jnp.cross(normal, a))
    image = lambda X: jnp.stack(project(model, tuple(p), *to_camera(pose, X)))
    return fit_ellipse(jax.vmap(image)(rim)).centre - image(centre)


def _centre(conic: Float[Array, "6"]) -> Float[Array, "2"]:
    """The point with zero gradient of the conic."""
    A, B, C, D, E, _ = conic
    determinant = 4 * A * C - B * B
    return jnp.stack([B * E - 2 * C * D, B * D - 2 * A * E]) / determinant
