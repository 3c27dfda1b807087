"""Cameras of other programs without an equal model here: the nearest is fitted, with its misfit.

A reader gives the formula of the camera, from rays to pixels. Points of a grid over the image get
their rays by Newton's method; the parameters of each candidate are those that bring the images of
these rays nearest to the points (`cameras.convert_fit`). The first candidate with differences below
`NearestCameraSettings.good_fit` is taken, else the nearest.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbundle.cameras import get_model
from jaxbundle.cameras.convert import MEASURABLE
from jaxbundle.cameras.convert_fit import (
    fit_parameters,
    fitted_parameters,
    image_grid,
    images_of,
    start_values,
)
from jaxbundle.cameras.pixel_frame import pixel_frame
from jaxbundle.errors import InputError
from jaxbundle.float64 import local_x64
from jaxbundle.network.tables import Camera
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar

# Parameters and one ray X, Y, Z, right, down and forward, to pixels from the centre of the first
# one: a function of JAX whose derivatives are finite on the axis, the same object for every camera
# of a kind (it is compiled once).
Formula = Callable[..., Float[Array, "2"]]

OPENCV = fitted_parameters(get_model("opencv"))
RATIONAL = (*OPENCV, "k4", "k5", "k6")
PRISM = (*OPENCV, "s1", "s2", "s3", "s4")
PERSPECTIVE = (
    ("opencv", OPENCV),
    ("opencv", RATIONAL),
    ("opencv", PRISM),
    ("opencv", (*RATIONAL, *PRISM[-4:])),
    ("brown-projected", fitted_parameters(get_model("brown-projected"))),
)
FISHEYE = (("kannala-brandt", fitted_parameters(get_model("kannala-brandt"))),)
MIRROR = (("mei", fitted_parameters(get_model("mei"))),)


@dataclasses.dataclass(frozen=True)
class NearestCameraSettings:
    """How a camera of another program is fitted.

    `good_fit`: largest difference [px] of a candidate that is taken without trying the next; below
    what image points are measured to (0.1 px and more), so that more parameters would only fit
    noise. `perspective_angle` [°]: rays within this angle of the axis may have a perspective model;
    tan θ, which that model forms, is 3.7 at 75° and grows without bound towards 90°.

    Newton's method for the ray of a pixel: at most `max_iterations`, steps of at most `max_step`
    [rad], `max_miss` [px] of a ray that is accepted. Measured on a fisheye624, a dual camera and a
    barrel of k1 = −0.35 whose fold is near: 15 iterations find every ray, 8 lose a sixth of those
    of the barrel; half and double 60 change nothing, nor do half and double 0.2 rad, but without a
    limit some rays of the barrel end on the other side of its fold, 100° off. `max_miss` is far
    below `good_fit` and far above the rounding of pixels: 100 times less or more changes nothing.
    """

    good_fit: float = 0.05
    perspective_angle: float = 75.0
    max_iterations: int = 60
    max_step: float = 0.2
    max_miss: float = 1e-7


SETTINGS = NearestCameraSettings()


class NoPlaceError(InputError):
    """No model is near this camera: its photographs can be left out."""


@dataclasses.dataclass(frozen=True)
class Foreign:
    """A camera of another program.

    `parameters`: those of the formula, numbers in any container of JAX; `start`: the parameters of
    `opencv`, or of `kannala-brandt` if it is a `fisheye`, or of `mei` if they have ξ, that come
    nearest to its formula;
    `image_size` in pixels, `pixel_size` in mm where it is known.
    """

    formula: Formula
    parameters: Any
    start: Mapping[str, float]
    image_size: Sequence[float]
    pixel_size: Sequence[float] | None = None
    fisheye: bool = False


def nearest_camera(
    camera: Foreign, where: str, settings: NearestCameraSettings = SETTINGS
) -> tuple[dict[str, Any], str]:
    """The nearest of our cameras as an entry of a document, and a message with its differences.

    **Raises:** `NoPlaceError` beginning with `where` if less than half of the image has rays, or
    nothing could be fitted.
    """
    sizes = (camera.image_size, camera.pixel_size)
    uv = image_grid([-0.5, -0.5], np.array(camera.image_size, float) - 0.5)
    rays, has_ray = _rays(camera, uv, settings)
    if has_ray.mean() < MEASURABLE:
        raise NoPlaceError(
            f"{where}: only {100 * has_ray.mean():.0f} % of the image has rays: its distortion "
            "turns back inside the image"
        )
    # Rays with y up, looking along −z, as of all models here.
    uv, rays = uv[has_ray], rays[has_ray] * [1, -1, -1]
    wide_candidates = (MIRROR if "xi" in camera.start else FISHEYE) if camera.fisheye else ()
    source = get_model(wide_candidates[0][0] if wide_candidates else "opencv")
    is_narrow = (-rays[:, 2] > np.cos(np.radians(settings.perspective_angle))).all()
    fits, problem = [], ""
    for name, free_names in (*wide_candidates, *(PERSPECTIVE if is_narrow else ())):
        target = get_model(name)
        if target.unit == "mm" and camera.pixel_size is None:
            continue
        origin, step = pixel_frame(target, *sizes)
        xy = (uv - origin) / step
        starts = start_values(source, camera.start, target, sizes)
        try:
            values = fit_parameters(target, rays, xy, starts, free_names)
        except ValueError as error:
            problem = str(error)
            continue
        residuals = np.linalg.norm((images_of(target, values, rays) - xy) * step, axis=1)
        largest = float(residuals.max()) if np.isfinite(residuals).all() else np.inf
        fits.append((largest, float(np.sqrt(np.mean(residuals**2))), target, values))
        if largest <= settings.good_fit:
            break
    if not fits or not np.isfinite(min(fits, key=lambda fit: fit[0])[0]):
        raise NoPlaceError(f"{where}: no camera model fits it; {problem}")
    largest, rms, target, values = min(fits, key=lambda fit: fit[0])
    entry: dict[str, Any] = {"model": target.name, **values}
    message = f"fitted as {target.name}, largest difference {largest:.2g} px, RMS {rms:.2g} px"
    if has_ray.mean() < 1:
        message += f"; {100 * (1 - has_ray.mean()):.1f} % of the image has no ray"
    if target.unit == "mm" and camera.pixel_size is not None:
        entry["pixel_size"] = list(camera.pixel_size)
    return entry, message


@dataclasses.dataclass(frozen=True)
class FittedCamera(Camera):
    """A camera with a message about how it was read: its differences from one of another program,
    entries of the file that are not understood."""

    message: str = ""


def with_messages(camera: Camera, *messages: str) -> Camera:
    """The camera with further messages, if there are any."""
    message = "; ".join([*fit_messages([camera]), *messages])
    fields = {field.name: getattr(camera, field.name) for field in dataclasses.fields(Camera)}
    return FittedCamera(**fields, message=message) if messages else camera


def fit_camera(
    id: str,
    camera: Foreign,
    where: str,
    reason: str,
    settings: NearestCameraSettings = SETTINGS,
) -> FittedCamera:
    """The nearest of our cameras; `reason`: why the original model has no equal here, in words.

    **Raises:** `NoPlaceError`.
    """
    entry, message = nearest_camera(camera, where, settings)
    pixel = entry.pop("pixel_size", None)
    model, size = entry.pop("model"), camera.image_size
    return FittedCamera(
        id,
        model,
        entry,
        image_size=(int(size[0]), int(size[1])),
        pixel_size=pixel and tuple(pixel),
        message=f"camera {id!r} {reason}: {message}",
    )


def fit_messages(cameras: Iterable[Camera]) -> tuple[str, ...]:
    """Messages about how cameras were read."""
    texts = (camera.message for camera in cameras if isinstance(camera, FittedCamera))
    return tuple(dict.fromkeys(filter(None, texts)))


def _rays(
    camera: Foreign, uv: Float[np.ndarray, "n 2"], settings: NearestCameraSettings
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Unit vectors (right, down, forward) of image points, and which points have one: beyond a
    radius where the image turns back there are none."""
    p = camera.start
    tangents = (uv - [p["cx"], p["cy"]]) / [p["fx"], p["fy"]]
    r = np.linalg.norm(tangents, axis=1, keepdims=True)
    # The start has no distortion: θ = r for a fisheye, θ = arctan r for a perspective camera.
    m = tangents if camera.fisheye else tangents * np.arctan(r) / np.where(r > 0, r, 1)
    with local_x64():
        newton = partial(_newton_steps, camera.formula, camera.parameters, settings.max_step, uv)
        for _ in range(settings.max_iterations):
            step = np.nan_to_num(newton(m)[0], posinf=0.0, neginf=0.0)
            m = m + step
            # Some 50 eps of an angle of about 1 rad: nothing is left but rounding.
            if np.abs(step).max() < 1e-14:
                break
        _, miss, det = map(np.asarray, newton(m))
        # det < 0: an image that is turned inside out, beyond the fold of the distortion
        return np.asarray(jax.vmap(_ray_direction)(m)), (miss < settings.max_miss) & (det > 0)


@partial(compile_once, static=(0, 2))
def _newton_steps(
    formula: Formula,
    p: Any,
    max_step: float,
    uv: Float[Array, "n 2"],
    m: Float[Array, "n 2"],
) -> tuple[Float[Array, "n 2"], Float[Array, " n"], Float[Array, " n"]]:
    """Steps of Newton's method, by how much the images miss the points, and the determinants."""

    def newton_step(
        uv: Float[Array, "2"], m: Float[Array, "2"]
    ) -> tuple[Float[Array, "2"], Float[Array, ""], Float[Array, ""]]:
        image = lambda m: formula(p, *_ray_direction(m))
        (a, b), (c, d) = jax.jacfwd(image)(m)
        du, dv = uv - image(m)
        # Cramer's rule: for 2 × 2 it needs no factorisation, and its determinant tells the fold
        det = a * d - b * c
        step = jnp.stack([d * du - b * dv, a * dv - c * du]) / det
        limit = jnp.minimum(1.0, max_step / jnp.maximum(jnp.linalg.norm(step), max_step))
        return step * limit, jnp.hypot(du, dv), det

    return jax.vmap(newton_step)(uv, m)


def _ray_direction(m: Float[AnyArray, "2"]) -> Float[Array, "3"]:
    """The unit vector at an angle from the axis: m is this angle times its direction.

    Angles, unlike tangents, have no pole at 90°, which fisheyes pass.
    """
    angle = root(m @ m)
    shrink = jnp.where(angle > 0, jnp.sin(angle) / jnp.where(angle > 0, angle, 1.0), 1.0)
    return jnp.append(m * shrink, jnp.cos(angle))


def root(square: Scalar) -> Float[Array, ""]:
    """The square root, with the derivative 0 at 0."""
    # Both branches of `where` are differentiated, and 0·∞ is NaN: hence the inner one.
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
