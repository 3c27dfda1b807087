"""The adjusted views of a rig as a network: to adjust it again, and to compare halves of it
(`jaxbundle.replicate`).

A photograph of camera k at the epoch e has the orientation

    M = R_k·M_e,        X0 = X0_e + M_eᵀ·b_k
"""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.geometry.rotations import omega_phi_kappa_from_matrix
from jaxbundle.network.build import make_network
from jaxbundle.network.tables import EXTERIOR, STATED, UNIT, Camera, Network
from jaxbundle.types import not_none

if TYPE_CHECKING:
    from jaxbundle.calibration.rig.result import RigCalibration


def network_of_views(calibration: "RigCalibration") -> Network | None:
    """The photographs of all cameras, tied by mountings (table `rigs`), with the image points that
    were used; None where a network has no words for the rig: several boards, something known of
    the mountings, or cameras that are not synchronised."""
    rig = calibration.rig
    if len(rig.boards) > 1 or rig.trajectory or rig.known.mountings or rig.known.bases:
        return None
    is_used = calibration.used
    views, image = np.unique(
        np.stack([rig.camera, rig.epoch], 1)[is_used], axis=0, return_inverse=True
    )
    mounting, pose = calibration.values("mounting"), calibration.values("epoch")
    R, M = (
        np.array([np.asarray(matrix_from_quaternion(q)) for q in rows.rotation])
        for rows in (mounting, pose)
    )
    # The rig has its points relative to the centroid of the board.
    centroid = not_none(rig.centroids)[0]
    position = [centroid + pose.position[e] + M[e].T @ mounting.position[k] for k, e in views]
    angles = [np.asarray(omega_phi_kappa_from_matrix(R[k] @ M[e])) for k, e in views]
    ids = [f"{calibration.names[k]} {rig.epochs[e]}" for k, e in views]
    seen_points, point = np.unique(rig.point[is_used], return_inverse=True)
    role = "tie" if rig.points_free else "fixed" if rig.point_sigma is None else "control"
    points = {"id": [rig.ids[p] for p in seen_points], "role": [role] * len(seen_points)}
    points |= dict(zip("XYZ", calibration.board[seen_points].T))
    if rig.point_sigma is not None:
        given_points = rig.points[seen_points] + centroid
        points |= dict(zip("XYZ", given_points.T)) | {
            f"s{a}": [rig.point_sigma] * len(seen_points) for a in "XYZ"
        }
    names = [calibration.names[k] for k, _ in views]
    epochs = [rig.epochs[e] for _, e in views]
    origins = {camera.adjustment.sigma_origin for camera in calibration.cameras.values()}
    return make_network(
        [_camera(calibration, name) for name in calibration.names],
        {"id": ids, "camera": names, **dict(zip(EXTERIOR, np.hstack([position, angles]).T))},
        points,
        {
            "image": [ids[i] for i in image.ravel()],
            "point": [rig.ids[p] for p in seen_points[point]],
            **dict(zip(("x", "y", "sx", "sy"), np.hstack([rig.xy, rig.sigma])[is_used].T)),
        },
        datum="inner",
        residuals="measured",
        image_unit=calibration.image_unit,
        object_unit=calibration.object_unit,
        sigma_origin=STATED if origins == {STATED} else UNIT,
        name="rig",
        rigs={"rig": ["rig"] * len(ids), "epoch": epochs, "image": ids},
        rig={"reference": calibration.names[0]},
    )


def _camera(calibration: "RigCalibration", name: str) -> Camera:
    """A camera with its adjusted values and the free parameters of the rig."""
    free = calibration.rig.cameras[calibration.names.index(name)].free
    return dataclasses.replace(calibration.camera(name), id=name, free=free)
