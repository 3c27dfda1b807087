"""The distortion of a camera as a curve over the radius, with its standard deviation.

For every model, the image of a point is displaced by d = measured − ideal (pincushion positive).
At the distance r from the principal point, and at the azimuths α around it, d has a radial part
d_r(α) and a tangential part d_t(α). Their harmonics separate the kinds of distortion:

    symmetric radial    mean of d_r(α)
    decentring          amplitude of d_t(α) at one turn, √(P1² + P2²)·r² for Brown's model

The σ of both follow from the covariance of the free parameters and the derivatives by them.
"""

import dataclasses
from functools import partial
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxbundle.cameras import get_model
from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.validity import measured_centre
from jaxbundle.display import print_in_one_screen
from jaxbundle.system.programs import compile_once

if TYPE_CHECKING:
    from jaxbundle.adjustment.result import Adjustment


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class DistortionProfile:
    """Distortion over the radius, all in the unit of the camera's model; σ a posteriori."""

    unit: str
    radius: Float[np.ndarray, " radii"]
    radial: Float[np.ndarray, " radii"]
    radial_sigma: Float[np.ndarray, " radii"]
    decentring: Float[np.ndarray, " radii"]
    decentring_sigma: Float[np.ndarray, " radii"]


def distortion_profile(
    adjustment: "Adjustment", camera: str, radii: int = 81, reach: float | None = None
) -> DistortionProfile:
    """The distortion of a camera from its principal point to its farthest measurement.

    **Arguments:** `adjustment` a solved one; `camera` its id; `radii` the number of values; `reach`
    the last radius, by default that of the farthest measurement.

    **Returns:** radial distortion and decentring, measured − ideal; σ are 0 for a held
    camera, NaN for a radius without image.
    """
    parameters = adjustment.camera_parameters(camera)
    free, covariance = adjustment.camera_covariance(camera)
    model = _model(adjustment, camera)
    reach = farthest_measurement(adjustment, camera) if reach is None else reach
    radius = np.linspace(0, reach, radii)
    p = jnp.array(list(parameters.values()))
    (radial, decentring), slopes = distortion_at(model, p, radius)
    slopes = slopes[:, :, [list(parameters).index(name) for name in free]]
    sigma = np.sqrt(np.clip(np.einsum("kri,ij,krj->kr", slopes, covariance, slopes), 0, None))
    return DistortionProfile(model.unit, radius, radial, sigma[0], decentring, sigma[1])


def farthest_measurement(adjustment: "Adjustment", camera: str) -> float:
    """The largest distance of a measurement of a camera from its principal point."""
    return float(adjustment.farthest_measurements[camera_index(adjustment, camera)])


def principal_point(adjustment: "Adjustment", camera: str) -> Float[np.ndarray, "2"]:
    """The measured image of a camera's axis, the centre of its distortion."""
    p = jnp.array(list(adjustment.camera_parameters(camera).values()))
    return np.asarray(measured_centre(_model(adjustment, camera), p))


def camera_index(adjustment: "Adjustment", camera: str) -> int:
    """The row of a camera in the arrays."""
    return [camera_of_network.id for camera_of_network in adjustment.problem.network.cameras].index(
        camera
    )


def _model(adjustment: "Adjustment", camera: str) -> CameraModel:
    return get_model(adjustment.problem.network.cameras[camera_index(adjustment, camera)].model)


@partial(compile_once, static=0)
def _ideal(
    model: CameraModel, p: Float[Array, " parameters"], xy: Float[Array, "radii azimuths 2"]
) -> Float[Array, "radii azimuths 2"]:
    """Ideal coordinates of measured ones [radii, azimuths, 2]."""
    return jnp.stack(jnp.vectorize(partial(model.to_ideal, tuple(p)))(xy[..., 0], xy[..., 1]), -1)


def distortion_at(
    model: CameraModel, parameters: ArrayLike, radius: ArrayLike, azimuths: int = 12
) -> tuple[np.ndarray, np.ndarray]:
    """Symmetric radial distortion and decentring of a camera model.

    **Arguments:** `parameters` in the model's order; `radius` [radii] from the principal point in
    the measured image; `azimuths`: number of directions over which harmonics are taken: of twelve,
    harmonics up to the tenth leave mean and one turn unchanged.

    **Returns:** both [2, radii], in the model's unit, rounding noise set to 0, and their
    derivatives by all parameters [2, radii, parameters].
    """
    p, radius = jnp.asarray(parameters, float), jnp.asarray(radius, float)
    azimuth = 2 * np.pi * np.arange(azimuths) / azimuths
    out = np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
    centre = measured_centre(model, p)
    ideal = _ideal(model, p, centre + radius[:, None, None] * out)
    harmonics = _harmonics(model, p, centre, ideal, radius, jnp.asarray(out))
    values, slopes = (np.array(x) for x in harmonics)
    # Image coordinates are exact to about 450 times the rounding of one operation.
    noise = np.abs(values) < 1e-13 * (np.abs(centre).max() + radius)
    # The amplitude has no derivative where it is zero.
    slopes[1][noise[1]] = 0
    values[noise] = 0
    return values, slopes


@partial(compile_once, static=0)
def _harmonics(
    model: CameraModel,
    p: Float[Array, " parameters"],
    centre: Float[Array, "2"],
    ideal: Float[Array, "radii azimuths 2"],
    radius: Float[Array, " radii"],
    out: Float[Array, "azimuths 2"],
) -> tuple[Array, Array]:
    """Values and derivatives, only by the formula of the model.

    Quantities that the formula gives only as an inverse (the centre, or the ideal points) are known
    at p. One Newton step with the Jacobian held there has their exact derivative by p.
    """
    formula = getattr(model, model.own_formula)

    def evaluate(p: Array, xy: Array) -> Array:
        return jnp.stack(formula(tuple(p), xy[0], xy[1]))

    def move_root(q: Array, root: Array, target: Array) -> Array:
        """The point near `root` with the image `target`, for parameters q near p."""
        return root - jnp.linalg.solve(jax.jacfwd(evaluate, 1)(p, root), evaluate(q, root) - target)

    def displacements(q: Array, radius: Array, ideal: Array) -> Array:
        if model.own_formula == "to_ideal":
            middle = move_root(q, centre, jnp.zeros(2))
            return radius * out - jax.vmap(evaluate, (None, 0))(q, middle + radius * out)
        middle = evaluate(q, jnp.zeros(2))
        return radius * out - jax.vmap(move_root, (None, 0, 0))(q, ideal, middle + radius * out)

    def amplitudes(q: Array, radius: Array, ideal: Array) -> Array:
        dx, dy = displacements(q, radius, ideal).T
        cosine, sine = out.T
        radial = (dx * cosine + dy * sine).mean()
        tangential = dy * cosine - dx * sine
        a, b = 2 * (tangential * cosine).mean(), 2 * (tangential * sine).mean()
        square = a * a + b * b
        is_positive = square > 0  # where it is not, the root would have the derivative NaN
        amplitude = jnp.where(is_positive, jnp.sqrt(jnp.where(is_positive, square, 1.0)), 0.0)
        return jnp.stack([radial, amplitude])

    values = jax.vmap(amplitudes, (None, 0, 0), 1)(p, radius, ideal)
    slopes = jax.vmap(jax.jacfwd(amplitudes), (None, 0, 0), 1)(p, radius, ideal)
    return values, slopes
