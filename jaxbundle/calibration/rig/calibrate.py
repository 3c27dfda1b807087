"""Rig calibration: cameras are calibrated separately first, then together with the mounting.

    ray of camera k = R_k·(Y − b_k)      Y: point in the frame of the reference camera

Simultaneous photographs are an epoch; they are matched by equal file names, or else equal last
numbers in them (left_017.jpg, right_017.jpg). Start values of the mounting come from the epochs two
cameras share: M_k·Mᵣᵀ and Mᵣ·(X0_k − X0_r) should be the same in all of them, and the one nearest
to all others is used. Epochs that contradict the mounting (the board moved in between) are
excluded, or only listed without snooping. The board is known, weighted or free, as in the
calibration of one camera. Gross errors are removed camera by camera, then those that only the
mounting reveals.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.arguments import show
from jaxbundle.batches.epochs import MIN_SHARED_EPOCHS, contradicting, epoch_keys
from jaxbundle.calibration import quality
from jaxbundle.calibration.pixels import unit_size
from jaxbundle.calibration.result import Calibration
from jaxbundle.calibration.rig.declare import Rig, adjust_rig, leave_out, snoop_rig, used_rays
from jaxbundle.calibration.rig.result import RigCalibration
from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.geometry import quaternion_from_matrix
from jaxbundle.leastsquares import Result
from jaxbundle.leastsquares.quality.snooping import check_test
from jaxbundle.leastsquares.spaces import PoseValue
from jaxbundle.network.columns import list_some
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray


def calibrate_rig(
    calibrations: Mapping[str, Calibration],
    *,
    board_sigma: float | None = None,
    board_free: bool = False,
    snooping: str | None = "pope",
    significance: float = 0.001,
    max_iterations: int = 50,
) -> RigCalibration:
    """The common calibration of separately calibrated cameras, from simultaneous photographs of one
    board; the first is the reference.

    **Arguments:** `board_sigma` (object unit), `board_free`, `snooping`, `significance`: as in
    `calibrate`; without snooping, epochs that contradict the mounting are kept and listed
    in `contradicting`.

    **Raises:** `InputError` if the photographs of two cameras cannot be paired;
    `NotSolvedError` if an adjustment does not converge.
    """
    check_test(snooping, significance)
    _check(calibrations)
    keys = epoch_keys({name: one.views.names for name, one in calibrations.items()})
    epochs = list(dict.fromkeys(key for name in calibrations for key in keys[name]))
    # M and X0 of every camera at every epoch it saw
    poses = {
        name: {key: (M, X0) for key, M, X0 in zip(keys[name], one.rotation, one.position)}
        for name, one in calibrations.items()
    }
    base, turn = _start_of_mountings(list(calibrations), poses)
    rig = _start(calibrations, keys, poses, base, turn, epochs)
    rig = dataclasses.replace(rig, point_sigma=board_sigma, points_free=board_free)
    cameras = [one.camera for one in calibrations.values()]
    size = np.array([unit_size(get_model(one.model), one.pixel_size) for one in cameras])
    left_out, found = [], require_solved(adjust_rig(rig, max_iterations))
    # each time from the start values: a wrong epoch may have led the adjustment far away
    while (bad := _contradictions(rig, found, size)) and snooping:
        why = "does not fit the mounting (RMS {:.1f} px): photographs not simultaneous?"
        left_out += [(rig.epochs[e], why.format(rms)) for e, rms in bad.items()]
        found = require_solved(leave_out(rig, found, np.isin(rig.epoch, list(bad)), max_iterations))
    if snooping:
        found = snoop_rig(found, snooping, significance, max_iterations)
    why = "kept, but does not fit the mounting (RMS {:.1f} px)"
    tolerated = [(rig.epochs[e], why.format(rms)) for e, rms in bad.items()]
    return RigCalibration(dict(calibrations), rig, found, left_out, tolerated)


def _check(calibrations: Mapping[str, Calibration]) -> None:
    if not isinstance(calibrations, Mapping):
        raise InputError(
            f"calibrations are {show(calibrations)}; expected a mapping from the "
            "name of each camera to its Calibration"
        )
    if len(calibrations) < 2:
        raise InputError("a rig has at least two cameras: give --camera NAME=PATTERN for each")
    for name, one in calibrations.items():
        if not isinstance(one, Calibration):
            raise InputError(
                f"calibrations: {name!r} is {show(one)}; expected the Calibration "
                "that calibrate returns for this camera"
            )
        if not one.converged:
            why = one.adjustment.termination
            raise NotSolvedError(f"not solved: camera {name} by itself: {why}")


def require_solved(found: Result) -> Result:
    """The result of an adjustment that converged.

    **Raises:** `NotSolvedError` for another one."""
    if not found.converged:
        names = found.undetermined
        what = f"; not determined: {list_some(names, 8, str)}" if names else ""
        raise NotSolvedError(
            f"not solved: the rig did not converge ({found.termination}){what}; look for cameras "
            "that share too few epochs, or photographs that are not simultaneous",
            list(names),
        )
    return found


def _start_of_mountings(
    names: Sequence[str], poses: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """b and R of every camera, from the epochs it shares with one that has them already."""
    base, turn = {names[0]: np.zeros(3)}, {names[0]: np.eye(3)}
    while len(base) < len(names):
        pairs = [(placed, name) for placed in base for name in names if name not in base]
        common = lambda pair: poses[pair[0]].keys() & poses[pair[1]].keys()
        # the pair with most common epochs next (a maximal spanning tree): the start values of a
        # camera may come through another one
        best = max(pairs, key=lambda pair: len(common(pair)))
        shared = [key for key in poses[best[0]] if key in common(best)]
        if len(shared) < min(MIN_SHARED_EPOCHS, len(poses[best[1]])) or not shared:
            raise InputError(
                f"camera {best[1]!r} shares {len(shared)} epochs with the others; "
                f"{MIN_SHARED_EPOCHS} photographs must be simultaneous"
            )
        placed, name = best
        both = [(poses[placed][key], poses[name][key]) for key in shared]
        R = np.array([M2 @ M1.T for (M1, _), (M2, _) in both])
        b = np.array([M1 @ (X2 - X1) for (M1, X1), (_, X2) in both])
        # the medoid, not a mean: a wrong epoch does not move it, and it needs no mean of rotations
        size = np.median(np.linalg.norm(b, axis=1)) + 1e-12
        apart = np.linalg.norm(R[:, None] - R, axis=(2, 3))
        apart += np.linalg.norm(b[:, None] - b, axis=2) / size
        k = int(np.median(apart, axis=1).argmin())
        base[name] = base[placed] + turn[placed].T @ b[k]
        turn[name] = R[k] @ turn[placed]
    return base, turn


def _start(
    calibrations: Mapping[str, Calibration],
    keys: Mapping[str, Sequence[str]],
    poses: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]],
    base: Mapping[str, np.ndarray],
    turn: Mapping[str, np.ndarray],
    epochs: Sequence[str],
) -> Rig:
    """The rig with start values, and the image points that the calibration of each camera kept."""
    names, board = list(calibrations), next(iter(calibrations.values())).views.board
    middle = board.points.mean(0)
    rotation, centre = [], []
    for key in epochs:
        name = next(name for name in names if key in poses[name])
        M, X0 = poses[name][key]
        # ray = R·(Y − b) = M·(X − X0)
        rotation.append(turn[name].T @ M)
        centre.append(X0 - M.T @ turn[name] @ base[name] - middle)
    place = lambda b, R: PoseValue(np.array(b), np.asarray(_quaternions(np.array(R))))
    # points that the calibration of a camera removed as gross stay out: data snooping of the rig
    # finds only what the mounting reveals
    rays = [_rays(one, keys[name], epochs) for name, one in calibrations.items()]
    epoch, point, xy, sigma = (np.concatenate(column) for column in zip(*rays))
    free = {
        name: one.adjustment.problem.network.cameras[0].free for name, one in calibrations.items()
    }
    return Rig(
        tuple(
            dataclasses.replace(one.camera, id=name, free=free[name])
            for name, one in calibrations.items()
        ),
        place([base[n] for n in names], [turn[n] for n in names]),
        tuple(epochs),
        place(centre, rotation),
        board.ids,
        board.points - middle,
        epoch,
        np.repeat(np.arange(len(names)), [len(ray[0]) for ray in rays]),
        point,
        xy,
        sigma,
    )


@partial(compile_once, static=())
def _quaternions(matrices: Float[AnyArray, "n 3 3"]) -> Float[Array, "n 4"]:
    return jax.vmap(quaternion_from_matrix)(matrices)


def _rays(
    calibration: Calibration, keys: Sequence[str], epochs: Sequence[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Epoch, point, xy and σ of the image points that the calibration of a camera kept."""
    network, views = calibration.adjustment.problem.network, calibration.views
    rays, used = network.observations, quality.used_rays(calibration.adjustment.problem)
    row, point = ({key: i for i, key in enumerate(ids)} for ids in (epochs, views.board.ids))
    epoch_of = {name: row[key] for name, key in zip(views.names, keys)}
    epoch = np.array([epoch_of[id] for id in network.images.id])[rays.image[used]]
    return (
        epoch,
        np.array([point[id] for id in network.points.id])[rays.point[used]],
        rays.xy[used],
        rays.sigma[used],
    )


def _contradictions(
    rig: Rig, found: Result, size: Float[np.ndarray, "cameras 2"]
) -> dict[int, float]:
    """Epochs seen by several cameras that do not fit, with their RMS in pixels; `size` of a pixel,
    [cameras, 2]."""
    v = rig.in_order(found.solution.residuals) * rig.sigma / size[rig.camera]
    number = np.zeros((len(rig.epochs), len(size)))
    np.add.at(number, (rig.epoch, rig.camera), used_rays(rig, found.problem))
    rays = number.sum(1)
    rms = np.sqrt(np.bincount(rig.epoch, (v**2).sum(1), len(rays)) / np.maximum(rays, 1))
    # only epochs that several cameras saw can contradict the mounting
    bad = contradicting(rms, rays > 0, (number > 0).sum(1) > 1)
    return {int(e): float(rms[e]) for e in bad}
