"""The reprojection error: distance between projected and measured image points.

    e = |x(X; X0, M, camera) − x measured|        in the measured image; of a point: the mean over
                                                  its image points

as in COLMAP's `ERROR`. In pixels if the cameras have pixels or a pixel size, else in mm.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbundle.cameras import CameraModel, default_parameters, get_model
from jaxbundle.cameras.model import project
from jaxbundle.float64 import local_x64
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.network.tables import Network
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray


def point_errors(network: Network) -> tuple[Float[np.ndarray, " points"], str]:
    """The mean reprojection error of every point, and its unit ("px" or "mm"); NaN without image
    points, coordinates or orientations."""
    rays, cameras = network.observations, network.cameras
    of_ray = network.images.camera[rays.image]
    in_pixels = all(get_model(c.model).unit == "px" or c.pixel_size for c in cameras)
    length = np.full(len(rays), np.nan)
    for name in {camera.model for camera in cameras}:
        model = get_model(name)
        values, pitch = np.zeros((len(cameras), len(model.parameters))), np.ones((len(cameras), 2))
        for c, camera in enumerate(cameras):
            if camera.model == name:
                values[c] = [
                    {**default_parameters(model), **camera.parameters}[p] for p in model.parameters
                ]
                if in_pixels and model.unit == "mm":
                    pitch[c] = camera.pixel_size
        rows = np.flatnonzero(np.array([camera.model == name for camera in cameras])[of_ray])
        difference = (_project(model, network, rows, values) - rays.xy[rows]) / pitch[of_ray[rows]]
        length[rows] = np.linalg.norm(difference, axis=1)
    good = np.isfinite(length)
    number = np.bincount(rays.point[good], minlength=len(network.points))
    total = np.bincount(rays.point[good], length[good], minlength=len(network.points))
    with np.errstate(invalid="ignore"):
        return total / number, "px" if in_pixels else "mm"


def _project(
    model: CameraModel,
    network: Network,
    rows: Int[np.ndarray, " n"],
    values: Float[np.ndarray, "cameras parameters"],
) -> Float[np.ndarray, "n 2"]:
    """The images of the points of some rays, a portion at a time."""
    images, rays = network.images, network.observations
    projected = np.zeros((len(rows), 2))
    # Portions of one size, padded: all networks share one program per camera model. Larger: small
    # networks project padding; smaller: large ones make more calls.
    portion = 4096
    with local_x64():
        for begin in range(0, len(rows), portion):
            portion_rows = rows[begin : begin + portion]
            padded_rows = np.pad(portion_rows, (0, portion - len(portion_rows)), mode="edge")
            image = rays.image[padded_rows]
            part = _portion(
                model,
                values[images.camera[image]],
                images.position[image],
                images.angles[image],
                network.points.position[rays.point[padded_rows]],
            )
            projected[begin : begin + portion] = np.asarray(part)[: len(portion_rows)]
    return projected


@partial(compile_once, static=0)
def _portion(
    model: CameraModel,
    values: Float[AnyArray, "n parameters"],
    position: Float[AnyArray, "n 3"],
    angles: Float[AnyArray, "n 3"],
    points: Float[AnyArray, "n 3"],
) -> Float[Array, "n 2"]:
    def project_point(
        p: Float[AnyArray, " parameters"],
        X0: Float[AnyArray, "3"],
        angles: Float[AnyArray, "3"],
        X: Float[AnyArray, "3"],
    ) -> Float[Array, "2"]:
        ray = matrix_from_omega_phi_kappa(angles) @ (X - X0)
        return jnp.stack(project(model, tuple(p), *ray))

    return jax.vmap(project_point)(values, position, angles, points)
