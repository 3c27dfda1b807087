"""Start values of a camera and its photographs of a board, and exclusion of impossible views.

`calibrate_batch` gives focal lengths and poses in closed form and adjusts them, in a model in
pixels. For a model in millimetres that is `opencv` with k1 and k2; to first order

    c = (fx·p_x + fy·p_y)/2,   K1 = ∓k1/c²  (− for a correction, + for a distortion)

The parameters of every other model, including user-defined ones, are fitted over the image to
`opencv` (or `kannala-brandt`, if rays may be 90° and more from the axis).

A view whose points do not fit the others (a wrong board, a wrong order of corners) is excluded:
more than a third of its residuals are gross compared with the median of all, or it looks at the
board from behind, like a mirror image.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxbundle.batch.calibrate import BatchCalibration, calibrate_batch
from jaxbundle.calibration.pixels import images_of_board
from jaxbundle.cameras import CameraModel, convert_camera, get_model, is_own
from jaxbundle.cameras.pixel_frame import in_model_units
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.measure.views import BoardViews
from jaxbundle.network.columns import count

GROSS = 12.0
"""Residuals above this multiple of their typical size (1.4826·median) are gross."""
LEAST_GROSS = 3.0
"""And above this many pixels."""
PART = 1 / 3
SOLVED = ("opencv", "kannala-brandt", "snavely")
"""Models in pixels that `calibrate_batch` solves without start values."""
SIMPLE = ("fx", "fy", "cx", "cy", "k1", "k2")
WIDE = tuple(np.radians([60.0, 100.0, 140.0, 180.0]))
"""Fields of view tried if the views give no start values for a fisheye."""


@dataclasses.dataclass(frozen=True)
class Start:
    """Usable views, camera parameters, X0 and ω, φ, κ (radians) of every view."""

    views: BoardViews
    parameters: dict[str, float]
    position: Float[np.ndarray, "views 3"]
    angles: Float[np.ndarray, "views 3"]


def start_values(
    views: BoardViews, model: CameraModel, free: tuple[str, ...], pixel_size=None, given=None
) -> Start:
    """Start values for the adjustment of one camera; `given`: parameters known beforehand.

    **Raises:** `InputError` for too few views; `NotSolvedError` if they do not determine the
    camera.
    """
    fisheye, by_fit = get_model("kannala-brandt"), _by_fit(model)
    known, wanted = (fisheye, fisheye.free) if by_fit and model.wide else (model, free)
    while True:
        if len(views) < 2:
            raise InputError(
                f"only {count(len(views), 'photograph')} can be used{_why(views)}; a camera needs "
                "several, 8 or more, from different directions"
            )
        solved = _solve(views, known, wanted)
        used = solved.views[0]
        if not used.all():
            views = views.take(used, "its points are too few or lie on a line")
            continue
        behind = solved.position[0][:, 2] < views.board.points[:, 2].mean()
        if behind.any() and not behind.all():
            views = views.take(~behind, "its points are numbered as in a mirror")
            continue
        gross = _gross_views(views, solved)
        if not gross.any():
            break
        if gross.sum() > len(views) - 2:
            raise NotSolvedError(
                "not solved: the photographs contradict one another: the points of "
                f"{int(gross.sum())} of {len(views)} do not fit a camera; look for different "
                "boards, another camera, a zoom that moved"
            )
        views = views.take(~gross, "its points do not fit those of the other photographs")
    given = dict(given or {})
    if by_fit:
        parameters = _fitted(views, solved, model, free, pixel_size, given) | given
    else:
        parameters = _parameters(views, solved, model, free, pixel_size) | given
    return Start(views, parameters, solved.position[0], solved.angles[0])


def _by_fit(model: CameraModel) -> bool:
    """Whether its start values are derived from another model."""
    return is_own(model) or (model.unit == "px" and model.name not in SOLVED)


def _why(views):
    return f" ({views.failed[0][0]}: {views.failed[0][1]})" if views.failed else ""


def _solve(views: BoardViews, model: CameraModel, free) -> BatchCalibration:
    """The first attempt with a solution, possibly weak."""
    size, direct = views.image_size, model.unit == "px" and not _by_fit(model)
    if direct:
        attempts = [(model.name, free, None)]
        if model.name == "opencv":
            attempts.append(("opencv", tuple(n for n in free if n in SIMPLE), None))
        if model.name == "kannala-brandt":
            guesses = [max(size) / angle for angle in WIDE]
            known = [{"fx": f, "fy": f} for f in guesses]
            attempts += [(model.name, free, start) for start in known]
            attempts += [(model.name, ("fx", "fy", "cx", "cy"), start) for start in known]
    else:
        attempts = [("opencv", SIMPLE, None), ("opencv", ("fx", "fy"), None)]
    xy = in_model_units(views.xy, get_model(attempts[0][0]), size)
    for name, wanted, start in attempts:
        held = [n for n in model.principal_distance if n not in wanted]
        if start is None and direct:
            wanted = (*held, *wanted)
        solved = calibrate_batch(
            views.board.points, xy[None], size, model=name, visible=views.visible[None],
            free=wanted, start=start, threads=1,
        )  # fmt: skip
        if solved.solved[0]:
            return solved
    raise NotSolvedError(
        f"not solved: {len(views)} photographs of the board do not determine the camera "
        f"({solved.status[0]}); take it from different directions, tilted by 20° to 45°, some with "
        "the camera turned by 90°, or free fewer parameters",
        free,
    )


def _gross_views(views, solved):
    """Views with more than a third of gross residuals."""
    v = _residuals(views, solved)
    typical = 1.4826 * np.nanmedian(v)
    gross = v > max(GROSS * typical, LEAST_GROSS)
    return gross.sum(1) > PART * views.visible.sum(1)


def _residuals(views, solved):
    """Lengths of the residuals, pixels; NaN for missing points."""
    model = get_model(solved.model)
    computed = images_of_board(
        model, solved.interior[0], solved.position[0], solved.rotation[0], views.board.points
    )
    return np.linalg.norm(computed - in_model_units(views.xy, model, views.image_size), axis=2)


def _parameters(views, solved, model, free, pixel_size) -> dict[str, float]:
    """The computed parameters of the camera; those in mm that are not free keep their default."""
    found = dict(zip(get_model(solved.model).parameters, solved.interior[0].tolist()))
    if model.unit == "px":
        return found
    width, height = pixel_size
    c = (found["fx"] * width + found["fy"] * height) / 2
    centre = np.array([found["cx"], found["cy"]])
    x0, y0 = in_model_units(centre, model, views.image_size, pixel_size).tolist()
    sign = -1 if model.own_formula == "to_ideal" else 1
    parameters = {"c": c, "x0": x0, "y0": y0, "K1": sign * found["k1"] / c**2}
    parameters = {
        name: value for name, value in parameters.items()
        if name in free or name in model.principal_distance
    }  # fmt: skip
    if "format_factor" in model.parameters:
        # the radial polynomial is zero at 100/F: in the corners of the image
        diagonal = np.hypot(*(np.array(views.image_size) * pixel_size))
        parameters["format_factor"] = 200 / float(diagonal)
    return parameters


def _fitted(views, solved, model, free, pixel_size, given) -> dict[str, float]:
    """Parameters of a model fitted to the images of the computed camera, over the measured area;
    for a model with priors, all parameters with a prior, over the whole image if possible."""
    source, xy = get_model(solved.model), views.xy[views.visible]
    found = dict(zip(source.parameters, solved.interior[0].tolist()))
    if {*given} - {*model.principal_distance}:
        model = dataclasses.replace(model, defaults=dict(model.defaults) | given)
    core = () if model.prior else model.principal_distance
    wanted = [n for n in model.parameters if n in (*core, *free) and n not in given]
    areas = [(xy.min(0), xy.max(0))]
    for area in [None, *areas] if model.prior else areas:
        try:
            cost = convert_camera(
                source, found, model, image_size=views.image_size, pixel_size=pixel_size,
                area=area, free=wanted,
            )  # fmt: skip
        except ValueError as error:
            problem = error
        else:
            return dict(cost.parameters)
    hint = "choose a larger field of view" if "spline" in model.name else (
        "start with fewer parameters (free), or give values (given)")  # fmt: skip
    raise NotSolvedError(
        f"not solved: no start values of model {model.name!r}: {problem}; {hint}"
    )
