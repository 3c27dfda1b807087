"""Cameras of other programs without an equal model here: the nearest is fitted, with its misfit.

A reader gives the formula of the camera, from rays to pixels. Points of a grid over the image get
their rays by Newton's method; the parameters of each candidate are those that bring the images of
these rays nearest to the points (`cameras.convert_fit`). The first candidate with differences below
`GOOD_FIT` is taken, else the nearest.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

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

Formula = Callable[..., Float[Array, "2"]]
"""Parameters and one ray X, Y, Z, right, down and forward, to pixels from the centre of the first
one: a function of JAX whose derivatives are finite on the axis, the same object for every camera of
a kind (it is compiled once)."""

GOOD_FIT = 0.05
"""Pixels: a candidate this near is taken without trying the next."""
ON_THE_POINT = 1e-7
"""Pixels by which a ray may miss its point."""
ROUNDS, LONGEST = 60, 0.2
"""Newton's method for rays: rounds, and radians of its steps."""
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
NARROW_COSINE = np.cos(np.radians(75))
"""Rays within this angle of the axis may have a perspective model."""


class NoPlaceError(InputError):
    """No model is near this camera: its photographs can be left out."""


@dataclasses.dataclass(frozen=True)
class Foreign:
    """A camera of another program.

    `parameters`: those of the formula, numbers in any container of JAX; `start`: the parameters of
    `opencv`, or of `kannala-brandt` if it is a `fisheye`, that come nearest to its formula;
    `image_size` in pixels, `pixel_size` in mm where it is known.
    """

    formula: Formula
    parameters: Any
    start: Mapping[str, float]
    image_size: Sequence[float]
    pixel_size: Sequence[float] | None = None
    fisheye: bool = False


def nearest_camera(camera: Foreign, where: str) -> tuple[dict, str]:
    """The nearest of our cameras as an entry of a document, and a message with its differences.

    **Raises:** `NoPlaceError` beginning with `where` if less than half of the image has rays, or
    nothing could be fitted.
    """
    sizes = (camera.image_size, camera.pixel_size)
    uv = image_grid([-0.5, -0.5], np.array(camera.image_size, float) - 0.5)
    rays, there = _rays(camera, uv)
    if there.mean() < MEASURABLE:
        raise NoPlaceError(
            f"{where}: only {100 * there.mean():.0f} % of the image has rays: its distortion turns "
            "back inside the image"
        )
    uv, rays = uv[there], rays[there] * [1, -1, -1]
    source = get_model("kannala-brandt" if camera.fisheye else "opencv")
    narrow = (-rays[:, 2] > NARROW_COSINE).all()
    found, problem = [], ""
    for name, free in (*(FISHEYE if camera.fisheye else ()), *(PERSPECTIVE if narrow else ())):
        target = get_model(name)
        if target.unit == "mm" and camera.pixel_size is None:
            continue
        origin, step = pixel_frame(target, *sizes)
        xy = (uv - origin) / step
        starts = start_values(source, camera.start, target, sizes)
        try:
            values = fit_parameters(target, rays, xy, starts, free)
        except ValueError as error:
            problem = str(error)
            continue
        off = np.linalg.norm((images_of(target, values, rays) - xy) * step, axis=1)
        largest = float(off.max()) if np.isfinite(off).all() else np.inf
        found.append((largest, float(np.sqrt(np.mean(off**2))), target, values))
        if largest <= GOOD_FIT:
            break
    if not found or not np.isfinite(min(found, key=lambda one: one[0])[0]):
        raise NoPlaceError(f"{where}: no camera model fits it; {problem}")
    largest, rms, target, values = min(found, key=lambda one: one[0])
    entry: dict[str, Any] = {"model": target.name, **values}
    told = f"fitted as {target.name}, largest difference {largest:.2g} px, RMS {rms:.2g} px"
    if there.mean() < 1:
        told += f"; {100 * (1 - there.mean()):.1f} % of the image has no ray"
    if target.unit == "mm" and camera.pixel_size is not None:
        entry["pixel_size"] = list(camera.pixel_size)
    return entry, told


@dataclasses.dataclass(frozen=True)
class FittedCamera(Camera):
    """A camera fitted to one of another program, and a message with its differences."""

    told: str = ""


def fit_camera(id: str, camera: Foreign, where: str, why: str) -> FittedCamera:
    """The nearest of our cameras; `why` the original model has no equal here.

    **Raises:** `NoPlaceError`.
    """
    entry, told = nearest_camera(camera, where)
    pixel = entry.pop("pixel_size", None)
    model, size = entry.pop("model"), camera.image_size
    return FittedCamera(
        id,
        model,
        entry,
        image_size=(int(size[0]), int(size[1])),
        pixel_size=pixel and tuple(pixel),
        told=f"camera {id!r} {why}: {told}",
    )


def fit_messages(cameras: Iterable[Camera]) -> tuple[str, ...]:
    """Messages about the fitted cameras."""
    return tuple(camera.told for camera in cameras if isinstance(camera, FittedCamera))


def _rays(camera: Foreign, uv) -> tuple[Float[np.ndarray, "n 3"], np.ndarray]:
    """Unit vectors (right, down, forward) of image points, and which points have one: beyond a
    radius where the image turns back there are none."""
    p = camera.start
    at = (uv - [p["cx"], p["cy"]]) / [p["fx"], p["fy"]]
    r = np.linalg.norm(at, axis=1, keepdims=True)
    m = at if camera.fisheye else at * np.arctan(r) / np.where(r > 0, r, 1)
    with local_x64():
        newton = partial(_newton, camera.formula, camera.parameters, uv)
        for _ in range(ROUNDS):
            step = np.nan_to_num(newton(m)[0], posinf=0.0, neginf=0.0)
            m = m + step
            if np.abs(step).max() < 1e-14:
                break
        _, off, det = map(np.asarray, newton(m))
        return np.asarray(jax.vmap(_direction)(m)), (off < ON_THE_POINT) & (det > 0)


@partial(compile_once, static=0)
def _newton(formula: Formula, p, uv, m):
    """Steps of Newton's method, by how much the images miss the points, and the determinants."""

    def one(uv, m):
        image = lambda m: formula(p, *_direction(m))
        (a, b), (c, d) = jax.jacfwd(image)(m)
        du, dv = uv - image(m)
        det = a * d - b * c
        step = jnp.stack([d * du - b * dv, a * dv - c * du]) / det
        limit = jnp.minimum(1.0, LONGEST / jnp.maximum(jnp.linalg.norm(step), LONGEST))
        return step * limit, jnp.hypot(du, dv), det

    return jax.vmap(one)(uv, m)


def _direction(m: Float[Array, "2"]) -> Float[Array, "3"]:
    """The unit vector at an angle from the axis: m is this angle times its direction."""
    angle = root(m @ m)
    shrink = jnp.where(angle > 0, jnp.sin(angle) / jnp.where(angle > 0, angle, 1.0), 1.0)
    return jnp.append(m * shrink, jnp.cos(angle))


def root(square: Float[Array, ""]) -> Float[Array, ""]:
    """The square root, with the derivative 0 at 0."""
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
