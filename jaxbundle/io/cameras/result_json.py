"""Cameras with the covariance of their parameters, from the JSON of `adjust` and `calibrate`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.io.cameras.camera_files import is_camera_file
from jaxbundle.io.cameras.kalibr_results import is_kalibr_results, read_kalibr_results
from jaxbundle.io.networks.openmvg import is_openmvg
from jaxbundle.io.networks.opensfm import is_opensfm
from jaxbundle.io.networks.transforms import is_transforms
from jaxbundle.io.text.csv_tables import read_text
from jaxbundle.network.build import make_cameras
from jaxbundle.network.tables import Camera
from jaxbundle.system.file_content import parse_json

# A camera, the names of its free parameters, their covariance: under correlated errors where the
# result has it.
Calibrated = tuple[Camera, tuple[list[str], Float[np.ndarray, "k k"]]]


def is_result(path: Path) -> bool:
    """Whether a file may be the result of an adjustment or a calibration, ours or of Kalibr."""
    return is_kalibr_results(path) or (
        path.suffix.lower() == ".json"
        and path.is_file()
        and not is_camera_file(path)
        and not any(recognises(path) for recognises in (is_openmvg, is_opensfm, is_transforms))
    )


def read_calibrated(path: str | Path) -> list[Calibrated]:
    """The cameras of a result.

    **Raises:** `InputError` if it is not solved, or entries are missing or wrong.
    """
    if is_kalibr_results(Path(path)):
        return read_kalibr_results(path)
    try:
        document = parse_json(path, read_text(Path(path)))
        if document["converged"] is not True:
            raise InputError(f"{path}: was not solved; there is no camera in it")
        parts = document.get("calibrations", {"": document})
        return [
            _calibrated_camera(path, id, entry, part.get("calibration", {}))
            for part in parts.values()
            for id, entry in part["cameras"].items()
        ]
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{path}: not a result in JSON: {str(error)[:100]}") from None
    except (KeyError, TypeError, AttributeError) as error:
        problem = f"has no {error}" if isinstance(error, KeyError) else f"{error!r:.100}"
        raise InputError(f"{path}: not the result of adjust or calibrate: {problem}") from None


def _calibrated_camera(
    path: str | Path, id: str, entry: Mapping[str, Any], settings: Mapping[str, Any]
) -> Calibrated:
    """The camera of an entry of `cameras`; `settings`: those of its calibration, in the JSON."""
    parameters = entry["parameters"]
    row = {"id": id, "model": entry["model"]} | {n: p["value"] for n, p in parameters.items()}
    # Results of before 0.3 have the size of images with the calibration only.
    sizes = {"image_size": settings.get("image_size"), **entry}
    row |= {name: sizes[name] for name in ("image_size", "pixel_size") if sizes.get(name)}
    (camera,) = make_cameras([row], f"{path}, ")
    free_names = [name for name, p in parameters.items() if p["free"]]
    # Both or none: σ and correlations of one covariance.
    kind = "_correlated" if "correlations_correlated" in entry else ""
    sigma = np.array([float(parameters[name][f"sigma{kind}"]) for name in free_names])
    correlations = entry[f"correlations{kind}"]
    # The JSON has one row for a group of tied parameters: they are fully correlated, ρ = 1.
    listed_name = {name: _find_tied(name, parameters, correlations) for name in free_names}
    correlation = lambda a, b: 1.0 if a == b else float(correlations[a][b])
    R = np.array(
        [[correlation(listed_name[a], listed_name[b]) for b in free_names] for a in free_names]
    )
    R = R.reshape(len(free_names), len(free_names))  # without free parameters [0, 0]
    if not (np.isfinite(sigma).all() and np.isfinite(R).all()):
        raise InputError(f"{path}, camera {id!r}: a σ or correlation is not a number")
    return camera, (free_names, sigma[:, None] * R * sigma)  # Q = diag(σ)·R·diag(σ)


def _find_tied(
    name: str, parameters: Mapping[str, Mapping[str, Any]], correlations: Mapping[str, Any]
) -> str:
    """The parameter with the correlations of this one: itself, or the first of tied ones, such as
    fx and fy, with the same value and σ."""
    if name in correlations:
        return name
    is_same = lambda candidate: all(
        parameters[candidate][field] == parameters[name][field] for field in ("value", "sigma")
    )
    return next((candidate for candidate in correlations if is_same(candidate)), name)
