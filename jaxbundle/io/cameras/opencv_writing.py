"""Cameras written in the form of OpenCV's FileStorage (YAML, JSON) and of ROS's camera_info;
`opencv_file.py` reads them and has the formulas."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.io.cameras.opencv_file import COEFFICIENT_COUNTS, ORDER
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.io.networks.losses import check_others_zero, size_of
from jaxbundle.io.text.csv_tables import write_text
from jaxbundle.io.text.rows import join_numbers
from jaxbundle.network.tables import Camera


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
    rotation = np.eye(3) if R is None else R
    projection = np.c_[np.reshape(K, (3, 3)), np.zeros(3)] if P is None else P
    return _as_yaml(
        {
            "image_width": w,
            "image_height": h,
            "camera_name": camera.id,
            "camera_matrix": (3, 3, K),
            "distortion_model": kind,
            "distortion_coefficients": (1, len(values), values),
            "rectification_matrix": (3, 3, rotation.ravel()),
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
