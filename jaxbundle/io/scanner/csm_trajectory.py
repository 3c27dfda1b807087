"""Positions and attitudes of support data (ISD) of the Community Sensor Model, as tables.

- `instrument_pointing`, `body_rotation`: scalar-first quaternions, v_to = R(q)·v_J2000, then the
  constant rotation; here R_body·R_pointingᵀ;
- `sensor_orientation` of older files, and of model states: scalar-last, camera → body, evenly
  spaced, as `sensor_position`;
- positions in km, or in their `unit` (m of the older `sensor_position`).

Positions are resampled to 25 even rows at least, by Hermite's cubics (without velocities by
Lagrange's polynomial through four rows), and turned by R_body at these times.

`usgscsm` does what usgscsm and ALE do: the times of pointing and body are merged, both turned by
slerp at each of them, their product resampled evenly by slerp, positions and quaternions
interpolated by Lagrange's polynomial of fewer rows near the ends (`pushbroom.interpolation`).
`lagrange` takes R_body by slerp at even times of the pointing and keeps eight rows to the ends.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from jaxbundle.errors import InputError
from jaxbundle.io.text.json_fields import JsonFields
from jaxbundle.network.columns import did_you_mean, show
from jaxbundle.network.tables import Source
from jaxbundle.pushbroom.ancillary import (
    attitude_table,
    check_times,
    extrapolation_limit,
    normalise_quaternions,
    position_table,
    warn_of_extrapolation,
)
from jaxbundle.pushbroom.interpolation import interpolate
from jaxbundle.pushbroom.trajectory import Trajectory

INTERPOLATIONS = ("usgscsm", "lagrange")
UNITS = {"m": 1.0, "km": 1000.0}
FEWEST, ORDER = 25, 7
"""Minimum rows of resampled positions."""
ORTHOGONAL = 1e-4
"""Tolerance of R·Rᵀ relative to the identity, as of quaternions."""


class States(NamedTuple):
    """Positions (metres) and rotations camera → body at their times, and their extrapolation.

    Times are in seconds since the centre time; `extrapolate` are seconds beyond the ends of both.
    """

    t: Float[np.ndarray, " n"]
    P: Float[np.ndarray, "n 3"]
    rows: Float[np.ndarray, " m"]
    R: Rotation
    extrapolate: tuple[float, float]
    sources: tuple[Source, Source]
    warnings: tuple[str, ...]


def unit_of(isd: JsonFields, key: str, default: str) -> float:
    """Metres in the unit of a field."""
    unit = isd.get(f"{key}.unit", default)
    if unit not in UNITS:
        raise InputError(f"{isd.path}: {key}.unit is {show(unit)}; m or km is expected")
    return UNITS[unit]


def states_of(isd: JsonFields, lines: Float[np.ndarray, " lines"], interpolation: str) -> States:
    """The states of an ISD for lines at these times; tables may end a little before them.

    **Raises:** `InputError` naming file, field and row.
    """
    if interpolation not in INTERPOLATIONS:
        raise InputError(
            f"{isd.path}: unknown interpolation {interpolation!r}"
            f"{did_you_mean(interpolation, INTERPOLATIONS)}"
        )
    older = "sensor_position" in isd.document and "instrument_position" not in isd.document
    return _read_even_table(isd, lines) if older else _resample(isd, lines, interpolation)


def trajectory_of(states: States, turn: Rotation, interpolation: str, order: int) -> Trajectory:
    """The tables, the camera turned by `turn`."""
    q = np.roll((states.R * turn).as_quat(), 1, axis=1)

    def options(k, n):
        least = order if interpolation == "usgscsm" else min(order, n - 1)
        return {
            "method": interpolation,
            "order": least,
            "gap": np.inf,
            "extrapolate": states.extrapolate[k],
            "source": states.sources[k],
        }

    return Trajectory(
        position_table(states.t, states.P, **options(0, len(states.t))),
        attitude_table(states.rows, q, **options(1, len(states.rows))),
    )


def slerp(t: Float[np.ndarray, " n"], R: Rotation, at: Float[np.ndarray, " m"]) -> Rotation:
    """Rotations between rows, and beyond them at the rate of the first and last step."""
    i = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    part = (at - t[i]) / (t[i + 1] - t[i])
    return R[i] * Rotation.from_rotvec(part[:, None] * (R[i].inv() * R[i + 1]).as_rotvec())


def _read_even_table(isd, lines):
    """Even tables as they are."""
    P = isd.array("sensor_position.positions", (None, 3)) * unit_of(isd, "sensor_position", "m")
    q = isd.array("sensor_orientation.quaternions", (None, 4))
    tables = []
    for name, key, n in (("ephemeris", "position", len(P)), ("quaternion", "orientation", len(q))):
        t = isd.number(f"t0_{name}") + isd.number(f"dt_{name}") * np.arange(n)
        _check_rows(isd, f"sensor_{key}", t)
        tables.append((t, isd.source(f"sensor_{key}")))
    warnings = [w for t, source in tables for w in warn_of_extrapolation(t, lines, source)]
    (t, rows), sources = zip(*tables)
    R, lengths = _rotations(isd, "sensor_orientation", q)
    limits = extrapolation_limit(t), extrapolation_limit(rows)
    return States(t, P, rows, R, limits, sources, (*lengths, *warnings))


def _resample(isd, lines, interpolation):
    given = _times(isd, "instrument_position")
    _check_rows(isd, "instrument_position", given)
    body_times, body, body_lengths = _turns(isd, "body_rotation")
    pointing_times, pointing, pointing_lengths = _turns(isd, "instrument_pointing")
    tables = {
        "instrument_position": given,
        "instrument_pointing": pointing_times,
        "body_rotation": body_times,
    }
    warnings = [
        warning
        for key, t in tables.items()
        if len(t) > 1
        for warning in warn_of_extrapolation(t, lines, isd.source(key))
    ]
    t = np.linspace(given[0], given[-1], max(FEWEST, len(given)))
    P = body(t).apply(_positions(isd, given)(t))
    if interpolation == "usgscsm":
        merged = np.union1d(body_times, pointing_times)
        if len(merged) == 1:
            merged = merged + [0.0, 1.0]
        both = body(merged) * pointing(merged).inv()
        rows = np.linspace(merged[0], merged[-1], len(merged))
        R = slerp(merged, both, rows)
    else:
        rows = np.linspace(pointing_times[0], pointing_times[-1], max(2, len(pointing_times)))
        R = body(rows) * pointing(rows).inv()
    limits = extrapolation_limit(given), extrapolation_limit(pointing_times)
    sources = isd.source("instrument_position"), isd.source("instrument_pointing")
    lengths = *body_lengths, *pointing_lengths
    return States(t, P, rows, R, limits, sources, (*lengths, *warnings))


def _check_rows(isd, key, t):
    if len(t) < 2:
        raise InputError(f"{isd.path}: {key} has {len(t)} row; 2 at least")
    check_times(t, isd.source(key))


def _positions(isd, given) -> Callable:
    """Positions in the inertial frame, metres, at times."""
    scale = unit_of(isd, "instrument_position", "km")
    P = scale * isd.array("instrument_position.positions", (len(given), 3))
    if isd.get("instrument_position.velocities") is None:
        table = position_table(given, P, method="usgscsm", order=3, gap=np.inf)
        return lambda t: np.array(jax.vmap(lambda at: interpolate(table, at))(t))
    V = scale * isd.array("instrument_position.velocities", (len(given), 3))
    return CubicHermiteSpline(given, P, V)


def _times(isd, key):
    """Seconds since the centre time."""
    t = isd.array(f"{key}.ephemeris_times", (None,)) - isd.number("center_ephemeris_time")
    check_times(t, isd.source(key))
    return t


def _turns(isd, key):
    """Times, the rotation from J2000 into a frame as a function of times, and warnings."""
    t = _times(isd, key)
    R, lengths = _rotations(isd, key, isd.array(f"{key}.quaternions", (len(t), 4))[:, [1, 2, 3, 0]])
    fixed = isd.array(f"{key}.constant_rotation", (9,), np.eye(3).ravel()).reshape(3, 3)
    if not np.abs(fixed @ fixed.T - np.eye(3)).max() < ORTHOGONAL or np.linalg.det(fixed) < 0:
        raise InputError(
            f"{isd.path}: {key}.constant_rotation is not a rotation; nine numbers of an orthogonal "
            "matrix are expected, row by row"
        )
    constant = Rotation.from_matrix(fixed)
    if len(t) == 1:
        rate = isd.array(f"{key}.angular_velocities", (1, 3), np.zeros((1, 3)))[0]
        turned = lambda at: constant * Rotation.from_rotvec(np.outer(at - t[0], rate)) * R[0]
        return t, turned, lengths
    return t, lambda at: constant * slerp(t, R, at), lengths


def _rotations(isd, key, scalar_last):
    if not len(scalar_last):
        raise InputError(f"{isd.path}: {key}.quaternions is empty; a row for each time is expected")
    values, lengths = normalise_quaternions(scalar_last, isd.source(f"{key}.quaternions"))
    return Rotation.from_quat(values), lengths
