"""Differences at check points as quantities: of networks and of refined scanner images."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.certificates.quantity import (
    AXES,
    Quantity,
    QuantityValues,
    Subject,
    number_of_result,
    one_value,
)

PARTS = {"": AXES, "H": AXES[:2], "V": AXES[2:], "3D": AXES, **{axis: (axis,) for axis in AXES}}


class CheckDifferences(NamedTuple):
    """Check points and their differences, NaN on axes that are not known, in `unit`."""

    id: Sequence[str]
    difference: Float[np.ndarray, "points 3"]
    unit: str


def check_point_quantities(
    differences_of: Callable[[Any], CheckDifferences | None],
) -> tuple[Quantity, ...]:
    """`check.rms`, `check.max` and `check.number` of results; `differences_of` one, None without
    check points."""

    def number(result: Any) -> int:
        differences = differences_of(result)
        return 0 if differences is None else len(differences.id)

    def known_differences(subject: Subject, argument: str) -> tuple[CheckDifferences, list[int]]:
        """The differences, and the axes of the argument on which some are known: what is not known
        does not count as 0."""
        differences = differences_of(subject.result)
        if differences is None:
            raise LookupError("the result has no check points")
        is_known = np.asarray(np.isfinite(differences.difference).any(0))
        axes = [i for i, axis in enumerate(AXES) if axis in PARTS[argument] and is_known[i]]
        # Without an argument it is that of all axes that are known.
        if not axes or (argument and len(axes) < len(PARTS[argument])):
            raise LookupError("no check point has this difference")
        return differences, axes

    def rms(subject: Subject, argument: str) -> QuantityValues:
        differences, axes = known_differences(subject, argument)
        square = np.nanmean(differences.difference[:, axes] ** 2, axis=0).sum()
        return one_value(math.sqrt(square), differences.unit)

    def largest(subject: Subject, argument: str) -> QuantityValues:
        differences, axes = known_differences(subject, argument)
        values = {
            f"{AXES[i]} of check point {id}": abs(float(d))
            for i in axes
            for id, d in zip(differences.id, differences.difference[:, i])
            if math.isfinite(d)
        }
        return QuantityValues(values, differences.unit)

    return (
        Quantity(
            "check.rms[(X|Y|Z|H|V|3D)]",
            "length",
            "RMS difference at check points, of all axes",
            rms,
        ),
        Quantity("check.max[(X|Y|Z)]", "length", "largest difference at check points", largest),
        Quantity("check.number", "", "number of check points", number_of_result(number)),
    )
