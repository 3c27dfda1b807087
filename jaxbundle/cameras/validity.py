"""The valid radius of a distortion formula around the principal point.

A polynomial that fits a lens inside the image turns back somewhere outside. If the determinant
of the formula's Jacobian falls to zero, two points get the same image and the inverse ends. With K1
alone, g = r·(1 + K1·r²), that is 1 + 3·K1·r² = 0.

The formula is `to_ideal` or `from_ideal`, as defined by the model. The returned radius is always
in the MEASURED image, in the model's unit, so that it can be compared with the image size.
"""

from collections.abc import Mapping, Sequence
from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.cameras.inverse import value_and_derivative
from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.parameters import default_parameters
from jaxbundle.cameras.scalars import Scalar
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray


def turning_radius(
    model: CameraModel,
    parameters: Mapping[str, float] | Sequence[float],
    radius_max: float,
) -> float | None:
    """The smallest radius about the principal point where the model's formula turns back.

    **Arguments:** `parameters` by name (those left out have their defaults) or in the order of the
    model; `radius_max` how far to look, in the model's unit: the image's half diagonal.

    **Returns:** the radius in the measured image, or None if the formula is one-to-one as far as
    `radius_max`. Sampled along 36 directions, refined by bisection.
    """
    p = tuple(float(v) for v in _in_order(model, parameters))
    # Every 10°: decentring moves the turning radius by its first two harmonics. In 400 steps of the
    # radius a turn is missed if it turns again within a quarter per cent.
    azimuth = np.linspace(0, 2 * np.pi, 36, endpoint=False)
    t = np.linspace(0, 1, 400)
    if model.own_formula == "to_ideal":
        radii = radius_max * t
    else:
        # Up to 200 times the half diagonal, dense near it: a barrel distortion brings far ideal
        # points into the image.
        radii = radius_max * t / (1.005 - t)
    determinant, measured = map(
        np.asarray, _determinant_along(model, p, azimuth[:, None], radii[None, :])
    )
    # NaN, beyond the range of a formula, counts as turned.
    turned = ~(determinant > 0)
    first_turn = (turned | (measured > radius_max)).argmax(1)
    turns = turned[np.arange(len(turned)), first_turn]
    azimuth, first_turn = azimuth[turns], first_turn[turns]
    if not len(azimuth):
        return None
    inner, outer = radii[np.maximum(first_turn - 1, 0)], radii[first_turn]
    for _ in range(50):  # 2⁻⁵⁰ of a step: rounding
        middle = (inner + outer) / 2
        good = np.asarray(_determinant_along(model, p, azimuth, middle)[0]) > 0
        inner, outer = np.where(good, middle, inner), np.where(good, outer, middle)
    # Where the image ends instead of turning back, there is none at `outer`.
    radius = float(np.min(_determinant_along(model, p, azimuth, inner)[1]))
    return radius if radius <= radius_max else None


def validity_message(
    camera: str,
    model: CameraModel,
    parameters: Mapping[str, float] | Sequence[float],
    half_diagonal: float,
) -> str | None:
    """A sentence for people if the distortion turns back inside the image, else None.

    **Arguments:** `camera` its name; `half_diagonal` of the image, in the model's unit.
    """
    radius = turning_radius(model, parameters, half_diagonal)
    if radius is None:
        return None
    subject, turns = end_in_words(model)
    remedy = (
        "Choose a model with a wider field or more knots across"
        if subject == "field"
        else "Free fewer distortion parameters"
    )
    return (
        f"Camera {camera!r}: the {subject} of model {model.name!r} {turns} at a radius of "
        f"{radius:.4g} {model.unit} from the principal point, inside the image, whose half "
        f"diagonal is {half_diagonal:.4g} {model.unit}: points farther out have no valid image. "
        f"{remedy}, or measure points out to the corners."
    )


def end_in_words(model: CameraModel) -> tuple[str, str]:
    """What ends where points have no ray, and how: the field of a spline ends at its last knot."""
    if "spline" in model.name:
        return "field", "ends, or its distortion turns back,"
    return "distortion", "turns back"


@partial(compile_once, static=0)
def measured_centre(model: CameraModel, p: Float[AnyArray, " parameters"]) -> Float[Array, "2"]:
    """The image of a camera's axis, the centre of its distortion."""
    return jnp.stack(model.from_ideal(tuple(p), 0.0, 0.0))


def _in_order(
    model: CameraModel, parameters: Mapping[str, float] | Sequence[float]
) -> Sequence[float]:
    if not isinstance(parameters, Mapping):
        return parameters
    values = {**default_parameters(model), **parameters}
    return [values[name] for name in model.parameters]


@partial(compile_once, static=0)
def _determinant_along(
    model: CameraModel, p: tuple[Scalar, ...], azimuth: AnyArray, radius: AnyArray
) -> tuple[Array, Array]:
    """Jacobian determinant and radius in the measured image, `radius` out from the centre."""
    formula = getattr(model, model.own_formula)
    to_ideal = model.own_formula == "to_ideal"
    centre = model.from_ideal(p, 0.0, 0.0)

    def determinant_at(azimuth: Scalar, radius: Scalar) -> tuple[Scalar, Scalar]:
        x, y = radius * jnp.cos(azimuth), radius * jnp.sin(azimuth)
        if to_ideal:
            # Measured coordinates count from the image of the axis.
            x, y = x + centre[0], y + centre[1]
        image, (a, b, c, d) = value_and_derivative(formula, p, x, y)
        if not to_ideal:
            radius = jnp.hypot(image[0] - centre[0], image[1] - centre[1])
        return a * d - b * c, radius

    return jnp.vectorize(determinant_at)(azimuth, radius)
