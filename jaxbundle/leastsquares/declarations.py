"""User declarations: tables of unknowns, and kinds of observations.

A problem without photographs:

    height = Table("height", start)                                                   # [n]
    levelled = Kind("levelled difference", lambda a, b, dh: b - a - dh, of=("height", "height"))
    observations = levelled(rows=(i, j), measured=dh, sigma=s)
"""

import dataclasses
import numbers
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int, PyTree

from jaxbundle.arguments import numeric_array
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.spaces import Pose, PoseValue, Space, Vector
from jaxbundle.leastsquares.whitening import whitening

# Placeholder: the space is derived from the values of the table.
OF_THE_VALUES: Any = None


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Table:
    """Unknowns of one type.

    **Arguments:**

    - `name`: its name in kinds of observations.
    - `value`: start values, arrays whose first axis is the rows.
    - `space`: how a row is updated; default: numbers that add.
    - `free`: [rows, width], whether each direction of each row is free (one value for all, or one
      per row); default: all. Derivatives with respect to held values are available.
    - `labels`: a name for every row, and `parameters` for its directions, for reports;
      `title`: the name of one row, by default that of the table.
    - `units`: of its numbers, for reports: as of a `Kind`. Poses and rotations have their own.
    """

    name: str
    value: PyTree[np.ndarray]
    space: Space = OF_THE_VALUES
    free: Any = None
    labels: Sequence[str] | None = None
    parameters: tuple[str, ...] = ()
    title: str = ""
    units: str | tuple[str, ...] = ""

    def __post_init__(self):
        description = f"table {self.name!r}: the start values"
        object.__setattr__(self, "value", _arrays(description, self.value))
        leaves = jax.tree.leaves(self.value)
        if not leaves or any(np.ndim(x) == 0 for x in leaves):
            raise InputError(f"table {self.name!r}: the values must be arrays of rows")
        if len({len(x) for x in leaves}) > 1:
            raise InputError(f"table {self.name!r}: its arrays differ in their number of rows")
        if self.space is None and isinstance(self.value, PoseValue):
            object.__setattr__(self, "space", Pose())
        if self.space is None:
            shape = np.shape(leaves[0])
            if len(leaves) > 1 or len(shape) > 2:
                raise InputError(
                    f"table {self.name!r}: values of this shape need a space, such as Pose()"
                )
            object.__setattr__(self, "space", Vector(shape[1] if len(shape) == 2 else 0))
        shape, free = np.shape(self.free), True if self.free is None else self.free
        free = numeric_array(f"table {self.name!r}: `free`", free, "truth values", truths=True)
        try:
            free = free if np.ndim(free) != 1 else np.asarray(free)[:, None]
            free = np.broadcast_to(free, (self.rows, self.space.width)).astype(float)
        except ValueError:
            raise InputError(
                f"table {self.name!r}: `free` must be [rows, {self.space.width}] or [rows], not "
                f"{list(shape)}"
            ) from None
        object.__setattr__(self, "free", free)
        if not isinstance(self.units, str) and len(self.units) != self.space.width:
            raise InputError(
                f"table {self.name!r}: expected one unit, or {self.space.width}; got "
                f"{len(self.units)} of them"
            )
        self._check_names()
        object.__setattr__(self, "title", self.title or self.name)

    def _check_names(self) -> None:
        """Refuse labels and parameters that do not name every row and direction, each its own."""
        if self.labels is not None:
            if len(self.labels) != self.rows:
                raise InputError(
                    f"table {self.name!r}: expected {self.rows} labels, got {len(self.labels)}"
                )
            seen: set[str] = set()
            for row in range(self.rows):
                if (label := self.label(row)) in seen:
                    raise InputError(f"table {self.name!r}: two rows have the label {label!r}")
                seen.add(label)
        if self.parameters and len(self.parameters) != self.space.width:
            raise InputError(
                f"table {self.name!r}: expected {self.space.width} parameters, got "
                f"{len(self.parameters)}"
            )

    @property
    def vector(self) -> Vector:
        """The space of a table of vectors."""
        assert isinstance(self.space, Vector)
        return self.space

    @property
    def rows(self) -> int:
        return len(jax.tree.leaves(self.value)[0])

    def rows_of(self, labels: Sequence[str] | np.ndarray, kind: str) -> np.ndarray:
        """The rows with these labels, as touched by observations of a kind."""
        place = {self.label(row): row for row in range(self.rows)}
        missing_label = next((name for name in labels if name not in place), None)
        if missing_label is not None:
            raise InputError(f"{kind}: there is no {self.title} {missing_label!r}")
        return np.array([place[name] for name in labels], np.int64)

    def label(self, row: int) -> str:
        """The name of a row; its number, counted from 1, if it has none."""
        return str(row + 1) if self.labels is None else str(self.labels[row])

    def parameter(self, column: int) -> str:
        """The name of a direction; its number, counted from 1, if it has none."""
        return self.parameters[column] if self.parameters else str(column + 1)


@dataclasses.dataclass(frozen=True)
class Local:
    """Few of many columns that an observation depends on (`equations/local.py`).

    `slot`: of the kind's `of`, a table of vectors; `number` of columns; `columns`:
    `(blocks…, measured) -> tuple of whole numbers`, which elements of the vector they are;
    `residual`: `(blocks…, columns, values, measured) -> residuals`, the kind's own with `values` in
    these columns. Scalars throughout.
    """

    slot: int
    number: int
    columns: Callable
    residual: Callable


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of observation: one pure function of ONE observation.

    **Arguments:**

    - `name`: of the kind, used in reports; each kind is a variance group.
    - `residual`: `(blocks…, measured) -> residuals`, computed minus observed. A block of a table of
      vectors is an array [m] (a number if the table is [rows]), of poses a `Posed`. It returns one
      number or an array [r]; with `scalars`, blocks, `measured` and the return value are tuples of
      scalars, which is faster for many observations.
    - `of`: the names of the tables it touches, one for each block (one table may be touched twice).
    - `axes`: names of the residuals ("x", "y"), for reports.
    - `units`: of the residuals, for reports: "length", "angle" (radians), "image", "velocity" or
      "time" (seconds), one word for all or one for each; "" if they have another or none.
    - `snooped`: how it is tested for blunders and removed: `"whole"` with all of its residuals,
      `"single"` each residual separately, `""` never, like priors.
    - `invariant`: unchanged by motions of the whole problem (see `Motions`), like image
      points: such kinds do not affect the datum defect.
    - `local`: of a kind with `scalars` whose observations depend on few columns of a wide table.
    """

    name: str
    residual: Callable
    of: tuple[str, ...]
    axes: tuple[str, ...] = ()
    units: str | tuple[str, ...] = ""
    scalars: bool = False
    snooped: str = "whole"
    invariant: bool = False
    local: Local | None = None

    def __call__(
        self,
        rows: Sequence[Int[np.ndarray, " n"]],
        measured: PyTree = (),
        *,
        sigma: Any = None,
        covariance: Any = None,
        name: str = "",
    ) -> "ObservationSet":
        """Observations of this kind; see `ObservationSet`."""
        return ObservationSet(self, tuple(rows), measured, sigma, covariance, name)


@dataclasses.dataclass(frozen=True)
class Motions:
    """Motions of the whole problem that its observations may leave open, as image points leave
    similarities open: the datum.

    **Arguments:**

    - `names`: of the parameters of a motion ("shift X", …, "scale").
    - `actions`: by table, `(motion, value) -> value` of one row; motion 0 is the identity, and
      moving twice by 1 along one direction is moving by 2 (canonical coordinates).
    - `curved`: parameters whose motions are not straight lines (rotations, scale).
    """

    names: tuple[str, ...]
    actions: tuple[tuple[str, Callable], ...]
    curved: tuple[int, ...] = ()


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class ObservationSet:
    """Observations of one kind.

    **Arguments:** `rows`: for each touched table the row (or the label of the row) every
    observation touches, [n];
    `measured`: arrays of n rows; `sigma`: one number, [n] or [n, r] (1 if neither is given;
    infinite: a weight of 0), or `covariance` [n, r, r] of the residuals of an observation; `name`:
    of these observations in the data and the results of a problem, by default that of their kind.

    `weight` [n, r] is 1/σ, the root of p = 1/σ²; or [n, r, r] L⁻¹ of the covariance L·Lᵀ, a root of
    P. Residuals are multiplied by it, so that their squares sum to vᵀPv.
    """

    kind: Kind
    rows: tuple[Int[np.ndarray, " n"], ...]
    measured: PyTree[np.ndarray]
    sigma: Any = None
    covariance: Any = None
    name: str = ""

    def __post_init__(self):
        name, kind = self.kind.name, self.kind
        object.__setattr__(self, "name", self.name or name)
        rows = tuple(row_numbers(name, r) for r in self.rows)
        if len(rows) != len(kind.of):
            raise InputError(
                f"{name}: expected rows of {len(kind.of)} tables ({', '.join(kind.of)}), not "
                f"of {len(rows)}"
            )
        if len({len(r) for r in rows}) > 1:
            raise InputError(f"{name}: the columns of rows differ in length")
        object.__setattr__(self, "rows", rows)
        measured = _arrays(f"{name}: the measured values", self.measured)
        if any(np.shape(x)[:1] != (self.number,) for x in jax.tree.leaves(measured)):
            raise InputError(
                f"{name}: expected measured values of {self.number} observations, got another "
                "number"
            )
        object.__setattr__(self, "measured", measured)
        if self.sigma is not None and self.covariance is not None:
            raise InputError(f"{name}: give sigma or covariance, not both")

    @property
    def number(self) -> int:
        return len(self.rows[0])

    def resolve_labels(self, tables: Sequence[Table]) -> "ObservationSet":
        """These observations with row numbers in place of labels.

        **Raises:** `InputError` for an unknown table or label."""
        table_of = {t.name: t for t in tables}
        unknown = next((name for name in self.kind.of if name not in table_of), None)
        if unknown is not None:
            names = ", ".join(table_of)
            raise InputError(f"{self.kind.name}: there is no table {unknown!r}; known: {names}")
        rows = tuple(
            table_of[name].rows_of(column, self.kind.name) if column.dtype == object else column
            for name, column in zip(self.kind.of, self.rows)
        )
        return dataclasses.replace(self, rows=rows)

    def label(self, tables: Sequence[Table], row: int) -> str:
        """An observation in words: its kind and the rows it touches."""
        table_of = {t.name: t for t in tables}
        rows = zip(self.kind.of, self.rows)
        touched_rows = (f"{table_of[t].title} {table_of[t].label(int(r[row]))}" for t, r in rows)
        return f"{self.kind.name} of {' and '.join(touched_rows)}"

    def weight(self, residuals: int) -> Float[np.ndarray, "n ..."]:
        """The weights, of observations of this number of `residuals` each."""
        if self.covariance is not None:
            return _whitening(self.kind.name, self.covariance, self.number, residuals)
        shape, sigma = np.shape(self.sigma), 1.0 if self.sigma is None else self.sigma
        sigma = numeric_array(f"{self.kind.name}: sigma", sigma, "positive numbers").astype(float)
        sigma = sigma[:, None] if sigma.ndim == 1 else sigma
        try:
            sigma = np.broadcast_to(sigma, (self.number, residuals))
        except ValueError:
            raise InputError(
                f"{self.kind.name}: sigma must be one number, [{self.number}] or "
                f"[{self.number}, {residuals}], not {list(shape)}"
            ) from None
        bad = ~(sigma > 0)
        if bad.any():
            row = int(np.argwhere(bad)[0][0])
            raise InputError(
                f"{self.kind.name}: sigma of observation {row + 1} is {sigma[bad][0]:g}; expected "
                "a positive number"
            )
        return 1 / sigma


def _arrays(description: str, tree: PyTree) -> PyTree[np.ndarray]:
    """A tree of arrays, or of lists of numbers, as arrays; masked values are NaN."""
    number = lambda x: numeric_array(description, x, "arrays of numbers").astype(float)
    return jax.tree.map(number, tree, is_leaf=lambda x: isinstance(x, list))


def row_numbers(kind: str, rows: Sequence | np.ndarray) -> np.ndarray:
    """Whole numbers, or labels as objects."""
    column = np.asarray(rows)
    # pandas has whole numbers in columns of objects.
    is_whole = lambda x: isinstance(x, numbers.Integral) and not isinstance(x, bool)
    if column.dtype.kind == "O" and column.size and all(map(is_whole, column.ravel())):
        return column.ravel().astype(np.int64)
    if column.dtype.kind in "OUS":
        return np.array([str(r) for r in np.ravel(rows)], dtype=object)
    rows = numeric_array(f"{kind}: rows", rows, "row numbers or labels").ravel()
    bad = rows != np.round(rows)
    if bad.any():
        raise InputError(f"{kind}: rows must be row numbers or labels, not {rows[bad][0]:g}")
    return rows.astype(np.int64)


def _whitening(
    name: str, covariance: Any, number: int, residuals: int
) -> Float[np.ndarray, "n r r"]:
    covariance = numeric_array(f"{name}: covariance", covariance, "[n, r, r]").astype(float)
    if covariance.shape != (number, residuals, residuals):
        raise InputError(
            f"{name}: covariance must be {[number, residuals, residuals]}, not "
            f"{list(covariance.shape)}"
        )
    variance = np.einsum("nii->ni", covariance)
    for row, i in np.argwhere(variance <= 0)[:1].tolist():
        raise InputError(
            f"{name}: the covariance of observation {row + 1} is not positive definite: it has a "
            f"variance of {variance[row, i]:g}"
        )
    size = np.sqrt(np.einsum("nii,njj->nij", covariance, covariance))
    # 1e-9: rounding of a covariance that was computed, or printed with nine digits; Cholesky reads
    # one triangle alone and would not see the other.
    if not (np.abs(covariance - covariance.mT) <= 1e-9 * size).all():
        raise InputError(f"{name}: a covariance is not symmetric or not finite")
    try:
        return whitening(covariance)
    except np.linalg.LinAlgError:
        raise InputError(f"{name}: a covariance is not positive definite") from None
