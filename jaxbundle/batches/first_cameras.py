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
    tried = _attempts(model, tuple(free), image_size)
    found: dict[int, FirstCamera] = {}
    left = np.arange(len(xy))
    shape = get_model(tried[0][0])
    xy = in_model_units(xy, shape, image_size)
    for name, wanted, start in tried:
        X = points[left] if points.ndim == 3 else points
        batch = calibrate_batch(
            X,
            xy[left],
            image_size,
            model=name,
            free=wanted,
            start=start,
            threads=threads,
        )
        found |= {int(i): FirstCamera(batch, row) for row, i in enumerate(left)}
        left = left[~batch.solved]
        if not len(left):
            break
    return [found[i] for i in range(len(xy))]


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
    held = tuple(n for n in model.principal_distance if n not in free)
    attempts: list[Attempt] = [(model.name, (*held, *free), None)]
    if model.name == "opencv":
        attempts.append(("opencv", (*held, *(n for n in free if n in SIMPLE)), None))
    if model.name == "kannala-brandt":
        known = [{"fx": f, "fy": f} for f in (max(size) / angle for angle in WIDE)]
        attempts += [(model.name, free, start) for start in known]
        attempts += [(model.name, ("fx", "fy", "cx", "cy"), start) for start in known]
    return attempts


def _by_fit(model: CameraModel) -> bool:
    """Whether its start values are derived from another model."""
    return is_own(model) or (model.unit == "px" and model.name not in SOLVED)


def parameters_of(
    first: FirstCamera,
    xy: Float[np.ndarray, "n 2"],
    image_size: tuple[float, float],
    model: CameraModel,
    free: Sequence[str],
    pixel_size: tuple[float, float] | None = None,
    given: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """Start values of the parameters of a model; `xy`: all image points, pixels; `given`: values
    known beforehand.

    **Raises:** `NotSolvedError` where the model cannot be fitted."""
    given = dict(given or {})
    if _by_fit(model):
        return _fit(first, xy, image_size, model, free, pixel_size, given) | given
    found = first.interior
    if model.unit == "px":
        return found | given
    width, height = pixel_size or (1.0, 1.0)
    c = (found["fx"] * width + found["fy"] * height) / 2
    centre = np.array([found["cx"], found["cy"]])
    x0, y0 = in_model_units(centre, model, image_size, (width, height)).tolist()
    # OpenCV adds k1·r² to the ideal point; corrections are applied to the measured one
    sign = -1 if model.own_formula == "to_ideal" else 1
    parameters = {"c": c, "x0": x0, "y0": y0, "K1": sign * found["k1"] / c**2}
    parameters = {
        name: value
        for name, value in parameters.items()
        if name in free or name in model.principal_distance
    }
    if "format_factor" in model.parameters:
        # The radial polynomial is zero at 100/F: in the corners of the image.
        diagonal = np.hypot(*(np.array(image_size) * (width, height)))
        parameters["format_factor"] = 200 / float(diagonal)
    return parameters | given


def _fit(
    first: FirstCamera,
    xy: Float[np.ndarray, "n 2"],
    image_size: tuple[float, float],
    model: CameraModel,
    free: Sequence[str],
    pixel_size: tuple[float, float] | None,
    given: dict[str, float],
) -> dict[str, float]:
    """Parameters of a model fitted to the images of the computed camera, over the measured area;
    for a model with priors, all parameters with a prior, over the whole image if possible."""
    conventions = dict(given)
    if model.prior:
        # Held, whatever it is; near the true one, so that knots without points, which stay at 0,
        # are like their neighbours.
        centre = {name: first.interior[name] for name in ("cx", "cy")}
        conventions = {n: v for n, v in centre.items() if n in model.parameters} | conventions
    if {*conventions} - {*model.principal_distance}:
        model = dataclasses.replace(model, defaults=dict(model.defaults) | conventions)
    core = () if model.prior else model.principal_distance
    wanted = [n for n in model.parameters if n in (*core, *free) and n not in given]
    areas = [(xy.min(0), xy.max(0))]
    # Over the measured area: beyond it the first camera is extrapolated, and a fit would follow
    # that. Models with priors (splines) first over the whole image, where every knot gets a value.
    for area in [None, *areas] if model.prior else areas:
        try:
            cost = convert_camera(
                first.model,
                first.interior,
                model,
                image_size=image_size,
                pixel_size=pixel_size,
                area=area,
                free=wanted,
            )
        except ValueError as error:
            problem = error
        else:
            return dict(cost.parameters)
    hint = (
        "choose a larger field of view"
        if "spline" in model.name
        else ("start with fewer parameters (free), or give values (given)")
    )
    raise NotSolvedError(f"not solved: no start values of model {model.name!r}: {problem}; {hint}")
