"""Relative orientation in closed form: essential matrices from eight and from five points.

The rays a₁ = (x₁, y₁, −1), a₂ = (x₂, y₂, −1) of one object point in two images and the base b, in
the frame of the first camera, are coplanar; with M the rotation from the first camera to the second

    a₂ᵀ·E·a₁ = 0,        E = M·[b]×,        2·E·Eᵀ·E − tr(E·Eᵀ)·E = 0,  det E = 0

Eight points determine E linearly (Longuet-Higgins, 1981; normalised as in Hartley, 1997), if they
do not lie in a plane. Five leave E = x·E₁ + y·E₂ + z·E₃ + E₄, and the ten cubic equations on the
right are solved by the eigenvectors of a 10 × 10 matrix: multiplication by x modulo the equations
(Nistér, 2004, IEEE PAMI 26(6); Stewénius, Engels and Nistér, 2006, ISPRS J. 60(4), 284–294).
"""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.lax import stop_gradient
from jaxtyping import Bool, Float

from jaxbundle.arguments import without_masks
from jaxbundle.orientation.linear import normalisation, null_space, null_vector, ones_unless
from jaxbundle.orientation.pose import ray_of
from jaxbundle.types import AnyArray


def _exponents(degree: int) -> list[tuple[int, int, int]]:
    """Exponents of the monomials xⁱ·yʲ·zᵏ of a degree, by falling powers of x and y."""
    return [(n - j, j, degree - n) for n in range(degree, -1, -1) for j in range(n + 1)]


# The ten monomials of degree three are eliminated; the ten of lower degree are a basis of the
# polynomials modulo the ten equations, in which multiplication by x is a matrix.
_CUBIC = _exponents(3)
_BASIS = [*_exponents(2), *_exponents(1), *_exponents(0)]


@without_masks
def eight_points(
    xy1: Float[AnyArray, "n 2"],
    xy2: Float[AnyArray, "n 2"],
    weights: Float[AnyArray, " n"] | None = None,
) -> tuple[Float[Array, "3 3"], Float[Array, "9"]]:
    """E of n ≥ 8 points, |E|² = 2, and the singular values of the normalised linear system.

    Image coordinates divided by the principal distance, y up. Of points in a plane, or without a
    base, the second last singular value is zero as well, and E is meaningless.
    """
    p = ones_unless(weights, xy1)
    T1, T2 = _to_normalised(xy1, p), _to_normalised(xy2, p)
    a1, a2 = jax.vmap(ray_of)(xy1) @ T1.T, jax.vmap(ray_of)(xy2) @ T2.T
    h, singular = null_vector(_coplanarity(a1, a2, p))
    return _nearest_essential(T2.T @ h.reshape(3, 3) @ T1), singular


@without_masks
def five_points(
    xy1: Float[AnyArray, "n 2"],
    xy2: Float[AnyArray, "n 2"],
    weights: Float[AnyArray, " n"] | None = None,
) -> tuple[Float[Array, "10 3 3"], Bool[Array, "10"]]:
    """Up to ten E of n ≥ 5 points, and which of the ten slots are real solutions, |E|² = 2.

    Of more than five points the four right singular vectors that fit best are used. A slot that is
    not valid has the real part of a complex solution. Without derivatives: those of a refined
    relative orientation are exact.
    """
    E, valid = five_solutions(xy1, xy2, weights)
    return jax.vmap(_nearest_essential)(E), valid


def five_solutions(
    xy1: Float[AnyArray, "n 2"],
    xy2: Float[AnyArray, "n 2"],
    weights: Float[AnyArray, " n"] | None = None,
) -> tuple[Float[Array, "10 3 3"], Bool[Array, "10"]]:
    """As `five_points`, but without projection to the nearest essential matrix: of any length, and
    essential only to rounding, or not at all if invalid. `orientations` takes the nearest itself.
    """
    p = ones_unless(weights, xy1)
    a1, a2 = jax.vmap(ray_of)(stop_gradient(xy1)), jax.vmap(ray_of)(stop_gradient(xy2))
    space = null_space(_coplanarity(a1, a2, stop_gradient(p)), 4).reshape(4, 3, 3)
    equations = _cubic_equations(space)
    reduced = jnp.linalg.solve(equations[:, :10], equations[:, 10:])
    times_x = jnp.asarray(_TAKE_CUBIC) @ -reduced + jnp.asarray(_TAKE_BASIS)
    x, vectors = jnp.linalg.eig(jnp.where(jnp.isfinite(times_x), times_x, 0))
    # An eigenvector holds the values of the basis at a solution: its last entries are x, y, z, 1.
    w = vectors[9]
    xyz = vectors[6:9] / jnp.where(jnp.abs(w) > 0, w, 1)
    size = 1 + jnp.sum(jnp.abs(xyz), 0)
    usable = (jnp.abs(w) > 0) & jnp.all(jnp.isfinite(times_x))
    # Rounding moves a double root by the root of 1e-16, 1e-8 of its length, off the real axis;
    # 1e-6 leaves room for the elimination before. Truly complex pairs of noisy points are farther
    # off, and serve as start values in `relative_orientation` all the same.
    valid = usable & (jnp.max(jnp.abs(xyz.imag), 0) < 1e-6 * size)
    xyzw = jnp.concatenate([xyz.real, jnp.ones_like(xyz.real[:1])])
    E = jnp.einsum("as,aij->sij", jnp.where(usable, xyzw, 1), space)
    return E, valid


def orientations(E: Float[AnyArray, "3 3"]) -> tuple[Float[Array, "4 3 3"], Float[Array, "4 3"]]:
    """The four pairs (M, b), |b| = 1, of the nearest essential matrix: ±E = M·[b]×."""
    U, _, Vt = jnp.linalg.svd(E)
    U, Vt = U * jnp.linalg.det(U), Vt * jnp.linalg.det(Vt)
    W = jnp.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    M, b = [U @ W @ Vt, U @ W.T @ Vt], Vt[2]
    return jnp.stack([M[0], M[0], M[1], M[1]]), jnp.stack([b, -b, b, -b])


def _to_normalised(
    xy: Float[AnyArray, "n 2"], weights: Float[AnyArray, " n"]
) -> Float[Array, "3 3"]:
    """T with T·(x, y, −1) = (x', y', −1), of mean 0 and mean square 1 a coordinate."""
    (x, y), size = normalisation(xy, weights)
    nil, one = jnp.zeros_like(x), jnp.ones_like(x)
    return jnp.array([[one / size, nil, x / size], [nil, one / size, y / size], [nil, nil, one]])


def _coplanarity(
    a1: Float[AnyArray, "n 3"], a2: Float[AnyArray, "n 3"], weights: Float[AnyArray, " n"]
) -> Float[Array, "n 9"]:
    """√p times the coefficients of a₂ᵀ·E·a₁ = 0, the elements of E row by row."""
    return jnp.sqrt(weights)[:, None] * (a2[:, :, None] * a1[:, None, :]).reshape(-1, 9)


def _nearest_essential(E: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The nearest matrix with singular values (1, 1, 0)."""
    U, _, Vt = jnp.linalg.svd(E)
    return U[:, :2] @ Vt[:2]


def _cubic_equations(space: Float[Array, "4 3 3"]) -> Float[Array, "10 20"]:
    """Coefficients [10, 20] of 2·E·Eᵀ·E − tr(E·Eᵀ)·E and det E, `_CUBIC` and `_BASIS`."""
    square = jnp.einsum("aij,bkj->ikab", space, space)
    trace = jnp.einsum("iiab->ab", square)
    nine_equations = 2 * jnp.einsum("ikab,ckj->ijabc", square, space)
    nine_equations = (nine_equations - jnp.einsum("ab,cij->ijabc", trace, space)).reshape(9, 64)
    determinant = jnp.einsum("aj,bk,cl,jkl->abc", *space.swapaxes(0, 1), _PERMUTATION)
    return jnp.concatenate([nine_equations, determinant.reshape(1, 64)]) @ jnp.asarray(_COLLECT)


def _collect() -> Float[np.ndarray, "64 20"]:
    """Sums the products of three of (x, y, z, 1) that are the same monomial [64, 20]."""
    monomials = _CUBIC + _BASIS
    selection = np.zeros((64, 20))
    for row, factors in enumerate(product(range(4), repeat=3)):
        powers = factors.count(0), factors.count(1), factors.count(2)
        selection[row, monomials.index(powers)] = 1
    return selection


def _times_x() -> tuple[Float[np.ndarray, "10 10"], Float[np.ndarray, "10 10"]]:
    """Where x times the basis is found: among the cubic monomials, or in the basis again."""
    cubic, basis = np.zeros((10, 10)), np.zeros((10, 10))
    for row, (i, j, k) in enumerate(_BASIS):
        product_powers = (i + 1, j, k)
        table, names = (cubic, _CUBIC) if sum(product_powers) == 3 else (basis, _BASIS)
        table[row, names.index(product_powers)] = 1
    return cubic, basis


_COLLECT = _collect()
_TAKE_CUBIC, _TAKE_BASIS = _times_x()
# The permutation symbol of Levi-Civita: det E = Σ εⱼₖₗ·E₁ⱼ·E₂ₖ·E₃ₗ.
_PERMUTATION = np.cross(np.eye(3)[:, None], np.eye(3)[None])
