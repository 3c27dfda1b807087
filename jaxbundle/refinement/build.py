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
    row_of = {id: k for k, id in enumerate(points.id)}
    row = np.array([] if frames is None else [row_of[id] for id in frames.points.id], int)
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
    is_used = (role != "check") & (number > 0) & ~lone
    check = (role == "check") & (number > 0)
    if not is_used.any():
        raise InputError(
            f"{points.source.name}: no control or tie point is measured; compare the ids of points "
            "and observations"
        )
    if frames is not None and (is_lost := ~is_used[row[frames.distances.points]].all(1)).any():
        warnings.append(f"left out {count(is_lost.sum(), 'distance')} to an excluded point")

    def rays_to(mask: Bool[np.ndarray, " points"]) -> Rays:
        return Rays(
            np.flatnonzero(mask[observations.point]),
            np.flatnonzero(mask[frame_point]),
            np.flatnonzero(mask),
        )

    return rays_to(is_used), rays_to(check), warnings


def start_points(inputs: RefinementInput, rays: Rays) -> Float[np.ndarray, "points 3"]:
    """Given coordinates, or the intersection of the rays of a tie point."""
    points, chosen_points = inputs.points, rays.points
    X = points.X[chosen_points].copy()
    is_wanted = np.any(np.isnan(X), axis=1)
    if not is_wanted.any():
        return X
    centre, direction, point = (np.concatenate(x) for x in zip(*_sights(inputs, rays)))
    point_row = np.searchsorted(chosen_points, point)
    # The rays sorted by their points, without those of points whose coordinates are given.
    order = np.argsort(point_row, kind="stable")
    order = order[is_wanted[point_row[order]]]
    rows, begin, number = np.unique(point_row[order], return_index=True, return_counts=True)
    # As many rays for every point as for the one with the most, the last repeated with weight 0:
    # one batch instead of a loop over points.
    place = np.minimum(np.arange(number.max()), number[:, None] - 1)
    weight = (np.arange(number.max()) < number[:, None]).astype(float)
    rays_of_points = order[begin[:, None] + place]
    intersected = _meet(centre[rays_of_points], direction[rays_of_points], weight)
    X[rows] = intersected.X
    is_lost = (np.asarray(intersected.status) != Status.SOUND) | ~np.isfinite(X[rows]).all(1)
    if is_lost.any():
        p = int(chosen_points[rows[is_lost.argmax()]])
        status = Status(int(intersected.status[is_lost.argmax()]))
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
    for i, scanner_image in enumerate(inputs.rigorous):
        rows = rays.scanner[image == i]
        if len(rows):
            sights = _scanner_sights(scanner_image.image, observations.xy[rows[fill_up(len(rows))]])
            yield *(np.asarray(x)[: len(rows)] for x in sights), observations.point[rows]
    first_rpc = len(inputs.rigorous)
    rows = rays.scanner[image >= first_rpc]
    if len(rows):
        rpcs, of_rpc = (
            [scanner_image.image.rpc for scanner_image in inputs.rpc],
            observations.image[rows] - first_rpc,
        )
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
    for i, scanner_image in enumerate(images):
        if isinstance(scanner_image, ScannerImage):
            _check_knots(scanner_image, int((observations.image == i).sum()))


def _check_knots(scanner_image: ScannerImage, measured: int) -> None:
    """Refuse a jitter with more knots than its points can determine."""
    free = np.isinf(scanner_image.freedom.jitter).any()
    if not any(scanner_image.freedom.jitter):
        return
    span = float(
        scanner_image.image.times.time(float(scanner_image.image.lines))
        - scanner_image.image.times.time(0.0)
    )
    # Free coefficients need a measured point each. With a prior they are always determined, but ten
    # for each point already repeat their prior; more only take time.
    max_intervals = max(measured if free else 10 * measured, MIN_INTERVALS)
    knots = span / scanner_image.freedom.knot_spacing
    if knots > max_intervals + 1:
        raise InputError(
            f"image {scanner_image.id!r}: knot_spacing = {scanner_image.freedom.knot_spacing:g} s "
            f"makes {knots:.0f} knots in {span:.4g} s, with {measured} measured points; give "
            f"{span / max_intervals:.3g} s at least{', or the jitter a prior σ' if free else ''}"
        )
