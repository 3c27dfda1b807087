"""A pose: projection centre X0 and rotation M, object to camera, and the image of a point.

    [r, s, q] = M·(X − X0),        x = −r/q,  y = −s/q

(x, y) are ideal image coordinates divided by the principal distance: free of distortion, relative
to the principal point, y up. The ray of an image point is (x, y, −1) in the camera frame.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from jaxbundle.cameras.perspective import perspective
from jaxbundle.geometry import matrix_from_rotation_vector
from jaxbundle.types import AnyArray

# The collinearity equations of `cameras`, without a principal point.
_ideal, _ = perspective((0,), up=True)


class CameraPose(eqx.Module):
    """Exterior orientation: X0 in the object unit, M from object to camera."""

    X0: Float[AnyArray, "*batch 3"]
    M: Float[AnyArray, "*batch 3 3"]


def to_camera(pose: CameraPose, X: Float[AnyArray, "3"]) -> Float[AnyArray, "3"]:
    """[r, s, q] of a point, in the object unit; q < 0 in front of the camera."""
    return pose.M @ (X - pose.X0)


def image_of(pose: CameraPose, X: Float[AnyArray, "3"]) -> Float[AnyArray, "2"]:
    """(x, y) of a point by the collinearity equations (Kraus, 2007, section 4.1), c = 1."""
    return jnp.stack(_ideal((1.0,), *to_camera(pose, X)))


def ray_of(xy: Float[AnyArray, "2"]) -> Float[AnyArray, "3"]:
    """The ray (x, y, −1) of an image point, c = 1, in the camera frame."""
    return jnp.concatenate([xy, -jnp.ones_like(xy[:1])])


def retract_pose(pose: CameraPose, delta: Float[AnyArray, "6"]) -> CameraPose:
    """X0 + δX0 (object unit), exp([δθ]×)·M (radians, camera frame)."""
    return CameraPose(pose.X0 + delta[:3], matrix_from_rotation_vector(delta[3:]) @ pose.M)
