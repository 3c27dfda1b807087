"""The structured solve: eliminate the points, solve the reduced system, substitute back.

With N = [A W; Wᵀ V] and V block diagonal (Brown 1958; Triggs et al. 2000, section 6.1):

    V_p = L_p·L_pᵀ,   Z = L⁻¹·Wᵀ,   h = L⁻¹·g_p
    S   = A − ZᵀZ                    (once per damping; sums over pairs of rays of a point)
    S·δ = −(g − Zᵀh)                 (`reduced.py`)
    δ_p = −L⁻ᵀ·(h + Z·δ)

In a free network the step is arbitrary along the datum directions; the datum is imposed afterwards
(`datum.py`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxbundle.adjustment.banded import BandFactor
from jaxbundle.adjustment.iterative import ConjugateGradients, precondition
from jaxbundle.adjustment.normal import Normal, diagonal
from jaxbundle.adjustment.parts import Parts, to_images, to_points
from jaxbundle.adjustment.reduced import DenseFactor, dense_matrix, factorise_reduced
from jaxbundle.network.arrays import Tangent
from jaxbundle.network.structure import Structure

EXACT = 1e-13
"""Relative residual of a reduced system solved by iteration, where it must be as good as exact."""
PIVOT = 1e-13
"""A pivot below this fraction of its diagonal element is rounding: nothing determines it."""


class Factor(eqx.Module):
    """N factorised: everything needed to solve with it, and to read blocks of its inverse.

    `reduced`: the factor of S; `point`: L_p⁻¹; `ray`, `incidence`: Z.
    """

    structure: Structure
    reduced: DenseFactor | BandFactor | ConjugateGradients
    point: Float[Array, "points 3 3"]
    ray: Float[Array, "rays 3 image_block"]
    incidence: Float[Array, "incidences 3 camera_block"]


def factorise(
    structure: Structure,
    normal: Normal,
    damping: Tangent | None = None,
    regular: Bool[Array, ""] | bool = True,
    tolerance: float = EXACT,
) -> Factor:
    """Factorise N + `damping` (diagonals; for images also matrices), with the datum directions
    made regular if `regular`: damping does that too, and the damped step should be no other.
    `tolerance`: of a reduced system solved by iteration.

    NaN where a pivot is rounding, as where it is negative: chance decides between the two.
    """
    if damping is not None:
        normal = _damped(normal, damping)
    parts, point, ray, incidence = eliminate(structure, normal)
    scale, free = _scale(structure, normal), reduced_free(structure)
    if structure.reduction == "iterative":
        factor = precondition(structure, parts, normal.image, ray, scale, free, tolerance)
    else:
        factor = factorise_reduced(structure, parts, scale, free, regular)
    sound = jnp.all(factor.pivots**2 > PIVOT)
    factor = jax.tree.map(lambda x: _where_floating(sound, x), factor)
    return Factor(structure, factor, point, ray, incidence)


def scaled_matrix(structure: Structure, normal: Normal) -> Float[Array, "reduced reduced"]:
    """The reduced matrix scaled to a unit diagonal, datum directions made regular; its lower
    triangle."""
    parts, *_ = eliminate(structure, normal)
    return dense_matrix(structure, parts, _scale(structure, normal), reduced_free(structure))


def _where_floating(sound, x):
    return jnp.where(sound, x, jnp.nan) if jnp.issubdtype(x.dtype, jnp.floating) else x


def _scale(s: Structure, normal: Normal) -> Float[Array, " reduced"]:
    """What brings the diagonal of A to 1."""
    D = reduced_vector(s, diagonal(normal))
    return jax.lax.rsqrt(jnp.where(D > 0, D, 1.0))


def eliminate(structure: Structure, normal: Normal):
    """Eliminate the points: the parts of the reduced matrix, and what substitution needs (the
    last fields of `Factor`)."""
    s = structure
    held = 1.0 - s.point_free * s.eliminated
    V = normal.point * s.eliminated[:, :, None] + held[:, :, None] * jnp.eye(3)
    point = inverse_cholesky_3x3(V)
    ray = jnp.einsum("nij,njk->nik", point[s.point], normal.image_point)
    incidence = normal.camera_point
    if s.camera_width:
        incidence = jnp.einsum("qij,qjk->qik", point[s.incidence.point], incidence)
    return _reduced_parts(s, normal, ray, incidence), point, ray, incidence


def solve(factor: Factor, right: Tangent) -> Tangent:
    """N⁻¹·b for one right-hand side, linear and transposable in b."""
    f, s = factor, factor.structure
    point_right = right.point * s.eliminated * s.point_free
    h = jnp.einsum("pij,pj->pi", f.point, point_right)
    reduced = reduced_vector(s, right) - reduced_vector(s, _gather_reduced(f, h))
    x = s.agreed(f.reduced.solve(reduced))
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
    matrices = lambda d: d if d.ndim == 3 else d[:, :, None] * jnp.eye(d.shape[1])
    add = lambda blocks, d: blocks + matrices(d)
    return eqx.tree_at(
        lambda n: (n.image, n.camera, n.point),
        normal,
        (add(normal.image, damping.image), add(normal.camera, damping.camera),
         add(normal.point, damping.point)),
    )  # fmt: skip


def reduced_free(s: Structure) -> Float[Array, " reduced"]:
    """1 for the free unknowns of the reduced system, 0 for the held ones."""
    camera = s.camera_free if s.camera_width else jnp.zeros((s.cameras, 0))
    return reduced_vector(s, Tangent(s.image_block_free, camera, s.point_free))


def _reduced_parts(s, normal, ray, incidence) -> Parts:
    """S = A − ZᵀZ, in parts."""
    I, w = s.images, s.image_width
    C, k, K = s.cameras, s.camera_width, s.kept.shape[0]
    pairs = -s.image_pairs.sum(ray, ray)  # none where S is only applied
    own = -s.table.products_by_image(ray, ray)
    B, D = jnp.zeros((C, I, k, w)), jnp.zeros((C, C, k, k))
    if k:
        at = s.image_camera_pairs
        B = B.at[at.column, at.row].add(-at.sum(ray, incidence).transpose(0, 2, 1))
        at = s.camera_pairs
        D = D.at[at.column, at.row].add(-at.sum(incidence, incidence).transpose(0, 2, 1))
    E, F, H = (jnp.zeros((K, n, 3, m)) for n, m in ((I, w), (C, k), (K, 3)))
    if K:
        kr, ki = s.kept_rays, s.kept_of_ray
        E = E.at[ki, s.image[kr]].add(normal.kept_image)
        F = F.at[ki, s.camera[kr]].add(normal.kept_camera)
        place = jnp.searchsorted(s.kept, s.distance)
        inside = (s.kept[jnp.minimum(place, K - 1)] == s.distance).all(1)
        ends = normal.kept_kept * inside[:, None, None]
        a, b = jnp.minimum(place, K - 1).T
        H = H.at[a, b].add(ends).at[b, a].add(ends.transpose(0, 2, 1))
        index = jnp.arange(K)
        H = H.at[index, index].add(normal.point[s.kept] * s.point_free[s.kept][:, :, None])
    pairs, own, B, D, E, F, H = s.total((pairs, own, B, D, E, F, H))
    own = own + normal.image
    if k:
        B = B.at[s.camera_of_image, jnp.arange(I)].add(normal.image_camera.transpose(0, 2, 1))
        D = D.at[jnp.arange(C), jnp.arange(C)].add(normal.camera)
    B, D, E, F, H = (_matrix(x) for x in (B, D, E, F, H))
    corner = jnp.concatenate([
        jnp.concatenate([D, F.T], 1), jnp.concatenate([F, H], 1)
    ])  # fmt: skip
    return Parts(pairs, own, jnp.concatenate([B, E]), corner)


def _matrix(blocks):
    """[rows, columns, m, n] blocks as a matrix."""
    r, c, m, n = blocks.shape
    return blocks.transpose(0, 2, 1, 3).reshape(r * m, c * n)


def _gather_reduced(f, h):
    """Zᵀh as a tangent of the reduced system."""
    s = f.structure
    image = to_images(s, f.ray, h)
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
    total = to_points(s, f.ray, image)
    if s.camera_width:
        total += jax.ops.segment_sum(
            jnp.einsum("qij,qj->qi", f.incidence, camera[s.incidence.camera]),
            s.incidence.point, s.points, indices_are_sorted=True,
        )  # fmt: skip
    return total
