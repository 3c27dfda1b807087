"""Oriented photographs from files: a project, a COLMAP folder or another network, and the
photographs its images are named after."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.io.formats import read_network, recognised_format
from jaxbundle.io.networks.project import read_project
from jaxbundle.network.columns import some
from jaxbundle.network.tables import Network
from jaxbundle.photographs.reading import read_photograph
from jaxbundle.surface.views import FrameView, frame_views


def read_views(
    path: str | Path, folder: str | Path
) -> tuple[tuple[FrameView, ...], Network, tuple[str, ...]]:
    """The oriented photographs of a network, the network, and what was left out.

    **Raises:** `InputError` where fewer than two images are oriented, a photograph is missing, or
    is not of the size of its camera.
    """
    is_project = os.path.exists(path) and recognised_format(Path(path)) == "project"
    network = read_project(path, oriented=True) if is_project else read_network(path)
    images = network.images
    known = np.isfinite(images.position).all(1) & np.isfinite(images.angles).all(1)
    messages = []
    if not known.all():
        left = [images.id[k] for k in np.flatnonzero(~known)]
        messages.append(f"without orientation, left out: {some(left, 5, str)}")
        network = network.replace(images=images.take(known))
    if known.sum() < 2:
        raise InputError(
            f"{path}: {known.sum()} oriented images; a surface needs two at least: orient them by "
            "jaxbundle adjust --out, whose folder can be given here"
        )
    files = find_photographs(network.images.id, Path(folder))
    greys = [read_photograph(file) for file in files]
    return frame_views(network, greys), network, tuple(messages)


def find_photographs(names: Sequence[str], folder: Path) -> list[Path]:
    """The files of photographs by their names, with or without suffix, in a folder or below it.

    **Raises:** `InputError` that names those that are not there, or are there twice.
    """
    if not folder.is_dir():
        raise InputError(f"--photos {folder}: no such folder")
    files = [p for p in sorted(folder.rglob("*")) if p.is_file()]
    found, missing = [], []
    for name in names:
        exact = folder / name
        if exact.is_file():
            found.append(exact)
            continue
        key = Path(name).name.lower()
        same = [p for p in files if p.name.lower() == key] or [
            p for p in files if p.stem.lower() == key
        ]
        if len(same) > 1:
            raise InputError(f"--photos {folder}: {name}: there are {some(same, 3, str)}")
        found += same
        missing += [name] * (not same)
    if missing:
        raise InputError(
            f"--photos {folder}: no photograph {some(missing, 5, str)}; the ids of the images are "
            "the names of their files"
        )
    return found


def tie_points(network: Network) -> np.ndarray:
    """Coordinates [n, 3] of the points of a network that have any."""
    X = network.points.position
    return X[np.isfinite(X).all(1)]
