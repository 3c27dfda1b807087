"""Formats of outputs: how their names are recognised, their writers, and what they do not keep."""

import dataclasses
from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path

from jaxbundle.cameras import CameraModel
from jaxbundle.io.cameras.camera_files import write_cameras
from jaxbundle.io.cameras.opencv_file import SUFFIXES as OPENCV_SUFFIXES
from jaxbundle.io.cameras.opencv_file import YAML
from jaxbundle.io.cameras.opencv_writing import write_opencv, write_ros
from jaxbundle.io.networks.alicevision_writing import ALICEVISION_LOSSES, write_alicevision
from jaxbundle.io.networks.anipose import ANIPOSE_LOSSES, write_anipose
from jaxbundle.io.networks.bal import BAL_LOSSES, OPENERS, write_bal
from jaxbundle.io.networks.bundler import BUNDLER_LOSSES, write_bundler
from jaxbundle.io.networks.colmap import FILES as COLMAP_FILES
from jaxbundle.io.networks.colmap import fill_colmap, write_colmap_cameras
from jaxbundle.io.networks.colmap_model import COLMAP_LOSSES, numbers_of
from jaxbundle.io.networks.colmap_models import COLMAP_MODELS
from jaxbundle.io.networks.jaicov import JAICOV_LOSSES, write_jaicov
from jaxbundle.io.networks.kalibr import KALIBR_LOSSES, write_kalibr
from jaxbundle.io.networks.kalibr import OFFERED_MODELS as KALIBR_MODELS
from jaxbundle.io.networks.losses import PIXEL_MODELS, QUANTITIES, Losses, changed
from jaxbundle.io.networks.micmac import FILES as MICMAC_FILES
from jaxbundle.io.networks.micmac import MICMAC_LOSSES, fill_micmac
from jaxbundle.io.networks.micmac_camera import MODELS as MICMAC_MODELS
from jaxbundle.io.networks.micmac_camera import write_autocal
from jaxbundle.io.networks.mrcal import FILES as MRCAL_FILES
from jaxbundle.io.networks.mrcal import MRCAL_LOSSES, fill_mrcal, write_cameramodel
from jaxbundle.io.networks.mrcal import OFFERED_MODELS as MRCAL_MODELS
from jaxbundle.io.networks.openmvg import OPENMVG_LOSSES, write_openmvg
from jaxbundle.io.networks.opensfm_writing import FILES as OPENSFM_FILES
from jaxbundle.io.networks.opensfm_writing import (
    OPENSFM_LOSSES,
    fill_opensfm,
    write_opensfm_cameras,
)
from jaxbundle.io.networks.project import FILE_NAME, fill_project
from jaxbundle.io.networks.project import FILES as PROJECT_FILES
from jaxbundle.io.networks.realityscan import FILES as REALITYSCAN_FILES
from jaxbundle.io.networks.realityscan import (
    REALITYSCAN_LOSSES,
    fill_realityscan,
    write_realityscan_csv,
)
from jaxbundle.io.networks.stereo import (
    ROS_FILES,
    STEREO_LOSSES,
    fill_ros_stereo,
    opencv_stereo_files,
    ros_stereo_folders,
    write_opencv_stereo,
)
from jaxbundle.io.networks.transforms import TRANSFORMS_LOSSES, write_transforms
from jaxbundle.io.results.coordinates import COORDINATES_LOSSES, write_coordinates
from jaxbundle.io.results.dxf import DXF_LOSSES, write_dxf
from jaxbundle.io.results.ply import PLY_LOSSES, write_ply
from jaxbundle.network.tables import Camera, Network


@dataclasses.dataclass(frozen=True)
class OutputFormat:
    """A kind of output: how its names are recognised, its writer, and its camera models.

    `write` returns messages about what is not kept: `losses`, and what only the writer sees; no
    `models`: all, a name with * is a family.
    `files`: names of the files in a folder; none: a file is written. `alone`: cameras
    without images can be written. `empty_cells`: images and points without values are written as
    empty cells, which nothing computes later. `parts`: the files or folders that are written of a
    network, if there may be several.
    """

    recognises: Callable[[Path], bool]
    write: Callable[[Network, Path], Sequence[str]]
    looks: str
    models: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    alone: bool = False
    empty_cells: bool = False
    losses: Losses = dataclasses.field(default_factory=dict)
    parts: Callable[[Network, Path], tuple[Path, ...]] | None = None


@dataclasses.dataclass(frozen=True)
class CameraTarget:
    """A kind of output that holds cameras only: as `OutputFormat`; `single`: one camera; `broad`:
    the name also fits other kinds, which come first."""

    recognises: Callable[[Path], bool]
    write: Callable[[Sequence[Camera], Path], None]
    looks: str
    models: tuple[str, ...] = ()
    single: bool = False
    broad: bool = False
    losses: Losses = dataclasses.field(default_factory=dict)


def _camera_losses(names: Callable[[Sequence[str]], Sequence[object]] | None = None) -> Losses:
    """The losses of a file of cameras; `names`: those that they get."""
    quantities = ("pixel sizes of cameras", "prior σ of camera parameters")
    name_losses: Losses = {}
    if names is not None:
        name_losses = {
            "names of cameras": lambda n: changed(ids := [c.id for c in n.cameras], names(ids))
        }
    return name_losses | {name: QUANTITIES[name] for name in quantities}


def _write_project(network: Network, path: Path) -> Sequence[str]:
    fill_project(network, path)
    return ()


def _has_suffix(*suffixes: str) -> Callable[[Path], bool]:
    return lambda path: path.suffix.lower() in suffixes


def _folder_contains(*words: str) -> Callable[[Path], bool]:
    """A name without suffix that contains one of these words, or whose folder does."""
    return lambda path: (
        not path.suffix and any(word in part.lower() for part in path.parts[-2:] for word in words)
    )


def _file_contains(word: str, *suffixes: str) -> Callable[[Path], bool]:
    return lambda path: word in path.stem.lower() and path.suffix.lower() in suffixes


def _has_name(name: str) -> Callable[[Path], bool]:
    return lambda path: path.name.lower() == name


def _single_camera_writer(
    write: Callable[[Camera, Path], None],
) -> Callable[[Sequence[Camera], Path], None]:
    """Writes the only camera."""
    return lambda cameras, path: write(cameras[0], path)


# The order is that of recognition; "project" takes any folder and stands last.
TARGETS: dict[str, OutputFormat] = {
    "ply": OutputFormat(
        _has_suffix(".ply"),
        write_ply,
        "NAME.ply",
        losses=PLY_LOSSES,
    ),
    "dxf": OutputFormat(
        _has_suffix(".dxf"),
        write_dxf,
        "NAME.dxf",
        losses=DXF_LOSSES,
    ),
    "realityscan-csv": OutputFormat(
        _file_contains("realityscan", ".csv"),
        write_realityscan_csv,
        "NAME.csv with realityscan in its name",
        ("opencv",),
        losses=REALITYSCAN_LOSSES,
    ),
    "csv": OutputFormat(
        _has_suffix(".csv"),
        write_coordinates,
        "NAME.csv",
        empty_cells=True,
        losses=COORDINATES_LOSSES,
    ),
    "bundler": OutputFormat(
        _has_suffix(".out"),
        write_bundler,
        "NAME.out",
        ("snavely",),
        losses=BUNDLER_LOSSES,
    ),
    "bal": OutputFormat(
        _has_suffix(".txt", ".bal", *OPENERS),
        write_bal,
        "NAME.txt, .bal, .gz, .bz2",
        ("snavely",),
        losses=BAL_LOSSES,
    ),
    "colmap": OutputFormat(
        _folder_contains("colmap", "sparse"),
        partial(fill_colmap, text=False),
        "a folder with colmap or sparse in its name",
        COLMAP_MODELS,
        COLMAP_FILES,
        losses=COLMAP_LOSSES,
    ),
    "colmap-text": OutputFormat(
        lambda _: False,  # a folder is named as for "colmap": only --to asks for text
        partial(fill_colmap, text=True),
        "by --to only",
        COLMAP_MODELS,
        COLMAP_FILES,
        losses=COLMAP_LOSSES,
    ),
    "openmvg": OutputFormat(
        _file_contains("sfm_data", ".json"),
        write_openmvg,
        "NAME.json with sfm_data in its name",
        PIXEL_MODELS,
        losses=OPENMVG_LOSSES,
    ),
    "opensfm": OutputFormat(
        _folder_contains("opensfm"),
        fill_opensfm,
        "a folder with opensfm in its name",
        PIXEL_MODELS,
        OPENSFM_FILES,
        losses=OPENSFM_LOSSES,
    ),
    "alicevision": OutputFormat(
        _has_suffix(".sfm"),
        write_alicevision,
        "NAME.sfm",
        PIXEL_MODELS,
        losses=ALICEVISION_LOSSES,
    ),
    "transforms": OutputFormat(
        _file_contains("transforms", ".json"),
        write_transforms,
        "NAME.json with transforms in its name",
        PIXEL_MODELS,
        alone=True,
        losses=TRANSFORMS_LOSSES,
    ),
    "kalibr": OutputFormat(
        _file_contains("camchain", *YAML),
        write_kalibr,
        "NAME.yaml with camchain in its name",
        KALIBR_MODELS,
        alone=True,
        losses=KALIBR_LOSSES,
    ),
    "micmac": OutputFormat(
        lambda path: path.name.startswith("Ori-"),
        fill_micmac,
        "a folder Ori-NAME",
        MICMAC_MODELS,
        MICMAC_FILES,
        losses=MICMAC_LOSSES,
    ),
    "jaicov": OutputFormat(
        _has_suffix(".phc"),
        write_jaicov,
        "NAME.phc",
        ("brown-projected",),
        losses=JAICOV_LOSSES,
    ),
    "mrcal": OutputFormat(
        _folder_contains("mrcal"),
        fill_mrcal,
        "a folder with mrcal in its name",
        MRCAL_MODELS,
        MRCAL_FILES,
        alone=True,
        losses=MRCAL_LOSSES,
    ),
    "opencv-stereo": OutputFormat(
        _file_contains("stereo", *OPENCV_SUFFIXES),
        write_opencv_stereo,
        "NAME.yaml, .yml, .json with stereo in its name",
        PIXEL_MODELS,
        losses=STEREO_LOSSES,
        parts=opencv_stereo_files,
    ),
    "ros-stereo": OutputFormat(
        _folder_contains("camera_info"),
        fill_ros_stereo,
        "a folder with camera_info in its name",
        PIXEL_MODELS,
        ROS_FILES,
        losses=STEREO_LOSSES,
        parts=ros_stereo_folders,
    ),
    "anipose": OutputFormat(
        _file_contains("calibration", ".toml"),
        write_anipose,
        "NAME.toml with calibration in its name",
        PIXEL_MODELS,
        alone=True,
        losses=ANIPOSE_LOSSES,
    ),
    "realityscan": OutputFormat(
        _folder_contains("realityscan"),
        fill_realityscan,
        "a folder with realityscan in its name",
        ("opencv",),
        REALITYSCAN_FILES,
        losses=REALITYSCAN_LOSSES,
    ),
    "project": OutputFormat(
        lambda path: not path.suffix or path.is_dir() or path.name == FILE_NAME,
        _write_project,
        "another folder",
        files=PROJECT_FILES,
    ),
}
# Outputs that hold cameras only.
CAMERA_KINDS: dict[str, CameraTarget] = {
    "colmap-cameras": CameraTarget(
        _has_name("cameras.txt"),
        write_colmap_cameras,
        "cameras.txt",
        COLMAP_MODELS,
        losses=_camera_losses(numbers_of),
    ),
    "opensfm-cameras": CameraTarget(
        _has_name("camera_models.json"),
        write_opensfm_cameras,
        "camera_models.json",
        PIXEL_MODELS,
        losses=_camera_losses(),
    ),
    "ros": CameraTarget(
        _file_contains("camera_info", *YAML),
        _single_camera_writer(write_ros),
        "NAME.yaml with camera_info in its name",
        PIXEL_MODELS,
        single=True,
        losses=_camera_losses(lambda ids: [None] * len(ids)),
    ),
    "cameramodel": CameraTarget(
        _has_suffix(".cameramodel"),
        _single_camera_writer(write_cameramodel),
        "NAME.cameramodel",
        MRCAL_MODELS,
        single=True,
        losses=_camera_losses(lambda ids: [None] * len(ids)),
    ),
    "autocal": CameraTarget(
        _file_contains("autocal", ".xml"),
        _single_camera_writer(write_autocal),
        "NAME.xml with autocal in its name",
        MICMAC_MODELS,
        single=True,
        losses=_camera_losses(lambda ids: [None] * len(ids)),
    ),
    "opencv": CameraTarget(
        _has_suffix(*YAML, ".json"),
        _single_camera_writer(write_opencv),
        "NAME.yaml, .yml, .json",
        PIXEL_MODELS,
        single=True,
        losses=_camera_losses(lambda ids: [None] * len(ids)),
        broad=True,
    ),
    "cameras": CameraTarget(_has_suffix(".toml"), write_cameras, "NAME.toml", broad=True),
}


def has_model(models: Sequence[str], model: str | CameraModel) -> bool:
    """Whether a kind of output has a model; an empty list means all."""
    return not models or any(isinstance(model, str) and fnmatchcase(model, m) for m in models)


def recognise_target(path: Path) -> str | None:
    """The kind of an output, from its name."""
    kinds = (
        # The narrow names of cameras first, the broad ones after the networks.
        *((name, kind) for name, kind in CAMERA_KINDS.items() if not kind.broad),
        *TARGETS.items(),
        *CAMERA_KINDS.items(),
    )
    return next((name for name, kind in kinds if kind.recognises(path)), None)
