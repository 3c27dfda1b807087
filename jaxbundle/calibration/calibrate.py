"""`calibrate`: from photographs of a board to a calibrated camera.

1. The board is detected in every photograph (`measure`), or its image points are given.
2. Start values of camera and poses; impossible views are excluded (`start`).
3. Adjustment as a network with residuals in the measured image, with data snooping or robust. A
   view that loses more than a third of its points by data snooping is excluded, and the others are
   adjusted again. The board is

       known      its points are fixed: exact coordinates of a drawing
       weighted   its points are control points with a σ: a print is not exact and not flat
       free       its points are estimated, inner constraints on all of them (scale included)

4. For circles of known diameter, the eccentricity of their images is corrected and the
   adjustment repeated.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbundle.adjustment.adjust import adjust, check_options
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.arguments import number, positive, refuse_unknown, show, text, truth, vector
from jaxbundle.calibration.pixels import unit_size
from jaxbundle.calibration.result import Calibration
from jaxbundle.calibration.start import CalibrationStart, start_values
from jaxbundle.cameras import CameraModel, check_own, get_model, is_own
from jaxbundle.cameras.pixel_frame import in_model_units, in_pixels
from jaxbundle.errors import InputError
from jaxbundle.float64 import require_x64
from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.leastsquares.quality.snooping import check_test
from jaxbundle.measure.boards import Board, require_board
from jaxbundle.measure.ellipses import rim_centre_shift
from jaxbundle.measure.views import BoardViews, measure_boards
from jaxbundle.network.blunders import removed_rays
from jaxbundle.network.build import make_network
from jaxbundle.network.tables import STATED, UNIT, UNSTATED_BOARD_SIGMA, Camera, Network
from jaxbundle.orientation.pose import CameraPose
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Progress


def calibrate(  # noqa: PLR0913 keyword arguments of a public function
    photographs: Sequence[str | Path] | BoardViews,
    board: Board | None = None,
    *,
    model: str | CameraModel = "opencv",
    free: Sequence[str] | None = None,
    given: Mapping[str, float] | None = None,
    pixel_size: float | tuple[float, float] | None = None,
    sigma_image: float | None = None,
    board_sigma: float | None = None,
    board_free: bool = False,
    robust: str | None = None,
    snooping: str | None = "pope",
    cross_validation: bool = True,
    correlated: bool = True,
    camera: str = "cam",
    object_unit: str = "m",
    progress: Progress | None = None,
    **options: Any,
) -> Calibration:
    """Calibrate a camera from photographs of a board.

    **Arguments:**

    - `photographs`: files, patterns or folders; or `BoardViews`, image points already measured.
    - `board`: the board in the photographs; its unit is the object unit.
    - `model`, `free`: camera model, by name or a `CameraModel`, and the parameters to estimate; the
      model's standard ones by default. `given`: values of parameters, held if they are not free.
    - `pixel_size`: mm, for models in mm.
    - `sigma_image`: a priori σ of an image coordinate, pixels; None: `UNSTATED_BOARD_SIGMA` as
      a unit of weight, without a χ² test.
    - `board_sigma`: σ of a coordinate of the board (object unit); `board_free`: its points are
      estimated. Default: the board is exact.
    - `robust`: "huber", "cauchy" or "tukey": points that fit badly are downweighted instead of
      removed; `snooping`: the test for removal, None: no removal. Both, and further `options`
      (`significance`, `max_iterations`, …), are those of `jaxbundle.adjust`.
    - `cross_validation`: False: do not calibrate from halves of the photographs.
    - `correlated`: state σ under errors that image points share, and compare halves by views, of
      eight views or more (`Adjustment.error_model`, `Adjustment.replication`).
    - `camera`: its name. `progress(stage, done, total)`: photographs searched.

    **Returns:** a `Calibration`; check `converged` first.

    **Raises:** `InputError` if nothing can be calibrated; `NotSolvedError` if the photographs
    do not determine the camera.
    """
    require_x64()
    camera_model, free = _model(model, free)
    pixel_size = _pair(pixel_size)
    unit_size(camera_model, pixel_size)
    _check(sigma_image, board_sigma, board_free)
    _check_given(camera_model, given)
    text("camera", camera)
    text("object_unit", object_unit)
    # Either downweighted or removed: a test of residuals that robust weights changed has no level.
    options |= {"robust": robust, "snooping": None if robust else snooping}
    refuse_unknown("calibrate", options, check_options)
    check_options(**options)
    check_test(snooping, options.get("significance", 0.001))
    views = views_of(photographs, board, progress)
    columns, rows = views.image_size
    # Held parameters need no prior.
    prior = {name: s for name, s in dict(camera_model.prior).items() if name in free}
    start_camera = Camera(
        camera,
        model,
        {},
        free,
        prior,
        image_size=(int(columns), int(rows)),
        pixel_size=pixel_size,
    )
    network_of = partial(
        board_network,
        sigma_image=sigma_image,
        board_sigma=board_sigma,
        board_free=board_free,
        object_unit=object_unit,
    )
    while True:
        start = start_values(views, camera_model, free, pixel_size, given)
        start_camera = dataclasses.replace(start_camera, parameters=start.parameters)
        centred, result = _adjust_views(start, start_camera, network_of, options)
        is_misfitting = _misfitting_views(centred, result)
        # Fewer than two would be left: nothing says which are right.
        if not is_misfitting.any() or is_misfitting.sum() > len(centred) - 2:
            break
        # As measured: the eccentricity of circles is corrected again, with the better camera.
        views = start.views.take(~is_misfitting, MISFITTING)
    if truth("correlated", correlated):
        result = result.with_correlated_errors("views")
    return Calibration(centred, result, cross_validation)


MISFITTING = (
    "more than a third of its points do not fit the other photographs: another camera, another "
    "zoom or focus, or it was shaken"
)


def _adjust_views(
    start: CalibrationStart,
    camera: Camera,
    network_of: Callable[[CalibrationStart, Camera], Network],
    options: Mapping[str, Any],
) -> tuple[BoardViews, Adjustment]:
    """The adjustment of all views, and these without the eccentricity of circles."""
    result = adjust(network_of(start, camera), **options)
    if start.views.board.diameters.any() and result.converged:
        # Twice: the shifts depend on the poses, and these change by the shifts, by a small part.
        for _ in range(2):
            centred = _without_eccentricity(start, result, camera)
            network = network_of(dataclasses.replace(start, views=centred), camera)
            result = adjust(network, **options)
        return centred, result
    return start.views, result


def _misfitting_views(views: BoardViews, result: Adjustment) -> Bool[np.ndarray, " views"]:
    """Views of which data snooping has removed more than a third of the points."""
    row_of = {name: row for row, name in enumerate(views.names)}
    names = result.problem.network.images.id
    removed = np.zeros(len(views), int)
    for ray in removed_rays(result.removed):
        removed[row_of[names[result.problem.image[ray]]]] += 1
    return removed > views.visible.sum(1) / 3


def views_of(
    photographs: Sequence[str | Path] | BoardViews,
    board: Board | None,
    progress: Progress | None = None,
) -> BoardViews:
    """The board measured in photographs; `BoardViews` are returned unchanged."""
    if isinstance(photographs, BoardViews):
        return photographs
    if board is None:
        raise InputError("calibrate: give the board that is in the photographs")
    require_board(board)
    files = [photographs] if isinstance(photographs, str | Path) else photographs
    if not isinstance(files, Sequence):
        raise InputError(
            "photographs must be a list of files, patterns or folders, or BoardViews, but is "
            f"{show(files)}"
        )
    return measure_boards(files, board, progress)


def board_network(
    start: CalibrationStart,
    camera: Camera,
    sigma_image: float | None,
    *,
    board_sigma: float | None = None,
    board_free: bool = False,
    object_unit: str = "m",
) -> Network:
    """The network of one camera, its views of a board, and the board."""
    views, model = start.views, get_model(camera.model)
    board = views.board
    view, point = np.nonzero(views.visible)
    xy = in_model_units(views.xy[view, point], model, views.image_size, camera.pixel_size)
    # Image coordinates in the unit of the model, σ in pixels: a pixel is not square in every camera
    sx, sy = (sigma_image or UNSTATED_BOARD_SIGMA) * np.array(unit_size(model, camera.pixel_size))
    role = "tie" if board_free else "fixed" if board_sigma is None else "control"
    X, Y, Z = board.points.T
    points = {"id": board.ids, "role": [role] * len(X), "X": X, "Y": Y, "Z": Z}
    if role == "control":
        points |= dict.fromkeys(("sX", "sY", "sZ"), np.full(len(X), board_sigma))
    names, ids = np.array(views.names, dtype=object), np.array(board.ids, dtype=object)
    exterior = np.concatenate([start.position, np.degrees(start.angles)], 1)
    network = make_network(
        [camera],
        {"id": names, "camera": [camera.id] * len(names)}
        | dict(zip(("X0", "Y0", "Z0", "omega", "phi", "kappa"), exterior.T)),
        points,
        {
            "image": names[view],
            "point": ids[point],
            "x": xy[:, 0],
            "y": xy[:, 1],
            "sx": np.full(len(xy), sx),
            "sy": np.full(len(xy), sy),
        },
        sigma_origin=UNIT if sigma_image is None else STATED,
        datum="inner" if board_free else "control",
        # Residuals where noise arises: in the photograph, not in the ideal image without distortion
        residuals="measured",
        angle_unit="deg",
        image_unit=model.unit,
        object_unit=object_unit,
        name=f"Calibration of {camera.id}",
    )
    for warning in views.warnings:
        network = network.warn(warning)
    if start.behind:
        network = network.warn(
            "every photograph sees the board from behind, as in a mirror: its points are numbered "
            "from the other side, or the photographs are mirrored; number them from the upper "
            "left, each row to the right, or mirror the photographs back"
        )
    if board_free and not board.unique:
        network = network.warn(
            f"the {board} looks the same rotated by 180°: its points are estimated "
            "correctly only if it was never upside down"
        )
    return network


def _without_eccentricity(
    start: CalibrationStart, result: Adjustment, camera: Camera
) -> BoardViews:
    """The measured views with points moved from the ellipse centres to the images of the circle
    centres."""
    views, model = start.views, get_model(camera.model)
    p = np.asarray(result.values["camera"])[0]
    M = jax.vmap(matrix_from_quaternion)(result.values["image"].rotation)
    poses = CameraPose(jnp.asarray(result.image_values[:, :3]), M)
    radius = views.board.diameters / 2
    shift = np.asarray(_shifts(model, p, poses, views.board.points, radius))
    shift = np.where(radius[:, None] > 0, shift, 0.0)  # corners beside circles
    xy = in_model_units(views.xy, model, views.image_size, camera.pixel_size) - shift
    return dataclasses.replace(views, xy=in_pixels(xy, model, views.image_size, camera.pixel_size))


@partial(compile_once, static=0)
def _shifts(
    model: CameraModel,
    p: Float[AnyArray, " parameters"],
    poses: CameraPose,
    centres: Float[AnyArray, "points 3"],
    radius: Float[AnyArray, " points"],
) -> Float[Array, "views points 2"]:
    normal = jnp.array([0.0, 0.0, 1.0])
    shift = lambda pose, X, r: rim_centre_shift(model, p, pose, X, normal, r)
    return jax.vmap(jax.vmap(shift, (None, 0, 0)), (0, None, None))(poses, centres, radius)


def check_model(name: str | CameraModel) -> CameraModel:
    """The model with this name, or a user-defined one.

    **Raises:** `InputError`.
    """
    try:
        model = get_model(name)
        if is_own(model):
            check_own(model)
    except ValueError as error:
        raise InputError(str(error)) from None
    return model


def _model(
    name: str | CameraModel, free: Iterable[str] | None
) -> tuple[CameraModel, tuple[str, ...]]:
    model = check_model(name)
    if isinstance(free, str) or not (free is None or isinstance(free, Iterable)):
        raise InputError(f"free must be a list of names, such as ['fx', 'fy'], but is {free!r:.60}")
    free = model.free if free is None else tuple(free)
    if not free or len({*free}) < len(free):
        raise InputError("free: expected at least one parameter, and each only once")
    for parameter in free:
        if parameter not in model.parameters or parameter in model.never_free:
            known_parameters = [p for p in model.parameters if p not in model.never_free]
            raise InputError(
                f"free: camera model {model.name!r} has no free parameter {parameter!r}; its "
                f"parameters are {', '.join(known_parameters)}"
            )
    return model, free


def _pair(pixel_size: Any) -> tuple[float, float] | None:
    if pixel_size is None:
        return None
    pair = vector("pixel_size", pixel_size, 2, "a positive length in mm, or two")
    if not (pair > 0).all():
        raise InputError(f"pixel size {pixel_size}: expected a positive length in mm")
    return float(pair[0]), float(pair[1])


def _check_given(model: CameraModel, values: Any) -> None:
    if values is None:
        return
    if not isinstance(values, Mapping):
        raise InputError(f"given must be like {{'fx': 900.0}}, but is {show(values)}")
    for name, value in values.items():
        if name not in model.parameters:
            raise InputError(
                f"given: camera model {model.name!r} has no parameter {name!r}; its parameters "
                f"are {', '.join(model.parameters)}"
            )
        check = positive if name in model.principal_distance else number
        check(f"given: {name}", value)


def _check(sigma_image: Any, board_sigma: Any, board_free: bool) -> None:
    if sigma_image is not None:
        positive("sigma_image", sigma_image)
    if board_sigma is not None:
        positive("board_sigma", board_sigma)
    if board_free and board_sigma is not None:
        raise InputError("the board is either free or has a σ (--board-free, --board-sigma)")
