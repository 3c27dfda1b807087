"""Errors that image points share, from the residuals of a network, and the σ they give.

Components of real photographs (`leastsquares.quality.error_components` estimates their sizes):

| component | is | size in |
|---|---|---|
| field on the sensor | what no lens model has, common to all photographs of a camera | image unit |
| principal point | moves from photograph to photograph | image unit |
| principal distance | the same, at the edge of the image | image unit |
| affine | shear and ratio of scales, the same | image unit |
| along tracks | of images of one point, alike from stations near to each other | a priori σ |

Fields are cubic B-splines on the sensor. Along a track the errors of two images are correlated by
Wendland's function (1995) of the distance of their stations.
"""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.leastsquares.quality.error_components import (
    OTHERS,
    ErrorComponent,
    ErrorModel,
    ErrorSettings,
    first_rows,
    fit_error_model,
)
from jaxbundle.leastsquares.solution import Solution


@dataclasses.dataclass(frozen=True)
class CorrelationSettings:
    """Which components are looked for.

    - `min_images`: photographs of a camera from which photograph-wise components are estimated: a
      size from n photographs is right to 1/√(2n), of eight to a quarter. From four, chance alone
      made σ of a principal distance 1.7 times larger.
    - `knots`: columns (x) and rows (y) of the splines of a field, over the measured part of the
      image whatever its sides.
    - `min_points_of_knot`: image points for each, so that residuals show the field.
    - `reach`: distance of stations at which errors along a track are independent, in units of the
      median distance to the points. Half and double have scores of the same size in five real sets.
    """

    min_images: int = 8
    knots: tuple[int, int] = (11, 9)
    min_points_of_knot: int = 4
    reach: float = 0.6
    estimation: ErrorSettings = ErrorSettings()

    @property
    def min_points_of_field(self) -> int:
        """Image points of a camera from which a field on its sensor is looked for."""
        return self.min_points_of_knot * self.knots[0] * self.knots[1]


DEFAULTS = CorrelationSettings()


@dataclasses.dataclass(frozen=True)
class ImageRows:
    """The used image points of a network as rows of its observations: row of x (that of y is the
    next), image, point, camera, image coordinates and σ."""

    row: Int[np.ndarray, " rays"]
    image: Int[np.ndarray, " rays"]
    point: Int[np.ndarray, " rays"]
    camera: Int[np.ndarray, " rays"]
    xy: Float[np.ndarray, "rays 2"]
    sigma: Float[np.ndarray, "rays 2"]
    number: int

    def root(self, x: Any, y: Any) -> Any:
        """Rows of all observations from columns in the image unit: [rays, k] of x and of y."""
        import scipy.sparse as sp

        rows = [
            self.place(axis, 1 / self.sigma[:, axis]) @ sp.csr_matrix(columns)
            for axis, columns in enumerate((x, y))
        ]
        return (rows[0] + rows[1]).tocsr()

    def place(self, axis: int, value: Float[np.ndarray, " rays"]) -> Any:
        """The matrix that puts values of the rays, times `value`, into the rows of x or y."""
        import scipy.sparse as sp

        shape = (self.number, len(self.row))
        return sp.csr_matrix((value, (self.row + axis, np.arange(len(self.row)))), shape=shape)

    def by_image(self, column: Float[np.ndarray, " rays"]) -> Any:
        """A column for every image."""
        import scipy.sparse as sp

        used, image = np.unique(self.image, return_inverse=True)
        rays = np.arange(len(column))
        return sp.csr_matrix((column, (rays, image)), shape=(len(column), len(used)))


def image_rows(found: Solution, problem: NetworkProblem) -> ImageRows:
    """The rows of the image points that take part."""
    starts = first_rows(found)
    row = np.zeros(len(problem.image), int)
    for name, rays in problem.image_rows.items():
        row[rays] = starts[name] + 2 * np.arange(len(rays))  # x and y of each
    weight = problem.image_weights
    used = (weight > 0).all(1)
    number = sum(np.asarray(v).size for v in found.residuals.values())
    return ImageRows(
        row[used],
        problem.image[used],
        problem.point[used],
        problem.camera[used],
        problem.image_coordinates()[used],
        1 / weight[used],
        number,
    )


def error_components(
    found: Solution, problem: NetworkProblem, settings: CorrelationSettings = DEFAULTS
) -> list[ErrorComponent]:
    """The components that the image points of a network can show."""
    import scipy.sparse as sp

    rays, network, components = image_rows(found, problem), problem.network, []
    several = len(network.cameras) > 1
    for c, camera in enumerate(network.cameras):
        of = rays.camera == c
        images = len(np.unique(rays.image[of]))
        if images < settings.min_images:
            continue
        name = f" of {camera.id}" if several else ""
        middle, half = _frame(rays.xy[of])
        at = (rays.xy - middle) / half
        here = of.astype(float)
        columns, rows = settings.knots
        roots: list[tuple[str, list[Any]]] = []
        if of.sum() >= settings.min_points_of_field:
            B = sp.diags(here) @ _sparse_splines(at, _aspect(rays.xy[of]), (columns, rows))
            # √θ is then the RMS of the field, not the σ of its coefficients
            B = B / np.sqrt(B.power(2).sum() / of.sum())
            roots.append(("field on the sensor", [rays.root(B, 0 * B), rays.root(0 * B, B)]))
        # displacements at the edge of the measured area, x or y = 1, of size 1
        (x, y), none = at.T, np.zeros(len(at))
        for what, pairs in (
            ("principal point by photograph", [(here, none), (none, here)]),
            ("principal distance by photograph", [(x, y)]),
            ("affine by photograph", [(x, -y), (y, x)]),
        ):
            of_images = lambda u, here=here: rays.by_image(here * u)
            roots.append((what, [rays.root(of_images(u), of_images(v)) for u, v in pairs]))
        components += [
            ErrorComponent(f"{what}{name}", "image", sp.hstack(parts).tocsr())
            for what, parts in roots
        ]
    if (track := _along_tracks(found, rays, settings.reach)) is not None:
        components.append(track)
    others = np.setdiff1d(np.arange(rays.number), np.concatenate([rays.row, rays.row + 1]))
    others = others[_have_weight(found)[others]]
    if components and len(others):
        # control, priors, positions: their σ are not those of image points
        shape = (rays.number, len(others))
        one = sp.csr_matrix((np.ones(len(others)), (others, np.arange(len(others)))), shape=shape)
        components.append(ErrorComponent(OTHERS, "σ", one))
    return components


def _have_weight(found: Solution) -> Bool[np.ndarray, " rows"]:
    """Which rows of all observations take part."""
    problem = found.problem
    return np.concatenate([problem.weights(o.name).ravel() > 0 for o in problem.observations])


def correlated_errors(
    found: Solution, problem: NetworkProblem, settings: CorrelationSettings = DEFAULTS
) -> ErrorModel | None:
    """The error model of a network; None where its image points cannot show any component."""
    components = error_components(found, problem, settings)
    return fit_error_model(found, components, settings.estimation) if components else None


def _frame(xy: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "2"], float]:
    """Middle of the measured part of the images, and half its longer side."""
    low, high = xy.min(0), xy.max(0)
    return (low + high) / 2, max(float((high - low).max()) / 2, np.finfo(float).tiny)


def _aspect(xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "2"]:
    """Half sides of the measured part, in units of the longer one."""
    sides = np.ptp(xy, axis=0)
    return sides / sides.max()


def splines(
    at: Float[np.ndarray, "n 2"],
    half: Float[np.ndarray, "2"],
    knots: tuple[int, int],
) -> Float[np.ndarray, "n columns*rows"]:
    """Products of cubic B-splines over −half … half of x and y."""
    factors = []
    for axis, number in enumerate(knots):
        place = (at[:, axis] / half[axis] + 1) / 2 * (number - 3)
        d = np.abs(place[:, None] - (np.arange(number) - 1.0))
        inner, outer = 2 / 3 - d**2 + d**3 / 2, np.clip(2 - d, 0, None) ** 3 / 6
        factors.append(np.where(d < 1, inner, outer))
    return (factors[1][:, :, None] * factors[0][:, None, :]).reshape(len(at), -1)


def _sparse_splines(
    at: Float[np.ndarray, "n 2"], half: Float[np.ndarray, "2"], knots: tuple[int, int]
) -> Any:
    """`splines` as a sparse matrix, of which 16 values a row are not zero; some rows at a time."""
    import scipy.sparse as sp

    step = 50_000  # 40 MB of a dense matrix
    parts = [splines(at[k : k + step], half, knots) for k in range(0, len(at), step)]
    return sp.vstack([sp.csr_matrix(part) for part in parts]).tocsr()


def wendland(distance: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Wendland's C² function of compact support, positive definite in space: 1 at 0, 0 from 1."""
    return np.clip(1 - distance, 0, None) ** 4 * (4 * distance + 1)


def _along_tracks(found: Solution, rays: ImageRows, reach: float) -> ErrorComponent | None:
    """The correlation of the images of a point by the distance of their stations, in units of their
    a priori σ."""
    import scipy.sparse as sp

    if "image" not in found.values or not len(rays.point):
        return None
    order = np.argsort(rays.point, kind="stable")
    point, start, count = np.unique(rays.point[order], return_index=True, return_counts=True)
    if not (count > 1).any():
        return None
    station = np.asarray(found.values["image"].position)
    X = np.asarray(found.values["point"])[:, :3]
    depth = float(np.nanmedian(np.linalg.norm(X[rays.point] - station[rays.image], axis=1)))
    if not (np.isfinite(depth) and depth > 0):
        return None
    rows, columns, values, first = [], [], [], 0
    for k in np.unique(count[count > 1]):
        of = order[start[count == k][:, None] + np.arange(k)]
        image = rays.image[of]
        # a root of each block by its eigenvalues: two images of one station are one
        apart = np.linalg.norm(station[image][:, :, None] - station[image][:, None], axis=3)
        w, E = np.linalg.eigh(wendland(apart / (reach * depth)))
        root = E * np.sqrt(np.clip(w, 0, None))[:, None, :]
        column = first + np.arange(of.size).reshape(of.shape)
        rows.append(np.broadcast_to(of[:, :, None], root.shape).ravel())
        columns.append(np.broadcast_to(column[:, None, :], root.shape).ravel())
        values.append(root.ravel())
        first += of.size
    of_rays = sp.csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        shape=(len(rays.row), first),
    )
    parts = [rays.place(axis, np.ones(len(rays.row))) @ of_rays for axis in (0, 1)]
    return ErrorComponent("along tracks", "σ", sp.hstack(parts).tocsr())
