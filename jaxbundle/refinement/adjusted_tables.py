"""Points and photographs of a refinement at the solution: tables and networks."""

import dataclasses

import jax
import numpy as np

from jaxbundle import cameras
from jaxbundle.geometry import matrix_from_quaternion, omega_phi_kappa_from_matrix
from jaxbundle.network.tables import Images, Network
from jaxbundle.refinement.inputs import PHOTOGRAPH
from jaxbundle.refinement.refining import Refinement

COLUMNS = ("id", "role", "X", "Y", "Z", "sX", "sY", "sZ")


def point_rows(result: Refinement) -> list[dict]:
    """Adjusted points of a `Refinement`: id, role, X, Y, Z and σ of them, metres, in `COLUMNS`."""
    inspection, chosen_points = result.inspection, result.inspection.declared.rays.points
    axes = result.points.axes[chosen_points]
    # The engine's cofactors are along the axes of each point: Σ = σ0²·Aᵀ·Q·A in X, Y, Z.
    covariance = inspection.sigma0**2 * axes.transpose(0, 2, 1) @ inspection.point_cofactor @ axes
    sigma = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    names = [(result.points.id[k], result.points.role[k]) for k in chosen_points]
    return [
        dict(zip(COLUMNS, (*name, *X, *s)))
        for name, X, s in zip(names, result.positions.tolist(), sigma.tolist())
    ]


def adjusted_photographs(result: Refinement) -> Network | None:
    """The network of the photographs of a `Refinement` at its solution; None without any.

    Cameras, orientations and points have their adjusted values, without measurements removed by
    snooping. Control points become tie points, and priors are dropped, since they would count twice
    in a new adjustment. Held orientations stay held.
    """
    network = result.frames
    if network is None:
        return None
    inspection, declared = result.inspection, result.inspection.declared
    poses = inspection.solution.values["image"]
    angles = jax.vmap(lambda q: omega_phi_kappa_from_matrix(matrix_from_quaternion(q)))
    parameters = {camera.id: dict(camera.parameters) for camera in network.cameras}
    for camera in network.cameras:
        if camera.id in declared.cameras:
            table, row = declared.cameras[camera.id]
            values = np.asarray(inspection.solution.values[table])[row].tolist()
            interior = dict(zip(cameras.get_model(camera.model).parameters, values))
            parameters[camera.id] |= {k: v for k, v in interior.items() if k in camera.free}
    is_kept = np.zeros(len(network.observations), bool)
    for part in declared.parts:
        if part.table == PHOTOGRAPH:
            # A point whose two coordinates were both removed by snooping is left out.
            is_kept[part.rows] = inspection.has_weight[part.set].any(1)
    adjusted = dict(zip(result.point_ids, result.positions))
    points = network.points
    X = np.array([adjusted.get(id, X) for id, X in zip(points.id, points.position)]).reshape(-1, 3)
    roles = tuple("tie" if role == "control" else role for role in points.role)
    is_held = network.images.sigma == 0
    return network.replace(
        cameras=tuple(
            dataclasses.replace(camera, parameters=parameters[camera.id], sigma={}, observed={})
            for camera in network.cameras
        ),
        images=Images(
            network.images.id,
            network.images.camera,
            np.asarray(poses.position) + declared.inputs.origin,
            np.asarray(angles(poses.rotation)),
            np.where(is_held, 0.0, np.nan),
            network.images.source,
        ),
        points=dataclasses.replace(
            points, role=roles, position=X, sigma=np.full_like(points.sigma, np.nan)
        ),
        observations=network.observations.take(is_kept),
        datum="inner",
        datum_points=(),
        warnings=("refined with scanner images",),
    )
