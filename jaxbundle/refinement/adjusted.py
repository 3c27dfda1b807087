"""What a refinement makes of points and photographs: tables and networks at the solution."""

import dataclasses

import numpy as np

from jaxbundle import cameras
from jaxbundle.geometry import (
    matrix_from_quaternion,
    omega_phi_kappa_from_matrix,
    retract_quaternion,
)
from jaxbundle.network.tables import Images, Network, Observations, Points
from jaxbundle.refinement.equations import vector_of

COLUMNS = ("id", "role", "X", "Y", "Z", "sX", "sY", "sZ")


def point_rows(result) -> list[dict]:
    """Adjusted points of a `Refinement`: id, role, X, Y, Z and σ of them, metres, in `COLUMNS`."""
    found = result.inspection
    free, axes = np.asarray(found.system.free), np.asarray(found.system.axes)
    held = free[:, :, None] * free[:, None, :]
    covariance = found.sigma0**2 * axes.transpose(0, 2, 1) @ (found.point_cofactor * held) @ axes
    sigma = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    names = [(result.points.id[k], result.points.role[k]) for k in result.rays.points]
    return [
        dict(zip(COLUMNS, (*name, *X, *s)))
        for name, X, s in zip(names, result.positions.tolist(), sigma.tolist())
    ]


def adjusted_photographs(result) -> Network | None:
    """The network of the photographs of a `Refinement` at its solution; None without any.

    Cameras, orientations and points have their adjusted values, measurements that snooping has
    removed are gone. What was controlled is a tie point, and priors are dropped: adjusted again
    they would say twice what they said. Orientations that were held stay so.
    """
    network = result.frames
    if network is None:
        return None
    found = result.inspection
    position, angles = network.images.position.copy(), network.images.angles.copy()
    parameters = {camera.id: dict(camera.parameters) for camera in network.cameras}
    kept = np.zeros(len(network.observations), bool)
    for i, rays in enumerate(found.system.frames):
        p = np.asarray(vector_of(rays, found.unknowns.shared))
        M = matrix_from_quaternion(retract_quaternion(rays.rotation, p[3:6]))
        position[i] = np.asarray(rays.position) + p[:3]
        angles[i] = np.asarray(omega_phi_kappa_from_matrix(M))
        camera = network.cameras[network.images.camera[i]]
        names = cameras.get_model(camera.model).parameters
        interior = dict(zip(names, (np.asarray(rays.interior) + p[6:]).tolist()))
        parameters[camera.id] |= {k: v for k, v in interior.items() if k in camera.free}
        rows = result.rays.frame[network.observations.image[result.rays.frame] == i]
        kept[rows] = (np.asarray(rays.weight) > 0).any(1)
    adjusted = {
        result.points.id[k]: X for k, X in zip(result.rays.points, result.positions)
    }
    points = network.points
    X = np.array([
        adjusted.get(id, given) for id, given in zip(points.id, points.position)
    ]).reshape(-1, 3)  # fmt: skip
    roles = tuple("tie" if role == "control" else role for role in points.role)
    held = network.images.sigma == 0
    observations = network.observations
    return network.replace(
        cameras=tuple(
            dataclasses.replace(camera, parameters=parameters[camera.id], sigma={})
            for camera in network.cameras
        ),
        images=Images(network.images.id, network.images.camera, position, angles,
                      np.where(held, 0.0, np.nan), network.images.source),
        points=Points(points.id, roles, X, np.full_like(points.sigma, np.nan), points.source),
        observations=Observations(
            observations.image, observations.point, observations.xy, observations.sigma,
            observations.source,
        ).take(kept),
        datum="inner", datum_points=(), warnings=("refined with scanner images",),
    )  # fmt: skip
