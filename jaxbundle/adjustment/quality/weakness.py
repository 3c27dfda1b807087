"""Poorly determined unknowns of a network, with the remedy.

The reference that a σ is compared with (`leastsquares/quality/weakness.py`): of a projection centre
the distance of the points in its image, of an angle a radian, of principal distance and point the
principal distance, of a point its distance. Distortion coefficients have none: a σ as large as the
coefficient only means that it is not needed.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbundle.adjustment.problem import NetworkProblem, coordinates
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.cameras import get_model
from jaxbundle.leastsquares.datum.by_table import directions_of_motions
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.quality.weakness import (
    NONLINEAR_RATIO,
    VAGUE_RATIO,
    Extents,
    Weak,
    find_weak,
    find_weak_unsolved,
)
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.kinds.base import ANGLES, LENGTHS, RATIOS
from jaxbundle.network.kinds.rolling_shutter import READ_OUT
from jaxbundle.report.head import ADVICE_FOR
from jaxbundle.types import AnyArray

FURTHER = (
    "Hold inseparable unknowns, or give them a prior σ: a lever arm and the shifts of strips, "
    "a tilt that its points do not show."
)


@dataclasses.dataclass(frozen=True)
class Weakness:
    """`unknowns`: names of image and camera unknowns with a σ above 1/`VAGUE_RATIO` of their
    reference, the weakest first; `worst`: the largest ratio. `points`: ids of points with a σ above
    1/`NONLINEAR_RATIO` of their distance; `judged`: the number of points. `georeference`: how
    uncertain the common position of all is, in words, if that alone makes image unknowns look
    weak."""

    unknowns: tuple[str, ...] = ()
    worst: float = 0.0
    points: tuple[str, ...] = ()
    judged: int = 0
    georeference: str = ""

    @property
    def few_points(self) -> bool:
        """Whether so few points are weak that the others are what the network is about."""
        # The summary of a network has the σ that 95 % of its points do not exceed: it does not
        # show a twentieth.
        return len(self.points) <= 0.05 * self.judged

    @property
    def notes(self) -> tuple[str, ...]:
        """What does not spoil the network: its georeference, a few weak points."""
        weak_points = self._of_points() if self.few_points else ()
        return (*filter(None, (self.georeference,)), *weak_points)

    @property
    def lines(self) -> tuple[str, ...]:
        """One line for the unknowns of images and cameras, one for points; each with a remedy."""
        return (*self._of_unknowns(), *(() if self.few_points else self._of_points()))

    def _of_unknowns(self) -> tuple[str, ...]:
        if self.unknowns:
            kinds = [kind for kind in ADVICE_FOR if any(f" of {kind} " in n for n in self.unknowns)]
            worst = f"is up to {self.worst:.2g} of" if self.worst < 1 else "is larger than"
            return (
                f"poorly determined: {list_some(self.unknowns, 8, str)}; a σ {worst} the "
                f"principal distance, the distance to the object, or a radian, and above "
                f"{1 / VAGUE_RATIO:g} of it the unknown is practically undetermined. "
                f"{ADVICE_FOR[kinds[0]] if kinds else FURTHER}",
            )
        return ()

    def _of_points(self) -> tuple[str, ...]:
        if self.points:
            is_majority = 2 * len(self.points) > self.judged
            where = (
                "images taken from one place, or nearly" if is_majority else "rays almost parallel"
            )
            number = count(self.judged, "point")
            return (
                f"poorly determined: X, Y, Z of {len(self.points)} of {number} "
                f"({list_some(self.points)}), with a σ above {1 / NONLINEAR_RATIO:g} of their "
                f"distance: {where}. Depth needs images from places farther apart.",
            )
        return ()


def weakness(inspection: Inspection, sigma0: float) -> Weakness:
    """The weak directions of a solution; none without a factor.

    The uncertainty of the common position, rotation and scale of all points, which loose control
    leaves, is none of the images': they are judged without it, and it is stated for itself."""
    problem, extents = inspection.problem, _extents(inspection)
    weak = find_weak(inspection.solution, extents, sigma0)
    # With a datum of inner constraints there is no georeference. Without one, an image σ is that of
    # its position in the block and that of the block: Q = Q_relative + G·Q_ττ·Gᵀ.
    if not any(" of image " in name for name in weak.names) or problem.counts.datum:
        return _in_words(problem, weak)
    georeference = find_georeference(inspection)
    # A linear similarity does not describe a block that may turn by more than a tenth of a radian.
    if georeference is None or sigma0 * georeference.rotation > 1 / NONLINEAR_RATIO:
        return _in_words(problem, weak)
    weak_without_frame = find_weak(
        inspection.solution, extents, sigma0, {"image": georeference.of_images}
    )
    georeference_words = (
        ""
        if weak_without_frame.names == weak.names
        else georeference.in_words(sigma0, problem.network.object_unit)
    )
    return dataclasses.replace(
        _in_words(problem, weak_without_frame), georeference=georeference_words
    )


@dataclasses.dataclass(frozen=True)
class Georeference:
    """Cofactors of the similarity of all points, estimated as that of the points: σ/σ0 of the
    `position` of their centroid in its least certain direction (object unit), of the `rotation`
    about its least certain axis (radians), of the `scale`; `of_images` [images, 6]: the cofactors
    of the unknowns of images that follow from it."""

    position: float
    rotation: float
    scale: float
    of_images: Float[np.ndarray, "images 6"]

    def in_words(self, sigma0: float, unit: str) -> str:
        """σ a posteriori of the common position."""
        return (
            f"georeference uncertain to {sigma0 * self.position:.2g} {unit}, "
            f"{np.degrees(sigma0 * self.rotation):.2g}° and {100 * sigma0 * self.scale:.2g} % of "
            "scale (σ of the whole block, from its control or camera positions); relative to each "
            "other images and points are determined"
        )


def find_georeference(inspection: Inspection) -> Georeference | None:
    """The uncertainty of the similarity of all points: τ = (GᵀG)⁻¹Gᵀ·δX of the Helmert matrix G, so
    that Q_ττ is propagated. None for points at any distance, and for fewer than three."""
    problem, values = inspection.problem, inspection.adjusted
    tables = inspection.solution.values
    moves = directions_of_motions(
        problem.declared, {name: tables[name] for name in ("image", "point")}
    )
    X, n = np.asarray(coordinates(values)), len(problem.network.points)
    rows = np.flatnonzero(np.isfinite(X[:n]).all(1) & ~problem.at_any_distance)
    of_points = np.asarray(moves["point"])[rows]
    if of_points.shape[1:2] != (3,) or len(rows) < 3:
        return None
    inverse = np.linalg.pinv(of_points.reshape(-1, of_points.shape[2]))
    estimate = eqx.Partial(_similarity_of, jnp.asarray(inverse), jnp.asarray(rows))
    Q = inspection.propagate(estimate)
    mean_of_points = of_points.mean(0)
    largest = lambda C: float(np.sqrt(max(np.linalg.eigvalsh(C)[-1], 0.0)))
    G = np.asarray(moves["image"])[: len(problem.network.images)]
    return Georeference(
        largest(mean_of_points @ Q @ mean_of_points.T),
        largest(Q[3:6, 3:6]),
        largest(Q[6:, 6:]),
        np.einsum("iaj,jk,iak->ia", G, Q, G),
    )


def _similarity_of(
    inverse: Float[AnyArray, "7 3*k"], rows: Int[AnyArray, " k"], values: Values
) -> Float[Array, "7"]:
    """τ of the coordinates of points, to first order."""
    return jnp.asarray(inverse @ coordinates(values)[rows].ravel())


def weakness_of_unsolved(problem: NetworkProblem, values: Values) -> Weakness:
    """The weak directions where an adjustment ended without a solution, by a priori σ."""
    inspection = Inspection(problem, values)
    return _in_words(problem, find_weak_unsolved(inspection.solution, _extents(inspection)))


def _in_words(problem: NetworkProblem, weak: Weak) -> Weakness:
    ids = problem.network.points.id
    return Weakness(weak.names, weak.worst, tuple(ids[p] for p in weak.rows), weak.judged)


def _extents(inspection: Inspection) -> Extents:
    """1/e of every unknown (`leastsquares.quality.weakness`), 0 for those that are not judged."""
    problem, values = inspection.problem, inspection.adjusted
    of_image, of_point = _ray_lengths(inspection)
    pose = np.where(of_image > 0, of_image, 1.0)[:, None]
    extents = {"image": np.concatenate([np.repeat(1 / pose, 3, 1), np.ones((len(pose), 3))], 1)}
    for table in problem.cameras:
        model = get_model(table.model)
        moving = problem.table(table.name).vector.moving
        columns = [model.parameters.index(name) for name in model.principal_distance]
        judged = np.array([model.parameters[j] in model.core for j in moving], bool)
        shortest = np.abs(np.asarray(values[table.name])[:, columns]).min(1)
        shortest = np.maximum(shortest, np.finfo(float).tiny)
        extents[table.name] = judged / shortest[:, None]
    mean = float(of_image[of_image > 0].mean()) if (of_image > 0).any() else 1.0
    for name in problem.further_tables:
        declared_table = problem.table(name)
        judged = [(p in LENGTHS) / mean + (p in ANGLES | RATIOS) for p in declared_table.parameters]
        if any(judged):
            extents[name] = np.tile(judged, (declared_table.rows, 1))
        if name == READ_OUT:
            extents[name] = 1 / np.maximum(np.abs(declared_table.value), np.finfo(float).tiny)
    return extents | {"point": of_point * ~problem.at_any_distance}


def _ray_lengths(
    inspection: Inspection,
) -> tuple[Float[np.ndarray, " images"], Float[np.ndarray, " points"]]:
    """Mean length of the rays of every image and of every point; 0 without rays."""
    problem, values = inspection.problem, inspection.adjusted
    rays = np.flatnonzero(problem.used)
    image, point = problem.image[rays], problem.point[rays]
    X0, X = np.asarray(values["image"].position), np.asarray(coordinates(values))
    ray = X[point] - X0[image]
    length = np.linalg.norm(ray, axis=1)

    def mean(index: Int[np.ndarray, " rays"], number: int) -> Float[np.ndarray, " n"]:
        total, rays = np.bincount(index, length, number), np.bincount(index, minlength=number)
        return total / np.maximum(rays, 1)

    return mean(image, len(X0)), mean(point, len(X))
