"""The rig in the JSON of `jaxbundle calibrate --rig`: cameras, and their mountings.

    rig.reference                           the camera without a mounting
    rig.mountings.CAMERA.base, rotation     projection centre in the frame of the reference camera,
                                            and R from its frame to that of the camera
    rig.cameras.CAMERA.PARAMETER.value      of the joint adjustment
    calibrations.CAMERA                     model and image size

Frames here have y up and look along −z. The network is that of a chain of Kalibr: one image a
camera, the reference at the origin, looking along Z with Y down.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.geometry.pose_conventions import D
from jaxbundle.io.networks.assemble import rig_network
from jaxbundle.io.networks.poses import check_rotations
from jaxbundle.io.text.csv_tables import read_text
from jaxbundle.network.build import make_cameras
from jaxbundle.network.tables import Camera, Network
from jaxbundle.system.file_content import beginning, parse_json

UNIT = "model"
REFERENCE = {"base": [0, 0, 0], "rotation": np.eye(3).tolist()}
IN_BOARD_UNITS = (
    "lengths of the mountings are in the unit of the board; Kalibr, ROS and mrcal expect metres"
)


def is_rig_result(path: Path) -> bool:
    """Whether a JSON file has the calibrations and the rig of `calibrate --rig`."""
    if path.suffix.lower() != ".json":
        return False
    return re.match(rb'\s*\{\s*"converged"\s*:\s*\w+\s*,\s*"calibrations"\s*:',
                    beginning(path, 1000)) is not None  # fmt: skip


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
        cameras = [_camera(path, id, rig["cameras"][id], parts[id]) for id in mountings]
        bases = [np.array(m["base"], float).reshape(3) for m in mountings.values()]
        turns = [np.array(m["rotation"], float).reshape(3, 3) for m in mountings.values()]
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        what = f"has no {error}" if isinstance(error, KeyError) else f"{error!r:.100}"
        raise InputError(f"{path}: not the result of calibrate --rig: {what}") from None
    for turn in turns:
        check_rotations(turn, f"{path}: rig.mountings, rotation")
    return network_of_rig(path, cameras, turns, bases, overrides)


def network_of_rig(
    path: Path,
    cameras: Sequence[Camera],
    rotations: Sequence[Float[np.ndarray, "3 3"]],
    bases: Sequence[Float[np.ndarray, "3"]],
    overrides: Sequence[str] = (),
) -> Network:
    """The network of cameras on mountings, as of `calibration.rig.result.Mounting`.

    X_k = R·(X − b) in our frames is x_k = (D·R·D)·x − D·R·b in those with y down, z forward.
    """
    flip = np.diag(D)
    R = [flip @ turn @ flip for turn in rotations]
    t = [-flip @ turn @ base for turn, base in zip(rotations, bases)]
    return rig_network(path, cameras, R, t, overrides, warnings=[IN_BOARD_UNITS], unit=UNIT)


def _camera(path: Path, id: str, values: Mapping, calibration: Mapping) -> Camera:
    (entry,) = calibration["cameras"].values()
    about = calibration.get("calibration", {})
    row = {"id": id, "model": entry["model"]}
    row |= {name: value["value"] for name, value in values.items()}
    if about.get("image_size"):
        row["image_size"] = about["image_size"]
    if about.get("pixel_size"):
        row["pixel_size"] = about["pixel_size"]
    (camera,) = make_cameras([row], str(path))
    return camera
