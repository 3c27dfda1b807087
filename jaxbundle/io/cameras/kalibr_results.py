"""Results of Kalibr: the text of `…-results-cam.txt`, cameras with the σ of their parameters.

    cam0 (/cam0/image_raw):
        type: <class '….DistortedPinholeCameraGeometry'>
        distortion: [k1 k2 p1 p2] +- [σ …]
        projection: [fu fv pu pv] +- [σ …]

The kind is in the name of the class: Pinhole, Omni, ExtendedUnified, DoubleSphere; Equidistant,
Fov, Distorted. The file has no correlations, which are taken as 0, and no image size.

Source: Kalibr's wiki, "Multiple camera calibration"; its results.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.io.networks.kalibr import MODELS
from jaxbundle.io.text.csv_tables import read_text
from jaxbundle.io.text.rows import TextRow
from jaxbundle.network.build import make_cameras
from jaxbundle.system.file_content import beginning

if TYPE_CHECKING:
    from jaxbundle.io.cameras.result_json import Calibrated

HEAD = b"Camera-system parameters"
CAMERA = re.compile(r"^\s*(cam\d+)\s*\(.*\):\s*$", re.M)
VALUES = r"{}:\s*\[([^\]]*)\]\s*\+-\s*\[([^\]]*)\]"
CAMERAS = {"Omni": "omni", "ExtendedUnified": "eucm", "DoubleSphere": "ds", "Pinhole": "pinhole"}
DISTORTIONS = {"Equidistant": "equi", "Fov": "fov", "Distorted": "radtan", "": "none"}


def is_kalibr_results(path: Path) -> bool:
    """Whether a text has the parameters of Kalibr's cameras."""
    return path.suffix.lower() == ".txt" and HEAD in beginning(path, 10_000)


def read_kalibr_results(path: str | Path) -> list["Calibrated"]:
    """The cameras of a file: each with the names of its parameters and their covariance.

    **Raises:** `InputError` naming file and camera.
    """
    path = Path(path)
    text = read_text(path)
    heads = list(CAMERA.finditer(text))
    ends = [head.start() for head in heads[1:]] + [len(text)]
    if not heads:
        raise InputError(f"{path}: there is no camera cam0 in it")
    return [_camera(path, head[1], text[head.end() : end]) for head, end in zip(heads, ends)]


def _camera(path: Path, id: str, text: str) -> "Calibrated":
    where = f"{path}, {id}"
    line = re.search(r"type:.*?(\w+)'?>", text)
    if line is None:
        raise InputError(f"{where}: type is missing")
    name = line[1]
    kind = (
        next((k for word, k in CAMERAS.items() if word in name), name),
        next(k for word, k in DISTORTIONS.items() if word in name),  # "" is in every name
    )
    if kind not in MODELS:
        raise InputError(f"{where}: cameras of type {name} are not known here")
    model, core, coefficients = MODELS[kind]
    values, sigma = _values(where, "projection", text, core)
    if coefficients:
        distortion = _values(where, "distortion", text, coefficients)
        values, sigma = values | distortion[0], sigma | distortion[1]
    (camera,) = make_cameras([{"id": id, "model": model, **values}], f"{path}, ")
    return camera, (list(sigma), np.diag(np.square([*sigma.values()])))


def _values(
    where: str, name: str, text: str, names: Sequence[str]
) -> tuple[dict[str, float], dict[str, float]]:
    """Values and σ of a line."""
    match = re.search(VALUES.format(name), text)
    if match is None:
        raise InputError(f"{where}: {name}: [values] +- [σ] is missing")
    numbers = []
    for part in match.groups():
        words = part.replace(",", " ").split()
        if len(words) != len(names):
            raise InputError(f"{where}: {name} has {len(words)} numbers; expected {len(names)}")
        row = TextRow(Path(where), 0, " ".join(words))
        try:
            numbers.append(dict(zip(names, row.numbers(names).tolist())))
        except InputError:
            raise InputError(f"{where}: {name}: expected finite numbers") from None
    return numbers[0], numbers[1]
