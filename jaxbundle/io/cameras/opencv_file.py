"""A camera in the form of OpenCV's FileStorage: YAML or JSON.

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
(height, width, K and D, in ROS 2 k and d): with `distortion_model` "equidistant" or "fisheye" the
four coefficients are those of `kannala-brandt`. Pixels have their origin at the
centre of the first pixel, as here. A skew and a tilted sensor (τx, τy),

    s·[x'', y'', 1] = [R33, 0, −R13; 0, R33, −R23; 0, 0, 1]·R·[x', y', 1]
    R = [cos τy, 0, −sin τy; 0, 1, 0; sin τy, 0, cos τy]
        ·[1, 0, 0; 0, cos τx, sin τx; 0, −sin τx, cos τx]
    u = fx·x'' + skew·y'' + cx

are not part of our models: if they are not 0 the nearest is fitted, which needs the image size.

Other entries are skipped.

Source: OpenCV 4 documentation, XML/YAML/JSON file storages; ROS wiki, camera_calibration_parsers.
"""

import json
import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeGuard

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxbundle.cameras import get_model
from jaxbundle.cameras.model import project
from jaxbundle.cameras.scalars import Scalar
from jaxbundle.errors import InputError
from jaxbundle.io.cameras.nearest_camera import FittedCamera, Foreign, fit_camera
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.io.networks.losses import check_others_zero, size_of
from jaxbundle.io.text.csv_tables import read_text, write_text
from jaxbundle.io.text.rows import join_numbers
from jaxbundle.io.text.yaml_text import parse_yaml
from jaxbundle.network.columns import show
from jaxbundle.network.rules import check_camera
from jaxbundle.network.tables import Camera
from jaxbundle.system.file_content import beginning, parse_json

YAML = (".yaml", ".yml")
SUFFIXES = (*YAML, ".json")
MATRIX = ("camera_matrix", "cameraMatrix", "K", "k")
COEFFICIENTS = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "D", "d")
MESSAGE_KEY = b"distortion_model"
"""Required in addition to a lone `k` in a message of ROS 2."""
ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
COEFFICIENT_COUNTS = (4, 5, 8, 12, 14)
"""Lengths of a vector of distortion coefficients that OpenCV accepts (`calibrateCamera`); the last
two of 14 are the tilt."""
FISHEYE = ("equidistant", "fisheye")


def is_opencv(path: Path) -> bool:
    """Whether a file has a name of this kind and mentions a camera matrix."""
    text = beginning(path, 1_000_000) if path.suffix.lower() in SUFFIXES else b""
    names = MATRIX if MESSAGE_KEY in text else MATRIX[:-1]
    return any(re.search(rb"^[\s{]*\"?%s\"?\s*:" % name.encode(), text, re.M) for name in names)


def read_entries(path: Path) -> dict[str, Any]:
    """The entries of a YAML or JSON file."""
    text = read_text(path)
    is_json = path.suffix.lower() == ".json" or text.lstrip().startswith("{")
    if not is_json:
        return parse_yaml(path, text, lenient=True)
    document = parse_json(path, text)
    if not isinstance(document, dict):
        raise InputError(f"{path}: an object with camera_matrix is expected")
    return document


def matrix_in(
    path: Path, entries: Mapping, names: Sequence[str], shape: tuple[int, int]
) -> Float[np.ndarray, "rows columns"]:
    """A matrix by the first of these names.

    **Raises:** `InputError` naming file and entry: missing, or of another shape."""
    return _matrix(path, entries, names, shape)[1]


def read_opencv(
    path: str | Path, entries: Mapping[str, Any] | None = None, id: str | None = None
) -> Camera:
    """The camera of a file, or of some of its `entries`; its id is the name of the file, if none
    is given.

    **Raises:** `InputError` naming the entry.
    """
    path = Path(path)
    entries = read_entries(path) if entries is None else entries
    name, K = _matrix(path, entries, MATRIX, (3, 3))
    for row, column, wanted in ((1, 0, 0), (2, 0, 0), (2, 1, 0), (2, 2, 1)):
        if K[row, column] != wanted:
            raise InputError(
                f"{path}: {name}[{row}][{column}] is {K[row, column]:g}; {wanted} is expected"
            )
    coefficients = _coefficients(path, entries)
    coefficients, tilt = coefficients[: len(ORDER)], coefficients[len(ORDER) :]
    parameters = dict(zip(("fx", "fy", "cx", "cy"), (K[0, 0], K[1, 1], K[0, 2], K[1, 2])))
    flag = entries.get("fisheye_model")
    fisheye = entries.get("distortion_model") in FISHEYE or (_is_number(flag) and flag == 1)
    if fisheye:
        if any(coefficients[4:]) or any(tilt):
            raise InputError(
                f"{path}: {len(coefficients)} distortion coefficients; a fisheye has 4"
            )
        names = ("k1", "k2", "k3", "k4")
    else:
        names = ORDER
    camera = Camera(
        id=path.stem if id is None else id,
        model="kannala-brandt" if fisheye else "opencv",
        parameters={k: float(v) for k, v in parameters.items()} | dict(zip(names, coefficients)),
        image_size=_image_size(path, entries),
    )
    check_camera(camera, f"{path}, ")
    return camera if K[0, 1] == 0 and not any(tilt) else _fit(path, camera, K[0, 1], tilt)


def _fit(path: Path, camera: Camera, skew: float, tilt: Sequence[float]) -> FittedCamera:
    """The nearest of our cameras to one with a skew or a tilted sensor."""
    if camera.image_size is None:
        raise InputError(
            f"{path}: no camera model has a skew or a tilted sensor; to fit the nearest one "
            "the image size is needed: give image_width and image_height"
        )
    p = all_parameters(camera)
    parameters = {"camera": p, "skew": skew, "H": _tilt(*tilt) if tilt else np.eye(3)}
    has = [f"skew {skew:g}"] if skew else []
    has += [f"tilt τx {tilt[0]:g}, τy {tilt[1]:g}"] if any(tilt) else []
    foreign = Foreign(
        FORMULAS[str(camera.model)],
        parameters,
        p,
        camera.image_size,
        fisheye=camera.model == "kannala-brandt",
    )
    return fit_camera(camera.id, foreign, str(path), f"has {' and '.join(has)}")


def _image(name: str, p: Mapping[str, Any], X: Scalar, Y: Scalar, Z: Scalar) -> Float[Array, "2"]:
    """Pixels of a ray in a camera with a skew and a tilted sensor."""
    model, own = get_model(name), p["camera"]
    # The homography acts on [x'', y''] before fx, fy, cx, cy do: the model is asked without them.
    plain = own | {"fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0}
    xy = project(model, tuple(plain[key] for key in model.parameters), X, -Y, -Z)
    x, y, s = p["H"] @ jnp.stack([*xy, 1.0])
    u = own["fx"] * x / s + p["skew"] * y / s + own["cx"]
    return jnp.stack([u, own["fy"] * y / s + own["cy"]])


FORMULAS = {name: partial(_image, name) for name in ("opencv", "kannala-brandt")}


def _tilt(tx: float, ty: float) -> Float[np.ndarray, "3 3"]:
    """The homography of a tilted sensor (the module's docstring)."""
    cx, sx, cy, sy = np.cos(tx), np.sin(tx), np.cos(ty), np.sin(ty)
    about_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    R = about_y @ np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    return np.array([[R[2, 2], 0, -R[0, 2]], [0, R[2, 2], -R[1, 2]], [0, 0, 1]]) @ R


def opencv_text(camera: Camera, as_json: bool = False) -> str:
    """The text of a file for a camera of model `opencv` or `kannala-brandt`.

    **Raises:** `InputError` for another model.
    """
    return file_text(opencv_entries(camera), as_json)


def file_text(entries: Mapping[str, Any], as_json: bool = False) -> str:
    """Entries as YAML or JSON of OpenCV's FileStorage; matrices are (rows, columns, numbers)."""
    return _as_json(entries) if as_json else _as_yaml(entries)


def opencv_entries(camera: Camera) -> dict[str, Any]:
    """The entries of a camera of model `opencv` or `kannala-brandt`, as of `file_text`.

    **Raises:** `InputError` for another model.
    """
    if camera.model not in ("opencv", "kannala-brandt"):
        raise InputError(
            f"camera {camera.id!r}: OpenCV has no model {str(camera.model)!r}; convert it with "
            "--model opencv"
        )
    p = all_parameters(camera)
    fisheye = camera.model == "kannala-brandt"
    K = [p["fx"], 0.0, p["cx"], 0.0, p["fy"], p["cy"], 0.0, 0.0, 1.0]
    values = [p[name] for name in (("k1", "k2", "k3", "k4") if fisheye else ORDER)]
    if not fisheye:
        values = values[: next(n for n in COEFFICIENT_COUNTS if not any(values[n:]))]
    entries: dict[str, Any] = {}
    if camera.image_size is not None:
        entries |= dict(zip(("image_width", "image_height"), camera.image_size))
    if fisheye:
        entries |= {"fisheye_model": 1, "distortion_model": "equidistant"}
    entries |= {"camera_matrix": (3, 3, K), "distortion_coefficients": (len(values), 1, values)}
    return entries


def write_opencv(camera: Camera, path: str | Path) -> None:
    """Write a camera as YAML or, by its suffix, JSON."""
    path = Path(path)
    write_text(path, opencv_text(camera, path.suffix.lower() == ".json"))


def ros_text(
    camera: Camera,
    R: Float[np.ndarray, "3 3"] | None = None,
    P: Float[np.ndarray, "3 4"] | None = None,
) -> str:
    """The text of a camera_info file of ROS for a camera of model `opencv` or `kannala-brandt`;
    with the rectification R and projection P of a pair.

    **Raises:** `InputError` for another model, a thin prism, and without image size.
    """
    fisheye = camera.model == "kannala-brandt"
    names = ("k1", "k2", "k3", "k4") if fisheye else ORDER[:8]
    p, (w, h) = check_others_zero(camera, "ROS", names), size_of(camera, "ROS")
    # plumb_bob, with five coefficients, is the usual one: if they suffice
    rational = any(p[name] for name in names[5:])
    kind = "equidistant" if fisheye else "rational_polynomial" if rational else "plumb_bob"
    values = [p[name] for name in (names if fisheye or rational else names[:5])]
    K = [p["fx"], 0.0, p["cx"], 0.0, p["fy"], p["cy"], 0.0, 0.0, 1.0]
    turn = np.eye(3) if R is None else R
    projection = np.c_[np.reshape(K, (3, 3)), np.zeros(3)] if P is None else P
    return _as_yaml(
        {
            "image_width": w,
            "image_height": h,
            "camera_name": camera.id,
            "camera_matrix": (3, 3, K),
            "distortion_model": kind,
            "distortion_coefficients": (1, len(values), values),
            "rectification_matrix": (3, 3, turn.ravel()),
            "projection_matrix": (3, 4, projection.ravel()),
        },
        ros=True,
    )


def write_ros(camera: Camera, path: str | Path) -> None:
    """Write a camera as ROS's camera_info, in YAML."""
    write_text(Path(path), ros_text(camera))


def _as_yaml(entries: Mapping, ros: bool = False) -> str:
    lines = [] if ros else ["%YAML:1.0", "---"]
    tag, dt = ("", []) if ros else (" !!opencv-matrix", ["   dt: d"])
    for key, value in entries.items():
        if isinstance(value, tuple):
            rows, columns, data = value
            lines += [
                f"{key}:{tag}",
                f"   rows: {rows}",
                f"   cols: {columns}",
                *dt,
                f"   data: [ {join_numbers(data, ', ')} ]",
            ]
        else:
            lines.append(f"{key}: {json.dumps(value)}")
    return "\n".join(lines) + "\n"


def _as_json(entries: Mapping) -> str:
    document = {
        key: {
            "type_id": "opencv-matrix",
            "rows": value[0],
            "cols": value[1],
            "dt": "d",
            "data": [float(x) for x in value[2]],
        }
        if isinstance(value, tuple)
        else value
        for key, value in entries.items()
    }
    return json.dumps(document, indent=4) + "\n"


def _matrix(
    path: Path, entries: Mapping, names: Sequence[str], shape: tuple[int, int] | None
) -> tuple[str, Float[np.ndarray, "..."]]:
    """The first name there is, and its numbers in the shape; without one as they stand."""
    name = next((name for name in names if name in entries), None)
    if name is None:
        raise InputError(f"{path}: {names[0]} is missing")
    value = entries[name]
    if isinstance(value, Mapping):
        stated = tuple(_whole(value.get(key)) for key in ("rows", "cols"))
        data = value.get("data")
        whole = [n for n in stated if n is not None]
        if len(whole) < 2 or not isinstance(data, list) or len(data) != whole[0] * whole[1]:
            size = len(data) if isinstance(data, list) else "no"
            raise InputError(
                f"{path}: {name} has {size} numbers for {show(value.get('rows'))} rows and "
                f"{show(value.get('cols'))} columns"
            )
    else:
        data, stated = value, None
        if isinstance(value, list) and all(isinstance(row, list) for row in value):
            data = [x for row in value for x in row]
    if not isinstance(data, list) or not all(_is_number(x) for x in data):
        raise InputError(f"{path}: {name}: a list of finite numbers is expected")
    if shape is not None and (stated not in (None, shape) or len(data) != shape[0] * shape[1]):
        raise InputError(f"{path}: {name} must have {shape[0]} rows and {shape[1]} columns")
    array = np.array(data, float)
    return name, array if shape is None else array.reshape(shape)


def _coefficients(path: Path, entries: Mapping) -> list[float]:
    if not any(name in entries for name in COEFFICIENTS):
        return [0.0] * 4
    name, values = _matrix(path, entries, COEFFICIENTS, None)
    values = values.tolist()
    # Programs pad with zeros: [k1, k2, p1, p2, k3, 0] is a vector of five.
    while values and len(values) not in COEFFICIENT_COUNTS and values[-1] == 0:
        values = values[:-1]
    values = values or [0.0] * 4
    if len(values) not in COEFFICIENT_COUNTS:
        raise InputError(f"{path}: {name} has {len(values)} values; 4, 5, 8, 12 or 14 are known")
    return values


def _image_size(path: Path, entries: Mapping) -> tuple[int, int] | None:
    sides = [entries.get(f"image_{n}", entries.get(n)) for n in ("width", "height")]
    if sides == [None, None]:
        size = entries.get("image_size", entries.get("image_Size"))
        if size is None:
            return None
        sides = size if isinstance(size, list) and len(size) == 2 else [None, None]
    width, height = (_whole(x) for x in sides)
    if width is None or height is None:
        raise InputError(f"{path}: the image size is {show(sides)}; two whole numbers expected")
    return width, height


def _whole(value: object) -> int | None:
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
