"""Start values of camera parameters: defaults and checks."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.names import closest


def default_parameters(model: CameraModel) -> dict[str, float]:
    """The default values of parameters: 0, or those of the model.

    The principal distance has no default.
    """
    stated = dict(model.defaults)
    return {
        name: float(stated.get(name, 0.0))
        for name in model.parameters
        if name not in model.principal_distance
    }


def check_parameters(model: CameraModel, given: Mapping[str, float]) -> None:
    """Refuses start values that cannot describe a camera of this model.

    **Raises:** `ValueError`, for a name the model does not have, a value that is not a finite
    number or out of its range, and a principal distance that is missing, zero or negative.
    """
    where = f"Camera model {model.name!r}"
    for name, value in given.items():
        if name not in model.parameters:
            raise ValueError(
                f"{where} has no parameter {name!r}{closest(name, model.parameters)} "
                f"Its parameters are {', '.join(model.parameters)}."
            )
        if not _is_finite_number(value):
            raise ValueError(f"{where}: {name} must be a finite number, but is {value!r}.")
    for name in model.principal_distance:
        if name not in given:
            raise ValueError(
                f"{where}: {name} is missing; give the principal distance in {model.unit}."
            )
    for name in (*model.principal_distance, "format_factor"):
        if name in given and given[name] <= 0:
            raise ValueError(f"{where}: {name} must be positive, but is {given[name]!r}.")
    for name, (low, high) in dict(model.ranges).items():
        if name in given and not low <= given[name] < high:
            end = "" if high == math.inf else f" and below {high:g}"
            raise ValueError(
                f"{where}: {name} must be at least {low:g}{end}, but is {given[name]!r}."
            )


def _is_finite_number(value: Any) -> bool:
    try:
        # True would be 1, and a masked value whatever lies under the mask.
        return not (isinstance(value, bool) or np.ma.is_masked(value)) and math.isfinite(value)
    except (TypeError, OverflowError):
        return False
