"""Refracting interfaces between cameras and points: table `interfaces`.

    interface,type,camera,Z,index,thickness,index_window,sZ,sindex
    left window,flat,left,-0.030,1.334,0.008,1.49,0.002,free

| interface | frame | unknowns |
|---|---|---|
| flat port: a window of a housing, one or two parallel planes | of its camera | shift along the
  normal, two tilts |
| dome port: two concentric spheres | of its camera | X, Y, Z of the centre: the decentring |
| flat without a camera, such as a water surface | object space | as of a flat port |

and of each the indices of refraction, the thickness of the window, the radius of a dome. The image
point is that of the ray which Snell's law bends (`geometry.refraction`). What is not behind the
interface, such as a control point above the water, is seen straight.

Columns: `interface` (its name), `type` ("flat" or "dome"), `camera` (empty: in object space, before
all cameras); `X`, `Y`, `Z`, a point of the plane that is nearer to the camera, or the centre of the
dome (0 if not given); of flat ones `omega`, `phi`: the plane has the normal that the z axis of an
image with these angles has, which points to the camera; 0 is a plane parallel to the image, or a
horizontal one. `index` at the points, `index_camera` at the camera (1), `index_window` and
`thickness` of the layer between (none), `radius` of the inner sphere of a dome. Each has a σ,
`sindex`, …: a number (the value is observed with it), `free`, or empty (held). Of a plane `sZ` is
the σ along its normal.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbundle import cameras
from jaxbundle.errors import InputError
from jaxbundle.geometry.quaternions import quaternion_from_matrix
from jaxbundle.geometry.refraction import refract_dome, refract_flat
from jaxbundle.geometry.rotations import matrix_from_omega_phi_kappa
from jaxbundle.leastsquares.datum.motions import move_pose, scale_length, scale_position
from jaxbundle.leastsquares.declarations import Kind, ObservationSet, Table
from jaxbundle.leastsquares.spaces import Change, Frame, Posed, PoseValue, Triple, Vector
from jaxbundle.network.columns import Columns, did_you_mean, is_missing
from jaxbundle.network.kinds.base import (
    Contribution,
    ObservationTable,
    computed_minus_given,
    refuse_unusable,
)
from jaxbundle.network.rules import check_unique
from jaxbundle.network.tables import Network

TYPES = ("flat", "dome")
PLACE, TILT = ("X", "Y", "Z"), ("omega", "phi")
MEDIUM = ("index_camera", "index_window", "index", "thickness", "radius")
COLUMNS = (*PLACE, *TILT, *MEDIUM)
INDICES = tuple(map(COLUMNS.index, MEDIUM[:3]))
# From vacuum to diamond.
SMALLEST_INDEX, LARGEST_INDEX = 1.0, 2.5
# The tables of what is unknown of the geometry, one network has one of them, and of the media.
SURFACE, PORT, DOME, MEDIA = "interface", "flat port", "dome port", "medium"
PLANE = ("shift z", "turn x", "turn y")
# What a camera without an interface looks through, in the same tables: an interface in its
# projection centre, which bends nothing.
NO_INTERFACE = np.array([0.0] * 5 + [1.0, 1.0, 1.0, 0.0, 1.0])


@dataclasses.dataclass(frozen=True)
class Refraction:
    """The direction in the camera in which it sees a point, through what `table` holds."""

    table: str

    def __call__(self, pose: Posed, interface: Any, medium: Change, point: Triple) -> Any:
        indices, thickness = (medium[0], medium[1], medium[2]), medium[3]
        if self.table == DOME:
            ray, centre = pose.ray(point), tuple(interface)
            return refract_dome(ray, centre, medium[4], thickness, indices)
        # z of the frame points to the camera, the normal to the points.
        z = interface.rotation.apply_inverse((0.0, 0.0, 1.0))
        normal = tuple(-x for x in z)
        if self.table == PORT:
            ray, plane_point = pose.ray(point), interface.centre
            distance = sum(n * x for n, x in zip(normal, plane_point))
            return refract_flat(ray, normal, distance, thickness, indices)
        ray = tuple(a - b for a, b in zip(point, pose.centre))
        plane_point = (a - b for a, b in zip(interface.centre, pose.centre))
        distance = sum(n * x for n, x in zip(normal, plane_point))
        return pose.rotation.apply(refract_flat(ray, normal, distance, thickness, indices))


def plane_minus_given(frame: Posed, prior: tuple[Array, Array]) -> Float[Array, "3"]:
    """The shift of a plane along its normal, and its tilts, against the given point and rotation.
    Of the plane alone, not of where its frame is on it, which has no derivative."""
    X0, M = prior
    z = jnp.stack(frame.rotation.apply_inverse((0.0, 0.0, 1.0)))
    x, y, _ = M @ z
    return jnp.stack([z @ (jnp.stack(frame.centre) - X0), y, -x])


PLANE_PRIOR = ("length", "angle", "angle")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Interfaces(ObservationTable):
    """Interfaces: values and σ of `COLUMNS`, radians; σ NaN: held, infinite: free; a camera "": in
    object space."""

    interface: tuple[str, ...]
    type: tuple[str, ...]
    camera: tuple[str, ...]
    value: Float[np.ndarray, "n 10"]
    sigma: Float[np.ndarray, "n 10"]

    TABLE = "interfaces"
    CHANGES_IMAGE_POINTS = True

    @classmethod
    def from_columns(
        cls, table: Columns, settings: Mapping[str, Any], radians: float
    ) -> "Interfaces":
        sigmas = tuple(f"s{name}" for name in COLUMNS)
        table.check_names(("interface", "type", "index"), ("camera", *COLUMNS, *sigmas))
        unit = np.where([name in TILT for name in COLUMNS], radians, 1.0)
        value = np.stack([table.numbers(name) for name in COLUMNS], 1) * unit
        words = {"free": np.inf}
        sigma = np.stack([table.numbers(name, words=words) for name in sigmas], 1)
        for name, column in zip(sigmas, sigma.T):
            refuse_unusable(table, name, column)
        cells = table.values.get("camera", [None] * len(table))
        interfaces = cls(
            interface=table.ids("interface"),
            type=table.ids("type"),
            camera=tuple("" if is_missing(cell) else str(cell).strip() for cell in cells),
            value=value,
            sigma=sigma * unit,
            source=table.source,
        )
        for row in range(len(interfaces)):
            interfaces._check_row(row)
        check_unique(interfaces.interface, interfaces.source, "interface")
        value = np.where(np.isnan(value), NO_INTERFACE, value)
        # A layer of thickness 0 has the index behind it: its two planes are one.
        window, thickness = COLUMNS.index("index_window"), COLUMNS.index("thickness")
        is_single_plane = value[:, thickness] == 0
        value[is_single_plane, window] = value[is_single_plane, COLUMNS.index("index")]
        return dataclasses.replace(interfaces, value=value)

    def _check_row(self, row: int) -> None:
        where, type = self.source(row), self.type[row]
        has_value = dict(zip(COLUMNS, ~np.isnan(self.value[row])))
        has_sigma = dict(zip(COLUMNS, ~np.isnan(self.sigma[row])))
        value = dict(zip(COLUMNS, self.value[row].tolist()))
        if type not in TYPES:
            raise InputError(f"{where}: type is {type!r}{did_you_mean(type, TYPES)}")
        layer = value["thickness"] > 0
        if has_value["index_window"] != layer or has_sigma["thickness"] and not layer:
            raise InputError(
                f"{where}: a window has a thickness, a positive number, and an index_window; "
                "expected both or neither"
            )
        # σ of what an interface of this type does not have
        absent_names = ("radius", "sX", "sY") if type == "flat" else (*TILT, "somega", "sphi")
        for name in absent_names:
            if has_value.get(name, False) or has_sigma.get(name[1:], False) and name[0] == "s":
                raise InputError(f"{where}: a {type} interface has no {name}")
        for name in ("radius", "index_window", "index_camera", "index", "thickness"):
            if has_sigma[name] and not has_value[name]:
                raise InputError(f"{where}: s{name} is given, but no {name}")
        self._check_indices(row)
        if type == "dome":
            self._check_dome(row)
        elif self.camera[row]:
            self._check_port(row)

    def _check_indices(self, row: int) -> None:
        for name, value in zip(MEDIUM[:3], self.value[row, 5:8].tolist()):
            if not (np.isnan(value) or SMALLEST_INDEX <= value <= LARGEST_INDEX):
                raise InputError(
                    f"{self.source(row)}: {name} is {value:g}; expected an index of refraction "
                    f"relative to vacuum, {SMALLEST_INDEX:g} to {LARGEST_INDEX:g} (water 1.33, "
                    "glass 1.5)"
                )
        if np.isnan(self.value[row, 7]):
            raise InputError(
                f"{self.source(row)}: index is missing, the index of refraction at the points"
            )

    def _check_dome(self, row: int) -> None:
        where, radius = self.source(row), self.value[row, 9]
        if not self.camera[row]:
            raise InputError(f"{where}: camera is missing: a dome is before one camera")
        if not radius > 0:
            raise InputError(f"{where}: radius is missing, of the inner sphere, positive")
        offset = np.linalg.norm(np.nan_to_num(self.value[row, :3]))
        if offset >= radius:
            raise InputError(
                f"{where}: the camera is {offset:g} from the centre of its dome, outside of the "
                f"radius {radius:g}; X, Y, Z are relative to the camera"
            )

    def _check_port(self, row: int) -> None:
        plane = np.nan_to_num(self.value[row, :5])
        M = np.asarray(matrix_from_omega_phi_kappa(np.append(plane[3:], 0.0)))
        distance = -M[2] @ plane[:3]
        if not distance > 0:
            raise InputError(
                f"{self.source(row)}: the plane is {distance:g} before the camera; expected a "
                "positive distance: the camera looks along −z, so that Z is negative"
            )

    def columns(self, radians: float) -> dict[str, Sequence[Any]]:
        unit = np.where([name in TILT for name in COLUMNS], radians, 1.0)
        columns: dict = {"interface": self.interface, "type": self.type, "camera": self.camera}
        is_flat = np.array([type == "flat" for type in self.type])
        is_single_plane = self.value[:, COLUMNS.index("thickness")] == 0
        for k, name in enumerate(COLUMNS):
            is_absent = (is_single_plane & (name in ("index_window", "thickness"))) | (
                is_flat if name == "radius" else ~is_flat & (name in TILT)
            )
            columns[name] = np.where(is_absent, np.nan, self.value[:, k] / unit[k])
        for k, name in enumerate(COLUMNS):
            sigma = (self.sigma[:, k] / unit[k]).tolist()
            columns[f"s{name}"] = [x if np.isfinite(x) else "free" if x > 0 else x for x in sigma]
        return {name: x for name, x in columns.items() if not _is_empty(x)}

    def held_at(self, unknowns: Mapping[str, Mapping], radians: float) -> "Interfaces":
        """The interfaces held at the values of a result (`Adjustment.further_unknowns`)."""
        geometry, media = (unknowns[name] for name in (self._table(0), MEDIA))
        value = self.value.copy()
        for row, name in enumerate(self.interface):
            estimates = {k.removesuffix("0"): v["value"] for k, v in geometry[name].items()}
            estimates |= {k: v["value"] for k, v in media[name].items()}
            scale = {k: radians if k in TILT else 1.0 for k in COLUMNS}
            value[row] = [
                estimates[k] * scale[k] if k in estimates else old
                for k, old in zip(COLUMNS, value[row])
            ]
        return dataclasses.replace(self, value=value, sigma=np.full_like(self.sigma, np.nan))

    def __len__(self) -> int:
        return len(self.interface)

    def _included_rows(self, network: Network) -> np.ndarray:
        known_ids = {"", *(camera.id for camera in network.cameras)}
        return np.array([id in known_ids for id in self.camera], bool)

    def number_of_equations(self) -> int:
        return 0

    def check(self, network: Network) -> None:
        ids = [camera.id for camera in network.cameras]
        for row, id in enumerate(self.camera):
            if id and id not in ids:
                raise InputError(
                    f"{self.source(row)}: camera {id!r} is unknown{did_you_mean(id, ids)}"
                )
        tables = [self._table(row) for row in range(len(self))]
        for row, table in enumerate(tables):
            if table != tables[0]:
                raise InputError(
                    f"{self.source(row)}: a {table}, but a {tables[0]} in {self.source(0)}: "
                    "expected all interfaces of a network of one type"
                )
        camera_ids = [id for id in self.camera if id] if tables[0] != SURFACE else [*self.camera]
        if len({*camera_ids}) < len(camera_ids):
            raise InputError(
                f"{self.source.name}: two interfaces "
                + ("in object space" if tables[0] == SURFACE else "before one camera")
                + "; expected one (a window is one interface with a thickness)"
            )
        for further_table in network.further:
            if further_table.TABLE in ("velocities", "edges"):
                raise InputError(
                    f"{self.source.name}: {further_table.TABLE} are for straight rays; expected "
                    f"a network with either {self.TABLE} or {further_table.TABLE}"
                )

    def _table(self, row: int) -> str:
        """The table that holds the geometry of an interface."""
        return DOME if self.type[row] == "dome" else PORT if self.camera[row] else SURFACE

    @property
    def refraction(self) -> Refraction:
        """What bends the rays."""
        return Refraction(self._table(0))

    def rows_of_cameras(self, network: Network) -> Int[np.ndarray, " cameras"]:
        """The row of the tables for every camera; the one behind the last for cameras without."""
        if self._table(0) == SURFACE:
            return np.zeros(len(network.cameras), int)
        row = {id: k for k, id in enumerate(self.camera)}
        return np.array([row.get(camera.id, len(self)) for camera in network.cameras], int)

    def directions(self, camera: str, rays: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Rays of a camera behind its port, from the directions before it; for start values, which
        neglect that they do not meet in one point. NaN beyond total reflection."""
        for row in [row for row, id in enumerate(self.camera) if id == camera]:
            value = dict(zip(COLUMNS, self.value[row].tolist()))
            intersection, normal = np.zeros_like(rays), self._normal(row)
            for radius, n, n_next in (
                (value["radius"], value["index_camera"], value["index_window"]),
                (value["radius"] + value["thickness"], value["index_window"], value["index"]),
            ):
                if self.type[row] == "dome":
                    to_centre = self.value[row, :3] - intersection
                    projection = (rays * to_centre).sum(1)
                    discriminant = projection**2 - (to_centre**2).sum(1) + radius**2
                    intersection = (
                        intersection + rays * (projection + np.sqrt(discriminant))[:, None]
                    )
                    normal = (intersection - self.value[row, :3]) / radius
                rays = _refract(rays, normal, n / n_next)
        return rays

    def _normal(self, row: int) -> Float[np.ndarray, "3"]:
        """Of a flat interface, from the camera to the points."""
        return -np.asarray(matrix_from_omega_phi_kappa(np.append(self.value[row, 3:5], 0.0)))[2]

    def declare(self, network: Network, origin: Float[np.ndarray, "3"]) -> Contribution:
        name, labels = self._table(0), [*self.interface]
        value, sigma = self.value, self.sigma
        if (self.rows_of_cameras(network) == len(self)).any():
            value = np.concatenate([value, NO_INTERFACE[None]])
            sigma = np.concatenate([sigma, np.full((1, len(COLUMNS)), np.nan)])
            labels.append("none")
        if name == SURFACE:
            value = value - np.pad(origin, (0, len(COLUMNS) - 3))
        if name == DOME:
            geometry = Table(
                name, value[:, :3], Vector(3), ~np.isnan(sigma[:, :3]), labels, PLACE, name
            )
            sets, action = _observe(geometry, sigma[:, :3], "length"), scale_length
        else:
            geometry, sets = _planes(name, value, sigma, labels)
            action = move_pose if name == SURFACE else scale_position
        # A plane has no radius: one that is held would hold the scale.
        names = MEDIUM if name == DOME else MEDIUM[:-1]
        value, sigma = (x[:, 5 : 5 + len(names)] for x in (value, sigma))
        free = ~np.isnan(sigma)
        media = Table(MEDIA, value, Vector(len(names)), free, labels, names, "medium of")
        sets = (*sets, *_observe(media, sigma, ("", "", "", "length", "length")[: len(names)]))
        return Contribution((geometry, media), sets, ((name, action), (MEDIA, _scale_thicknesses)))


def _refract(
    rays: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "*n 3"], ratio: float
) -> Float[np.ndarray, "n 3"]:
    """Snell's law for unit vectors; `ratio` of the indices before and behind."""
    cosine = (rays * normal).sum(1, keepdims=True)
    with np.errstate(invalid="ignore"):
        behind = np.sqrt(1 - ratio**2 * (1 - cosine**2))
    return ratio * rays + (behind - ratio * cosine) * normal


def _is_empty(column: Any) -> bool:
    return all(x == "" or (not isinstance(x, str) and x != x) for x in column)


def _observe(
    table: Table, sigma: Float[np.ndarray, "rows n"], units: str | tuple[str, ...]
) -> tuple[ObservationSet, ...]:
    """Pseudo-observations of the start values of a table that have a σ."""
    rows = np.flatnonzero(np.isfinite(sigma).any(1))
    if not len(rows):
        return ()
    kind = Kind(
        f"prior of {table.name}",
        computed_minus_given,
        (table.name,),
        table.parameters,
        units,
        snooped="",
    )
    prior_sigma = np.where(np.isnan(sigma[rows]), np.inf, sigma[rows])
    return (kind((rows,), np.asarray(table.value)[rows], sigma=prior_sigma),)


def _planes(
    name: str,
    value: Float[np.ndarray, "rows 10"],
    sigma: Float[np.ndarray, "rows 10"],
    labels: Sequence[str],
) -> tuple[Table, tuple[ObservationSet, ...]]:
    """The table of flat interfaces, and the observations of those that have a σ."""
    X0, plane_sigma = value[:, :3], sigma[:, 2:5]
    angles = np.pad(value[:, 3:5], ((0, 0), (0, 1)))
    M = np.stack([np.asarray(matrix_from_omega_phi_kappa(a)) for a in angles])
    q = np.stack([np.asarray(quaternion_from_matrix(m)) for m in M])
    free = ~np.isnan(plane_sigma)
    table = Table(name, PoseValue(X0, q), Frame((2, 3, 4)), free, labels, PLANE, name)
    rows = np.flatnonzero(np.isfinite(plane_sigma).any(1))
    if not len(rows):
        return table, ()
    kind = Kind(f"prior of {name}", plane_minus_given, (name,), PLANE, PLANE_PRIOR, snooped="")
    plane_sigma = np.where(np.isnan(plane_sigma[rows]), np.inf, plane_sigma[rows])
    return table, (kind((rows,), (X0[rows], M[rows]), sigma=plane_sigma),)


def _scale_thicknesses(motion: Float[Array, "7"], value: Float[Array, " n"]) -> Float[Array, " n"]:
    # The three refractive indices before them have no unit.
    return value.at[3:].set(scale_length(motion, value[3:]))


@dataclasses.dataclass(frozen=True)
class RefractedImagePoint:
    """The residuals of an image point seen through an interface."""

    model: str | cameras.CameraModel
    domain: str
    refraction: Refraction

    def __call__(
        self,
        pose: Posed,
        interface: Any,
        medium: Change,
        interior: Change,
        point: Triple,
        xy: tuple[Any, Any],
    ) -> Change:
        ray = self.refraction(pose, interface, medium, point)
        return cameras.residual(cameras.get_model(self.model), self.domain, interior, ray, xy)
