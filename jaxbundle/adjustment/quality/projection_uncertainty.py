"""Projection uncertainty of a calibrated camera: the covariance of an image point, by position and
distance.

The image of a ray depends on the parameters p of the camera, with ∂x/∂p by automatic
differentiation of the projection. The result depends on the frame in which the ray is fixed while p
is uncertain:

    "camera"   of the camera frame: Cx = A·Cp·Aᵀ, A = ∂x/∂p. The least useful one: a shift of the
               principal point is nearly a rotation, which later orientations absorb.
    "rotation" of the scene, after the rotation θ that moves the images of all rays least:
               A' = A − B·(BᵀB)⁻¹·BᵀA over the image, B = ∂x/∂θ.
    "scene"    of the object points the camera was calibrated from: a point at a distance d along
               the ray is held in the object frame of every view, and projected through the view's
               pose as it varies together with p; the covariance of the mean of its images over
               the views. It depends on d: small
               where the object was, larger in front of it and beyond.

Source of the last: Kogan, mrcal documentation, "Projection uncertainty" (mean of the boards'
frames); of the second: the implied rotation of a difference of two calibrations, linearised.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxbundle.cameras import CameraModel, image_ray, project
from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray

FRAMES = ("camera", "rotation", "scene")


@partial(compile_once, static=0)
def _slopes(
    model: CameraModel, p: Float[AnyArray, " parameters"], xy: Float[AnyArray, "n 2"]
) -> tuple[Float[Array, "n 2 parameters"], Float[Array, "n 2 3"]]:
    """∂x/∂p [n, 2, parameters] and ∂x/∂θ [n, 2, 3] of the rays that have the images `xy`."""

    def image(
        p: Float[Array, " parameters"], theta: Float[Array, "3"], ray: Float[Array, "3"]
    ) -> Float[Array, "2"]:
        return jnp.stack(project(model, tuple(p), *(ray + jnp.cross(theta, ray))))

    def slopes(xy: Float[AnyArray, "2"]):
        ray = jnp.stack(image_ray(model, tuple(p), xy[0], xy[1]))
        return jax.jacfwd(image, (0, 1))(p, jnp.zeros(3), ray)

    return jax.vmap(slopes)(xy)


def slopes_of_images(
    model: CameraModel,
    p: Float[np.ndarray, " parameters"],
    free: tuple[int, ...],
    xy: Float[np.ndarray, "n 2"],
    frame: str = "rotation",
) -> Float[np.ndarray, "n 2 k"]:
    """A, or A' of the frame "rotation": the derivatives of images whose rays are fixed in that
    frame, by the parameters in the columns `free`. Points without a ray are NaN and ignored.

    **Arguments:** `xy`: image points, in the unit of the model; for "rotation" they represent the
    image over which the rotation is fitted.
    """
    if frame not in ("camera", "rotation"):
        raise ValueError(f'frame must be "camera" or "rotation", not {frame!r}')
    A, B = (np.asarray(x) for x in _slopes(model, jnp.asarray(p, float), jnp.asarray(xy, float)))
    A = A[:, :, list(free)]
    if frame == "rotation":
        # One rotation for the whole image, by least squares over its points: B·θ as close to A as
        # it can be. What is left is distortion, which no orientation absorbs.
        good = _are_finite(A, B)
        turn = np.linalg.lstsq(B[good].reshape(-1, 3), A[good].reshape(-1, A.shape[2]), rcond=None)[
            0
        ]
        A = A - B @ turn
    return A


def have_rays(
    model: CameraModel, p: Float[np.ndarray, " parameters"], xy: Float[np.ndarray, "n 2"]
) -> Bool[np.ndarray, " n"]:
    """Which image points have a ray whose image depends smoothly on ray and parameters `p`."""
    slopes = _slopes(model, jnp.asarray(p, float), jnp.asarray(xy, float))
    return _are_finite(*map(np.asarray, slopes))


def _are_finite(
    A: Float[np.ndarray, "n 2 k"], B: Float[np.ndarray, "n 2 3"]
) -> Bool[np.ndarray, " n"]:
    return np.asarray(np.isfinite(A).all((1, 2)) & np.isfinite(B).all((1, 2)))


def interior_covariance_of_images(
    model: CameraModel,
    p: Float[np.ndarray, " parameters"],
    free: tuple[int, ...],
    covariance: Float[np.ndarray, "k k"],
    xy: Float[np.ndarray, "n 2"],
    frame: str = "rotation",
) -> Float[np.ndarray, "n 2 2"]:
    """Covariance of image points whose rays are held in the frame "camera" or "rotation"
    (`slopes_of_images`); `covariance`: of the parameters in the columns `free`."""
    A = slopes_of_images(model, p, free, xy, frame)
    return A @ covariance @ A.swapaxes(1, 2)


def images_through_scene(
    model: CameraModel,
    camera: tuple[str, int],
    views: Int[np.ndarray, " views"],
    estimate: Values,
    xy: Float[np.ndarray, "n 2"],
    distance: float,
):
    """A function of the adjusted unknowns: the images [2n] of points held in the scene.

    Their covariance is that of the frame "scene". At the estimate itself they are `xy`, which must
    have rays (`have_rays`): one without would make the derivatives of all NaN.

    **Arguments:** `camera`: its table and its row there; `views`: indices of its images; `distance`
    from the projection centre in the object unit; infinity as well.
    """
    table, row = camera
    X0, rotation = (np.asarray(rows)[views] for rows in estimate["image"])
    directions = _directions(
        model, np.asarray(estimate[table])[row], rotation, np.asarray(xy, float)
    )
    # Of the inverse distance images are smooth, infinity is 0.
    inverse_distance = np.asarray(1.0 / distance)
    return eqx.Partial(
        _images_through_scene, model, camera, views, X0, directions, inverse_distance
    )


def _images_through_scene(
    model: CameraModel,
    camera: tuple[str, int],
    views: Int[AnyArray, " views"],
    X0: Float[AnyArray, "views 3"],
    directions: Float[AnyArray, "views n 3"],
    inverse_distance: Float[AnyArray, ""],
    values: Values,
) -> Float[Array, " 2*n"]:
    """The images [2n] of points in the directions [views, n, 3] from X0, at a distance."""
    # A point that was in the direction of the pixel is seen again from the changed pose: X − X0 is
    # d·direction + (X0_before − X0), of which only the direction matters.
    table, row = camera
    q, (position, rotation) = tuple(values[table][row]), values["image"]
    change = inverse_distance * (X0 - position[views])
    turned = jnp.einsum(
        "vij,vnj->vni",
        jax.vmap(matrix_from_quaternion)(rotation[views]),
        directions + change[:, None],
    )
    image = jax.vmap(jax.vmap(lambda ray: jnp.stack(project(model, q, *ray))))(turned)
    return jnp.mean(image, 0).ravel()


@partial(compile_once, static=0)
def _directions(
    model: CameraModel,
    p: Float[AnyArray, " parameters"],
    rotation: Float[AnyArray, "views 4"],
    xy: Float[AnyArray, "n 2"],
) -> Float[Array, "views n 3"]:
    """Lines of sight in the object frame [views, n, 3]; with 1/d homogeneous points, infinity
    included."""
    rays = jax.vmap(lambda xy: jnp.stack(image_ray(model, tuple(p), xy[0], xy[1])))(xy)
    return jnp.einsum("vji,nj->vni", jax.vmap(matrix_from_quaternion)(rotation), rays)
