"""Forward intersection: a point from any number of rays, with its covariance.

The point nearest to all rays is linear, with the unit directions dᵢ in the object frame,

    Σ pᵢ·(I − dᵢ·dᵢᵀ)·(X − X0ᵢ) = 0

and starts the adjustment of directions: with two axes eᵢ, nᵢ across the ray, in radians,

    vᵢ = [eᵢ, nᵢ]ᵀ·(X − X0ᵢ)/dᵢᵀ·(X − X0ᵢ),        Σ pᵢ·|vᵢ|² = min
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.lax import stop_gradient
from jaxtyping import Float, Int

from jaxbundle.arguments import without_masks
from jaxbundle.leastsquares.iterations.small import adjust
from jaxbundle.orientation.linear import ones_unless
from jaxbundle.orientation.status import Status, first_of
from jaxbundle.types import AnyArray


class Intersection(eqx.Module):
    """X and its cofactors in the object unit, vᵀPv, angle of intersection in radians.

    `angle`: the greatest between two of the rays, seen as lines, at most 90°.
    """

    X: Float[AnyArray, "3"]
    vtpv: Float[AnyArray, ""]
    cofactor: Float[AnyArray, "3 3"]
    angle: Float[AnyArray, ""]
    status: Int[AnyArray, ""]


@without_masks
def intersection(
    X0: Float[AnyArray, "n 3"],
    rays: Float[AnyArray, "n 3"],
    weights: Float[AnyArray, " n"] | None = None,
) -> Intersection:
    """The point of n ≥ 2 rays from X0, in the object frame (Mᵀ·(x, y, −1)), differentiable.

    **Arguments:** rays of any length; weights p = 1/σ² of the directions, 1/rad²; 0: the ray is
    absent.

    **Returns:** the cofactors times σ0² are the covariance (infinite: undetermined). `status`:
    `PARALLEL_RAYS` (also for fewer than two), `BEHIND_THE_CAMERA`.
    """
    p = ones_unless(weights, X0)
    d = rays / jnp.linalg.norm(rays, axis=1, keepdims=True)
    # Of the angles the sine is exact where the cosine is flat, and vice versa.
    lines = stop_gradient(d)
    sine = jnp.linalg.norm(jnp.cross(lines[:, None], lines[None]), axis=-1)
    angles = jnp.arctan2(sine, jnp.abs(lines @ lines.T))
    angle = jnp.max(jnp.where((p[:, None] > 0) & (p > 0), angles, 0))
    # The least eigenvalue of N is p·angle²/2 of two rays: 5e-15·p at 1e-7 rad, of which rounding
    # (1e-16) leaves one or two figures. Directions are measured to 1e-6 rad at best.
    parallel = angle < 1e-7
    projectors = jnp.eye(3, dtype=d.dtype) - d[:, :, None] * d[:, None, :]
    N = jnp.einsum("n,nij->ij", p, projectors)
    # Relative to the mean centre: with map coordinates in the millions g would lose their figures.
    middle = p @ X0 / jnp.sum(p)
    g = jnp.einsum("n,nij,nj->i", p, projectors, X0 - middle)
    start = jnp.linalg.solve(jnp.where(parallel, jnp.eye(3, dtype=d.dtype), N), g) + middle
    data = (X0, d, jnp.sqrt(p))
    fit = adjust(_misclosures, jnp.add, start, data, 3)
    distances = jnp.einsum("ni,ni->n", d, fit.estimate - X0)
    status = first_of(
        (parallel, Status.PARALLEL_RAYS),
        (~fit.determined, Status.UNDETERMINED),
        (jnp.any((distances <= 0) & (p > 0)), Status.BEHIND_THE_CAMERA),
    )
    cofactor = jnp.where(parallel, jnp.inf, fit.cofactor)
    return Intersection(fit.estimate, fit.vtpv, cofactor, angle, status)


def _misclosures(
    X: Float[AnyArray, "3"],
    X0: Float[AnyArray, "n 3"],
    d: Float[AnyArray, "n 3"],
    sqrt_weight: Float[AnyArray, " n"],
) -> Float[Array, " 2n"]:
    return jax.vmap(misclosure, (None, 0, 0, 0))(X, X0, d, sqrt_weight).ravel()


def misclosure(
    X: Float[AnyArray, "3"],
    X0: Float[AnyArray, "3"],
    d: Float[AnyArray, "3"],
    sqrt_weight: Float[AnyArray, ""],
) -> Float[Array, "2"]:
    """√p·v of a point and a ray: tangents of the angles across it; `d` of length 1."""
    # The coordinate axis farthest from the ray is never parallel to it. The choice jumps, but |v|
    # does not depend on it.
    axis = jnp.eye(3, dtype=d.dtype)[jnp.argmin(jnp.abs(stop_gradient(d)))]
    e = jnp.cross(d, axis)
    e = e / jnp.linalg.norm(e)
    r, s, t = jnp.stack([e, jnp.cross(d, e), d]) @ (X - X0)
    return jnp.asarray(sqrt_weight) * jnp.stack([r / t, s / t])
