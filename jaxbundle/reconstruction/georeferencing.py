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
from collections.abc import Callable, Iterator

import numpy as np

from jaxbundle.adjustment.result import Adjustment
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.network.columns import list_some
from jaxbundle.network.tables import Points
from jaxbundle.reconstruction.adjusting import WeightedAdjustment, adjust_determined
from jaxbundle.reconstruction.block import camera_positions
from jaxbundle.reconstruction.control_choice import (
    ControlChoice,
    assess_control,
    choose_control,
    without_unknown_heights,
)
from jaxbundle.reconstruction.control_table import ControlPoint, ControlTable, describe_sigma
from jaxbundle.reconstruction.controlled_network import network_with_control
from jaxbundle.reconstruction.oriented_block import (
    MIN_CONTROL,
    ControlSettings,
    FrameData,
    OrientedBlock,
)
from jaxbundle.types import present


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
    control, heights = without_unknown_heights(block)
    usable = [
        k
        for k, id in enumerate(control.id)
        if control.role[k] != "check" and block.is_determined(id, measured[id])
    ]
    # rays and intersections again, in the frame of control
    if not block.has_positions:
        block.move(usable, control)
        measured = block.resolve()
    assumed = block.settings.assumed_pixels * block.ground_sample_distance
    # in object units: a pixel is larger on the ground the higher the camera
    usable, assessed = assess_control(block, control, usable, assumed)
    choice = choose_control(block, control, measured, usable, assessed, assumed)
    if not block.has_positions and choice.used.sum() < MIN_CONTROL:
        raise InputError(
            f"expected {MIN_CONTROL} control points without contradictions, got "
            f"{choice.used.sum()}: "
            + list_some((f"{id}: {why}" for id, why in choice.reasons.items()), 5, str)
        )
    # snooping begins without what was removed before; control is judged anew
    doubtful = [pair for pair in block.removed() if pair[1] not in control.id]
    result, _, _ = adjust_determined(
        network_with_control(block, control, choice),
        snooping="pope",
        significance=significance,
        doubtful=doubtful,
    )
    if not result.converged:
        raise NotSolvedError(f"with control: {result.termination}", list(result.undetermined))
    used = result.problem.used
    fixed = [id for id, role in zip(control.id, control.role) if role == "fixed"]
    free = np.array([role == "control" for role in control.role])
    words = describe_sigma(control.sigma[free], choice.assessed(free), fixed, "m")
    positions = camera_positions(result)
    notes = [heights] * bool(heights) + choice.remarks()
    notes += [] if positions is None else positions.contradictions(block.settings.offset_sigma, "m")
    table = ControlTable(tuple(_tabulate(result, block, control, choice)), words, tuple(notes), "m")
    return dataclasses.replace(weighted, adjustment=result, agreeing_rays=int(used.sum())), table


def _tabulate(
    result: Adjustment, block: OrientedBlock, control: Points, choice: ControlChoice
) -> Iterator[ControlPoint]:
    """The rows of the table."""
    final = OrientedBlock(result, block.frame, block.settings)
    checks, points = result.check_points, result.problem.network.points.id
    compared = {} if checks is None else {id: k for k, id in enumerate(checks.id)}
    snooped = [removed.name for removed in result.removed]
    for k, id in enumerate(control.id):
        measured = dataclasses.replace(final.measure(id), good=choice.points[id].good)
        X, residual = np.full(3, np.nan), np.full(3, np.nan)
        if id in compared:
            X = present(checks).position[compared[id]]
        elif id in final.of_id:
            X = final.X[final.of_id[id]]
        if np.isfinite(X).all():
            residual = np.where(np.isinf(choice.sigma[k]), np.nan, X - control.position[k])
        off = final.misses(measured, X)[measured.good]
        used = "held exactly" if control.role[k] == "fixed" else "used"
        verdict = used if choice.used[k] else "left out"
        verdict = "check" if control.role[k] == "check" else verdict
        reasons = [
            *([choice.reasons[id]] if id in choice.reasons else []),
            *choice.errors.get(id, []),
        ]
        reasons += [
            f"data snooping removed {name}" for name in snooped if f"point {id} " in f"{name} "
        ]
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
        )
