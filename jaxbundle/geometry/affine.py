"""Affine transformation of the plane: interior orientation of a scanned photograph.

    X = a·x + b·y + c
    Y = d·x + e·y + f        params = (a, b, c, d, e, f)

Two translations, one rotation, two scales and one shear. From photograph (mm) to image (pixel)
or back; a, b, d, e in units of the target per unit of the source, c and f in units of the target.

    inverse:  a' =  e/D   b' = −b/D   c' = (b·f − c·e)/D
              d' = −d/D   e' =  a/D   f' = (c·d − a·f)/D        D = a·e − b·d

Source: Wolf and Dewitt (2000), Elements of Photogrammetry, appendix B.
"""

import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import solve_triangular
from jaxtyping import Float

from jaxbundle.types import AnyArray


def apply(params: Float[AnyArray, "6"], point: Float[AnyArray, "2"]) -> Float[Array, "2"]:
    """(X, Y), in the target's unit, of a point (x, y) in the source's unit."""
    a, b, c, d, e, f = params
    x, y = point
    return jnp.stack([a * x + b * y + c, d * x + e * y + f])


def inverse(params: Float[AnyArray, "6"]) -> Float[Array, "6"]:
    """The parameters (a', b', c', d', e', f') that lead back from (X, Y) to (x, y)."""
    a, b, c, d, e, f = params
    determinant = a * e - b * d
    return jnp.stack([e, -b, b * f - c * e, -d, a, c * d - a * f]) / determinant


def compose(outer: Float[AnyArray, "6"], inner: Float[AnyArray, "6"]) -> Float[Array, "6"]:
    """The parameters of `inner` followed by `outer`: (X, Y) = outer(inner(x, y))."""
    bottom = jnp.array([0, 0, 1], outer.dtype)
    matrix = jnp.vstack([inner.reshape(2, 3), bottom])
    return (jnp.reshape(outer, (2, 3)) @ matrix).reshape(6)


def fit(
    source: Float[AnyArray, "n 2"],
    target: Float[AnyArray, "n 2"],
    weights: Float[AnyArray, "n"] | None = None,
) -> Float[Array, "6"]:
    """The parameters that take `source` to `target` with the least weighted sum of squares.

    Minimises Σ pᵢ·|apply(params, sourceᵢ) − targetᵢ|² by QR, differentiable in all arguments.

    **Arguments:** corresponding points, at least three and not on one line; `weights` p = 1/σ² of
    each point, equal for its two coordinates (one if absent).

    **Raises:** `ValueError` if fewer than three points are given or the two lists differ in length.
    Points on one line are not detected; their result is meaningless.
    """
    if source.shape != target.shape:
        raise ValueError(
            f"An affine fit needs pairs of points, but source has shape {source.shape} and "
            f"target {target.shape}."
        )
    if len(source) < 3:
        raise ValueError(
            f"An affine transformation has six parameters and needs at least three points, "
            f"but {len(source)} given: measure more points (fiducial marks)."
        )
    design = jnp.hstack([source, jnp.ones_like(source[:, :1])])
    if weights is not None:
        # p = 1/σ²: rows of the design and of the targets times √p.
        root = jnp.sqrt(weights)[:, None]
        design, target = root * design, root * target
    # QR, not normal equations: pixel coordinates of some thousands beside ones have a condition
    # that would be squared.
    Q, R = jnp.linalg.qr(design)
    return solve_triangular(R, Q.T @ target).T.reshape(6)
