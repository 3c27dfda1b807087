"""The rig in the JSON of `jaxbundle calibrate --rig`, or a line of `jaxbundle batch`: cameras, and
their mountings. In the JSON

    rig.reference, rig.unit                 the camera without a mounting; the unit of lengths
    rig.mountings.CAMERA.base, rotation     projection centre in the frame of the reference camera,
                                            and R from its frame to that of the camera
    rig.cameras.CAMERA.PARAMETER.value      of the joint adjustment
    calibrations.CAMERA                     model and image size

and in a line

    cameras.CAMERA                          model and parameters
    image_size.CAMERA                       columns and rows
    further_unknowns.mounting               "CAMERA of RIG": X0, Y0, Z0, omega, phi, kappa, the base
                                            and the angles of R; zeros for the reference

Frames here have y up and look along −z. The network is that of a chain of Kalibr: one image a
camera, the reference at the origin, looking along Z with Y down.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.geometry.pose_conventions import D
from jaxbundle.io.networks.assemble import rig_network
from jaxbundle.io.networks.poses import check_rotations
from jaxbundle.io.text.csv_tables import read_text
from jaxbundle.network.build import make_cameras
from jaxbundle.network.columns import did_you_mean, list_some
from jaxbundle.network.tables import Camera, Network
from jaxbundle.system.file_content import beginning, parse_json

# A file of lines, and the key of one of them, which may have a # itself.
LINE = re.compile(r"(.+\.jsonl)(?:#(.+))?", re.S)
# Of results that do not say theirs.
UNIT = "model"
REFERENCE = {"base": [0, 0, 0], "rotation": np.eye(3).tolist()}


def is_rig_result(path: Path) -> bool:
    """Whether a JSON file has the calibrations and the rig of `calibrate --rig`."""
    if path.suffix.lower() != ".json":
        return False
    if not re.match(rb'\s*\{\s*"converged"\s*:', beginning(path, 1000)):
        return False
    content = path.read_bytes()
    return all(key in content for key in (b'"calibrations"', b'"rig"'))


def file_of_line(path: Path) -> Path:
    """The file of a line, `FILE.jsonl#KEY`; any other path as it is."""
    match = LINE.fullmatch(str(path))
    return Path(match[1]) if match else path


def is_rig_line(path: Path) -> bool:
    """Whether a path names lines of `jaxbundle batch`, or one of them."""
    return LINE.fullmatch(str(path)) is not None and file_of_line(path).is_file()


def read_rig_line(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The rig of a line `FILE.jsonl#KEY`; without KEY of the only rig of the file.

    **Raises:** `InputError` naming file, line and entry.
    """
    path = Path(path)
    file = file_of_line(path)
    key = str(path)[len(str(file)) + 1 :] or None  # after the #
    rigs = {row["key"]: row for row in _rows(file) if "mounting" in row.get("further_unknowns", {})}
    if not rigs:
        raise InputError(f"{file}: no rig is in it; expected lines of jaxbundle batch --rig")
    if key is None and len(rigs) > 1:
        raise InputError(
            f"{file}: {len(rigs)} rigs; name one: {file}#KEY, with KEY one of {list_some(rigs)}"
        )
    row = rigs.get(next(iter(rigs)) if key is None else key)
    if row is None:
        raise InputError(f"{file}: no rig {key!r}{did_you_mean(str(key), rigs)}")
    where = f"{file}, {row['key']}"
    try:
        if row["converged"] is not True:
            raise InputError(f"{where}: was not solved ({row['status']})")
        mountings = {
            label.rpartition(" of ")[0]: {name: x["value"] for name, x in parameters.items()}
            for label, parameters in row["further_unknowns"]["mounting"].items()
        }
        cameras, pixel = [], row.get("settings", {}).get("pixel_size")
        for id in mountings:
            entry = row["cameras"][id]
            sizes = {"image_size": row["image_size"][id], "pixel_size": pixel and [pixel, pixel]}
            cameras.append(_camera(where, id, entry["parameters"], entry["model"], sizes))
        bases = [np.array([m[x] for x in ("X0", "Y0", "Z0")]) for m in mountings.values()]
        angles = np.array([[m[x] for x in ("omega", "phi", "kappa")] for m in mountings.values()])
        rotations = [np.asarray(matrix_from_omega_phi_kappa(row)) for row in angles]
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        problem = f"has no {error}" if isinstance(error, KeyError) else f"{error!r:.100}"
        raise InputError(f"{where}: not a line of jaxbundle batch --rig: {problem}") from None
    return network_of_rig(file, cameras, rotations, bases, overrides=overrides)


def _rows(file: Path) -> Iterator[dict[str, Any]]:
    for number, line in enumerate(read_text(file).splitlines(), 1):
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            row = None
        if not isinstance(row, dict) or not {"key", "status"} <= row.keys():
            raise InputError(f"{file}, line {number}: not a line of jaxbundle batch")
        yield row


def read_rig_result(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The cameras of a rig on their mountings; nothing can be adjusted.

    **Raises:** `InputError` naming file and entry.
    """
    path = Path(path)
    try:
        document = parse_json(path, read_text(path))
        rig, parts = document.get("rig"), document["calibrations"]
        if rig is None:
            raise InputError(
                f"{path}: separate calibrations, without a mounting; expected the result of "
                "calibrate --rig"
            )
        mountings = {rig["reference"]: REFERENCE, **rig["mountings"]}
        cameras = []
        for id in mountings:
            (entry,) = parts[id]["cameras"].values()
            sizes = parts[id].get("calibration", {})
            cameras.append(_camera(str(path), id, rig["cameras"][id], entry["model"], sizes))
        bases = [np.array(m["base"], float).reshape(3) for m in mountings.values()]
        rotations = [np.array(m["rotation"], float).reshape(3, 3) for m in mountings.values()]
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        problem = f"has no {error}" if isinstance(error, KeyError) else f"{error!r:.100}"
        raise InputError(f"{path}: not the result of calibrate --rig: {problem}") from None
    for rotation in rotations:
        check_rotations(rotation, f"{path}: rig.mountings, rotation")
    unit = rig.get("unit", UNIT)
    return network_of_rig(path, cameras, rotations, bases, unit, overrides)


def network_of_rig(
    path: Path,
    cameras: Sequence[Camera],
    rotations: Sequence[Float[np.ndarray, "3 3"]],
    bases: Sequence[Float[np.ndarray, "3"]],
    unit: str = UNIT,
    overrides: Sequence[str] = (),
) -> Network:
    """The network of cameras on mountings, as of `calibration.rig.result.Mounting`; `unit`: of
    their bases.

    X_k = R·(X − b) in our frames is x_k = (D·R·D)·x − D·R·b in those with y down, z forward.
    """
    flip = np.diag(D)
    R = [flip @ rotation @ flip for rotation in rotations]
    t = [-flip @ rotation @ base for rotation, base in zip(rotations, bases)]
    return rig_network(path, cameras, R, t, overrides, unit=unit)


def _camera(
    where: str,
    id: str,
    values: Mapping[str, Mapping[str, Any]],
    model: str,
    sizes: Mapping[str, Any],
) -> Camera:
    row = {"id": id, "model": model}
    row |= {name: value["value"] for name, value in values.items()}
    row |= {name: sizes[name] for name in ("image_size", "pixel_size") if sizes.get(name)}
    (camera,) = make_cameras([row], where)
    return camera
