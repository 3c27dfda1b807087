"""The interface of further kinds of observations: tables of rows that refer to objects by id."""

import abc
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.declarations import Kind, ObservationSet, Table
from jaxbundle.network.columns import Columns, did_you_mean, refuse_unknown
from jaxbundle.network.number_range import (
    is_usable_sigma,
    sigma_of_setting,
    sigma_requirement,
)
from jaxbundle.network.tables import Images, Network, Points, Rows, Source, row_indices

# Unknowns of further tables that are lengths, in the object unit.
LENGTHS = frozenset(
    (
        "ax",
        "ay",
        "az",
        "shift X",
        "shift Y",
        "shift Z",
        "shift x",
        "shift y",
        "shift z",
        "R",
        "X",
        "Y",
        "Z",
        "thickness",
        "radius",
    )
)
# Of residuals of a pose: position and rotation.
POSE_UNITS = (*["length"] * 3, *["angle"] * 3)
# Errors of instruments that are angles, in tables of numbers.
INSTRUMENT_ANGLES = ("declination", "zero right", "zero up", "zero view")
# Unknowns of further tables that are angles, in the unit of the project.
ANGLES = frozenset(("omega", "phi", "kappa", "turn x", "turn y", "turn z", *INSTRUMENT_ANGLES))
# Unknowns without a unit: indices of refraction.
RATIOS = frozenset(("index", "index_window", "index_camera"))


class Contribution(NamedTuple):
    """What a kind contributes to the problem of the engine: tables of unknowns, sets of
    observations (object coordinates relative to the origin), and how a similarity of object space
    moves the tables, (name, function) each."""

    tables: Sequence[Table] = ()
    observations: Sequence[ObservationSet] = ()
    actions: Sequence[tuple[str, Callable]] = ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class ObservationTable(abc.ABC):
    """Rows of one further kind. A subclass has a column (a tuple or an array) for each field except
    `settings` and `source`, and declares what its id columns refer to.

    `settings`: of the section `SECTION` of a project."""

    TABLE: ClassVar[str]
    """The name of the table in `make_network` and in a project."""
    SECTION: ClassVar[str] = ""
    IMAGES: ClassVar[tuple[str, ...]] = ()
    POINTS: ClassVar[tuple[str, ...]] = ()
    """The fields that hold ids of images, of points."""
    MEASURED: ClassVar[str] = ""
    """The field of measurements; none for conditions."""
    GIVES_SCALE: ClassVar[bool] = False
    """Whether the rows may contain lengths that give a network its scale."""
    FILES: ClassVar[tuple[str, ...]] = ()
    """Keys of files in the tables of `settings`."""
    CHANGES_IMAGE_POINTS: ClassVar[bool] = False
    """Whether image points depend on the tables of this kind."""
    ANGLES_IN_SETTINGS: ClassVar[bool] = False
    """Whether `settings` hold angles, which are in the unit of the network: a table in another unit
    of angles cannot be added (`add_further`)."""

    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    source: Source = Source("table")

    @classmethod
    @abc.abstractmethod
    def from_columns(cls, table: Columns, settings: Mapping[str, Any], radians: float) -> Self:
        """Rows from the columns of a table; `radians` per angle unit."""

    @abc.abstractmethod
    def columns(self, radians: float) -> dict[str, Sequence[Any]]:
        """The columns of the table, in the form of `from_columns`."""

    @abc.abstractmethod
    def declare(self, network: Network, origin: Float[np.ndarray, "3"]) -> Contribution:
        """The tables and observations for a network that contains all rows (`restrict_to`)."""

    def __len__(self) -> int:
        return len(getattr(self, (*self.IMAGES, *self.POINTS)[0]))

    def take(self, rows: Rows) -> Self:
        """The chosen rows (a mask or indices)."""
        rows = row_indices(rows)
        names = [f.name for f in dataclasses.fields(self) if f.name not in ("settings", "source")]
        take_rows = lambda x: (
            x[rows] if isinstance(x, np.ndarray) else tuple(x[row] for row in rows)
        )
        fields = {name: take_rows(getattr(self, name)) for name in names}
        return dataclasses.replace(self, source=self.source.take(rows), **fields)

    def restrict_to(self, network: Network) -> Self:
        """The rows whose images and points are all in the network."""
        return self.take(self._included_rows(network))

    def _included_rows(self, network: Network) -> np.ndarray:
        # Rows about objects that were left out go with them, without an error.
        keep = np.ones(len(self), bool)
        for fields, known_ids in (
            (self.IMAGES, network.images.id),
            (self.POINTS, network.points.id),
        ):
            known_ids = set(known_ids)
            for field in fields:
                keep &= np.array([id in known_ids for id in getattr(self, field)], bool)
        return keep

    def check(self, network: Network) -> None:
        """Refuse rows about unknown images and points.

        **Raises:** `InputError`."""
        for fields, table, noun in (
            (self.IMAGES, network.images, "image"),
            (self.POINTS, network.points, "point"),
        ):
            known_ids = set(table.id)
            for field in fields:
                for row, id in enumerate(getattr(self, field)):
                    if id not in known_ids:
                        raise InputError(
                            f"{self.source(row)}: {noun} {id!r} is unknown: no such {noun} in "
                            f"{table.source.name}{did_you_mean(id, known_ids, listing=False)}"
                        )

    def begin(self, network: Network) -> Network:
        """The network with missing start values taken from these rows."""
        return network

    def scales(self, network: Network) -> Sequence[float]:
        """Given lengths by those of the network, whose scale is arbitrary; none if these rows have
        no lengths."""
        return ()

    @property
    def needs_scale(self) -> bool:
        """Whether a σ is a length that does not define the scale: the residuals shrink with the
        network, so its scale must be known: a network whose scale is open is refused."""
        return False

    def number_of_equations(self) -> int:
        """Equations per row; they help to determine every image and point it touches."""
        return 1


# "from" is a reserved word of Python: the field of this column has another name.
COLUMNS_OF_FIELDS = {"start": "from"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class SingleValues(ObservationTable):
    """Rows of one measured value each, with its σ. A subclass has its id columns, `TABLE`, `IMAGES`
    or `POINTS`, and `KIND`: one residual, of the tables "image" and "point", in the order of the
    id columns. Angles (`Kind.units`) are in radians here, and in the project's unit in a table."""

    value: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]

    KIND: ClassVar[Kind]
    MEASURED = "value"

    @classmethod
    def from_columns(cls, table: Columns, settings: Mapping[str, Any], radians: float) -> Self:
        names = {field: COLUMNS_OF_FIELDS.get(field, field) for field in (*cls.IMAGES, *cls.POINTS)}
        table.check_names((*names.values(), "value", "sigma"))
        ids: dict[str, Any] = {field: table.ids(name) for field, name in names.items()}
        unit = radians if cls.KIND.units == "angle" else 1.0
        observations = cls(
            value=unit * table.numbers("value", required=True),
            sigma=unit * positive_sigma(table, "sigma"),
            source=table.source,
            **ids,
        )
        for row, objects in enumerate(zip(*(getattr(observations, field) for field in cls.POINTS))):
            if len({*objects}) < len(objects):
                raise InputError(f"{table.source(row)}: expected {len(objects)} different points")
        observations.check_values(radians)
        return observations

    def check_values(self, radians: float) -> None:
        """Refuse values that cannot be measured; all are accepted by default.

        **Raises:** `InputError`."""

    def columns(self, radians: float) -> dict[str, Sequence[Any]]:
        fields = (*self.IMAGES, *self.POINTS)
        ids: dict[str, Any] = {COLUMNS_OF_FIELDS.get(f, f): getattr(self, f) for f in fields}
        unit = radians if self.KIND.units == "angle" else 1.0
        ids |= {"value": self.value / unit, "sigma": self.sigma / unit}
        return ids

    def declare(self, network: Network, origin: Float[np.ndarray, "3"]) -> Contribution:
        fields = {"image": iter(self.IMAGES), "point": iter(self.POINTS)}
        tables = {"image": network.images, "point": network.points}
        rows = tuple(
            rows_of(getattr(self, next(fields[name])), tables[name]) for name in self.KIND.of
        )
        return Contribution((), (self.KIND(rows, self.value, sigma=self.sigma),))


def rows_of(ids: Sequence[str], table: Images | Points) -> Int[np.ndarray, " n"]:
    """The rows of a table with these (existing) ids."""
    row = {id: k for k, id in enumerate(table.id)}
    return np.array([row[id] for id in ids], int)


def included_tables(network: Network) -> list[ObservationTable]:
    """The observations of further kinds of a network whose images and points are all included."""
    restricted = (table.restrict_to(network) for table in network.further)
    return [table for table in restricted if len(table)]


def positive_sigma(
    table: Columns, name: str, *, required: bool = True
) -> Float[np.ndarray, " rows"]:
    """A column of σ; NaN if missing.

    **Raises:** `InputError` for one that cannot be used, or is missing but required."""
    sigma = table.numbers(name, required=required)
    refuse_unusable(table, name, sigma)
    return sigma


def sigma_or_exact(table: Columns) -> Float[np.ndarray, " rows"]:
    """σ of distances; 0 if exact or missing.

    **Raises:** `InputError` for one that cannot be used."""
    sigma = table.numbers("sigma", words={"exact": 0.0})
    refuse_unusable(table, "sigma", np.where(sigma == 0, np.nan, sigma))
    return np.where(np.isnan(sigma), 0.0, sigma)


def refuse_unusable(table: Columns, name: str, sigma: Float[np.ndarray, " rows"]) -> None:
    """Refuse the first σ of a column that cannot be computed with; NaN and infinite: none."""
    is_none = np.isnan(sigma) | np.isposinf(sigma)
    for row in np.flatnonzero(~(is_none | is_usable_sigma(sigma)))[:1]:
        raise InputError(
            f"{table.source(row)}: {name} is {sigma[row]:g}; it must be "
            f"{sigma_requirement(float(sigma[row]))}"
        )


def check_settings(section: str, settings: Mapping[str, Any], known_names: Sequence[str]) -> None:
    """Refuse settings of a section that are not known."""
    if not isinstance(settings, Mapping):
        raise InputError(f"[{section}]: expected a section of settings, got {show(settings)}")
    for key in settings:
        refuse_unknown(key, known_names, f"[{section}]: ")


def numbers(section: str, key: str, value: Any, length: int) -> Float[np.ndarray, " length"]:
    """A setting of this many numbers.

    **Raises:** `InputError`."""
    try:
        vector = np.array(value, float)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (length,) or not np.isfinite(vector).all():
        raise InputError(f"[{section}]: {key} is {show(value)}; expected {length} numbers")
    return vector


def three_by_camera(
    section: str, key: str, setting: Any, cameras: Sequence[str]
) -> Float[np.ndarray, "cameras 3"]:
    """Three numbers of a setting, the same for all cameras or a table by camera.

    **Raises:** `InputError`, also for a camera that the table lacks."""
    if not isinstance(setting, Mapping):
        return np.tile(numbers(section, key, setting, 3), (len(cameras), 1))
    for camera in cameras:
        if camera not in setting:
            raise InputError(f"[{section}]: {key} of camera {camera!r} is missing")
    return np.array([numbers(section, f"{key} of {c}", setting[c], 3) for c in cameras])


@dataclasses.dataclass(frozen=True)
class Parameters:
    """Parameters a section may free: their names, which are free, their prior σ by name."""

    names: tuple[str, ...]
    free: tuple[str, ...]
    sigma: Mapping[str, float]

    @staticmethod
    def from_settings(
        section: str, settings: Mapping[str, Any], names: tuple[str, ...]
    ) -> "Parameters":
        """From the keys `free` and `sigma` of a section.

        **Raises:** `InputError`."""
        free, sigma = settings.get("free", ()), settings.get("sigma", {})
        if isinstance(free, str) or not isinstance(free, Sequence):
            raise InputError(f"[{section}]: free is {show(free)}; expected a list of names")
        if not isinstance(sigma, Mapping):
            raise InputError(
                f"[{section}]: sigma is {show(sigma)}; expected a table of names and numbers"
            )
        for name in (*free, *sigma):
            if name not in names:
                raise InputError(f"[{section}]: unknown {name!r}{did_you_mean(name, names)}")
        for name, value in sigma.items():
            if name not in free:
                raise InputError(f"[{section}]: sigma is given for {name!r}, which is not free")
            sigma_of_setting(f"[{section}]: sigma of {name}", value)
        return Parameters(names, tuple(free), dict(sigma))

    def mask(self, names: Sequence[str]) -> Bool[np.ndarray, "1 n"]:
        """Which of these are free, in every row."""
        return np.array([[name in self.free for name in names]])

    def priors(
        self, table: Table, names: Sequence[str], units: str | tuple[str, ...] = ""
    ) -> list[ObservationSet]:
        """Pseudo-observations of the start values of a table of vectors with these columns, in
        `units` (`Kind`)."""
        # An infinite σ is no prior: a column without one is a row without weight.
        sigma = np.array([self.sigma.get(name, np.inf) for name in names])
        if not np.isfinite(sigma).any():
            return []
        kind = Kind(
            f"prior of {table.title}",
            computed_minus_given,
            (table.name,),
            tuple(names),
            units,
            snooped="",
        )
        sigma = np.tile(sigma, (table.rows, 1))
        return [kind((np.arange(table.rows),), table.value, sigma=sigma)]


def computed_minus_given(value: Any, prior: Any) -> Any:
    """Computed minus given."""
    return value - prior
