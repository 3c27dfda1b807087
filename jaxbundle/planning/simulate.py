"""Simulated networks: from stations and targets to a network with noise in one call.

    stations = jaxbundle.ring_of_stations(8, radius=3.0, height=2.0, roll_every=2)
    targets = jaxbundle.grid_of_targets(9, 9, 0.2, relief=0.1)
    camera = jaxbundle.Camera("cam", "brown", {"c": 24.0, "K1": -1e-4}, free=("c", "x0", "K1"))
    result = jaxbundle.adjust(
        jaxbundle.simulate(stations, targets, camera, noise=0.001, seed=1, image_format=(36, 24))
    )

A target is imaged if its image is inside the format and the ray of that image leads back to it. So
nothing behind a camera is imaged, and nothing beyond the radius to which a distortion is one-to-one
(`jaxbundle.cameras.turning_radius`). Targets do not occlude each other.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from jaxbundle.arguments import integer, numeric_array, positive, show, text
from jaxbundle.cameras import CameraModel, default_parameters, get_model, image_ray, project
from jaxbundle.errors import InputError
from jaxbundle.float64 import require_x64
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.leastsquares.indexing.indices import round_up
from jaxbundle.network.build import make_cameras
from jaxbundle.network.rules import CHOICES, check_choice
from jaxbundle.network.tables import (
    STATED,
    UNIT,
    Camera,
    Distances,
    Images,
    Network,
    Observations,
    Points,
    Source,
)
from jaxbundle.planning.stations import LARGEST_SEED, Stations, rows_of_three
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray

# Rays projected in one call, so that memory does not grow with stations × targets: some ten numbers
# of 8 bytes a ray, 160 MB.
RAYS_AT_ONCE = 2_000_000
# Image, point and image coordinates of every ray.
Rays = tuple[Int[np.ndarray, " rays"], Int[np.ndarray, " rays"], Float[np.ndarray, "rays 2"]]


@dataclasses.dataclass(frozen=True)
class Simulation:
    """A simulated network and the truth behind it.

    `truth` is the same network (same rows) with true cameras, exterior orientation, object
    coordinates and distances, and image coordinates without noise.
    """

    network: Network
    truth: Network


def simulate(
    stations: Stations,
    targets: Float[np.ndarray, "points 3"],
    camera: Camera | Sequence[Camera],
    *,
    noise: float | tuple[float, float],
    seed: int = 0,
    **options: Any,
) -> Network:
    """A simulated network, ready for `jaxbundle.adjust`.

    Arguments and errors are those of `simulate_with_truth`, which returns the truth as well.
    """
    return simulate_with_truth(stations, targets, camera, noise=noise, seed=seed, **options).network


def simulate_with_truth(  # noqa: PLR0913 (public: a table of options, all but three by name)
    stations: Stations,
    targets: Float[np.ndarray, "points 3"],
    camera: Camera | Sequence[Camera],
    *,
    noise: float | tuple[float, float],
    seed: int = 0,
    datum: str = "inner",
    residuals: str = "corrected",
    image_format: tuple[float, float] | None = None,
    camera_of_station: Sequence[int] | None = None,
    start: Camera | Sequence[Camera] | None = None,
    disturb: float | tuple[float, float, float] = 0.0,
    control: Sequence[int] = (),
    control_sigma: float | tuple[float, float, float] = 0.0,
    check: Sequence[int] = (),
    distances: Sequence[tuple[int, int]] = (),
    distance_sigma: float = 1e-3,
    normals: Float[np.ndarray, "points 3"] | Sequence[float] | None = None,
    max_incidence: float | None = None,
    max_rays: int | None = None,
    min_rays: int = 2,
    name: str = "simulation",
    object_unit: str = "m",
) -> Simulation:
    """A simulated network, ready for `jaxbundle.adjust`, and its truth.

    **Arguments:**

    - `stations`: exterior orientations, see `Stations`, `stations_looking_at`,
      `ring_of_stations`, `aerial_block`.
    - `targets`: object points [P, 3], object unit; the k-th has the id `str(k + 1)`.
    - `camera`: with its TRUE parameters; its `free` parameters and prior σ are kept. Several
      cameras: one per station, or by the indices `camera_of_station` [I].
    - `noise`: σ of the image coordinates (or of x and y), in the unit of the camera's model;
      also their σ in the network. 0: exact coordinates, with σ 1.
    - `seed`: of `numpy.random.default_rng`; equal arguments give equal networks.
    - `image_format`: (width, height) of the image in the unit of the model, centred on the image
      origin (pixel models with v down: from −½ to width − ½). Default: the camera's `image_size`
      and `pixel_size`; unlimited without them.
    - `start`: cameras with the start values of the parameters, default the true ones; their `free`
      parameters and priors take precedence.
    - `disturb`: σ of the errors of the start values: positions, angles, points (object unit,
      radians, object unit); or one fraction f, for f times the mean length of a ray, f radians
      and f times the mean length again. Only tie points are disturbed.
    - `control`: indices of control points, known with `control_sigma` (object unit, an error is
      drawn; 0: fixed, without error); `check`: indices of check points.
    - `distances`: pairs of indices of points with a measured distance of `distance_sigma`.
    - `max_incidence`: largest angle, radians, between a target's normal (`normals`, [P, 3] or one
      for all) and the direction to the camera.
    - `max_rays`: per point, selected at random. Tie and check points with fewer than
      `min_rays` rays are dropped.

    **Returns:** a `Simulation`: network and truth, with the given `datum` and domain of
    `residuals`.

    **Raises:** `InputError` for impossible arguments, or if no target is imaged.
    """
    require_x64()
    check_choice("datum", datum, CHOICES["datum"])
    check_choice("residuals", residuals, CHOICES["residuals"])
    if not isinstance(stations, Stations):
        raise InputError(
            f"stations must be Stations, but is {show(stations)}: use ring_of_stations, "
            "aerial_block or stations_looking_at"
        )
    targets = rows_of_three(targets, "targets")
    seed = integer("seed", seed, least=0, most=LARGEST_SEED)
    min_rays = integer("min_rays", min_rays, least=0)
    max_rays = None if max_rays is None else integer("max_rays", max_rays)
    if max_incidence is not None:
        max_incidence = positive("max_incidence", max_incidence)
    distance_sigma = positive("distance_sigma", distance_sigma)
    if normals is not None:
        normals = _normals(normals, targets)
    for key, value in (("name", name), ("object_unit", object_unit)):
        text(key, value)
    cameras = make_cameras(camera)
    of_station = _camera_of_station(cameras, camera_of_station, len(stations))
    start_cameras = cameras if start is None else make_cameras(start, "start: ")
    if len(start_cameras) != len(cameras):
        raise InputError(
            f"start has {len(start_cameras)} cameras, camera {len(cameras)}; give the same number"
        )
    # Before any drawing, so that faults of arguments are reported without computing.
    role = _roles(len(targets), control, control_sigma, check)
    sigma_xy = _not_negative(noise, 2, "noise")

    rng = np.random.default_rng(seed)
    rays = _project_all(stations, targets, cameras, of_station, image_format)
    is_selected = np.ones(len(rays[0]), bool)
    if max_incidence is not None:
        is_selected = _incidence_cosines(stations, targets, normals, *rays[:2]) >= np.cos(
            max_incidence
        )
    if max_rays is not None:
        is_selected[is_selected] = _draw_rays(rays[1][is_selected], max_rays, rng)
    # A control point is known: one ray is information about its image. Others need two.
    required_rays = np.where(np.isin(role, ("tie", "check")), min_rays, 1)
    (image, point, xy), is_imaged = _select_imaged(rays, is_selected, required_rays)
    row = np.cumsum(is_imaged) - 1
    points = _points(targets, role, is_imaged, control_sigma)
    ends = _ends(distances, len(targets), is_imaged, row)
    observations = Observations(
        image,
        row[point],
        xy,
        np.broadcast_to(np.where(sigma_xy > 0, sigma_xy, 1.0), xy.shape).copy(),
        Source("image points"),
        STATED if np.all(sigma_xy) else UNIT,
    )
    length = np.linalg.norm(points.position[ends[:, 0]] - points.position[ends[:, 1]], axis=1)
    truth = Network(
        cameras=cameras,
        images=Images(
            id=tuple(str(i + 1) for i in range(len(stations))),
            camera=of_station,
            position=stations.position,
            angles=stations.angles,
            sigma=np.full((len(stations), 6), np.nan),
            source=Source("stations", None, "station"),
        ),
        points=points,
        observations=observations,
        distances=Distances(
            ends, length, np.full(len(ends), float(distance_sigma)), Source("distances")
        ),
        datum=datum,
        residuals=residuals,
        name=name,
        object_unit=object_unit,
        image_unit=get_model(cameras[0].model).unit,
    )
    to_camera = stations.position[image] - points.position[observations.point]
    disturbance = _disturbance(disturb, to_camera)
    return Simulation(_measure(truth, start_cameras, sigma_xy, disturbance, rng), truth)


def _select_imaged(
    rays: Rays, is_selected: Bool[np.ndarray, " rays"], required_rays: Int[np.ndarray, " targets"]
) -> tuple[list[np.ndarray], Bool[np.ndarray, " targets"]]:
    """The rays of targets with enough rays, and these targets.

    **Raises:** `InputError` where there are none."""
    is_imaged = np.bincount(rays[1][is_selected], minlength=len(required_rays)) >= required_rays
    is_selected = is_selected & is_imaged[rays[1]]
    if not is_selected.any():
        raise InputError(
            "no target is imaged often enough; check the format, the units, and where the "
            "stations look"
        )
    return [x[is_selected] for x in rays], is_imaged


def _points(
    targets: Float[np.ndarray, "targets 3"],
    role: np.ndarray,
    is_imaged: Bool[np.ndarray, " targets"],
    control_sigma: float | Sequence[float],
) -> Points:
    role, number = role[is_imaged], np.flatnonzero(is_imaged) + 1
    sigma = np.full((len(role), 3), np.nan)
    if "control" in role:
        sigma[role == "control"] = np.broadcast_to(control_sigma, 3)
    source = Source("targets", number, "target")
    return Points(
        tuple(map(str, number.tolist())), tuple(role.tolist()), targets[is_imaged], sigma, source
    )


def _measure(
    truth: Network,
    start_cameras: Sequence[Camera],
    noise: Float[np.ndarray, "2"],
    disturb: Float[np.ndarray, "3"],
    rng: np.random.Generator,
) -> Network:
    """The network as observed: noise, errors of given coordinates, disturbed start values."""
    images, points, distances = truth.images, truth.points, truth.distances
    observations = truth.observations
    # The order of the draws is part of what a seed means; all are drawn, also where σ is 0.
    xy = observations.xy + noise * rng.standard_normal(observations.xy.shape)
    value = distances.value + distances.sigma * rng.standard_normal(len(distances))
    error = rng.standard_normal(points.position.shape)
    scale = np.where(points.has_role("tie")[:, None], disturb[2], np.nan_to_num(points.sigma))
    position = images.position + disturb[0] * rng.standard_normal(images.position.shape)
    angles = images.angles + disturb[1] * rng.standard_normal(images.angles.shape)
    return truth.replace(
        cameras=start_cameras,
        images=dataclasses.replace(images, position=position, angles=angles),
        points=dataclasses.replace(points, position=points.position + scale * error),
        observations=dataclasses.replace(observations, xy=xy),
        distances=dataclasses.replace(distances, value=value),
    )


def _camera_of_station(
    cameras: Sequence[Camera], camera_of_station: Sequence[int] | None, stations: int
) -> Int[np.ndarray, " images"]:
    if camera_of_station is None:
        if len(cameras) not in (1, stations):
            raise InputError(
                f"{len(cameras)} cameras for {stations} stations; give camera_of_station, the "
                "index of the camera of every station"
            )
        return np.arange(stations) % len(cameras)
    indices = numeric_array("camera_of_station", camera_of_station, "indices of cameras")
    if indices.shape != (stations,) or not np.isin(indices, np.arange(len(cameras))).all():
        raise InputError(
            f"camera_of_station must be {stations} indices below {len(cameras)}, one for each "
            "station"
        )
    return indices.astype(np.int64)


def _roles(
    points: int,
    control: Sequence[int],
    control_sigma: float | Sequence[float],
    check: Sequence[int],
) -> np.ndarray:
    """The role of every target."""
    role = np.full(points, "tie", dtype=object)
    sigma = _not_negative(control_sigma, 3, "control_sigma")
    if (sigma == 0).any() and (sigma > 0).any():
        raise InputError("control_sigma: 0 (fixed) must be given for all three axes or for none")
    for name, indices, word in (
        ("control", control, "fixed" if (sigma == 0).all() else "control"),
        ("check", check, "check"),
    ):
        indices = _indices(name, indices)
        if indices.ndim != 1:
            raise InputError(f"{name} must be a list of indices, but is {show(indices.tolist())}")
        if not np.isin(indices, np.arange(points)).all():
            raise InputError(f"{name} holds an index that is not among the {points} targets")
        if (role[indices] != "tie").any():
            raise InputError("a target cannot be a control point and a check point at once")
        role[indices] = word
    return role


def _indices(name: str, values: ArrayLike) -> np.ndarray:
    """Indices of targets; none may be given as []."""
    array = numeric_array(name, values, "indices of targets")
    if array.size and array.dtype.kind not in "iu":
        raise InputError(
            f"{name} must be indices of targets, whole numbers, but is {show(array.tolist())}"
        )
    return array.astype(int)


def _not_negative(value: ArrayLike, size: int, name: str) -> Float[np.ndarray, " size"]:
    value = numeric_array(name, value, f"0 or positive, one number or {size}").astype(float)
    if value.shape not in ((), (size,)) or not (np.isfinite(value) & (value >= 0)).all():
        raise InputError(
            f"{name} is {show(value.tolist())}; it must be 0 or positive, one number or {size}"
        )
    return np.broadcast_to(value, size)


def _disturbance(
    disturb: float | Sequence[float], rays: Float[np.ndarray, "rays 3"]
) -> Float[np.ndarray, "3"]:
    """σ of the start values of positions, angles and points."""
    sigma = numeric_array("disturb", disturb, "a fraction, or three σ")
    if sigma.ndim == 0:
        length = float(np.linalg.norm(rays, axis=1).mean())
        sigma = sigma * np.array([length, 1.0, length])
    return _not_negative(sigma, 3, "disturb")


def _ends(
    distances: Sequence[tuple[int, int]],
    targets: int,
    is_imaged: Bool[np.ndarray, " targets"],
    row: Int[np.ndarray, " targets"],
) -> Int[np.ndarray, "n 2"]:
    """The ends of the distances as rows of the points used."""
    ends = _indices("distances", distances)
    if ends.shape != (0,) and (
        ends.ndim != 2 or ends.shape[1] != 2 or (ends[:, 0] == ends[:, 1]).any()
    ):
        raise InputError(
            "distances must be pairs of indices of two different targets, but is "
            f"{show(ends.tolist())}"
        )
    ends = ends.reshape(-1, 2)
    if not np.isin(ends, np.arange(targets)).all():
        raise InputError(f"distances name an index that is not among the {targets} targets")
    for a, b in ends[~is_imaged[ends].all(1)][:1]:
        raise InputError(f"the distance from target {a + 1} to {b + 1}: too few images show it")
    return row[ends]


def _incidence_cosines(
    stations: Stations,
    targets: Float[np.ndarray, "targets 3"],
    normals: Float[np.ndarray, "targets 3"] | None,
    image: Int[np.ndarray, " rays"],
    point: Int[np.ndarray, " rays"],
) -> Float[np.ndarray, " rays"]:
    """Cosine of the angle between a target's normal and the direction to the camera."""
    if normals is None:
        raise InputError("max_incidence needs the normals of the targets; give normals [P, 3]")
    ray = stations.position[image] - targets[point]
    return (ray * normals[point]).sum(1) / np.linalg.norm(ray, axis=1)


def _normals(
    normals: ArrayLike, targets: Float[np.ndarray, "targets 3"]
) -> Float[np.ndarray, "targets 3"]:
    """Unit vectors [P, 3]."""
    normals = numeric_array("normals", normals, "directions X, Y, Z").astype(float)
    if normals.shape not in ((3,), targets.shape):
        raise InputError(
            f"normals must have the shape [3] or {list(targets.shape)}, but has {normals.shape}"
        )
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    if not (np.isfinite(length) & (length > 0)).all():
        raise InputError("normals must be finite directions, none of them 0, 0, 0")
    return np.broadcast_to(normals / length, targets.shape)


def _draw_rays(
    point: Int[np.ndarray, " rays"], max_rays: int, rng: np.random.Generator
) -> Bool[np.ndarray, " rays"]:
    """A mask that keeps at most this number of rays per point, drawn at random."""
    order = np.lexsort((rng.random(len(point)), point))
    sorted_point = point[order]
    starts = np.searchsorted(sorted_point, sorted_point)
    keep = np.empty(len(point), bool)
    keep[order] = np.arange(len(point)) - starts < max_rays
    return keep


def _project_all(
    stations: Stations,
    targets: Float[np.ndarray, "targets 3"],
    cameras: Sequence[Camera],
    of_station: Int[np.ndarray, " images"],
    image_format: tuple[float, float] | None,
) -> Rays:
    """All images of targets inside the format: image, point [rays], true coordinates [rays, 2]."""
    # Small networks are padded to 16 stations and 128 targets, larger ones to round numbers, so
    # that they share programs: compiling takes longer than projecting a million rays.
    parts, number = [], len(targets)
    padded_targets = max(128, round_up(number))
    targets = np.pad(targets, [(0, padded_targets - number), (0, 0)], mode="edge")
    for c, camera in enumerate(cameras):
        model = get_model(camera.model)
        values = {**default_parameters(model), **camera.parameters}
        p = tuple(float(values[name]) for name in model.parameters)
        low, high = _format_limits(camera, image_format)
        index = np.flatnonzero(of_station == c)
        padded_stations = max(16, round_up(len(index)))
        at_once = int(np.clip(RAYS_AT_ONCE // padded_targets, 1, padded_stations))
        for begin in range(0, len(index), at_once):
            # The last batch is padded, so that all have one shape and compile once.
            batch = np.resize(index[begin : begin + at_once], at_once)
            xy, leads_back = _images_of(
                model, p, stations.position[batch], stations.angles[batch], targets
            )
            xy, leads_back = np.asarray(xy)[:, :number], np.asarray(leads_back)[:, :number]
            is_inside = ((xy >= low) & (xy <= high)).all(-1) & leads_back
            is_inside[len(index) - begin :] = False
            i, k = np.nonzero(is_inside)
            parts.append((batch[i], k, xy[i, k]))
    image, point, xy = (np.concatenate(columns) for columns in zip(*parts))
    order = np.lexsort((point, image))
    return image[order], point[order], xy[order]


@partial(compile_once, static=0)
def _images_of(
    model: CameraModel,
    p: tuple[float, ...],
    position: Float[np.ndarray, "i 3"],
    angles: Float[np.ndarray, "i 3"],
    targets: Float[np.ndarray, "P 3"],
) -> tuple[Float[Array, "i P 2"], Bool[AnyArray, "i P"] | bool]:
    """Image coordinates [i, P, 2], and whether their rays lead back to the targets [i, P]."""
    matrices = jax.vmap(matrix_from_omega_phi_kappa)(angles)

    def image_of(
        M: Float[Array, "3 3"],
        centre: Float[AnyArray, "3"],
        X: Float[Array, ""],
        Y: Float[Array, ""],
        Z: Float[Array, ""],
    ) -> tuple[Float[Array, "2"], Bool[AnyArray, ""] | bool]:
        X, Y, Z = X - centre[0], Y - centre[1], Z - centre[2]
        ray = tuple(M[k, 0] * X + M[k, 1] * Y + M[k, 2] * Z for k in range(3))
        x, y = project(model, p, *ray)
        length = jnp.sqrt(sum(r * r for r in ray))
        square = sum((a - b / length) ** 2 for a, b in zip(image_ray(model, p, x, y), ray))
        # Unit vectors nearer than 1e-6 are one direction: rounding gives 1e-12, a second solution
        # of a distortion that is not one-to-one lies far away.
        return jnp.stack([x, y]), square < 1e-6**2

    points = jax.vmap(image_of, (None, None, 0, 0, 0))
    return jax.vmap(points, (0, 0, None, None, None))(matrices, position, *targets.T)


def _format_limits(
    camera: Camera, image_format: tuple[float, float] | None
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Lowest and highest image coordinates, in the unit and axes of the camera's model."""
    model = get_model(camera.model)
    size = image_format
    if size is None and camera.image_size is not None:
        if model.unit == "px":
            size = camera.image_size
        elif camera.pixel_size is not None:
            size = np.array(camera.image_size) * camera.pixel_size
    if size is None:
        return np.full(2, -np.inf), np.full(2, np.inf)
    size = numeric_array("image_format", size, "(width, height)").astype(float)
    if size.shape != (2,) or not (np.isfinite(size) & (size > 0)).all():
        raise InputError(f"image_format is {size}; expected (width, height), both positive")
    if model.axes == "down":
        return np.full(2, -0.5), size - 0.5
    return -size / 2, size / 2
