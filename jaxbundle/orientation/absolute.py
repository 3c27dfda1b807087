"""Absolute orientation: the similarity transformation between two lists of points.

    X' = exp(s)·R·X + t,        Σ pᵢ·|X'ᵢ(τ) − X'ᵢ|² = min,        τ = (t, ω, s), R = exp([ω]×)

In closed form about the weighted means (Horn, 1987, J. Opt. Soc. Am. A 4(4), 629–642): R is that of
the quaternion that belongs to the largest eigenvalue of a symmetric 4 × 4 matrix, so never a
reflection; exp(s) is the regression coefficient of X' on R·X. τ as in `geometry.similarity`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxbundle.arguments import without_masks
from jaxbundle.geometry import (
    matrix_from_quaternion,
    rotation_vector_from_quaternion,
    transform_point,
)
from jaxbundle.leastsquares.iterations.small import inverse
from jaxbundle.orientation.linear import are_collinear, normalisation, ones_unless
from jaxbundle.orientation.status import Status, first_of
from jaxbundle.types import AnyArray


class AbsoluteOrientation(eqx.Module):
    """τ = (tx, ty, tz, ωx, ωy, ωz, s), residuals computed − given, vᵀPv, cofactors Q of τ."""

    tau: Float[AnyArray, "7"]
    residuals: Float[AnyArray, "n 3"]
    vtpv: Float[AnyArray, ""]
    cofactor: Float[AnyArray, "7 7"]
    status: Int[AnyArray, ""]


@without_masks
def absolute_orientation(
    source: Float[AnyArray, "n 3"],
    target: Float[AnyArray, "n 3"],
    weights: Float[AnyArray, " n"] | None = None,
) -> AbsoluteOrientation:
    """The similarity from `source` to `target`, differentiable, without start values.

    **Arguments:** corresponding points, three or more, not on one line (`COLLINEAR_POINTS`);
    weights p = 1/σ² of the target, equal in X, Y, Z; 0: the point is absent.

    **Returns:** the cofactors times σ0² are the covariance of τ: t in the target's unit, ω in
    radians, s without unit.
    """
    p = ones_unless(weights, source)
    (X, _), (Y, _) = normalisation(source, p), normalisation(target, p)
    x, y = source - X, target - Y
    q = rotation_between(x, y, p)
    R = matrix_from_quaternion(q)
    turned = x @ R.T
    scale = jnp.sum(p[:, None] * turned * y) / jnp.sum(p[:, None] * x * x)
    omega = rotation_vector_from_quaternion(q)
    tau = jnp.concatenate([Y - scale * R @ X, omega, jnp.log(scale)[None]])
    line = are_collinear(source, p) | are_collinear(target, p)
    sqrt_p = jnp.sqrt(p)[:, None]
    computed = lambda t: jax.vmap(transform_point, (None, 0))(t, source)
    # The Jacobian by differentiation, not by hand: it is needed once, and the seven columns are
    # those of `transform_point`, whose parameters τ the network uses as well.
    J = (sqrt_p[:, :, None] * jax.jacfwd(computed)(tau)).reshape(-1, 7)
    N = jnp.where(line, jnp.eye(7, dtype=J.dtype), J.T @ J)
    v = computed(tau) - target
    return AbsoluteOrientation(
        tau,
        v,
        jnp.sum(p[:, None] * v * v),
        jnp.where(line, jnp.inf, inverse(N)),
        first_of((line, Status.COLLINEAR_POINTS)),
    )


def rotation_between(
    x: Float[AnyArray, "n 3"], y: Float[AnyArray, "n 3"], weights: Float[AnyArray, " n"]
) -> Float[Array, "4"]:
    """The unit quaternion of the rotation that best maps directions x to y (Horn, 1987)."""
    # The quaternion q maximises qᵀ·N·q, N built from the 3 × 3 sums S = Σ p·x·yᵀ: the eigenvector
    # of the largest eigenvalue, which `eigh` puts last. An SVD of S would need a test of det R for
    # reflections (Arun, Huang and Blostein, 1987); a quaternion is a rotation always.
    S = jnp.einsum("n,ni,nj->ij", weights, x, y)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = S
    rows = [
        [xx + yy + zz, yz - zy, zx - xz, xy - yx],
        [yz - zy, xx - yy - zz, xy + yx, zx + xz],
        [zx - xz, xy + yx, yy - xx - zz, yz + zy],
        [xy - yx, zx + xz, yz + zy, zz - xx - yy],
    ]
    return jnp.linalg.eigh(jnp.array(rows))[1][:, -1]
