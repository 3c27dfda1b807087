"""A camera read from a file in the form of OpenCV's FileStorage: YAML, JSON or XML.

    %YAML:1.0
    ---
    image_width: 640
    image_height: 480
    camera_matrix: !!opencv-matrix
       rows: 3
       cols: 3
       dt: d
       data: [ fx, 0., cx, 0., fy, cy, 0., 0., 1. ]
    distortion_coefficients: !!opencv-matrix
       …
       data: [ k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 ]      4, 5, 8, 12 or 14 of them

The similar files of ROS are read as well, and its message CameraInfo as printed
(height, width, K and D, in ROS 2 k and d), and files of other programs with the same entries under
other names (`spellings.py`). With `distortion_model` "equidistant" or "fisheye" the
four coefficients are those of `kannala-brandt`. Pixels have their origin at the
centre of the first pixel, as here. A skew and a tilted sensor (τx, τy),

    s·[x'', y'', 1] = [R33, 0, −R13; 0, R33, −R23; 0, 0, 1]·R·[x', y', 1]
    R = [cos τy, 0, −sin τy; 0, 1, 0; sin τy, 0, cos τy]
        ·[1, 0, 0; 0, cos τx, sin τx; 0, −sin τx, cos τx]
    u = fx·x'' + skew·y'' + cx

are not part of our models: if they are not 0 the nearest is fitted, which needs the image size.
With an entry `xi` it is the camera of OpenCV's module `omnidir`, `mei` with k1, k2, p1, p2.

`opencv_writing.py` writes such files.

Source: OpenCV 4 documentation, XML/YAML/JSON file storages; ROS wiki, camera_calibration_parsers.
"""

import codecs
import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeGuard

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxbundle.arguments import show
from jaxbundle.cameras import get_model
from jaxbundle.cameras.model import project
from jaxbundle.cameras.scalars import Scalar
from jaxbundle.errors import InputError
from jaxbundle.io.cameras.file_storage import storage_entries
from jaxbundle.io.cameras.nearest_camera import FittedCamera, Foreign, fit_camera, with_messages
from jaxbundle.io.cameras.spellings import (
    CORE,
    IGNORED,
    MEANING,
    MODEL_NAMES,
    TILT,
    EntriesByMeaning,
    camera_entries,
    cameras_within,
    fold,
    has_camera,
    meaning_of,
)
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.io.networks.kalibr import is_kalibr
from jaxbundle.io.text.csv_tables import read_text
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.io.text.yaml_text import parse_document
from jaxbundle.network.rules import check_camera
from jaxbundle.network.tables import Camera
from jaxbundle.system.file_content import beginning, parse_json

YAML = (".yaml", ".yml")
# Of files that are written.
SUFFIXES = (*YAML, ".json")
READ_SUFFIXES = (*SUFFIXES, ".xml")
ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
# Lengths of a vector of distortion coefficients that OpenCV accepts (`calibrateCamera`); the last
# two of 14 are the tilt.
COEFFICIENT_COUNTS = (4, 5, 8, 12, 14)
FISHEYE = ("equidistant", "fisheye")
# Names of its omnidirectional camera.
OMNIDIRECTIONAL = re.compile("omni|mei")
# Parts of the names of lens models that are none of OpenCV's; what has none of them under the key
# `model` names a product, "HERO7 Black".
FOREIGN_MODELS = re.compile(
    "omni|mei|unified|scaramuzza|ocam|sphere|eucm|ucm|fov|prism|division|cylind|equirect|ftheta|"
    "inverse|modified|atan|poly|stereographic|orthographic|equisolid|spline|generic"
)
MODEL_KEYS = ("distortion_model", "camera_model")
FILE_STORAGE = b"<opencv_storage"
# Bytes of a file that is looked into: calibrations with all their measurements have a megabyte,
# networks of other programs in JSON hundreds.
LARGEST_FILE = 20_000_000


def is_opencv(path: Path) -> bool:
    """Whether a file has a name of this kind, and one camera in OpenCV's or a similar form."""
    return len(find_cameras(path)) == 1


def find_cameras(path: Path) -> list[tuple[str, Mapping[str, Any]]]:
    """The names and entries of the cameras in a YAML, JSON or XML file, without any complaint."""
    head = beginning(path, 1_000_000) if path.suffix.lower() in READ_SUFFIXES else b""
    if _is_xml(head) and FILE_STORAGE not in head:
        return []
    # Every spelling of a camera has one of these.
    if not re.search(rb"(?i)[km]\b|intrinsic|matri|mat\b|mtx|fx\b|focal_?length", head):
        return []
    if path.stat().st_size > LARGEST_FILE or is_kalibr(path):
        return []
    # A result of ours has cameras with their covariance: `io/cameras/result_json.py` reads it.
    if b'"converged"' in head and b'"termination"' in head:
        return []
    try:
        return list(cameras_within(read_document(path)))
    except InputError:
        # A damaged file is reported by its reader.
        return [("", {})] if re.search(rb"(?i)\bcamera_?matrix\b", head) else []


def _is_xml(head: bytes) -> bool:
    return head.removeprefix(codecs.BOM_UTF8).lstrip().startswith(b"<")


def read_document(path: Path) -> Any:
    """The document of a YAML, JSON or XML file; OpenCV recognises them by their content."""
    text = read_text(path)
    if path.suffix.lower() == ".xml" or _is_xml(text[:1000].encode()):
        return storage_entries(path)
    if path.suffix.lower() == ".json" or text.lstrip().startswith("{"):
        return parse_json(path, text)
    return parse_document(path, text)


def read_entries(path: Path) -> dict[str, Any]:
    """The entries of a YAML, JSON or XML file.

    **Raises:** `InputError`."""
    document = read_document(path)
    if document is None:
        raise InputError(f"{path}: the file is empty; expected keys and values")
    if not isinstance(document, dict):
        raise InputError(f"{path}: expected an object with camera_matrix")
    return document


def matrix_in(
    path: str | Path, entries: Mapping, names: Sequence[str], shape: tuple[int, int]
) -> Float[np.ndarray, "rows columns"]:
    """A matrix by the first of these names.

    **Raises:** `InputError` naming file and entry: missing, or of another shape."""
    name = next((name for name in names if name in entries), None)
    if name is None:
        raise InputError(f"{path}: {names[0]} is missing")
    return matrix_of(path, name, entries[name], shape)


def read_opencv(
    path: str | Path, entries: Mapping[str, Any] | None = None, id: str | None = None
) -> Camera:
    """The camera of a file, or of some of its `entries`; its id is the name of the file, if none
    is given. Messages about what was not understood go with it (`nearest_camera`).

    **Raises:** `InputError` naming the entry.
    """
    path = Path(path)
    unknown = UnknownKeys()
    entries = _only_camera(path, read_entries(path), unknown) if entries is None else entries
    by_meaning = camera_entries(entries, path, unknown)
    if id is None:
        # EuRoC: cam0/sensor.yaml
        id = path.stem if path.stem != "sensor" else path.resolve().parent.name
    return with_messages(camera_of(path, by_meaning, id), *unknown.messages())


def _only_camera(path: Path, entries: Mapping[str, Any], unknown: UnknownKeys) -> Mapping[str, Any]:
    """The entries of the camera, also where they stand within another object."""
    if has_camera(entries):
        return entries
    cameras = list(cameras_within(entries))
    if len(cameras) != 1 or meaning_of(*cameras[0]) == "camera_matrix":
        return entries
    name, inner_entries = cameras[0]
    # {"camera": {…}, "software": …}: what stands around it is checked as well
    outer_keys = {fold(key): key for key in entries if key != name}
    unknown.check((outer_keys[key] for key in IGNORED.unknown(outer_keys)), Keys(()), path)
    return inner_entries


def camera_of(path: str | Path, entries: EntriesByMeaning, id: str) -> Camera:
    """The camera of the entries by meaning.

    **Raises:** `InputError` naming the entry.
    """
    core, skew = _pinhole_parameters(path, entries)
    mirror = _mirror_parameter(path, entries)
    fisheye = not mirror and _is_fisheye(path, entries)
    values = _coefficients(path, entries, fisheye)
    coefficients, tilt = values[: len(ORDER)], values[len(ORDER) :]
    short_model = "a fisheye" if fisheye else "an omnidirectional camera" if mirror else ""
    if short_model and (any(coefficients[4:]) or any(tilt)):
        raise InputError(f"{path}: {len(values)} distortion coefficients; {short_model} has 4")
    size = _image_size(path, entries)
    core, size, messages = _published_image(path, entries, core, size)
    names = ORDER if not fisheye else ("k1", "k2", "k3", "k4")
    camera = Camera(
        id=id,
        model="mei" if mirror else "kannala-brandt" if fisheye else "opencv",
        parameters=core | mirror | dict(zip(names[:4] if mirror else names, coefficients)),
        image_size=size,
    )
    check_camera(camera, f"{path}, ")
    if skew or any(tilt):
        camera = _fit_nearest(Path(path), camera, skew, tilt)
    return with_messages(camera, *messages)


def _pinhole_parameters(
    path: str | Path, entries: EntriesByMeaning
) -> tuple[dict[str, float], float]:
    """fx, fy, cx, cy and the skew."""
    extra = _number(path, entries, "skew", 0.0)
    if "camera_matrix" not in entries and {"fx", "fy"} <= entries.keys():
        return {name: _number(path, entries, name) for name in CORE}, extra
    if "camera_matrix" not in entries:
        raise InputError(f"{path}: camera_matrix is missing")
    name, value = entries["camera_matrix"]
    # As Kalibr and ROS write `intrinsics`.
    if "intrinsic" in name.lower() and isinstance(value, list) and len(value) == 4:
        four = matrix_of(path, name, value, None).tolist()
        return dict(zip(CORE, four)), extra
    K = matrix_of(path, name, value, (3, 3))
    # Its last column can be no principal point.
    if not K[:2, 2].any() and K[2, :2].all():
        # Open3D writes nine numbers column by column
        if not isinstance(value, list) or isinstance(value[0], list):
            raise InputError(
                f"{path}: {name} is transposed, as MATLAB has it, whose pixels count from 1; "
                "expected rows (fx, s, cx), (0, fy, cy), (0, 0, 1), with 1 less in cx and cy"
            )
        K = K.T
    for row, column, expected in ((1, 0, 0), (2, 0, 0), (2, 1, 0), (2, 2, 1)):
        if K[row, column] != expected:
            raise InputError(
                f"{path}: {name}[{row}][{column}] is {K[row, column]:g}; expected {expected}"
            )
    core: dict[str, float] = dict(zip(CORE, map(float, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))))
    for key in CORE:
        # Programs that write both round one of them: three decimals are off by up to 5e-4.
        if key in entries and abs(_number(path, entries, key) - core[key]) > 1e-3:
            raise InputError(
                f"{path}: {entries[key][0]} is {entries[key][1]:g}, but {name} has {core[key]:g}; "
                "expected equal numbers"
            )
    if K[0, 1] and extra and K[0, 1] != extra:
        raise InputError(f"{path}: {entries['skew'][0]} and {name}[0][1] differ; expected one skew")
    return core, float(K[0, 1]) or extra


def _mirror_parameter(path: str | Path, entries: EntriesByMeaning) -> dict[str, float]:
    """ξ of an omnidirectional camera; nothing of others.

    **Raises:** `InputError` for a lens model that is another."""
    if "xi" not in entries:
        return {}
    for meaning in MODEL_KEYS:
        key, kind = entries.get(meaning, ("", ""))
        folded_name = fold(str(kind))
        if (
            folded_name
            and not OMNIDIRECTIONAL.search(folded_name)
            and MODEL_NAMES.get(folded_name) != "opencv"
        ):
            raise InputError(
                f"{path}: {key} {show(kind)} with xi is not known here; expected OpenCV's "
                "omnidirectional camera"
            )
    name, value = entries["xi"]
    values = [value] if _is_number(value) else matrix_of(path, name, value, None).tolist()
    if len(values) != 1:
        raise InputError(f"{path}: {name} has {len(values)} values; expected a finite number")
    return {"xi": float(values[0])}


def _number(
    path: str | Path, entries: EntriesByMeaning, meaning: str, default: float | None = None
) -> float:
    if meaning not in entries and default is not None:
        return default
    if meaning not in entries:
        raise InputError(f"{path}: {meaning} is missing")
    name, value = entries[meaning]
    if not _is_number(value):
        raise InputError(f"{path}: {name} is {show(value)}; expected a finite number")
    return float(value)


def _is_fisheye(path: str | Path, entries: EntriesByMeaning) -> bool:
    """Whether the model is that of `cv2.fisheye`.

    **Raises:** `InputError` for a lens model that is not OpenCV's."""
    _, flag = entries.get("fisheye_model", ("", False))
    if isinstance(flag, str):
        flag = flag.strip().lower() in ("1", "true", "yes")
    models = [flag is True or (_is_number(flag) and flag == 1)]
    for meaning in MODEL_KEYS:
        key, kind = entries.get(meaning, ("", ""))
        if not kind:
            continue
        folded_name = fold(str(kind))
        model = MODEL_NAMES.get(folded_name)
        foreign = model is None and FOREIGN_MODELS.search(folded_name)
        # `model` may be a product's name; without any distortion all models are the same
        is_unknown = model is None and meaning == "distortion_model"
        if foreign or (is_unknown and not _has_zero_distortion(path, entries)):
            raise InputError(
                f"{path}: {key} {show(kind)} is not known here; expected plumb_bob, "
                "rational_polynomial (OpenCV's), equidistant or fisheye"
            )
        models.append(model == "kannala-brandt")
    return any(models)


def _has_zero_distortion(path: str | Path, entries: EntriesByMeaning) -> bool:
    """Whether coefficients are given and are all 0."""
    has_coefficients = not entries.keys().isdisjoint(("distortion_coefficients", *ORDER, *TILT))
    return has_coefficients and not any(_coefficients(path, entries, False))


def _coefficients(path: str | Path, entries: EntriesByMeaning, fisheye: bool) -> list[float]:
    """The coefficients in OpenCV's order."""
    by_name = {name: _number(path, entries, name) for name in (*ORDER, *TILT) if name in entries}
    if "distortion_coefficients" not in entries:
        order = ("k1", "k2", "k3", "k4") if fisheye else (*ORDER, *TILT)
        superfluous = [name for name, value in by_name.items() if value and name not in order]
        if superfluous:
            raise InputError(f"{path}: {', '.join(superfluous)}: a fisheye has k1 to k4")
        return [by_name.get(name, 0.0) for name in order]
    name, value = entries["distortion_coefficients"]
    values = matrix_of(path, name, value, None).tolist()
    if any(by_name.values()) and [by_name.get(k, 0.0) for k in ORDER[: len(values)]] != values:
        raise InputError(f"{path}: {name} and {', '.join(by_name)} differ; expected one of them")
    # Programs pad with zeros: [k1, k2, p1, p2, k3, 0] is a vector of five.
    while values and len(values) not in COEFFICIENT_COUNTS and values[-1] == 0:
        values = values[:-1]
    values = values or [0.0] * 4
    if len(values) not in COEFFICIENT_COUNTS:
        raise InputError(f"{path}: {name} has {len(values)} values; 4, 5, 8, 12 or 14 are known")
    return values


def _image_size(path: str | Path, entries: EntriesByMeaning) -> tuple[int, int] | None:
    sides = [entries.get(f"image_{n}", ("", None))[1] for n in ("width", "height")]
    if sides == [None, None]:
        size = entries.get("image_size", ("", None))[1]
        if size is None:
            return None
        if isinstance(size, Mapping):
            by_meaning = {MEANING.get(fold(name)): value for name, value in size.items()}
            size = [by_meaning.get("image_width"), by_meaning.get("image_height")]
            size = entries["image_size"][1]["data"] if size == [None, None] else size
        size = size[0] if isinstance(size, list) and len(size) == 1 else size
        sides = size if isinstance(size, list) and len(size) == 2 else [None, None]
    width, height = (_positive_integer(x) for x in sides)
    if width is None or height is None:
        raise InputError(f"{path}: the image size is {show(sides)}; two whole numbers expected")
    return width, height


def _published_image(
    path: str | Path,
    entries: EntriesByMeaning,
    core: dict[str, float],
    size: tuple[int, int] | None,
) -> tuple[dict[str, float], tuple[int, int] | None, list[str]]:
    """The camera of the image that a camera of ROS publishes: a region of the whole one (`roi`),
    whose pixels are binned.

        fx = fx/bx   cx = (cx − x_offset)/bx   w = width of the region/bx    0 means none of it

    Source: ROS, sensor_msgs/CameraInfo; image_geometry, PinholeCameraModel::fromCameraInfo.
    """
    name, roi = entries.get("roi", ("", {}))
    roi_values = {}
    for key, value in roi.items():
        if fold(key) in ("dorectify",):
            continue  # how it is displayed
        if fold(key) not in ("xoffset", "yoffset", "width", "height"):
            raise InputError(f"{path}: unknown key {show(key)} in {name}; expected x_offset, …")
        if value is not None:
            roi_values[fold(key)] = _natural_number(path, f"{name}: {key}", value)
    x, y = roi_values.get("xoffset", 0), roi_values.get("yoffset", 0)
    bins = [
        _natural_number(path, *entries[kind]) or 1 if kind in entries else 1
        for kind in ("binning_x", "binning_y")
    ]
    region = [roi_values.get(key, 0) for key in ("width", "height")]
    messages = []
    if size is None and any((x, y, *region)):
        raise InputError(f"{path}: {name} needs the size of the whole image, which is missing")
    if size is not None:
        region = [part or n for part, n in zip(region, size)]
        if x + region[0] > size[0] or y + region[1] > size[1]:
            raise InputError(
                f"{path}: {name} of {region[0]} × {region[1]} px at ({x}, {y}) is not inside the "
                f"image of {size[0]} × {size[1]} px"
            )
        if (x, y, *region, *bins) == (0, 0, *size, 1, 1):
            return core, size, messages
        size = region[0] // bins[0], region[1] // bins[1]
    if size is not None or bins != [1, 1]:
        sides = "" if size is None else f", {size[0]} × {size[1]} px"
        messages = [
            f"{path}: roi and binning are applied: the camera is that of the published image{sides}"
        ]
    core = {
        "fx": core["fx"] / bins[0],
        "fy": core["fy"] / bins[1],
        "cx": (core["cx"] - x) / bins[0],
        "cy": (core["cy"] - y) / bins[1],
    }
    return core, size, messages


def _natural_number(path: str | Path, name: str, value: object) -> int:
    if value == 0:
        return 0
    number = _positive_integer(value)
    if number is None:
        raise InputError(f"{path}: {name} is {show(value)}; expected a whole number")
    return number


def _fit_nearest(path: Path, camera: Camera, skew: float, tilt: Sequence[float]) -> FittedCamera:
    """The nearest of our cameras to one with a skew or a tilted sensor."""
    if camera.image_size is None:
        raise InputError(
            f"{path}: no camera model has a skew or a tilted sensor; to fit the nearest one "
            "the image size is needed: give image_width and image_height"
        )
    p = all_parameters(camera)
    parameters = {"camera": p, "skew": skew, "H": _tilt_homography(*tilt) if tilt else np.eye(3)}
    features = [f"skew {skew:g}"] if skew else []
    features += [f"tilt τx {tilt[0]:g}, τy {tilt[1]:g}"] if any(tilt) else []
    foreign = Foreign(
        FORMULAS[str(camera.model)],
        parameters,
        p,
        camera.image_size,
        fisheye=camera.model != "opencv",
    )
    return fit_camera(camera.id, foreign, str(path), f"has {' and '.join(features)}")


def _project_ray(
    name: str, p: Mapping[str, Any], X: Scalar, Y: Scalar, Z: Scalar
) -> Float[Array, "2"]:
    """Pixels of a ray in a camera with a skew and a tilted sensor."""
    model, parameters = get_model(name), p["camera"]
    # The homography acts on [x'', y''] before fx, fy, cx, cy do: the model is asked without them.
    unit_parameters = parameters | {"fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0}
    xy = project(model, tuple(unit_parameters[key] for key in model.parameters), X, -Y, -Z)
    x, y, s = p["H"] @ jnp.stack([*xy, 1.0])
    u = parameters["fx"] * x / s + p["skew"] * y / s + parameters["cx"]
    return jnp.stack([u, parameters["fy"] * y / s + parameters["cy"]])


FORMULAS = {name: partial(_project_ray, name) for name in ("opencv", "kannala-brandt", "mei")}


def _tilt_homography(tx: float, ty: float) -> Float[np.ndarray, "3 3"]:
    """The homography of a tilted sensor (the module's docstring)."""
    cx, sx, cy, sy = np.cos(tx), np.sin(tx), np.cos(ty), np.sin(ty)
    about_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    R = about_y @ np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    return np.array([[R[2, 2], 0, -R[0, 2]], [0, R[2, 2], -R[1, 2]], [0, 0, 1]]) @ R


def matrix_of(
    path: str | Path, name: str, value: Any, shape: tuple[int, int] | None
) -> Float[np.ndarray, "..."]:
    """The numbers of an entry in the shape; without one as they stand.

    **Raises:** `InputError` naming file and entry."""
    if isinstance(value, Mapping):
        declared_shape = tuple(_positive_integer(value.get(key)) for key in ("rows", "cols"))
        data = value.get("data")
        # ROS writes a camera without distortion as 1 × 0 numbers, or none at all
        if data in (None, []) and 0 in (value.get("rows"), value.get("cols")):
            data, declared_shape = [], (1, 0)
        sides = [n for n in declared_shape if n is not None]
        if len(sides) < 2 or not isinstance(data, list) or len(data) != sides[0] * sides[1]:
            size = len(data) if isinstance(data, list) else "no"
            raise InputError(
                f"{path}: {name} has {size} numbers for {show(value.get('rows'))} rows and "
                f"{show(value.get('cols'))} columns"
            )
    else:
        data, declared_shape = value, None
        # [[…]], [[[…]]]: rows of a matrix, and of lists of lists of one
        while isinstance(data, list) and data and all(isinstance(row, list) for row in data):
            data = [x for row in data for x in row]
    if not isinstance(data, list) or not all(_is_number(x) for x in data):
        raise InputError(f"{path}: {name}: expected a list of finite numbers")
    if shape is not None and (
        declared_shape not in (None, shape) or len(data) != shape[0] * shape[1]
    ):
        raise InputError(f"{path}: {name} must have {shape[0]} rows and {shape[1]} columns")
    array = np.array(data, float)
    return array if shape is None else array.reshape(shape)


def _positive_integer(value: object) -> int | None:
    if not _is_number(value) or not float(value).is_integer() or not 0 < value < 1e9:
        return None
    return int(value)


def _is_number(value: object) -> TypeGuard[float]:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return bool(np.isfinite(float(value)))
    except OverflowError:  # a whole number of more than 308 digits
        return False
