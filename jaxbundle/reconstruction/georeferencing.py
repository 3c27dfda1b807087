"""Control points and satellite positions in the adjustment of a reconstruction.

1. The block is adjusted without control (`adjusting`), in the system of the satellite positions or
   in an arbitrary one; without positions the similarity that fits most of the control moves it.
2. Every control point is intersected from its rays. A ray that misses the point of the others is a
   wrong measurement; if it ends at another control point of its photograph, a wrong name.
3. The intersected points are compared with the given coordinates by leave-one-out prediction
   (`orientation.control_consistency`), which estimates the σ of control where none is given.
4. Everything is adjusted together: control with its σ, satellite positions with theirs and an
   offset between the two systems. Check points are intersected and compared; control that
   contradicts the rest is compared as tie points.
"""

import dataclasses
import re
from collections.abc import Callable, Iterator

import numpy as np

from jaxbundle.adjustment.likely_causes import CAUSES
from jaxbundle.adjustment.quality.control_prediction import predict_measurements
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.tables import Points, are_among
from jaxbundle.reconstruction.adjusting import WeightedAdjustment, adjust_determined
from jaxbundle.reconstruction.block import camera_positions
from jaxbundle.reconstruction.control_choice import (
    ControlChoice,
    assess_control,
    choose_control,
    has_doubtful_heights,
    with_heights_as_in_plane,
    without_unknown_heights,
)
from jaxbundle.reconstruction.control_mistakes import refuse_wrong_axes, refuse_wrong_columns
from jaxbundle.reconstruction.control_table import (
    ControlMeasurement,
    ControlPoint,
    ControlTable,
    describe_sigma,
)
from jaxbundle.reconstruction.controlled_network import network_with_control
from jaxbundle.reconstruction.oriented_block import (
    MIN_CONTROL,
    ControlSettings,
    FrameData,
    MeasuredPoint,
    OrientedBlock,
)
from jaxbundle.types import not_none


def georeference(
    weighted: WeightedAdjustment,
    frame: FrameData,
    significance: float,
    tell: Callable[[str], None],
    settings: ControlSettings | None = None,
) -> tuple[WeightedAdjustment, ControlTable]:
    """The adjustment with control and positions, and the table of control and check points.

    **Raises:** `InputError` or `NotSolvedError` if control does not determine the frame.
    """
    tell("control points")
    block = OrientedBlock(weighted.adjustment, frame, settings or ControlSettings())
    measured = block.resolve()
    refuse_wrong_columns(block, measured)
    control, heights = without_unknown_heights(block)
    usable = [
        k
        for k, id in enumerate(control.id)
        if control.role[k] != "check" and block.is_determined(id, measured[id])
    ]
    doubt = refuse_wrong_axes(block, control, usable)
    # Rays and intersections again, in the frame of control.
    if not block.has_positions:
        block.move(usable, control)
        measured = block.resolve()
    # In object units: a pixel is larger on the ground the higher the camera.
    assumed = block.settings.assumed_pixels * block.ground_sample_distance
    usable, assessed = assess_control(block, control, usable, assumed)
    given_sigma = control.sigma
    if has_doubtful_heights(control):
        control = with_heights_as_in_plane(control, usable, assessed)
        usable, assessed = assess_control(block, control, usable, assumed)
    choice = choose_control(block, control, measured, usable, assessed, assumed)
    # Satellite positions give the frame, but without any control the result is not in its system.
    fewest = 1 if block.has_positions else MIN_CONTROL
    if choice.used.sum() < fewest:
        raise InputError(
            f"expected {count(fewest, 'control point')} without contradictions, got "
            f"{choice.used.sum()}: "
            + list_some((f"{id}: {why}" for id, why in choice.reasons.items()), 5, str)
        )
    # Snooping begins without what was removed before; control is judged anew.
    doubtful = [pair for pair in block.removed_image_points() if pair[1] not in control.id]
    result, _, _ = adjust_determined(
        network_with_control(block, control, choice),
        snooping="pope",
        significance=significance,
        doubtful=doubtful,
    )
    if not result.converged:
        raise NotSolvedError(f"with control: {result.termination}", list(result.undetermined))
    is_used = result.problem.used
    fixed = [id for id, role in zip(control.id, control.role) if role == "fixed"]
    free = np.array([role == "control" for role in control.role])
    as_in_plane = np.isnan(given_sigma[free, 2]) & np.isfinite(control.sigma[free, 2])
    words = describe_sigma(
        given_sigma[free],
        choice.assessed(free),
        fixed,
        "m",
        block.settings.assumed_pixels,
        bool(as_in_plane.any()),
    )
    positions = camera_positions(result)
    notes = [heights] * bool(heights) + choice.remarks()
    notes += [f"data snooping removed {name}" for name in _removed_of_control(result, control)]
    notes += [] if positions is None else positions.contradictions(block.settings.offset_sigma, "m")
    warnings = [doubt] * bool(doubt)
    # Stated σ that are so far off are those of another unit or axis, as of rays.
    if choice.assessment.factor > CAUSES.max_sigma0:
        warnings.append(f"control does not fit the photographs: {words}")
    table = ControlTable(
        tuple(_tabulate(result, block, control, choice)), words, tuple(notes), "m", tuple(warnings)
    )
    return dataclasses.replace(weighted, adjustment=result, agreeing_rays=int(is_used.sum())), table


def _tabulate(
    result: Adjustment, block: OrientedBlock, control: Points, choice: ControlChoice
) -> Iterator[ControlPoint]:
    """The rows of the table."""
    final = OrientedBlock(result, block.frame, block.settings)
    checks, points = result.check_points, result.problem.network.points.id
    compared = {} if checks is None else {id: k for k, id in enumerate(checks.id)}
    snooped = _removed_of_control(result, control)
    predicted, rays = _predict(result, control, choice), _predict_rays(result, control)
    for k, id in enumerate(control.id):
        # The last adjustment may have lost photographs with their measurements.
        chosen, measured = choice.points[id], final.measure(id)
        is_good = np.isin(measured.rows, chosen.rows[chosen.good])
        measured = dataclasses.replace(measured, good=is_good)
        X, residual = np.full(3, np.nan), np.full(3, np.nan)
        if id in compared:
            X = not_none(checks).position[compared[id]]
        elif id in final.row_of_point:
            X = final.X[final.row_of_point[id]]
        if np.isfinite(X).all():
            residual = np.where(np.isinf(choice.sigma[k]), np.nan, X - control.position[k])
        away = final.misses(measured, X)
        off = away[measured.good]
        used = "held exactly" if control.role[k] == "fixed" else "used"
        verdict = used if choice.used[k] else "left out"
        verdict = "check" if control.role[k] == "check" else verdict
        reasons = [
            *([choice.reasons[id]] if id in choice.reasons else []),
            *choice.errors.get(id, []),
        ]
        reasons += [f"data snooping removed {name}" for name in snooped if _is_of_point(name, id)]
        removed_axes = [axis for axis in "XYZ" if f"{axis} of control point {id}" in snooped]
        yield ControlPoint(
            id,
            control.role[k],
            bool(choice.used[k]) and id in points,
            int(measured.good.sum()),
            control.position[k],
            np.full(3, np.nan) if control.role[k] == "fixed" else choice.sigma[k],
            residual,
            float(np.sqrt((off**2).mean())) if len(off) else np.nan,
            ": ".join([verdict, "; ".join(reasons)]) if reasons else verdict,
            *predicted.get(id, (np.full(3, np.nan), np.full(3, np.nan))),
            tuple(_measurements(final, id, measured, away, rays)),
            "".join(removed_axes),
        )


def _removed_of_control(result: Adjustment, control: Points) -> list[str]:
    """The names of removed observations of control and check points."""
    names = [removed.name for removed in result.removed]
    return [name for name in names if any(_is_of_point(name, id) for id in control.id)]


def _is_of_point(removed: str, id: str) -> bool:
    """Whether a name of removed observations (`adjustment.quality.blunder_names`) contains an image
    measurement or a coordinate of a point; "point 5" also begins the name of point "5 b"."""
    return bool(re.search(rf"point {re.escape(id)}( in image |, | or |$)", removed))


def _predict(
    result: Adjustment, control: Points, choice: ControlChoice
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Error and σ of the prediction of every point from everything else; of points that take no
    part in the result, their difference from it."""
    given = {id: (X, s) for id, X, s in zip(control.id, control.position, choice.sigma)}
    found = {}
    for table in (result.points, result.table("checks")):
        for k, id in enumerate(table.get("id", ())):
            if id in given:
                X, sigma = given[id]
                position, own = (
                    np.array([table[f"{kind}{axis}"][k] for axis in "XYZ"]) for kind in ("", "s")
                )
                free = np.isinf(sigma)
                spread = np.hypot(own, np.where(np.isfinite(sigma), sigma, 0.0))
                found[id] = tuple(np.where(free, np.nan, x) for x in (position - X, spread))
    used = result.control_prediction
    if used is not None:
        found |= {id: (e, s) for id, e, s in zip(used.id, used.error, used.sigma)}
    # Exact coordinates take part and are not predicted.
    fixed = {id for id, role in zip(result.points["id"], result.points["role"]) if role == "fixed"}
    return {id: both for id, both in found.items() if id not in fixed}


def _predict_rays(result: Adjustment, control: Points) -> dict[tuple[str, str], tuple]:
    """Distance and σ of the prediction of the image measurements that take part, pixels."""
    problem = result.problem
    is_control = are_among(problem.network.points.id, control.id)
    rays = np.flatnonzero(is_control[problem.point])
    names, error, sigma, _ = predict_measurements(result.inspection, result.sigma0, rays)
    scale = dict(zip(problem.network.images.id, _pixels(result)))
    return {
        (image, point): (
            float(np.hypot(*e)) / scale[image],
            float(np.sqrt((s**2).mean())) / scale[image],
        )
        for (image, point), e, s in zip(names, error, sigma)
    }


def _pixels(result: Adjustment) -> np.ndarray:
    """The size of a pixel in the image unit, by image."""
    network = result.problem.network
    sizes = [
        1.0 if get_model(c.model).unit == "px" or c.pixel_size is None else float(c.pixel_size[0])
        for c in network.cameras
    ]
    return np.array(sizes)[network.images.camera]


def _measurements(
    final: OrientedBlock,
    id: str,
    measured: MeasuredPoint,
    distances: np.ndarray,
    rays: dict[tuple[str, str], tuple],
) -> Iterator[ControlMeasurement]:
    """Every measurement of a point: those that take part as all others predict them, the others
    against the place of the point."""
    for n in range(len(measured.rows)):
        image = final.name_of(measured, n)
        distance, sigma = rays.get((image, id), (distances[n], measured.sigma[n]))
        finite = lambda x: float(x) if np.isfinite(x) else None
        is_used = bool(measured.good[n]) and (image, id) in rays
        yield ControlMeasurement(image, is_used, finite(distance), finite(sigma))
