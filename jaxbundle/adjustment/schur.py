"""The structured solve: eliminate the points, solve the reduced system, substitute back.

With N = [A W; Wᵀ V] and V block diagonal (Brown 1958; Triggs et al. 2000, section 6.1):

    V_p = L_p·L_pᵀ,   Z = L⁻¹·Wᵀ,   h = L⁻¹·g_p
    S   = A − ZᵀZ                    (once per damping; sums over pairs of rays of a point)
    S·δ = −(g − Zᵀh)                 (dense Cholesky, scaled to unit diagonal)
    δ_p = −L⁻ᵀ·(h + Z·δ)

A free network is singular along its datum directions G (similarities). They are made regular by
adding q·qᵀ to the scaled S, q an orthonormal basis of G's part in the reduced system: the step
changes along G only, and the datum is then imposed by an S-transformation (`datum.py`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbundle.adjustment.normal import Normal
from jaxbundle.network.arrays import Tangent
from jaxbundle.network.structure import Structure

PIVOT = 1e-13
"""A pivot below this fraction of its diagonal element is rounding: nothing determines it."""


class Factor(eqx.Module):
    """N factorised: everything needed to solve with it, and to read blocks of its inverse.

    `cholesky`: lower factor of the reduced system scaled by `scale` on both sides;
    `point`: L_p⁻¹; `ray`, `incidence`: Z.
    """

    structure: Structure
    cholesky: Float[Array, "reduced reduced"]
    scale: Float[Array, " reduced"]
    point: Float[Array, "points 3 3"]
    ray: Float[Array, "rays 3 image_block"]
    incidence: Float[Array, "incidences 3 camera_block"]


def factorise(
    structure: Structure,
    normal: Normal,
    damping: Tangent | None = None,
    gauge: Tangent | None = None,
) -> Factor:
    """Factorise N + diag(damping), with the datum directions `gauge` (last axis) made regular.

    NaN where a pivot is rounding, as where it is negative: chance decides between the two.
    """
    matrix, *rest = reduce(structure, normal, damping, gauge)
    cholesky = jnp.linalg.cholesky(matrix, symmetrize_input=False)
    regular = jnp.all(jnp.diagonal(cholesky) ** 2 > PIVOT)
    return Factor(structure, jnp.where(regular, cholesky, jnp.nan), *rest)


def reduce(
    structure: Structure,
    normal: Normal,
    damping: Tangent | None = None,
    gauge: Tangent | None = None,
):
    """Eliminate the points: the reduced matrix scaled to unit diagonal (before elimination; its
    lower triangle), the scale, and what substitution needs (the fields of `Factor`)."""
    s = structure
    if damping is not None:
        normal = _damped(normal, damping)
    held = 1.0 - s.point_free * s.eliminated
    V = normal.point * s.eliminated[:, :, None] + held[:, :, None] * jnp.eye(3)
    point = inverse_cholesky_3x3(V)
    ray = jnp.einsum("nij,njk->nik", point[s.point], normal.image_point)
    incidence = normal.camera_point
    if s.camera_width:
        incidence = jnp.einsum("qij,qjk->qik", point[s.incidence.point], incidence)
    S = _reduced_matrix(s, normal, ray, incidence)
    diagonal = jnp.diagonal(S)
    original = reduced_vector(s, _diagonal_of(s, normal))
    scale = jax.lax.rsqrt(jnp.where(original > 0, original, 1.0))
    S = S * scale[:, None] * scale[None, :]
    index = jnp.arange(S.shape[0])
    S = S.at[index, index].set(jnp.where(reduced_free(s) > 0, diagonal * scale**2, 1.0))
    if gauge is not None and s.defect:
        directions = jax.vmap(lambda g: reduced_vector(s, g), -1, -1)(gauge) / scale[:, None]
        q, _ = jnp.linalg.qr(directions)
        S = S + q @ q.T
    return S, scale, point, ray, incidence


def solve(factor: Factor, right: Tangent) -> Tangent:
    """N⁻¹·b for one right-hand side, linear and transposable in b."""
    f, s = factor, factor.structure
    point_right = right.point * s.eliminated * s.point_free
    h = jnp.einsum("pij,pj->pi", f.point, point_right)
    reduced = reduced_vector(s, right) - reduced_vector(s, _gather_reduced(f, h))
    x = jax.scipy.linalg.cho_solve((f.cholesky, True), reduced * f.scale) * f.scale
    x = jnp.where(reduced_free(s) > 0, x, 0.0)
    image, camera, kept = split_reduced(s, x)
    h = h - _scatter_points(f, image, camera)
    point = jnp.einsum("pji,pj->pi", f.point, h) * s.eliminated * s.point_free
    return Tangent(image, camera, point.at[s.kept].add(kept * s.point_free[s.kept]))


def reduced_vector(structure: Structure, tangent: Tangent) -> Float[Array, " reduced"]:
    """The part of a tangent that belongs to the reduced system: images, cameras, kept points."""
    kept = structure.kept
    kept = structure.total(tangent.point[kept] * structure.point_free[kept])
    return jnp.concatenate([tangent.image.ravel(), tangent.camera.ravel(), kept.ravel()])


def split_reduced(structure: Structure, vector):
    """The images, cameras and kept points of a vector of the reduced system."""
    s = structure
    n = s.images * s.image_width
    m = n + s.cameras * s.camera_width
    return (
        vector[:n].reshape(s.images, s.image_width),
        vector[n:m].reshape(s.cameras, s.camera_width),
        vector[m:].reshape(-1, 3),
    )


def inverse_cholesky_3x3(V: Float[Array, "n 3 3"]) -> Float[Array, "n 3 3"]:
    """L⁻¹ of V = L·Lᵀ in closed form (7 ns a point; a batched Cholesky takes 60); else NaN."""
    root = lambda pivot, element: jnp.sqrt(jnp.where(pivot > PIVOT * element, pivot, jnp.nan))
    i00 = 1 / root(V[:, 0, 0], 0.0)
    l10, l20 = V[:, 1, 0] * i00, V[:, 2, 0] * i00
    i11 = 1 / root(V[:, 1, 1] - l10 * l10, V[:, 1, 1])
    l21 = (V[:, 2, 1] - l20 * l10) * i11
    i22 = 1 / root(V[:, 2, 2] - l20 * l20 - l21 * l21, V[:, 2, 2])
    m10 = -l10 * i00 * i11
    m21 = -l21 * i11 * i22
    m20 = -(l20 * i00 + l21 * m10) * i22
    zero = jnp.zeros_like(i00)
    rows = [[i00, zero, zero], [m10, i11, zero], [m20, m21, i22]]
    return jnp.stack([jnp.stack(r, -1) for r in rows], -2)


def _damped(normal: Normal, damping: Tangent) -> Normal:
    add = lambda blocks, d: blocks + d[:, :, None] * jnp.eye(d.shape[1])
    return eqx.tree_at(
        lambda n: (n.image, n.camera, n.point),
        normal,
        (add(normal.image, damping.image), add(normal.camera, damping.camera),
         add(normal.point, damping.point)),
    )  # fmt: skip


def _diagonal_of(s, normal):
    pick = lambda blocks: jnp.diagonal(blocks, axis1=1, axis2=2)
    return Tangent(pick(normal.image), pick(normal.camera), pick(normal.point))


def reduced_free(s: Structure) -> Float[Array, " reduced"]:
    """1 for the free unknowns of the reduced system, 0 for the held ones."""
    camera = s.camera_free if s.camera_width else jnp.zeros((s.cameras, 0))
    return reduced_vector(s, Tangent(s.image_block_free, camera, s.point_free))


def _reduced_matrix(s, normal, ray, incidence):
    """S = A − ZᵀZ, dense; only its lower triangle needs to be right."""
    I, w = s.images, s.image_width
    C, k, K = s.cameras, s.camera_width, s.kept.shape[0]
    index = jnp.arange(I)
    pairs = s.image_pairs
    S = jnp.zeros((I, I, w, w))
    S = S.at[pairs.column, pairs.row].add(-pairs.sum(ray, ray).transpose(0, 2, 1))
    S = S.at[index, index].add(-s.table.products_by_image(ray, ray))
    rows = [[S, None, None]]
    if k:
        pairs = s.image_camera_pairs
        coupling = -pairs.sum(ray, incidence)
        B = jnp.zeros((C, I, k, w)).at[pairs.column, pairs.row].add(coupling.transpose(0, 2, 1))
        pairs = s.camera_pairs
        coupling = -pairs.sum(incidence, incidence)
        D = jnp.zeros((C, C, k, k)).at[pairs.column, pairs.row].add(coupling.transpose(0, 2, 1))
        rows.append([B, D, None])
    if K:
        kr, ki = s.kept_rays, s.kept_of_ray
        E = jnp.zeros((K, I, 3, w)).at[ki, s.image[kr]].add(normal.kept_image)
        F = jnp.zeros((K, C, 3, k)).at[ki, s.camera[kr]].add(normal.kept_camera)
        H = jnp.zeros((K, K, 3, 3))
        place = jnp.searchsorted(s.kept, s.distance)
        inside = (s.kept[jnp.minimum(place, K - 1)] == s.distance).all(1)
        ends = normal.kept_kept * inside[:, None, None]
        a, b = jnp.minimum(place, K - 1).T
        H = H.at[a, b].add(ends).at[b, a].add(ends.transpose(0, 2, 1))
        own = normal.point[s.kept] * s.point_free[s.kept][:, :, None]
        H = H.at[jnp.arange(K), jnp.arange(K)].add(own)
        rows.append([E, F, H])
    rows = s.total(rows)
    rows[0][0] = rows[0][0].at[index, index].add(normal.image)
    if k:
        image_camera = normal.image_camera.transpose(0, 2, 1)
        rows[1][0] = rows[1][0].at[s.camera_of_image, index].add(image_camera)
        rows[1][1] = rows[1][1].at[jnp.arange(C), jnp.arange(C)].add(normal.camera)
    rows = [[_matrix(block) for block in row if block is not None] for row in rows]
    if len(rows) == 1:
        return rows[0][0]
    n = s.reduced_size
    full, at = jnp.zeros((n, n)), 0
    for row in rows:
        left = 0
        for block in row:
            full = jax.lax.dynamic_update_slice(full, block, (at, left))
            left += block.shape[1]
        at += row[0].shape[0]
    return full


def _matrix(blocks):
    """[rows, columns, m, n] blocks as a matrix."""
    r, c, m, n = blocks.shape
    return blocks.transpose(0, 2, 1, 3).reshape(r * m, c * n)


def _gather_reduced(f, h):
    """Zᵀh as a tangent of the reduced system."""
    s = f.structure
    image = s.table.products_by_image(f.ray, h[s.point][:, :, None])[:, :, 0]
    camera = jnp.zeros((s.cameras, s.camera_width))
    if s.camera_width:
        camera = jax.ops.segment_sum(
            jnp.einsum("qij,qi->qj", f.incidence, h[s.incidence.point]),
            s.incidence.camera, s.cameras,
        )  # fmt: skip
    return Tangent(*s.total((image, camera)), jnp.zeros((s.points, 3)))


def _scatter_points(f, image, camera):
    """Z·δ for changes of images and cameras, [points, 3]."""
    s = f.structure
    total = jax.ops.segment_sum(
        s.table.times_image(f.ray, image), s.point, s.points
    )
    if s.camera_width:
        total += jax.ops.segment_sum(
            jnp.einsum("qij,qj->qi", f.incidence, camera[s.incidence.camera]),
            s.incidence.point, s.points, indices_are_sorted=True,
        )  # fmt: skip
    return total
