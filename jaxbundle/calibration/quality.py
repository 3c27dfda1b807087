"""Accuracy of a calibration: uncertainty maps, coverage of the image, comparison of two halves."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.adjustment.adjust import adjust
from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.adjustment.quality.projection_uncertainty import (
    FRAMES,
    have_rays,
    images_through_scene,
    interior_covariance_of_images,
)
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.arguments import one_of
from jaxbundle.calibration.pixels import unit_size
from jaxbundle.cameras import get_model
from jaxbundle.cameras.compare import Comparison, compare_cameras
from jaxbundle.cameras.pixel_frame import in_model_units, in_pixels
from jaxbundle.display import data_set, print_in_one_screen
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.leastsquares.quality.correlation import squared_difference
from jaxbundle.network.camera_tables import with_start
from jaxbundle.network.tables import Camera, Network

# Columns and rows of the grid of a map: odd, so that the middle of the image is a point of it; σ is
# smooth, and changes little between neighbours.
GRID = (11, 9)
# Those of the grid of a figure, half as far apart, with σ interpolated in between.
DRAWN = (21, 17)

if TYPE_CHECKING:
    from xarray import Dataset


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class UncertaintyMap:
    """Standard deviations of a projected point over the image.

    **Fields:** `frame`, `distance`: the frame in which the point is fixed, see
    `jaxbundle.adjustment.quality.projection_uncertainty`; `uv` pixels of the grid;
    `covariance` and `sigma`, √((σx² + σy²)/2), pixels; NaN where there is no image.
    """

    frame: str
    distance: float
    uv: Float[np.ndarray, "rows columns 2"]
    covariance: Float[np.ndarray, "rows columns 2 2"]

    @property
    def sigma(self) -> Float[np.ndarray, "rows columns"]:
        return np.sqrt(np.trace(self.covariance, axis1=2, axis2=3) / 2)

    def to_xarray(self) -> "Dataset":
        """σ and covariance over u and v (pixels), as an `xarray.Dataset` (extra `grids`)."""
        axes = np.array(["u", "v"])
        return data_set(
            {
                "sigma": (("v", "u"), self.sigma, "px"),
                "covariance": (("v", "u", "axis", "other_axis"), self.covariance, "px²"),
            },
            {
                "v": (self.uv[:, 0, 1], "px"),
                "u": (self.uv[0, :, 0], "px"),
                "axis": (axes, ""),
                "other_axis": (axes, ""),
            },
            frame=self.frame,
            distance=self.distance,
        )

    @property
    def middle(self) -> float:
        """σ in the middle of the image."""
        rows, columns = self.sigma.shape
        return float(self.sigma[rows // 2, columns // 2])

    @property
    def corners(self) -> float:
        """The largest σ in those of the four corners that have a ray; NaN if none has."""
        return float(np.fmax.reduce(_in_corners(self.sigma)))


def grid_of(
    image_size: tuple[int, int] | Sequence[float], columns: int = GRID[0], rows: int = GRID[1]
) -> Float[np.ndarray, "rows columns 2"]:
    """A grid from corner to corner of an image, pixels [rows, columns, 2]."""
    w, h = image_size
    return np.stack(np.meshgrid(np.linspace(0, w - 1, columns), np.linspace(0, h - 1, rows)), -1)


def uncertainty_map(
    adjustment: Adjustment,
    camera: str,
    distance: float = np.inf,
    frame: str = "scene",
    grid: tuple[int, int] = GRID,
) -> UncertaintyMap:
    """The uncertainty of a projected point over the image of an adjusted camera.

    **Arguments:** `frame`: "scene", "rotation" or "camera"; `distance` (object unit) matters only
    for "scene"; `grid`: columns and rows of the map.

    **Raises:** `InputError` if the image size is unknown or the distance impossible.
    """
    one_of("frame", frame, FRAMES)
    if not distance > 0:
        raise InputError(f"distance {distance:g}: expected a positive distance")
    network = adjustment.problem.network
    c = [camera_of_network.id for camera_of_network in network.cameras].index(camera)
    camera_of_network = network.cameras[c]
    if camera_of_network.image_size is None:
        raise InputError(f"camera {camera!r}: image_size is needed for a map of its image")
    model = get_model(camera_of_network.model)
    uv = grid_of(camera_of_network.image_size, *grid)
    xy = in_model_units(
        uv.reshape(-1, 2), model, camera_of_network.image_size, camera_of_network.pixel_size
    )
    if frame == "scene":
        views = np.flatnonzero(network.images.camera == c)
        p = np.array(list(adjustment.camera_parameters(camera).values()))
        places_with_rays = np.flatnonzero(have_rays(model, p, xy))
        # Fixed in the scene, a point moves with the pose of each view as well, and poses are
        # correlated with the camera: the whole covariance, by propagation through a function.
        table, row = adjustment.problem.table_of_camera(c)
        function = images_through_scene(
            model, (table.name, row), views, adjustment.values, xy[places_with_rays], distance
        )
        Q = adjustment.covariance_of(function).reshape(
            len(places_with_rays), 2, len(places_with_rays), 2
        )
        n = np.arange(len(places_with_rays))
        C = np.full((len(xy), 2, 2), np.nan)
        C[places_with_rays] = Q[n, :, n]
    else:
        names, Q = adjustment.camera_covariance(camera)
        columns = tuple(model.parameters.index(name) for name in names)
        p = np.array(list(adjustment.camera_parameters(camera).values()))
        C = interior_covariance_of_images(model, p, columns, Q, xy, frame)
    per_unit = 1 / np.array(unit_size(model, camera_of_network.pixel_size))
    C = C * per_unit[:, None] * per_unit
    return UncertaintyMap(frame, float(distance), uv, C.reshape(*uv.shape[:2], 2, 2))


def _in_corners(values: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "4"]:
    return values[[0, 0, -1, -1], [0, -1, 0, -1]]


def over_distance(
    maps: Sequence[UncertaintyMap], distances: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """σ of a projected point in the middle and in the corners, pixels, [n] each.

    The image of a point fixed in the scene changes with the projection centre in proportion to 1/d,
    so its variance is a quadratic polynomial in 1/d, found exactly by Lagrange interpolation of
    `maps` at three distances.
    """
    # Infinity is the point 0 of 1/d, and as good a node as any other.
    nearness = np.array([1 / m.distance for m in maps])
    variance = np.array([_in_corners(m.sigma**2) for m in maps])
    middle = np.array([m.middle**2 for m in maps])
    t = 1 / np.asarray(distances, float)
    weight = np.array(
        [
            np.prod(
                [
                    (t - other_nearness) / (own_nearness - other_nearness)
                    for other_nearness in nearness
                    if other_nearness != own_nearness
                ],
                axis=0,
            )
            for own_nearness in nearness
        ]
    )
    interpolate = lambda values: np.sqrt(np.clip(values @ weight, 0, None))
    return interpolate(middle), np.fmax.reduce(interpolate(variance.T))


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Coverage:
    """Coverage of the image by measured points.

    **Fields:** `counts` of points in cells of the image; `part` of the cells with points;
    `corners`: by name, whether the corner cells have points; `reach`: largest distance of a
    measured point from the image centre, in half diagonals.
    """

    counts: Int[np.ndarray, "rows columns"]
    corners: dict[str, bool]
    reach: float

    @property
    def part(self) -> float:
        return float((self.counts > 0).mean())


def coverage(
    uv: Float[np.ndarray, "n 2"],
    image_size: tuple[int, int] | Sequence[float],
    cells: tuple[int, int] = (12, 9),
) -> Coverage:
    """The coverage of an image by measured points, pixels.

    **Arguments:** `cells`: columns and rows, squares in an image of 4 : 3; more would stay empty
    between the points of a board."""
    uv = uv[np.isfinite(uv).all(1)]
    (w, h), (columns, rows) = image_size, cells
    counts, *_ = np.histogram2d(
        uv[:, 1], uv[:, 0], (rows, columns), ((-0.5, h - 0.5), (-0.5, w - 0.5))
    )
    # A corner is about a quarter of the height and a sixth of the width: nearly a square.
    corner_rows, corner_columns = max(rows // 4, 1), max(columns // 6, 1)
    corners = {
        "upper left": counts[:corner_rows, :corner_columns],
        "upper right": counts[:corner_rows, -corner_columns:],
        "lower left": counts[-corner_rows:, :corner_columns],
        "lower right": counts[-corner_rows:, -corner_columns:],
    }
    distance = np.linalg.norm(uv - (np.array(image_size) - 1) / 2, axis=1)
    return Coverage(
        counts.astype(int),
        {name: bool((c > 0).any()) for name, c in corners.items()},
        float(distance.max(initial=0.0) / (np.hypot(w, h) / 2)),
    )


@dataclasses.dataclass(frozen=True)
class CrossValidation:
    """A camera calibrated from either half of its photographs.

    **Fields:**

    - `rms_own`: RMS of the residuals (pixels, |v| of a point) of the two halves adjusted freely;
    - `rms_other`: the same with the camera of the other half held;
    - `difference`: of the parameters, first half − second half, in units of its σ;
    - `test`: dᵀ·C⁻¹·d/k of all k free parameters, near 1 if the halves differ by chance;
    - `halves`: the parameters of both; `comparison`: their image differences, without the best
      rotation (`jaxbundle.cameras.compare`), in the model's unit; None if nothing can be compared.
    """

    rms_own: float
    rms_other: float
    difference: dict[str, float]
    test: float
    halves: tuple[dict[str, float], dict[str, float]]
    comparison: Comparison | None


def used_rays(problem: NetworkProblem) -> Bool[np.ndarray, " rays"]:
    """Which image points have weight: those that were not removed as gross errors."""
    return np.all(problem.image_weights > 0, axis=1)


def cross_validation(result: Adjustment) -> CrossValidation | None:
    """Calibrate from every other photograph, and test that camera on the rest.

    **Arguments:** the adjustment of one camera: its start values are used, and its removed
    observations stay removed.

    **Returns:** None if there are too few photographs, or a half does not determine the camera.
    """
    network = result.problem.network
    if len(network.images) < 8:  # four photographs are few for a camera, fewer none
        return None
    network = start_at_result(network, result)
    # Every other photograph, so that both halves have poses from all around.
    half_of_image = np.arange(len(network.images)) % 2
    try:
        adjust_again = partial(adjust, robust=result.robust)
        halves = [adjust_again(take_images(network, half_of_image == number)) for number in (0, 1)]
        if not all(half.converged for half in halves):
            return None
        name = network.cameras[0].id
        # Each half with the camera of the other, whose poses alone are estimated: the residuals
        # grow by what the camera does not know of unseen photographs.
        parameters_of_halves = [half.camera_parameters(name) for half in halves]
        cross_adjusted = [
            adjust_again(
                _with_fixed_camera(
                    take_images(network, half_of_image == 1 - number), parameters_of_halves[number]
                )
            )
            for number in (0, 1)
        ]
    except (InputError, NotSolvedError):
        return None
    if not all(adjusted.converged for adjusted in cross_adjusted):
        return None
    # Independent halves: Σ(p₁ − p₂) = C₁ + C₂.
    names, C = halves[0].camera_covariance(name)
    C = C + halves[1].camera_covariance(name)[1]
    d = np.array([parameters_of_halves[0][n] - parameters_of_halves[1][n] for n in names])
    scale = np.sqrt(np.diagonal(C))
    test = squared_difference(d, C) / len(d)
    v = lambda half: residuals_in_pixels(half, half.problem.network.cameras[0])[0]
    rms_of = lambda half: float(np.sqrt(np.nanmean((v(half) ** 2).sum(1))))
    rms = lambda parts: float(np.sqrt(np.mean([rms_of(p) ** 2 for p in parts])))
    return CrossValidation(
        rms(halves),
        rms(cross_adjusted),
        dict(zip(names, (d / scale).tolist())),
        test,
        (parameters_of_halves[0], parameters_of_halves[1]),
        _compare(network.cameras[0], parameters_of_halves),
    )


def _compare(camera: Camera, halves: Sequence[Mapping[str, float]]) -> Comparison | None:
    model = get_model(camera.model)
    try:
        return compare_cameras(
            *((model, parameters) for parameters in halves),
            image_size=camera.image_size,
            pixel_size=camera.pixel_size,
        )
    except ValueError:
        return None


def start_at_result(
    network: Network, result: Adjustment, keep: Bool[np.ndarray, " rays"] | None = None
) -> Network:
    """The network with adjusted values as start values; priors observe what they did.

    `keep`: remaining rays, by default those not removed."""
    camera, exterior = network.cameras[0], result.image_values
    return network.replace(
        cameras=(with_start(camera, result.camera_parameters(camera.id)),),
        images=dataclasses.replace(
            network.images, position=exterior[:, :3], angles=exterior[:, 3:]
        ),
        observations=network.observations.take(used_rays(result.problem) if keep is None else keep),
        warnings=(),
        notes=(),
    )


def take_images(network: Network, keep: Bool[np.ndarray, " images"]) -> Network:
    """The network with some of its images and their rays."""
    images, rays = network.images, network.observations
    index = np.cumsum(keep) - 1
    rays = rays.take(keep[rays.image])
    rows = np.flatnonzero(keep)
    return network.replace(
        images=dataclasses.replace(
            images,
            id=tuple(images.id[i] for i in rows),
            camera=images.camera[rows],
            position=images.position[rows],
            angles=images.angles[rows],
            sigma=images.sigma[rows],
            source=images.source.take(rows),
        ),
        observations=dataclasses.replace(rays, image=index[rays.image]),
    )


def _with_fixed_camera(network: Network, parameters: Mapping[str, float]) -> Network:
    camera = dataclasses.replace(network.cameras[0], parameters=parameters, free=())
    return network.replace(cameras=(camera,))


def residuals_in_pixels(
    adjustment: Adjustment, camera: Camera
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Residuals v [n, 2] of the image points of a camera, and the points [n, 2], in pixels; v is
    NaN where a point was removed."""
    problem, model = adjustment.problem, get_model(camera.model)
    weight = problem.image_weights
    v = adjustment.inspection.image_residuals
    is_used = used_rays(problem)
    # v is over σ in the adjustment
    v = np.where(is_used[:, None], v / np.where(is_used[:, None], weight, 1.0), np.nan)
    c = [camera_of_network.id for camera_of_network in adjustment.problem.network.cameras].index(
        camera.id
    )
    is_of_camera = problem.camera == c
    xy = problem.image_coordinates()[is_of_camera]
    size = np.array(unit_size(model, camera.pixel_size))
    uv = in_pixels(xy, model, camera.image_size, camera.pixel_size)
    return v[is_of_camera] / size, uv
