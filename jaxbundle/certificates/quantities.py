"""The quantities of results that acceptance criteria may name.

A quantity is one number or several, of all parameters, images, points or cameras it concerns: a
criterion must hold for each of them.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from jaxbundle.adjustment.budget_inputs import unit_of_parameter
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.batches.population import Population
from jaxbundle.calibration.result import Calibration
from jaxbundle.calibration.rig.result import RigCalibration
from jaxbundle.calibration.several import Calibrations
from jaxbundle.certificates.check_differences import CheckDifferences, check_point_quantities
from jaxbundle.certificates.lengths import LengthTest
from jaxbundle.certificates.quantities_of_batches import OF_BATCH
from jaxbundle.certificates.quantities_of_others import (
    OF_HAND_EYE,
    OF_REFINEMENT,
    find_by_path,
    unknown_quantity,
)
from jaxbundle.certificates.quantity import (
    AXES,
    Quantity,
    QuantityValues,
    Subject,
    number_of_result,
    one_value,
    require_parameter,
    require_rig_camera,
    rig_camera_and_name,
)
from jaxbundle.certificates.units import NO_PITCH, PixelPitch
from jaxbundle.errors import InputError
from jaxbundle.network.tables import EXTERIOR
from jaxbundle.reconstruction.result import Reconstruction
from jaxbundle.refinement import Refinement
from jaxbundle.report.correlated import stated_sigma, stated_sigma_of
from jaxbundle.report.head import count_removed
from jaxbundle.types import not_none


def offered(kind: str) -> dict[str, Quantity]:
    """The quantities of a command's result, by name; none of a command whose quantities are the
    numbers of its JSON."""
    groups_of_quantities = {
        "adjust": (OF_ADJUSTMENT,),
        "calibrate": (OF_CALIBRATION, OF_ADJUSTMENT),
        "calibrate-rig": (OF_RIG,),
        "reconstruct": (OF_RECONSTRUCTION, OF_ADJUSTMENT),
        "batch": (OF_BATCH,),
        "hand-eye": (OF_HAND_EYE, OF_ADJUSTMENT),
        "pushbroom refine": (OF_REFINEMENT,),
    }.get(kind, ())
    by_name: dict[str, Quantity] = {}
    for quantities in groups_of_quantities:
        for quantity in quantities:
            by_name.setdefault(quantity.name, quantity)
    return by_name


def find_quantity(
    result: Any, lengths: LengthTest | None, name: str, argument: str
) -> QuantityValues:
    """The values of a quantity in a result, of all of its parts.

    **Raises:** `InputError` for an unknown quantity or argument; `LookupError` with the reason if
    the result does not have it."""
    groups = _parts_of(result)
    for quantities, subjects in groups:
        by_name = {quantity.name: quantity for quantity in quantities}
        if name in by_name:
            by_name[name].check_argument(argument)
            parts = {
                label: by_name[name].find(Subject(part_result, lengths), argument)
                for label, part_result in subjects.items()
            }
            return _join(parts)
    if not groups:
        return find_by_path(result, name, argument)
    forms = {quantity.form for quantities, _ in groups for quantity in quantities}
    raise InputError(unknown_quantity(name, sorted(forms)))


def _parts_of(result: Any) -> list[tuple[tuple[Quantity, ...], dict[str, Any]]]:
    """Quantities, and the results by name that have them, of a result and its parts."""
    if isinstance(result, Adjustment):
        return [(OF_ADJUSTMENT, {"": result})]
    if isinstance(result, Calibration):
        return [(OF_CALIBRATION, {"": result}), (OF_ADJUSTMENT, {"": result.adjustment})]
    if isinstance(result, RigCalibration):
        return [(OF_RIG, {"": result})]
    if isinstance(result, Calibrations):
        if result.rig is not None:
            return [(OF_RIG, {"": result.rig})]
        is_single = len(result.cameras) == 1
        calibrations = {
            "" if is_single else name: calibration for name, calibration in result.cameras.items()
        }
        adjusted = {name: calibration.adjustment for name, calibration in calibrations.items()}
        return [(OF_CALIBRATION, calibrations), (OF_ADJUSTMENT, adjusted)]
    if isinstance(result, Reconstruction):
        is_single = len(result.parts) == 1
        parts = {"" if is_single else part.name: part.adjustment for part in result.parts}
        return [(OF_RECONSTRUCTION, {"": result}), (OF_ADJUSTMENT, parts)]
    if isinstance(result, Population):
        return [(OF_BATCH, {"": result})]
    if isinstance(result, Refinement):
        return [(OF_REFINEMENT, {"": result})]
    if isinstance(adjustment := getattr(result, "adjustment", None), Adjustment):
        # Of a camera on a robot, which is above this room.
        return [(OF_HAND_EYE, {"": result}), (OF_ADJUSTMENT, {"": adjustment})]
    return []


def _join(parts: Mapping[str, QuantityValues]) -> QuantityValues:
    """Values of several parts; their units are the same, or it is said."""
    units = {part.unit for part in parts.values()}
    if len(units) > 1:
        raise LookupError(f"its parts have different units: {', '.join(sorted(units))}")
    pitches = {part.pitch for part in parts.values()}
    values = {
        " ".join(word for word in (name, label) if word): value
        for label, part in parts.items()
        for name, value in part.values.items()
    }
    owners = {name: owner for part in parts.values() for name, owner in part.owners.items()}
    pitch = pitches.pop() if len(pitches) == 1 else NO_PITCH
    return QuantityValues(values, units.pop(), pitch, owners)


# --- adjustment -----------------------------------------------------------------------------


def _pitch(cameras: Any) -> PixelPitch:
    """The pixel size where all cameras have the same square one."""
    sizes = {camera.pixel_size for camera in cameras}
    if len(sizes) == 1 and (size := next(iter(sizes))) is not None and size[0] == size[1]:
        return PixelPitch(float(size[0]))
    return NO_PITCH


WITH_ARTICLE = {"image": "an image", "point": "a point"}


def named_unknown(argument: str, of_cameras_alone: bool = False) -> tuple[str, str, str]:
    """KIND, ID and NAME of an argument: a parameter alone is that of all cameras, images or
    points.

    **Raises:** `InputError` for another form, and for a name that no image or point has, or that is
    none of a camera where only cameras have the quantity."""
    kind, id, name = _split_argument(argument)
    if kind == "camera":
        return kind, id, name
    if of_cameras_alone:
        raise InputError("only parameters of cameras have it, such as c")
    known_names = EXTERIOR if kind == "image" else AXES
    if name not in known_names:
        raise InputError(
            f"there is no {name!r} of {WITH_ARTICLE[kind]}; known: {', '.join(known_names)}"
        )
    return kind, id, name


def _split_argument(argument: str) -> tuple[str, str, str]:
    kind, mark, after_kind = argument.partition(":")
    id, second_mark, name = after_kind.rpartition(":")
    if mark and second_mark and name and kind in ("camera", "image", "point"):
        return kind, id, name
    if mark:
        raise InputError(
            f"({argument}): expected a parameter, such as c, or KIND:ID:NAME, such as "
            "camera:cam:c, image:*:X0 or point:7:Z"
        )
    if not argument:
        raise InputError("expected a parameter in parentheses, such as (c), (X0) or (Z)")
    if argument in EXTERIOR:
        return "image", "*", argument
    if argument in AXES:
        return "point", "*", argument
    return "camera", "*", argument


def _parameters(
    subject: Subject,
    argument: str,
    of_camera: Callable[[Mapping[str, Any]], float | None],
    of_table: Callable[[Mapping[str, np.ndarray], str], np.ndarray] | None,
    unit_less: bool = False,
) -> QuantityValues:
    """A number for each of the named unknowns that are estimated."""
    adjustment: Adjustment = subject.result
    kind, id, name = named_unknown(argument, of_table is None)
    network = adjustment.problem.network
    if kind == "camera":
        return _of_cameras(adjustment, id, name, of_camera, unit_less)
    rows = adjustment.images if kind == "image" else adjustment.points
    values, ids = not_none(of_table)(rows, name), [str(x) for x in rows["id"]]
    if id not in ("*", *ids):
        raise LookupError(f"there is no {kind} {id!r}")
    free = stated_sigma(rows, name) > 0
    named_unknowns = {
        f"{name} of {kind} {k}": float(v)
        for k, v, is_free in zip(ids, values, free)
        if is_free and id in ("*", k) and math.isfinite(v)
    }
    if not named_unknowns:
        raise LookupError(f"no {name} of {WITH_ARTICLE[kind]} is estimated")
    angle = name in EXTERIOR[3:]
    return QuantityValues(named_unknowns, network.angle_unit if angle else network.object_unit)


def _of_cameras(
    adjustment: Adjustment,
    id: str,
    name: str,
    of_camera: Callable[[Mapping[str, Any]], float | None],
    unit_less: bool,
) -> QuantityValues:
    cameras = [c for c in adjustment.problem.network.cameras if id in ("*", c.id)]
    if not cameras:
        raise LookupError(f"there is no camera {id!r}")
    values, units = {}, set()
    for camera in cameras:
        entry = adjustment.cameras[camera.id]["parameters"].get(name)
        value = None if entry is None or not entry["free"] else of_camera(entry)
        if value is not None:
            values[f"{name} of camera {camera.id}"] = float(value)
            units.add("" if unit_less else unit_of_parameter(camera.model, name))
    if not values:
        require_parameter(cameras, name)
        raise LookupError(f"{name} is held, and not estimated")
    if len(units) > 1:
        raise LookupError(f"{name} has different units: {', '.join(sorted(units))}")
    return QuantityValues(values, units.pop(), _pitch(cameras))


def _sigma(subject: Subject, argument: str) -> QuantityValues:
    return _parameters(subject, argument, stated_sigma_of, stated_sigma)


def _value(subject: Subject, argument: str) -> QuantityValues:
    return _parameters(
        subject, argument, lambda entry: entry["value"], lambda rows, name: rows[name]
    )


def _t(subject: Subject, argument: str) -> QuantityValues:
    return _parameters(subject, argument, lambda entry: entry["t"], None, unit_less=True)


def _total_correlation(subject: Subject, argument: str) -> QuantityValues:
    find = lambda entry: entry["total_correlation"]
    return _parameters(subject, argument, find, None, unit_less=True)


def _rms_sigma(subject: Subject, argument: str) -> QuantityValues:
    sigmas = _sigma(subject, argument)
    values = np.array(list(sigmas.values.values()))
    return dataclasses.replace(sigmas, values={"": float(np.sqrt(np.mean(values**2)))})


def _image_rms(subject: Subject, _: str) -> QuantityValues:
    adjustment: Adjustment = subject.result
    pitch = _pitch(adjustment.problem.network.cameras)
    return QuantityValues({"": adjustment.image_rms}, adjustment.image_unit, pitch)


def _differences(result: Adjustment) -> CheckDifferences | None:
    table = result.table("checks")
    if not table:
        return None
    difference = np.stack([table[f"d{axis}"] for axis in AXES], 1)
    return CheckDifferences(table["id"].tolist(), difference, result.network.object_unit)


def _control_rms(subject: Subject, argument: str) -> QuantityValues:
    adjustment: Adjustment = subject.result
    rows = adjustment.residuals
    is_control = rows["kind"] == "control"
    if not is_control.any():
        raise LookupError("the result has no control points with σ")
    mean = [
        np.mean(rows["v"][chosen] ** 2)
        for axis in AXES
        if argument in ("", axis) and (chosen := is_control & (rows["axis"] == axis)).any()
    ]
    if not mean:
        raise LookupError(f"no control point has a σ in {argument}")
    return one_value(math.sqrt(sum(mean)), adjustment.network.object_unit)


def _lengths(subject: Subject) -> LengthTest:
    if subject.lengths is None:
        raise LookupError("no calibrated lengths are given (--lengths)")
    return subject.lengths


def _lme(subject: Subject, _: str) -> QuantityValues:
    test = _lengths(subject)
    errors: dict[tuple[str, str], float] = {}
    for ends, error in zip(test.lengths.ends, np.abs(test.error).tolist()):
        # Of repetitions the largest: each of them has to meet the limit.
        errors[ends] = max(error, errors.get(ends, 0.0))
    # A length that was not measured is not accepted.
    errors |= dict.fromkeys(test.missing, math.nan)
    return QuantityValues({f"length {a} – {b}": e for (a, b), e in errors.items()}, test.unit)


def _lme_rms(subject: Subject, _: str) -> QuantityValues:
    return one_value(_lengths(subject).rms, _lengths(subject).unit)


def _lme_number(subject: Subject, _: str) -> QuantityValues:
    return one_value(len(_lengths(subject).lengths))


def _chi_squared(adjustment: Adjustment) -> float:
    test = adjustment.global_test()
    if test["passed"] is None:
        raise LookupError("no χ² test is made: no a priori σ is stated")
    return test["vtpv"] / test["high"]


OF_ADJUSTMENT: tuple[Quantity, ...] = (
    Quantity("sigma0", "", "σ0 of the adjustment", number_of_result(lambda a: a.sigma0)),
    Quantity(
        "redundancy", "", "redundancy of the adjustment", number_of_result(lambda a: a.redundancy)
    ),
    Quantity(
        "chi2", "", "vᵀPv over the upper limit of its χ² test", number_of_result(_chi_squared)
    ),
    Quantity(
        "observations",
        "",
        "number of observations",
        number_of_result(lambda a: a.counts.observations),
    ),
    Quantity(
        "images", "", "number of images", number_of_result(lambda a: len(a.problem.network.images))
    ),
    Quantity(
        "points",
        "",
        "number of points",
        number_of_result(lambda a: int((~a.problem.excluded).sum())),
    ),
    Quantity(
        "removed",
        "",
        "observations removed as blunders",
        number_of_result(lambda a: count_removed(a.removed)),
    ),
    Quantity("warnings", "", "number of warnings", number_of_result(lambda a: len(a.warnings))),
    Quantity(
        "r", "", "smallest redundancy number", number_of_result(lambda a: a.residuals["r"].min())
    ),
    Quantity("sigma(NAME)", "of NAME", "σ of an unknown, the largest of several", _sigma),
    Quantity(
        "sigma.rms(NAME)",
        "of NAME",
        "its root mean square over cameras, images, points",
        _rms_sigma,
    ),
    Quantity("value(NAME)", "of NAME", "the adjusted value", _value),
    Quantity("t(NAME)", "", "value over σ of a camera parameter", _t),
    Quantity(
        "correlation(NAME)", "", "total correlation of a camera parameter", _total_correlation
    ),
    Quantity("image.rms", "px, length", "RMS residual of an image coordinate", _image_rms),
    *check_point_quantities(_differences),
    Quantity("control.rms[(X|Y|Z)]", "length", "RMS residual of control", _control_rms),
    Quantity("LME", "length", "largest length measurement error (--lengths)", _lme),
    Quantity("LME.rms", "length", "RMS of length measurement errors", _lme_rms),
    Quantity("LME.number", "", "number of compared lengths", _lme_number),
)


# --- calibration ----------------------------------------------------------------------------


def _calibrated(
    function: Callable[[Calibration], float], unit: str = ""
) -> Callable[[Subject, str], QuantityValues]:
    def find(subject: Subject, _: str) -> QuantityValues:
        camera = not_none(subject.result).camera
        return QuantityValues({"": float(function(subject.result))}, unit, _pitch([camera]))

    return find


OF_CALIBRATION: tuple[Quantity, ...] = (
    Quantity("rms", "px", "RMS of an image point", _calibrated(lambda c: c.rms, "px")),
    Quantity("views", "", "photographs used", _calibrated(lambda c: len(c.views))),
    Quantity(
        "coverage",
        "",
        "share of the image's cells with points",
        _calibrated(lambda c: c.coverage.part),
    ),
    Quantity(
        "mapping_error",
        "px",
        "expected mapping error over the image",
        _calibrated(lambda c: c.mapping_error.rms, "px"),
    ),
    Quantity(
        "uncertainty.middle",
        "px",
        "σ of a projected point at infinity, middle",
        _calibrated(lambda c: c.uncertainty().middle, "px"),
    ),
    Quantity(
        "uncertainty.corners",
        "px",
        "the same in the worst corner",
        _calibrated(lambda c: c.uncertainty().corners, "px"),
    ),
)


# --- rigs -----------------------------------------------------------------------------------


def _rig_rms(subject: Subject, argument: str) -> QuantityValues:
    rig: RigCalibration = subject.result
    camera = argument or "*"
    require_rig_camera(camera, rig.rms)
    rms_of_cameras = {f"camera {n}": v for n, v in rig.rms.items() if camera in ("*", n)}
    return QuantityValues(rms_of_cameras, "px", _pitch([rig.camera(n) for n in rig.names]))


def _rig_sigma(subject: Subject, argument: str) -> QuantityValues:
    rig: RigCalibration = subject.result
    if argument in ("base", "rotation"):
        return _mountings(rig, argument)
    camera, name = rig_camera_and_name(argument)
    require_rig_camera(camera, rig.names)
    cameras = {n: rig.camera(n) for n in rig.names if camera in ("*", n)}
    values = {f"{name} of camera {n}": rig.sigma[n][name] for n in cameras if name in rig.sigma[n]}
    if not values:
        require_parameter(cameras.values(), name)
        raise LookupError(f"{name} is held, and not estimated")
    units = {unit_of_parameter(cameras[n].model, name) for n in cameras if name in rig.sigma[n]}
    if len(units) > 1:
        raise LookupError(f"{name} has different units: {', '.join(sorted(units))}")
    return QuantityValues(values, units.pop(), _pitch(cameras.values()))


def _mountings(rig: RigCalibration, kind: str) -> QuantityValues:
    if kind == "base":
        values = {f"base of {n}": m.length_sigma for n, m in rig.mountings.items()}
        return QuantityValues(values, rig.object_unit)
    # Angles of a mounting are in degrees.
    values = {f"rotation of {n}": float(max(m.sigma[3:])) for n, m in rig.mountings.items()}
    return QuantityValues(values, "deg")


OF_RIG: tuple[Quantity, ...] = (
    Quantity("sigma0", "", "σ0 of the common adjustment", number_of_result(lambda r: r.sigma0)),
    Quantity("redundancy", "", "redundancy of the rig", number_of_result(lambda r: r.redundancy)),
    Quantity("epochs", "", "epochs used", number_of_result(lambda r: len(r.epochs))),
    Quantity("left_out", "", "epochs left out", number_of_result(lambda r: len(r.left_out))),
    Quantity("rms[(CAMERA)]", "px", "RMS of an image point by camera", _rig_rms),
    Quantity(
        "sigma(NAME|CAMERA:NAME|base|rotation)",
        "of NAME",
        "σ of a parameter, of the bases, of the rotations of the mountings",
        _rig_sigma,
    ),
)


# --- reconstruction -------------------------------------------------------------------------


OF_RECONSTRUCTION: tuple[Quantity, ...] = (
    Quantity("parts", "", "parts of the reconstruction", number_of_result(lambda r: len(r.parts))),
    Quantity("left_out", "", "photographs left out", number_of_result(lambda r: len(r.left_out))),
    Quantity(
        "misfit",
        "",
        "how many times worse than their σ measurements fit",
        number_of_result(lambda r: max((p.misfit for p in r.parts), default=math.nan)),
    ),
)
