"""From image to ground, to image, and from one image to another through the ground.

    ground point   the ray of (x, y) meets the plane Z:  X = X0 + t·Mᵀ·[r, s, q],  t = (Z − Z0)/d_Z
    image point    (x, y) of X by the collinearity equations with distortion
    transfer       both, one after the other

Pure functions of one point; batch them with `jax.vmap`. A `View` is a camera with its exterior
orientation; image coordinates are in the unit and axes of its model.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbundle.cameras import CameraModel, image_ray, project
from jaxbundle.orientation.pose import CameraPose, to_camera
from jaxbundle.types import AnyArray, Scalar


class View(eqx.Module):
    """An oriented image: camera model, its parameters in the model's order, pose."""

    model: CameraModel = eqx.field(static=True)
    parameters: Float[AnyArray, " parameters"]
    pose: CameraPose


def line_of_sight(view: View, xy: Float[AnyArray, "2"]) -> Float[Array, "3"]:
    """The direction in object space, of length 1, of an image point."""
    ray = image_ray(view.model, tuple(view.parameters), xy[0], xy[1])
    return jnp.asarray(view.pose.M).T @ jnp.stack(ray)


def ground_point(view: View, xy: Float[AnyArray, "2"], Z: Scalar) -> Float[Array, "3"]:
    """The intersection of the ray of an image point with the plane of this Z; NaN if none."""
    d = line_of_sight(view, xy)
    t = (Z - view.pose.X0[2]) / d[2]
    point = jnp.asarray(view.pose.X0) + t * d
    return jnp.where(t > 0, point.at[2].set(Z), jnp.nan)


def image_point(view: View, X: Float[AnyArray, "3"]) -> Float[Array, "2"]:
    """The image of an object point; NaN behind a perspective camera."""
    r, s, q = to_camera(view.pose, X)
    behind = (q >= 0) & (not view.model.wide)
    xy = jnp.stack(project(view.model, tuple(view.parameters), r, s, q))
    return jnp.where(behind, jnp.nan, xy)


def image_to_image(
    view: View, xy: Float[AnyArray, "2"], Z: Scalar, other: View
) -> Float[Array, "2"]:
    """The image point in another image of a point at the height Z in this one."""
    return image_point(other, ground_point(view, xy, Z))
