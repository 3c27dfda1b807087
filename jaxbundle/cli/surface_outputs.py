"""Surfaces of `jaxbundle surface` from photographs, or from line scanner and RPC images."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import typer
from rich.progress import Progress, TaskID

from jaxbundle.errors import InputError
from jaxbundle.network.columns import did_you_mean
from jaxbundle.surface.inputs import check_points, read_views, tie_points
from jaxbundle.surface.orthophoto import ToViews
from jaxbundle.surface.pairs import parse_partners
from jaxbundle.surface.reconstruct import SurfaceResult, find_bounds, ground_bounds, reconstruct
from jaxbundle.surface.relative import align_all
from jaxbundle.surface.scanner_inputs import from_map, read_ground_views, system_of, to_map
from jaxbundle.surface.views import OrientedImage

Heights = tuple[float, float]
"""The lowest and the highest height searched."""


class Found(NamedTuple):
    """The surface, its images, the transformation from cloud to image coordinates, and check
    points."""

    surface: SurfaceResult
    views: Sequence[OrientedImage]
    to_views: ToViews
    check: np.ndarray


def make_of_photographs(
    path: Path,
    photos: Path | None,
    heights: Heights | None,
    pairs: Sequence[str] | None,
    crs: str | None,
    options: Mapping[str, Any],
) -> Found:
    """The surface of oriented photographs."""
    if photos is None:
        raise InputError("--photos is missing: the folder of the photographs")
    views, network, messages = read_views(path, photos)
    bounds, more = find_bounds(views, tie_points(network), heights)
    found = reconstruct(views, bounds, _partners(pairs, views), **options)
    cloud = dataclasses.replace(found.cloud, system=crs)
    said = _with_messages(dataclasses.replace(found, cloud=cloud), (*messages, *more))
    return Found(said, views, lambda X: X, check_points(network))


def make_of_ground(
    files: Sequence[Path],
    photos: Path | None,
    heights: Heights | None,
    pairs: Sequence[str] | None,
    crs: str | None,
    options: Mapping[str, Any],
) -> Found:
    """The surface of scanner or RPC images, in the coordinates of a map."""
    if len(files) < 2:
        raise InputError(f"{files[0]}: one image; a surface needs at least two")
    views, around = read_ground_views(files, photos)
    bounds, messages = ground_bounds(views, heights)
    moved = align_all(views, bounds)
    found = reconstruct(views, bounds, _partners(pairs, views), **options)
    to_views = lambda X: X
    if around is not None:
        system = system_of(around, crs)
        to_views = lambda X: from_map(X[:, 0], X[:, 1], X[:, 2], around, system)
        found = dataclasses.replace(found, cloud=to_map(found.cloud, around, system))
    said = _with_messages(found, (*messages, *moved))
    return Found(said, views, to_views, np.zeros((0, 3)))


def choose(views: Sequence[OrientedImage], names: Sequence[str] | None) -> list[OrientedImage]:
    """The images with these names; all if none are given."""
    known = [view.name for view in views]
    for name in names or ():
        if name not in known:
            raise InputError(f"--orthophoto-of {name!r}: no such image{did_you_mean(name, known)}")
    return [view for view in views if not names or view.name in names]


def _partners(
    pairs: Sequence[str] | None, views: Sequence[OrientedImage]
) -> dict[int, list[int]] | None:
    return parse_partners(pairs, [v.name for v in views]) if pairs else None


def _with_messages(found: SurfaceResult, messages: Sequence[str]) -> SurfaceResult:
    everything = (*messages, *found.messages)
    for message in everything:
        typer.echo(f"jaxbundle: {message}", err=True)
    return dataclasses.replace(found, messages=everything)


def report_stages(bar: Progress) -> Callable[[str, int, int], None]:
    """A callback that shows every stage as a bar of its own."""
    tasks: dict[str, TaskID] = {}

    def tell(stage: str, done: int, total: int) -> None:
        if stage not in tasks:
            tasks[stage] = bar.add_task(stage, total=total)
        bar.update(tasks[stage], completed=done, total=total)

    return tell
