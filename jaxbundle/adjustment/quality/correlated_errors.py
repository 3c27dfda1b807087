"""Errors that image points share, from the residuals of a network, and the σ they give.

Components of real photographs (`leastsquares.quality.error_components` estimates their sizes):

| component | is | size in |
|---|---|---|
| field on the sensor | what no lens model has, common to all photographs of a camera | image unit |
| principal point | moves from photograph to photograph | image unit |
| principal distance | the same, at the edge of the image | image unit |
| affine | shear and ratio of scales, the same | image unit |
| along tracks | of images of one point, alike from stations near to each other | a priori σ |
| given points in plane | held points, as those of a board, not where they are given | image unit |
| given points out of plane | the same across the plane that fits them | image unit |

Fields are sums of cubic B-splines on the sensor, in octaves of the same variance. Along a track the
errors of two images are correlated by Wendland's function (1995) of the distance of their stations.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.adjustment.quality.given_points import given_points_components, wendland
from jaxbundle.arguments import number as require_number
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.quality.error_components import (
    IMAGE,
    INDEPENDENT,
    OTHERS,
    ErrorComponent,
    ErrorModel,
    ErrorSettings,
    fit_error_model,
    stated_error_model,
)
from jaxbundle.leastsquares.quality.error_effects import first_rows
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.network.columns import list_some
from jaxbundle.network.tables import Camera
from jaxbundle.types import AnyArray


@dataclasses.dataclass(frozen=True)
class CorrelationSettings:
    """Which components are looked for.

    - `min_images`: photographs of a camera from which photograph-wise components are estimated: a
      size from n photographs is right to 1/√(2n), of eight to a quarter. From four, chance alone
      made σ of a principal distance 1.7 times larger.
    - `knots`: columns (x) and rows (y) of the finest splines of a field, over the measured part of
      the image whatever its sides. 11 have eight intervals, which three halvings make one.
    - `octaves`: of the field, each with splines half as fine as the one before, and the same
      variance; four end with those of the whole image. What a lens model lacks has no known scale:
      with the finest splines alone the variance found is spread evenly over all of them, and
      unknowns of the camera, which take up the coarse part, get too little of it.
    - `min_points_of_knot`: image points for each, so that residuals show the field.
    - `min_given_points`: held points, seen in two images or more, from which their errors are
      estimated; a size from eight is right to a quarter, as of photographs.
    - `reach`: distance of stations at which errors along a track are independent, in units of the
      median distance to the points. Half and double have scores of the same size in five real sets.
    """

    min_images: int = 8
    knots: tuple[int, int] = (11, 9)
    octaves: int = 4
    min_points_of_knot: int = 4
    min_given_points: int = 8
    reach: float = 0.6
    estimation: ErrorSettings = ErrorSettings()

    @property
    def octaves_of_knots(self) -> list[tuple[int, int]]:
        """Columns and rows of the splines of every octave, the finest first: between n knots are
        n − 3 intervals."""
        intervals = np.array(self.knots) - 3
        return [tuple((np.ceil(intervals / 2**k) + 3).astype(int)) for k in range(self.octaves)]

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

    def root(
        self,
        rays: Int[np.ndarray, " n"],
        columns: Int[np.ndarray, "n 2 s"],
        values: Float[np.ndarray, "n 2 s"],
        width: int,
    ) -> Any:
        """Rows of all observations [number, width] from the values, in the image unit, that s
        columns have in the rows of x and y of some rays."""
        import scipy.sparse as sp

        row, s = self.row[rays][:, None] + np.arange(2), values.shape[2]
        count = np.zeros(self.number, int)
        count[row] = s
        start = np.concatenate([[0], np.cumsum(count)])
        data = values / self.sigma[rays][:, :, None]
        indices = columns.astype(np.int32)
        if (np.diff(row.ravel()) < 0).any():
            order = np.argsort(row.ravel())
            data, indices = (x.reshape(-1, s)[order] for x in (data, indices))
        data, indices = data.ravel(), indices.ravel()
        return sp.csr_matrix((data, indices, start), shape=(self.number, width))


def first_row_of_rays(solution: Solution, problem: NetworkProblem) -> Int[np.ndarray, " rays"]:
    """The row of x of every image point among the rows of all observations; that of y is the
    next."""
    starts = first_rows(solution)
    row = np.zeros(len(problem.image), int)
    for name, rays in problem.image_rows.items():
        row[rays] = starts[name] + 2 * np.arange(len(rays))
    return row


def image_rows(solution: Solution, problem: NetworkProblem) -> ImageRows:
    """The rows of the image points that take part, at their computed image coordinates.

    At the measured ones a component such as x·∂v/∂c would contain the errors themselves, and its
    quadratic form vᵀv: a principal distance that changes between photographs leaves so little in
    residuals that 0.5 pixels of it were found in 1280 views with independent errors of 0.2."""
    row, weight = first_row_of_rays(solution, problem), problem.image_weights
    has_weight = (weight > 0).all(1)
    number = sum(np.asarray(v).size for v in solution.residuals.values())
    v = problem.image_points(solution.residuals) / np.where(weight > 0, weight, 1.0)
    xy = problem.image_coordinates() + v  # computed − measured
    return ImageRows(
        row[has_weight],
        problem.image[has_weight],
        problem.point[has_weight],
        problem.camera[has_weight],
        xy[has_weight],
        1 / weight[has_weight],
        number,
    )


def error_components(
    solution: Solution, problem: NetworkProblem, settings: CorrelationSettings = DEFAULTS
) -> list[ErrorComponent]:
    """The components that the image points of a network can show."""
    rays = image_rows(solution, problem)
    components = components_of(rays, _scene(solution), problem.network.cameras, settings)
    return with_given_points_and_others(components, rays, solution, settings)


def with_given_points_and_others(
    components: list[ErrorComponent],
    rays: ImageRows,
    solution: Solution,
    settings: CorrelationSettings,
) -> list[ErrorComponent]:
    """Components of image points, that of given points, and that of all other observations, where
    there are any."""
    import scipy.sparse as sp

    options = settings.octaves, settings.min_given_points
    given_points = given_points_components(solution, rays.row, rays.point, rays.sigma, *options)
    components = [*components, *given_points]

    has_weight = _have_weight(solution)
    has_weight[np.concatenate([rays.row, rays.row + 1])] = False
    other_rows = np.flatnonzero(has_weight)
    if components and len(other_rows):
        # Control, priors, positions: their σ are not those of image points.
        shape = (rays.number, len(other_rows))
        unit_root = sp.csr_matrix(
            (np.ones(len(other_rows)), (other_rows, np.arange(len(other_rows)))), shape=shape
        )
        return [*components, ErrorComponent(OTHERS, "σ", unit_root)]
    return components


def joint_components(
    network: tuple[Solution, NetworkProblem],
    checks: tuple[Solution, NetworkProblem],
    settings: CorrelationSettings = DEFAULTS,
) -> list[ErrorComponent]:
    """`error_components` of a network, in its order, whose rows are followed by those of check
    points that take no part in it."""
    import scipy.sparse as sp

    components_of_network = error_components(*network, settings)
    rays, check_rays = (image_rows(*part) for part in (network, checks))
    scene, check_scene = (_scene(part) for part, _ in (network, checks))
    joint = ImageRows(
        np.concatenate([rays.row, rays.number + check_rays.row]),
        np.concatenate([rays.image, check_rays.image]),
        np.concatenate([rays.point, len(scene.points) + check_rays.point]),
        np.concatenate([rays.camera, check_rays.camera]),
        np.concatenate([rays.xy, check_rays.xy]),
        np.concatenate([rays.sigma, check_rays.sigma]),
        rays.number + check_rays.number,
    )
    scene = scene._replace(points=np.concatenate([scene.points, check_scene.points]))
    component_of = {
        c.name: c for c in components_of(joint, scene, network[1].network.cameras, settings)
    }
    padded_below = lambda root: sp.vstack(
        [root, sp.csr_matrix((check_rays.number, root.shape[1]))]
    ).tocsr()
    return [
        component_of.get(c.name) or c._replace(root=padded_below(c.root))
        for c in components_of_network
    ]


class StationsAndPoints(NamedTuple):
    """Adjusted `stations` of all images, and `points`."""

    stations: Float[np.ndarray, "images 3"]
    points: Float[np.ndarray, "points 3"]


def _scene(solution: Solution) -> StationsAndPoints:
    X = np.asarray(solution.values["point"])[:, :3]
    return StationsAndPoints(np.asarray(solution.values["image"].position), X)


def components_of(
    rays: ImageRows,
    scene: StationsAndPoints,
    cameras: Sequence[Camera],
    settings: CorrelationSettings,
) -> list[ErrorComponent]:
    """The components of image points."""
    components: list[ErrorComponent] = []
    has_several = len(cameras) > 1
    for c, camera in enumerate(cameras):
        is_of_camera = rays.camera == c
        if len(np.unique(rays.image[is_of_camera])) < settings.min_images:
            continue
        name = f" of {camera.id}" if has_several else ""
        rays_of_camera = np.flatnonzero(is_of_camera)
        middle, half_size = _frame(rays.xy[rays_of_camera])
        normalised = (rays.xy[rays_of_camera] - middle) / half_size
        if len(rays_of_camera) >= settings.min_points_of_field:
            components.append(
                _field(rays, rays_of_camera, normalised, f"field on the sensor{name}", settings)
            )
        # Displacements at the edge of the measured area, x or y = 1, of size 1.
        photographs, image = np.unique(rays.image[rays_of_camera], return_inverse=True)
        number, (x, y), ones = len(photographs), normalised.T, np.ones(len(normalised))
        first_column, second_column = image, number + image
        for effect, columns, values in (
            ("principal point by photograph", [[first_column], [second_column]], [[ones], [ones]]),
            ("principal distance by photograph", [[first_column], [first_column]], [[x], [y]]),
            ("affine by photograph", [[first_column, second_column]] * 2, [[x, y], [-y, x]]),
        ):
            columns, values = (np.moveaxis(np.array(a), 2, 0) for a in (columns, values))
            width = number * (1 + (effect != "principal distance by photograph"))
            root = rays.root(rays_of_camera, columns, values, width)
            components.append(ErrorComponent(f"{effect}{name}", IMAGE, root))
    if (track := _along_tracks(rays, scene, settings.reach)) is not None:
        components.append(track)
    return components


def _have_weight(solution: Solution) -> Bool[np.ndarray, " rows"]:
    """Which rows of all observations take part."""
    problem = solution.problem
    return np.concatenate([problem.weights(o.name).ravel() > 0 for o in problem.observations])


def correlated_errors(
    solution: Solution, problem: NetworkProblem, settings: CorrelationSettings = DEFAULTS
) -> ErrorModel | None:
    """The error model of a network; None where its image points cannot show any component."""
    components = error_components(solution, problem, settings)
    return fit_error_model(solution, components, settings.estimation) if components else None


def stated_errors(
    solution: Solution,
    problem: NetworkProblem,
    sizes: Mapping[str, float],
    sigma0: float = 1.0,
    settings: CorrelationSettings = DEFAULTS,
) -> ErrorModel:
    """The error model of components of known `sizes` by name, as an adjustment lists them
    (`ErrorModel.sizes`), in a solution or a design; a name without its camera is that of all
    cameras. Independent errors have `sigma0` times the σ of the observations, unless they are
    named.

    **Raises:** `InputError` for an unknown name, or a size that is no number from 0 on.
    """
    # Nothing is estimated: any number of photographs will do.
    settings = dataclasses.replace(settings, min_images=1, min_points_of_knot=0)
    components = error_components(solution, problem, settings)
    theta, unknown = np.zeros(len(components) + 1), dict(sizes)
    theta[0] = _size(INDEPENDENT, unknown.pop(INDEPENDENT, sigma0)) ** 2
    for k, component in enumerate(components, 1):
        of_all = next((n for n in sizes if component.name.startswith(f"{n} of ")), component.name)
        name = component.name if component.name in sizes else of_all
        if component.name == OTHERS:
            # θ of the independent part is that of all rows: the difference, which may be negative,
            # leaves the other observations `sigma0`.
            theta[k] = sigma0**2 - theta[0]
        elif name in sizes:
            theta[k] = _size(name, sizes[name]) ** 2
            unknown.pop(name, None)
    if unknown:
        known_names = [INDEPENDENT, *(c.name for c in components if c.name != OTHERS)]
        raise InputError(
            f"errors: no component {list_some([*unknown], 5, str)}; those of this network are "
            f"{list_some(known_names, 20, str)}"
        )
    return stated_error_model(solution, components, theta, settings.estimation)


def _size(name: str, value: Any) -> float:
    return require_number(f"the size of {name}", value, "0 or more", lambda x: x >= 0)


def _frame(xy: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "2"], float]:
    """Middle of the measured part of the images, and half its longer side."""
    low, high = xy.min(0), xy.max(0)
    return (low + high) / 2, max(float((high - low).max()) / 2, np.finfo(float).tiny)


def _aspect(xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "2"]:
    """Half sides of the measured part, in units of the longer one."""
    sides = np.ptp(xy, axis=0)
    return sides / sides.max()


def cubic_spline(distance: Float[AnyArray, "..."]) -> Float[AnyArray, "..."]:
    """A cubic B-spline at distances from its middle, in intervals of knots."""
    d = abs(distance)
    # Products: a power of 3 takes NumPy ten times as long.
    outer, inner = (2 - d).clip(0), (1 - d).clip(0)
    return (outer * outer * outer - 4 * inner * inner * inner) / 6


def cubic_splines(
    place: Float[AnyArray, "*points"], number: int
) -> Float[AnyArray, "*points number"]:
    """Cubic B-splines of a number − 3 of equal intervals over 0 … 1; the first has its middle an
    interval before."""
    return cubic_spline((place * (number - 3))[..., None] - (np.arange(number) - 1.0))


def squares_of_splines(
    place: Float[AnyArray, "*points"], number: int
) -> Float[AnyArray, "*points"]:
    """The sum of the squares of `cubic_splines`: in every interval of knots the same polynomial of
    the place t in it, of the sixth degree, and symmetric: a cubic one of t·(1 − t)."""
    four_places = np.linspace(0, 0.5, 4)
    sums = np.sum(cubic_splines(four_places, 4) ** 2, 1)
    a, b, c, d = np.polyfit(four_places * (1 - four_places), sums, 3)
    t = place * (number - 3) % 1
    s = t * (1 - t)
    return ((a * s + b) * s + c) * s + d


def root_of_octaves(settings: CorrelationSettings) -> Float[np.ndarray, "splines splines"]:
    """R with B·R·(B·R)ᵀ the sum of all octaves, B: the finest splines, of which those of octaves
    with half as many intervals are sums."""
    finest, *coarser = settings.octaves_of_knots
    # A cubic spline between two knots is determined by four places.
    places = [np.linspace(0, 1, 4 * n) for n in finest]
    total = np.eye(finest[0] * finest[1])
    for octave in coarser:
        x, y = (
            np.linalg.lstsq(
                cubic_splines(places_on_axis, n), cubic_splines(places_on_axis, m), rcond=None
            )[0]
            for places_on_axis, n, m in zip(places, finest, octave)
        )
        total += np.kron(y @ y.T, x @ x.T)
    return np.linalg.cholesky(total)


def _field(
    rays: ImageRows,
    rays_of_camera: Int[np.ndarray, " n"],
    normalised: Float[np.ndarray, "n 2"],
    name: str,
    settings: CorrelationSettings,
) -> ErrorComponent:
    """A field on the sensor in x and one in y, by the finest splines, of which 16 are not zero at a
    point."""
    knots, place = settings.knots, (normalised / _aspect(rays.xy[rays_of_camera]) + 1) / 2
    (x, of_x), (y, of_y) = (splines_of_point(u, number) for u, number in zip(place.T, knots))
    values = (y[:, :, None] * x[:, None, :]).reshape(len(normalised), -1)
    columns = (knots[0] * of_y[:, :, None] + of_x[:, None, :]).reshape(len(normalised), -1)
    number, root = knots[0] * knots[1], root_of_octaves(settings)
    both_columns = np.stack([columns, number + columns], 1)
    B = rays.root(rays_of_camera, both_columns, np.stack([values, values], 1), 2 * number)
    # √θ is then the RMS of the field, not the σ of its coefficients: Σ_i Σ_j (x_i·y_j)²
    square = 0.0
    for octave in settings.octaves_of_knots:
        x, y = (squares_of_splines(u, n) for u, n in zip(place.T, octave))
        square += np.mean(x * y)
    return ErrorComponent(name, IMAGE, B, root / np.sqrt(square))


def splines_of_point(
    place: Float[np.ndarray, " n"], number: int
) -> tuple[Float[np.ndarray, "n 4"], Int[np.ndarray, "n 4"]]:
    """The values of the four of `cubic_splines` that are not zero at a place, and which they
    are."""
    interval = np.clip(np.floor(place * (number - 3)), 0, number - 4)
    within = (place * (number - 3) - interval)[:, None]
    # The first begins an interval before.
    values = np.asarray(cubic_splines(within, 4))[:, 0]
    return values, interval.astype(np.int32)[:, None] + np.arange(4, dtype=np.int32)


def _along_tracks(rays: ImageRows, scene: StationsAndPoints, reach: float) -> ErrorComponent | None:
    """The correlation of the images of a point by the distance of their stations, in units of their
    a priori σ."""
    import scipy.sparse as sp

    if not len(rays.point):
        return None
    order = np.argsort(rays.point, kind="stable")
    point, start, count = np.unique(rays.point[order], return_index=True, return_counts=True)
    if not (count > 1).any():
        return None
    station, X = scene
    depth = float(np.nanmedian(np.linalg.norm(X[rays.point] - station[rays.image], axis=1)))
    if not (np.isfinite(depth) and depth > 0):
        return None
    rows, columns, values, first_column = [], [], [], 0
    for k in np.unique(count[count > 1]):
        tracks = order[start[count == k][:, None] + np.arange(k)]
        image = rays.image[tracks]
        # Two images of one station are one, and the block of both singular. Rounding of Cholesky's
        # method takes up to k(k + 1)·ε/2 from eigenvalues (Higham 2002, theorem 10.7), that of the
        # correlations a few k·ε: so much more is on the diagonal.
        distances = np.linalg.norm(station[image][:, :, None] - station[image][:, None], axis=3)
        nugget = 4 * k * (k + 1) * np.finfo(float).eps * np.eye(k)
        root = np.linalg.cholesky(wendland(distances / (reach * depth)) + nugget)
        column = first_column + np.arange(tracks.size).reshape(tracks.shape)
        rows.append(np.broadcast_to(rays.row[tracks][:, :, None], root.shape).ravel())
        columns.append(np.broadcast_to(column[:, None, :], root.shape).ravel())
        values.append(root.ravel())
        first_column += tracks.size
    row, column, value = (np.concatenate(x) for x in (rows, columns, values))
    # x, and y
    rows_and_columns = (
        np.concatenate([row, row + 1]),
        np.concatenate([column, first_column + column]),
    )
    root = sp.csr_matrix(
        (np.tile(value, 2), rows_and_columns), shape=(rays.number, 2 * first_column)
    )
    return ErrorComponent("along tracks", "σ", root)
