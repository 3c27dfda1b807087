"""The index plan of a network, made once on the host: who sees whom, what is free, who pairs.

The normal equations of a network are an arrow. Object points touch only the images that see
them, so they are eliminated point by point; what remains is the *reduced system* of

    images  (6 exterior parameters each, and the interior ones where every image has its camera),
    cameras (the free interior parameters, where cameras are shared),
    kept points (those at the ends of a distance: a distance ties two points together, so they
    are not eliminated).

Rays stand in the order of the images (`jaxbundle.network.rays`). `Incidence` has one row for each
camera a point is seen with, so that a shared camera costs one row a point, not one a ray.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from jaxbundle.cameras import CameraModel, default_parameters, get_model, key_of
from jaxbundle.geometry import matrix_from_omega_phi_kappa, quaternion_from_matrix
from jaxbundle.network.arrays import Data, Values
from jaxbundle.network.pairs import Pairs, make_pairs, pairs_between, pairs_within
from jaxbundle.network.rays import RayTable, lay_out, make_ray_table
from jaxbundle.network.reduction import (
    MOST_PAIRS,
    REDUCTIONS,
    Band,
    plan_reduction,
)
from jaxbundle.network.tables import Network


class Group(eqx.Module):
    """The rays of one camera model: which chunks (None: all), and its free parameter columns."""

    model: str | CameraModel = eqx.field(static=True)
    free: tuple[int, ...] = eqx.field(static=True)
    chunks: Int[Array, " chunks"] | None


class Incidence(eqx.Module):
    """A point seen with a shared camera: one row for each such couple, sorted by point."""

    of_ray: Int[Array, " rays"]
    point: Int[Array, " incidences"]
    camera: Int[Array, " incidences"]


class Structure(eqx.Module):
    """The index plan; `*_free` are 1 where an unknown is free, 0 where it is held.

    `reduction`: "dense", "banded" or "iterative", how the reduced system is solved; `band` is there
    where it is banded. `pins`: see `jaxbundle.adjustment.reduced`. `axis`: the name of the device
    axis over which points and their rays are distributed, each device holding the plan of its own;
    images and cameras are on all. None: one device.
    """

    domain: str = eqx.field(static=True)
    axis: str | None = eqx.field(static=True)
    own_camera: bool = eqx.field(static=True)
    all_free: bool = eqx.field(static=True)
    all_eliminated: bool = eqx.field(static=True)
    reduction: str = eqx.field(static=True)
    groups: tuple[Group, ...]
    table: RayTable
    camera_of_image: Int[Array, " images"]
    camera_columns: Int[Array, "cameras k"]
    camera_free: Float[Array, "cameras k"]
    image_free: Float[Array, "images 6"]
    point_free: Float[Array, "points 3"]
    eliminated: Float[Array, "points 1"]
    kept: Int[Array, " kept"]
    kept_rays: Int[Array, " kept_rays"]
    kept_of_ray: Int[Array, " kept_rays"]
    control: Int[Array, " control"]
    exterior: Int[Array, " exterior"]
    interior: Int[Array, " interior"]
    distance: Int[Array, "distances 2"]
    incidence: Incidence | None
    image_pairs: Pairs
    image_camera_pairs: Pairs | None
    camera_pairs: Pairs | None
    band: Band | None
    pins: Float[Array, "images image_block"]
    datum_weight: Float[Array, "points 3"]
    gauge: Float[Array, "7 defect"]

    @property
    def image(self) -> Int[Array, " rays"]:
        """The image of every ray."""
        return self.table.image

    @property
    def camera(self) -> Int[Array, " rays"]:
        """The camera of every ray."""
        return self.table.camera

    @property
    def point(self) -> Int[Array, " rays"]:
        """The point of every ray."""
        return self.table.point

    @property
    def images(self) -> int:
        return self.image_free.shape[0]

    @property
    def cameras(self) -> int:
        return self.camera_free.shape[0]

    @property
    def points(self) -> int:
        return self.point_free.shape[0]

    @property
    def rays(self) -> int:
        """Rows of the table of rays, the empty ones counted."""
        return self.table.rays

    @property
    def interior_width(self) -> int:
        """Free interior parameters of a camera (the largest number over the cameras)."""
        return self.camera_free.shape[1]

    @property
    def image_width(self) -> int:
        """Width of an image's block in the reduced system."""
        return 6 + (self.interior_width if self.own_camera else 0)

    @property
    def camera_width(self) -> int:
        """Width of a shared camera's block in the reduced system; 0 where there is none."""
        return 0 if self.own_camera else self.interior_width

    @property
    def reduced_size(self) -> int:
        """Unknowns of the reduced system, the held ones counted."""
        return (
            self.images * self.image_width
            + self.cameras * self.camera_width
            + 3 * self.kept.shape[0]
        )

    @property
    def defect(self) -> int:
        """Datum defect: directions in which the network may float."""
        return self.gauge.shape[1]

    def without_datum(self) -> "Structure":
        """The same without the open directions of the datum, for programs that do not ask."""
        return dataclasses.replace(self, gauge=np.zeros((7, 0)))

    def total(self, parts: PyTree[Array]) -> PyTree[Array]:
        """The sum over the devices of what each has found for its own points and rays."""
        return parts if self.axis is None else jax.lax.psum(parts, self.axis)

    def agreed(self, value: Array) -> Array:
        """The mean over the devices of what should be the same on all, so that it is, to the last
        digit: devices that decide differently would wait for each other for ever."""
        return value if self.axis is None else jax.lax.pmean(value, self.axis)

    @property
    def image_block_free(self) -> Float[Array, "images image_block"]:
        """Which columns of the image blocks are free."""
        if self.own_camera:
            return jnp.concatenate([self.image_free, self.camera_free], 1)
        return self.image_free


def order_cameras(network: Network) -> Network:
    """The same network with its cameras in the order of the images, where each has its own."""
    used = network.images.camera
    if len(used) == len(network.cameras) and len(set(used)) == len(used):
        network = network.replace(
            cameras=tuple(network.cameras[c] for c in used),
            images=_with_camera(network.images, np.arange(len(used))),
        )
    return network


def _with_camera(images, camera):
    return type(images)(
        images.id, camera, images.position, images.angles, images.sigma, images.source
    )


def make_structure(
    network: Network,
    *,
    chunk: int | None = None,
    pair_lengths: tuple[int, ...] | None = None,
    pair_blocks: tuple | None = None,
    ways: tuple[str, ...] = REDUCTIONS,
) -> tuple[Structure, Data, Float[np.ndarray, "3"], Int[np.ndarray, " observations"]]:
    """The index plan, the arrays, the origin and the ray of every observation of a checked network
    (`check_network`).

    Check points must have been set aside. The datum is not decided here. `chunk` and `pair_lengths`
    are the lengths of chunks of rays and of pairs of rays, if not chosen by size; `pair_blocks` the
    pairs of images with common points, if these are not all of the network's points; `ways`: how
    the reduced system may be solved (`reduction` is None where none of them fits into memory).
    """
    images, points, observations = network.images, network.points, network.observations
    source, used, chunk = lay_out(observations.image, observations.point, chunk)
    image, point = observations.image[source], observations.point[source]
    camera = images.camera[image]
    row = np.empty(len(observations), np.int64)
    row[source[used]] = np.flatnonzero(used)

    camera_columns, camera_free, groups = _interior(network, camera[::chunk])
    k = camera_free.shape[1]
    own_camera = bool(
        k and len(network.cameras) == len(images)
        and np.array_equal(images.camera, np.arange(len(images)))
    )
    image_free = np.where(images.sigma == 0, 0.0, 1.0)
    fixed = points.has_role("fixed")
    point_free = np.where(fixed[:, None], 0.0, 1.0) * np.ones((len(points), 3))
    kept = np.setdiff1d(network.distances.points.ravel(), np.flatnonzero(fixed))
    eliminated = ~fixed
    eliminated[kept] = False

    rays = np.flatnonzero(used)
    rays = rays[np.argsort(point[rays], kind="stable")]
    elim_rays = rays[eliminated[point[rays]]]
    kept_rays = rays[np.isin(point[rays], kept)]
    incidence, camera_plans = None, (None, None)
    if k and not own_camera:
        incidence, camera_plans = _camera_plans(
            image, camera, point, elim_rays, len(network.cameras), chunk > 1, pair_lengths
        )
    data, origin, priors = _data(network, source, used)
    as_int = lambda x: np.asarray(x, np.int32)
    width = 6 + (k if own_camera else 0)
    number = np.bincount(point[elim_rays])
    if len(ways) > 1 and (number * (number - 1.0)).sum() / 2 > MOST_PAIRS:
        ways = ("iterative",)
    paired = elim_rays[:0] if ways == ("iterative",) else elim_rays
    pairs = _image_pairs(
        image, point, paired, len(images), chunk > 1, pair_lengths, pair_blocks
    )
    others = (0 if own_camera else k * len(network.cameras)) + 3 * len(kept)
    reduction, band = plan_reduction(
        (pairs.row, pairs.column), len(images), width, others, len(observations), ways
    )
    structure = Structure(
        domain=network.residuals,
        axis=None,
        own_camera=own_camera,
        all_free=bool(image_free.all() and camera_free.all() and point_free.all()),
        all_eliminated=bool(eliminated.all()),
        reduction=reduction,
        groups=groups,
        table=make_ray_table(image, camera, point, used, chunk, len(images)),
        camera_of_image=as_int(images.camera),
        camera_columns=as_int(camera_columns),
        camera_free=camera_free,
        image_free=image_free,
        point_free=point_free,
        eliminated=eliminated[:, None].astype(float),
        kept=as_int(kept),
        kept_rays=as_int(kept_rays),
        kept_of_ray=as_int(np.searchsorted(kept, point[kept_rays])),
        control=as_int(priors["control"]),
        exterior=as_int(priors["exterior"]),
        interior=as_int(priors["interior"]),
        distance=as_int(network.distances.points),
        incidence=incidence,
        image_pairs=pairs,
        image_camera_pairs=camera_plans[0],
        camera_pairs=camera_plans[1],
        band=band,
        pins=np.zeros((len(images), width)),
        datum_weight=np.zeros((len(points), 3)),
        gauge=np.zeros((7, 0)),
    )
    # Straight to the device: `jnp.asarray` compiles a little program for every shape.
    structure, data = jax.device_put((structure, data))
    return structure, data, origin, row


def _image_pairs(image, point, rays, images, empty, lengths=None, blocks=None) -> Pairs:
    """Pairs of two rays of one point, the lower image first; both ways round if it is the same."""
    i, j = pairs_within(point[rays])
    i, j = rays[i], rays[j]
    swap = image[i] > image[j]
    i, j = np.where(swap, j, i), np.where(swap, i, j)
    twice = image[i] == image[j]
    i, j = np.concatenate([i, j[twice]]), np.concatenate([j, i[twice]])
    missing = len(image) - empty
    return make_pairs(
        i, j, image[i], image[j], images, (missing, missing), lengths, (empty, empty), blocks
    )


def _camera_plans(image, camera, point, elim_rays, cameras, empty, lengths):
    """Incidences of points and shared cameras, and the pairs in which cameras take part."""
    key = point.astype(np.int64) * cameras + camera
    keys, of_ray = np.unique(key, return_inverse=True)
    inc_point, inc_camera = keys // cameras, keys % cameras
    elim = np.zeros(len(keys), bool)
    elim[of_ray[elim_rays]] = True
    elim = np.flatnonzero(elim)
    r, q = pairs_between(point[elim_rays], inc_point[elim])
    r, q = elim_rays[r], elim[q]
    a, b = pairs_within(inc_point[elim])
    a, b = (elim[np.concatenate([x, np.arange(len(elim))])] for x in (a, b))
    as_int = lambda x: np.asarray(x, np.int32)
    incidence = Incidence(as_int(of_ray), as_int(inc_point), as_int(inc_camera))
    return incidence, (  # fmt: skip
        make_pairs(
            r, q, image[r], inc_camera[q], cameras, (len(image) - empty, len(keys)), lengths,
            (empty, False),
        ),
        make_pairs(a, b, inc_camera[a], inc_camera[b], cameras, (len(keys), len(keys)), lengths),
    )


def _interior(network: Network, camera_of_chunk):
    """Free interior columns of every camera, and the chunks of rays of every camera model."""
    models = [get_model(c.model) for c in network.cameras]
    free_of_model: dict[CameraModel, set[int]] = {}
    for camera, model in zip(network.cameras, models):
        columns = free_of_model.setdefault(model, set())
        columns.update(model.parameters.index(name) for name in camera.free)
    free = {model: tuple(sorted(columns)) for model, columns in free_of_model.items()}
    k = max((len(columns) for columns in free.values()), default=0)
    camera_columns = np.zeros((len(models), k), np.int64)
    camera_free = np.zeros((len(models), k))
    for c, (camera, model) in enumerate(zip(network.cameras, models)):
        for j, column in enumerate(free[model]):
            camera_columns[c, j] = column
            camera_free[c, j] = model.parameters[column] in camera.free
    groups = []
    number = {model: i for i, model in enumerate(free)}
    model_of_chunk = np.array([number[model] for model in models])[camera_of_chunk]
    for model, columns in free.items():
        chunks = np.flatnonzero(model_of_chunk == number[model])
        rows = None if len(free) == 1 else chunks.astype(np.int32)
        groups.append(Group(key_of(model), columns, rows))
    return camera_columns, camera_free, tuple(groups)


@jax.jit
def _quaternions(angles):
    one = lambda a: quaternion_from_matrix(matrix_from_omega_phi_kappa(a))
    return jax.vmap(one)(angles)


def _data(network: Network, source, used):
    """Values and weights of the network, object coordinates relative to their origin."""
    images, points, observations = network.images, network.points, network.observations
    origin = np.round(points.position.mean(0)) if len(points) else np.zeros(3)
    models = [get_model(c.model) for c in network.cameras]
    width = max(len(m.parameters) for m in models)
    camera = np.zeros((len(models), width))
    camera_sigma = np.full((len(models), width), np.inf)
    for c, (given, model) in enumerate(zip(network.cameras, models)):
        values = {**default_parameters(model), **given.parameters}
        for j, name in enumerate(model.parameters):
            camera[c, j] = values[name]
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
        image_xy=observations.xy[source],
        image_weight=used[:, None] / observations.sigma[source],
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
