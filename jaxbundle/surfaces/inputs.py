"""Oriented photographs from files: a project, a COLMAP folder or another network, and the
photographs its images are named after."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.io.formats import read_oriented
from jaxbundle.io.networks.orientation_covariance import (
    FILE,
    OrientationCovariance,
    read_orientation_covariance,
)
from jaxbundle.io.networks.project import ADJUSTED, FILE_NAME
from jaxbundle.network.columns import list_some
from jaxbundle.network.tables import Network
from jaxbundle.network.units import ANGLE_UNITS
from jaxbundle.photographs.formats import SUFFIXES
from jaxbundle.photographs.reading import read_photograph
from jaxbundle.surfaces.views import FrameView, frame_views


def read_views(
    path: str | Path, folder: str | Path
) -> tuple[tuple[FrameView, ...], Network, tuple[str, ...]]:
    """The oriented photographs of a network, the network, and messages about excluded images.

    **Raises:** `InputError` if fewer than two images are oriented, a photograph is missing, or
    does not have the size of its camera.
    """
    network = read_oriented(path)
    images = network.images
    values = np.concatenate([images.position, images.angles], 1)
    is_oriented = np.asarray(np.isfinite(values).all(1))
    messages = []
    if not is_oriented.all():
        left_out = [images.id[k] for k in np.flatnonzero(~is_oriented)]
        messages.append(f"without orientation, left out: {list_some(left_out, 5, str)}")
        network = network.replace(images=images.take(is_oriented))
    if is_oriented.sum() < 2:
        raise InputError(
            f"{path}: {is_oriented.sum()} oriented images; a surface needs at least two: orient "
            "them by jaxbundle adjust --out and give its folder here"
        )
    files = find_photographs(network.images.id, Path(folder))
    greys = [read_photograph(file) for file in files]
    colours = [partial(read_photograph, file, colour=True) for file in files]
    views = frame_views(network, greys, colours, _read_joint_covariance(Path(path), network))
    return views, network, tuple(messages)


def read_orientations(path: str | Path) -> tuple[FrameView, ...]:
    """The oriented images of a network without their photographs, which have the size of their
    cameras; images without orientation are left out.

    **Raises:** `InputError` if fewer than two are oriented, or a camera has no size.
    """
    network = read_oriented(path)
    images = network.images
    is_oriented = np.asarray(
        np.isfinite(np.concatenate([images.position, images.angles], 1)).all(1)
    )
    network = network.replace(images=images.take(is_oriented))
    if is_oriented.sum() < 2:
        raise InputError(f"{path}: {is_oriented.sum()} oriented images; a surface has at least two")
    greys = []
    for camera in (network.cameras[c] for c in network.images.camera):
        if camera.image_size is None:
            raise InputError(f"{path}: camera {camera.id}: image_size is missing, in pixels")
        columns, rows = camera.image_size
        greys.append(np.broadcast_to(np.uint8(0), (rows, columns)))
    return frame_views(network, greys, joint=_read_joint_covariance(Path(path), network))


def _read_joint_covariance(path: Path, network: Network) -> OrientationCovariance | None:
    """The covariance of the orientations beside a project, if an adjustment has written it."""
    folder = path if path.is_dir() else path.parent
    # A folder of results contains the folder of its project.
    file = next((f / FILE for f in (folder, folder / ADJUSTED) if (f / FILE_NAME).is_file()), None)
    if file is None or not file.is_file():
        return None
    covariance = read_orientation_covariance(file, ANGLE_UNITS[network.angle_unit])
    owners_in_network = {("image", id) for id in network.images.id}
    owners_in_network |= {("camera", camera.id) for camera in network.cameras}
    if not owners_in_network & {(kind, id) for kind, id, _ in covariance.unknowns}:
        raise InputError(f"{file}: not of this project: contains none of its images; remove it")
    return covariance


def find_photographs(names: Sequence[str], folder: Path) -> list[Path]:
    """The files of photographs by their names, with or without suffix, in a folder or below it;
    images before other files (masks and depths may have similar names), the nearest folder
    first.

    **Raises:** `InputError` naming missing or repeated ones.
    """
    if not folder.is_dir():
        raise InputError(f"--photos {folder}: no such folder")
    files = [p for p in sorted(folder.rglob("*")) if p.is_file()]
    files_found, missing_names = [], []
    for name in names:
        exact = folder / name
        if exact.is_file():
            files_found.append(exact)
            continue
        key = Path(name).name.lower()
        same_name = _foremost([p for p in files if p.name.lower() == key]) or _foremost(
            [p for p in files if p.stem.lower() == key]
        )
        if len(same_name) > 1:
            raise InputError(f"--photos {folder}: {name}: there are {list_some(same_name, 3, str)}")
        files_found += same_name
        missing_names += [name] * (not same_name)
    if missing_names:
        raise InputError(
            f"--photos {folder}: no photograph {list_some(missing_names, 5, str)}; the ids of the "
            "images are the names of their files"
        )
    return files_found


def _foremost(files: Sequence[Path]) -> list[Path]:
    """Among files of one name the images, and of these those in the nearest folder."""
    files = [p for p in files if p.suffix.lower() in SUFFIXES] or files
    smallest_depth = min((len(p.parts) for p in files), default=0)
    return [p for p in files if len(p.parts) == smallest_depth]


def tie_points(network: Network) -> np.ndarray:
    """Known coordinates [n, 3] of the points of a network."""
    X = network.points.position
    return X[np.isfinite(X).all(1)]


def check_points(network: Network) -> Float[np.ndarray, "n 3"]:
    """Known coordinates [n, 3] of the check and control points of a network."""
    X = network.points.position
    return X[np.isfinite(X).all(1) & network.points.has_role("check", "control", "fixed")]
