"""The adjusted network as a project: what other programs are given of a result."""

import dataclasses

import numpy as np

from jaxbundle.cameras import get_model
from jaxbundle.network.sightings import keep_points
from jaxbundle.network.tables import Images, Network, Observations, Points


def adjusted_network(adjustment) -> Network:
    """The network of a solved `Adjustment` at its solution.

    Cameras, orientations and points have their adjusted values; observations that data snooping has
    removed are gone. Control points with σ are tie points here; priors and observations of further
    kinds are dropped: what they said has been used, and around the adjusted values they would say
    it twice. Only the priors that a camera model needs, as a grid of splines, stay: without them it
    has no solution. So the datum is inner; adjusted again, the network stays as it is. σ of image
    coordinates are those given, also where variance components were estimated. Check points are
    not in it, nor are points at infinity, which have no coordinates.
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
