"""Cameras on one mounting: calibrated by themselves first, then together with the mounting.

    ray of camera k = R_k·(Y − b_k)      Y: point in the frame of the reference camera

Photographs taken at the same moment are an epoch; they are found by name: equal file names, or
else equal last numbers in them (left_017.jpg, right_017.jpg). Start values of the mounting come
from the epochs two cameras share: M_k·Mᵣᵀ and Mᵣ·(X0_k − X0_r) should be the same in all of them,
and the one nearest to all others is taken. Epochs that contradict the mounting (the board moved in
between) are left out, or named where nothing is to be left out. The board is known, weighted or
free, as in the calibration of one camera; gross errors were removed camera by camera.
"""

import re
from collections.abc import Mapping

import numpy as np

from jaxbundle.adjustment.rig import adjust_rig
from jaxbundle.adjustment.rig_normal import RigCamera, RigObject, RigValues
from jaxbundle.calibration.frames import unit_size
from jaxbundle.calibration.quality import kept_rays
from jaxbundle.calibration.result import Calibration
from jaxbundle.calibration.rig_result import RigCalibration
from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.network.columns import some

FEWEST = 3
"""Epochs that two cameras must share."""
CONTRADICTS, LEAST_CONTRADICTION = 3.0, 1.0
"""An epoch is left out whose RMS is above so many times the median of all, and so many pixels."""
WORST = 0.5
"""In one round those go whose RMS is above this part of the largest: the worst spoil the others."""
ROUNDS = 10


def calibrate_rig(
    calibrations: Mapping[str, Calibration],
    *,
    board_sigma: float | None = None,
    board_free: bool = False,
    snooping: bool = True,
    max_iterations: int = 50,
) -> RigCalibration:
    """The common calibration of cameras that were calibrated by themselves, from photographs of one
    board taken in step; the first is the reference.

    **Arguments:** `board_sigma` (object unit), `board_free`: as in `calibrate`; `snooping`: False:
    epochs that contradict the mounting stay, and are named in `contradicting`.

    **Raises:** `InputError` where the photographs of two cameras cannot be paired;
    `NotSolvedError` where an adjustment does not settle.
    """
    if len(calibrations) < 2:
        raise InputError("a rig has two cameras or more: give --camera NAME=PATTERN for each")
    for name, one in calibrations.items():
        if not one.converged:
            why = one.adjustment.termination
            raise NotSolvedError(f"not solved: camera {name} by itself: {why}")
    keys = epoch_keys({name: one.views.names for name, one in calibrations.items()})
    epochs = list(dict.fromkeys(key for name in calibrations for key in keys[name]))
    poses = _poses(calibrations, keys)
    base, turn = _start_of_mountings(list(calibrations), poses)
    points = next(iter(calibrations.values())).views.board.points
    middle = points.mean(0)
    known = RigObject(points - middle, board_sigma, board_free)
    left_out: list[tuple[str, str]] = []
    for _ in range(ROUNDS):
        rig = [_camera(one, keys[name], epochs) for name, one in calibrations.items()]
        start = _start(calibrations, poses, base, turn, epochs, points)
        solution = adjust_rig(rig, known, start, max_iterations)
        bad = _contradictions(calibrations, rig, solution) if solution.converged else []
        if not bad or not snooping:
            break
        left_out += [(epochs[e], f"does not fit the mounting (RMS {rms:.1f} px): photographs not "
                      "of the same moment?") for e, rms in bad]  # fmt: skip
        gone = {e for e, _ in bad}
        epochs = [key for e, key in enumerate(epochs) if e not in gone]
    if not solution.converged:
        raise NotSolvedError(
            "not solved: the rig did not settle; look for cameras that share too few epochs, or "
            "photographs that are not of the same moment"
        )
    return RigCalibration(
        dict(calibrations), rig, known, tuple(epochs), tuple(left_out), solution,
        tuple((epochs[e], f"kept, but does not fit the mounting (RMS {rms:.1f} px)")
              for e, rms in bad),
    )  # fmt: skip


def epoch_keys(names: Mapping[str, tuple[str, ...]]) -> dict[str, list[str]]:
    """The epoch of every photograph of every camera: equal file names, or equal last numbers.

    **Raises:** `InputError` where neither pairs them.
    """
    whole = lambda name: re.sub(r"\.\w+$", "", name.rsplit("/", 1)[-1])

    def number(name):
        found = re.findall(r"\d+", whole(name))
        return found[-1].lstrip("0") or "0" if found else ""

    for key in (whole, number):
        keys = {camera: [key(name) for name in given] for camera, given in names.items()}
        once = all("" not in k and len({*k}) == len(k) for k in keys.values())
        first, *others = ({*k} for k in keys.values())
        if once and all(len(first & other) >= min(FEWEST, len(first)) for other in others):
            return keys
        if once and len(keys) > 2 and _connected(keys):
            return keys
    shown = "; ".join(f"{camera}: {some(given, 2)}" for camera, given in names.items())
    raise InputError(
        f"the photographs of the cameras cannot be paired by their names ({shown}): call those of "
        "one moment alike, or give them the same last number"
    )


def _connected(keys) -> bool:
    """Whether every camera shares epochs with the first, directly or through others."""
    sets = {name: {*k} for name, k in keys.items()}
    reached = [next(iter(sets))]
    for name in reached:
        reached += [other for other in sets if other not in reached
                    and len(sets[name] & sets[other]) >= FEWEST]  # fmt: skip
    return len(reached) == len(sets)


def _poses(calibrations, keys):
    """M and X0 of every camera at every epoch it saw."""
    return {
        name: {key: (M, X0) for key, M, X0 in zip(keys[name], one.rotation, one.position)}
        for name, one in calibrations.items()
    }


def _start_of_mountings(names, poses):
    """b and R of every camera, from the epochs it shares with one that has them already."""
    base, turn = {names[0]: np.zeros(3)}, {names[0]: np.eye(3)}
    while len(base) < len(names):
        pairs = [(placed, name) for placed in base for name in names if name not in base]
        common = lambda pair: poses[pair[0]].keys() & poses[pair[1]].keys()
        best = max(pairs, key=lambda pair: len(common(pair)))
        shared = [key for key in poses[best[0]] if key in common(best)]
        if len(shared) < min(FEWEST, len(poses[best[1]])) or not shared:
            raise InputError(
                f"camera {best[1]!r} shares {len(shared)} epochs with the others; {FEWEST} or more "
                "photographs must be of the same moments"
            )
        placed, name = best
        both = [(poses[placed][key], poses[name][key]) for key in shared]
        R = np.array([M2 @ M1.T for (M1, _), (M2, _) in both])
        b = np.array([M1 @ (X2 - X1) for (M1, X1), (_, X2) in both])
        size = np.median(np.linalg.norm(b, axis=1)) + 1e-12
        apart = np.linalg.norm(R[:, None] - R, axis=(2, 3))
        apart += np.linalg.norm(b[:, None] - b, axis=2) / size
        k = int(np.median(apart, axis=1).argmin())
        base[name] = base[placed] + turn[placed].T @ b[k]
        turn[name] = R[k] @ turn[placed]
    return base, turn


def _start(calibrations, poses, base, turn, epochs, points) -> RigValues:
    shift, rotation, middle = [], [], points.mean(0)
    for key in epochs:
        name = next(name for name in calibrations if key in poses[name])
        M, X0 = poses[name][key]
        # ray = R·(Y − b) = M·(X − X0)
        M_reference = turn[name].T @ M
        rotation.append(M_reference)
        shift.append(M_reference @ (middle - X0) + base[name])
    interior = tuple(
        np.array(list(one.parameters.values())) for one in calibrations.values()
    )
    names = list(calibrations)
    return RigValues(
        interior, np.array([base[n] for n in names]), np.array([turn[n] for n in names]),
        np.array(shift), np.array(rotation), points - middle,
    )  # fmt: skip


def _camera(calibration: Calibration, keys, epochs) -> RigCamera:
    """The image points of a camera that its own calibration kept, by epoch."""
    network = calibration.adjustment.problem.network
    given = network.cameras[0]
    model = get_model(given.model)
    rays = network.observations
    kept = kept_rays(calibration.adjustment)
    board = calibration.views.board
    xy = np.zeros((len(epochs), len(board.ids), 2))
    seen = np.zeros(xy.shape[:2], bool)
    row = {key: e for e, key in enumerate(epochs)}
    epoch_of_view = np.array([row.get(key, -1) for key in keys])
    point_of = {id: p for p, id in enumerate(board.ids)}
    point = np.array([point_of[id] for id in network.points.id])[rays.point]
    view_of = {name: v for v, name in enumerate(calibration.views.names)}
    view = np.array([view_of[id] for id in network.images.id])[rays.image]
    used = kept & (epoch_of_view[view] >= 0)
    xy[epoch_of_view[view][used], point[used]] = rays.xy[used]
    seen[epoch_of_view[view][used], point[used]] = True
    weight = float(1 / calibration.adjustment.problem.network.observations.sigma.mean())
    free = tuple(model.parameters.index(name) for name in given.free)
    return RigCamera(model, free, xy, seen, weight)


def _contradictions(calibrations, rig, solution):
    """Epochs, of those several cameras saw, that do not fit; with their RMS in pixels."""
    square, number = 0.0, 0
    for one, v in zip(calibrations.values(), solution.residuals):
        size = unit_size(get_model(one.camera.model), one.camera.pixel_size)
        v = v / np.array(size)
        square = square + np.nansum(v**2, axis=(1, 2))
        number = number + np.isfinite(v[..., 0]).sum(1)
    rms = np.sqrt(square / np.maximum(number, 1))
    several = sum(camera.seen.any(1).astype(int) for camera in rig) > 1
    limit = max(CONTRADICTS * float(np.median(rms)), LEAST_CONTRADICTION)
    rms = np.where(several, rms, 0.0)
    bad = np.flatnonzero(rms > max(limit, WORST * rms.max()))
    return [(int(e), float(rms[e])) for e in bad]
