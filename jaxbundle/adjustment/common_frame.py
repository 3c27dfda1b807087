"""The unknowns of two adjustments in one frame: those of the same names, referred to the same
points by a similarity (`compare`)."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbundle.adjustment.problem import NetworkProblem, coordinates, has_open_scale
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.adjustment.unknowns import angles_near
from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.geometry import transform_point, transform_pose
from jaxbundle.geometry.similarity import compose, helmert_point
from jaxbundle.leastsquares.datum.motions import SIMILARITY_PARAMETERS
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.network.columns import list_some
from jaxbundle.orientation.absolute import absolute_orientation
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray

SCALE = SIMILARITY_PARAMETERS.index("scale")


@dataclasses.dataclass(frozen=True)
class CommonRows:
    """Rows that two networks have in common: (camera, parameter) names; images; points."""

    cameras: list[tuple[str, str]]
    images: list[str]
    points: list[str]


def common_rows(a: Adjustment, b: Adjustment) -> CommonRows:
    """The free camera parameters, images and determined points of both.

    **Raises:** `InputError` if there are none."""
    network_a, network_b = a.problem.network, b.problem.network
    model = {c.id: str(c.model) for c in network_b.cameras}
    cameras = []
    for camera in network_a.cameras:
        if model.get(camera.id) != str(camera.model):
            continue
        free = {*a.camera_cofactor(camera.id)[0], *b.camera_cofactor(camera.id)[0]}
        names = get_model(camera.model).parameters
        cameras += [(camera.id, name) for name in names if name in free]
    determined = lambda r: {
        id for id, X in zip(r.problem.network.points.id, r.point_values) if np.isfinite(X).all()
    }
    images, points = set(network_b.images.id), determined(a) & determined(b)
    common = CommonRows(
        cameras,
        [id for id in network_a.images.id if id in images],
        [id for id in network_a.points.id if id in points],
    )
    if not (common.cameras or common.images or common.points):
        raise InputError("a and b have no camera, image or point of the same name")
    return common


def points_that_hold(points: Sequence[str], requested: Sequence[str]) -> tuple[str, ...]:
    """The ids of the points that hold a similarity: the wanted ones, by default all.

    **Raises:** `InputError`."""
    if isinstance(requested, str):
        raise InputError("held_by must be a list of ids of points, but is a text")
    missing_ids = [id for id in map(str, requested) if id not in set(points)]
    if missing_ids:
        raise InputError(f"held_by: points {list_some(missing_ids)} are not in both adjustments")
    holding = tuple(map(str, requested)) or tuple(points)
    if len(holding) < 3:
        raise InputError(
            f"a similarity needs three points in common, but there are {len(holding)}; "
            "similarity=False compares coordinates as they are"
        )
    return holding


class CommonFrame(eqx.Module):
    """How values are referred to points: by τ, then by the small similarity that takes the points
    `held` to `reference` (its pseudo-inverse `projection` is that of their Helmert matrix)."""

    tau: Float[Array, "7"]
    held: Int[Array, " h"]
    reference: Float[Array, "h 3"]
    projection: Float[Array, "7 m"]

    def small(self, points: Float[AnyArray, "points 3"]) -> Float[Array, "7"]:
        transformed = jax.vmap(transform_point, (None, 0))(self.tau, points[self.held])
        return self.projection @ (self.reference - transformed).ravel()


def common_frames(
    a: Adjustment, b: Adjustment, holding_points: Sequence[str]
) -> tuple[tuple[CommonFrame, CommonFrame], Float[np.ndarray, "7"]]:
    """The frames of both, and τ from a to b; coordinates are relative to the origin of b."""
    rows_and_points, origin = [], b.problem.origin
    for r in (a, b):
        place = {id: k for k, id in enumerate(r.problem.network.points.id)}
        rows = np.array([place[id] for id in holding_points])
        rows_and_points.append((rows, r.point_values[rows] - origin))
    (rows_a, X), (rows_b, Y) = rows_and_points
    orientation = absolute_orientation(X, Y)
    if int(orientation.status):
        raise InputError("the points of the similarity are on one line, or at one place")
    G = np.asarray(jax.vmap(helmert_point)(jnp.asarray(Y))).reshape(-1, 7).copy()
    if not (has_open_scale(a.problem) or has_open_scale(b.problem)):
        G[:, SCALE] = 0.0
    projection = np.linalg.pinv(G)
    tau = np.array(orientation.tau)
    if not G[:, SCALE].any():
        tau[SCALE] = 0.0
    # The closed solution has a scale; without one it is off, and G is that of b, so that a step
    # leaves a remainder of the size of the misfit times the step. Ten steps leave rounding.
    for _ in range(10):
        transformed = np.asarray(_move(tau, X))
        tau = np.asarray(compose(projection @ (Y - transformed).ravel(), tau))
    frame_a = CommonFrame(*map(jnp.asarray, (tau, rows_a, Y, projection)))
    # What is left of the points of a stays where it is: only changes are referred to the points.
    frame_a = dataclasses.replace(frame_a, reference=jnp.asarray(_move(tau, X)))
    frame_b = CommonFrame(*map(jnp.asarray, (np.zeros(7), rows_b, Y, projection)))
    return (frame_a, frame_b), tau


_move = compile_once(jax.vmap(transform_point, (None, 0)), ())


class UnknownsInFrame(eqx.Module):
    """Unknowns of a network as one vector, in a frame: the (row, column) pairs of every table of
    cameras, and their `order` in the vector; images, points."""

    cameras: dict[str, Int[Array, "k 2"]]
    order: Int[Array, " parameters"]
    images: Int[Array, " n"]
    points: Int[Array, " m"]
    angles: Float[Array, "n 3"]
    shift: Float[Array, "3"]
    frame: CommonFrame | None

    def __call__(self, values: Values) -> Float[Array, " size"]:
        position, turn = values["image"]
        place, points = position + self.shift, coordinates(values) + self.shift
        if self.frame is not None:
            for tau in (self.frame.tau, self.frame.small(points)):
                place, turn = jax.vmap(transform_pose, (None, 0, 0))(tau, place, turn)
                points = jax.vmap(transform_point, (None, 0))(tau, points)
        angles_near_given = lambda q, given: angles_near(q, jnp.zeros(3), given)
        angles = jax.vmap(angles_near_given)(turn[self.images], self.angles)
        poses = jnp.concatenate([place[self.images], angles], 1)
        parameters = [
            values[table][places[:, 0], places[:, 1]]
            for table, places in sorted(self.cameras.items())
        ]
        cameras = jnp.concatenate([jnp.zeros(0), *parameters])[self.order]
        return jnp.concatenate([cameras, poses.ravel(), points[self.points].ravel()])


@dataclasses.dataclass(frozen=True)
class FramedAdjustment:
    """One of the adjustments, in the common frame; relative to the origin of `like`."""

    result: Adjustment
    frame: CommonFrame | None
    problem: NetworkProblem
    like: NetworkProblem

    def choose_rows(
        self, rows: CommonRows, angles: Float[np.ndarray, "images 3"]
    ) -> UnknownsInFrame:
        """The function that gives the unknowns of these rows; angles near the given ones."""
        network = self.problem.network

        def rows_of_ids(ids: Sequence[str], table: Sequence[str]) -> np.ndarray:
            row = {id: k for k, id in enumerate(table)}
            return np.array([row[id] for id in ids], int)

        place = {c.id: self.problem.table_of_camera(k) for k, c in enumerate(network.cameras)}
        pairs: dict[str, list[tuple[int, int, int]]] = {}
        for k, (id, name) in enumerate(rows.cameras):
            table, row = place[id]
            pairs.setdefault(table.name, []).append((row, table.parameters.index(name), k))
        order = np.array([k for _, places in sorted(pairs.items()) for *_, k in places], int)
        return UnknownsInFrame(
            {table: jnp.asarray(np.array(places)[:, :2]) for table, places in pairs.items()},
            jnp.asarray(np.argsort(order)),
            jnp.asarray(rows_of_ids(rows.images, network.images.id)),
            jnp.asarray(rows_of_ids(rows.points, network.points.id)),
            jnp.asarray(angles),
            jnp.asarray(self.problem.origin - self.like.origin),
            self.frame,
        )

    def estimate(
        self, rows: CommonRows, angles: Float[np.ndarray, "images 3"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """The unknowns and their covariance."""
        unknowns = self.choose_rows(rows, angles)
        return np.asarray(_call(unknowns, self.result.values)), self.result.covariance_of(unknowns)


@compile_once
def _call(unknowns: UnknownsInFrame, values: Values) -> Float[Array, " n"]:
    return unknowns(values)
