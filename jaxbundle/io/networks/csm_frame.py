"""Frame and push-frame cameras of the Community Sensor Model: support data (ISD) as ALE writes
them, and the model states of frame cameras.

A file of a frame camera is one photograph: its camera, its projection centre and its attitude in
the frame of the body. The fields have the meaning of usgscsm:

    sample = u + ½, line = v + ½                      (½, ½): centre of the first pixel
    detector = (line, sample)·summing + starting_detector
    (x, y) = A⁻¹·(detector − detector_center − a₀)    focal plane, mm; a₀ | A: focal2pixel
    (x', y') = (x, y) without distortion
    X = X0 + λ·R·(x', y', f)                          R from the camera into the frame of the body

With the x and y axis of our camera along the samples and against the lines, `radial` is `usgs`
(xi = x − x·(k0 + k1·r² + k2·r⁴): K_i = −k_i), `dawnfc` (x = x'·(1 + k·r'²), mm) and `radtan`
(OpenCV's coefficients, of x'/f) are `opencv`; `cahvor` with its centre of distortion on the axis
is `radial`. With another centre, and for `transverse`, cubic polynomials of (x', y'), the nearest
camera is fitted and the difference reported. A mirror image (samples × lines against the view) has
no camera here.

A push-frame camera takes framelets of some lines, one under the other in its image, each as a frame
camera does, at the time

    t = starting_ephemeris_time + exposure_duration/2 + k·interframe_delay

of its middle, k = 0 the first in time: from the bottom of the image if framelet_order_reversed. The
file is as many photographs, NAME-000 the uppermost one, of one camera. Line l of the image is line
l − k·framelet_height of framelet k, also where usgscsm cuts lines that neighbours show too.

Source: usgscsm, UsgsAstroFrameSensorModel.cpp, UsgsAstroPushFrameSensorModel.cpp and
Distortion.cpp; ALE's formatters.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.io.cameras.nearest_camera import Foreign, Formula, fit_camera, fit_messages
from jaxbundle.io.networks.assemble import assemble, entry_of, foreign_document, image_columns
from jaxbundle.io.text.csv_tables import read_text
from jaxbundle.io.text.json_fields import JsonFields, read_object
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.network.tables import Camera, Network, Source
from jaxbundle.system.file_content import beginning
from jaxbundle.types import Scalar

# As in `io/scanner/csm.py`, which is imported on use: every command that reads a network would
# load line scanners otherwise, a fifteenth of the time of a small adjustment.
MODEL, PUSH_FRAME = "USGS_ASTRO_FRAME_SENSOR_MODEL", "USGS_ASTRO_PUSH_FRAME_SENSOR_MODEL"
FRAMELETS = (
    "framelet_height",
    "framelets_flipped",
    "framelet_order_reversed",
    "interframe_delay",
    "exposure_duration",
    "starting_ephemeris_time",
    "num_lines_overlap",
)
KEYS = Keys(
    (
        *("name_model", "name_sensor", "image_lines", "image_samples", "center_ephemeris_time"),
        *("body_rotation", "instrument_pointing", "instrument_position", "sensor_position"),
        *("sensor_orientation", "detector_sample_summing", "detector_line_summing"),
        *("focal_length_model", "detector_center", "focal2pixel_lines", "focal2pixel_samples"),
        *("optical_distortion", "starting_detector_line", "starting_detector_sample"),
        *("projection", "geotransform", "jitter"),
        *FRAMELETS,
    ),
    {
        **dict.fromkeys(
            ("isis_camera_version", "name_platform", "image_identifier", "naif_keywords",
             "interpolation_method", "number_of_*", "dt_ephemeris", "t0_ephemeris", "dt_quaternion",
             "t0_quaternion", "b_summing", "ending_ephemeris_time"),
            "names and sources; times of one photograph",
        ),
        **dict.fromkeys(
            ("radii", "reference_height", "sun_position", "velocity*", "sensor_velocity"),
            "the body, the sun and the motion, which the photograph does not need",
        ),
    },
)  # fmt: skip


def is_csm_frame(path: Path) -> bool:
    """Whether a JSON file names the model of frame or push-frame cameras."""
    if path.suffix.lower() != ".json":
        return False
    start = beginning(path, 100_000)
    return any(model.encode() in start for model in (MODEL, PUSH_FRAME))


def read_csm_frame(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The photograph of an ISD or a model state, with the name of the file, or the photographs of
    the framelets of a push-frame camera; lengths in metres, in the frame of the body. Nothing can
    be adjusted.

    **Raises:** `InputError` naming file and field: missing, not a number, a distortion without a
    camera here; for states of push-frame cameras, maps, crops and mirror images.
    """
    from jaxbundle.io.scanner.csm import refuse_map
    from jaxbundle.io.scanner.csm_trajectory import pose_at_centre

    path = Path(path)
    isd, unknown = _support_data(path)
    refuse_map(isd)
    if isd.get("jitter") is not None:
        raise InputError(f"{path}: jitter, of a rolling shutter, is not supported")
    plane = _focal_plane(isd)
    id = str(isd.get("name_sensor") or path.stem)
    if isd.get("name_model") == PUSH_FRAME:
        plane, X0, R, warnings = _framelets(isd, plane)
        names = [f"{path.stem}-{k:03d}" for k in range(len(X0))]
    else:
        centre, rotation, warnings = pose_at_centre(isd)
        X0, R, names = centre[None], rotation.as_matrix()[None], [path.stem]
    camera = _camera(id, isd, plane)
    # From the body into our frame, of which the plane has the axes in the frame of the ISD.
    M = plane.axes @ np.swapaxes(R, 1, 2)
    source = Source(str(path), None, "photograph")
    images = image_columns(source, names, [id] * len(names), M, X0)
    document = foreign_document(path.stem, [entry_of(camera)], object_unit="m")
    messages = (*warnings, *fit_messages([camera]), *unknown.messages())
    return assemble(path, document, overrides, images, warnings=messages)


def _support_data(path: Path) -> tuple[JsonFields, UnknownKeys]:
    """The fields of an ISD, or of a state in the form of one; keys that are not understood."""
    text, unknown = read_text(path), UnknownKeys()
    if not text.lstrip().startswith("{"):
        from jaxbundle.io.scanner.csm_state import frame_support_data_of

        # A state: the name of its model, then an object.
        name, _, body = text.lstrip().partition("\n")
        if name.strip() != MODEL:
            raise InputError(
                f"{path}: a model state of {show(name.strip()[:60])}; expected one of {MODEL}, or "
                "support data (ISD)"
            )
        state = JsonFields(path, read_object(path, body, "a model state"))
        return JsonFields(path, frame_support_data_of(state)), unknown
    isd = JsonFields(path, read_object(path, text, "an ISD"))
    if isd.get("name_model") not in (MODEL, PUSH_FRAME):
        raise InputError(
            f"{path}: name_model is {show(isd.get('name_model'))}; expected {MODEL} or "
            f"{PUSH_FRAME}: give the support data (ISD) of a frame or push-frame camera"
        )
    unknown.check(isd.document, KEYS, path)
    return isd, unknown


def _framelets(
    isd: JsonFields, plane: "FocalPlane"
) -> tuple["FocalPlane", Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"], tuple[str, ...]]:
    """The plane of a framelet; projection centres, rotations camera → body of all of them, from the
    top of the image; warnings."""
    from jaxbundle.io.scanner.csm_trajectory import poses_at

    height, lines = isd.integer("framelet_height", minimum=1), plane.size[1]
    if isd.number("detector_line_summing", 1.0) != 1:
        raise InputError(f"{isd.path}: detector_line_summing of framelets is not supported")
    flags = {
        name: isd.get(name, False) for name in ("framelets_flipped", "framelet_order_reversed")
    }
    for name, value in flags.items():
        if not isinstance(value, bool):
            raise InputError(f"{isd.path}: {name} is {show(value)}; expected true or false")
    if flags["framelets_flipped"]:
        raise InputError(
            f"{isd.path}: framelets_flipped: the lines of every framelet are in reverse order, a "
            "mirror image, which no camera here has; turn them round and set it to false"
        )
    framelet_count, surplus_lines = divmod(lines, height)
    warnings = []
    if surplus_lines:
        warnings.append(
            f"{isd.path}: {lines} lines are {framelet_count} framelets of {height} and "
            f"{surplus_lines} more lines, which are left out"
        )
    if framelet_count == 0:
        raise InputError(f"{isd.path}: {lines} lines are less than a framelet of {height}")
    delay = isd.number("interframe_delay")
    if not delay > 0:
        raise InputError(f"{isd.path}: interframe_delay is {delay:g}; expected seconds above 0")
    k = np.arange(framelet_count)
    k = k[::-1] if flags["framelet_order_reversed"] else k
    first_time = isd.number("starting_ephemeris_time") + isd.number("exposure_duration") / 2
    P, R, pose_warnings = poses_at(
        isd, first_time - isd.number("center_ephemeris_time") + k * delay
    )
    return (
        plane._replace(size=(plane.size[0], height)),
        P,
        R.as_matrix(),
        (*pose_warnings, *warnings),
    )


class FocalPlane(NamedTuple):
    """The focal plane of an ISD.

    `to_mm`: of a pixel along samples and along lines [2, 2], in columns; `centre`: (u, v) of
    x = y = 0; `axes`: x, y, z of our camera in the frame of the ISD, in rows; `focal_length`: |f|.
    """

    to_mm: Float[np.ndarray, "2 2"]
    centre: Float[np.ndarray, "2"]
    axes: Float[np.ndarray, "3 3"]
    size: tuple[int, int]
    focal_length: float

    @property
    def pixel_size(self) -> tuple[float, float]:
        """Width and height, mm."""
        w, h = np.linalg.norm(self.to_mm, axis=0)
        return float(w), float(h)


def _focal_plane(isd: JsonFields) -> FocalPlane:
    f = isd.number("focal_length_model.focal_length")
    size = (isd.integer("image_samples", minimum=1), isd.integer("image_lines", minimum=1))
    along_line, along_sample = (isd.array(f"focal2pixel_{k}", (3,)) for k in ("lines", "samples"))
    names = ("detector_sample_summing", "detector_line_summing")
    summing = np.array([isd.number(name, 1.0) for name in names])
    if f == 0 or not (summing > 0).all():
        raise InputError(
            f"{isd.path}: focal_length is {f:g}, {names[0]} and {names[1]} are {summing[0]:g} and "
            f"{summing[1]:g}; expected a focal length in mm, and summing above 0"
        )
    A = np.stack([along_sample[1:], along_line[1:]])
    # Parallel but for the rounding of numbers of 12 digits.
    if abs(np.linalg.det(A)) < 1e-12 * np.abs(A).max() ** 2 or not A.any():
        raise InputError(f"{isd.path}: focal2pixel_lines and focal2pixel_samples are dependent")
    to_mm = np.linalg.inv(A) * summing
    start = np.array([isd.number(f"starting_detector_{k}", 0.0) for k in ("sample", "line")])
    middle = np.array([isd.number(f"detector_center.{k}") for k in ("sample", "line")])
    offset = np.array([along_sample[0], along_line[0]])
    centre = (middle + offset - start) / summing - 0.5
    if np.linalg.det(to_mm) * np.sign(f) < 0:
        raise InputError(
            f"{isd.path}: focal2pixel_lines and focal2pixel_samples make a mirror image, which no "
            "camera here has; mirror the image, and negate the coefficients of its lines"
        )
    x_axis = to_mm[:, 0] / np.linalg.norm(to_mm[:, 0])
    # y against the lines; of a plane with skew, at right angles to the samples
    y_axis = np.array([x_axis[1], -x_axis[0]]) * np.sign(f)
    axes = np.array([[*x_axis, 0.0], [*y_axis, 0.0], [0.0, 0.0, -np.sign(f)]])
    return FocalPlane(to_mm, centre, axes, size, abs(f))


def _camera(id: str, isd: JsonFields, plane: FocalPlane) -> Camera:
    kinds = isd.get("optical_distortion", {"radial": {"coefficients": [0.0]}})
    if not isinstance(kinds, dict) or len(kinds) != 1:
        raise InputError(f"{isd.path}: optical_distortion {show(kinds)}; expected one kind")
    (kind,) = kinds
    where = f"optical_distortion.{kind}"
    numbers = lambda n: isd.array(f"{where}.coefficients", (n,))
    # The images of the axes of the plane in ours: the rows of `axes` without the third.
    Q, f = plane.axes[:2, :2], plane.focal_length
    # The cosine of the angle between the axes: 1e-9 shifts 1e-5 px across 10 000 pixels.
    is_skewed = abs(plane.to_mm[:, 0] @ plane.to_mm[:, 1]) > 1e-9 * np.prod(plane.pixel_size)
    focal: Mapping[str, float] = dict(
        fx=f / plane.pixel_size[0],
        fy=f / plane.pixel_size[1],
        cx=float(plane.centre[0]),
        cy=float(plane.centre[1]),
    )
    match kind:
        case "radial" | "cahvor":
            k = np.r_[numbers(None), np.zeros(6)]
            term_count = 5 if kind == "cahvor" else 3
            if k[term_count:].any():
                raise InputError(
                    f"{isd.path}: {where}: at most {term_count} coefficients are known"
                )
            offset = k[3:5] if kind == "cahvor" else np.zeros(2)
            if is_skewed or offset.any():
                p = {"k": k[:3], "offset": offset}
                return _fit(id, isd, plane, focal, image_of_radial, p, f"has the distortion {kind}")
            return (
                _corrected_camera(id, plane, k[:3]) if k.any() else _opencv_camera(id, plane, focal)
            )
        case "dawnfc" | "radtan":
            # k1, k2, p1, p2, k3 of x/f; a decentring (p2, p1) turns with the axes
            k1, k2, p1, p2, k3 = (
                numbers(5) if kind == "radtan" else (numbers(1)[0] * f * f, 0, 0, 0, 0)
            )
            decentring = Q @ [p2, p1] * np.sign(-plane.axes[2, 2])
            coefficients = {"k1": k1, "k2": k2, "k3": k3, "p1": -decentring[1], "p2": decentring[0]}
            if is_skewed:
                raise InputError(f"{isd.path}: {where} with skewed pixels is not supported")
            return _opencv_camera(
                id, plane, {**focal, **{name: float(v) for name, v in coefficients.items()}}
            )
        case "transverse":
            a, b = (isd.array(f"{where}.{axis}", (None,)) for axis in "xy")
            p = {"a": np.r_[a, np.zeros(10)][:10], "b": np.r_[b, np.zeros(10)][:10]}
            reason = "has the distortion transverse"
            return _fit(id, isd, plane, focal, image_of_transverse, p, reason)
    raise InputError(
        f"{isd.path}: optical_distortion {show(kind)} of a frame camera is not supported; "
        "expected radial, transverse, radtan, dawnfc or cahvor"
    )


def _opencv_camera(id: str, plane: FocalPlane, parameters: Mapping[str, float]) -> Camera:
    return Camera(id, "opencv", parameters, image_size=plane.size, pixel_size=plane.pixel_size)


def _corrected_camera(id: str, plane: FocalPlane, k: Float[np.ndarray, "3"]) -> Camera:
    """Exactly `radial`, the correction of the measured point; `brown` without a linear term."""
    (w, h), (pw, ph) = plane.size, plane.pixel_size
    parameters = {
        "c": plane.focal_length,
        "x0": (plane.centre[0] - (w - 1) / 2) * pw,
        "y0": -(plane.centre[1] - (h - 1) / 2) * ph,
        **{f"K{i}": -value for i, value in enumerate(k)},
    }
    parameters = {name: float(value) for name, value in parameters.items()}
    model = "usgs" if parameters["K0"] else "brown"
    if model == "brown":
        del parameters["K0"]
    return Camera(id, model, parameters, image_size=plane.size, pixel_size=plane.pixel_size)


def _fit(
    id: str,
    isd: JsonFields,
    plane: FocalPlane,
    start: Mapping[str, float],
    formula: Formula,
    p: Mapping[str, Float[np.ndarray, " n"]],
    reason: str,
) -> Camera:
    """The nearest camera: the pixels of rays by the formula of the ISD."""
    parameters = {
        "distortion": dict(p),
        "f": plane.focal_length,
        "axes": plane.axes[:2, :2],
        "to_pixel": np.linalg.inv(plane.to_mm),
        "centre": plane.centre,
    }
    foreign = Foreign(formula, parameters, start, plane.size, plane.pixel_size)
    return fit_camera(id, foreign, str(isd.path), reason)


def radial(k: Mapping[str, Array], u: Float[Array, "2"]) -> Float[Array, "2"]:
    """The point whose correction, about `offset`, is u: d + (1 − k0 − k1·r² − k2·r⁴)·… = u."""

    def correct(d: Float[Array, "2"]) -> Float[Array, "2"]:
        e = d - k["offset"]
        r2 = e @ e
        return k["offset"] + e * (1 - k["k"][0] - r2 * (k["k"][1] + r2 * k["k"][2]))

    # Fixed-point iteration as of the scanners: a step gains some digits.
    d = u
    for _ in range(25):
        d = d + u - correct(d)
    return d


def transverse(k: Mapping[str, Array], u: Float[Array, "2"]) -> Float[Array, "2"]:
    """Cubic polynomials of the undistorted point."""
    x, y = u
    terms = jnp.stack(
        [jnp.ones_like(x), x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3]
    )
    return jnp.stack([k["a"] @ terms, k["b"] @ terms])


def image_of_radial(p: Mapping, X: Scalar, Y: Scalar, Z: Scalar) -> Float[Array, "2"]:
    """The pixel of a ray (right, down, forward) by `radial`, or `cahvor`."""
    return _pixel_of_ray(radial, p, X, Y, Z)


def image_of_transverse(p: Mapping, X: Scalar, Y: Scalar, Z: Scalar) -> Float[Array, "2"]:
    """The pixel of a ray (right, down, forward) by `transverse`."""
    return _pixel_of_ray(transverse, p, X, Y, Z)


def _pixel_of_ray(
    distort: Callable, p: Mapping, X: Scalar, Y: Scalar, Z: Scalar
) -> Float[Array, "2"]:
    # Our axes are x right, y up: a ray (X, Y) has −Y along the second.
    u = p["f"] / Z * (X * p["axes"][0] - Y * p["axes"][1])
    return p["to_pixel"] @ distort(p["distortion"], u) + p["centre"]
