"""The distortion of a camera as a curve over the radius, with its standard deviation.

Whatever the model, the image of a point is displaced by d = measured − ideal (pincushion positive).
At the distance r from the principal point, and all around it at the azimuths α, d has a radial part
d_r(α) and a tangential part d_t(α). Their harmonics separate the kinds of distortion:

    symmetric radial    mean of d_r(α)
    decentring          amplitude of d_t(α) at one turn, √(P1² + P2²)·r² for Brown's model

The σ of both follow from the covariance of the free parameters and the derivatives by them.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.cameras import get_model

AZIMUTHS = 24


@dataclasses.dataclass(frozen=True)
class DistortionProfile:
    """Distortion over the radius, all in the unit of the camera's model; σ a posteriori."""

    unit: str
    radius: Float[np.ndarray, " radii"]
    radial: Float[np.ndarray, " radii"]
    radial_sigma: Float[np.ndarray, " radii"]
    decentring: Float[np.ndarray, " radii"]
    decentring_sigma: Float[np.ndarray, " radii"]


def distortion_profile(adjustment, camera: str, radii: int = 101) -> DistortionProfile:
    """The distortion of a camera from its principal point to its farthest measurement.

    **Arguments:** `adjustment` a solved one; `camera` its id; `radii` how many values.

    **Returns:** radial distortion and decentring, measured − ideal; σ are 0 for a camera that is
    held, NaN where a radius has no image.
    """
    parameters = adjustment.camera_parameters(camera)
    free, covariance = adjustment.camera_covariance(camera)
    model = _model(adjustment, camera)
    radius = np.linspace(0, farthest_measurement(adjustment, camera), radii)
    p = jnp.array(list(parameters.values()))
    values, slopes = (np.asarray(x) for x in _profile(model, p, jnp.asarray(radius)))
    columns = [list(parameters).index(name) for name in free]
    slopes = slopes[:, :, columns]
    sigma = np.sqrt(np.clip(np.einsum("kri,ij,krj->kr", slopes, covariance, slopes), 0, None))
    radial, decentring = values
    return DistortionProfile(model.unit, radius, radial, sigma[0], decentring, sigma[1])


def farthest_measurement(adjustment, camera: str) -> float:
    """The largest distance of a measurement of a camera from its principal point."""
    s, data = adjustment.problem.structure, adjustment.problem.data
    c = camera_index(adjustment, camera)
    used = (np.asarray(s.camera) == c) & (np.asarray(data.image_weight) > 0).any(1)
    p = jnp.array(list(adjustment.camera_parameters(camera).values()))
    centre = np.asarray(_centre(_model(adjustment, camera), p))
    away = np.asarray(data.image_xy)[used] - centre
    return float(np.linalg.norm(away, axis=1).max(initial=0.0))


def camera_index(adjustment, camera: str) -> int:
    """The row of a camera in the arrays."""
    return [given.id for given in adjustment.problem.network.cameras].index(camera)


def _model(adjustment, camera):
    return get_model(adjustment.problem.network.cameras[camera_index(adjustment, camera)].model)


@partial(jax.jit, static_argnums=0)
def _centre(model, p):
    """The measured image of the principal axis."""
    return jnp.stack(model.from_ideal(tuple(p), 0.0, 0.0))


@partial(jax.jit, static_argnums=0)
def _profile(model, p, radius):
    """[2, radii] radial and decentring, and their derivatives by all parameters."""
    azimuth = 2 * jnp.pi * jnp.arange(AZIMUTHS) / AZIMUTHS
    cosine, sine = jnp.cos(azimuth), jnp.sin(azimuth)

    def at(p, radius):
        x0, y0 = model.from_ideal(tuple(p), 0.0, 0.0)
        ideal = jax.vmap(lambda x, y: jnp.stack(model.to_ideal(tuple(p), x, y)))
        xi, yi = ideal(x0 + radius * cosine, y0 + radius * sine).T
        dx, dy = radius * cosine - xi, radius * sine - yi
        radial = (dx * cosine + dy * sine).mean()
        tangential = dy * cosine - dx * sine
        a, b = 2 * (tangential * cosine).mean(), 2 * (tangential * sine).mean()
        square = a * a + b * b
        there = square > 0
        amplitude = jnp.where(there, jnp.sqrt(jnp.where(there, square, 1.0)), 0.0)
        return jnp.stack([radial, amplitude])

    values = jax.vmap(at, (None, 0), 1)(p, radius)
    slopes = jax.vmap(jax.jacfwd(at), (None, 0), 1)(p, radius)
    return values, slopes
