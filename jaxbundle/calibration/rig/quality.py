r"""Accuracy of the cameras of a rig: the uncertainty of a projected point, and coverage.

A point Y at the distance d from camera k is fixed in the frame

    "rig"       of the reference camera: mounting and interior orientation of camera k vary,
                ray = R_k·(Y − b_k). This is what the rig is used for: points intersected from its
                cameras. The reference camera has no mounting.
    "camera"    of camera k itself, the interior orientation alone
    "rotation"  of camera k, without the rotation that moves the images least

with the covariance of the common adjustment, as
`jaxbundle.adjustment.quality.projection_uncertainty` for one camera.
"""

from functools import partial
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.adjustment.quality.projection_uncertainty import interior_covariance_of_images
from jaxbundle.arguments import one_of
from jaxbundle.calibration.pixels import unit_size
from jaxbundle.calibration.quality import GRID, Coverage, UncertaintyMap, coverage, grid_of
from jaxbundle.cameras import CameraModel, get_model, image_ray, project
from jaxbundle.cameras.pixel_frame import in_model_units, in_pixels
from jaxbundle.errors import InputError
from jaxbundle.leastsquares import Pose, PoseValue
from jaxbundle.network.columns import did_you_mean
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar, not_none

if TYPE_CHECKING:
    from jaxbundle.calibration.rig.result import RigCalibration

FRAMES = ("rig", "camera", "rotation")


@partial(compile_once, static=0)
def _slopes(
    model: CameraModel,
    p: Float[AnyArray, " parameters"],
    mounting: PoseValue,
    xy: Float[AnyArray, "n 2"],
    nearness: Scalar,
) -> Float[Array, "n 2 k"]:
    """∂x/∂(δb, δθ, p) [n, 2, 6 + parameters] of points at the distance 1/nearness, whose images
    are `xy`."""
    space = Pose()
    # Relative to the camera, in units of the distance.
    block = space.prepare(mounting._replace(position=jnp.zeros(3)))

    def derive(xy: Float[AnyArray, "2"]) -> Float[Array, "2 k"]:
        ray = block.rotation.apply_inverse(image_ray(model, tuple(p), xy[0], xy[1]))

        def image(
            change: Float[Array, "6"], p: Float[AnyArray, " parameters"]
        ) -> Float[Array, "2"]:
            moved_block = space.move(block, (*(nearness * change[:3]), *change[3:]))
            return jnp.stack(project(model, tuple(p), *moved_block.ray(ray)))

        return jnp.concatenate(jax.jacfwd(image, (0, 1))(jnp.zeros(space.width), p), 1)

    return jax.vmap(derive)(xy)


def rig_uncertainty(
    rig: "RigCalibration",
    name: str,
    distance: float = np.inf,
    frame: str = "rig",
    grid: tuple[int, int] = GRID,
) -> UncertaintyMap:
    """The uncertainty of a projected point over the image of a camera of a rig, pixels.

    **Arguments:** `rig`: a `RigCalibration`; `distance` (object unit) matters only for "rig";
    `grid`: columns and rows of the map.

    **Raises:** `InputError` for an invalid camera, frame or distance.
    """
    one_of("frame", frame, FRAMES)
    if not distance > 0:
        raise InputError(f"distance {distance:g}: expected a positive distance")
    k = _index(rig, name)
    camera, space = rig.camera(name), rig.result.problem.table(rig.rig.row_of(k)[0]).vector
    model = get_model(camera.model)
    p = np.array(list(camera.parameters.values()))
    uv = grid_of(not_none(camera.image_size), *grid)
    xy = in_model_units(uv.reshape(-1, 2), model, camera.image_size, camera.pixel_size)
    C = rig.covariance(name)
    if frame == "rig":
        mounting = jax.tree.map(lambda x: x[k], rig.values("mounting"))
        J = np.asarray(_slopes(model, p, mounting, xy, 1 / distance))
        J = J[:, :, [*range(Pose.width), *(Pose.width + c for c in space.moving)]]
        C = J @ C @ J.swapaxes(1, 2)
    else:
        covariance_of_interior = C[Pose.width :, Pose.width :]
        C = interior_covariance_of_images(model, p, space.moving, covariance_of_interior, xy, frame)
    per_unit = 1 / np.array(unit_size(model, camera.pixel_size))
    C = C * per_unit[:, None] * per_unit
    return UncertaintyMap(frame, float(distance), uv, C.reshape(*uv.shape[:2], 2, 2))


def rig_points(rig: "RigCalibration", name: str) -> Float[np.ndarray, "n 2"]:
    """The image points of a camera used in the rig adjustment, pixels [n, 2]."""
    is_of_camera, camera = rig.used & (rig.rig.camera == _index(rig, name)), rig.camera(name)
    model = get_model(camera.model)
    return in_pixels(rig.rig.xy[is_of_camera], model, camera.image_size, camera.pixel_size)


def rig_coverage(rig: "RigCalibration", name: str) -> Coverage:
    """Coverage of the image of a camera by points of the rig."""
    return coverage(rig_points(rig, name), not_none(rig.camera(name).image_size))


def _index(rig: "RigCalibration", name: str) -> int:
    if name not in rig.names:
        raise InputError(f"camera {name!r} is not of the rig{did_you_mean(name, rig.names)}")
    return rig.names.index(name)
