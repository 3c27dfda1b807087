"""Ground points of a table: Earth-fixed, geographic, or in a local frame."""

import numpy as np

from jaxbundle.cli.pushbroom.shared import check_spheroid, geographic, warn
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid, earth_fixed
from jaxbundle.network.columns import Columns, did_you_mean

CARTESIAN, GEOGRAPHIC = ("X", "Y", "Z"), ("longitude", "latitude", "height")
OUTPUT_COLUMNS = ("id", "line", "pixel", "count", "status")
"""Further columns written by `locate` and `project`: their tables are accepted as input."""


def with_points(table: Columns) -> Columns:
    """The rows that have a point: `locate` leaves the others empty, with a status."""
    if "status" not in table.values:
        return table
    given = [name for name in (*CARTESIAN, *GEOGRAPHIC) if name in table.values]
    empty = np.all([np.isnan(table.numbers(name)) for name in given], axis=0)
    if not np.any(empty):
        return table
    warn(f"{table.source(int(empty.argmax()))}: no point ({empty.sum()} rows are skipped)")
    kept = np.flatnonzero(~empty).tolist()
    values = {name: [column[row] for row in kept] for name, column in table.values.items()}
    return Columns(values, table.source.take(kept))


def points_of(table: Columns, earth: Ellipsoid | None) -> np.ndarray:
    """Points of a table, Earth-fixed or local; X, Y, Z have priority.

    **Raises:** `InputError`.
    """
    cartesian = "X" in table.values
    if not cartesian and not any(name in table.values for name in GEOGRAPHIC[:2]):
        expected = (*CARTESIAN, *GEOGRAPHIC)
        odd = next((name for name in table.values if name not in OUTPUT_COLUMNS), "")
        raise InputError(
            f"{table.source.name}: no columns {', '.join(CARTESIAN)} nor {', '.join(GEOGRAPHIC)}"
            f"{did_you_mean(odd, expected, listing=False)}"
        )
    if cartesian:
        table.check_names(CARTESIAN, (*GEOGRAPHIC, *OUTPUT_COLUMNS))
        return np.stack([table.numbers(n, required=True) for n in CARTESIAN])
    if earth is None:
        raise InputError(f"{table.source.name}: a local frame has no longitudes; give X, Y, Z")
    check_spheroid(earth)
    table.check_names(GEOGRAPHIC, OUTPUT_COLUMNS)
    return np.array(earth_fixed(earth, geographic(table)))
