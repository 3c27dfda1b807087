"""From tables to the arrays of an adjustment; what cannot be used is said before."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxbundle import cameras
from jaxbundle.errors import InputError
from jaxbundle.geometry import (
    matrix_from_omega_phi_kappa,
    matrix_from_quaternion,
    quaternion_from_matrix,
)
from jaxbundle.geometry.vectors import turned
from jaxbundle.network.columns import some
from jaxbundle.network.tables import EXTERIOR, Network, Observations
from jaxbundle.orientation.intersection import intersection
from jaxbundle.orientation.status import Status
from jaxbundle.pushbroom.image import pose_at
from jaxbundle.refinement.equations import (
    FrameRays,
    ScannerRays,
    System,
    compiled_image_residuals,
    compiled_rescaled,
)
from jaxbundle.refinement.freedom import Form, Name, make_form, names, of_sensor, priors
from jaxbundle.refinement.spline import FEWEST
from jaxbundle.refinement.tables import (
    GroundPoints,
    ScannerImage,
    check_observations,
    check_points_table,
)

KNOTS = 10
"""Knots of jitter with a prior, for each measured point: what is between points only costs."""
FAR = 2.0
"""A control point farther from its measurement than this many images is in another place."""


@dataclasses.dataclass(frozen=True)
class Columns:
    """The shared unknowns: names, σ of their priors (inf: none), where each image has them.

    `frames`: those of the photographs; `forms` of the scanner images.
    """

    names: list[Name]
    sigma: Float[np.ndarray, " m"]
    scanners: list[Int[np.ndarray, " n"]]
    forms: list[Form]
    frames: list[Int[np.ndarray, " n"]]


@dataclasses.dataclass(frozen=True)
class Rays:
    """Which measurements an adjustment uses: rows of the two tables, and the points of them."""

    scanner: Int[np.ndarray, " rows"]
    frame: Int[np.ndarray, " rows"]
    points: Int[np.ndarray, " points"]


def make_columns(images: list[ScannerImage], frames: Network | None) -> Columns:
    """The shared unknowns of all images; what is held has no column."""
    found, sigma, of_images, forms, sensors = [], [], [], [], {}
    for one in images:
        form = make_form(one.image, one.earth, one.freedom)
        sensor = one.sensor or one.id
        own, s = names(form, one.id, sensor), priors(form, one.freedom)
        column, shared = np.full(len(own), -1), of_sensor(form)
        for k in range(len(own)):
            key = (own[k].owner, own[k].parameter)
            if shared[k] and key in sensors:
                column[k] = sensors[key]
            elif s[k] > 0:
                column[k] = len(found)
                found.append(own[k])
                sigma.append(s[k])
            if shared[k]:
                sensors[key] = column[k]
        of_images.append(column)
        forms.append(form)
    of_frames = [] if frames is None else _frame_columns(frames, found, sigma)
    m = len(found)
    free = lambda columns: [np.where(c < 0, m, c) for c in columns]
    if not m:
        raise InputError(
            "refine: every unknown is held; free some, such as attitude = \"free\" in [unknowns]"
        )
    return Columns(found, np.array(sigma), free(of_images), forms, free(of_frames))


def _frame_columns(network, found, sigma):
    """Columns of the photographs; their exterior priors are rows of their own."""
    columns = []
    arcsec = math.degrees(1) * 3600
    words = dict(zip(EXTERIOR[:3], ("X0", "Y0", "Z0")))
    interior = {}
    for i, id in enumerate(network.images.id):
        camera = network.cameras[network.images.camera[i]]
        parameters = cameras.get_model(camera.model).parameters
        column = np.full(6 + len(parameters), -1)
        for k, parameter in enumerate(EXTERIOR):
            if network.images.sigma[i, k] == 0:
                continue
            column[k] = len(found)
            unit, factor = ("m", 1.0) if k < 3 else ("arcsec", arcsec)
            word = words.get(parameter, parameter)
            found.append(Name(f"photograph {id}", word, unit, factor, word))
            sigma.append(math.inf)
        for k, parameter in enumerate(parameters):
            if parameter not in camera.free:
                continue
            if (camera.id, parameter) not in interior:
                interior[camera.id, parameter] = len(found)
                found.append(Name(f"camera {camera.id}", parameter, "", 1.0, parameter))
                sigma.append(camera.sigma.get(parameter, math.inf))
            column[6 + k] = interior[camera.id, parameter]
        columns.append(column)
    return columns


def choose_rays(
    points: GroundPoints, observations: Observations, frames: Network | None
) -> tuple[Rays, Rays, list[str]]:
    """The rays of the adjustment and those of check points; warnings about what is left out."""
    theirs, frame_point = _frame_points(points, frames)
    number = np.bincount(observations.point, minlength=len(points))
    number += np.bincount(frame_point, minlength=len(points))
    role = np.array(points.role, dtype=object)
    lone = (role == "tie") & (number == 1)
    warnings = []
    if lone.any():
        warnings.append(
            f"tie points measured once are left out: {some(np.array(points.id)[lone])}"
        )
    used = (role != "check") & (number > 0) & ~lone
    check = (role == "check") & (number > 0)
    if not used.any():
        raise InputError(
            f"{points.source.name}: no control or tie point is measured; compare the ids of points "
            "and observations"
        )

    def rays(mask):
        return Rays(np.flatnonzero(mask[observations.point]), theirs[mask[frame_point]],
                    np.flatnonzero(mask))  # fmt: skip

    return rays(used), rays(check), warnings


def _frame_points(points, frames):
    """Rows of the frame observations, and the point of each."""
    if frames is None:
        return np.zeros(0, int), np.zeros(0, int)
    at = {id: k for k, id in enumerate(points.id)}
    row = np.array([at[id] for id in frames.points.id], int)
    return np.arange(len(frames.observations)), row[frames.observations.point]


def make_system(
    images: list[ScannerImage],
    points: GroundPoints,
    observations: Observations,
    frames: Network | None,
    columns: Columns,
    rays: Rays,
) -> System:
    """The arrays of an adjustment with the rays given; control as their roles say."""
    index = np.full(len(points), -1)
    index[rays.points] = np.arange(len(rays.points))
    scanners = []
    for i, one in enumerate(images):
        rows = rays.scanner[observations.image[rays.scanner] == i]
        scanners.append(ScannerRays(
            one.image, jnp.asarray(columns.scanners[i]), jnp.asarray(observations.xy[rows]),
            jnp.asarray(index[observations.point[rows]]), jnp.asarray(1 / observations.sigma[rows]),
            jnp.tile(jnp.eye(2), (len(rows), 1, 1)), columns.forms[i], one.earth,
        ))  # fmt: skip
    photographs = [] if frames is None else _photographs(points, frames, columns, rays, index)
    chosen = rays.points
    control = np.array([points.role[k] == "control" for k in chosen])[:, None]
    sigma = np.nan_to_num(points.sigma[chosen], nan=0.0, posinf=np.inf)
    X = _start(tuple(scanners), tuple(photographs), points, chosen)
    held = control & (sigma == 0)
    weight = np.where(control & ~held, 1 / np.where(sigma > 0, sigma, 1.0), 0.0)
    system = System(
        tuple(scanners), tuple(photographs), jnp.asarray(X), jnp.asarray(points.axes[chosen]),
        jnp.asarray(np.where(held, 0.0, 1.0)), jnp.zeros(X.shape), jnp.asarray(weight),
        jnp.asarray(1 / columns.sigma),
    )  # fmt: skip
    return compiled_rescaled(system, system.start())


def _photographs(points, network, columns, rays, index):
    rows_of, point_of = _frame_points(points, network)
    found = []
    for i in range(len(network.images)):
        rows = rays.frame[network.observations.image[rays.frame] == i]
        camera = network.cameras[network.images.camera[i]]
        model = cameras.get_model(camera.model)
        values = cameras.default_parameters(model) | dict(camera.parameters)
        angles, sigma = network.images.angles[i], network.images.sigma[i]
        prior = np.where((sigma > 0) & np.isfinite(sigma), 1 / np.where(sigma > 0, sigma, 1), 0.0)
        found.append(FrameRays(
            jnp.asarray(network.images.position[i]),
            quaternion_from_matrix(matrix_from_omega_phi_kappa(jnp.asarray(angles))),
            jnp.asarray([values[name] for name in model.parameters]),
            jnp.asarray(columns.frames[i]), jnp.asarray(network.observations.xy[rows]),
            jnp.asarray(index[point_of[rows]]), jnp.asarray(1 / network.observations.sigma[rows]),
            jnp.asarray(np.r_[network.images.position[i], angles]), jnp.asarray(prior),
            camera.model, network.residuals,
        ))  # fmt: skip
    return found


def _start(scanners, photographs, points, chosen):
    """Coordinates as given, or where the rays of a tie point meet."""
    X = points.X[chosen].copy()
    wanted = np.isnan(X).any(1)
    if not wanted.any():
        return X
    found = {int(p): [] for p in np.flatnonzero(wanted)}
    for rays in (*scanners, *photographs):
        if len(rays.point) and wanted[np.asarray(rays.point)].any():
            sights = _sights if isinstance(rays, ScannerRays) else _frame_sights
            for p, *sight in zip(np.asarray(rays.point), *map(np.asarray, sights(rays))):
                if wanted[p]:
                    found[p].append(sight)
    most = max(map(len, found.values()))
    table = np.zeros((len(found), most, 7))
    table[..., 5] = 1.0
    for row, sight in enumerate(found.values()):
        table[row, : len(sight), :6] = np.reshape(sight, (len(sight), 6))
        table[row, : len(sight), 6] = 1.0
        table[row, len(sight) :, :3] = sight[0][0]
    met = jax.jit(jax.vmap(intersection))(table[..., :3], table[..., 3:6], table[..., 6])
    for row, p in enumerate(found):
        status = int(met.status[row])
        if status != Status.SOUND or not np.isfinite(met.X[row]).all():
            raise InputError(
                f"{points.source(chosen[p])}: the rays of tie point {points.id[chosen[p]]!r} do "
                f"not meet ({Status(status).name.lower().replace('_', ' ')}); give approximate "
                "coordinates, or measure it in an image from elsewhere"
            )
        X[p] = met.X[row]
    return X


@eqx.filter_jit
def _sights(rays):
    def one(place):
        pose = pose_at(rays.image, rays.image.times.time(place[0]))
        return pose.P, jnp.stack(turned(pose.R, (*rays.image.optics.slopes(place[1]), -1.0)))

    return jax.vmap(one)(rays.place)


def _frame_sights(rays):
    model, M = cameras.get_model(rays.model), matrix_from_quaternion(rays.rotation)
    one = lambda xy: M.T @ jnp.stack(cameras.image_ray(model, tuple(rays.interior), *xy))
    return jnp.tile(rays.position, (len(rays.xy), 1)), jax.vmap(one)(rays.xy)


def check_input(
    images: list[ScannerImage],
    points: GroundPoints,
    observations: Observations,
    frames: Network | None,
) -> None:
    """All that can be refused before anything is computed."""
    if not images:
        raise InputError("refine: no scanner image; photographs alone are adjusted by `adjust`")
    if len({one.id for one in images}) < len(images):
        raise InputError("refine: two scanner images have the same id; give each its own")
    if frames is not None:
        table = frames.images
        lacking = ~np.isfinite(np.c_[table.position, table.angles]).all(1)
        if lacking.any():
            row = int(lacking.argmax())
            raise InputError(
                f"{table.source(row)}: photograph {table.id[row]!r} has no start values; give "
                "X0, Y0, Z0, omega, phi, kappa, or find them by `jaxbundle orient`"
            )
    for one in images:
        if one.freedom.knot_spacing <= 0:
            raise InputError(f"image {one.id!r}: knot_spacing must be positive, in seconds")
    check_points_table(points)
    check_observations(images, points, observations)
    for i, one in enumerate(images):
        _check_knots(one, int((observations.image == i).sum()))


def _check_knots(one: ScannerImage, measured: int) -> None:
    """Refuse a jitter with more knots than its points could tell of."""
    free = np.isinf(one.freedom.jitter).any()
    if not any(one.freedom.jitter):
        return
    span = float(one.image.times.time(float(one.image.lines)) - one.image.times.time(0.0))
    most = max(measured if free else KNOTS * measured, FEWEST)
    knots = span / one.freedom.knot_spacing
    if knots > most + 1:
        raise InputError(
            f"image {one.id!r}: knot_spacing = {one.freedom.knot_spacing:g} s makes {knots:.0f} "
            f"knots in {span:.4g} s, with {measured} measured points; give {span / most:.3g} s at "
            f"least{', or the jitter a prior σ' if free else ''}"
        )


def check_near(
    system: System, images: list[ScannerImage], points: GroundPoints, observations: Observations,
    rays: Rays,
) -> None:  # fmt: skip
    """Refuse control points that lie far from where they are measured: swapped or in error."""
    v = compiled_image_residuals(system, system.start())
    for i, one in enumerate(images):
        rows = rays.scanner[observations.image[rays.scanner] == i]
        size = np.array([one.image.lines, one.image.pixels])
        far = ~(np.abs(np.asarray(v[i])) <= FAR * size)
        if far.any():
            k = int(far.any(1).argmax())
            p, away = observations.point[rows[k]], np.asarray(v[i])[k]
            said = (
                f"{away[0]:.0f} lines and {away[1]:.0f} pixels away" if np.isfinite(away).all()
                else "where the camera does not look"
            )
            raise InputError(
                f"{observations.source(rows[k])}: {points.role[p]} point {points.id[p]!r} of "
                f"{points.source(p)} is off image {one.id!r}: its coordinates are {said}; look at "
                "their order, frame and units, and at the id"
            )
