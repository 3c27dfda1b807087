"""Start values of cameras of any model from views of known points.

`calibrate_batch` gives focal lengths and poses in closed form and adjusts them, in a model in
pixels. For a model in millimetres that is `opencv` with k1 and k2; to first order

    c = (fx·p_x + fy·p_y)/2,   K1 = ∓k1/c²  (− for a correction, + for a distortion)

The parameters of every other model, including user-defined ones, are fitted over the image to
`opencv` (or `kannala-brandt`, if rays may be 90° and more from the axis).
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.batches.calibrate import BatchCalibration, calibrate_batch
from jaxbundle.cameras import CameraModel, convert_camera, get_model, is_own
from jaxbundle.cameras.pixel_frame import in_model_units
from jaxbundle.errors import NotSolvedError

# Models in pixels that `calibrate_batch` solves without start values.
SOLVED = ("opencv", "kannala-brandt", "snavely")
SIMPLE = ("fx", "fy", "cx", "cy", "k1", "k2")
# Model, free parameters and start values.
Attempt = tuple[str, tuple[str, ...], dict[str, float] | None]
# Fields of view tried if the views give no start values for a fisheye; between them every principal
# distance is within a third of one.
WIDE = tuple(np.radians([60.0, 100.0, 140.0, 180.0]))


@dataclasses.dataclass(frozen=True)
class FirstCamera:
    """A camera of a batch in a model that it solves; properties are those of `BatchCalibration`."""

    batch: BatchCalibration
    row: int

    @property
    def model(self) -> CameraModel:
        return get_model(self.batch.model)

    @property
    def solved(self) -> bool:
        return bool(self.batch.solved[self.row])

    @property
    def interior(self) -> dict[str, float]:
        return dict(zip(self.model.parameters, self.batch.interior[self.row].tolist()))

    @property
    def status(self) -> str:
        return str(self.batch.status[self.row])

    @property
    def remark(self) -> str:
        return str(self.batch.remark[self.row])

    @property
    def views(self) -> Bool[np.ndarray, " views"]:
        return self.batch.views[self.row]

    @property
    def position(self) -> Float[np.ndarray, "views 3"]:
        return self.batch.position[self.row]

    @property
    def angles(self) -> Float[np.ndarray, "views 3"]:
        return self.batch.angles[self.row]

    @property
    def rotation(self) -> Float[np.ndarray, "views 3 3"]:
        return self.batch.rotation[self.row]


def first_cameras(
    points: Float[np.ndarray, "*cameras points 3"],
    xy: Float[np.ndarray, "cameras views points 2"],
    image_size: tuple[int, int],
    model: CameraModel,
    free: Sequence[str],
    threads: int | None = None,
) -> list[FirstCamera]:
    """The first attempt with a solution, possibly weak, of every camera; the last one if there is
    none. `xy` in pixels, NaN where a point is missing."""
    attempts = _attempts(model, tuple(free), image_size)
    found_cameras: dict[int, FirstCamera] = {}
    unsolved = np.arange(len(xy))
    shape = get_model(attempts[0][0])
    xy = in_model_units(xy, shape, image_size)
    for name, free_names, start in attempts:
        X = points[unsolved] if points.ndim == 3 else points
        batch = calibrate_batch(
            X,
            xy[unsolved],
            image_size,
            model=name,
            free=free_names,
            start=start,
            threads=threads,
        )
        found_cameras |= {int(i): FirstCamera(batch, row) for row, i in enumerate(unsolved)}
        unsolved = unsolved[~batch.solved]
        if not len(unsolved):
            break
    return [found_cameras[i] for i in range(len(xy))]


def _attempts(
    model: CameraModel, free: tuple[str, ...], size: tuple[float, float]
) -> list[Attempt]:
    """Model, free parameters and start values of the attempts."""
    if _by_fit(model) or model.unit != "px":
        if _by_fit(model) and model.wide:
            fisheye = get_model("kannala-brandt")
            return _attempts(fisheye, fisheye.free, size)
        return [("opencv", SIMPLE, None), ("opencv", ("fx", "fy"), None)]
    # The principal distance is always sought. A second attempt without the higher coefficients:
    # what does not determine them may still determine a start.
    held_names = tuple(n for n in model.principal_distance if n not in free)
    attempts: list[Attempt] = [(model.name, (*held_names, *free), None)]
    if model.name == "opencv":
        attempts.append(("opencv", (*held_names, *(n for n in free if n in SIMPLE)), None))
    if model.name == "kannala-brandt":
        focal_lengths = [{"fx": f, "fy": f} for f in (max(size) / angle for angle in WIDE)]
        attempts += [(model.name, free, start) for start in focal_lengths]
        attempts += [(model.name, ("fx", "fy", "cx", "cy"), start) for start in focal_lengths]
    return attempts


def _by_fit(model: CameraModel) -> bool:
    """Whether its start values are derived from another model."""
    return is_own(model) or (model.unit == "px" and model.name not in SOLVED)


def parameters_of(
    first_camera: FirstCamera,
    xy: Float[np.ndarray, "n 2"],
    image_size: tuple[float, float],
    model: CameraModel,
    free: Sequence[str],
    pixel_size: tuple[float, float] | None = None,
    given_values: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """Start values of the parameters of a model; `xy`: all image points, pixels; `given_values`:
    values known beforehand.

    **Raises:** `NotSolvedError` where the model cannot be fitted."""
    given_values = dict(given_values or {})
    if _by_fit(model):
        return (
            _fit(first_camera, xy, image_size, model, free, pixel_size, given_values) | given_values
        )
    interior = first_camera.interior
    if model.unit == "px":
        return interior | given_values
    width, height = pixel_size or (1.0, 1.0)
    c = (interior["fx"] * width + interior["fy"] * height) / 2
    centre = np.array([interior["cx"], interior["cy"]])
    x0, y0 = in_model_units(centre, model, image_size, (width, height)).tolist()
    # OpenCV adds k1·r² to the ideal point; corrections are applied to the measured one
    sign = -1 if model.own_formula == "to_ideal" else 1
    parameters = {"c": c, "x0": x0, "y0": y0, "K1": sign * interior["k1"] / c**2}
    parameters = {
        name: value
        for name, value in parameters.items()
        if name in free or name in model.principal_distance
    }
    if "format_factor" in model.parameters:
        # The radial polynomial is zero at 100/F: in the corners of the image.
        diagonal = np.hypot(*(np.array(image_size) * (width, height)))
        parameters["format_factor"] = 200 / float(diagonal)
    return parameters | given_values


def _fit(
    first_camera: FirstCamera,
    xy: Float[np.ndarray, "n 2"],
    image_size: tuple[float, float],
    model: CameraModel,
    free: Sequence[str],
    pixel_size: tuple[float, float] | None,
    given_values: dict[str, float],
) -> dict[str, float]:
    """Parameters of a model fitted to the images of the computed camera, over the measured area;
    for a model with priors, all parameters with a prior, over the whole image if possible."""
    held_values = dict(given_values)
    if model.prior:
        # Held, whatever it is; near the true one, so that knots without points, which stay at 0,
        # are like their neighbours.
        centre = {name: first_camera.interior[name] for name in ("cx", "cy")}
        held_values = {n: v for n, v in centre.items() if n in model.parameters} | held_values
    # A principal distance has no default: a given one replaces that of the fit in the end, and the
    # adjustment finds what goes with it.
    if {*held_values} - {*model.principal_distance}:
        model = dataclasses.replace(model, defaults=dict(model.defaults) | held_values)
    core = () if model.prior else model.principal_distance
    fitted_names = [n for n in model.parameters if n in (*core, *free) and n not in given_values]
    areas = [(xy.min(0), xy.max(0))]
    # Over the measured area: beyond it the first camera is extrapolated, and a fit would follow
    # that. Models with priors (splines) first over the whole image, where every knot gets a value.
    for area in [None, *areas] if model.prior else areas:
        try:
            conversion = convert_camera(
                first_camera.model,
                first_camera.interior,
                model,
                image_size=image_size,
                pixel_size=pixel_size,
                area=area,
                free=fitted_names,
            )
        except ValueError as error:
            problem = error
        else:
            return dict(conversion.parameters)
    hint = (
        "choose a larger field of view"
        if "spline" in model.name
        else ("start with fewer parameters (free), or give values (given)")
    )
    raise NotSolvedError(f"not solved: no start values of model {model.name!r}: {problem}; {hint}")
