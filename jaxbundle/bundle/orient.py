"""`orient`: start values, with adjustments on the way; `screen`: what contradicts them."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from jaxbundle.adjustment.problem import make_problem
from jaxbundle.bundle.minimum import minimise
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.float64 import require_x64
from jaxbundle.network.check import check_network
from jaxbundle.network.sightings import keep_images, keep_points
from jaxbundle.network.tables import Camera, Distances, Network
from jaxbundle.orientation import many
from jaxbundle.orientation.growth import Model, misclosures
from jaxbundle.orientation.network import Oriented, find_start_values
from jaxbundle.orientation.sights import TOLERANCE, Sights

STEPS = 12
"""Iterations of an adjustment on the way: drift is what it takes away, and that goes first."""


def orient(network: Network, tolerance: float = TOLERANCE) -> Oriented:
    """Find the start values a network lacks; those it has stay.

    The principal distance of a camera should be right to some per cent; its distortion may be
    unknown, and some measurements wrong. Large networks are adjusted on the way, whenever they have
    become two and a half times as large.

    **Arguments:** `tolerance`: how far image points may miss, in parts of the extent of a picture;
    as far as the distortion of a lens goes that is not known at all, if it is not given.

    **Returns:** the network with start values; images and points that could not be placed, and
    image points that contradict everything else, are left out of it and named with the reason.

    **Raises:** `InputError` for bad tables; `NotSolvedError` where no image could be placed.
    """
    require_x64()
    return find_start_values(network, _adjusted, tolerance)


def orient_again(given: Network, placed: Network, better: Mapping[str, Camera]) -> Network:
    """The given network with start values found with better cameras, if that places more of its
    image points than are in `placed`; its cameras stay the given ones."""
    try:
        cameras = tuple(better.get(camera.id, camera) for camera in given.cameras)
        found = orient(given.replace(cameras=cameras)).network
    except (InputError, NotSolvedError):
        return placed
    more = len(found.observations) > len(placed.observations)
    return found.replace(cameras=given.cameras) if more else placed


def screen(network: Network) -> Network:
    """The network without the image points that contradict its start values altogether, and with
    tie points intersected anew; it warns of what it left out."""
    tie = network.points.has_role("tie")[:, None]
    position = np.where(tie, np.nan, network.points.position)
    points = dataclasses.replace(network.points, position=position)
    return find_start_values(network.replace(points=points)).network


def _adjusted(network: Network, sights: Sights, model: Model) -> None:
    """A model adjusted in place with the interior orientation held, by the rays that agree."""
    agree = misclosures(sights, model) < sights.tolerance[sights.image]
    rays = np.bincount(sights.point[agree], minlength=sights.points)
    use = model.known & (rays >= 2)
    try:
        part = check_network(_part(network, model, use, sights.row[agree & use[sights.point]]))
        problem = make_problem(part)
        values = minimise(problem, problem.data.start, max_steps=STEPS).values
    except (InputError, NotSolvedError):
        return
    X0, X = np.asarray(values.position), np.asarray(values.point)
    if not (np.isfinite(X0).all() and np.isfinite(X).all()):
        return
    images = [network.images.id.index(id) for id in part.images.id]
    index = {id: k for k, id in enumerate(network.points.id)}
    points = np.array([index[id] for id in problem.network.points.id])
    model.X0[images] = X0 + problem.origin
    model.M[images] = many.matrices_of_quaternions(np.asarray(values.rotation))
    model.X[points] = X + problem.origin


def _part(network: Network, model: Model, use, rows) -> Network:
    """The placed images and the points in `use`, without priors, control held."""
    images, points = network.images, network.points
    angles = np.full((len(images), 3), np.nan)
    angles[model.placed] = many.angles(model.M[model.placed])
    held = model.held & use
    roles = tuple("fixed" if h else "tie" for h in held)
    cameras = tuple(dataclasses.replace(c, free=(), sigma={}) for c in network.cameras)
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
        datum="control" if held.sum() >= 3 else "inner",
        datum_points=(),
        warnings=(),
    )
    return keep_points(keep_images(part, model.placed), use)
