"""The adjusted network as a project, for other programs."""

import dataclasses

import numpy as np

from jaxbundle.cameras import get_model
from jaxbundle.network.sightings import keep_points
from jaxbundle.network.tables import Images, Network, Observations, Points


def adjusted_network(adjustment) -> Network:
    """The network of a solved `Adjustment` at its solution.

    Cameras, orientations and points have their adjusted values; observations removed by data
    snooping are left out. Control points with σ are tie points here; priors and observations of
    further kinds are dropped: their information is already in the adjusted values and would count
    twice. Only priors required by a camera model, such as a grid of splines, stay: without them it
    has no solution. So the datum is inner; a second adjustment changes nothing. σ of image
    coordinates are the given ones, even if variance components were estimated. Check points are
    left out, and so are points without coordinates: at infinity, or excluded by data snooping.
    """
    problem = adjustment.problem
    network = problem.network
    values = adjustment.image_values
    images, points, rays = network.images, network.points, network.observations
    gone = {(name.id, name.parameter) for name in adjustment.eliminated}
    cameras = tuple(
        dataclasses.replace(
            camera, parameters=adjustment.camera_parameters(camera.id),
            sigma=camera.sigma if get_model(camera.model).prior else {},
            free=tuple(name for name in camera.unknowns if (camera.id, name) not in gone),
        )
        for camera in network.cameras
    )  # fmt: skip
    used = (np.asarray(problem.data.image_weight) > 0).any(1)
    roles = tuple("tie" if role == "control" else role for role in points.role)
    adjusted = network.replace(
        cameras=cameras,
        images=Images(images.id, images.camera, values[:, :3], values[:, 3:],
                      np.full_like(images.sigma, np.nan), images.source),
        points=Points(points.id, roles, adjustment.point_values,
                      np.full_like(points.sigma, np.nan), points.source),
        observations=Observations(rays.image, rays.point, rays.xy, rays.sigma,
                                  rays.source).take(used),
        datum="inner", datum_points=(), further=(), warnings=("the adjusted network",),
    )  # fmt: skip
    return keep_points(adjusted, np.isfinite(adjustment.point_values).all(1))
