"""The tables of a network: cameras, images, points, observations, distances.

A table is a frozen dataclass of numpy columns with the source of its rows (`Source`), so that every
message can name file and row. Rows refer to each other by index; ids are kept for reports.

| column | meaning |
|---|---|
| `Images.angles` | ω, φ, κ in radians, M = R3(κ)·R2(φ)·R1(ω) |
| `Images.sigma` | prior σ of X0, Y0, Z0, ω, φ, κ; NaN: no prior; 0: held fixed |
| `Points.sigma` | σ of a control point; NaN: none; inf: this axis is not controlled |
| `Points.colour` | red, green, blue, 0 to 255; None: the network has no colours |
| `Observations.xy` | measured image coordinates, in the unit and axes of the camera's model |
"""

import dataclasses
import os
from collections.abc import Iterable, Mapping, Sequence
from operator import index
from typing import Any, SupportsIndex

import numpy as np
from jax.core import Tracer
from jaxtyping import Bool, Float, Int, Shaped, UInt8

from jaxbundle.arguments import refuse_traced, show
from jaxbundle.cameras import CameraModel, get_model, key_of
from jaxbundle.choices import ESTIMATED as ESTIMATED
from jaxbundle.choices import SIGMA_ORIGINS as SIGMA_ORIGINS
from jaxbundle.choices import STATED as STATED
from jaxbundle.choices import UNIT as UNIT
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError

ROLES = ("tie", "control", "fixed", "check")
DATUMS = ("control", "inner", "minimal")
RESIDUAL_DOMAINS = ("corrected", "measured")
EXTERIOR = ("X0", "Y0", "Z0", "omega", "phi", "kappa")
# Red, green, blue of a point without a colour, among coloured ones or where a format requires one.
GREY = (128, 128, 128)
# Which rows of a table: a mask, or indices.
Rows = Bool[np.ndarray, " n"] | Int[np.ndarray, " k"] | Sequence[int]
# σ of an image coordinate of a calibration, pixels, where none is stated: a unit of weight, about
# what corners of boards have, which σ0 estimates.
UNSTATED_BOARD_SIGMA = 0.1


def row_indices(rows: Rows) -> Int[np.ndarray, " k"]:
    """The chosen rows as indices."""
    rows = np.asarray(rows)
    return np.flatnonzero(rows) if rows.dtype == bool else rows


@dataclasses.dataclass(frozen=True)
class Source:
    """The source of a table: a name, and the number of each row in it (None: counted from 1), or
    its place in words."""

    name: str
    numbers: Shaped[np.ndarray, " rows"] | None = None
    word: str = "row"

    def __call__(self, row: SupportsIndex) -> str:
        """The location of a row, for messages."""
        number = index(row) + 1 if self.numbers is None else self.numbers[row]
        return f"{self.name}, {self.word} {number}"

    def take(self, rows: Rows) -> "Source":
        """The source of the chosen rows (a mask or indices)."""
        rows = row_indices(rows)
        numbers = rows + 1 if self.numbers is None else self.numbers[rows]
        return Source(self.name, numbers, self.word)


@dataclasses.dataclass(frozen=True)
class Camera:
    """One camera: a model of `jaxbundle.cameras`, start values, free parameters, priors.

    `model` is the name of a built-in model, or your own `CameraModel`. Missing `parameters`
    start at 0 (or the model's default); `sigma` gives a parameter a prior: a pseudo-observation
    of its start value, or of the value in `observed`. `image_size` is (columns, rows), `pixel_size`
    (width, height) in mm. `tie`: groups of parameters that are one unknown, such as
    `(("fx", "fy"),)`.
    """

    id: str
    model: str | CameraModel = "brown"
    parameters: Mapping[str, float] = dataclasses.field(default_factory=dict)
    free: tuple[str, ...] = ()
    sigma: Mapping[str, float] = dataclasses.field(default_factory=dict)
    image_size: tuple[int, int] | None = None
    pixel_size: tuple[float, float] | None = None
    tie: tuple[tuple[str, ...], ...] = ()
    observed: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        object.__setattr__(self, "model", key_of(self.model))

    @property
    def unknowns(self) -> tuple[str, ...]:
        """The names of the free parameters; of tied ones the first."""
        # A group is one unknown: freeing any of it frees all.
        representative = {name: group[0] for group in self.tie for name in group}
        return tuple(dict.fromkeys(representative.get(name, name) for name in self.free))


def units_of(cameras: Iterable[Camera]) -> str:
    """The unit of image coordinates, that of the camera models."""
    return "/".join(sorted({get_model(camera.model).unit for camera in cameras}))


def are_among(ids: Sequence[str], chosen: Iterable[str]) -> Bool[np.ndarray, " ids"]:
    """Which ids are among some. (`np.isin` compares arrays of objects each with each, which takes
    seconds for the points of a large block.)"""
    chosen = set(chosen)
    return np.array([id in chosen for id in ids], bool)


def _fill_masked(table: Any) -> None:
    """Masked numbers become NaN, which the checks refuse with their row. Arrays that JAX traces are
    refused: tables are of the host."""
    for field in dataclasses.fields(table):
        value = getattr(table, field.name)
        if isinstance(value, Tracer):
            refuse_traced(f"{table.source.name}: {field.name}", value)
        if not isinstance(value, np.ma.MaskedArray):
            continue
        # A masked number is a missing one, NaN; an index or a flag cannot be missing.
        if value.dtype.kind != "f" and np.ma.is_masked(value):
            raise InputError(f"{table.source.name}: {field.name} has masked values; give all")
        filled = value.filled(np.nan) if value.dtype.kind == "f" else value.data
        object.__setattr__(table, field.name, filled)


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Images:
    """Exposures with the start values of their exterior orientation."""

    id: tuple[str, ...]
    camera: Int[np.ndarray, " images"]
    position: Float[np.ndarray, "images 3"]
    angles: Float[np.ndarray, "images 3"]
    sigma: Float[np.ndarray, "images 6"]
    source: Source = Source("images")
    __post_init__ = _fill_masked

    def __len__(self) -> int:
        return len(self.id)

    def take(self, rows: Rows) -> "Images":
        """The chosen images (a mask or indices), with their source rows."""
        rows = row_indices(rows)
        return Images(
            tuple(self.id[row] for row in rows),
            self.camera[rows],
            self.position[rows],
            self.angles[rows],
            self.sigma[rows],
            self.source.take(rows),
        )


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Points:
    """Object points: role, coordinates (start values, given values), σ, and colour, which takes no
    part in an adjustment."""

    id: tuple[str, ...]
    role: tuple[str, ...]
    position: Float[np.ndarray, "points 3"]
    sigma: Float[np.ndarray, "points 3"]
    source: Source = Source("points")
    colour: UInt8[np.ndarray, "points 3"] | None = None
    __post_init__ = _fill_masked

    def __len__(self) -> int:
        return len(self.id)

    def take(self, rows: Rows) -> "Points":
        """The chosen points (a mask or indices), with their source rows."""
        rows = row_indices(rows)
        return Points(
            tuple(self.id[row] for row in rows),
            tuple(self.role[row] for row in rows),
            self.position[rows],
            self.sigma[rows],
            self.source.take(rows),
            None if self.colour is None else self.colour[rows],
        )

    def colour_or_grey(self) -> UInt8[np.ndarray, "points 3"]:
        """The colours, `GREY` without."""
        return np.full((len(self), 3), GREY, np.uint8) if self.colour is None else self.colour

    def with_colours(self, colours: Mapping[str, Sequence[int]]) -> "Points":
        """The same points with the colours of some, by id; the others are `GREY`."""
        colour_of_point = [tuple(colours.get(id, GREY)) for id in self.id]
        return dataclasses.replace(self, colour=np.array(colour_of_point, np.uint8).reshape(-1, 3))

    def has_role(self, *roles: str) -> Bool[np.ndarray, " points"]:
        """Which points have one of these roles."""
        return np.isin(np.array(self.role, dtype=object), roles)


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Observations:
    """Measured image points: image, point, coordinates, σ and their origin (`SIGMA_ORIGINS`)."""

    image: Int[np.ndarray, " rays"]
    point: Int[np.ndarray, " rays"]
    xy: Float[np.ndarray, "rays 2"]
    sigma: Float[np.ndarray, "rays 2"]
    source: Source = Source("observations")
    sigma_origin: str = STATED
    __post_init__ = _fill_masked

    def __len__(self) -> int:
        return len(self.image)

    def take(self, rows: Rows) -> "Observations":
        """The chosen rows (a mask or indices), with their source rows."""
        return dataclasses.replace(
            self,
            image=self.image[rows],
            point=self.point[rows],
            xy=self.xy[rows],
            sigma=self.sigma[rows],
            source=self.source.take(rows),
        )


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Distances:
    """Measured distances between two points, in the object unit."""

    points: Int[np.ndarray, "distances 2"]
    value: Float[np.ndarray, " distances"]
    sigma: Float[np.ndarray, " distances"]
    source: Source = Source("distances")
    __post_init__ = _fill_masked

    def __len__(self) -> int:
        return len(self.value)

    @staticmethod
    def none() -> "Distances":
        """An empty table of distances."""
        return Distances(np.zeros((0, 2), np.int64), np.zeros(0), np.zeros(0))


@dataclasses.dataclass(frozen=True)
class LeftOut:
    """What an adjustment leaves out for one reason: `thing` is "image", "tie point",
    "image point", …; `names` of image points are "POINT in IMAGE"; `why` completes
    "… left out"; `measured`: whether they have observations enough, so that something is lost."""

    thing: str
    names: tuple[str, ...]
    why: str
    measured: bool = True


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Network:
    """A photogrammetric network: the complete input of an adjustment, checked before use.

    `datum` is "control" (given by control points, priors), "inner" (inner constraints on
    `datum_points`, all tie points if empty) or "minimal" (as many coordinates held as the network
    has datum defects). `residuals` names the domain in which v = computed − observed is formed.
    `further`: observations of further kinds (`network/kinds`), which name images and points by
    id. `warnings` and `notes` for the report: what may spoil a result, and what is only good to
    know, such as what was left out; `left_out`: the latter with all names.
    """

    cameras: tuple[Camera, ...]
    images: Images
    points: Points
    observations: Observations
    distances: Distances = dataclasses.field(default_factory=Distances.none)
    datum: str = "control"
    datum_points: tuple[str, ...] = ()
    residuals: str = "corrected"
    name: str = "network"
    object_unit: str = "m"
    image_unit: str = "mm"
    angle_unit: str = "rad"
    further: tuple[Any, ...] = ()
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    left_out: tuple[LeftOut, ...] = ()

    def replace(self, **changes: Any) -> "Network":
        """A copy with some fields changed."""
        return dataclasses.replace(self, **changes)

    def warn(self, *messages: str) -> "Network":
        """A copy with further warnings."""
        return self.replace(warnings=(*self.warnings, *messages))

    def note(self, *messages: str) -> "Network":
        """A copy with further notes."""
        return self.replace(notes=(*self.notes, *messages))

    def __str__(self) -> str:
        return (
            f"Network {self.name!r}: {len(self.cameras)} camera(s), {len(self.images)} images, "
            f"{len(self.points)} points, {len(self.observations)} image points, "
            f"{len(self.distances)} distances, datum {self.datum}"
        )


def require_network(network: Network) -> Network:
    """The network, or an error for anything else.

    **Raises:** `InputError`."""
    if isinstance(network, Network):
        return network
    is_path = isinstance(network, str | os.PathLike)
    remedy = (
        f"jaxbundle.read_network({os.fspath(network)!r})"
        if is_path
        else ("use jaxbundle.read_network(path), make_network or simulate")
    )
    raise InputError(
        f"network must be a Network, but is {show(network)}: {remedy}" + " reads it" * is_path
    )
