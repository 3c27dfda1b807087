"""Planar targets: homographies, and start values of interior and exterior orientation from them.

    w·[x, y, 1]ᵀ = H·[X, Y, 1]ᵀ,        H ~ K·D·[m₁ m₂ −M·X0],        D = diag(1, 1, −1)

        ⎡fx  s  x0⎤
    K = ⎢    fy y0⎥        x = x0 − fx·r/q − s·s/q,  y = y0 − fy·s/q  (r, s, q in the camera frame)
        ⎣        1⎦

with m₁, m₂ the first columns of M. They are perpendicular and of equal length, so that the columns
h₁, h₂ of each H give two equations of B = K⁻ᵀ·K⁻¹ (Zhang, 2000, IEEE PAMI 22(11), 1330–1334):

    h₁ᵀ·B·h₂ = 0,        h₁ᵀ·B·h₁ = h₂ᵀ·B·h₂

`batches.start` has the same idea for a thousand cameras at once, in another layout.
"""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxbundle.arguments import without_masks
from jaxbundle.orientation.linear import (
    RANK_TOLERANCE,
    are_collinear,
    normalisation,
    null_vector,
    ones_unless,
)
from jaxbundle.orientation.pose import CameraPose
from jaxbundle.orientation.status import Status, first_of
from jaxbundle.types import AnyArray


@without_masks
def homography(
    source: Float[AnyArray, "n 2"],
    target: Float[AnyArray, "n 2"],
    weights: Float[AnyArray, " n"] | None = None,
) -> tuple[Float[Array, "3 3"], Int[Array, ""]]:
    """H from `source` to `target` by the normalised direct linear transformation (Hartley, 1997).

    **Arguments:** n ≥ 4 corresponding points, no three of four on a line (`COLLINEAR_POINTS` if
    all are, else `UNDETERMINED`); weights p = 1/σ² of the target; 0: the point is absent.

    **Returns:** H, scaled to w = 1 at the mean of the source, and the status. Differentiable.
    """
    p = ones_unless(weights, source)
    (m, k), (n, l) = normalisation(source, p), normalisation(target, p)
    X = jnp.pad((source - m) / k, ((0, 0), (0, 1)), constant_values=1)
    xy, nil, sqrt_p = (target - n) / l, jnp.zeros_like(X), jnp.sqrt(p)[:, None]
    rows_x = sqrt_p * jnp.hstack([X, nil, -xy[:, :1] * X])
    rows_y = sqrt_p * jnp.hstack([nil, X, -xy[:, 1:] * X])
    h, singular = null_vector(jnp.concatenate([rows_x, rows_y]))
    H = _similarity(l, n) @ h.reshape(3, 3) @ jnp.linalg.inv(_similarity(k, m))
    at_mean = H[2, :2] @ m + H[2, 2]
    status = first_of(
        (are_collinear(source, p), Status.COLLINEAR_POINTS),
        # The last singular value is zero of exact data; a second one leaves H open.
        (singular[-2] < RANK_TOLERANCE * singular[0], Status.UNDETERMINED),
    )
    return H / jnp.where(at_mean == 0, 1, at_mean), status


def apply_homography(H: Float[AnyArray, "3 3"], point: Float[AnyArray, "2"]) -> Float[Array, "2"]:
    """The image of a point."""
    x, y, w = H[:, :2] @ point + H[:, 2]
    return jnp.stack([x / w, y / w])


def interior_from_homographies(
    H: Float[AnyArray, "views 3 3"],
    size: float,
    weights: Float[AnyArray, " views"] | None = None,
    skew: bool = False,
) -> tuple[Float[Array, "5"], Int[Array, ""]]:
    """(fx, fy, s, x0, y0), in the unit of the image, of one camera from views of planes.

    **Arguments:** homographies from the planes to the image, two or more (three with `skew`), not
    of parallel planes; `size`: a length of the image, for the numerical scale; `weights`: 0 leaves
    a view out.

    **Returns:** `PARALLEL_PLANES` where the views determine no camera.
    """
    p = ones_unless(weights, H)
    H = jnp.diag(jnp.array([1 / size, 1 / size, 1.0])) @ H
    H = H / jnp.linalg.norm(H, axis=(1, 2), keepdims=True)
    v = jax.vmap(_coefficients_of_product, (0, None, None))
    rows = jnp.concatenate([v(H, 0, 1), v(H, 0, 0) - v(H, 1, 1)]) * jnp.tile(p, 2)[:, None]
    columns = jnp.array([0, 1, 2, 3, 4, 5] if skew else [0, 2, 3, 4, 5])
    b, singular = null_vector(rows[:, columns])
    # K from B = K⁻ᵀ·K⁻¹ in closed form (Zhang, 2000, appendix B); with noise B need not be positive
    # definite, and then there is no camera.
    b11, b12, b22, b13, b23, b33 = jnp.zeros(6, b.dtype).at[columns].set(b)
    minor = b11 * b22 - b12**2
    y0 = (b12 * b13 - b11 * b23) / minor
    scale = b33 - (b13**2 + y0 * (b12 * b13 - b11 * b23)) / b11
    squares = jnp.stack([scale / b11, scale * b11 / minor])
    fx, fy = jnp.sqrt(jnp.where(squares > 0, squares, 1))
    s = -b12 * fx**2 * fy / scale
    x0 = s * y0 / fy - b13 * fx**2 / scale
    bad = (singular[-2] < RANK_TOLERANCE * singular[0]) | ~jnp.all(squares > 0)
    return size * jnp.stack([fx, fy, s, x0, y0]), first_of((bad, Status.PARALLEL_PLANES))


def pose_from_homography(H: Float[AnyArray, "3 3"], interior: Float[AnyArray, "5"]) -> CameraPose:
    """The pose of an image of the plane Z = 0, in the unit of the plane.

    `H` with w > 0 at the points, as `homography` gives it; `interior`: (fx, fy, s, x0, y0). The
    first two axes are made perpendicular, the error shared.
    """
    fx, fy, s, x0, y0 = interior
    nil, one = jnp.zeros_like(fx), jnp.ones_like(fx)
    K = jnp.array([[fx, s, x0], [nil, fy, y0], [nil, nil, one]])
    A = jnp.diag(jnp.array([1.0, 1.0, -1.0])) @ jnp.linalg.solve(K, H)
    length = jnp.linalg.norm(A[:, :2], axis=0)
    unit = lambda a: a / jnp.linalg.norm(a)
    x_axis, y_axis = (A[:, :2] / length).T
    # The bisectors of two unit vectors are perpendicular; so are the vectors at 45° to them, each
    # turned by half of the error.
    p, q = unit(x_axis + y_axis), unit(x_axis - y_axis)
    x_axis, y_axis = (p + q) / jnp.sqrt(2.0), (p - q) / jnp.sqrt(2.0)
    M = jnp.stack([x_axis, y_axis, jnp.cross(x_axis, y_axis)], 1)
    return CameraPose(-M.T @ A[:, 2] * 2 / jnp.sum(length), M)


def _similarity(scale: Float[Array, ""], shift: Float[Array, "2"]) -> Float[Array, "3 3"]:
    """The matrix of scale·[x, y] + shift in homogeneous coordinates."""
    nil, one = jnp.zeros_like(scale), jnp.ones_like(scale)
    return jnp.array([[scale, nil, shift[0]], [nil, scale, shift[1]], [nil, nil, one]])


def _coefficients_of_product(H: Float[AnyArray, "3 3"], i: int, j: int) -> Float[Array, "6"]:
    """hᵢᵀ·B·hⱼ as the coefficients of (B11, B12, B22, B13, B23, B33)."""
    a, b = H[:, i], H[:, j]
    return jnp.stack(
        [
            a[0] * b[0],
            a[0] * b[1] + a[1] * b[0],
            a[1] * b[1],
            a[2] * b[0] + a[0] * b[2],
            a[2] * b[1] + a[1] * b[2],
            a[2] * b[2],
        ]
    )
