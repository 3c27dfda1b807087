"""Formats of inputs: how they are recognised, and their readers."""

import dataclasses
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path

from jaxbundle.arguments import path as given_path
from jaxbundle.arguments import show, text
from jaxbundle.cameras import CameraModel
from jaxbundle.choices import CAMERA_INPUTS, NETWORK_FILES
from jaxbundle.errors import InputError
from jaxbundle.io.cameras.camera_files import is_camera_file
from jaxbundle.io.cameras.opencv_file import FILE_STORAGE
from jaxbundle.io.networks.alicevision import is_alicevision, read_alicevision
from jaxbundle.io.networks.anipose import is_anipose, read_anipose
from jaxbundle.io.networks.bal import is_bal, read_bal
from jaxbundle.io.networks.bingo import is_bingo, read_bingo
from jaxbundle.io.networks.bundler import is_bundler, read_bundler
from jaxbundle.io.networks.colmap import is_colmap, read_colmap
from jaxbundle.io.networks.column_map import is_column_map, read_column_map
from jaxbundle.io.networks.control import read_control, select_checks, with_control
from jaxbundle.io.networks.csm_frame import is_csm_frame, read_csm_frame
from jaxbundle.io.networks.jaicov import is_jaicov, read_jaicov
from jaxbundle.io.networks.kalibr import is_kalibr, read_kalibr
from jaxbundle.io.networks.metashape import is_metashape, read_metashape
from jaxbundle.io.networks.micmac import is_micmac, read_micmac
from jaxbundle.io.networks.mounted_files import is_euroc, is_vins, read_euroc, read_vins
from jaxbundle.io.networks.mrcal import is_mrcal, read_mrcal
from jaxbundle.io.networks.nvm import is_nvm, read_nvm
from jaxbundle.io.networks.opencv_rigs import is_opencv_rig, read_opencv_rig
from jaxbundle.io.networks.openmvg import is_openmvg, read_openmvg
from jaxbundle.io.networks.opensfm import is_opensfm, read_opensfm
from jaxbundle.io.networks.opensfm_control import CONTROL
from jaxbundle.io.networks.opf import is_opf, read_opf
from jaxbundle.io.networks.orb_slam import is_orb_slam_pair, read_orb_slam_pair
from jaxbundle.io.networks.photo_list import read_photo_list
from jaxbundle.io.networks.photomodeler import is_photomodeler, read_photomodeler
from jaxbundle.io.networks.project import project_file, read_project
from jaxbundle.io.networks.realityscan import is_realityscan, read_realityscan
from jaxbundle.io.networks.rig_result import (
    file_of_line,
    is_rig_line,
    is_rig_result,
    read_rig_line,
    read_rig_result,
)
from jaxbundle.io.networks.settings import choose_datum, require_overrides
from jaxbundle.io.networks.stereo import is_ros_stereo, read_ros_stereo
from jaxbundle.io.networks.transforms import is_transforms, read_transforms
from jaxbundle.io.output_formats import TARGETS
from jaxbundle.network.columns import count, did_you_mean, list_some
from jaxbundle.network.rules import check_unique, model_of
from jaxbundle.network.tables import Network, Source
from jaxbundle.system.file_content import beginning, is_plain


@dataclasses.dataclass(frozen=True)
class Format:
    """A kind of input: how it is recognised, how it is read, and a description;
    `adjusted` if its control points have adjusted coordinates and a posteriori σ; `names_models`
    if cameras name their models, and `read` takes own ones; `takes_image_size`: `read` takes the
    image size of cameras that have none and need it; `unread`: what of such files is not read."""

    recognises: Callable[[Path], bool]
    read: Callable[..., Network]
    looks: str
    adjusted: bool = False
    names_models: bool = False
    takes_image_size: bool = False
    unread: tuple[str, ...] = ()


def _is_project(path: Path) -> bool:
    if path.suffix.lower() == ".toml":
        return not (is_column_map(path) or is_anipose(path))
    return path.is_dir() and project_file(path).is_file()


def _is_photo_list(path: Path) -> bool:
    """A text file whose first line is one number."""
    if path.suffix.lower() != ".txt" or not is_plain(path):
        return False
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        # Empty lines may stand before the number; the limit bounds the memory for any other file.
        first_line = next((line for line in file.read(100_000).split("\n") if line.strip()), "")
    try:
        float(first_line)
    except ValueError:
        return False
    return True


# The order is that of recognition: a .toml is a project unless it maps columns, a .txt is a list of
# photographs if its first line is one number, and so on. Each test reads only the beginning.
FORMATS: dict[str, Format] = {
    "project": Format(_is_project, read_project, NETWORK_FILES["project"], names_models=True),
    "photo-list": Format(_is_photo_list, read_photo_list, NETWORK_FILES["photo-list"]),
    "bal": Format(is_bal, read_bal, NETWORK_FILES["bal"]),
    "column-map": Format(
        is_column_map, read_column_map, NETWORK_FILES["column-map"], names_models=True
    ),
    "colmap": Format(
        is_colmap,
        read_colmap,
        NETWORK_FILES["colmap"],
    ),
    "bingo": Format(
        is_bingo,
        read_bingo,
        NETWORK_FILES["bingo"],
        unread=("orientations, distortion, which are not read",),
    ),
    "metashape": Format(is_metashape, read_metashape, NETWORK_FILES["metashape"]),
    "photomodeler": Format(
        is_photomodeler,
        read_photomodeler,
        NETWORK_FILES["photomodeler"],
        adjusted=True,
        unread=("covariances, which are not read",),
    ),
    "bundler": Format(
        is_bundler,
        read_bundler,
        NETWORK_FILES["bundler"],
    ),
    "openmvg": Format(
        is_openmvg,
        read_openmvg,
        NETWORK_FILES["openmvg"],
    ),
    "opensfm": Format(
        is_opensfm,
        read_opensfm,
        NETWORK_FILES["opensfm"],
    ),
    "transforms": Format(
        is_transforms,
        read_transforms,
        NETWORK_FILES["transforms"],
        takes_image_size=True,
    ),
    "kalibr": Format(is_kalibr, read_kalibr, NETWORK_FILES["kalibr"]),
    "micmac": Format(is_micmac, read_micmac, NETWORK_FILES["micmac"]),
    "jaicov": Format(is_jaicov, read_jaicov, NETWORK_FILES["jaicov"]),
    "mrcal": Format(is_mrcal, read_mrcal, NETWORK_FILES["mrcal"]),
    "opencv-stereo": Format(
        is_opencv_rig,
        read_opencv_rig,
        NETWORK_FILES["opencv-stereo"],
    ),
    "orb-slam": Format(
        is_orb_slam_pair,
        read_orb_slam_pair,
        NETWORK_FILES["orb-slam"],
    ),
    "vins": Format(is_vins, read_vins, NETWORK_FILES["vins"]),
    "euroc": Format(is_euroc, read_euroc, NETWORK_FILES["euroc"]),
    "ros-stereo": Format(is_ros_stereo, read_ros_stereo, NETWORK_FILES["ros-stereo"]),
    "anipose": Format(is_anipose, read_anipose, NETWORK_FILES["anipose"]),
    "rig": Format(is_rig_result, read_rig_result, NETWORK_FILES["rig"]),
    "rig-line": Format(is_rig_line, read_rig_line, NETWORK_FILES["rig-line"]),
    "csm-frame": Format(is_csm_frame, read_csm_frame, NETWORK_FILES["csm-frame"]),
    "nvm": Format(
        is_nvm,
        read_nvm,
        NETWORK_FILES["nvm"],
    ),
    "alicevision": Format(
        is_alicevision,
        read_alicevision,
        NETWORK_FILES["alicevision"],
    ),
    "realityscan": Format(
        is_realityscan,
        read_realityscan,
        NETWORK_FILES["realityscan"],
        takes_image_size=True,
    ),
    "opf": Format(is_opf, read_opf, NETWORK_FILES["opf"]),
}


def recognise_format(path: Path) -> str | None:
    """The kind of an input, from its name and content; None if none fits."""
    return next((name for name, kind in FORMATS.items() if kind.recognises(path)), None)


def read_oriented(path: str | Path) -> Network:
    """The network of an input in any known format; a project needs only cameras and images.

    **Raises:** `InputError`."""
    is_project = os.path.exists(path) and recognise_format(Path(path)) == "project"
    return read_project(path, oriented=True) if is_project else read_network(path)


def read_network(
    path: str | Path,
    *,
    format: str | None = None,
    overrides: Sequence[str] = (),
    control: str | Path | None = None,
    models: Sequence[CameraModel] = (),
    image_size: Sequence[float] | None = None,
) -> Network:
    """The network of an input in any known format.

    **Arguments:**

    - `path`: a file or folder.
    - `format`: a name in `FORMATS`; recognised from the path and its content if not given.
    - `overrides`: settings `KEY=VALUE` that replace those of the input.
    - `control`: a table whose control points replace those of the input (`networks.control`).
    - `models`: own `CameraModel`s that a project, or a column map, may name.
    - `image_size`: width and height in pixels, of cameras that have none and need it to be read
      (`transforms.json` with an angle of view).

    **Raises:** `InputError`.
    """
    path = Path(given_path("path", path))
    require_overrides(overrides)
    if format is not None and text("format", format) not in FORMATS:
        if format in TARGETS or format == "opencv":
            limitation = "contains only a camera" if format == "opencv" else "is written only"
            raise InputError(
                f"--format {format}: {limitation}; a network is read as {', '.join(FORMATS)}"
            )
        raise InputError(f"unknown format {format!r}{did_you_mean(format, FORMATS)}")
    if not os.path.exists(file_of_line(path)):
        raise InputError(f"{file_of_line(path)}: no such file or folder")
    format = format or recognise_format(path)
    if format is None and is_camera_file(path):
        raise InputError(
            f"{path}: contains only cameras, without images and points; expected a project "
            "or another network (jaxbundle camera, compare and convert read it)"
        )
    if format is None:
        if description := describe_incomplete(path):
            raise InputError(f"{path}: {description}")
        raise InputError(f"{path}: the kind of input is not recognised; {expected_inputs(path)}")
    # Read before the network, which may take long: its errors come at once.
    control_points = None if control is None else read_control(control)
    # Other formats have names of their own for their models.
    model_arguments = (check_own_models(models),) if FORMATS[format].names_models else ()
    sized = image_size is not None and FORMATS[format].takes_image_size
    sizes = {"image_size": image_size} if sized else {}
    network = FORMATS[format].read(path, overrides, *model_arguments, **sizes)
    if control_points is not None:
        return with_control(network, control_points, datum=not choose_datum(overrides))
    return _with_adjusted_control(network) if FORMATS[format].adjusted else network


# What files are that no reader of networks and cameras reads, by something in their beginning.
SCANNER_PRODUCT = "a product of a line scanner; `jaxbundle pushbroom` reads it"
OTHER_KINDS = {
    rb"^version https://git-lfs": "a pointer of Git LFS, not the file; fetch it by `git lfs pull`",
    rb"(?m)^sensor_type:\s*(?!camera)\w+": "of EuRoC, but of another sensor than a camera",
    rb"(?i)<(?:PHR_)?Dimap_Document": f"DIMAP, {SCANNER_PRODUCT}",
    rb"<isd>": f"support data of DigitalGlobe, {SCANNER_PRODUCT}",
    rb"USGS_ASTRO_LINE_SCANNER": f"support data (ISD), {SCANNER_PRODUCT}",
}


def describe_incomplete(path: Path) -> str:
    """What a file is that has a known form and not what is read from it; empty for others."""
    if path.name == CONTROL:
        return "ground control of OpenSfM; give its folder, with reconstruction.json"
    if FILE_STORAGE in beginning(path, 1000):
        return (
            "a FileStorage of OpenCV without camera_matrix; expected the result of a calibration, "
            "such as out_camera_data.xml, not its settings or images"
        )
    head = beginning(path, 1000)
    return next(
        (description for mark, description in OTHER_KINDS.items() if re.search(mark, head)), ""
    )


def expected_inputs(path: Path) -> str:
    """The kinds of inputs with the suffix of a path, or of folders, for a message; if there are
    none, the names of all."""
    word = "folder" if path.is_dir() else path.suffix.lower() or "…"
    kinds = {k: look for k, look in (CAMERA_INPUTS | NETWORK_FILES).items() if word in look.lower()}
    looks = "; ".join(kinds.values())
    # A message is one line: 200 characters are two lines of a terminal.
    if kinds and len(looks) < 200:
        return f"known formats of this name: {looks}"
    names = (
        f"formats of this name: {', '.join(kinds)}" if kinds else f"formats: {', '.join(FORMATS)}"
    )
    return f"known {names} (jaxbundle convert --help describes them)"


def check_own_models(models: Sequence[CameraModel]) -> tuple[CameraModel, ...]:
    """Own models that a file may name, each of them once.

    **Raises:** `InputError`."""
    if not (isinstance(models, list | tuple) and all(isinstance(m, CameraModel) for m in models)):
        raise InputError(f"models must be a list of CameraModels, but is {show(models)}")
    check_unique([model_of(m).name for m in models], Source("models", None, "number"), "model")
    return tuple(models)


def _with_adjusted_control(network: Network) -> Network:
    """The network with a warning about already adjusted control points, and a note about held
    ones."""
    points = network.points
    held_ids = [id for id, role in zip(points.id, points.role) if role == "fixed"]
    weighted = points.role.count("control")
    if held_ids:
        held_count = count(len(held_ids), "control point")
        network = network.note(
            f"{held_count} without positive σ held as fixed: {list_some(held_ids)}"
        )
    if weighted:
        network = network.warn(
            f"the file gives {count(weighted, 'control point')} with adjusted coordinates and a "
            "posteriori σ; adjusted again, control counts twice and σ0 is too small. Give the "
            "control as it was measured: --control FILE (id,X,Y,Z,sX,sY,sZ)"
        )
    return network


def as_network(
    network: Network | str | Path,
    *,
    format: str | None = None,
    overrides: Sequence[str] = (),
    control: str | Path | None = None,
    check: Sequence[str] = (),
    oriented: bool = False,
) -> Network:
    """A network, or that of an input in any known format.

    **Arguments:** `format`, `overrides`, `control`: as of `read_network`, for a path; `check`:
    control points that are only compared with the result, names or `"every 3rd"`; `oriented`: a
    project needs only cameras and images.

    **Raises:** `InputError`."""
    if isinstance(network, str | os.PathLike):
        if oriented:
            network = read_oriented(network)
        else:
            network = read_network(network, format=format, overrides=overrides, control=control)
    elif not isinstance(network, Network):
        raise InputError(
            f"network must be a Network or the path of one, but is {show(network)}: "
            "read_network, make_network and simulate make networks"
        )
    elif format or overrides or control:
        raise InputError("format, overrides and control are for the network of a file: give a path")
    if check:
        network = network.replace(points=select_checks(network.points, check))
    return network
