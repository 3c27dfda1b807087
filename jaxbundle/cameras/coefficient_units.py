"""The units of distortion coefficients, from how their effect grows with the size of an image.

If principal distance and image coordinates are multiplied by λ, a displacement must be, too. One
that a coefficient of the same value then multiplies by λᵈ leaves 1 − d powers of a length to it:
mm⁻² of Brown's K1, none of OpenCV's k1, which is of coordinates divided by the principal distance.
"""

import math

import numpy as np

from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.parameters import default_parameters
from jaxbundle.float64 import local_x64

SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def coefficient_unit(model: CameraModel, parameter: str) -> str:
    """The unit of a coefficient, such as "mm⁻²"; empty of a number, and where the model has no
    formula in image coordinates, or its coefficient is no factor of a power."""
    if model.own_formula not in ("to_ideal", "from_ideal"):
        return ""
    with local_x64():
        effects = [_effect(model, parameter, scale) for scale in (1.0, 2.0)]
    if not all(effect > 0 and math.isfinite(effect) for effect in effects):
        return ""
    exact = 1 - math.log2(effects[1] / effects[0])
    power = round(exact)
    # Effects of coefficients are of all orders; a power is one to the digits of a difference.
    if not power or abs(exact - power) > 1e-3:
        return ""
    return model.unit + ("" if power == 1 else str(power).translate(SUPERSCRIPTS))


def _effect(model: CameraModel, parameter: str, scale: float) -> float:
    """By how much a small coefficient moves a point, 13° off the axis in no symmetric direction, of
    an image of the principal distance `scale`."""
    values = default_parameters(model) | dict.fromkeys(model.principal_distance, scale)
    p = np.array([values[name] for name in model.parameters], float)
    changed = p.copy()
    changed[model.parameters.index(parameter)] += 1e-6
    point = 0.2 * scale, -0.12 * scale
    formula = getattr(model, model.own_formula)
    with_it, without = (np.array(formula(tuple(v), *point), float) for v in (changed, p))
    return float(np.hypot(*(with_it - without)))
