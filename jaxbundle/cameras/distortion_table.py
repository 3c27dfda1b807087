"""The distortion of a camera in steps of the radius, as in calibration reports.

Around the circle of radius r in the MEASURED image, the displacement d = measured − ideal has a
radial part, whose mean is the symmetric radial distortion dr, and a tangential part, whose
first harmonic is the decentring. A correction (`brown`, `usgs`) has the opposite sign.
"""

from collections.abc import Mapping
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.parameters import default_parameters
from jaxbundle.float64 import local_x64
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray


def distortion_table(
    model: CameraModel,
    parameters: Mapping[str, float],
    step: float,
    largest: float,
    about: Literal["principal point", "origin"] = "principal point",
) -> dict[str, np.ndarray]:
    """Radial distortion and decentring at step, 2·step, … to `largest`.

    **Arguments:** `step` and `largest` in the model's unit; `about` the origin of the radii:
    the image of the optical axis, or the origin of image coordinates, as in BINGO.

    **Returns:** columns r, radial, decentring, in the model's unit; NaN without ray.

    **Raises:** `ValueError` for a step or end that is not positive.
    """
    if not (0 < step <= largest < np.inf):
        raise ValueError(f"the step is {step} and the end {largest}; expected 0 < step ≤ end")
    values = {**default_parameters(model), **parameters}
    p = np.array([values[name] for name in model.parameters], float)
    radius = step * np.arange(1, int(largest / step * (1 + 1e-12)) + 1)
    # Twelve directions: mean and first harmonic are exact for a distortion whose harmonics about
    # the axis end at the tenth; those of the models end at the second.
    azimuth = 2 * np.pi * np.arange(12) / 12
    out = np.stack([np.cos(azimuth), np.sin(azimuth)], 1)
    with local_x64():
        centre = np.asarray(_from_ideal(model, p, np.zeros((1, 2))))[0]
        point = np.array([values[name] for name in model.principal_point] or [0.0, 0.0])
        begin = centre if about == "principal point" else np.zeros(2)
        xy = begin + radius[:, None, None] * out
        ideal = np.asarray(_to_ideal(model, p, xy.reshape(-1, 2))).reshape(xy.shape)
    d = xy - begin - (ideal if about == "principal point" else ideal + point)
    radial = (d * out).sum(2).mean(1)
    # Decentring P turns tangential displacement through one period around the circle; its mean over
    # the circle, a rotation, is no distortion.
    tangential = d[..., 1] * out[:, 0] - d[..., 0] * out[:, 1]
    decentring = 2 * np.abs((tangential * np.exp(-1j * azimuth)).mean(1))
    # Below 1e-13 of a coordinate distortion is noise of the arithmetic.
    noise = 1e-13 * (np.abs(begin).max() + radius)
    without = lambda d: np.where(np.abs(d) < noise, 0.0, d)
    return {"r": radius, "radial": without(radial), "decentring": without(decentring)}


@partial(compile_once, static=0)
def _to_ideal(model: CameraModel, p: AnyArray, xy: AnyArray) -> Array:
    return jax.vmap(lambda xy: jnp.stack(model.to_ideal(tuple(p), *xy)))(xy)


@partial(compile_once, static=0)
def _from_ideal(model: CameraModel, p: AnyArray, xy: AnyArray) -> Array:
    return jax.vmap(lambda xy: jnp.stack(model.from_ideal(tuple(p), *xy)))(xy)
