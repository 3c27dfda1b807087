"""What observations determine in name only: the weakest directions, in the words of the unknowns.

The σ of an unknown says little by itself; compared with the extent e of what it measures it does: a
projection centre with the distance of the points in its image, an angle with a radian, principal
distance and point with the principal distance. With E = diag(e), the datum S and Q = N⁻¹, the
largest eigenvalues μ of

    A = E⁻¹·S·Q·Sᵀ·E⁻¹

belong to the weakest directions, and no σ is larger than σ0·√μ₁ extents. They are found by subspace
iteration (Golub and Van Loan, Matrix Computations, section 8.2.4): a few solutions with the factor
that exists, never an inverse; where the cofactors are at hand, the σ are read from these.
Coefficients of distortion have no extent, and a σ as large as themselves says only that they are
not needed. Points count by the σ they have where the images are given, which the elimination leaves
behind.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.batch_weakness import VAGUE
from jaxbundle.adjustment.datum import s_transform, s_transform_transposed
from jaxbundle.adjustment.jacobian import compiled_jacobian
from jaxbundle.adjustment.normal import diagonal, normal_from_jacobian
from jaxbundle.adjustment.problem import Problem
from jaxbundle.adjustment.schur import (
    Factor,
    factorise,
    reduced_free,
    reduced_vector,
    solve,
    split_reduced,
)
from jaxbundle.adjustment.unknowns import reduced_names
from jaxbundle.cameras import get_model
from jaxbundle.network.arrays import Tangent, Values
from jaxbundle.network.columns import count, some
from jaxbundle.network.reduction import FACTORS, SMALL
from jaxbundle.network.structure import Structure
from jaxbundle.statistics.inspection import Inspection

FAR = 10.0
"""A point whose σ is above a tenth of its distance has no depth: errors of the second order in it
are as large as those that least squares propagate."""
DIRECTIONS, ROUNDS = 6, 8
"""Of the subspace iteration: directions looked for, products with A."""
LIFT = 1e-10
"""Added to the normal equations that cannot be solved, in parts of their diagonal."""
ADVICE_FOR = {
    "camera": "Free fewer camera parameters, or give them a prior σ; c needs depth or convergent "
    "images, x0 and y0 need images turned about their axis.",
    "image": "An image needs three or more well spread points whose coordinates are determined.",
    "point": "A point needs rays from two directions or more.",
}


@dataclasses.dataclass(frozen=True)
class Weakness:
    """`unknowns`: names of those of images and cameras with a σ above 1/`VAGUE` of their extent,
    the weakest first; `worst`: the largest of these ratios. `points`: ids of those with a σ above
    1/`FAR` of their distance; `of`: how many there are."""

    unknowns: tuple[str, ...] = ()
    worst: float = 0.0
    points: tuple[str, ...] = ()
    of: int = 0

    @property
    def lines(self) -> tuple[str, ...]:
        """One line for the unknowns of images and cameras, one for points; each with a remedy."""
        found = []
        if self.unknowns:
            kinds = [kind for kind in ADVICE_FOR if any(f" of {kind} " in n for n in self.unknowns)]
            worst = f"is up to {self.worst:.2g} of" if self.worst < 1 else "is larger than"
            found.append(
                f"poorly determined: {some(self.unknowns, 8, str)}; a σ {worst} the "
                f"principal distance, the distance to the object, or a radian, and above "
                f"{1 / VAGUE:g} of it the solution is one in name only. {ADVICE_FOR[kinds[0]]}"
            )
        if self.points:
            most = 2 * len(self.points) > self.of
            where = "the images stand at one place, or nearly" if most else "rays almost parallel"
            found.append(
                f"poorly determined: X, Y, Z of {len(self.points)} of {count(self.of, 'point')} "
                f"({some(self.points)}), with a σ above {1 / FAR:g} of their distance: {where}. "
                "Depth needs images from places farther apart."
            )
        return tuple(found)


def weakness(inspection: Inspection, sigma0: float) -> Weakness:
    """The weak directions of a solution; none are looked for where there is no factor."""
    if inspection.structure.reduction not in FACTORS:
        return Weakness()
    at_hand = "cofactors" in vars(inspection) or inspection.structure.reduced_size < SMALL
    return _weakness(inspection, inspection.factor, sigma0, at_hand)


def weakness_of_unsolved(problem: Problem, values: Values) -> Weakness:
    """The weak directions where an adjustment ended without a solution, by σ a priori: the normal
    equations are lifted by `LIFT`, so that there is a factor."""
    if problem.structure.reduction not in FACTORS:
        return Weakness()
    there = Inspection(problem, values)
    factor = _lifted_factor(compiled_jacobian(there.structure, there.values, there.data))
    return _weakness(there, dataclasses.replace(factor, structure=there.structure), 1.0)


@eqx.filter_jit
def _lifted_factor(jac) -> Factor:
    normal = normal_from_jacobian(jac)
    more = jax.tree.map(lambda d: LIFT * d, diagonal(normal))
    return dataclasses.replace(factorise(jac.structure, normal, more), structure=None)


def _weakness(inspection: Inspection, factor: Factor, sigma0: float, at_hand=False) -> Weakness:
    problem, sigma0 = inspection.problem, sigma0 if np.isfinite(sigma0) else 1.0
    of_image, of_point, used = _ray_lengths(inspection)
    of_one = np.asarray(factor.point)
    free = (np.asarray(inspection.structure.eliminated)[:, 0] > 0) & used
    if not (np.isfinite(np.asarray(factor.reduced.pivots)).all() and np.isfinite(of_one).all()):
        return Weakness()
    ratio = np.where(free, np.sqrt((of_one**2).sum((1, 2))) * sigma0 / of_point, 0.0)
    far = np.argsort(-ratio, kind="stable")[: (FAR * ratio > 1).sum()]
    per_extent = _per_extent(inspection, of_image, of_point)
    if at_hand:
        sigma = sigma0 * _all_sigma(inspection, per_extent)
    else:
        sigma = sigma0 * _sigma_of_weakest(inspection, factor, per_extent)
    order = np.argsort(-sigma, kind="stable")[: (VAGUE * sigma > 1).sum()]
    names = reduced_names(problem) if len(order) else []
    return Weakness(
        tuple(str(names[k]) for k in order), float(sigma.max(initial=0.0)),
        tuple(problem.network.points.id[p] for p in far), int(free.sum()),
    )  # fmt: skip


def _ray_lengths(inspection: Inspection):
    """Mean length of the rays of every image and of every point, 1 where there is none, and which
    points have any."""
    s, values = inspection.structure, inspection.values
    rays = np.flatnonzero((np.asarray(inspection.data.image_weight) > 0).any(1))
    image, point = np.asarray(s.image)[rays], np.asarray(s.point)[rays]
    ray = np.asarray(values.point)[point] - np.asarray(values.position)[image]
    length = np.linalg.norm(ray, axis=1)

    def mean(of, number):
        total, rays = np.bincount(of, length, number), np.bincount(of, minlength=number)
        return np.where(total > 0, total, 1.0) / np.maximum(rays, 1), rays > 0

    return mean(image, s.images)[0], *mean(point, s.points)


def _per_extent(inspection: Inspection, of_image, of_point) -> Float[np.ndarray, " reduced"]:
    """1/e of the columns of the reduced system; 0 for what is held or has no extent."""
    s, problem = inspection.structure, inspection.problem
    pose = np.concatenate([np.repeat(1 / of_image[:, None], 3, 1), np.ones((s.images, 3))], 1)
    interior = np.zeros((s.cameras, s.interior_width))
    for c, camera in enumerate(problem.network.cameras):
        model = get_model(camera.model)
        columns = np.asarray(s.camera_columns)[c]
        of_extent = [model.parameters.index(name) for name in model.core]
        at = [model.parameters.index(name) for name in model.principal_distance]
        shortest = np.abs(np.asarray(inspection.values.camera)[c, at]).min()
        interior[c] = np.isin(columns, of_extent) / max(shortest, np.finfo(float).tiny)
    if s.own_camera:
        pose = np.concatenate([pose, interior[np.asarray(s.camera_of_image)]], 1)
    per = Tangent(pose, interior if s.camera_width else interior[:, :0],
                  np.repeat(1 / of_point[:, None], 3, 1))  # fmt: skip
    return np.asarray(reduced_vector(s, per)) * np.asarray(reduced_free(s))


def _sigma_of_weakest(inspection: Inspection, factor: Factor, per_extent):
    """σ/e (a priori) of the reduced system's columns, as far as the weakest directions give it, in
    the order of the problem's own arrays."""
    directions = np.random.default_rng(0).standard_normal((DIRECTIONS, len(per_extent)))
    directions *= per_extent > 0
    for _ in range(ROUNDS):
        directions = np.linalg.qr(directions.T)[0].T
        previous = directions
        directions = np.asarray(_products(inspection.structure, inspection.values, factor,
                                          per_extent, directions))  # fmt: skip
    mu, turn = np.linalg.eigh(previous @ directions.T)
    return _of_the_problem(inspection, np.maximum(mu, 0) @ (turn.T @ previous) ** 2)


def _all_sigma(inspection: Inspection, per_extent):
    """σ/e (a priori) of the reduced system's columns from the cofactors that exist."""
    Q = inspection.cofactors
    pick = lambda blocks: np.diagonal(np.asarray(blocks), axis1=1, axis2=2)
    of_all = Tangent(pick(Q.image), pick(Q.camera), pick(Q.point))
    square = np.asarray(reduced_vector(inspection.structure, of_all)) * per_extent**2
    return _of_the_problem(inspection, square)


def _of_the_problem(inspection: Inspection, square):
    """Square roots, in the order of the problem's own arrays."""
    s, given = inspection.structure, inspection.problem.structure
    image, camera, kept = split_reduced(s, square)
    parts = image[: given.images], camera[: given.cameras], kept[: len(given.kept)]
    return np.sqrt(np.concatenate([np.ravel(part) for part in parts]))


@eqx.filter_jit
def _products(structure: Structure, values: Values, factor: Factor, per_extent, directions):
    """A times each of the directions [m, reduced]."""

    def product(direction):
        image, camera, kept = split_reduced(structure, direction * per_extent)
        point = jnp.zeros((structure.points, 3)).at[structure.kept].set(kept)
        right = s_transform_transposed(structure, values, Tangent(image, camera, point))
        change = s_transform(structure, values, solve(factor, right))
        return reduced_vector(structure, change) * per_extent

    return jax.vmap(product)(directions)
