r"""The two relative orientations of a plane.

Rays a = (x, y, −1) to the points of a plane nᵀ·Y = d in two images are related by

    a₂ ~ G·a₁,      G = M·(I − b·nᵀ/d)

and G, scaled to a second singular value of 1, has two decompositions with the plane in front of the
first camera. Both fit the images exactly; where both have the plane in front of the second camera
as well, two images alone cannot choose. With the eigenvectors v and eigenvalues λ of GᵀG,

    u = (√(1 − λ₃)·v₁ ± √(λ₁ − 1)·v₃)/√(λ₁ − λ₃),     n = v₂ × u
    M = [G·v₂, G·u, G·v₂ × G·u]·[v₂, u, v₂ × u]ᵀ,     b ~ −Mᵀ·(G − M)·n

Source: Ma, Soatto, Košecká and Sastry (2004), An Invitation to 3-D Vision, section 5.3.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxbundle.orientation.homography import homography
from jaxbundle.orientation.linear import ones_unless
from jaxbundle.orientation.pose import ray_of
from jaxbundle.orientation.status import Status, first_of
from jaxbundle.types import AnyArray


class PlanarOrientations(eqx.Module):
    """Both solutions: M from the first camera to the second, base b of length 1 and unit normal n
    (nᵀ·Y > 0 on the plane) in the frame of the first; `possible`: the plane is in front of both
    cameras; `status`: `NO_BASE`, or what `homography` says."""

    M: Float[AnyArray, "2 3 3"]
    b: Float[AnyArray, "2 3"]
    normal: Float[AnyArray, "2 3"]
    possible: Bool[AnyArray, " 2"]
    status: Int[AnyArray, ""]


def planar_orientations(
    xy1: Float[AnyArray, "n 2"],
    xy2: Float[AnyArray, "n 2"],
    weights: Float[AnyArray, " n"] | None = None,
) -> PlanarOrientations:
    """Both relative orientations of two images of n ≥ 4 points of a plane.

    **Arguments:** as of `relative_orientation`. With noise the solutions are start values.
    """
    p = ones_unless(weights, xy1)
    H, status = homography(xy1, xy2, p)
    D = jnp.diag(jnp.array([1.0, 1.0, -1.0]))
    G = D @ H @ D
    # H fixes G up to a factor: its size by the second singular value, which is 1 of M·(I − b·nᵀ/d);
    # its sign by the points, which G maps to the same side.
    G = G / jnp.linalg.svd(G, compute_uv=False)[1]
    a1, a2 = jax.vmap(ray_of)(xy1), jax.vmap(ray_of)(xy2)
    G = G * jnp.where(jnp.sum(p * jnp.einsum("ni,ij,nj->n", a2, G, a1)) < 0, -1.0, 1.0)
    square, V = jnp.linalg.eigh(G.T @ G)
    v3, v2, v1 = V.T
    excess, deficit = jnp.maximum(square[2] - 1, 0), jnp.maximum(1 - square[0], 0)
    # λ₁ − λ₃ is about 2·|b|/d, the base by the distance of the plane: a base of 1e-9 of the
    # distance moves no image point by what can be measured, and is far above rounding (1e-15).
    no_base = excess + deficit < 1e-9
    base_norm = jnp.sqrt(jnp.where(no_base, 1.0, excess + deficit))

    def solution(sign: Float[Array, ""]) -> tuple[Array, Array, Array, Array]:
        """M, b, n, and whether the plane is in front of both cameras."""
        u = (jnp.sqrt(deficit) * v1 + sign * jnp.sqrt(excess) * v3) / base_norm
        n = jnp.cross(v2, u)
        Gv, Gu = G @ v2, G @ u
        M = jnp.stack([Gv, Gu, jnp.cross(Gv, Gu)], 1) @ jnp.stack([v2, u, n])
        n = n * jnp.where(jnp.sum(p * (a1 @ n)) < 0, -1.0, 1.0)
        b = -M.T @ (G - M) @ n
        length = jnp.linalg.norm(b)
        # Depth of the points in both cameras, in units of the plane's distance.
        depth = 1 / (a1 @ n)
        in_second = (depth[:, None] * a1 - b) @ M.T
        front = (depth > 0) & (in_second[:, 2] < 0)
        return M, b / jnp.where(length > 0, length, 1.0), n, jnp.all(front | (p == 0))

    M, b, n, possible = jax.vmap(solution)(jnp.array([1.0, -1.0]))
    # A homography that the points leave open says nothing about the base.
    is_open = status != int(Status.SOUND)
    status = jnp.where(is_open, status, first_of((no_base, Status.NO_BASE)))
    return PlanarOrientations(M, b, n, possible & ~no_base, status)
