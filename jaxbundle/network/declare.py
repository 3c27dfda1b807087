"""A network as tables of unknowns and sets of observations for the engine.

Cameras of one model share a table, which is named "camera" if there is only one model. A `Layout`
maps the arrays of `Data` and `Values`, in the order of the network, to the engine's tables and
sets.
"""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float, Int

from jaxbundle.cameras import get_model
from jaxbundle.geometry.rotations import quaternion_from_omega_phi_kappa
from jaxbundle.leastsquares import declarations as ls
from jaxbundle.leastsquares.any_distance import AnyDistance, derivative
from jaxbundle.leastsquares.indexing.indices import round_up
from jaxbundle.leastsquares.indexing.rows import Data as EngineData
from jaxbundle.leastsquares.indexing.rows import Values as Tables
from jaxbundle.leastsquares.problem import distinct_names, weights_of
from jaxbundle.leastsquares.spaces import Pose, PoseValue, Vector
from jaxbundle.network import kinds
from jaxbundle.network.also import place, split
from jaxbundle.network.arrays import Data, Values
from jaxbundle.network.camera_tables import CameraTable, camera_tables, start_of
from jaxbundle.network.further.base import among
from jaxbundle.network.further.rolling_shutter import RollingShutter
from jaxbundle.network.tables import EXTERIOR, Network
from jaxbundle.system.programs import compile_once

LEAST_IMAGES = 64
"""Smallest batch of rotations, so that small networks share the program."""


@dataclasses.dataclass(frozen=True)
class Set:
    """A set of observations: its name, the field of `Data`, its rows and columns there (None: all);
    `constant`: further constants per row for its kind."""

    name: str
    field: str
    rows: Int[np.ndarray, " n"] | None = None
    columns: int | None = None
    constant: Float[np.ndarray, " n"] | None = None

    def measured(self, data: Data):
        """The measurements, in the form of the kind."""
        xy = self.cut(data.measured(self.field))
        return xy if self.constant is None else (xy, self.constant)

    def cut(self, x):
        """The part of an array of the field that belongs to this set."""
        x = x if self.columns is None else x[:, : self.columns]
        return x if self.rows is None else x[self.rows]

    def put(self, whole, part):
        """An array of the field with this set's part [n, r] in it."""
        rows = slice(None) if self.rows is None else self.rows
        at, part = (rows, part[:, 0]) if whole.ndim == 1 else ((rows, np.s_[: self.columns]), part)
        return _put(whole, at, part)


@dataclasses.dataclass(frozen=True)
class Layout:
    """The mapping of the arrays of a network; `width`: of `Values.camera`; `given`: the points,
    images and cameras of the rows of control, exterior and interior; `others`: the names of the
    sets of further kinds; `lengths`: the unit of distance of points at any distance, 0 for the
    others."""

    cameras: tuple[CameraTable, ...]
    sets: tuple[Set, ...]
    others: tuple[str, ...]
    width: int
    given: Mapping[str, Int[np.ndarray, " rows"]]
    lengths: Float[np.ndarray, " points"] | None = None

    def tables(self, values: Values) -> Tables:
        """The unknowns as the engine's tables."""
        found: Tables = {"image": PoseValue(values.position, values.rotation)}
        found["point"] = self._points(values.point)
        camera = values.camera
        # On the host, where nothing is compiled for it.
        camera = camera if isinstance(camera, Tracer) else np.asarray(camera)
        for table in self.cameras:
            found[table.name] = camera[table.cameras, : len(table.parameters)]
        return found | values.other

    def values(self, tables: Tables) -> Values:
        """The engine's tables as the arrays of the network."""
        cameras = sum(len(table.cameras) for table in self.cameras)
        camera = np.zeros((cameras, self.width))
        for table in self.cameras:
            rows = tables[table.name]
            camera = _put(camera, (table.cameras, np.s_[: rows.shape[1]]), rows)
        own = {"image", "point", *(table.name for table in self.cameras)}
        other = {name: rows for name, rows in tables.items() if name not in own}
        camera, pose = jax.device_put(camera), tables["image"]
        return Values(camera, pose.position, pose.rotation, tables["point"][:, :3], other)

    def _points(self, point):
        """The rows of the table of points."""
        if self.lengths is None:
            return point
        module = jnp if isinstance(point, Tracer) else np
        return module.concatenate([point, self.lengths[:, None]], 1)

    def coordinate_cofactors(self, point, Q):
        """The cofactors of X, Y, Z of all points, from those of their directions of change."""
        if self.lengths is None:
            return Q
        A = jax.vmap(derivative)(jnp.asarray(self._points(point)))
        return A @ Q @ A.transpose(0, 2, 1)

    def data(self, data: Data) -> EngineData:
        """The data of a network for the engine."""
        measured = {s.name: s.measured(data) for s in self.sets}
        weight = {s.name: _of_rows(s.cut(data.weight(s.field))) for s in self.sets}
        for name, (values, w) in zip(self.others, data.other, strict=True):
            measured[name], weight[name] = values, w
        return EngineData(self.tables(data.start), measured, weight)

    def with_weights(self, data: Data, weight) -> Data:
        """The data with the weights of the engine's sets."""
        found = {}
        for s in self.sets:
            name = f"{s.field}_weight"
            whole = found.get(name, np.array(data.weight(s.field)))
            found[name] = s.put(whole, np.asarray(weight[s.name]))
        other = tuple((m, weight[o]) for o, (m, _) in zip(self.others, data.other, strict=True))
        return dataclasses.replace(data, other=other, **jax.device_put(found))

    def rows(self, by_set, data: Data) -> "Rows":
        """The engine's results by set of observations, in the order of `Data`."""
        found = {}
        for field in ("image", "control", "exterior", "interior", "distance"):
            found[field] = np.zeros(np.shape(data.weight(field)))
        for s in self.sets:
            found[s.field] = s.put(found[s.field], by_set[s.name])
        return Rows(**found, other=tuple(by_set[name] for name in self.others))


class Rows(NamedTuple):
    """One number per residual, by kind, in the order of `Data`."""

    image: Float[np.ndarray, "rays 2"]
    control: Float[np.ndarray, "control 3"]
    exterior: Float[np.ndarray, "exterior 6"]
    interior: Float[np.ndarray, "interior parameters"]
    distance: Float[np.ndarray, " distances"]
    other: tuple[Float[np.ndarray, "n r"], ...]


def _put(whole, at, part):
    """The array with a part set: on the host, to avoid compiling, unless traced."""
    if isinstance(part, Tracer) or isinstance(whole, Tracer):
        return jnp.asarray(whole).at[at].set(part)
    whole[at] = part
    return whole


def _of_rows(weight):
    """[n, r], also for kinds with one residual."""
    return weight if weight.ndim == 2 else weight[:, None]


@dataclasses.dataclass(frozen=True)
class Declared:
    """The engine's problem, and the mapping to the arrays of the network (`layout`, `data`);
    `origin` [3] was subtracted from all object coordinates."""

    tables: tuple[ls.Table, ...]
    observations: tuple[ls.Observations, ...]
    layout: Layout
    data: Data
    origin: Float[np.ndarray, "3"]
    motions: ls.Motions


def declare(network: Network, origin=None, also=(), lengths=None) -> Declared:
    """The tables and observations of a checked network (`check_network`) without check points.

    `origin`: of its coordinates, default the centroid of its points; `also`: further tables, and
    observations of further kinds (`also.py`); `lengths`: of points at any distance (`Layout`)."""
    data, origin, priors = _data(network, origin)
    further, others = split(also)
    images, points, start = network.images, network.points, data.start
    cameras = camera_tables(network.cameras)
    placed = start.point, Vector(3)
    if lengths is not None:
        placed = np.concatenate([start.point, lengths[:, None]], 1), AnyDistance()
    tables = [
        ls.Table(
            "image",
            PoseValue(start.position, start.rotation),
            Pose(),
            images.sigma != 0,
            images.id,
            EXTERIOR,
        ),
        *(t.unknowns(network.cameras) for t in cameras),
        ls.Table(
            "point",
            *placed,
            free=~points.has_role("fixed"),
            labels=points.id,
            parameters=("X", "Y", "Z"),
        ),
    ]
    sets, given = _observe(network, data, priors, cameras)
    taking_part = [f for f in network.further if isinstance(f, RollingShutter)]
    taking_part += [f for f in among(network) if not isinstance(f, RollingShutter)]
    declared = [f.among(network).declare(network, origin) for f in taking_part]
    further += [table for one in declared for table in one.tables]
    tables += further
    others = [place(one, origin).resolve_labels(tables) for one in others]
    others += [one for of_kind in declared for one in of_kind.observations]
    similarity = kinds.SIMILARITY if lengths is None else kinds.SIMILARITY_AT_ANY_DISTANCE
    actions = (*similarity.actions, *(action for one in declared for action in one.actions))
    start = dataclasses.replace(start, other={t.name: t.value for t in further})
    given = distinct_names([*given, *others])
    others = given[len(sets) :]
    weights = weights_of(tables, others)
    data = dataclasses.replace(
        data, start=start, other=tuple((one.measured, weights[one.name]) for one in others)
    )
    names = tuple(one.name for one in others)
    layout = Layout(cameras, tuple(sets), names, start.camera.shape[1], priors, lengths)
    motions = dataclasses.replace(similarity, actions=actions)
    return Declared(tuple(tables), given, layout, data, origin, motions)


def _observe(network: Network, data: Data, priors, cameras: tuple[CameraTable, ...]):
    """Image points, control, priors and distances: their rows in the network (`Set`), and the
    observations."""
    images, observations = network.images, network.observations
    row_of_camera = np.zeros(len(network.cameras), np.int64)
    for t in cameras:
        row_of_camera[list(t.cameras)] = np.arange(len(t.cameras))
    sets, given = [], []

    def observe(kind, rows, name, *where):
        if len(rows[0]):
            s = Set(name, *where)
            sets.append(s)
            weight = s.cut(data.weight(s.field))
            sigma = np.where(weight > 0, 1 / np.where(weight > 0, weight, 1.0), np.inf)
            given.append(kind(rows, s.measured(data), sigma=sigma, name=s.name))

    shutter = next((f for f in network.further if isinstance(f, RollingShutter)), None)
    lines = None if shutter is None else shutter.lines(network)
    camera = images.camera[observations.image]
    for t in cameras:
        kind = kinds.image_points(t.model, network.residuals, t.name, moving=lines is not None)
        rows = None if len(cameras) == 1 else np.flatnonzero(np.isin(camera, t.cameras))
        take = lambda x, rows=rows: x if rows is None or x is None else x[rows]
        motion = () if lines is None else (observations.image, camera)
        touched = observations.image, *motion, row_of_camera[camera], observations.point
        observe(kind, tuple(map(take, touched)), t.image_set, "image", rows, None, take(lines))
    observe(kinds.CONTROL, (priors["control"],), "control", "control")
    observe(kinds.EXTERIOR, (priors["exterior"],), "exterior", "exterior")
    for t in cameras:
        rows = np.flatnonzero(np.isin(priors["interior"], t.cameras))
        kind = kinds.interior_orientation(t.name, t.parameters)
        columns = len(t.parameters)
        touched = (row_of_camera[priors["interior"][rows]],)
        observe(kind, touched, t.interior_set, "interior", rows, columns)
    observe(kinds.DISTANCES, tuple(network.distances.points.T), "distance", "distance")
    return sets, given


def order_cameras(network: Network) -> Network:
    """The same network with its cameras in the order of the images, if each image has its own: the
    engine then uses one block for an image and its camera."""
    used = network.images.camera
    if len(used) == len(network.cameras) and len(set(used)) == len(used):
        images = dataclasses.replace(network.images, camera=np.arange(len(used)))
        network = network.replace(cameras=tuple(network.cameras[c] for c in used), images=images)
    return network


def _quaternions(angles):
    """Rotations, by a program shared by small networks."""
    wide = np.resize(angles, (max(round_up(len(angles)), LEAST_IMAGES), 3))
    return np.asarray(_quaternions_of(wide))[: len(angles)]


_quaternions_of = compile_once(jax.vmap(quaternion_from_omega_phi_kappa), ())


def _data(network: Network, origin):
    """Values and weights of the network, object coordinates relative to their origin."""
    images, points, observations = network.images, network.points, network.observations
    if origin is None:
        origin = np.round(points.position.mean(0)) if len(points) else np.zeros(3)
    models = [get_model(c.model) for c in network.cameras]
    width = max(len(m.parameters) for m in models)
    camera = np.zeros((len(models), width))
    camera_sigma = np.full((len(models), width), np.inf)
    for c, (given, model) in enumerate(zip(network.cameras, models)):
        camera[c, : len(model.parameters)] = start_of(given)
        for j, name in enumerate(model.parameters):
            if name in given.free:
                camera_sigma[c, j] = given.sigma.get(name, np.inf)
    start = Values(
        camera=camera,
        position=images.position - origin,
        rotation=_quaternions(images.angles),
        point=points.position - origin,
    )
    weight = lambda sigma: np.where(
        np.isfinite(sigma) & (sigma > 0), 1 / np.where(sigma > 0, sigma, 1), 0.0
    )
    control = np.flatnonzero(points.has_role("control"))
    exterior = np.flatnonzero((np.isfinite(images.sigma) & (images.sigma > 0)).any(1))
    interior = np.flatnonzero(np.isfinite(camera_sigma).any(1))
    exterior_value = np.concatenate([images.position - origin, images.angles], 1)
    data = Data(
        start=start,
        image_xy=observations.xy,
        image_weight=1 / observations.sigma,
        control=(points.position - origin)[control],
        control_weight=weight(points.sigma[control]),
        exterior=exterior_value[exterior],
        exterior_weight=weight(images.sigma[exterior]),
        interior=camera[interior],
        interior_weight=weight(camera_sigma[interior]),
        distance=network.distances.value,
        distance_weight=1 / network.distances.sigma,
    )
    return data, origin, {"control": control, "exterior": exterior, "interior": interior}
