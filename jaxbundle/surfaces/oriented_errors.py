"""Errors that the cells of a surface share through the orientations of its images: photographs of a
project, or scanner and RPC images of a refinement.

A cell depends on all images that see it. Its height changes by n·dX, n = (−∂z/∂x, −∂z/∂y, 1) in the
coordinates of the map; images of scanners have coordinates of their own, dX_map = (∂X_map/∂X)·dX.
"""

import dataclasses
from collections.abc import Set
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.errors import InputError
from jaxbundle.io.rasters.vertical import horizontal_system
from jaxbundle.network.columns import list_some
from jaxbundle.surfaces.height_cells import CellSource, HeightGrid, Modes
from jaxbundle.surfaces.inputs import read_orientations
from jaxbundle.surfaces.orientation import (
    OrientationErrors,
    orientation_errors,
    orientation_modes,
)
from jaxbundle.surfaces.scanner_inputs import from_map, map_derivative, read_refined_views
from jaxbundle.surfaces.scanner_views import Neighbourhood
from jaxbundle.surfaces.views import OrientedImage, is_inside


@dataclasses.dataclass(frozen=True)
class ChosenImages:
    """The images of a project or of a refinement, and the names of those a surface was made of;
    `around`: the place of scanner images, None in the coordinates of the object."""

    path: Path
    views: tuple[OrientedImage, ...]
    around: Neighbourhood | None
    names: Set[str]


def choose_images(path: str | Path, patterns: str) -> ChosenImages:
    """The images of a project, or of the folder of a refinement, whose ids have one of the
    patterns, which commas separate.

    **Raises:** `InputError` if they are fewer than two.
    """
    path = Path(path)
    refined = read_refined_views(path) if path.is_dir() else None
    views, around = refined if refined is not None else (read_orientations(path), None)
    some = [pattern.strip() for pattern in patterns.split(",")]
    names = {v.name for v in views if any(fnmatchcase(v.name, p) for p in some)}
    if len(names) < 2:
        known_names = list_some([view.name for view in views], 5, str)
        raise InputError(f"{path}: {patterns} names {len(names)} of its images ({known_names})")
    return ChosenImages(path, tuple(views), around, names)


@dataclasses.dataclass(frozen=True)
class OrientedErrors:
    """The errors of a surface by the orientations of its images; `uses`: of those listed, which it
    was made of; `system` of its coordinates."""

    errors: OrientationErrors
    uses: tuple[bool, ...]
    around: Neighbourhood | None
    system: str | None

    @property
    def number(self) -> int:
        return self.errors.root.shape[1]

    def __call__(self, grid: HeightGrid) -> Modes:
        modes = np.zeros((self.number, *grid.shape))
        rows, columns = np.nonzero(np.isfinite(grid.height))
        if not len(rows):
            return modes
        slopes = grid.slopes()[:, rows, columns]
        direction = np.stack([-slopes[0], -slopes[1], np.ones(len(rows))], 1)
        X = _centres(grid, rows, columns)
        X, direction = self._to_images(X, direction)
        is_used = self._used(X)
        is_seen = is_used.any(1)
        M = orientation_modes(self.errors, X[is_seen], is_used[is_seen], direction[is_seen])
        modes[:, rows[is_seen], columns[is_seen]] = M.T
        return modes

    def are_those_of(self, other: "OrientedErrors") -> bool:
        """Whether the independent errors are the same ones, column by column."""
        own_errors, other_errors = self.errors, other.errors
        if [v.name for v in own_errors.views] != [v.name for v in other_errors.views]:
            return False
        if own_errors.root.shape != other_errors.root.shape:
            return False
        # Unknowns have different units; W of the same covariance differs by roundings at most.
        scale = np.maximum(np.abs(own_errors.root).max(1, initial=0.0), 1e-300)[:, None]
        return bool(
            np.allclose(own_errors.root / scale, other_errors.root / scale, rtol=0.0, atol=1e-6)
        )

    def share_seen(self, cells: CellSource) -> float:
        """The share of the cells with a height that two of the images see; 1 without heights."""
        rows, columns = cells.shape
        number_seen, number = 0, 0
        # 512 rows of 10 000 cells are 40 MB, of which 10 000 cells tell the share within 1 %
        for begin in range(0, rows, 512):
            grid = cells.window(slice(begin, min(begin + 512, rows)), slice(0, columns))
            cells_with_height = np.argwhere(np.isfinite(grid.height))
            step = max(1, len(cells_with_height) // 10_000)
            cells_with_height = cells_with_height[::step]
            if len(cells_with_height):
                X = _centres(grid, *cells_with_height.T)
                is_used = self._used(self._to_images(X, np.zeros_like(X))[0]).any(1)
                number_seen, number = (
                    number_seen + step * int(is_used.sum()),
                    number + step * len(cells_with_height),
                )
        return number_seen / number if number else 1.0

    def _used(self, X: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n views"]:
        """Which images a cell is from: all that it is made of and that contain it."""
        is_used = np.zeros((len(X), len(self.uses)), bool)
        for k, (view, is_of_view) in enumerate(zip(self.errors.views, self.uses)):
            if is_of_view:
                is_used[:, k] = is_inside(view, view.project(X))
        # A cell of one image has no height from it.
        return is_used & (is_used.sum(1, keepdims=True) > 1)

    def _to_images(
        self, X: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Points, and the directions along which their errors count, in the images' coordinates."""
        if self.around is None or self.system is None:
            return X, direction
        X = from_map(X[:, 0], X[:, 1], X[:, 2], self.around, self.system)
        # n·dX_map = (Jᵀn)·dX: one vector a cell, instead of J·S·W, which has k columns
        J = map_derivative(X, self.around, self.system)
        return X, np.einsum("ni,nij->nj", direction, J)


def _centres(
    grid: HeightGrid, rows: Int[np.ndarray, " n"], columns: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """The points of some cells."""
    x, y = grid.x + (columns + 0.5) * grid.size, grid.y - (rows + 0.5) * grid.size
    return np.stack([x, y, grid.height[rows, columns]], 1)


def oriented_errors(
    chosen_images: ChosenImages, further_names: Set[str], system: str | None
) -> OrientedErrors:
    """The errors of the chosen images; `further_names`: images whose errors belong to the same
    ones, of another surface of the same adjustment.

    **Raises:** `InputError` without covariance, or of a surface without coordinate system.
    """
    if chosen_images.around is not None and system is None:
        raise InputError(
            f"{chosen_images.path}: its images are on the Earth, the surface has no coordinate "
            "system; give it one (gdal_edit.py -a_srs)"
        )
    # In the order of the project, and with those of the other surface: L of both then have the same
    # columns, and the common part of an error leaves their difference.
    views_kept = [
        view for view in chosen_images.views if view.name in (chosen_images.names | further_names)
    ]
    errors = orientation_errors(views_kept)
    if not errors.uncertain:
        raise InputError(
            f"{chosen_images.path}: no covariance of its orientations; adjust it with --out "
            "(images of scanners and RPC: pushbroom refine --out) and give the folder"
        )
    uses = tuple(view.name in chosen_images.names for view in views_kept)
    # Heights above a geoid are taken as they are: 100 m at 500 km change the effects by 2e-4.
    return OrientedErrors(errors, uses, chosen_images.around, horizontal_system(system))
