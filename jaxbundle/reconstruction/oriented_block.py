"""Named points in an adjusted block: their rays, where these meet, and how exactly.

A ray that misses the point of the others is a wrong measurement. Coordinates from the block are
compared with given ones by their joint covariance and, without satellite positions, up to a
similarity.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.adjustment.problem import coordinates
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.any_distance import derivative
from jaxbundle.network.tables import Network, Points
from jaxbundle.network.units import from_image_unit
from jaxbundle.orientation import batched
from jaxbundle.orientation.alignment import similarity_of_most
from jaxbundle.orientation.control_consistency import Discrepancies
from jaxbundle.orientation.rays import MIN_COSINE, rays_of
from jaxbundle.reconstruction.block import ground_sample_distance
from jaxbundle.reconstruction.named import NamedMeasurements

# Minimum control points of a block without satellite positions: a similarity has 7 parameters, two
# points have 6 coordinates.
MIN_CONTROL = 3


@dataclasses.dataclass(frozen=True)
class ControlSettings:
    """Settings of the use of control points and satellite positions."""

    offset_sigma: tuple[float, float, float] = (10.0, 10.0, 100.0)
    """Prior σ of the offset between satellite positions and control, metres: in the plane the error
    common to the code solutions of one flight; in height geoid undulations reach 107 m
    (EGM2008)."""
    wrong_ray: float = 5.0
    """A ray that misses its point by more, in σ of the measurement, is a wrong measurement: by
    chance with a probability of 4e-6 (Rayleigh). Wrong names and marks miss by tens of pixels. If
    the misclosures of all rays are larger than their σ explain, `resolve` multiplies σ by their
    robust scale."""
    paired_rays: int = 8
    """Maximum number of rays of a point of which every pair is tried: eight have 28 pairs, and if
    half of the rays are wrong, six of these are right."""
    assumed_pixels: float = 2.0
    """σ of control that its residuals do not determine, and the smallest estimated one, in pixels
    on the ground: what is marked and identified in photographs is hardly more exact, unless it is
    stated."""
    contradictory_heights: float = 3.0
    """Heights that are all 0 are unknown if the heights of the block differ by more, in σ of
    satellite positions."""
    compared_together: int = 100
    """Largest number of control points with a joint covariance, of 300 coordinates: the time of
    their comparison grows with the cube."""


@dataclasses.dataclass(frozen=True)
class FrameData:
    """What is given about the frame: control and check `points` with `named` measurements
    (photographs by their row in `names`), the `system` of their coordinates; satellite `positions`
    [photographs, 3] and their σ in this system, NaN: unknown."""

    points: Points
    named: NamedMeasurements
    names: tuple[str, ...]
    system: str = ""
    positions: tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]] | None = None


@dataclasses.dataclass(frozen=True)
class MeasuredPoint:
    """The measurements of one point in oriented photographs: rows of the named ones, of the
    network's images; directions as unit vectors in object space; the `normal` of a plane at
    distance 1 from the projection centre, in which differences from the ray are measured: that of
    the image of perspective cameras, of others the plane across the ray; `pixels` per unit of this
    plane, along columns and rows; σ, pixels; whether each agrees with the point, and the point
    intersected from those."""

    rows: Int[np.ndarray, " n"]
    image: Int[np.ndarray, " n"]
    rays: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    pixels: Float[np.ndarray, "n 2 3"]
    sigma: Float[np.ndarray, " n"]
    good: Bool[np.ndarray, " n"]
    position: Float[np.ndarray, "3"]


class OrientedBlock:
    """An adjusted block: its orientations, and intersections of named points in it."""

    def __init__(
        self, result: Adjustment, frame: FrameData, settings: ControlSettings = ControlSettings()
    ):
        self.result, self.frame, self.settings = result, frame, settings
        self.network: Network = result.problem.network
        values = result.image_values
        self.X0, self.angles = values[:, :3], values[:, 3:]
        self.M = np.asarray(batched.matrices(self.angles))
        self.X, self.A = result.point_values, np.eye(3)
        self.cameras = tuple(
            dataclasses.replace(c, parameters=result.camera_parameters(c.id))
            for c in self.network.cameras
        )
        self.row = {id: k for k, id in enumerate(self.network.images.id)}
        points = self.network.points.id
        is_known = np.all(np.isfinite(self.X), axis=1)
        named_ids = set(frame.points.id)
        self.row_of_determined = {
            id: k for k, id in enumerate(points) if id in named_ids and is_known[k]
        }
        observed = np.all(np.isfinite(self.network.images.sigma[:, :3]), axis=1)
        self.has_positions = int(observed.sum()) > 2  # two leave a rotation open
        self.row_of_point = {id: k for k, id in enumerate(points)}

    def measure(self, id: str) -> MeasuredPoint:
        """The measurements of a point; all of them agree for now."""
        named_measurements, names = self.frame.named, self.frame.names
        rows = [
            k
            for k, name in enumerate(named_measurements.name)
            if name == id and names[named_measurements.image[k]] in self.row
        ]
        rows = np.array(rows, int)
        image = np.array([self.row[names[named_measurements.image[k]]] for k in rows], int)
        camera = self.network.images.camera[image]
        # The measurements, and half a pixel to each side, for a central difference quotient.
        shifts = np.array([[0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]])
        xy = named_measurements.xy[rows] + shifts[:, None]
        d = self._camera_rays(np.tile(camera, len(shifts)), xy.reshape(-1, 2))
        d = np.einsum("nij,sni->snj", self.M[image], d.reshape(len(shifts), -1, 3))
        # The ideal image of other cameras is not flat: the plane across the ray fits it best, and
        # there is one beyond 90° from the axis, too.
        flat = np.array([get_model(c.model).image == "perspective" for c in self.cameras], bool)
        axis = -self.M[image, 2]
        is_before = np.einsum("ni,ni->n", axis, d[0]) > MIN_COSINE
        normal = np.where((flat[camera] & is_before)[:, None], axis, d[0])
        in_plane = d / np.einsum("ni,sni->sn", normal, d)[:, :, None]
        pixels = np.full((len(rows), 2, 3), np.nan)
        T = np.stack([in_plane[1] - in_plane[2], in_plane[3] - in_plane[4]], 2)
        # NaN: at the end of the range of the camera
        is_known = np.all(np.isfinite(T), axis=(1, 2))
        pixels[is_known] = np.linalg.pinv(T[is_known])
        rays = np.where(is_known[:, None], d[0], np.nan)
        sigma = named_measurements.sigma[rows].mean(1)
        return MeasuredPoint(rows, image, rays, normal, pixels, sigma, is_known, np.full(3, np.nan))

    def _camera_rays(
        self, camera: Int[np.ndarray, " n"], xy: Float[np.ndarray, "n 2"]
    ) -> Float[np.ndarray, "n 3"]:
        """Unit rays in the camera frame of points in pixels, NaN outside the range of a camera."""
        xy, sigma = from_image_unit(self.cameras, camera, xy, np.ones_like(xy), "px")
        d = np.full((len(xy), 3), np.nan)
        for c in np.unique(camera):
            d[camera == c], _ = rays_of(self.cameras[c], xy[camera == c], sigma[camera == c])
        return d

    def misses(self, point: MeasuredPoint, X: Float[np.ndarray, "3"]) -> Float[np.ndarray, " n"]:
        """Distances of the projections of X from its measurements, pixels: infinite behind the
        camera and of measurements without a ray, otherwise of the image without distortion, in
        pixels at the measurement."""
        sight = X - self.X0[point.image]
        depth = np.einsum("ni,ni->n", sight, point.normal)
        in_plane = point.rays / np.einsum("ni,ni->n", point.rays, point.normal)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            misclosure = np.einsum("nki,ni->nk", point.pixels, sight / depth[:, None] - in_plane)
            length = np.nan_to_num(np.linalg.norm(misclosure, axis=1), nan=np.inf)
            return np.where(depth > 0, length, np.inf)

    def distances(self, point: MeasuredPoint, X: Float[np.ndarray, "3"]) -> Float[np.ndarray, " n"]:
        """Distances of X from the rays of its measurements, object units."""
        return np.linalg.norm(np.cross(X - self.X0[point.image], point.rays), axis=1)

    def pixel_length(
        self, point: MeasuredPoint, X: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, " n"]:
        """The length of a pixel at X, parallel to the planes of its measurements."""
        depth = np.einsum("ni,ni->n", X - self.X0[point.image], point.normal)
        # The side of a square as large as the pixel: |∂u × ∂v| pixels cover an area of 1.
        cover = np.linalg.norm(np.cross(point.pixels[:, 0], point.pixels[:, 1]), axis=1)
        return depth / np.sqrt(cover)

    def resolve(self) -> dict[str, MeasuredPoint]:
        """By point, the measurements that agree on one position of it, and that position.

        σ of the measurements are multiplied by the robust scale of all their misclosures, if this
        is larger than 1: a point is identified worse than it is measured."""
        measured = {id: self.measure(id) for id in self.frame.points.id}
        consistent = {id: self._find_consistent(point) for id, point in measured.items()}
        # Normalised by the redundancy number 1 − 3/(2n) of a point with n rays.
        misses = [
            self.misses(point, point.position)[point.good]
            / point.sigma[point.good]
            / np.sqrt(1 - 1.5 / point.good.sum())
            for point in consistent.values()
            if point.good.sum() > 1
        ]
        # The median of a Rayleigh distribution (the length of two errors) is √(2·ln 2)·σ = 1.1774 σ
        scale = max(1.0, float(np.median(np.concatenate(misses))) / 1.1774) if misses else 1.0
        if scale == 1.0:
            return consistent
        return {
            id: self._find_consistent(dataclasses.replace(point, sigma=scale * point.sigma))
            for id, point in measured.items()
        }

    def smallest_miss(self, point: MeasuredPoint) -> float:
        """The least distance of a measurement from where the rays of two of them come nearest to
        each other, the larger one of the two, pixels; infinite without two rays."""
        return min((misses[pair].max() for pair, misses in self._pairs(point)), default=np.inf)

    def _pairs(
        self, point: MeasuredPoint
    ) -> Iterator[tuple[Int[np.ndarray, "2"], Float[np.ndarray, " n"]]]:
        """Pairs of rays, and the misses of all measurements from the point that they give."""
        usable = np.flatnonzero(np.isfinite(point.rays).all(1))
        rays_tried = usable[batched.evenly_spaced(len(usable), self.settings.paired_rays)]
        for i, j in itertools.combinations(rays_tried, 2):
            pair = np.isin(np.arange(len(point.rows)), [i, j])
            yield np.array([i, j]), self.misses(point, self._intersect(point, pair))

    def _find_consistent(self, point: MeasuredPoint) -> MeasuredPoint:
        """The largest set of rays that meet, more than half of them, from the best pair."""
        usable = np.flatnonzero(np.isfinite(point.rays).all(1))
        best = np.zeros(len(point.rows), bool)
        closest = np.inf
        for pair, misses_in_pixels in self._pairs(point):
            misses = misses_in_pixels / point.sigma
            good = misses < self.settings.wrong_ray
            if good[pair].all() and (good.sum(), -np.median(misses[good])) > (
                best.sum(),
                -closest,
            ):
                best, closest = good, np.median(misses[good])
        if best.sum() < 2 or 2 * best.sum() <= len(usable):
            return dataclasses.replace(point, good=np.zeros(len(point.rows), bool))
        return dataclasses.replace(point, good=best, position=self._intersect(point, best))

    def _intersect(
        self, point: MeasuredPoint, use: Bool[np.ndarray, " n"]
    ) -> Float[np.ndarray, "3"]:
        """The point nearest to some rays, by the angle at which they miss it."""
        weight, X0 = np.ones(use.sum()), self.X0[point.image[use]]
        # Σ p·(I − r·rᵀ)·(X − X0) = 0; with p = 1/distance² from the step before, distances from the
        # rays become angles
        P = np.eye(3) - point.rays[use][:, :, None] * point.rays[use][:, None, :]
        X = X0[0]
        for _ in range(3):
            N = (P * weight[:, None, None]).sum(0)
            # Parallel rays: σ along them would be a million times that across.
            if np.linalg.cond(N) > 1e12:
                return np.full(3, np.nan)
            X = np.linalg.solve(N, np.einsum("n,nij,nj->i", weight, P, X0))
            weight = 1 / np.maximum(((X - X0) ** 2).sum(1), 1e-30)
        return X

    def move(self, places: Sequence[int], points: Points) -> None:
        """Move the block by the similarity that fits most of the control points that are controlled
        on all axes.

        **Raises:** `InputError` if there are fewer than three of them, or on a line."""
        places = [k for k in places if not np.isinf(points.sigma[k]).any()]
        ids, target = [points.id[k] for k in places], points.position[places]
        if len(ids) < MIN_CONTROL:
            raise InputError(
                f"control points with heights in at least two photographs: expected "
                f"{MIN_CONTROL}, got {len(ids)} in this part; without satellite positions they "
                "alone give the frame"
            )
        similarity = similarity_of_most(self.X[[self.row_of_determined[id] for id in ids]], target)
        if similarity is None:
            raise InputError("the control points are on a line: they leave a rotation open")
        A, t = similarity
        R = A / np.cbrt(np.linalg.det(A))
        self.X0, self.X, self.M = self.X0 @ A.T + t, self.X @ A.T + t, self.M @ R.T
        self.angles, self.A = np.asarray(batched.angles(self.M)), A

    @property
    def ground_sample_distance(self) -> float:
        """The length of a pixel at the named points, the median; at all points if no named one
        has a position."""
        lengths = [
            self.pixel_length(self.measure(id), self.X[k])
            for id, k in self.row_of_determined.items()
        ]
        # NaN of measurements outside the range of their camera
        known_lengths = [x for of_point in lengths for x in of_point if np.isfinite(x)]
        if known_lengths:
            return float(np.median(known_lengths))
        return ground_sample_distance(self.result) * float(np.cbrt(np.linalg.det(self.A)))

    def compare(self, places: Sequence[int], points: Points) -> Discrepancies:
        """Coordinates from the block minus given ones, and their joint covariance."""
        rows = [self.row_of_determined[points.id[k]] for k in places]
        if not rows:
            no_points = np.zeros((0, 3))
            return Discrepancies(no_points, np.zeros((0, 3, 0, 3)), no_points, np.zeros((0, 3, 0)))
        X, given_position = self.X[rows], points.position[list(places)]
        C = self._joint_covariance(rows)
        n, sigma = len(rows), points.sigma[list(places)].copy()
        if self.has_positions:
            C = C + np.diag(self.offset_sigma**2)[None, :, None, :]
            G = np.zeros((n, 3, 0))
        else:
            # The generators of a similarity about the middle: shift, rotation, scale.
            x = (X - X.mean(0)) / max(np.ptp(X, axis=0).max(), 1e-12)
            turn = np.cross(np.eye(3)[None], x[:, None]).transpose(0, 2, 1)
            G = np.concatenate([np.tile(np.eye(3), (n, 1, 1)), turn, x[:, :, None]], 2)
        # Exact coordinates: σ 0, while NaN is to be estimated and infinity no observation.
        fixed = np.array([points.role[k] == "fixed" for k in places])
        sigma[fixed] = 0.0
        return Discrepancies(X - given_position, C, sigma, G)

    def _joint_covariance(self, rows: Sequence[int]) -> Float[np.ndarray, "n 3 n 3"]:
        """The covariance of the coordinates of some points among each other."""
        problem, n = self.result.problem, len(rows)
        D, lengths = np.tile(np.eye(3), (n, 1, 1)), problem.lengths
        # Far points are unknowns by direction and inverse distance: D of X by them.
        if lengths is not None:
            table = np.asarray(coordinates(self.result.values))
            for k, row in enumerate(rows):
                D[k] = derivative(jnp.asarray(np.append(table[row], lengths[row])))
        AD = self.A @ D
        C = self.result.errors.joint_covariance("point", rows)
        return np.einsum("nij,njmk,mlk->niml", AD, C, AD)

    def removed_image_points(self) -> list[tuple[str, str]]:
        """Image and point, by id, of the image points without weight."""
        problem = self.result.problem
        is_removed = ~problem.used
        images, points = self.network.images.id, self.network.points.id
        return [
            (images[i], points[p])
            for i, p in zip(problem.image[is_removed].tolist(), problem.point[is_removed].tolist())
        ]

    def is_determined(self, id: str, point: MeasuredPoint) -> bool:
        """Whether a point was adjusted with the block, from the measurements that agree."""
        if id not in self.row_of_determined or point.good.sum() < 2:
            return False
        misses = self.misses(point, self.X[self.row_of_determined[id]])[point.good]
        return bool((misses < self.settings.wrong_ray * point.sigma[point.good]).all())

    def name_of(self, point: MeasuredPoint, n: int) -> str:
        """The photograph of a measurement."""
        return self.network.images.id[point.image[n]]

    def seen_there(
        self, point: MeasuredPoint, n: int, id: str, measured: dict[str, MeasuredPoint]
    ) -> str:
        """Another point at the place of a measurement: measured in the same photograph, or
        intersected from others; empty without."""
        limit, xy = self.settings.wrong_ray * point.sigma[n], self.frame.named.xy
        for other_id, other_point in measured.items():
            rows_in_image = other_point.rows[other_point.image == point.image[n]]
            is_near = np.linalg.norm(xy[rows_in_image] - xy[point.rows[n]], axis=1) < limit
            if other_id != id and (
                is_near.any() or self.misses(point, other_point.position)[n] < limit
            ):
                return other_id
        return ""

    @property
    def offset_sigma(self) -> Float[np.ndarray, "3"]:
        """σ of the system of the block against that of control."""
        return np.array(self.settings.offset_sigma) if self.has_positions else np.zeros(3)
