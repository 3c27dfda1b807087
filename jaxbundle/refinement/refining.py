"""Refinement of scanner images by control and tie points, with photographs in the same equations.

`refine` puts tables in and a `Refinement` out: least squares with the unknowns of `freedom`, the
equations of `equations`, statistics, blunders, check points, warnings, and the refined images.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxbundle.configuration import enable_x64
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid, geodetic
from jaxbundle.network.tables import Network, Observations
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.refinement.build import (
    Columns,
    Rays,
    check_input,
    check_near,
    choose_rays,
    make_columns,
    make_system,
)
from jaxbundle.refinement.check_points import CheckPoints, intersect
from jaxbundle.refinement.equations import compiled_image_residuals, positions, vector_of
from jaxbundle.refinement.freedom import change_of
from jaxbundle.refinement.inspection import Blunder, Inspection, adjust, snoop
from jaxbundle.refinement.refined import refined_image
from jaxbundle.refinement.tables import GroundPoints, ScannerImage, with_frames
from jaxbundle.refinement.weakness import weaknesses
from jaxbundle.statistics.correlation import correlation_matrix

TESTS = ("none", "baarda", "pope")


@dataclasses.dataclass(frozen=True)
class Refinement:
    """The result: `inspection` holds the numbers, `columns` the names of the shared unknowns.

    `rays`: which measurements took part, image by image in the order of `inspection`'s rows.
    """

    images: tuple[ScannerImage, ...]
    points: GroundPoints
    observations: Observations
    frames: Network | None
    columns: Columns
    rays: Rays
    inspection: Inspection
    removed: tuple[Blunder, ...]
    check: CheckPoints | None
    warnings: tuple[str, ...]

    @property
    def sigma0(self) -> float:
        """σ0 a posteriori."""
        return self.inspection.sigma0

    @property
    def redundancy(self) -> int:
        """Observations and priors less unknowns."""
        return self.inspection.redundancy

    @property
    def estimate(self) -> Float[np.ndarray, " m"]:
        """The changes of the shared unknowns, in the units of `freedom`."""
        return np.asarray(self.inspection.unknowns.shared)

    @property
    def covariance(self) -> Float[np.ndarray, "m m"]:
        """Of `estimate`, with σ0 a posteriori."""
        return self.inspection.sigma0**2 * self.inspection.cofactor

    @property
    def correlation(self) -> Float[np.ndarray, "m m"]:
        """Of `estimate`."""
        return correlation_matrix(self.inspection.cofactor)

    @property
    def positions(self) -> Float[np.ndarray, "points 3"]:
        """Adjusted coordinates of the points of `rays.points`."""
        return np.asarray(positions(self.inspection.system, self.inspection.unknowns))

    def image(self, id: str) -> PushbroomImage:
        """A refined scanner image, for `locate`, `project` and the correction."""
        at = {one.id: k for k, one in enumerate(self.images)}
        if id not in at:
            raise InputError(f"no scanner image {id!r}; there are {', '.join(at)}")
        k = at[id]
        rays, form = self.inspection.system.scanners[k], self.columns.forms[k]
        change = change_of(form, vector_of(rays, self.inspection.unknowns.shared))
        return refined_image(self.images[k].image, form, change)

    def image_points(self) -> list[dict]:
        """A row for every image point that took part: ids, v, σ of it, r and w of both
        coordinates, whether it was removed."""
        found, rows = self.inspection, []
        v = compiled_image_residuals(found.system, found.unknowns)
        ids = [one.id for one in self.images]
        ids += [] if self.frames is None else list(self.frames.images.id)
        start = 0
        for id, rays, residual in zip(ids, found.system.rays, v):
            end = start + 2 * len(rays.point)
            r, w = (x[start:end].reshape(-1, 2) for x in (found.r, found.w))
            used = (np.asarray(rays.weight) > 0).any(1)
            for k, p in enumerate(np.asarray(rays.point)):
                rows.append({
                    "image": id, "point": self.points.id[self.rays.points[p]],
                    "v": np.asarray(residual)[k], "r": r[k], "w": w[k], "removed": not used[k],
                })  # fmt: skip
            start = end
        return rows


def refine(
    images: Sequence[ScannerImage],
    points: GroundPoints,
    observations: Observations,
    frames: Network | None = None,
    *,
    snooping: str = "none",
    significance: float = 0.001,
) -> Refinement:
    """Adjust scanner images, and photographs that share points with them.

    **Arguments:**

    - `observations` of the scanner images: `xy` are line and pixel, `sigma` theirs.
    - `frames`: a network in the same object frame; its points are joined by their ids to `points`,
      its exterior orientations have priors, are held (σ 0) or free (NaN).
    - `snooping`: `"none"`, `"baarda"` (σ a priori, every observation by itself) or `"pope"` (σ a
      posteriori, the largest of all), with the `significance` α, two-sided.

    **Raises:** `InputError` for what cannot be used, with its row; `NotSolvedError` where the
    unknowns are not determined, with their names.
    """
    enable_x64()
    if snooping not in TESTS:
        raise InputError(f"snooping {snooping!r}; one of {', '.join(TESTS)} is expected")
    images = list(images)
    points = with_frames(points, frames)
    check_input(images, points, observations, frames)
    points = _checks_upright(points, images[0].earth)
    columns = make_columns(images, frames)
    rays, check_rays, warnings = choose_rays(points, observations, frames)
    if frames is not None and len(frames.distances):
        warnings.append("distances of the photographs' project take no part")
    system = make_system(images, points, observations, frames, columns, rays)
    check_near(system, images, points, observations, rays)
    weak = lambda system, unknowns: [
        w.sentence for w in weaknesses(system, unknowns, columns)
    ]
    found, removed = adjust(system, system.start(), weak), []
    if snooping != "none":
        found, removed = snoop(found, snooping, significance, weak)
    for sentence in weak(found.system, found.unknowns):
        warnings.append(f"{sentence}; what keeps them apart are priors, if any")
    check = None
    if len(check_rays.points):
        other = make_system(images, points, observations, frames, columns, check_rays)
        check_near(other, images, points, observations, check_rays)
        check = intersect(other, found, tuple(points.id[k] for k in check_rays.points))
    return Refinement(
        tuple(images), points, observations, frames, columns, rays, found, tuple(removed), check,
        tuple(warnings),
    )  # fmt: skip


def _checks_upright(points: GroundPoints, earth: Ellipsoid | None) -> GroundPoints:
    """The axes of check points made east, north, up, for what is at a given height."""
    if earth is None or earth.a != earth.b:
        return points
    axes = points.axes.copy()
    for k, role in enumerate(points.role):
        if role == "check":
            axes[k] = east_north_up(earth, points.X[k])
    return dataclasses.replace(points, axes=axes)


def east_north_up(earth: Ellipsoid, X: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The axes east, north and up at a point, as rows."""
    longitude, latitude, _ = (float(v) for v in geodetic(earth, tuple(X)))
    s, c, z, k = np.sin(longitude), np.cos(longitude), np.sin(latitude), np.cos(latitude)
    return np.array([[-s, c, 0], [-z * c, -z * s, k], [k * c, k * s, z]])
