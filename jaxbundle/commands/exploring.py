"""`explore`: an adjusted network, a camera, or a line scanner on an interactive page."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from jaxbundle.adjustment.adjust import adjust
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.calibration.files import COMMAND
from jaxbundle.calibration.result import Calibration
from jaxbundle.choices import EXPLORED
from jaxbundle.commands.cameras import Pair, open_calibration
from jaxbundle.commands.origins import trace_files, trace_origin
from jaxbundle.errors import InputError
from jaxbundle.explorer.camera import CameraView
from jaxbundle.explorer.network import NetworkView
from jaxbundle.explorer.scanner import FlightView
from jaxbundle.explorer.server import Server
from jaxbundle.explorer.view import ExplorerView
from jaxbundle.io import read_network
from jaxbundle.io.cameras.camera_files import is_camera_file
from jaxbundle.io.cameras.result_json import is_result
from jaxbundle.io.formats import recognise_format
from jaxbundle.io.rasters.scenes import read_scene
from jaxbundle.io.scanner.flight import read_flight
from jaxbundle.io.scanner.read import read_scanner
from jaxbundle.io.text.csv_tables import read_text, read_toml
from jaxbundle.io.writing.folders import MARKER
from jaxbundle.network.tables import Camera, Network
from jaxbundle.photographs import photograph_size, read_photograph
from jaxbundle.report.page import UNKNOWN
from jaxbundle.system.file_content import parse_json
from jaxbundle.types import Progress

NETWORK, CAMERA, SCANNER = EXPLORED
RESULT = "result.json"
# Keys of the result of an adjustment or a calibration.
RESULTS = {"cameras", "calibrations"}

Explored = Adjustment | Network | Camera | Calibration | str | Path


def explore(  # noqa: PLR0913 (public: the options of the command, all but one by name)
    input: Explored,
    *,
    kind: str | None = None,
    photo: str | Path | None = None,
    image_size: Pair | None = None,
    pixel_size: Pair | None = None,
    truth: str | Path | None = None,
    scene: str | Path | None = None,
    overrides: Sequence[str] = (),
    format: str | None = None,
    control: str | Path | None = None,
    correlated: bool = False,
    port: int = 0,
    progress: Progress | None = None,
    tell: Callable[[str], object] = lambda _: None,
) -> Server:
    """Serve a network, a camera or a line scanner as an interactive page, on this machine only:

        server = jaxbundle.explore("project.toml")
        print(server.address)
        server.serve_forever()

    **Arguments:**

    - `input`: an `Adjustment`, a `Network` (which is adjusted), a `Camera`, a `Calibration`; or a
      file: of a network, a camera (FILE or FILE#ID, the result of `calibrate`), a scanner or a
      flight.
    - `kind`: `"network"`, `"camera"` or `"scanner"`, where a file is not recognised (`--as`).
    - `overrides`, `format`, `control`: of the file of a network (`read_network`).
    - `correlated`: of a network: σ under errors that image points share, as by `adjust`.
    - `photo`: a photograph to undistort; `image_size`, pixels, `pixel_size`, mm: where the camera
      has none.
    - `truth`: scanner file of the truth.
    - `scene`: georeferenced raster for the pictures of a scanner; without one, a pattern.
    - `port`: 0: any that is free; `progress`: of the adjustment; `tell`: called with warnings and
      what the server says.

    **Raises:** `InputError`; `NotSolvedError`.
    """
    sizes = {"--image-size": image_size, "--pixel-size": pixel_size}
    options = {
        NETWORK: {
            "--set": overrides,
            "--format": format,
            "--control": control,
            "--correlated": correlated,
        },
        CAMERA: {"--photo": photo, **sizes},
        SCANNER: {"--truth": truth, "--scene": scene},
    }
    path = input if isinstance(input, str | Path) else None
    content = kind or (NETWORK if format else recognise(input))
    for kind_of_options, values in options.items():
        for option, value in values.items():
            if value and kind_of_options != content:
                raise InputError(
                    f"{option}: is for a {kind_of_options}, but {_last_name(input)} is a {content}"
                    + ("" if kind or path is None else "; change this with --as")
                )
    if content == NETWORK:
        view: ExplorerView = _view_network(input, overrides, format, control, correlated, progress)
    elif content == CAMERA:
        view = _view_camera(input, Path(photo) if photo else None, image_size, pixel_size)
    elif path is None:
        raise InputError(f"kind: {_last_name(input)} is no file of a scanner")
    else:
        reference, background = (Path(file) if file else None for file in (truth, scene))
        view = _view_scanner(Path(path), reference, background, tell)
    return Server(view, port, tell)


def _last_name(input: Explored) -> str:
    return str(input) if isinstance(input, str | Path) else f"the {type(input).__name__}"


def recognise(input: Explored) -> str:
    """Whether an input is a network, a camera or a line scanner.

    **Raises:** `InputError` if there is no such file."""
    if isinstance(input, Adjustment | Network):
        return NETWORK
    if not isinstance(input, str | Path):
        return CAMERA
    path, text = Path(input), str(input)
    if not path.exists():
        if "#" in text and Path(text.rpartition("#")[0]).exists():
            return CAMERA
        raise InputError(f"{input}: no such file or folder")
    if path.suffix.lower() == ".toml" and "scanner" in read_toml(path):
        return SCANNER
    if path.suffix.lower() in (".dim", ".imd"):
        return SCANNER
    # Before the networks, since its folder contains one.
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


def _view_network(
    input: Explored,
    overrides: Sequence[str],
    format: str | None,
    control: str | Path | None,
    correlated: bool,
    progress: Progress | None,
) -> NetworkView:
    if isinstance(input, Adjustment):
        return NetworkView(input, UNKNOWN)
    origin = UNKNOWN
    if isinstance(input, str | Path):
        path, beside = Path(input), Path(control) if control else None
        network = read_network(path, format=format, overrides=overrides, control=beside)
        origin = trace_origin(
            path,
            network,
            beside,
            {
                "--set": ", ".join(overrides),
                "--correlated": correlated or None,
            },
        )
    elif isinstance(input, Network):
        network = input
    else:
        raise InputError(f"kind: {_last_name(input)} is no network")
    return NetworkView(adjust(network, correlated=correlated, progress=progress), origin)


def _view_camera(
    input: Explored, photo: Path | None, image_size: Pair | None, pixel_size: Pair | None
) -> CameraView:
    """A camera, with its σ if it is the result of a calibration."""
    if isinstance(input, Adjustment | Network):
        raise InputError(f"kind: {_last_name(input)} is no camera")
    files = [] if photo is None else [photo]
    if isinstance(input, str | Path):
        result_file = Path(input) / RESULT
        input = str(result_file if result_file.is_file() else input)
        files = [Path(input.rpartition("#")[0] or input), *files]
    camera, covariance = open_calibration(input)
    size = image_size or camera.image_size
    if size is None and photo is not None:
        size = photograph_size(photo)
    pixels = None if size is None else (int(size[0]), int(size[1]))
    pitch = pixel_size or camera.pixel_size
    camera = dataclasses.replace(camera, image_size=pixels, pixel_size=pitch)
    # Of the free parameters only: sliders of the others have none.
    sigma = None
    if covariance is not None:
        sigma = dict(zip(covariance[0], np.sqrt(np.diag(covariance[1]))))
    picture = None if photo is None else read_photograph(photo, colour=True)
    return CameraView(camera, sigma, picture, trace_files(files, {}))


def _view_scanner(
    path: Path, truth: Path | None, scene: Path | None, tell: Callable[[str], object]
) -> FlightView:
    """A scanner file, or a flight file, which has a track."""
    true_image = None
    if truth is not None:
        opened = read_scanner(truth)
        for warning in opened.warnings:
            tell(warning)
        true_image = opened.image
    origin = trace_files([path, *(file for file in (truth, scene) if file is not None)], {})
    scene_on = lambda earth: None if scene is None else read_scene(scene, earth)
    if path.suffix.lower() == ".toml" and "track" in read_toml(path):
        if true_image is not None:
            raise InputError("--truth: a flight file contains its truth; omit it")
        flight = read_flight(path)
        name = flight.file.section("scanner").text("name", path.stem)
        return FlightView(
            name, flight.flight, flight.earth, origin=origin, scene=scene_on(flight.earth)
        )
    scanner = read_scanner(path)
    for warning in scanner.warnings:
        tell(warning)
    return FlightView(
        scanner.name,
        scanner.image,
        scanner.earth,
        true_image,
        origin,
        scene=scene_on(scanner.earth),
    )
