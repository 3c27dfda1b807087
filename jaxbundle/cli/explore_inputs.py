"""The inputs of `jaxbundle explore`: an adjusted network, a camera, a line scanner."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxbundle.adjustment.adjust import adjust
from jaxbundle.calibration.files import COMMAND
from jaxbundle.choices import EXPLORED
from jaxbundle.cli.camera_inputs import calibration_given, pair
from jaxbundle.cli.outputs import trace_files, trace_origin
from jaxbundle.cli.progress import iterating
from jaxbundle.cli.pushbroom.shared import open_scanner
from jaxbundle.errors import InputError
from jaxbundle.explore.camera import CameraView
from jaxbundle.explore.network import NetworkView
from jaxbundle.explore.scanner import FlightView
from jaxbundle.explore.view import ExplorerView
from jaxbundle.io import read_network
from jaxbundle.io.cameras.calibrated import is_result
from jaxbundle.io.cameras.camera_files import is_camera_file
from jaxbundle.io.formats import recognise_format
from jaxbundle.io.scanner.flight import read_flight
from jaxbundle.io.text.csv_tables import read_text, read_toml
from jaxbundle.io.writing.folders import MARKER
from jaxbundle.photographs import photograph_size, read_photograph
from jaxbundle.system.file_content import parse_json

NETWORK, CAMERA, SCANNER = EXPLORED
RESULT = "result.json"
RESULTS = {"cameras", "calibrations"}
"""Keys of the result of an adjustment or a calibration."""


def recognise(input: str) -> str:
    """Whether an input is a network, a camera or a line scanner.

    **Raises:** `InputError` if there is no such file."""
    path = Path(input)
    if not path.exists():
        if "#" in input and Path(input.rpartition("#")[0]).exists():
            return CAMERA
        raise InputError(f"{input}: no such file or folder")
    if path.suffix.lower() == ".toml" and "scanner" in read_toml(path):
        return SCANNER
    if path.suffix.lower() in (".dim", ".imd"):
        return SCANNER
    # before the networks, since its folder contains one
    if is_of_calibrate(path):
        return CAMERA
    if recognise_format(path) is not None:
        return NETWORK
    if path.suffix.lower() == ".xml":
        return SCANNER
    if is_camera_file(path) or (path / RESULT).is_file():
        return CAMERA
    if not is_result(path):
        return NETWORK
    if path.suffix.lower() == ".json":
        document = parse_json(path, read_text(path))
        if not (isinstance(document, dict) and RESULTS & document.keys()):
            return SCANNER  # support data
    return CAMERA


def is_of_calibrate(folder: Path) -> bool:
    """Whether a folder is the --out of `jaxbundle calibrate`; it contains a network too."""
    marker = folder / MARKER
    if not ((folder / RESULT).is_file() and marker.is_file()):
        return False
    document = parse_json(marker, read_text(marker))
    return isinstance(document, dict) and document.get("command") == COMMAND


def open_view(
    input: str,
    kind: str | None,
    *,
    photo: Path | None,
    sizes: tuple[str, str],
    truth: Path | None,
    settings: Sequence[str],
    format: str | None,
    control: Path | None,
    quiet: bool,
) -> ExplorerView:
    """The view of an input; options that are for another kind are refused.

    **Raises:** `InputError`, `NotSolvedError`."""
    found = kind or (NETWORK if format else recognise(input))
    options = {
        NETWORK: {"--set": settings, "--format": format, "--control": control},
        CAMERA: {"--photo": photo, "--image-size": sizes[0], "--pixel-size": sizes[1]},
        SCANNER: {"--truth": truth},
    }
    for other, named in options.items():
        for option, value in named.items():
            if value and other != found:
                raise InputError(
                    f"{option}: is for a {other}, but {input} is a {found}"
                    + ("" if kind else "; change this with --as")
                )
    if found == NETWORK:
        return open_network(Path(input), settings, format, control, quiet)
    if found == CAMERA:
        return open_camera(input, photo, *sizes)
    return open_flight_or_scanner(Path(input), truth)


def open_network(
    path: Path, settings: Sequence[str], format: str | None, control: Path | None, quiet: bool
) -> NetworkView:
    """A network, adjusted."""
    network = read_network(path, format=format, overrides=tuple(settings), control=control)
    origin = trace_origin(path, network, control, {"--set": ", ".join(settings)})
    with iterating(quiet) as tell:
        return NetworkView(adjust(network, progress=tell), origin)


def open_camera(input: str, photo: Path | None, image_size: str, pixel_size: str) -> CameraView:
    """A camera of a file, with its σ if the file is the result of a calibration."""
    if (Path(input) / RESULT).is_file():
        input = str(Path(input) / RESULT)
    camera, found = calibration_given(input)
    size = pair("--image-size", image_size) or camera.image_size
    if size is None and photo is not None:
        size = photograph_size(photo)
    pitch = pair("--pixel-size", pixel_size) or camera.pixel_size
    whole = None if size is None else (int(size[0]), int(size[1]))
    camera = dataclasses.replace(camera, image_size=whole, pixel_size=pitch)
    # of the free parameters only: sliders of the others have none
    sigma = None if found is None else dict(zip(found[0], np.sqrt(np.diag(found[1]))))
    picture = None if photo is None else read_photograph(photo, colour=True)
    files = [input.rpartition("#")[0] or input, *([] if photo is None else [photo])]
    return CameraView(camera, sigma, picture, trace_files(files, {}))


def open_flight_or_scanner(path: Path, truth: Path | None) -> FlightView:
    """A scanner file, or a flight file, which has a track."""
    known = None if truth is None else open_scanner(truth).image
    files = [path, *([] if truth is None else [truth])]
    origin = trace_files(files, {})
    if path.suffix.lower() == ".toml" and "track" in read_toml(path):
        if known is not None:
            raise InputError("--truth: a flight file contains its truth; omit it")
        flight = read_flight(path)
        name = flight.file.section("scanner").text("name", path.stem)
        return FlightView(name, flight.flight, flight.earth, origin=origin)
    scanner = open_scanner(path)
    return FlightView(scanner.name, scanner.image, scanner.earth, known, origin)
