"""`cloud`: filter, thin and compare a point cloud."""

import dataclasses
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from jaxbundle.display import print_in_one_screen
from jaxbundle.io.results.result_json import without_nan
from jaxbundle.results import TableMethods
from jaxbundle.surfaces.accuracy import accuracy_of, at_check_points, to_plane
from jaxbundle.surfaces.cloud import Cloud
from jaxbundle.surfaces.cloud_filters import drop_isolated, drop_weak, thin
from jaxbundle.surfaces.compare import compare
from jaxbundle.surfaces.dsm import Dsm, make_dsm
from jaxbundle.surfaces.point_files import read_cloud


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class CloudResult(TableMethods):
    """A filtered cloud: `points_read` before filtering; the `figures` that were asked for, by name:
    "plane", "check_points", "comparison"; the `dsm`, None if not asked for."""

    cloud: Cloud
    points_read: int
    figures: dict[str, dict[str, Any]]
    dsm: Dsm | None = None

    @cached_property
    def accuracy(self) -> dict[str, Any]:
        """σ of the points along each axis, and their classes."""
        return accuracy_of(self.cloud)

    def to_dict(self) -> dict[str, Any]:
        """Counts and accuracy as plain dicts and numbers."""
        counts = {"points_read": self.points_read, "points": len(self.cloud)}
        return without_nan({**counts, "accuracy": self.accuracy, **self.figures})

    def table(self) -> dict[str, np.ndarray]:
        """The points with σ, rays and base image."""
        return self.cloud.table()

    def __str__(self) -> str:
        """Counts and figures in lines."""
        lines = [f"{self.points_read} points read, {len(self.cloud)} kept"]
        for name, values in self.figures.items():
            lines += [f"{name} {key:20} {value}" for key, value in values.items()]
        return "\n".join(lines)


def cloud(  # noqa: PLR0913 - the options of the command
    cloud: Cloud | str | Path,
    *,
    cube: float | None = None,
    least: int = 1,
    place: str = "mean",
    max_sigma: float | None = None,
    min_rays: int | None = None,
    statistical: float | None = None,
    size: float | None = None,
    against: Cloud | str | Path | None = None,
    check: np.ndarray | str | Path | None = None,
    plane: bool = False,
) -> CloudResult:
    """Filter, thin and compare a point cloud.

    **Arguments:**

    - `cloud`: a cloud, or its file: .csv with X, Y, Z, .ply, .las, .laz.
    - `cube`: side of cubes, each with at least `least` points replaced by one: their `"mean"`, the
      `"corner"`, or the `"best"` of them (`place`).
    - `max_sigma`: largest σ on any axis; `min_rays`: minimum number of rays; `statistical`: drop
      points this many σ farther from their neighbours than others are.
    - `size`: cells of a DSM; `against`: another cloud to compare with; `check`: points [n, 3] or
      their file, whose heights are compared; `plane`: RMS to the best plane.

    **Raises:** `InputError`.
    """
    opened = _open_cloud(cloud)
    reference = None if against is None else _open_cloud(against)
    filtered = drop_weak(opened, max_sigma, min_rays)
    if statistical is not None:
        filtered = drop_isolated(filtered, limit=statistical)
    if cube is not None:
        filtered = thin(filtered, cube, least, place)
    figures = {}
    if plane:
        figures["plane"] = to_plane(filtered.X)
    if check is not None:
        X = _open_cloud(check).X if isinstance(check, str | Path) else np.asarray(check, float)
        figures["check_points"] = at_check_points(filtered, X)
    if reference is not None:
        figures["comparison"] = compare(filtered, reference)
    dsm = None if size is None else make_dsm(filtered, size)
    return CloudResult(filtered, len(opened), figures, dsm)


def _open_cloud(cloud: Cloud | str | Path) -> Cloud:
    return cloud if isinstance(cloud, Cloud) else read_cloud(cloud)
