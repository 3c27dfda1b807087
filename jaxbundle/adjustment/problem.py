"""A network prepared for the engine: plan, data and datum, with its names, units and origin."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Bool, Float, Int

from jaxbundle.arguments import one_of, show
from jaxbundle.choices import REDUCTIONS
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.float64 import require_x64
from jaxbundle.leastsquares import problem as engine
from jaxbundle.leastsquares.any_distance import derivative
from jaxbundle.leastsquares.datum.defect import MAX_OPEN_EFFECT, CannotHold
from jaxbundle.leastsquares.declarations import ObservationSet, Table
from jaxbundle.leastsquares.indexing.rows import Data, Values
from jaxbundle.network.camera_tables import CameraTable
from jaxbundle.network.datum_words import open_directions_in_words
from jaxbundle.network.declare import DeclaredNetwork, declare, order_cameras
from jaxbundle.network.kinds.base import included_tables
from jaxbundle.network.kinds.image_points import image_coordinates
from jaxbundle.network.retraction import TurnAboutSeen, control_is_weak
from jaxbundle.network.rules import AXES
from jaxbundle.network.subsets import split_check_points
from jaxbundle.network.tables import Network, Points, are_among, require_network
from jaxbundle.types import AnyArray, not_none

NEGLIGIBLE_MOTION = 1e-6
"""A datum direction contains a motion whose displacement of the points is at least this part of the
largest one: that of an open motion is of its size, that of a determined one rounding."""


@dataclasses.dataclass(frozen=True)
class Counts:
    """Rows and columns of the adjustment of a network; redundancy = rows + datum conditions −
    unknowns. `observations`: image coordinates."""

    observations: int
    control: int
    exterior: int
    interior: int
    distances: int
    other: int
    datum: int
    unknowns: int

    @property
    def pseudo_observations(self) -> int:
        return self.control + self.exterior + self.interior + self.distances + self.other

    @property
    def redundancy(self) -> int:
        return self.observations + self.pseudo_observations + self.datum - self.unknowns


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class NetworkProblem(engine.Problem):
    """A problem of the engine that knows its network.

    `network`: as adjusted (cameras in the order of the arrays); the others are those of
    `network.declare.DeclaredNetwork`. Names of tables and sets of observations: see there.
    """

    network: Network
    cameras: tuple[CameraTable, ...]
    image_rows: Mapping[str, Int[np.ndarray, " rows"]]
    further_sets: tuple[str, ...]
    further_tables: tuple[str, ...]
    origin: Float[np.ndarray, "3"]
    lengths: Float[np.ndarray, " points"] | None

    @property
    def image(self) -> Int[np.ndarray, " rays"]:
        """The image of every image point, in the order of the network."""
        return self.network.observations.image

    @property
    def point(self) -> Int[np.ndarray, " rays"]:
        """The object point of every image point."""
        return self.network.observations.point

    @property
    def camera(self) -> Int[np.ndarray, " rays"]:
        """The camera of every image point."""
        return self.network.images.camera[self.image]

    def image_points(self, by_set: Mapping[str, Any]) -> Any:
        """A quantity of the image points [rays, …] in the order of the network, from those of the
        sets: such as `data.weight`, or residuals."""
        return self._in_order({name: by_set[name] for name in self.image_rows})

    def image_coordinates(self, data: Data | None = None) -> Any:
        """Measured x and y [rays, 2] in the order of the network; by default those of the problem,
        on the host."""
        measured = (self.data if data is None else data).measured
        xy = self._in_order({name: image_coordinates(measured[name]) for name in self.image_rows})
        return np.asarray(xy) if data is None else xy

    def with_image_coordinates(self, data: Data, xy: AnyArray) -> Data:
        """Data with other x and y [rays, 2]."""
        measured = dict(data.measured)
        for name, rows in self.image_rows.items():
            planned = measured[name]
            measured[name] = (xy[rows], planned[1]) if isinstance(planned, tuple) else xy[rows]
        return dataclasses.replace(data, measured=measured)

    def with_image_weights(self, data: Data, weight: AnyArray) -> Data:
        """Data with other weights 1/σ [rays, 2] of image coordinates."""
        changed = {name: weight[rows] for name, rows in self.image_rows.items()}
        return dataclasses.replace(data, weight={**data.weight, **changed})

    def _in_order(self, parts: Mapping[str, Any]) -> Any:
        # Cameras of several models are several sets for the engine, which compiles one formula a
        # set; the network has all its image points in one table.
        if len(parts) == 1:
            return next(iter(parts.values()))
        shape = np.shape(next(iter(parts.values()), np.zeros((0, 2))))[1:]
        if any(isinstance(part, Tracer) for part in parts.values()):
            all_rays = jnp.zeros((len(self.image), *shape))
            for name, part in parts.items():
                all_rays = all_rays.at[self.image_rows[name]].set(part)
            return all_rays
        all_rays = np.zeros((len(self.image), *shape))
        for name, part in parts.items():
            all_rays[self.image_rows[name]] = np.asarray(part)
        return all_rays

    @property
    def image_weights(self) -> Float[np.ndarray, "rays 2"]:
        """1/σ of the image coordinates, the root of their weight p = 1/σ²; 0 for those that take no
        part."""
        return np.asarray(self.image_points(self.data.weight))

    @property
    def used_coordinates(self) -> Bool[np.ndarray, "rays 2"]:
        """Which image coordinates take part in the adjustment."""
        return self.image_weights > 0

    @property
    def used(self) -> Bool[np.ndarray, " rays"]:
        """Which image points take part in the adjustment."""
        return np.asarray(self.used_coordinates.any(1))

    def interior_orientation(self, values: Values) -> AnyArray:
        """The parameters of all cameras, in the order of those of their models, padded with 0."""
        if len(self.cameras) == 1:
            return values[self.cameras[0].name]
        width = max(len(table.parameters) for table in self.cameras)
        rows = [values[table.name] for table in self.cameras]
        module = jnp if any(isinstance(part, Tracer) for part in rows) else np
        wide = [module.pad(part, [(0, 0), (0, width - part.shape[1])]) for part in rows]
        places = np.argsort(np.concatenate([table.cameras for table in self.cameras]))
        return module.concatenate(wide)[places]

    def with_interior_orientation(self, values: Values, rows: AnyArray) -> Values:
        """Values with other parameters of all cameras, as `interior_orientation` gives them."""
        return values | {
            table.name: rows[table.cameras, : len(table.parameters)] for table in self.cameras
        }

    def table_of_camera(self, c: int) -> tuple[CameraTable, int]:
        """The table of a camera of the network, and its row there."""
        table = next(table for table in self.cameras if c in table.cameras)
        return table, int(np.flatnonzero(table.cameras == c)[0])

    def free_parameters(self, c: int) -> tuple[tuple[str, ...], Int[np.ndarray, " k"]]:
        """The parameters free in any camera of the table of a camera, and which of them are free in
        this camera."""
        table, row = self.table_of_camera(c)
        declared_table = self.table(table.name)
        return declared_table.parameters, np.flatnonzero(declared_table.free[row])

    @property
    def at_any_distance(self) -> Bool[np.ndarray, " points"]:
        """Which points are parametrised as directions and inverse distances."""
        if self.lengths is None:
            return np.zeros(len(self.network.points), bool)
        return self.lengths > 0

    @property
    def excluded(self) -> Bool[np.ndarray, " points"]:
        """Which points data snooping left with too few rays, or with rays that do not determine
        them."""
        # Snooping takes the weight of rays and holds the point: without rays, and held although it
        # is not given.
        rays = np.bincount(self.point[self.used], minlength=len(self.network.points))
        is_held = ~self.table("point").free.any(1)
        return ~self.network.points.has_role("fixed") & is_held & (rays == 0)

    def cofactors_of_coordinates(
        self, points: Float[AnyArray, "points width"], Q: Float[AnyArray, "points 3 3"]
    ) -> Float[AnyArray, "points 3 3"]:
        """The cofactors of X, Y, Z of all points, from those of their directions of change."""
        if self.lengths is None:
            return Q
        A = jax.vmap(derivative)(jnp.asarray(points))
        return A @ Q @ A.transpose(0, 2, 1)

    @property
    def reduction(self) -> str:
        """Solver of the reduced system."""
        return not_none(self.plan.reduction)

    @property
    def rows_and_unknowns(self) -> Counts:
        """How many rows with weight of every kind, datum conditions and free unknowns there are."""
        number: dict[str, int] = dict.fromkeys(("image", *PSEUDO_OBSERVATIONS), 0)
        for name in set(self.data.weight) - set(self.further_sets):
            number[name.partition(",")[0]] += int((np.asarray(self.data.weight[name]) > 0).sum())
        return Counts(
            observations=number["image"],
            control=number["control"],
            exterior=number["exterior"],
            interior=number["interior"],
            distances=number["distance"],
            other=self.counts.observations - sum(number.values()),
            datum=self.counts.datum,
            unknowns=self.counts.unknowns,
        )


# The sets of a network beside image points; with cameras of several models "interior, MODEL".
PSEUDO_OBSERVATIONS = ("control", "exterior", "interior", "distance")


def coordinates(values: Values) -> Float[AnyArray, "points 3"]:
    """X, Y, Z of all points, relative to the origin."""
    return values["point"][:, :3]


def with_coordinates(
    rows: Float[AnyArray, "points width"], X: Float[AnyArray, "points 3"]
) -> Float[AnyArray, "points width"]:
    """Rows of the table of points with other coordinates."""
    return jax.device_put(np.concatenate([np.asarray(X), np.asarray(rows)[:, 3:]], 1))


def make_problem(
    network: Network,
    *,
    reduction: str | None = None,
    also: Sequence[Table | ObservationSet] = (),
    lengths: Float[np.ndarray, " points"] | None = None,
) -> NetworkProblem:
    """Plan, data and datum of a checked network (see `jaxbundle.network.check.check_network`).

    Check points and their rays are excluded.

    `reduction`: solver of the reduced system, "dense", "banded" or "iterative"; by default chosen
    by size and fill. `also`: observations of further kinds, and tables of their unknowns (see
    `jaxbundle.adjust`). `lengths`: the unit of distance of points at any distance, 0 for the others
    (`leastsquares.any_distance`); they are not datum points.

    **Raises:** `InputError` if the requested datum is impossible; `RuntimeError` without 64-bit
    floats.
    """
    require_x64()
    one_of("reduction", reduction, REDUCTIONS, allow_none=True)
    require_network(network)
    if not isinstance(also, Sequence):
        raise InputError(f"also must be a list of tables and observations, but is {show(also)}")
    network = order_cameras(split_check_points(network)[0])
    carries_datum, origin = _datum_points(network), None
    # Points at any distance are directions from the origin, which is then the mean of the
    # projection centres (in whole units, by which printed coordinates lose no digit); their
    # distance is uncertain by its own size, so that they would carry a datum of no precision.
    if lengths is not None:
        carries_datum, origin = (
            carries_datum & (lengths == 0),
            np.round(network.images.position.mean(0)),
        )
    # Points are eliminated: they are many, and two of them share no observation but those of
    # further kinds, which the planner keeps in the reduced system.
    declared = declare(network, origin, also, lengths)
    try:
        problem = engine.make_problem(
            declared.tables,
            declared.observations,
            "point",
            motions=declared.motions,
            datum=lambda gauge: _datum(network, gauge, declared.origin, carries_datum),
            reduction=reduction,
            retraction=TurnAboutSeen,
        )
    except CannotHold as error:
        raise InputError(
            f"the {int(carries_datum.sum())} datum points cannot fix the datum, of which "
            f"{error.defect} of 7 parameters are open: give at least three free points that "
            "are not collinear (datum_points), or omit the setting"
        ) from None
    if problem.information is not None and control_is_weak(
        network, problem.information, problem.counts.observations
    ):
        retraction = TurnAboutSeen(problem.declared, moves_as_one=True)
        problem = dataclasses.replace(problem, retraction=retraction)
    return _of_network(problem, network, declared)


def _of_network(
    problem: engine.Problem, network: Network, declared: DeclaredNetwork
) -> NetworkProblem:
    # A problem of the engine with further fields: whatever takes a problem takes this one.
    fields = {field.name: getattr(problem, field.name) for field in dataclasses.fields(problem)}
    return NetworkProblem(
        **fields,
        network=network,
        cameras=declared.cameras,
        image_rows=declared.image_rows,
        further_sets=declared.further_sets,
        further_tables=declared.further_tables,
        origin=declared.origin,
        lengths=declared.lengths,
    )


def _datum_points(network: Network) -> Bool[np.ndarray, " points"]:
    """Which points carry the datum if it is open."""
    points = network.points
    if network.datum_points:
        return are_among(points.id, network.datum_points)
    # All tie points: the trace of their covariance is then the smallest of all datums.
    # Control points are weighted by their σ and carry none, unless there is nothing else.
    carries_datum = points.has_role("tie")
    return carries_datum if carries_datum.any() else points.has_role("control")


def _overpowering_control(points: Points) -> str:
    """A sentence where the σ of one coordinate is so small that others count as none."""
    sigma = np.where(points.has_role("control")[:, None], points.sigma, np.inf)
    largest = sigma.max(initial=0.0, where=np.isfinite(sigma))
    if not largest * MAX_OPEN_EFFECT > sigma.min(initial=np.inf):
        return ""
    row, axis = np.unravel_index(sigma.argmin(), sigma.shape)
    return (
        f"{points.source(row)}: σ of {AXES[axis]} of control point {points.id[row]!r} is "
        f"{sigma[row, axis]:g}: beside it others, of up to {largest:g}, have no effect; make it "
        "larger, or leave all three σ of the point empty to hold it. "
    )


def _datum(
    network: Network,
    gauge: Float[np.ndarray, "7 defect"],
    origin: Float[np.ndarray, "3"],
    carries_datum: Bool[np.ndarray, " points"],
) -> tuple[dict[str, Float[np.ndarray, "points 3"]], bool]:
    """The datum constraints; refused if the setting requires the observations to fix the datum."""
    if network.datum == "control":
        points = network.points
        about = (points.position - origin)[points.has_role("control", "fixed")]
        words = open_directions_in_words(gauge, about.mean(0) if len(about) else np.zeros(3))
        raise InputError(
            f"the datum is not fixed: the observations leave open {words}"
            f" ({gauge.shape[1]} of 7). {_overpowering_control(points)}Give control points or "
            'distances, or choose datum = "inner" or "minimal".'
        )
    # With the scale open, all distances shrink to fit a σ that is a length (1 mm from a plane): the
    # minimum would be a network of size 0.
    needing_scale = [kind for kind in included_tables(network) if kind.needs_scale]
    if needing_scale and is_scale_open(gauge, network.points.position - origin):
        raise InputError(
            f"{needing_scale[0].source.name}: a σ of {needing_scale[0].TABLE} is a length, but "
            "nothing gives the network a scale: add a distance or control points, or write "
            '"exact" (no σ)'
        )
    return {
        "point": np.repeat(carries_datum[:, None].astype(float), 3, 1)
    }, network.datum == "minimal"


def is_scale_open(gauge: Float[np.ndarray, "7 defect"], X: Float[np.ndarray, "points 3"]) -> bool:
    """Whether an open direction of the datum scales points X, whatever its length and the units."""
    size = np.sqrt(np.nanmean((X**2).sum(1)))
    # Shifts move points by 1, rotations and the scale by their distance from the origin.
    displacement = np.abs(gauge) * np.repeat([1.0, size, size], [3, 3, 1])[:, None]
    return bool((displacement[-1] > NEGLIGIBLE_MOTION * displacement.max(0)).any())


def has_open_scale(problem: NetworkProblem) -> bool:
    """Whether nothing gives a network its scale."""
    datum = problem.plan.datum
    if datum is None:
        return False
    X = problem.network.points.position - np.asarray(problem.origin)
    return is_scale_open(np.asarray(datum.gauge), X)


def shifted_problem(network: Network, like: NetworkProblem, values: Values) -> NetworkProblem:
    """A problem of other points of the network with the orientations and cameras of `values`,
    without priors and datum: for excluded points."""
    # Of further kinds those that change where a point is seen.
    kinds = tuple(kind for kind in network.further if kind.CHANGES_IMAGE_POINTS)
    declared = declare(network.replace(further=kinds), like.origin)
    start_values: dict[str, Any] = {
        name: jax.tree.map(np.asarray, rows) for name, rows in values.items()
    }
    tables = tuple(
        table
        if table.name == "point"
        else dataclasses.replace(table, value=start_values[table.name])
        for table in declared.tables
    )
    observations = tuple(o for o in declared.observations if o.name in declared.image_rows)
    problem = engine.make_problem(tables, observations, "point")
    return _of_network(problem, network, dataclasses.replace(declared, further_sets=()))
