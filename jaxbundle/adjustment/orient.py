"""`orient`: start values with intermediate adjustments; `screen`: observations that contradict
them."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int

from jaxbundle.adjustment.problem import coordinates, make_problem
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.float64 import require_x64
from jaxbundle.io.formats import as_network
from jaxbundle.leastsquares.solution import find_minimum
from jaxbundle.network.check import check_network
from jaxbundle.network.subsets import keep_images, keep_points
from jaxbundle.network.tables import Camera, Distances, Network
from jaxbundle.orientation import batched
from jaxbundle.orientation.incremental import Model, misclosures
from jaxbundle.orientation.network import Oriented, find_start_values
from jaxbundle.orientation.rays import TOLERANCE, Sights


def orient(
    network: Network | str | Path,
    *,
    format: str | None = None,
    overrides: Sequence[str] = (),
    control: str | Path | None = None,
    tolerance: float = TOLERANCE,
) -> Oriented:
    """Compute missing start values of a network; given ones are kept.

    The principal distance of a camera should be correct to a few per cent; its distortion may be
    unknown, and some measurements wrong. Large networks are adjusted whenever they have grown by a
    factor of two and a half.

    **Arguments:**

    - `network`: a network, or the path of one, which is read with `format`, `overrides` (`--set`)
      and `control` (`jaxbundle.read_network`).
    - `tolerance`: largest residual of image points, relative to the image extent; the default
      allows for a completely unknown distortion.

    **Returns:** the network with start values. Images and points that could not be oriented, and
    image points that contradict all others, are excluded and listed with the reason.

    **Raises:** `InputError` for bad tables; `NotSolvedError` if no image could be oriented.
    """
    require_x64()
    network_as_given = as_network(network, format=format, overrides=overrides, control=control)
    return find_start_values(network_as_given, _adjust, tolerance)


def orient_again(
    network_as_given: Network, placed: Network, better: Mapping[str, Camera]
) -> Network:
    """The given network with start values computed with better cameras, if this uses more image
    points than `placed`; the cameras of the network are kept."""
    try:
        cameras = tuple(better.get(camera.id, camera) for camera in network_as_given.cameras)
        reoriented = orient(network_as_given.replace(cameras=cameras)).network
    except (InputError, NotSolvedError):
        return placed
    uses_more = len(reoriented.observations) > len(placed.observations)
    return reoriented.replace(cameras=network_as_given.cameras) if uses_more else placed


def screen(network: Network) -> Network:
    """The network without image points that grossly contradict its start values, and with tie
    points intersected again; it warns of what it removed."""
    tie = network.points.has_role("tie")[:, None]
    position = np.where(tie, np.nan, network.points.position)
    points = dataclasses.replace(network.points, position=position)
    return find_start_values(network.replace(points=points)).network


def _adjust(network: Network, sights: Sights, model: Model) -> None:
    """Adjust a model in place with held interior orientation, using the rays that agree."""
    # Everything is held that is not known from the rays alone: cameras may be rough, and priors
    # would pull a part that has its own scale and orientation yet.
    agree = misclosures(sights, model) < sights.tolerance[sights.image]
    rays = np.bincount(sights.point[agree], minlength=sights.points)
    use = model.known & (rays >= 2)
    try:
        part = check_network(_part(network, model, use, sights.row[agree & use[sights.point]]))
        problem = make_problem(part)
        # Twelve iterations: it only has to remove the drift of a growing network, which the first
        # steps do. Its minimum to the last digit would be that of a part with held cameras.
        values = find_minimum(problem, max_steps=12).values
    except (InputError, NotSolvedError):
        return
    X0, rotation = map(np.asarray, values["image"])
    X = np.asarray(coordinates(values))
    if not (np.isfinite(X0).all() and np.isfinite(X).all()):
        return
    images = [network.images.id.index(id) for id in part.images.id]
    index = {id: k for k, id in enumerate(network.points.id)}
    points = np.array([index[id] for id in problem.network.points.id])
    model.X0[images] = X0 + problem.origin
    model.M[images] = batched.matrices_of_quaternions(rotation)
    model.X[points] = X + problem.origin


def _part(
    network: Network, model: Model, use: Bool[np.ndarray, " points"], rows: Int[np.ndarray, " rays"]
) -> Network:
    """The oriented images and the points in `use`, without priors, with control held."""
    images, points = network.images, network.points
    angles = np.full((len(images), 3), np.nan)
    angles[model.placed] = batched.angles(model.M[model.placed])
    is_held = model.control & use
    roles = tuple("fixed" if h else "tie" for h in is_held)
    cameras = tuple(dataclasses.replace(c, free=(), sigma={}, observed={}) for c in network.cameras)
    part = network.replace(
        cameras=cameras,
        images=dataclasses.replace(
            images, position=model.X0, angles=angles, sigma=np.full((len(images), 6), np.nan)
        ),
        points=dataclasses.replace(
            points, position=model.X, role=roles, sigma=np.full((len(points), 3), np.nan)
        ),
        observations=network.observations.take(rows),
        distances=Distances.none(),
        datum="control" if is_held.sum() >= 3 else "inner",
        datum_points=(),
        warnings=(),
    )
    return keep_points(keep_images(part, model.placed), use)
