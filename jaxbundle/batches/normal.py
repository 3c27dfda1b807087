"""The normal equations of one camera calibrated from many views of known points, by view.

    ray = M·X + t,        v = computed − observed image point      (pixels, weight 1 or 0)

The unknowns are the free parameters of the interior orientation, shared by all views, and 6 per
view: a shift δt and a rotation δθ about the centre of the object, which is the origin of X:

    ray(δ) = M·X + δθ × (M·X) + t + δt

These two are hardly correlated, whereas a rotation about the projection centre shifts the image
like a displacement. For each view the *augmented* normal matrix is stored,

    N = [Jₑ Jᵢ v]ᵀ·[Jₑ Jᵢ v],        Jₑ ∂v/∂(δt, δθ),  Jᵢ ∂v/∂(interior),

which contains everything for a step, its predicted effect and the covariances. The views are
eliminated first (Schur), then a small dense system of the interior orientation remains:

    S = Σ Nᵢᵢ − Nᵢₑ·Nₑₑ⁻¹·Nₑᵢ

Arrays are [views, points] for every quantity of a point, and one matrix product per view builds N:
a camera of 20 views × 88 points takes 0.12 ms on a core, with the derivatives as the last axis 0.18
ms.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxbundle import cameras
from jaxbundle.batches.small_cholesky import Rows, backward, cholesky, forward, rows_of
from jaxbundle.cameras import CameraModel
from jaxbundle.geometry import matrix_from_quaternion, retract_quaternion
from jaxbundle.types import AnyArray, Scalar

# Unknowns of a view: δt (3), δθ (3).
POSE = 6
ByPoint = Float[AnyArray, "views points"]


class Sightings(eqx.Module):
    """The data of one camera: object points about their centroid, image points, weights 1 or 0."""

    point: Float[AnyArray, "*cameras points 3"]
    xy: Float[AnyArray, "*cameras views points 2"]
    weight: Float[AnyArray, "*cameras views points"]

    @property
    def views(self) -> Bool[Array, " views"]:
        """Used views."""
        return jnp.any(self.weight > 0, 1)


class CameraUnknowns(eqx.Module):
    """The unknowns: all interior parameters; unit quaternion of M and t of every view."""

    interior: Float[AnyArray, " parameters"]
    rotation: Float[AnyArray, "views 4"]
    shift: Float[AnyArray, "views 3"]


def normal_equations(
    model: CameraModel, free: tuple[int, ...], sightings: Sightings, unknowns: CameraUnknowns
) -> Float[Array, "views n n"]:
    """The augmented normal matrix of every view [views, 6 + k + 1, 6 + k + 1].

    **Arguments:** `free`: the columns of the k free parameters.
    """
    return gram(*design(model, free, sightings, unknowns))


def design(
    model: CameraModel, free: tuple[int, ...], sightings: Sightings, unknowns: CameraUnknowns
) -> tuple[list[ByPoint], list[ByPoint]]:
    """The columns of [Jₑ Jᵢ v], each [views, points]: the rows of x, and those of y."""
    M = jax.vmap(matrix_from_quaternion)(unknowns.rotation)
    of_view = lambda column: column[:, None]
    # Invisible points are put at the centre of the object, whose image always exists.
    X = [jnp.where(sightings.weight > 0, sightings.point[:, i], 0.0) for i in range(3)]
    Y = [sum(of_view(M[:, i, j]) * X[j] for j in range(3)) for i in range(3)]
    t = [of_view(unknowns.shift[:, i]) for i in range(3)]
    xy = (sightings.xy[..., 0], sightings.xy[..., 1])

    def weighted_residual(change: tuple[Sequence[ByPoint], ...]) -> tuple[ByPoint, ByPoint]:
        d_shift, (a, b, c), d_interior = change
        turn = (b * Y[2] - c * Y[1], c * Y[0] - a * Y[2], a * Y[1] - b * Y[0])
        ray = tuple(Y[i] + turn[i] + t[i] + d_shift[i] for i in range(3))
        interior = list(unknowns.interior)
        for column, d in zip(free, d_interior):
            interior[column] = interior[column] + d
        vx, vy = cameras.residual(model, "measured", tuple(interior), ray, xy)
        return sightings.weight * vx, sightings.weight * vy

    # Every point has its own unknowns here, so that one pull for x and one for y, of all points at
    # once, give all columns: two passes whatever the number of parameters.
    nil = jnp.zeros_like(sightings.weight)
    ones = jnp.ones_like(nil)
    zero_change = ((nil,) * 3, (nil,) * 3, (nil,) * len(free))
    (vx, vy), pull = jax.vjp(weighted_residual, zero_change)
    flat = lambda rows: [column for group in rows for column in group]
    return [*flat(pull((ones, nil))[0]), vx], [*flat(pull((nil, ones))[0]), vy]


def residual_lengths(model: CameraModel, sightings: Sightings, unknowns: CameraUnknowns) -> ByPoint:
    """√(vx² + vy²) of all points, 0 if invisible."""
    M = jax.vmap(matrix_from_quaternion)(unknowns.rotation)
    X = [jnp.where(sightings.weight > 0, sightings.point[:, i], 0.0) for i in range(3)]
    r, s, q = (
        sum(M[:, i, j, None] * X[j] for j in range(3)) + unknowns.shift[:, i, None]
        for i in range(3)
    )
    xy = (sightings.xy[..., 0], sightings.xy[..., 1])
    vx, vy = cameras.residual(model, "measured", tuple(unknowns.interior), (r, s, q), xy)
    return jnp.asarray(sightings.weight) * jnp.sqrt(vx * vx + vy * vy)


def effects_of_object_points(
    model: CameraModel, sightings: Sightings, unknowns: CameraUnknowns
) -> tuple[Float[Array, "2 views points"], Float[Array, "3 2 views points"]]:
    """v of all points and ∂v/∂X by their object points, 0 if invisible: forward, 0.05 ms (backward,
    as in `design`, 0.09 ms)."""
    M = jax.vmap(matrix_from_quaternion)(unknowns.rotation)
    xy = (sightings.xy[..., 0], sightings.xy[..., 1])
    weight = jnp.asarray(sightings.weight)
    X = [jnp.where(weight > 0, sightings.point[:, i], 0.0) for i in range(3)]

    def weighted_residual(X: Sequence[ByPoint]) -> tuple[ByPoint, ByPoint]:
        r, s, q = (
            sum(M[:, i, j, None] * X[j] for j in range(3)) + unknowns.shift[:, i, None]
            for i in range(3)
        )
        vx, vy = cameras.residual(model, "measured", tuple(unknowns.interior), (r, s, q), xy)
        return weight * vx, weight * vy

    ones, zeros = jnp.ones_like(weight), jnp.zeros_like(weight)
    direction_of = lambda axis: [ones if i == axis else zeros for i in range(3)]
    pushed = [jax.jvp(weighted_residual, (X,), (direction_of(axis),)) for axis in range(3)]
    return jnp.stack(pushed[0][0]), jnp.stack([jnp.stack(change) for _, change in pushed])


def gram(x: list[ByPoint], y: list[ByPoint]) -> Float[Array, "views n n"]:
    """AᵀA by view, of the n columns of A, with a row in x and one in y per point."""
    square = lambda A: jnp.einsum("vip,vjp->vij", A, A)
    return square(jnp.stack(x, 1)) + square(jnp.stack(y, 1))


class CameraFactor(eqx.Module):
    """The damped normal equations, factorised.

    `scale` [views, 6] and `interior_scale` [k] make the diagonal 1 before the damping; `reduced` is
    the matrix of the interior orientation, so scaled, after the elimination.
    """

    pose: Rows
    eliminated: list[Float[Array, "views k+1"]]
    reduced: Float[Array, "k k"]
    scale: Float[Array, "views 6"]
    interior: Float[Array, "k k"]
    interior_scale: Float[Array, " k"]
    right: Float[Array, " k"]


def factorise(
    N: Float[Array, "views n n"], views: Bool[Array, " views"], damping: Scalar
) -> CameraFactor:
    """Eliminate the views and factorise what remains; damping is Marquardt's, λ·diag(N)."""
    k = N.shape[1] - POSE - 1
    diagonal = jnp.diagonal(N, axis1=1, axis2=2)
    scale = jax.lax.rsqrt(jnp.where(views[:, None], diagonal[:, :POSE], 1.0))
    E = rows_of(N[:, :POSE, :POSE])
    s = [scale[:, i] for i in range(POSE)]
    E = [[s[i] * s[j] * E[i][j] for j in range(i + 1)] for i in range(POSE)]
    # The unit diagonal of Marquardt's scaling; views that take no part get it too, so that they are
    # solvable and change nothing.
    for i in range(POSE):
        E[i][i] = jnp.where(views, 1.0 + damping, 1.0)
    # Nₑₑ = L·Lᵀ, Y = L⁻¹·[Nₑᵢ gₑ]: S = Σ Nᵢᵢ − YᵀY, with the reduced right hand side as its last
    # column
    L = cholesky(E)
    wide = [[element[:, None] for element in row] for row in L]
    Y = forward(wide, [s[i][:, None] * N[:, i, POSE:] for i in range(POSE)])
    flat = jnp.concatenate(Y, 0)
    total = N[:, POSE:, POSE:].sum(0)
    reduced = total - flat.T @ flat
    interior_scale = jax.lax.rsqrt(jnp.diagonal(total)[:k])
    S = interior_scale[:, None] * reduced[:k, :k] * interior_scale + damping * jnp.eye(k)
    factor = jnp.linalg.cholesky(S)
    return CameraFactor(
        pose=L,
        eliminated=Y,
        reduced=S,
        scale=scale,
        interior=factor,
        interior_scale=interior_scale,
        right=reduced[:k, k],
    )


def step(factor: CameraFactor) -> tuple[Float[Array, "views 6"], Float[Array, " k"]]:
    """The change −(N + λD)⁻¹·Jᵀv: of the views [views, 6] and the interior orientation [k]."""
    b = -factor.interior_scale * factor.right
    d_interior = factor.interior_scale * jax.scipy.linalg.cho_solve((factor.interior, True), b)
    k = len(b)
    Y = [-(row[:, k] + row[:, :k] @ d_interior) for row in factor.eliminated]
    return factor.scale * jnp.stack(backward(factor.pose, Y), 1), d_interior


def cofactors(
    factor: CameraFactor,
) -> tuple[Float[Array, "k k"], Float[Array, "views 6 6"], Float[Array, ""]]:
    """Q of the interior orientation [k, k], and of every view [views, 6, 6], marginal; and the
    determinability of the weakest interior parameter, 1/(Qᵢᵢ·Nᵢᵢ): 1 independent, 0
    undetermined."""
    k = len(factor.right)
    inverse = jax.scipy.linalg.cho_solve((factor.interior, True), jnp.eye(k))
    interior = factor.interior_scale[:, None] * inverse * factor.interior_scale
    columns = [jnp.broadcast_to(row, (len(factor.scale), POSE)) for row in jnp.eye(POSE)]
    wide = [[element[:, None] for element in row] for row in factor.pose]
    # Qₑₑ = Nₑₑ⁻¹ + Nₑₑ⁻¹·Nₑᵢ·Qᵢᵢ·Nᵢₑ·Nₑₑ⁻¹
    pose_alone = backward(wide, forward(wide, columns))
    pose_through_interior = backward(wide, [row[:, :k] for row in factor.eliminated])
    pose_alone, pose_through_interior = (
        factor.scale[:, :, None] * jnp.stack(x, 1) for x in (pose_alone, pose_through_interior)
    )
    pose = pose_alone * factor.scale[
        :, None, :
    ] + pose_through_interior @ interior @ pose_through_interior.swapaxes(1, 2)
    return interior, pose, 1 / jnp.max(jnp.diagonal(inverse))


def retract(
    free: tuple[int, ...],
    unknowns: CameraUnknowns,
    d_pose: Float[Array, "views 6"],
    d_interior: Float[Array, " k"],
) -> CameraUnknowns:
    """The unknowns after a change; every view rotates about the centre of the object."""
    return CameraUnknowns(
        interior=jnp.asarray(unknowns.interior).at[jnp.array(free)].add(d_interior),
        rotation=jax.vmap(retract_quaternion)(unknowns.rotation, d_pose[:, 3:]),
        shift=unknowns.shift + d_pose[:, :3],
    )
