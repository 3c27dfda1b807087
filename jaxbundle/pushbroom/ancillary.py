"""Tables of ancillary data, checked before use; errors are reported with the row."""

import dataclasses
from collections.abc import Sequence
from typing import Literal, NamedTuple, cast

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.arguments import numeric_array
from jaxbundle.errors import InputError
from jaxbundle.network.columns import did_you_mean
from jaxbundle.network.tables import Source
from jaxbundle.pushbroom.interpolation import METHODS, Method, TimeTable
from jaxbundle.pushbroom.trajectory import AttitudeTable
from jaxbundle.types import Numbers

POSITIONS, ATTITUDE = Source("positions"), Source("attitude")

MIN_ROWS = {"linear": 2, "hermite": 2, "slerp": 2, "spline": 4, "usgscsm": 2}


@dataclasses.dataclass(frozen=True)
class AncillarySettings:
    """Limits of the checks of ancillary tables.

    - `rounded_length`: a quaternion whose length deviates from 1 by more is mentioned; components
      with three decimals, and components that other programs have adjusted one by one, explain as
      much, and leave the direction where it is.
    - `max_length_error`: four numbers whose length deviates by more are no quaternion but a column
      too many, angles or zeros.
    - `extrapolated_steps`, `min_extrapolation`, `max_extrapolation`: product tables may end so many
      of their steps before the image, but at least and at most these times in seconds. In these a
      satellite falls ½·9 m/s²·t² = 1 cm and 1 m, mostly along the line of sight: what an
      extrapolation may miss.
    - `time_rounding`: seconds by which times of products are rounded: those since J2000, 8e8 s, to
      1e-7 s in double precision, written dates to microseconds.
    """

    rounded_length: float = 1e-3
    max_length_error: float = 0.1
    extrapolated_steps: float = 2.0
    min_extrapolation: float = 0.05
    max_extrapolation: float = 0.5
    time_rounding: float = 1e-6


DEFAULTS = AncillarySettings()


def position_table(
    times: Float[np.ndarray, " rows"],
    positions: Float[np.ndarray, "rows k"],
    velocities: Float[np.ndarray, "rows k"] | None = None,
    *,
    method: str = "lagrange",
    order: int = 7,
    gap: float | None = None,
    extrapolate: float = 0.0,
    source: Source = POSITIONS,
) -> TimeTable:
    """Positions (metres) against time (seconds).

    **Arguments:** `velocities` in metres a second, needed by `"hermite"`; `order` of Lagrange's
    polynomial (7: eight rows, as of usgscsm and the SPOT Geometry Handbook); `gap` the longest step
    that is interpolated, in seconds (five median steps); `extrapolate` the seconds of allowed
    extrapolation (none); `source` names the rows in messages.

    **Raises:** `InputError` naming the row: times that do not increase, invalid numbers, too
    few rows; a gap that is not positive.
    """
    _check_method(method, METHODS, source)
    if method == "hermite" and velocities is None:
        raise InputError(
            f"{source.name}: 'hermite' needs velocities; give VX, VY, VZ or another interpolation"
        )
    return _table(times, positions, velocities, method, order, gap, extrapolate, "position", source)


def attitude_table(
    times: Float[np.ndarray, " rows"],
    values: Float[np.ndarray, "rows k"],
    *,
    method: str = "slerp",
    order: int = 7,
    gap: float | None = None,
    extrapolate: float = 0.0,
    reference: Literal["earth", "orbit"] = "earth",
    source: Source = ATTITUDE,
) -> AttitudeTable:
    """Attitudes against time (seconds): quaternions (w, x, y, z), or pitch, roll, yaw in radians.

    Quaternions are normalised and sign changes corrected. Angles that jump by a full turn are made
    continuous.

    **Arguments:** as in `position_table`; `method` also `"slerp"`, for quaternions only.

    **Raises:** `InputError` naming the row, also for quaternions whose length is far from 1.
    """
    expected = "quaternions [rows, 4], or pitch, roll, yaw [rows, 3]"
    values = numeric_array(source.name, values, expected).astype(float)
    if values.ndim != 2 or values.shape[1] not in (3, 4):
        raise InputError(f"{source.name}: attitudes of shape {values.shape}; expected {expected}")
    quaternions = values.shape[1] == 4
    allowed_methods = tuple(m for m in (*METHODS, "slerp") if m != "hermite")
    _check_method(method, allowed_methods, source)
    if method == "slerp" and not quaternions:
        raise InputError(
            f"{source.name}: 'slerp' is for quaternions; interpolate angles by 'linear', "
            "'lagrange' or 'spline'"
        )
    if quaternions:
        values = continuous(normalise_quaternions(values, source)[0])
    else:
        values = np.unwrap(values, axis=0)
    table = _table(times, values, None, method, order, gap, extrapolate, "attitude", source)
    return AttitudeTable(table, method == "slerp", reference)


def normalise_quaternions(
    values: Float[np.ndarray, "rows 4"],
    source: Source = ATTITUDE,
    settings: AncillarySettings = DEFAULTS,
) -> tuple[Float[np.ndarray, "rows 4"], tuple[str, ...]]:
    """Quaternions of length 1, and a message if some deviate by more than rounding.

    **Raises:** `InputError` naming the row of one that is no quaternion (`AncillarySettings`)."""
    length = np.linalg.norm(values, axis=1)
    if (bad := ~(np.abs(length - 1) < settings.max_length_error)).any():
        row = int(bad.argmax())
        raise InputError(
            f"{source(row)}: expected a quaternion, of length 1, got four numbers of length "
            f"{length[row]:.6g}; check the columns (in tables of scanner files w, x, y, z)"
        )
    message = (
        f"{source.name}: lengths of quaternions from {length.min():.6f} to {length.max():.6f}; "
        "they are normalised"
    )
    rounded = np.abs(length - 1) <= settings.rounded_length
    return values / length[:, None], () if rounded.all() else (message,)


class VelocityContradiction(NamedTuple):
    """Velocities that are not the rates of the positions: the row and what it shows, in words;
    `shift`: metres by which Hermite's interpolation is off between two rows, at most."""

    message: str
    shift: float


def contradiction(
    times: Float[np.ndarray, " rows"],
    positions: Float[np.ndarray, "rows k"],
    velocities: Float[np.ndarray, "rows k"],
    source: Source = POSITIONS,
    tolerance: float = 0.02,
) -> VelocityContradiction | None:
    """What shows that velocities are not the rates of the positions; None if nothing does.

    The mean velocity between two rows is compared with the mean of theirs, which differ by h²/12
    times the second derivative of the velocity: by less than half of the change of velocity for
    steps up to a sixth of a revolution (of a circular orbit, |ΔV|/2 = |V|·sin(ωh/2) against
    |V|·(ωh)²/12). Hermite's cubic with velocities that are off by δ at one end of a step is off by
    4/27·h·δ at most.

    **Arguments:** `tolerance`: of the speed, beside that: differences of rounded positions of
    neighbouring rows; a velocity relative to inertial axes differs by 6 % in a low orbit of the
    Earth.
    """
    step = np.diff(times)
    mean = np.diff(positions, axis=0) / step[:, None]
    trapezoid = (velocities[1:] + velocities[:-1]) / 2
    speed = np.linalg.norm(mean, axis=1)
    change = np.linalg.norm(np.diff(velocities, axis=0), axis=1)
    deviation = np.linalg.norm(mean - trapezoid, axis=1)
    # Velocities that are much too large excuse nothing.
    limit = tolerance * np.median(speed) + np.minimum(change, speed) / 2
    if not (bad := deviation > limit).any():
        return None
    k = int(bad.argmax())
    return VelocityContradiction(
        f"{source(k + 1)}: positions move by {speed[k]:.6g} m/s from the row before, velocities "
        f"say {np.linalg.norm(trapezoid[k]):.6g} m/s, {deviation[k]:.6g} m/s from that; expected "
        "metres a second in the frame of the positions",
        float((4 / 27 * step * deviation)[bad].max()),
    )


def continuous(quaternions: Float[np.ndarray, "rows 4"]) -> Float[np.ndarray, "rows 4"]:
    """The rotations by quaternions of such signs that neighbours are close.

    q and −q are one rotation, but between them interpolated components pass zero.
    """
    has_same_sign = np.sum(quaternions[1:] * quaternions[:-1], 1) >= 0
    return quaternions * np.cumprod(np.r_[1, np.where(has_same_sign, 1, -1)])[:, None]


def check_times(times: Float[np.ndarray, " rows"], source: Source) -> None:
    """Refuse times that are not finite, unsorted, or duplicate."""
    if (bad := ~np.isfinite(times)).any():
        raise InputError(f"{source(int(bad.argmax()))}: the time is not a finite number")
    if (bad := np.diff(times) <= 0).any():
        row = int(bad.argmax()) + 1
        previous_time, time = times[row - 1 : row + 1]
        fault = "occurs twice" if time == previous_time else f"comes after {previous_time:.15g} s"
        raise InputError(
            f"{source(row)}: the time {time:.15g} s {fault}; sort the rows by time and keep "
            "each time once"
        )


def extrapolation_limit(
    rows: Float[np.ndarray, " rows"], settings: AncillarySettings = DEFAULTS
) -> float:
    """The maximum extrapolation, in seconds, of a product table with rows at these times: two of
    its steps, but at least 0.05 s and at most 0.5 s."""
    step = float(np.median(np.diff(rows))) if len(rows) > 1 else 0.0
    limit = max(settings.extrapolated_steps * step, settings.min_extrapolation)
    return min(limit, settings.max_extrapolation)


def warn_of_extrapolation(
    rows: Float[np.ndarray, " rows"],
    times: Float[np.ndarray, " lines"],
    source: Source,
    settings: AncillarySettings = DEFAULTS,
) -> tuple[str, ...]:
    """A warning if the rows of a product begin after, or end before, the times of the lines.

    **Raises:** `InputError` if they do so by more than `extrapolation_limit`.
    """
    limit, rounding = extrapolation_limit(rows, settings), settings.time_rounding
    check_span(rows, limit, times, source)
    start_excess, end_excess = rows[0] - times.min(), times.max() - rows[-1]
    if max(start_excess, end_excess) <= rounding:
        return ()
    number = int(((times < rows[0] - rounding) | (times > rows[-1] + rounding)).sum())
    where = " and ".join(
        f"{value:.6g} s {text}"
        for value, text in ((start_excess, "at its start"), (end_excess, "at its end"))
        if value > rounding
    )
    return (
        f"{source.name}: the table does not cover the whole image: extrapolated by {where} "
        f"({number} of {len(times)} lines; up to {limit:.6g} s are allowed)",
    )


def check_span(
    rows: Float[np.ndarray, " rows"],
    extrapolate: float,
    times: Float[np.ndarray, " n"],
    source: Source,
    noun: str = "image line",
) -> None:
    """Refuse times outside a table by more than the allowed extrapolation."""
    is_outside = (times < rows[0] - extrapolate) | (times > rows[-1] + extrapolate)
    if is_outside.any():
        k = int(is_outside.argmax())
        allowance = f"at most {extrapolate:.6g} s are" if extrapolate else "nothing is"
        raise InputError(
            f"{source.name}: {noun} {k} is at {times[k]:.9g} s, outside the table, "
            f"{rows[0]:.9g} to {rows[-1]:.9g} s; give ancillary data for the whole image, "
            f"{allowance} extrapolated"
        )


def check_covered(
    table: TimeTable, times: Numbers, source: Source, noun: str = "image line"
) -> None:
    """Refuse a table that does not cover the times, or has a gap among them.

    `source` names the table and its rows, `noun` what the times belong to.
    """
    rows, times = np.asarray(table.times), np.asarray(times, float)
    check_span(rows, table.extrapolate, times, source, noun)
    # As in `interpolation.interval`, which decides for the image.
    i = np.clip(np.searchsorted(rows, times, side="right") - 1, 0, len(rows) - 2)
    is_gap = rows[i + 1] - rows[i] > table.gap
    if is_gap.any():
        k = int(is_gap.argmax())
        start, end = rows[i[k]], rows[i[k] + 1]
        raise InputError(
            f"{source(i[k] + 1)}: {noun} {k} at {times[k]:.9g} s is in the gap of "
            f"{end - start:.6g} s before this row; allow it with gap = {end - start:.6g}, or give "
            "rows"
        )


def _check_method(method: str, allowed_methods: Sequence[str], source: Source) -> None:
    if method not in allowed_methods:
        raise InputError(
            f"{source.name}: unknown interpolation "
            f"{method!r}{did_you_mean(method, allowed_methods)}"
        )


def _table(
    times: Float[np.ndarray, " rows"],
    values: Float[np.ndarray, "rows k"],
    rates: Float[np.ndarray, "rows k"] | None,
    method: str,
    order: int,
    gap: float | None,
    extrapolate: float,
    quantity: str,
    source: Source,
) -> TimeTable:
    # Masked values are NaN, and refused with their row.
    to_numbers = lambda array: numeric_array(source.name, array, "numbers").astype(float)
    times, values = to_numbers(times), to_numbers(values)
    if values.ndim != 2 or times.shape != values.shape[:1]:
        raise InputError(
            f"{source.name}: {times.shape} times and {quantity}s of shape {values.shape}; one "
            "row of values a time is expected"
        )
    rates = None if rates is None else to_numbers(rates)
    for name, array in ((quantity, values), ("velocity", rates)):
        if array is not None and (bad := ~np.isfinite(array).all(1)).any():
            raise InputError(f"{source(int(bad.argmax()))}: the {name} is not a finite number")
    if method in ("lagrange", "usgscsm") and order < 1:
        raise InputError(f"{source.name}: the order of {method!r} is {order}; at least 1 is needed")
    fewest = MIN_ROWS.get(method, order + 1)
    if len(times) < fewest:
        advice = " or a lower order" if method == "lagrange" else ""
        raise InputError(
            f"{source.name}: {len(times)} rows; {method!r} needs {fewest}; give more rows{advice}"
        )
    check_times(times, source)
    if method == "hermite" and rates is not None:
        if fault := contradiction(times, values, rates, source):
            raise InputError(f"{fault.message}, or another interpolation than 'hermite'")
    if gap is not None and not gap > 0:
        raise InputError(
            f"{source.name}: gap is {gap:g}; the longest step that is interpolated, in seconds, "
            "is expected, a positive number"
        )
    if not 0 <= extrapolate < np.inf:
        raise InputError(
            f"{source.name}: extrapolate is {extrapolate:g}; seconds beyond the ends of the table "
            "are expected, 0 or more"
        )
    # Up to four missing rows are interpolated. Larger: gaps are bridged unseen; smaller: uneven
    # tables are refused. Not critical: the user can state `gap`.
    gap = 5.0 * float(np.median(np.diff(times))) if gap is None else float(gap)
    kind = cast(Method, "linear" if method == "slerp" else method)
    return TimeTable(
        jnp.asarray(times),
        jnp.asarray(values),
        None if rates is None else jnp.asarray(rates),
        gap,
        kind,
        order,
        float(extrapolate),
    )
