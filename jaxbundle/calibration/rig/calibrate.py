"""Rig calibration: cameras are calibrated separately first, then together with the mounting.

    ray of camera k = R_k·(Y − b_k)      Y: point in the frame of the reference camera

Simultaneous photographs are an epoch; they are matched by equal file names, or else equal last
numbers in them (left_017.jpg, right_017.jpg). Each camera may see other boards than the others:
boards that move by themselves have a pose at every epoch, boards that are fixed to each other have
one common pose and unknown relations. What ties the cameras, by boards seen simultaneously, by
other cameras, or by the motion of the rig, is found by `connections`, which gives the start values.
Cameras that are not synchronised have no epochs in common: their clocks are unknowns
(`synchronize`). Epochs that contradict the mounting (the board moved in between) are excluded, or
only listed without snooping. The boards are known, weighted or free, as in the calibration of one
camera. Gross errors are removed camera by camera, then those that only the mounting reveals.
"""

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.arguments import one_of, show
from jaxbundle.batches.epochs import contradicting
from jaxbundle.calibration.calibrate import calibrate
from jaxbundle.calibration.each_camera import calibrate_each
from jaxbundle.calibration.pixels import unit_size
from jaxbundle.calibration.result import Calibration
from jaxbundle.calibration.rig.connections import Connections, MotionTie
from jaxbundle.calibration.rig.declare import Rig, adjust_rig, leave_out, snoop_rig, used_rays
from jaxbundle.calibration.rig.known_mountings import known_mountings
from jaxbundle.calibration.rig.photographs import RigPhotographs, require_lists, views_of_camera
from jaxbundle.calibration.rig.result import RigCalibration
from jaxbundle.calibration.rig.start import start_rig
from jaxbundle.calibration.rig.synchronize import (
    adjust_unsynchronized,
    start_unsynchronized,
    without_run,
)
from jaxbundle.calibration.rig.times import HOW, times_of_photographs
from jaxbundle.calibration.rig.wand_body import Wand, add_wand, start_wand
from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.leastsquares import Result
from jaxbundle.leastsquares.quality.snooping import check_test
from jaxbundle.measure.boards import Board
from jaxbundle.measure.views import BoardViews
from jaxbundle.network.columns import list_some
from jaxbundle.network.kinds.continuous_time import CLOCK_PARAMETERS
from jaxbundle.types import Progress

# Options of a camera that are those of its rig, too.
SHARED = ("board_sigma", "board_free", "snooping", "significance", "max_iterations")


def calibrate_rig(  # noqa: PLR0913 - what a rig may be given by
    photographs: Mapping[str, RigPhotographs],
    board: Board | Mapping[str, Board] | str | Path | None = None,
    *,
    fixed: bool = False,
    bodies: Mapping[str, Sequence[str]] | None = None,
    seen_by: Mapping[str, Sequence[str]] | None = None,
    mountings: Mapping[str, Any] | str | Path | None = None,
    bases: Sequence[Mapping[str, Any]] = (),
    wand: Wand | None = None,
    synchronize: str | Sequence[str] = (),
    times: Any = None,
    progress: Progress | None = None,
    **options: Any,
) -> RigCalibration:
    """Calibrate cameras on one rigid mounting, from simultaneous photographs of any boards.

        boards = {"front": Board(9, 6, 0.03), "back": Board(8, 5, 0.03)}
        found = calibrate_rig({"a": ["a/"], "b": ["b/"]}, boards, fixed=True)
        found.mountings["b"].base, found.mountings["b"].sigma

    **Arguments:**

    - `photographs` by the name of the camera, the first is the reference: files, patterns, folders;
      `BoardViews`, of several boards by their names; or the `Calibration` of the camera by itself.
    - `board`: the board in the photographs, or several by name, or a file of them
      (`jaxbundle.io.read_boards`), whose `bodies` and `seen_by` count as well.
    - `fixed`: all boards are fixed to each other, as on walls around a rig that moves; their
      relations are estimated. `bodies`: by any name, the boards that are fixed to each other. Other
      boards move by themselves.
    - `seen_by`: by the name of a board, the cameras in whose photographs it is searched; all by
      default.
    - `mountings`, `bases`: what is known of the mountings, held or with σ, as in the section
      `[rig]` of a project (degrees), such as `{"b": {"position": [0, 0, 0.1], "sigma_position":
      0.01}}`; or a file with that section.
    - `wand`: a wand waved before the cameras while they stood still, a `calibration.Wand`: it ties
      cameras, those that see no board, too, and its length gives the scale beside the boards.
    - `synchronize`: unknowns of the clocks of cameras that run by themselves, of "offset", "rate"
      and "read-out" (of a rolling shutter): nothing is simultaneous then, targets move along
      splines in time, and `clocks` of the result has the unknowns. Photographs must follow each
      other closely, as frames of a video; `times`: of them, frames per second (the last number in a
      name is that of the frame), by camera if they differ; or seconds by camera and name; or the
      path of a table with columns camera, image, time.
    - `board_sigma` (object unit), `board_free` (one board only, not with `synchronize`),
      `snooping`, `significance`, `max_iterations` of cameras and rig, and further `options` of
      the cameras: as in `calibrate`.
      Without snooping, epochs that contradict the mounting are kept and listed in `contradicting`.
    - `progress(stage, done, total)`: photographs searched, a stage for every camera.

    **Raises:** `InputError` if photographs cannot be paired, or cameras do not hang together, with
    what would join them; `NotSolvedError` if an adjustment does not converge, or the motion of the
    rig does not determine a mounting that nothing else does.
    """
    check_test(options.get("snooping", "pope"), options.get("significance", 0.001))
    wand_cameras = (
        [] if wand is None else [name for name in wand.markers if name not in photographs]
    )
    _check(photographs, wand_cameras)
    known_of_mountings = known_mountings(mountings, bases, [*photographs, *wand_cameras])
    unknowns = _unknowns_of_clocks(synchronize, times, bool(options.get("board_free")))
    if bodies is not None:
        bodies = require_lists("bodies", bodies, "{'room': ['front', 'rear']}")
    if fixed and bodies:
        raise InputError("fixed: all boards are one body; give either fixed or bodies")
    if wand is not None and (unknowns or options.get("board_free")):
        raise InputError("wand: expected cameras that are synchronised, and boards that are known")
    views, declared = views_of_camera(photographs, board, seen_by, progress)
    calibrations = _calibrate_cameras(views, options, progress)
    shared_options = {name: options[name] for name in SHARED if name in options}
    if options.get("robust") and not shared_options.get("snooping"):
        # Points downweighted in a camera have full weight in the rig.
        shared_options["snooping"] = "pope"
    bodies = declared if bodies is None else bodies
    if unknowns:
        seconds = times_of_photographs(calibrations, times)
        rig, connections = start_unsynchronized(
            calibrations, bodies, fixed, known_of_mountings, seconds, unknowns
        )
    else:
        body = None
        if wand is not None:
            unit = next(iter(calibrations.values())).adjustment.network.object_unit
            body = start_wand(wand, calibrations, unit, progress)
        rig, connections = start_rig(calibrations, bodies, fixed, known_of_mountings, wand=body)
        if body is not None:
            rig = add_wand(rig, body, connections, calibrations)
    return _adjust_together(calibrations, rig, connections, **shared_options)


def _unknowns_of_clocks(
    synchronize: str | Sequence[str], times: Any, board_free: bool
) -> tuple[str, ...]:
    """The unknowns of clocks.

    **Raises:** `InputError` for others, without times, or with free points."""
    words = synchronize.split(",") if isinstance(synchronize, str) else synchronize
    if not (isinstance(words, Collection) and all(isinstance(word, str) for word in words)):
        raise InputError(
            f"synchronize: got {show(synchronize)}; expected unknowns of the clocks, of "
            f"{', '.join(CLOCK_PARAMETERS)}"
        )
    unknowns = tuple(word.strip() for word in words if word.strip())
    for word in unknowns:
        one_of("synchronize", word, CLOCK_PARAMETERS)
    if unknowns and times is None:
        raise InputError(f"synchronize: the times of the photographs are missing (times); {HOW}")
    if times is not None and not unknowns:
        raise InputError("times: are for cameras that are not synchronised; give synchronize, too")
    if unknowns and board_free:
        # A similarity of the points has no action on control poses (`declare.FLOATING`).
        raise InputError(
            "board_free: points of a board are not free where cameras are not synchronised; "
            "expected board_sigma, or known points"
        )
    return unknowns


def _calibrate_cameras(
    views: Mapping[str, BoardViews | Calibration],
    options: Mapping[str, Any],
    progress: Progress | None,
) -> dict[str, Calibration]:
    """The calibration of every camera by itself."""
    if all(isinstance(calibration, Calibration) for calibration in views.values()):
        unused = {*options} - {*SHARED, "robust"}
        if unused:
            raise InputError(
                f"{', '.join(sorted(unused))}: for the calibration of each camera, but all of them "
                "are calibrated already; omit it"
            )

    def calibrate_one(
        name: str, photographs_or_calibration: Any, tell: Progress | None
    ) -> Calibration:
        if isinstance(photographs_or_calibration, Calibration):
            return photographs_or_calibration
        return calibrate(photographs_or_calibration, camera=name, progress=tell, **options)

    calibrations = calibrate_each(views, calibrate_one, progress)
    for name, calibration in calibrations.items():
        if not calibration.converged:
            why = calibration.adjustment.termination
            raise NotSolvedError(f"not solved: camera {name} alone: {why}")
    return calibrations


def _adjust_together(
    calibrations: Mapping[str, Calibration],
    rig: Rig,
    connections: Connections,
    *,
    board_sigma: float | None = None,
    board_free: bool = False,
    snooping: str | None = "pope",
    significance: float = 0.001,
    max_iterations: int = 50,
) -> RigCalibration:
    """The common adjustment of separately calibrated cameras."""
    if board_free and len(rig.boards) > 1:
        raise InputError(
            f"the points of {len(rig.boards)} boards cannot be free: each would have a frame of "
            "its own; give the σ of their coordinates instead (--board-sigma)"
        )
    rig = dataclasses.replace(rig, point_sigma=board_sigma, points_free=board_free)
    size = np.array(
        [unit_size(get_model(camera.model), camera.pixel_size) for camera in rig.cameras]
    )
    left_out, held_unknowns = [], {}
    if rig.trajectory is None:
        result = adjust_rig(rig, max_iterations)
    else:
        rig, result, held_unknowns = adjust_unsynchronized(rig, max_iterations)
        left_out = without_run(rig)
    require_solved(result, connections.ties)
    # Each time from the start values: a wrong epoch may have led the adjustment far away.
    while (contradictions := _contradictions(rig, result, size)) and snooping:
        why = (
            "does not fit the mounting (RMS {:.1f} px): photographs not simultaneous?"
            if rig.trajectory is None
            else "does not fit the motion and the mounting (RMS {:.1f} px): is its time right?"
        )
        left_out += [(rig.epochs[e], why.format(rms)) for e, rms in contradictions.items()]
        result = require_solved(
            leave_out(rig, result, np.isin(rig.epoch, list(contradictions)), max_iterations)
        )
    if snooping:
        result = snoop_rig(result, snooping, significance, max_iterations)
    why = "kept, but does not fit the mounting (RMS {:.1f} px)"
    tolerated = [(rig.epochs[e], why.format(rms)) for e, rms in contradictions.items()]
    return RigCalibration(
        dict(calibrations), rig, result, left_out, tolerated, connections, held_unknowns
    )


def _check(photographs: Any, wand_cameras: Sequence[str]) -> None:
    """Refuse photographs of one camera without `wand_cameras`."""
    if not isinstance(photographs, Mapping):
        raise InputError(
            "photographs must be by the name of the camera, such as {'left': ['left/*.jpg']}, but "
            f"is {show(photographs)}"
        )
    if len(photographs) < (1 if wand_cameras else 2):
        raise InputError("a rig has at least two cameras: give the photographs of each")


def require_solved(result: Result, ties: Sequence[MotionTie] = ()) -> Result:
    """The result of an adjustment that converged; `ties`: by motion, for the message.

    **Raises:** `NotSolvedError` for another one."""
    if not result.converged:
        names = result.undetermined
        undetermined = f"; not determined: {list_some(names, 8, str)}" if names else ""
        advice = (
            "what is given of the mountings hardly determines what the motion of the rig leaves "
            "open: give it with a smaller σ, or rotate the rig about a second axis"
            if any(tie.open for tie in ties)
            else "look for cameras that share too few epochs, or photographs that are not "
            "simultaneous"
        )
        raise NotSolvedError(
            f"not solved: the rig did not converge ({result.termination}){undetermined}; {advice}",
            list(names),
        )
    return result


def _contradictions(
    rig: Rig, result: Result, size: Float[np.ndarray, "cameras 2"]
) -> dict[int, float]:
    """Epochs of several views that do not fit, with their RMS in pixels; `size` of a pixel,
    [cameras, 2]."""
    v = rig.in_order(result.solution.residuals) * rig.sigma / size[rig.camera]
    # Views of each pose: a board by a camera.
    number = np.zeros((len(rig.epochs), len(size), len(rig.boards)))
    board = rig.board_of_points[rig.point]
    np.add.at(number, (rig.epoch, rig.camera, board), used_rays(rig, result.problem))
    number = number.reshape(len(number), -1)
    rays = number.sum(1)
    rms = np.sqrt(np.bincount(rig.epoch, (v**2).sum(1), len(rays)) / np.maximum(rays, 1))
    # Only epochs of several views can contradict the mounting, or the relations of boards; or the
    # motion before and after them.
    shared = rays > 0 if rig.trajectory is not None else (number > 0).sum(1) > 1
    bad = contradicting(rms, rays > 0, shared)
    return {int(e): float(rms[e]) for e in bad}
