"""Uncoded targets: discs of oriented photographs that are images of one point.

Two rays that meet are a point that the other photographs either confirm or not. Those with the
most rays are accepted first; a disc belongs to one point.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from jaxbundle.adjustment.result import Adjustment
from jaxbundle.orientation import batched
from jaxbundle.reconstruction.named import NamedMeasurements
from jaxbundle.tiepoints.verified_pairs import central_distance, ideal_features

Places = Sequence[Float[np.ndarray, "_ 2"]]


@dataclasses.dataclass(frozen=True)
class UncodedSettings:
    """Settings of the search for uncoded targets.

    **Fields:**

    - `tolerance`: of the distance of a disc from where it is expected, pixels. Photographs that are
      oriented by coded targets predict to 0.1 to 0.3 pixels. Larger: neighbouring discs, whose
      radius is 3 pixels at least, are mixed up; smaller: those of poorly oriented ones are lost.
    - `min_rays`: with two rays every crossing of two epipolar lines would be a point; the third one
      confirms it.
    - `min_angle`: between the two rays from which a point is predicted, radians; 5°: at a smaller
      one its distance is off by more than ten times the error across the rays.
    """

    tolerance: float = 1.0
    min_rays: int = 3
    min_angle: float = np.radians(5.0)


def find_uncoded(
    result: Adjustment, names: Sequence[str], discs: Places, settings: UncodedSettings
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Photograph, disc and number of the point of every disc that belongs to one.

    **Arguments:** `result`: oriented photographs; `names`: of all photographs; `discs`: pixels, of
    each of them."""
    search = _Search(result, names, discs, settings)
    # Six and more rays at once: a disc is within a pixel of a place by chance with a probability of
    # 3e-4 (240 discs in 2000 × 1333 pixels), so four photographs confirm no wrong crossing.
    for min_rays in range(min(len(search.rows), 6), settings.min_rays - 1, -1):
        search.accept(min_rays)
    rows = np.array(search.found, int).reshape(-1, 3)
    return rows[:, 0], rows[:, 1], rows[:, 2]


def name_uncoded(
    discs_of_points: tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Int[np.ndarray, " n"]],
    discs: Places,
    sigma: Places,
) -> NamedMeasurements:
    """The measurements of uncoded targets, named u1, u2, …"""
    image, disc, point = discs_of_points
    pick = lambda of_images: np.array(
        [of_images[k][d] for k, d in zip(image, disc)], float
    ).reshape(-1, 2)
    return NamedMeasurements(image, tuple(f"u{p}" for p in point), pick(discs), pick(sigma))


class _Search:
    """Rays of the discs of the oriented photographs, and which are used already."""

    def __init__(
        self, result: Adjustment, names: Sequence[str], discs: Places, settings: UncodedSettings
    ):
        network, values = result.network, result.image_values
        place = {name: k for k, name in enumerate(names)}
        self.settings = settings
        self.rows = [place[id] for id in network.images.id]
        self.X0, self.M = values[:, :3], np.asarray(batched.matrices(values[:, 3:]))
        cameras = [
            dataclasses.replace(c, parameters=result.camera_parameters(c.id))
            for c in network.cameras
        ]
        camera_of_image = [cameras[c] for c in network.images.camera]
        self.ideal = [
            ideal_features(camera, discs[k]) for camera, k in zip(camera_of_image, self.rows)
        ]
        self.pixel = 1 / np.array([central_distance(camera) for camera in camera_of_image])
        self.ray = [self._rays(k) for k in range(len(self.rows))]
        self.free: list[Bool[np.ndarray, " _"]] = [
            np.asarray(np.isfinite(xy).all(1)) for xy in self.ideal
        ]
        self.there = [np.flatnonzero(free) for free in self.free]
        self.tree = [
            KDTree(xy[rows]) if len(rows) else None for xy, rows in zip(self.ideal, self.there)
        ]
        self.found: list[tuple[int, int, int]] = []
        self.points = 0

    def _rays(self, k: int) -> Float[np.ndarray, "n 3"]:
        """Directions in the object to the discs of a photograph."""
        xy = self.ideal[k]
        d = np.concatenate([xy, -np.ones((len(xy), 1))], 1) @ self.M[k]
        return d / np.linalg.norm(d, axis=1, keepdims=True)

    def accept(self, min_rays: int) -> None:
        """Accept the points with at least `min_rays` rays, pair by pair."""
        n = len(self.rows)
        for i in range(n):
            for j in range(i + 1, n):
                X = self._cross(i, j)
                if not len(X):
                    continue
                hits, misfit = self._confirm(X)
                rays = (hits >= 0).sum(1)
                # Of two that share a disc the one with more rays, of as many the closer one.
                for row in np.lexsort((misfit, -rays)):
                    if rays[row] < min_rays:
                        break
                    self._take(hits[row], min_rays)

    def _cross(self, i: int, j: int) -> Float[np.ndarray, "m 3"]:
        """Points where free rays of two photographs meet within the tolerance."""
        a, b = np.flatnonzero(self.free[i]), np.flatnonzero(self.free[j])
        if not len(a) or not len(b):
            return np.zeros((0, 3))
        base = self.X0[j] - self.X0[i]
        if not np.linalg.norm(base) > 0:
            return np.zeros((0, 3))
        # The angle of a ray with the epipolar plane of the other, in pixels of the photograph.
        planes = np.cross(self.ray[i][a], base)
        planes /= np.maximum(np.linalg.norm(planes, axis=1, keepdims=True), np.finfo(float).tiny)
        distance = np.abs(planes @ self.ray[j][b].T) / self.pixel[j]
        cosine = np.abs(self.ray[i][a] @ self.ray[j][b].T)
        is_near = (distance < self.settings.tolerance) & (cosine < np.cos(self.settings.min_angle))
        p, q = np.nonzero(is_near)
        u, v = self.ray[i][a[p]], self.ray[j][b[q]]
        # The point midway between two rays: from the normal equations of both distances.
        c = (u * v).sum(1)
        s = ((u - c[:, None] * v) @ base) / (1 - c**2)
        t = ((c[:, None] * u - v) @ base) / (1 - c**2)
        X = (self.X0[i] + s[:, None] * u + self.X0[j] + t[:, None] * v) / 2
        return X[(s > 0) & (t > 0)]

    def _confirm(
        self, X: Float[np.ndarray, "m 3"]
    ) -> tuple[Int[np.ndarray, "m images"], Float[np.ndarray, " m"]]:
        """The free disc of every photograph where each point is expected, −1: none; and the mean
        distance from there, pixels."""
        hits = np.full((len(X), len(self.rows)), -1)
        misfit = np.zeros(len(X))
        for k, tree in enumerate(self.tree):
            if tree is None:
                continue
            d = (X - self.X0[k]) @ self.M[k].T
            is_before = d[:, 2] < 0
            xy = np.where(
                is_before[:, None], -d[:, :2] / np.where(is_before, d[:, 2], 1)[:, None], 1e9
            )
            reach = self.settings.tolerance * self.pixel[k]
            distance, nearest = tree.query(xy, distance_upper_bound=reach)
            ok = np.isfinite(distance)
            row = self.there[k][np.where(ok, nearest, 0)]
            ok &= self.free[k][row]
            hits[ok, k] = row[ok]
            misfit[ok] += distance[ok] / self.pixel[k]
        return hits, misfit / np.maximum((hits >= 0).sum(1), 1)

    def _take(self, hits: Int[np.ndarray, " images"], min_rays: int) -> None:
        """Make a point of the discs that are still free, if these are enough."""
        free_discs = [(k, d) for k, d in enumerate(hits.tolist()) if d >= 0 and self.free[k][d]]
        if len(free_discs) < min_rays:
            return
        self.points += 1
        for k, d in free_discs:
            self.free[k][d] = False
            self.found.append((self.rows[k], d, self.points))
