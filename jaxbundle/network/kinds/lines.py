"""Image points on straight lines of object space: table `edges`.

A measured point is anywhere on the image of a line, without corresponding points in other images.
The residual is the distance of the corrected image point from the projected line, in the plane of
the ideal image, in the unit of the image coordinates (Mulawa and Mikhail 1988; Schmid and Zisserman
1997):

    n = (M·(A − X0)) × (M·d)        v = c·(n·r)/(r_z·√(n_x² + n_y²))

A a point of the line, d its direction, r the ray of the image point without distortion.

Columns: `line` (its name), `image`, `x`, `y` in the image unit, `sigma` of the distance (that of
image points if absent). Start values: the best intersection line of the planes through the points
of two or more images.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxbundle import cameras
from jaxbundle.errors import InputError
from jaxbundle.geometry import quaternion_from_matrix
from jaxbundle.geometry.principal_axes import principal_axes
from jaxbundle.geometry.rotations import matrix_from_omega_phi_kappa
from jaxbundle.geometry.vectors import cross
from jaxbundle.leastsquares.datum.motions import move_pose
from jaxbundle.leastsquares.declarations import Kind, Table
from jaxbundle.leastsquares.spaces import Change, Frame, Posed, PoseValue
from jaxbundle.network.camera_tables import camera_tables, start_of
from jaxbundle.network.columns import Columns
from jaxbundle.network.kinds.base import Contribution, ObservationTable, positive_sigma, rows_of
from jaxbundle.network.tables import Network
from jaxbundle.network.units import from_image_unit

LINE = "object line"


@dataclasses.dataclass(frozen=True)
class OnLine:
    """The residual of an image point of a camera of this model."""

    model: str | cameras.CameraModel

    def __call__(self, pose: Posed, interior: Change, line: Posed, xy: Change) -> Change:
        model = cameras.get_model(self.model)
        # The plane through the projection centre and the line has the normal n = (P − X0) ×
        # direction; a ray r in it has n·r = 0. Divided by its length across, and at the distance c,
        # this is the distance of the image point from the image of the line.
        direction = pose.rotation.apply(line.rotation.apply_inverse((0.0, 0.0, 1.0)))
        n = cross(pose.ray(line.centre), direction)
        r = cameras.image_ray(model, interior, *xy)
        c = interior[model.parameters.index(model.principal_distance[0])]
        normal_length = (n[0] ** 2 + n[1] ** 2) ** 0.5
        return (c * sum(a * b for a, b in zip(n, r)) / (r[2] * normal_length),)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Edges(ObservationTable):
    """Image points of lines, in the unit of the network's image coordinates; σ NaN: that of image
    points."""

    line: tuple[str, ...]
    image: tuple[str, ...]
    xy: Float[np.ndarray, "n 2"]
    sigma: Float[np.ndarray, " n"]

    TABLE, IMAGES = "edges", ("image",)

    @classmethod
    def from_columns(cls, table: Columns, settings: Mapping[str, Any], radians: float) -> "Edges":
        table.check_names(("line", "image", "x", "y"), ("sigma",))
        xy = np.stack([table.numbers(name, required=True) for name in "xy"], 1)
        return cls(
            line=table.ids("line"),
            image=table.ids("image"),
            xy=xy,
            sigma=positive_sigma(table, "sigma", required=False),
            source=table.source,
        )

    def columns(self, radians: float) -> dict:
        return {
            "line": self.line,
            "image": self.image,
            "x": self.xy[:, 0],
            "y": self.xy[:, 1],
            "sigma": self.sigma,
        }

    def declare(self, network: Network, origin: Float[np.ndarray, "3"]) -> Contribution:
        images = network.images
        image = rows_of(self.image, images)
        camera = images.camera[image]
        sigma = np.where(np.isnan(self.sigma), np.median(network.observations.sigma), self.sigma)
        unit = network.image_unit if network.image_unit in ("mm", "px") else "mm"
        sigma_xy = np.stack([self.sigma] * 2, 1)
        xy, converted_sigma = from_image_unit(network.cameras, camera, self.xy, sigma_xy, unit)
        sigma = np.where(np.isnan(self.sigma), sigma, converted_sigma[:, 0])
        names, line = np.unique(np.array(self.line, dtype=object), return_inverse=True)
        start = [
            self._start(network, origin, np.flatnonzero(line == k), image, xy)
            for k in range(len(names))
        ]
        centre, rotation = (np.array(x) for x in zip(*start))
        lines = Table(
            LINE,
            PoseValue(centre, rotation),
            Frame((0, 1, 3, 4)),  # neither along the line nor about it, which moves no point of it
            labels=list(names),
            parameters=("shift x", "shift y", "turn x", "turn y"),
            title="line",
        )
        observed = []
        for table in camera_tables(network.cameras):
            rows = np.flatnonzero(np.isin(camera, table.cameras))
            if not len(rows):
                continue
            place = {int(c): k for k, c in enumerate(table.cameras)}
            of_camera = np.array([place[int(c)] for c in camera[rows]], int)
            kind = Kind(
                "edges",
                OnLine(table.model),
                ("image", table.name, LINE),
                ("across",),
                "image",
                scalars=True,
                invariant=True,
            )
            observed.append(kind((image[rows], of_camera, line[rows]), xy[rows], sigma=sigma[rows]))
        return Contribution((lines,), observed, ((LINE, move_pose),))

    def _start(
        self,
        network: Network,
        origin: Float[np.ndarray, "3"],
        rows: Int[np.ndarray, " k"],
        image: Int[np.ndarray, " n"],
        xy: Float[np.ndarray, "n 2"],
        min_angle: float = 1e-3,
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"]]:
        """The intersection of the planes of the images: a point, and a rotation whose last row is
        the direction. `min_angle` between the planes, radians: closer ones intersect in a line
        whose direction is mostly noise."""
        normals, plane_offsets = [], []
        for i in np.unique(image[rows]):
            line_rows = rows[image[rows] == i]
            # Two points of the line in an image give a plane; one point only helps the adjustment.
            if len(line_rows) < 2:
                continue
            c = network.images.camera[i]
            table = next(t for t in camera_tables(network.cameras) if c in t.cameras)
            p = tuple(start_of(network.cameras[c]))
            r = np.stack(
                [
                    np.asarray(x)
                    for x in cameras.image_ray(cameras.get_model(table.model), p, *xy[line_rows].T)
                ],
                1,
            )
            M = np.asarray(matrix_from_omega_phi_kappa(network.images.angles[i]))
            normals.append(principal_axes(r @ M)[1][-1])
            plane_offsets.append(normals[-1] @ (network.images.position[i] - origin))
        n = np.array(normals).reshape(-1, 3)
        size, Vt = principal_axes(n)
        if len(n) < 2 or size[1] < min_angle:
            raise InputError(
                f"{self.source(rows[0])}: line {self.line[rows[0]]!r} needs two points in each of "
                "two images that do not see it in one plane"
            )
        A = np.linalg.lstsq(n, np.array(plane_offsets), rcond=min_angle)[0]
        y = np.cross(Vt[2], Vt[0])
        return A, np.asarray(quaternion_from_matrix(np.stack([Vt[0], y, Vt[2]])))
