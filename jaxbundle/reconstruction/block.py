"""What a surveyor asks of a reconstructed block: scale, height, area, overlap, camera positions."""

import dataclasses
import datetime
import re
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.adjustment.result import Adjustment
from jaxbundle.network.kinds import Antennas
from jaxbundle.orientation import batched
from jaxbundle.photographs.exif import Exif
from jaxbundle.report.layout import significant
from jaxbundle.system.clock import in_words, now
from jaxbundle.tiepoints.verified_pairs import central_distance


@dataclasses.dataclass(frozen=True)
class CameraPositions:
    """Given positions of photographs: adjusted minus given without the `offset` of their system,
    by photograph; the offset against control with its σ (NaN: none was estimated); `sigma`, the
    median of those given."""

    difference: Mapping[str, Float[np.ndarray, "3"]]
    sigma: Float[np.ndarray, "3"]
    offset: Float[np.ndarray, "3"]
    offset_sigma: Float[np.ndarray, "3"]

    @property
    def rms(self) -> Float[np.ndarray, "3"]:
        """RMS of the differences."""
        return np.sqrt(np.mean(np.square([*self.difference.values()]), 0))

    def contradictions(self, prior: Sequence[float], unit: str) -> list[str]:
        """How the positions contradict control and their own σ, in words; `prior`: σ of the
        offset before the adjustment."""
        sentences, limit = [], 3.0  # σ: by chance one in 370 for an offset, less for an RMS
        for axis, value, s in zip("XYZ", self.offset, prior):
            if np.isfinite(value) and abs(value) > limit * s:
                sentences.append(
                    f"satellite positions and control contradict each other: their offset "
                    f"in {axis} is {value:+.1f} {unit}, its prior σ {s:g} {unit}; compare "
                    "their coordinate systems"
                )
        for axis, value, s in zip("XYZ", self.rms, self.sigma):
            if value > limit * s:
                numbers = f"{significant(value)} {unit}, their σ {significant(s)} {unit}"
                sentences.append(
                    f"satellite positions contradict the photographs: RMS in {axis} {numbers}"
                )
        return sentences


@dataclasses.dataclass(frozen=True)
class BlockFacts:
    """Facts about an adjusted block. Lengths in the object unit; None: not defined, without a
    vertical or in an oblique block."""

    photographs: int
    taken: tuple[datetime.datetime, datetime.datetime] | None
    computed: datetime.datetime
    system: str
    unit: str
    ground_sample_distance: float
    object_distance: float
    flying_height: float | None
    area: float | None
    rays_per_point: float
    points_per_photograph: float
    photographs_per_place: float | None
    positions: CameraPositions | None

    @property
    def epsg(self) -> str:
        """The code of the coordinate system, EPSG:NUMBER; empty if it has none."""
        code = re.match(r"EPSG:\d+", self.system)
        return code[0] if code else ""

    def facts(self) -> list[tuple[str, str]]:
        """Names and values in words."""
        area = self.unit + "²"
        rows = [("Photographs", str(self.photographs))]
        if self.taken is not None:
            begin, end = (t.strftime("%Y-%m-%d %H:%M") for t in self.taken)
            rows.append(("Taken", begin if begin == end else f"{begin} to {end}"))
        rows += [
            ("Computed", in_words(self.computed)),
            ("Coordinate system", self.system),
            (
                "Ground sample distance",
                f"{significant(self.ground_sample_distance)} {self.unit} per pixel, median",
            ),
            ("Distance to the object", f"{significant(self.object_distance)} {self.unit}, median"),
        ]
        if self.flying_height is not None:
            height = significant(self.flying_height)
            rows.append(("Flying height", f"{height} {self.unit} above the ground, median"))
        if self.area is not None:
            rows.append(("Area covered", f"{significant(self.area)} {area}, of the tie points"))
        overlap = (
            f"{self.rays_per_point:.1f} rays per tie point, "
            f"{self.points_per_photograph:.0f} tie points per photograph"
        )
        if self.photographs_per_place is not None:
            overlap += f", each place in {self.photographs_per_place:.1f} photographs"
        rows.append(("Overlap", overlap))
        return rows + self._position_facts()

    def _position_facts(self) -> list[tuple[str, str]]:
        if self.positions is None:
            return [("Camera positions", "none in the files were used")]
        axes = lambda values: " ".join(
            f"{a} {significant(v)}" for a, v in zip("XYZ", values) if np.isfinite(v)
        )
        p = self.positions
        rows = [
            (
                "Camera positions",
                f"{len(p.difference)} in the files, RMS of adjusted − given {axes(p.rms)} "
                f"{self.unit} (σ {axes(p.sigma)})",
            )
        ]
        if np.isfinite(p.offset).any():
            offset = " ".join(
                f"{a} {v:+.3g} ± {significant(s, 2)}"
                for a, v, s in zip("XYZ", p.offset, p.offset_sigma)
                if np.isfinite(v)
            )
            rows.append(("Their offset", f"{offset} {self.unit}, positions minus control"))
        return rows

    def as_dict(self) -> dict:
        """The facts for JSON."""
        number = lambda x: None if x is None or not np.isfinite(x) else float(x)
        axes = lambda values: dict(zip("XYZ", map(number, values)))
        facts = {
            "photographs": self.photographs,
            "taken": None if self.taken is None else [t.isoformat() for t in self.taken],
            "computed": self.computed.isoformat(timespec="seconds"),
            "system": self.system,
        }
        names = (
            "ground_sample_distance",
            "object_distance",
            "flying_height",
            "area",
            "rays_per_point",
            "points_per_photograph",
            "photographs_per_place",
        )
        facts |= {name: number(getattr(self, name)) for name in names}
        if self.positions is None:
            return facts | {"camera_positions": None}
        p = self.positions
        return facts | {
            "camera_positions": {
                "rms": axes(p.rms),
                "sigma": axes(p.sigma),
                "offset": axes(p.offset),
                "offset_sigma": axes(p.offset_sigma),
                "difference": {id: axes(d) for id, d in p.difference.items()},
            }
        }


def describe_block(result: Adjustment, exif: Mapping[str, Exif], system: str) -> BlockFacts:
    """The facts of an adjusted block.

    **Arguments:** `exif` by photograph; `system` of the coordinates, empty: arbitrary."""
    network, X = result.problem.network, result.point_values
    X0, M = _orientations(result)
    image, point = _used_rays(result)
    # Within 45 degrees of the vertical: in an oblique block the middle of a photograph is not below
    # the camera, and footprints reach to the horizon.
    looks_down = bool(system) and float(np.median(M[:, 2, 2])) > 0.7
    height = area = places = None
    tie = network.points.has_role("tie")
    ground = X[np.unique(point[tie[point]])]
    if looks_down and len(ground) > 3:
        flying_heights = [
            X0[k, 2] - np.median(X[point[image == k], 2])
            for k in range(len(X0))
            if (image == k).any()
        ]
        height, area = float(np.median(flying_heights)), _hull_area(_inner(ground[:, :2]))
        # As much ground as the photographs cover, by how much there is.
        footprints = [_hull_area(_inner(X[point[image == k], :2])) for k in range(len(X0))]
        places = sum(footprints) / area if area else None
    times = [exif[id].time for id in network.images.id if id in exif]
    times_taken = sorted(t for t in times if t is not None)
    on_ties = tie[point]
    return BlockFacts(
        len(X0),
        (times_taken[0], times_taken[-1]) if times_taken else None,
        now(),
        system
        or (
            "local, to scale"
            if network.object_unit != "unit"
            else "arbitrary: neither control, satellite positions nor scale bars"
        ),
        network.object_unit,
        ground_sample_distance(result),
        float(np.nanmedian(_object_distances(result))),
        height,
        area,
        on_ties.sum() / max(len(ground), 1),
        on_ties.sum() / len(X0),
        places,
        camera_positions(result),
    )


def ground_sample_distance(result: Adjustment) -> float:
    """The length of a pixel of the adjusted cameras at the points, the median of the
    photographs."""
    network = result.problem.network
    cameras = (
        dataclasses.replace(c, parameters=result.camera_parameters(c.id)) for c in network.cameras
    )
    c = np.array([central_distance(camera) for camera in cameras])
    return float(np.nanmedian(_object_distances(result) / c[network.images.camera]))


def _object_distances(result: Adjustment) -> Float[np.ndarray, " images"]:
    """The median depth of the points of every photograph; NaN without points."""
    X, (X0, M), (image, point) = result.point_values, _orientations(result), _used_rays(result)
    depth = -np.einsum("nj,nj->n", M[image, 2], X[point] - X0[image])
    # By photograph first: one with many points does not decide for all.
    return np.array(
        [np.median(depth[image == k]) if (image == k).any() else np.nan for k in range(len(X0))]
    )


def _orientations(
    result: Adjustment,
) -> tuple[Float[np.ndarray, "images 3"], Float[np.ndarray, "images 3 3"]]:
    """Projection centres and rotation matrices."""
    values = result.image_values
    return values[:, :3], np.asarray(batched.matrices(values[:, 3:]))


def _used_rays(result: Adjustment) -> tuple[Int[np.ndarray, " rays"], Int[np.ndarray, " rays"]]:
    """Image and point of the measurements that take part, of points with a position."""
    problem = result.problem
    is_used = problem.used & np.isfinite(result.point_values[problem.point]).all(1)
    return problem.image[is_used], problem.point[is_used]


def _inner(xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
    """The points without 1 % beyond each side, which may be far away by a gross error."""
    if len(xy) < 4:
        return xy
    low, high = np.quantile(xy, [0.01, 1 - 0.01], axis=0)
    return xy[((xy >= low) & (xy <= high)).all(1)]


def _hull_area(xy: Float[np.ndarray, "n 2"]) -> float:
    """The area of the convex hull (monotone chain; Andrew 1979)."""
    if len(xy) < 3:
        return 0.0
    ordered = sorted(map(tuple, xy.tolist()))

    def half(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
        chain: list[tuple[float, float]] = []
        for p in points:
            while len(chain) > 1 and (
                (chain[-1][0] - chain[-2][0]) * (p[1] - chain[-2][1])
                <= (chain[-1][1] - chain[-2][1]) * (p[0] - chain[-2][0])
            ):
                chain.pop()
            chain.append(p)
        return chain[:-1]

    x, y = np.array([*half(ordered), *half(ordered[::-1])]).T
    x, y = x - x[0], y - y[0]  # map coordinates have 7 digits, whose products would cancel
    return 0.5 * abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))


def camera_positions(result: Adjustment) -> CameraPositions | None:
    """Given positions against the adjusted ones: antennas with the shift of their system, or
    priors of the images."""
    network, X0 = result.problem.network, result.image_values[:, :3]
    nothing = np.full(3, np.nan)
    antennas = next((table for table in network.further if isinstance(table, Antennas)), None)
    if antennas is not None:
        # The shift of the one strip is the offset of the system; not estimated axes have none.
        row = {id: k for k, id in enumerate(network.images.id)}
        (strip,) = result.further_unknowns.get("GNSS strip", {"": {}}).values()
        shifts = [strip.get(f"shift {axis}", {}) for axis in "XYZ"]
        shift = np.array([estimate.get("value", 0.0) for estimate in shifts])
        sigma = np.array([estimate.get("sigma") or np.nan for estimate in shifts])
        offset = np.where(np.isfinite(sigma), shift, np.nan)
        positions_given = zip(antennas.image, antennas.position)
        difference = {id: X0[row[id]] + shift - X for id, X in positions_given if id in row}
        s = np.median(np.sqrt(np.diagonal(antennas.covariance, axis1=1, axis2=2)), axis=0)
        return CameraPositions(difference, s, offset, sigma) if difference else None
    images = network.images
    has_position = (np.isfinite(images.sigma[:, :3]) & (images.sigma[:, :3] > 0)).all(1)
    if not has_position.any():
        return None
    difference = {images.id[k]: X0[k] - images.position[k] for k in np.flatnonzero(has_position)}
    s = np.median(images.sigma[has_position, :3], axis=0)
    return CameraPositions(difference, s, nothing, nothing)
