"""Relative orientation of two images by coplanarity, without start values.

The first camera is the frame: M₁ = I, X0₁ = 0; the second has the rotation M from the first and its
centre at the base b, |b| = 1. Essential matrices in closed form (`essential`) give candidates; the
one with the points in front of both cameras and the least vᵀPv is taken, and refined on the
five-parameter manifold with the misclosures of coplanarity as lengths in the image,

    v = a₂ᵀ·E·a₁/√(|(E·a₁)ₓᵧ|² + |(Eᵀ·a₂)ₓᵧ|²),        E = M·[b]×,        Σ p·v² = min

to first order the least corrections of all four coordinates (Sampson, 1982).

Two simpler explanations are tried. If a rotation alone explains the rays with a variance less than
`MAX_VARIANCE_RATIO` times that of the relative orientation (and of a homography), there is no
significant base; if a homography does, the object is a plane, on which eight points do not suffice.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.lax import stop_gradient
from jaxtyping import Bool, Float, Int, PyTree

from jaxbundle.arguments import without_masks
from jaxbundle.geometry import matrix_from_quaternion, matrix_from_rotation_vector
from jaxbundle.geometry.vectors import dot, rotate, rotate_back, rows_of_matrix, unpack
from jaxbundle.leastsquares.iterations.small import finish, minimise
from jaxbundle.orientation.absolute import rotation_between
from jaxbundle.orientation.essential import eight_points, five_solutions, orientations
from jaxbundle.orientation.homography import apply_homography, homography
from jaxbundle.orientation.linear import ones_unless
from jaxbundle.orientation.pose import CameraPose, image_of, ray_of
from jaxbundle.orientation.status import Status, first_of
from jaxbundle.types import AnyArray, Scalar

# Ratio of variances below which the simpler explanation counts: about the 99 % quantile of F for a
# dozen points, F(0.99; 21, 7) = 6.1 (a rotation has 2·12 − 3 = 21 redundant coordinates, a relative
# orientation 12 − 5 = 7). One value for all numbers of points: with more, a rotation that explains
# the images nearly as well is no base to work with either.
MAX_VARIANCE_RATIO = 6.0
# Variance of image coordinates (c = 1) that is rounding: (1e-10)², a million roundings of a
# coordinate, a thousandth of the best measurements.
ROUNDING_VARIANCE = 1e-20
# (M, b) of the second camera relative to the first.
Motion = tuple[Float[AnyArray, "3 3"], Float[AnyArray, "3"]]


class RelativeOrientation(eqx.Module):
    """M from the first camera to the second, base b in the frame of the first, vᵀPv.

    `cofactor`: of three turns δθ in radians in the frame of the second camera, and of the two
    components of b, radians, across it. `in_front`: weight of the points in front of both cameras,
    in parts of the whole. `flat`: a homography explains the images as well: of a plane there may be
    a second solution, see `planar_orientations`.
    """

    M: Float[AnyArray, "3 3"]
    b: Float[AnyArray, "3"]
    vtpv: Float[AnyArray, ""]
    cofactor: Float[AnyArray, "5 5"]
    in_front: Float[AnyArray, ""]
    flat: Bool[AnyArray, ""]
    status: Int[AnyArray, ""]


@without_masks
def relative_orientation(
    xy1: Float[AnyArray, "n 2"],
    xy2: Float[AnyArray, "n 2"],
    weights: Float[AnyArray, " n"] | None = None,
    method: str = "five",
) -> RelativeOrientation:
    """The relative orientation of two images of n points, differentiable in all arguments.

    **Arguments:** ideal image coordinates divided by the principal distance, y up; weights
    p = 1/σ², equal for the four coordinates; 0: the point is absent. `method`: `"five"` (n ≥ 6, any
    object; the solution of eight points is one more candidate) or `"eight"` (n ≥ 8, not a plane).

    **Returns:** `status`: `NO_BASE`, `COPLANAR_POINTS` (method `"eight"`), `NO_SOLUTION`,
    `UNDETERMINED`, `BEHIND_THE_CAMERA` (most points are).

    **Raises:** `ValueError` for another method.
    """
    p = ones_unless(weights, xy1)
    if method not in ("five", "eight"):
        raise ValueError(f'The method must be "five" or "eight", but is {method!r}.')
    points = stop_gradient((xy1, xy2, p))
    E = eight_points(*points)[0][None]
    if method == "five":
        points = _wait_for(E, points)
        # With noise, a solution that is not quite real is a good start.
        E = jnp.concatenate([E, five_solutions(*points)[0]])
    M, b = (a.reshape(-1, *a.shape[2:]) for a in jax.vmap(orientations)(E))
    data = (xy1, xy2, jnp.sqrt(p))
    best, score = _refine_best(M, b, stop_gradient(data), p)
    fit = finish(coplanarity_misclosures, retract, best, data, 5)
    M, b = fit.estimate
    front = _in_front((M, b), xy1, xy2, p)
    vtpv = stop_gradient(fit.vtpv)
    no_base, flat = _find_simpler(_wait_for(vtpv, points), vtpv)
    status = first_of(
        (no_base, Status.NO_BASE),
        (flat if method == "eight" else jnp.asarray(False), Status.COPLANAR_POINTS),
        (~jnp.isfinite(score), Status.NO_SOLUTION),
        (~fit.determined, Status.UNDETERMINED),
        (front < 0.5, Status.BEHIND_THE_CAMERA),
    )
    return RelativeOrientation(M, b, fit.vtpv, fit.cofactor, front, flat & ~no_base, status)


# This function and `retract` are traced once for all programs that contain them several times.
@jax.jit
def sampson_distance(
    M: Float[AnyArray, "3 3"],
    b: Float[AnyArray, "3"],
    xy1: Float[AnyArray, "2"],
    xy2: Float[AnyArray, "2"],
) -> Float[Array, ""]:
    """Misclosure of coplanarity of one point as a length in the image, c = 1, with a sign."""
    a1, a2 = _rays(xy1, xy2)
    E = rows_of_matrix(jnp.cross(M, b))  # M·[b]×
    line2, line1 = rotate(E, a1), rotate_back(E, a2)
    length = line2[0] ** 2 + line2[1] ** 2 + line1[0] ** 2 + line1[1] ** 2
    return jnp.divide(dot(a2, line2), jnp.sqrt(jnp.where(length > 0, length, 1)))


def distances_along_rays(
    M: Float[AnyArray, "3 3"],
    b: Float[AnyArray, "3"],
    xy1: Float[AnyArray, "2"],
    xy2: Float[AnyArray, "2"],
) -> Float[Array, "2"]:
    """(s₁, s₂) of the nearest points s₁·a₁ and b + s₂·Mᵀ·a₂ of two rays; positive: in front."""
    a1, a2 = _rays(xy1, xy2)
    a2, base = rotate_back(rows_of_matrix(M), a2), unpack(b)
    aa, cc, ac = dot(a1, a1), dot(a2, a2), dot(a1, a2)
    ab, cb = dot(base, a1), dot(base, a2)
    determinant = aa * cc - ac * ac
    s = jnp.stack([cc * ab - ac * cb, ac * ab - aa * cb])
    return s / jnp.where(determinant > 0, determinant, 1)


def _rays(
    xy1: Float[AnyArray, "2"], xy2: Float[AnyArray, "2"]
) -> tuple[tuple[Scalar, Scalar, float], tuple[Scalar, Scalar, float]]:
    """The rays of one point in two images, as scalars: over 1500 models of 64 points a twelfth of
    the time of products of small matrices."""
    return (*xy1, -1.0), (*xy2, -1.0)


def _refine_best(
    M: Float[Array, "candidates 3 3"],
    b: Float[Array, "candidates 3"],
    data: tuple[AnyArray, AnyArray, AnyArray],
    p: Float[AnyArray, " n"],
) -> tuple[Motion, Float[Array, ""]]:
    """The best few candidates refined; of these the best, and its score."""
    xy1, xy2, _ = data

    def score(pair: Motion, square: Float[Array, ""]) -> Float[Array, ""]:
        # A fraction of points behind a camera counts as up to a hundred times the variance: of the
        # four (M, b) of one E, which fit equally, that with the points in front wins, but a few
        # gross errors behind a camera do not outweigh a far better fit.
        behind = 1 - _in_front(pair, xy1, xy2, p)
        value = (square / jnp.sum(p) + ROUNDING_VARIANCE) * (1 + 100 * behind)
        return jnp.where(jnp.isfinite(value), value, jnp.inf)

    initial_score = lambda M, b: score((M, b), jnp.sum(coplanarity_misclosures((M, b), *data) ** 2))
    # Of up to 44 candidates. Of 400 pairs of images with eight points and noise of 1e-3, 3 % ended
    # above the best vᵀPv by more than 1 % with two, 2 % with four, 0.7 % with eight, which cost
    # twice the time; of a nearly flat object 6, 1.5 and 0.5 %.
    _, best = jax.lax.top_k(-jax.vmap(initial_score)(M, b), 4)
    refine = lambda M, b: minimise(coplanarity_misclosures, retract, (M, b), data, 5)
    refined, squares = jax.vmap(refine)(M[best], b[best])
    scores = jax.vmap(score)(refined, squares)
    k = jnp.argmin(scores)
    return jax.tree.map(lambda a: a[k], refined), scores[k]


def _wait_for(result: Float[AnyArray, "..."], arrays: PyTree) -> PyTree:
    """The arrays, which wait for `result`: adds zero. Decompositions that run side by side can hang
    jaxlib 0.10 on two cores; a barrier does not order them."""
    zero = jnp.where(jnp.sum(result) > 1e300, 1.0, 0.0)
    return jax.tree.map(lambda a: a + zero, arrays)


def coplanarity_misclosures(
    pair: Motion,
    xy1: Float[AnyArray, "n 2"],
    xy2: Float[AnyArray, "n 2"],
    sqrt_weight: Float[AnyArray, " n"],
) -> Float[AnyArray, " n"]:
    """Weighted Sampson distances of the points of M and b."""
    M, b = pair
    return sqrt_weight * jax.vmap(sampson_distance, (None, None, 0, 0))(M, b, xy1, xy2)


@jax.jit
def retract(pair: Motion, delta: Float[AnyArray, "5"]) -> Motion:
    """A pair (M, b) turned by δ[:3] in the frame of the second camera, its base moved by δ[3:]."""
    M, b = pair
    M = matrix_from_rotation_vector(delta[:3]) @ M
    b = b + delta[3:] @ _perpendiculars(b)
    return M, b / jnp.linalg.norm(b)


def _perpendiculars(b: Float[AnyArray, "3"]) -> Float[Array, "2 3"]:
    """Two unit vectors perpendicular to b, of length 1, and to one another."""
    axis = jnp.eye(3, dtype=b.dtype)[jnp.argmin(jnp.abs(stop_gradient(b)))]
    normal = jnp.cross(b, axis)
    normal = normal / jnp.linalg.norm(normal)
    return jnp.stack([normal, jnp.cross(b, normal)])


def _in_front(
    pair: Motion,
    xy1: Float[AnyArray, "n 2"],
    xy2: Float[AnyArray, "n 2"],
    p: Float[AnyArray, " n"],
) -> Float[Array, ""]:
    """Weight of the points in front of both cameras, in parts of the whole."""
    M, b = pair
    s = jax.vmap(distances_along_rays, (None, None, 0, 0))(M, b, xy1, xy2)
    return jnp.sum(jnp.where(jnp.all(s > 0, 1), p, 0)) / jnp.sum(p)


def _find_simpler(
    points: tuple[AnyArray, AnyArray, AnyArray], vtpv: Float[Array, ""]
) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Whether a rotation, and whether a homography, explain the second image as well."""
    xy1, xy2, p = points
    n, average = jnp.sum(p > 0), jnp.sum(p) / jnp.sum(p > 0)
    redundancy = n - 5
    variance = vtpv / jnp.where(redundancy > 0, redundancy, 1)
    unit = lambda a: a / jnp.linalg.norm(a)
    rays1, rays2 = (jax.vmap(lambda xy: unit(ray_of(xy)))(xy) for xy in (xy1, xy2))
    rotation = CameraPose(jnp.zeros(3), matrix_from_quaternion(rotation_between(rays1, rays2, p)))
    by_rotation = jax.vmap(image_of, (None, 0))(rotation, rays1)
    H, _ = homography(*_wait_for(by_rotation, (xy1, xy2, p)))
    by_plane = jax.vmap(apply_homography, (None, 0))(H, xy1)

    def variance_of(computed: Float[AnyArray, "n 2"], unknowns: int) -> Float[Array, ""]:
        """The differences contain the errors of both images: twice the variance."""
        redundancy = 2 * n - unknowns
        sum_of_squares = jnp.sum(p[:, None] * (computed - xy2) ** 2)
        variance = sum_of_squares / (2 * jnp.where(redundancy > 0, redundancy, 1))
        return jnp.where(redundancy > 0, variance, jnp.inf)

    rotation, plane = variance_of(by_rotation, 3), variance_of(by_plane, 8)
    limit = lambda reference: MAX_VARIANCE_RATIO * reference + ROUNDING_VARIANCE * average
    return rotation < limit(jnp.minimum(variance, plane)), plane < limit(variance)
