"""Ancillary data made into tables; what is wrong is said with its row before it is used."""

from collections.abc import Sequence
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.network.columns import did_you_mean
from jaxbundle.network.tables import Source

from .interpolation import METHODS, Table
from .trajectory import Attitude

POSITIONS, ATTITUDE = Source("positions"), Source("attitude")

UNIT = 1e-4
"""A quaternion's length may differ by this from 1: files with four decimals are taken."""

GAP = 5.0
"""A step longer than this many median steps is a gap."""

FEWEST = {"linear": 2, "hermite": 2, "slerp": 2, "spline": 4}


def position_table(
    times: Float[np.ndarray, " rows"],
    positions: Float[np.ndarray, "rows 3"],
    velocities: Float[np.ndarray, "rows 3"] | None = None,
    *,
    method: str = "lagrange",
    order: int = 7,
    gap: float | None = None,
    source: Source = POSITIONS,
) -> Table:
    """Positions (metres) against time (seconds).

    **Arguments:** `velocities` in metres a second, needed by `"hermite"`; `order` of Lagrange's
    polynomial; `gap` the longest step that is interpolated, in seconds (five median steps);
    `source` names the rows in messages.

    **Raises:** `InputError` naming the row: times that do not increase, what is not a number, too
    few rows; a gap that is not positive.
    """
    _check_method(method, METHODS, source)
    if method == "hermite" and velocities is None:
        raise InputError(
            f"{source.name}: 'hermite' needs velocities; give VX, VY, VZ or another interpolation"
        )
    return _table(times, positions, velocities, method, order, gap, "position", source)


def attitude_table(
    times: Float[np.ndarray, " rows"],
    values: Float[np.ndarray, "rows k"],
    *,
    method: str = "slerp",
    order: int = 7,
    gap: float | None = None,
    reference: Literal["earth", "orbit"] = "earth",
    source: Source = ATTITUDE,
) -> Attitude:
    """Attitudes against time (seconds): quaternions (w, x, y, z), or pitch, roll, yaw in radians.

    Jumps of the sign of quaternions are mended. Angles that jump by a turn are made continuous.

    **Arguments:** as in `position_table`; `method` also `"slerp"`, for quaternions only.

    **Raises:** `InputError` naming the row, also for quaternions that are not unit.
    """
    values = np.array(values, float)
    quaternions = values.ndim == 2 and values.shape[1] == 4
    known = tuple(m for m in (*METHODS, "slerp") if m != "hermite")
    _check_method(method, known, source)
    if method == "slerp" and not quaternions:
        raise InputError(
            f"{source.name}: 'slerp' is for quaternions; interpolate angles by 'linear', "
            "'lagrange' or 'spline'"
        )
    if quaternions:
        length = np.linalg.norm(values, axis=1)
        if (bad := ~(np.abs(length - 1) < UNIT)).any():
            row = int(bad.argmax())
            raise InputError(
                f"{source(row)}: the quaternion has the length {length[row]:.6g}; 1 is expected, "
                "in the order w, x, y, z: give unit quaternions"
            )
        values = continuous(values / length[:, None])
    else:
        values = np.unwrap(values, axis=0)
    table = _table(times, values, None, method, order, gap, "attitude", source)
    return Attitude(table, method == "slerp", reference)


def continuous(quaternions: Float[np.ndarray, "rows 4"]) -> Float[np.ndarray, "rows 4"]:
    """The same rotations with signs such that neighbours are near each other."""
    same = np.sum(quaternions[1:] * quaternions[:-1], 1) >= 0
    return quaternions * np.cumprod(np.r_[1, np.where(same, 1, -1)])[:, None]


def check_times(times: Float[np.ndarray, " rows"], source: Source) -> None:
    """Refuse times that are not numbers, not sorted, or there twice."""
    if (bad := ~np.isfinite(times)).any():
        raise InputError(f"{source(int(bad.argmax()))}: the time is not a finite number")
    if (bad := np.diff(times) <= 0).any():
        row = int(bad.argmax()) + 1
        before, time = times[row - 1 : row + 1]
        wrong = "is there twice" if time == before else f"comes after {before:.15g} s"
        raise InputError(
            f"{source(row)}: the time {time:.15g} s {wrong}; sort the rows by time and leave "
            "every time once"
        )


def check_covered(
    table: Table, times: Sequence[float], source: Source, thing: str = "image line"
) -> None:
    """Refuse a table that does not reach over the times, or has a gap among them.

    `source` names the table and its rows, `thing` what the times belong to.
    """
    rows, times = np.asarray(table.times), np.asarray(times, float)
    outside = (times < rows[0]) | (times > rows[-1])
    if outside.any():
        k = int(outside.argmax())
        raise InputError(
            f"{source.name}: {thing} {k} is at {times[k]:.9g} s, outside the table, "
            f"{rows[0]:.9g} to {rows[-1]:.9g} s; give ancillary data for the whole image, nothing "
            "is extrapolated"
        )
    i = np.clip(np.searchsorted(rows, times, side="right") - 1, 0, len(rows) - 2)
    wide = rows[i + 1] - rows[i] > table.gap
    if wide.any():
        k = int(wide.argmax())
        start, end = rows[i[k]], rows[i[k] + 1]
        raise InputError(
            f"{source(i[k] + 1)}: {thing} {k} at {times[k]:.9g} s is in the gap of "
            f"{end - start:.6g} s before this row; allow it with gap = {end - start:.6g}, or give "
            "rows"
        )


def _check_method(method, known, source):
    if method not in known:
        raise InputError(
            f"{source.name}: unknown interpolation {method!r}{did_you_mean(method, known)}"
        )


def _table(times, values, rates, method, order, gap, what, source):
    times, values = np.asarray(times, float), np.asarray(values, float)
    if values.ndim != 2 or times.shape != values.shape[:1]:
        raise InputError(
            f"{source.name}: {times.shape} times and {what}s of shape {values.shape}; one row of "
            "values a time is expected"
        )
    rates = None if rates is None else np.asarray(rates, float)
    for name, array in ((what, values), ("velocity", rates)):
        if array is not None and (bad := ~np.isfinite(array).all(1)).any():
            raise InputError(f"{source(int(bad.argmax()))}: the {name} is not a finite number")
    if method == "lagrange" and order < 1:
        raise InputError(f"{source.name}: the order of 'lagrange' is {order}; at least 1, please")
    fewest = FEWEST.get(method, order + 1)
    if len(times) < fewest:
        advice = " or a lower order" if method == "lagrange" else ""
        raise InputError(
            f"{source.name}: {len(times)} rows; {method!r} needs {fewest}; give more rows{advice}"
        )
    check_times(times, source)
    if gap is not None and not gap > 0:
        raise InputError(
            f"{source.name}: gap is {gap:g}; the longest step that is interpolated, in seconds, "
            "is expected, a positive number"
        )
    gap = GAP * float(np.median(np.diff(times))) if gap is None else float(gap)
    kind = "linear" if method == "slerp" else method
    rates = None if rates is None else jnp.asarray(rates)
    return Table(jnp.asarray(times), jnp.asarray(values), rates, gap, kind, order)
