"""The observations and start values of a refinement; unusable input is reported before."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbundle import cameras
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.geometry.vectors import rotate
from jaxbundle.leastsquares.indexing.indices import fill_up
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.tables import Network, Observations
from jaxbundle.orientation.intersection import intersection
from jaxbundle.orientation.status import Status
from jaxbundle.pushbroom.image import PushbroomImage, pose_at
from jaxbundle.refinement.inputs import Rays, RefinementInput
from jaxbundle.refinement.rpc_points import lines_of_sight
from jaxbundle.refinement.spline import MIN_INTERVALS
from jaxbundle.refinement.tables import (
    AnyScannerImage,
    GroundPoints,
    ScannerImage,
    check_images,
    check_observations,
    check_points_table,
)
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray


def choose_rays(
    points: GroundPoints, observations: Observations, frames: Network | None
) -> tuple[Rays, Rays, list[str]]:
    """The rays of the adjustment and those of check points; warnings about exclusions."""
    at = {id: k for k, id in enumerate(points.id)}
    row = np.array([] if frames is None else [at[id] for id in frames.points.id], int)
    frame_point = row[frames.observations.point] if frames is not None else row
    number = np.bincount(observations.point, minlength=len(points))
    number += np.bincount(frame_point, minlength=len(points))
    role = np.array(points.role, dtype=object)
    # Two equations for three coordinates: such a point would be undetermined.
    lone = (role == "tie") & (number == 1)
    warnings = []
    if lone.any():
        warnings.append(
            f"tie points measured once are left out: {list_some(np.array(points.id)[lone])}"
        )
    used = (role != "check") & (number > 0) & ~lone
    check = (role == "check") & (number > 0)
    if not used.any():
        raise InputError(
            f"{points.source.name}: no control or tie point is measured; compare the ids of points "
            "and observations"
        )
    if frames is not None and (lost := ~used[row[frames.distances.points]].all(1)).any():
        warnings.append(f"left out {count(lost.sum(), 'distance')} to an excluded point")

    def rays_to(mask: Bool[np.ndarray, " points"]) -> Rays:
        return Rays(
            np.flatnonzero(mask[observations.point]),
            np.flatnonzero(mask[frame_point]),
            np.flatnonzero(mask),
        )

    return rays_to(used), rays_to(check), warnings


def start_points(inputs: RefinementInput, rays: Rays) -> Float[np.ndarray, "points 3"]:
    """Given coordinates, or the intersection of the rays of a tie point."""
    points, chosen = inputs.points, rays.points
    X = points.X[chosen].copy()
    wanted = np.any(np.isnan(X), axis=1)
    if not wanted.any():
        return X
    centre, direction, point = (np.concatenate(x) for x in zip(*_sights(inputs, rays)))
    at = np.searchsorted(chosen, point)
    # The rays sorted by their points, without those of points whose coordinates are given.
    order = np.argsort(at, kind="stable")
    order = order[wanted[at[order]]]
    rows, first, number = np.unique(at[order], return_index=True, return_counts=True)
    # As many rays for every point as for the one with the most, the last repeated with weight 0:
    # one batch instead of a loop over points.
    place = np.minimum(np.arange(number.max()), number[:, None] - 1)
    weight = (np.arange(number.max()) < number[:, None]).astype(float)
    mine = order[first[:, None] + place]
    met = _meet(centre[mine], direction[mine], weight)
    X[rows] = met.X
    lost = (np.asarray(met.status) != Status.SOUND) | ~np.isfinite(X[rows]).all(1)
    if lost.any():
        p = int(chosen[rows[lost.argmax()]])
        status = Status(int(met.status[lost.argmax()]))
        raise InputError(
            f"{points.source(p)}: the rays of tie point {points.id[p]!r} do not meet "
            f"({status.name.lower().replace('_', ' ')}); give approximate coordinates, or measure "
            "it in an image from elsewhere"
        )
    return X


_meet = compile_once(jax.vmap(intersection), ())


def _sights(inputs: RefinementInput, rays: Rays) -> Iterator[tuple[np.ndarray, ...]]:
    """Origins, directions and points of the rays; image by image."""
    observations, frames = inputs.observations, inputs.frames
    image = observations.image[rays.scanner]
    for i, one in enumerate(inputs.rigorous):
        rows = rays.scanner[image == i]
        if len(rows):
            found = _scanner_sights(one.image, observations.xy[rows[fill_up(len(rows))]])
            yield *(np.asarray(x)[: len(rows)] for x in found), observations.point[rows]
    first = len(inputs.rigorous)
    rows = rays.scanner[image >= first]
    if len(rows):
        rpcs, of_rpc = [one.image.rpc for one in inputs.rpc], observations.image[rows] - first
        yield *lines_of_sight(rpcs, of_rpc, observations.xy[rows]), observations.point[rows]
    if frames is None:
        return
    for j in range(len(frames.images)):
        rows = rays.frame[frames.observations.image[rays.frame] == j]
        camera = frames.cameras[frames.images.camera[j]]
        model = cameras.get_model(camera.model)
        values = cameras.default_parameters(model) | dict(camera.parameters)
        interior = tuple(values[name] for name in model.parameters)
        M = matrix_from_omega_phi_kappa(jnp.asarray(frames.images.angles[j]))
        ray = lambda xy, m=model, p=interior, M=M: M.T @ jnp.stack(cameras.image_ray(m, p, *xy))
        centre = np.tile(frames.images.position[j], (len(rows), 1))
        direction = jax.vmap(ray)(jnp.asarray(frames.observations.xy[rows]))
        yield centre, np.asarray(direction), inputs.frame_point[frames.observations.point[rows]]


@compile_once
def _scanner_sights(
    image: PushbroomImage, places: Float[AnyArray, "n 2"]
) -> tuple[Float[AnyArray, "n 3"], Float[Array, "n 3"]]:
    def sight(place: Float[AnyArray, "2"]) -> tuple[AnyArray, Array]:
        pose = pose_at(image, image.times.time(place[0]))
        return pose.P, jnp.stack(rotate(pose.R, (*image.optics.slopes(place[1]), -1.0)))

    return jax.vmap(sight)(places)


def check_input(
    images: list[AnyScannerImage],
    points: GroundPoints,
    observations: Observations,
    frames: Network | None,
) -> None:
    """Checks before any computation."""
    check_images(images)
    if frames is not None:
        table = frames.images
        lacking = ~np.isfinite(np.c_[table.position, table.angles]).all(1)
        if lacking.any():
            row = int(lacking.argmax())
            raise InputError(
                f"{table.source(row)}: photograph {table.id[row]!r} has no start values; give "
                "X0, Y0, Z0, omega, phi, kappa, or find them by `jaxbundle orient`"
            )
    check_points_table(points)
    check_observations(images, points, observations)
    for i, one in enumerate(images):
        if isinstance(one, ScannerImage):
            _check_knots(one, int((observations.image == i).sum()))


def _check_knots(one: ScannerImage, measured: int) -> None:
    """Refuse a jitter with more knots than its points can determine."""
    free = np.isinf(one.freedom.jitter).any()
    if not any(one.freedom.jitter):
        return
    span = float(one.image.times.time(float(one.image.lines)) - one.image.times.time(0.0))
    # Free coefficients need a measured point each. With a prior they are always determined, but ten
    # for each point already repeat their prior; more only take time.
    most = max(measured if free else 10 * measured, MIN_INTERVALS)
    knots = span / one.freedom.knot_spacing
    if knots > most + 1:
        raise InputError(
            f"image {one.id!r}: knot_spacing = {one.freedom.knot_spacing:g} s makes {knots:.0f} "
            f"knots in {span:.4g} s, with {measured} measured points; give {span / most:.3g} s at "
            f"least{', or the jitter a prior σ' if free else ''}"
        )
