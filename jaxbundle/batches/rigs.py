"""Rigs of a batch, moving cameras, and cameras of any model: each its own network.

`calibrate_batch` has one layout of the normal equations: a camera at rest, of a model in pixels
without priors. Anything else is declared as a network of cameras, images and known points, with the
further observations `rigs` and `velocities`, and adjusted like any other; networks of similar size
share their compiled programs. Start values are those of `first_cameras`, computed for all rigs
together. A single camera is a rig of one.

With data snooping, epochs that contradict the mounting (`epochs`) are excluded first.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.adjust import adjust
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.batches.camera import CONVERGED, MISFIT, STATUS, WEAK
from jaxbundle.batches.epochs import contradicting
from jaxbundle.batches.first_cameras import FirstCamera, first_cameras, parameters_of
from jaxbundle.batches.input import LARGEST_NUMBER
from jaxbundle.batches.misfit import misfits
from jaxbundle.batches.weakness import is_vague
from jaxbundle.cameras import CameraModel, key_of
from jaxbundle.cameras.pixel_frame import in_model_units
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.io.results.result_json import result_dict
from jaxbundle.network.build import make_network
from jaxbundle.network.kinds.rolling_shutter import VELOCITY
from jaxbundle.network.tables import STATED, UNIT, UNSTATED_BOARD_SIGMA, Camera, Network

# Errors of one network that must not end the others.
UNEXPECTED = (ValueError, ArithmeticError, RuntimeError, OSError, MemoryError)


@dataclasses.dataclass(frozen=True)
class RigViews:
    """Views of one rig.

    **Fields:** `cameras`, their names; `sizes`, columns and rows of each; `images`: names [cameras]
    [epochs]; `epochs`: names; `points` of the object; `xy` pixels, NaN where a point is missing.
    """

    cameras: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    images: tuple[tuple[str, ...], ...]
    epochs: tuple[str, ...]
    points: Float[np.ndarray, "points 3"]
    xy: Float[np.ndarray, "cameras epochs points 2"]


@dataclasses.dataclass(frozen=True)
class RigSettings:
    """How the rigs of a batch are adjusted: the camera model, the parameters to estimate, the size
    of a pixel in mm for a model in mm, sections `rolling_shutter` and `rig` as in a project, the a
    priori σ of an image coordinate (pixels; None: nobody stated one, and `UNSTATED_BOARD_SIGMA` is
    a unit of weight), and options of `adjust`."""

    model: CameraModel
    free: tuple[str, ...]
    pixel_size: tuple[float, float] | None = None
    sections: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    sigma_image: float | None = None
    max_iterations: int = 100
    snooping: str | None = None
    significance: float = 0.001

    @property
    def sigma(self) -> float:
        """σ of an image coordinate in the weights, pixels."""
        return UNSTATED_BOARD_SIGMA if self.sigma_image is None else self.sigma_image


def solve_rigs(
    rigs: Sequence[RigViews], settings: RigSettings, tell: Callable[[float], None] = lambda _: None
) -> list[tuple[dict, Adjustment | None]]:
    """The row of every rig, as a line of `jaxbundle batch`, and its adjustment, if any.

    `tell(part)`: the fraction done."""
    firsts, solved = _first_cameras(rigs, settings), []
    for number, (rig, first_cameras_of_rig) in enumerate(zip(rigs, firsts), 1):
        solved.append(_solve(rig, first_cameras_of_rig, settings))
        tell(number / len(rigs))
    # Misfits in the end, since they are found by comparison with the other rigs.
    lengths = [_residual_lengths(result, settings) for _, result in solved]
    rms = np.array([np.sqrt(np.mean(v**2)) if len(v) else np.nan for v in lengths])
    mean = np.array([v.mean() if len(v) else np.nan for v in lengths])
    for i in np.flatnonzero(np.isfinite(rms)):
        solved[i][0]["rms"] = float(rms[i])
    for i in np.flatnonzero(misfits(rms, mean, np.isfinite(rms))):
        solved[i][0]["status"] = STATUS[MISFIT]
    return solved


def _first_cameras(
    rigs: Sequence[RigViews], settings: RigSettings
) -> list[list[FirstCamera | None]]:
    """The cameras of every rig, those of one image size calibrated together; None for one without
    finite measurements, or with one beyond LARGEST_NUMBER, which counts as infinite."""
    cameras_of_rigs: list[list[FirstCamera | None]] = [[None] * len(rig.cameras) for rig in rigs]
    places: dict[tuple, list[tuple[int, int]]] = {}
    for i, rig in enumerate(rigs):
        for c, size in enumerate(rig.sizes):
            # One call of `calibrate_batch` has one image size and one number of points.
            if not (np.abs(rig.xy[c]) > LARGEST_NUMBER).any() and np.isfinite(rig.xy[c]).any():
                places.setdefault((size, len(rig.points)), []).append((i, c))
    for (size, points), places_of_size in places.items():
        xy = np.full(
            (len(places_of_size), max(len(rigs[i].epochs) for i, _ in places_of_size), points, 2),
            np.nan,
        )
        for row, (i, c) in enumerate(places_of_size):
            xy[row, : len(rigs[i].epochs)] = rigs[i].xy[c]
        # One list of points if all have the same, which saves memory and keeps them exact.
        X = np.array([rigs[i].points for i, _ in places_of_size])
        X = X[0] if (X == X[:1]).all() else X
        for (i, c), first_camera in zip(
            places_of_size, first_cameras(X, xy, size, settings.model, settings.free)
        ):
            cameras_of_rigs[i][c] = first_camera
    return cameras_of_rigs


def _solve(
    rig: RigViews, firsts: list[FirstCamera | None], settings: RigSettings
) -> tuple[dict, Adjustment | None]:
    """The row of a rig, without its RMS, and its adjustment."""
    try:
        result, excluded = _adjust(rig, firsts, settings)
    except InputError as error:
        return {"status": "bad input", "error": str(error)}, None
    except NotSolvedError as error:
        return {"status": "not solved", "error": str(error)}, None
    except UNEXPECTED as error:
        return {"status": "failed", "error": f"{type(error).__name__}: {error}"}, None
    row: dict[str, Any] = {"status": STATUS[CONVERGED] if result.converged else result.termination}
    row |= {"model": str(settings.model.name), "views": len(result.network.images)}
    if len(rig.cameras) > 1:
        row["image_size"] = {name: list(size) for name, size in zip(rig.cameras, rig.sizes)}
    if excluded:
        row["epochs_not_used"] = excluded
    row |= result_dict(result, brief=True)
    if not result.converged:
        return row, None
    weak = _undetermined(result, settings)
    if weak:
        row |= {"status": STATUS[WEAK], "undetermined": weak}
    return row, result


def _adjust(
    rig: RigViews, firsts: Sequence[FirstCamera | None], settings: RigSettings
) -> tuple[Adjustment, dict[str, str]]:
    """The adjustment of a rig, and what epochs were excluded, with the reason.

    **Raises:** `InputError`, `NotSolvedError`."""
    network, excluded = declare_rig(rig, firsts, settings), {}
    result = adjust(network, max_iterations=settings.max_iterations)
    if settings.snooping is None:
        return result, excluded
    # Epochs first: a board that moved shifts all points of an epoch, and point by point data
    # snooping would remove the cameras that are right as well.
    while result.converged and (contradictions := _contradicting(rig, result, settings)):
        excluded |= {
            rig.epochs[e]: f"does not fit the mounting (RMS {rms:.1f} px): photographs "
            "not simultaneous?"
            for e, rms in contradictions.items()
        }
        xy = rig.xy.copy()
        xy[:, list(contradictions)] = np.nan
        rig = dataclasses.replace(rig, xy=xy)
        try:
            network = declare_rig(rig, firsts, settings)
            result = adjust(network, max_iterations=settings.max_iterations)
        except (InputError, NotSolvedError, ValueError) as error:
            left_out = "; ".join(f"epoch {epoch} {why}" for epoch, why in excluded.items())
            raise NotSolvedError(f"{left_out}; without these: {error}") from None
    return adjust(
        network,
        max_iterations=settings.max_iterations,
        snooping=settings.snooping,
        significance=settings.significance,
    ), excluded


def _contradicting(rig: RigViews, result: Adjustment, settings: RigSettings) -> dict[int, float]:
    """Epochs that contradict the mounting, and their RMS, pixels."""
    epoch_of_image = {
        id: e for images_of_camera in rig.images for e, id in enumerate(images_of_camera)
    }
    epoch = np.array([epoch_of_image[id] for id in result.problem.network.images.id])
    of_ray = epoch[result.problem.image]
    lengths = settings.sigma * np.hypot(*result.inspection.image_residuals.T)
    number = np.bincount(of_ray, minlength=len(rig.epochs))
    rms = np.sqrt(np.bincount(of_ray, lengths**2, len(rig.epochs)) / np.maximum(number, 1))
    shared = np.bincount(epoch, minlength=len(rig.epochs)) > 1
    return {int(e): float(rms[e]) for e in contradicting(rms, number > 0, shared)}


def _residual_lengths(result: Adjustment | None, settings: RigSettings) -> Float[np.ndarray, " n"]:
    """Residual lengths of the image points used, pixels."""
    if result is None:
        return np.zeros(0)
    has_weight = (result.problem.image_weights > 0).all(1)
    # v/σ times σ in pixels: pixels, also of a model in mm.
    v = settings.sigma * result.inspection.image_residuals
    return np.hypot(*v.T)[has_weight]


def _undetermined(result: Adjustment, settings: RigSettings) -> list[str]:
    """Principal distances and points that the views do not determine."""
    model, undetermined = settings.model, []
    free = tuple(map(model.parameters.index, settings.free))
    for id, camera in result.cameras.items():
        parameters = camera["parameters"]
        values = np.array([[parameters[name]["value"] for name in model.parameters]])
        sigma = np.array([[parameters[name]["sigma"] for name in settings.free]])
        weak = is_vague(model, free, values, sigma)[0]
        prefix = f"{id} " if len(result.cameras) > 1 else ""
        undetermined += [f"{prefix}{settings.free[k]}" for k in np.flatnonzero(weak)]
    return undetermined


def declare_rig(
    rig: RigViews, firsts: Sequence[FirstCamera | None], settings: RigSettings
) -> Network:
    """The network of a rig, with start values.

    **Raises:** `NotSolvedError` for a camera without start values."""
    model, size_of_pixel = settings.model, settings.pixel_size
    cameras, images, rays = [], [], []
    prior = {name: s for name, s in dict(model.prior).items() if name in settings.free}
    sigma = settings.sigma * np.array(size_of_pixel if model.unit == "mm" else (1.0, 1.0))
    for c, (name, first_camera) in enumerate(zip(rig.cameras, firsts)):
        if first_camera is None or not first_camera.solved:
            why = (
                "no finite image points, or one above 1e100"
                if first_camera is None
                else first_camera.status
            )
            where = f"camera {name}: " if len(rig.cameras) > 1 else ""
            raise NotSolvedError(f"{where}its views do not determine it ({why})")
        has_coordinates = np.isfinite(rig.points).all(1)
        is_seen = (
            np.isfinite(rig.xy[c]).all(-1)
            & has_coordinates
            & first_camera.views[: len(rig.epochs), None]
        )
        parameters = parameters_of(
            first_camera, rig.xy[c][is_seen], rig.sizes[c], model, settings.free, size_of_pixel
        )
        cameras.append(
            Camera(
                name,
                key_of(model),
                parameters,
                settings.free,
                prior,
                image_size=rig.sizes[c],
                pixel_size=size_of_pixel,
            )
        )
        xy = in_model_units(rig.xy[c], model, rig.sizes[c], size_of_pixel)
        for e in np.flatnonzero(is_seen.any(1)):
            images.append((c, int(e), *first_camera.position[e], *first_camera.angles[e]))
            rays += [(len(images) - 1, p, *xy[e, p]) for p in np.flatnonzero(is_seen[e])]
    return _network_of(rig, cameras, images, np.array(rays), sigma, settings)


def with_free(moves: Mapping[str, Any]) -> dict[str, Any]:
    """The section `rolling_shutter`: every velocity is free unless it says which."""
    return {"free": VELOCITY, **moves}


def _network_of(
    rig: RigViews,
    cameras: Sequence[Camera],
    images: Sequence[tuple[Any, ...]],
    rays: Float[np.ndarray, "n 4"],
    sigma: Float[np.ndarray, "2"],
    settings: RigSettings,
) -> Network:
    """The network of images (camera, epoch, pose) and rays (image, point, x, y)."""
    ids = np.array([rig.images[c][e] for c, e, *_ in images], dtype=object)
    names = [rig.cameras[c] for c, *_ in images]
    pose = np.array([row[2:] for row in images])
    has_coordinates = np.all(np.isfinite(rig.points), axis=1)
    X, Y, Z = np.where(has_coordinates[:, None], rig.points, 0.0).T
    points = np.array([str(p) for p in range(len(X))], dtype=object)
    image, point = rays[:, 0].astype(int), rays[:, 1].astype(int)
    further_tables: dict[str, Any] = {}
    if len(rig.cameras) > 1:
        epochs = [rig.epochs[e] for _, e, *_ in images]
        further_tables["rigs"] = {"rig": ["rig"] * len(ids), "epoch": epochs, "image": ids}
        further_tables["rig"] = {"reference": rig.cameras[0], **settings.sections.get("rig", {})}
    if moves := settings.sections.get("rolling_shutter"):
        further_tables["velocities"] = {"image": ids}
        further_tables["rolling_shutter"] = with_free(moves)
    return make_network(
        cameras,
        {"id": ids, "camera": names}
        | dict(zip(("X0", "Y0", "Z0", "omega", "phi", "kappa"), pose.T)),
        {"id": points, "role": ["fixed"] * len(points), "X": X, "Y": Y, "Z": Z},
        {
            "image": ids[image],
            "point": points[point],
            "x": rays[:, 2],
            "y": rays[:, 3],
            "sx": np.full(len(rays), sigma[0]),
            "sy": np.full(len(rays), sigma[1]),
        },
        residuals="measured",
        image_unit=settings.model.unit,
        sigma_origin=UNIT if settings.sigma_image is None else STATED,
        **further_tables,
    )
