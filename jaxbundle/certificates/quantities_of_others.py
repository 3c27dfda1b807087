"""Quantities of robots' cameras and of refined scanner images; of any other result the numbers of
its JSON."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from jaxbundle.certificates.check_differences import CheckDifferences, check_point_quantities
from jaxbundle.certificates.quantity import (
    AXES,
    Quantity,
    QuantityValues,
    Subject,
    number_of_result,
    one_value,
    refuse_argument,
)
from jaxbundle.errors import InputError
from jaxbundle.network.columns import did_you_mean, list_some
from jaxbundle.network.kinds.robot_poses import PARTS
from jaxbundle.network.tables import EXTERIOR
from jaxbundle.refinement import Refinement
from jaxbundle.report.head import count_removed

METRE = "m"


def unknown_quantity(name: str, forms: Sequence[str]) -> str:
    """The message for an unknown quantity, with the list."""
    names = [form.partition("(")[0].rstrip("[") for form in forms]
    mean = did_you_mean(name, names, listing=False)
    return f"unknown quantity {name!r}{mean}; known: {list_some(forms, len(forms), str)}"


# --- any other result -----------------------------------------------------------------------


def find_by_path(result: Any, name: str, argument: str) -> QuantityValues:
    """The numbers of `to_dict` by their path, such as `rms`, `counts.images`, or, of every row of a
    list, `splits.d2`.

    **Raises:** `InputError` for an unknown path, and for one that leads to no number."""
    to_dict = getattr(result, "to_dict", None)
    if to_dict is None:
        raise InputError(f"expected a result of jaxbundle, got {type(result).__name__}")
    refuse_argument(argument)
    numbers = dict(_walk(to_dict(), name.split("."), name, ""))
    if not numbers:
        raise LookupError(f"{name}: the result has none")
    return QuantityValues(numbers)


def _walk(document: Any, path: Sequence[str], name: str, rows: str) -> Iterator[tuple[str, float]]:
    """The numbers below a part of a document, each with the rows of the lists that lead to it."""
    if isinstance(document, list | tuple):
        for number, row in enumerate(document, 1):
            row_name = str(row.get("id", number)) if isinstance(row, Mapping) else str(number)
            yield from _walk(row, path, name, f"{rows} {row_name}".strip())
    elif path:
        if not isinstance(document, Mapping) or path[0] not in document:
            entries = document.items() if isinstance(document, Mapping) else ()
            kinds = int | float | Mapping | list | tuple
            raise InputError(
                unknown_quantity(name, [k for k, v in entries if isinstance(v, kinds)])
            )
        yield from _walk(document[path[0]], path[1:], name, rows)
    elif document is None:
        # A number that is not finite is null in JSON; it is not accepted.
        yield rows, math.nan
    elif isinstance(document, bool) or not isinstance(document, int | float):
        raise InputError(f"{name}: is not a number of the result")
    else:
        yield rows, float(document)


# --- a camera on a robot --------------------------------------------------------------------


def _mounting(subject: Subject, argument: str) -> QuantityValues:
    """σ of the two poses that are estimated."""
    adjustment = subject.result.adjustment
    network = adjustment.problem.network
    table = subject.result.table()
    values = {
        f"{name} of {pose}": float(sigma)
        for pose, name, sigma in zip(table["of"], table["unknown"], table["sigma"])
        if (name in (*EXTERIOR[:3], *AXES)) == (argument == "position")
    }
    unit = network.angle_unit if argument == "rotation" else network.object_unit
    return QuantityValues(values, unit)


def _repeatability(subject: Subject, argument: str) -> QuantityValues:
    network = subject.result.adjustment.problem.network
    part = PARTS[argument == "rotation"]
    if part not in subject.result.repeatability:
        raise LookupError(f"the repeatability of {part} is not estimated")
    unit = network.angle_unit if argument == "rotation" else network.object_unit
    return one_value(subject.result.repeatability[part], unit)


OF_HAND_EYE: tuple[Quantity, ...] = (
    Quantity("robot.sigma(position|rotation)", "length, angle", "σ of the two poses", _mounting),
    Quantity(
        "robot.repeatability(position|rotation)",
        "length, angle",
        "σ of the robot's poses, from their residuals",
        _repeatability,
    ),
)


# --- scanner images -------------------------------------------------------------------------


def _differences(result: Refinement) -> CheckDifferences | None:
    check = result.check
    return None if check is None else CheckDifferences(check.id, check.difference, METRE)


def _point_sigma(subject: Subject, argument: str) -> QuantityValues:
    result: Refinement = subject.result
    sigma = np.asarray(result.inspection.point_sigma)[:, AXES.index(argument)]
    sigma_of_points = {
        f"{argument} of point {k}": float(s) for k, s in zip(result.point_ids, sigma) if s
    }
    if not sigma_of_points:
        raise LookupError(f"no {argument} of a point is estimated")
    return QuantityValues(sigma_of_points, METRE)


OF_REFINEMENT: tuple[Quantity, ...] = (
    Quantity("sigma0", "", "σ0 of the adjustment", number_of_result(lambda r: r.sigma0)),
    Quantity("redundancy", "", "its redundancy", number_of_result(lambda r: r.redundancy)),
    Quantity(
        "removed",
        "",
        "observations removed as blunders",
        number_of_result(lambda r: count_removed(r.removed)),
    ),
    Quantity("warnings", "", "number of warnings", number_of_result(lambda r: len(r.warnings))),
    Quantity("sigma(X|Y|Z)", "length", "σ of the points, the largest", _point_sigma),
    *check_point_quantities(_differences),
)
