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
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.io.networks.poses import are_rotations
from jaxbundle.io.text.json_fields import JsonFields
from jaxbundle.network.columns import did_you_mean
from jaxbundle.network.tables import Source
from jaxbundle.pushbroom.ancillary import (
    AncillarySettings,
    attitude_table,
    check_times,
    contradiction,
    extrapolation_limit,
    normalise_quaternions,
    position_table,
    warn_of_extrapolation,
)
from jaxbundle.pushbroom.interpolation import interpolate
from jaxbundle.pushbroom.trajectory import Trajectory

INTERPOLATIONS = ("usgscsm", "lagrange")
UNITS = {"m": 1.0, "km": 1000.0}
# Degree of the polynomial through eight rows with which usgscsm (`m_platformFlag` 1) and the SPOT
# 123-4-5 Geometry Handbook interpolate positions; taken for the other products too.
LAGRANGE_ORDER = 7
Times = Float[np.ndarray, " n"]
# Rotations at times.
RotationFunction = Callable[[Times], Rotation]


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
        raise InputError(f"{isd.path}: {key}.unit is {show(unit)}; expected m or km")
    return UNITS[unit]


def states_of(
    isd: JsonFields,
    lines: Float[np.ndarray, " lines"],
    interpolation: str,
    settings: AncillarySettings,
) -> States:
    """The states of an ISD for lines at these times; tables may end a little before them, by what
    the settings allow.

    **Raises:** `InputError` naming file, field and row.
    """
    if interpolation not in INTERPOLATIONS:
        raise InputError(
            f"{isd.path}: unknown interpolation {interpolation!r}"
            f"{did_you_mean(interpolation, INTERPOLATIONS)}"
        )
    older = "sensor_position" in isd.document and "instrument_position" not in isd.document
    if older:
        return _read_even_table(isd, lines, settings)
    return _resample_tables(isd, lines, interpolation, settings)


def pose_at_centre(isd: JsonFields) -> tuple[Float[np.ndarray, "3"], Rotation, tuple[str, ...]]:
    """The pose of a photograph: projection centre, the rotation from the camera into the frame of
    the body, and warnings. Of tables with several rows the state at the centre time; a single row
    is taken as it is.

    **Raises:** `InputError` naming file and field.
    """
    if "sensor_position" in isd.document and "instrument_position" not in isd.document:
        P = isd.array("sensor_position.positions", (1, 3)) * unit_of(isd, "sensor_position", "m")
        R, length_warnings = _parse_rotations(
            isd, "sensor_orientation", isd.array("sensor_orientation.quaternions", (1, 4))
        )
        return P[0], R[0], length_warnings
    P, R, warnings = poses_at(isd, np.zeros(1))
    return P[0], R[0], warnings


def poses_at(
    isd: JsonFields, query_times: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 3"], Rotation, tuple[str, ...]]:
    """Poses at times, seconds since the centre time: projection centres, the rotations from the
    camera into the frame of the body, and warnings. A table with a single row holds for all times;
    others hold for one step beyond their ends.

    **Raises:** `InputError` naming file and field.
    """
    body_times, body, body_warnings = _rotation_function(isd, "body_rotation")
    times, pointing, pointing_warnings = _rotation_function(isd, "instrument_pointing")
    position_times = _times(isd, "instrument_position")
    for name, rows in (
        ("body_rotation", body_times),
        ("instrument_pointing", times),
        ("instrument_position", position_times),
    ):
        if len(rows) > 1 and len(query_times) > 1:
            step = np.diff(rows).max()
            if query_times.min() < rows[0] - step or query_times.max() > rows[-1] + step:
                raise InputError(
                    f"{isd.path}: {name} has times from {rows[0]:.6g} to {rows[-1]:.6g} s of the "
                    f"centre time, the image needs {query_times.min():.6g} to "
                    f"{query_times.max():.6g} s"
                )
    of_table = lambda t: t if len(t) == 1 else query_times
    if len(position_times) == 1:
        scale = unit_of(isd, "instrument_position", "km")
        inertial, position_warnings = scale * isd.array("instrument_position.positions", (1, 3)), ()
    else:
        position_at, position_warnings = _positions(isd, position_times)
        inertial = position_at(query_times)
    X0 = body(of_table(position_times)).apply(inertial)
    R = body(of_table(times)) * pointing(of_table(times)).inv()
    return X0, R, (*body_warnings, *pointing_warnings, *position_warnings)


def trajectory_of(states: States, rotation: Rotation, interpolation: str, order: int) -> Trajectory:
    """The tables, the camera turned by `rotation`."""
    q = np.roll((states.R * rotation).as_quat(), 1, axis=1)

    def options(k: int, n: int) -> dict[str, Any]:
        table_order = order if interpolation == "usgscsm" else min(order, n - 1)
        return {
            "method": interpolation,
            "order": table_order,
            "gap": np.inf,
            "extrapolate": states.extrapolate[k],
            "source": states.sources[k],
        }

    return Trajectory(
        position_table(states.t, states.P, **options(0, len(states.t))),
        attitude_table(states.rows, q, **options(1, len(states.rows))),
    )


def slerp(t: Float[np.ndarray, " n"], R: Rotation, times: Float[np.ndarray, " m"]) -> Rotation:
    """Rotations between rows, and beyond them at the rate of the first and last step (Shoemake,
    1985): R(t) = Rᵢ·exp(u·log(Rᵢᵀ·Rᵢ₊₁)), u the part of the interval. SciPy's `Slerp` refuses
    times outside the rows."""
    i = np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 2)
    part = (times - t[i]) / (t[i + 1] - t[i])
    return R[i] * Rotation.from_rotvec(part[:, None] * (R[i].inv() * R[i + 1]).as_rotvec())


def view_directions(
    t: Float[np.ndarray, " n"],
    P: Float[np.ndarray, "n 3"],
    rows: Float[np.ndarray, " m"],
    R: Rotation,
    time: float,
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Approximate directions down and of flight in the camera frame: they only decide which axis
    is which, so that linear interpolation and a difference over a millisecond suffice."""
    position, next_position = (
        np.array([np.interp(time + dt, t, p) for p in P.T]) for dt in (0, 1e-3)
    )
    camera = slerp(rows, R, np.array([time]))[0].inv()
    return camera.apply(-position), camera.apply(next_position - position)


def _read_even_table(
    isd: JsonFields, lines: Float[np.ndarray, " lines"], settings: AncillarySettings
) -> States:
    """Even tables as they are."""
    P = isd.array("sensor_position.positions", (None, 3)) * unit_of(isd, "sensor_position", "m")
    q = isd.array("sensor_orientation.quaternions", (None, 4))
    tables = []
    for name, key, n in (("ephemeris", "position", len(P)), ("quaternion", "orientation", len(q))):
        t = isd.number(f"t0_{name}") + isd.number(f"dt_{name}") * np.arange(n)
        _check_rows(isd, f"sensor_{key}", t)
        tables.append((t, isd.source(f"sensor_{key}")))
    warnings = [
        w for t, source in tables for w in warn_of_extrapolation(t, lines, source, settings)
    ]
    (t, rows), sources = zip(*tables)
    R, length_warnings = _parse_rotations(isd, "sensor_orientation", q)
    limits = extrapolation_limit(t, settings), extrapolation_limit(rows, settings)
    return States(t, P, rows, R, limits, sources, (*length_warnings, *warnings))


def _resample_tables(
    isd: JsonFields,
    lines: Float[np.ndarray, " lines"],
    interpolation: str,
    settings: AncillarySettings,
) -> States:
    position_times = _times(isd, "instrument_position")
    _check_rows(isd, "instrument_position", position_times)
    body_times, body, body_warnings = _rotation_function(isd, "body_rotation")
    pointing_times, pointing, pointing_warnings = _rotation_function(isd, "instrument_pointing")
    tables = {
        "instrument_position": position_times,
        "instrument_pointing": pointing_times,
        "body_rotation": body_times,
    }
    warnings = [
        warning
        for key, t in tables.items()
        if len(t) > 1
        for warning in warn_of_extrapolation(t, lines, isd.source(key), settings)
    ]
    # At least 25 rows, so that the eight rows of the polynomial lie close about every line of a
    # short image, of which the file may have two states. Hermite's cubic between states h seconds
    # apart errs by r·ω⁴·h⁴/384: in a low orbit of the Earth below a millimetre up to 14 s.
    t = np.linspace(position_times[0], position_times[-1], max(25, len(position_times)))
    inertial, position_warnings = _positions(isd, position_times)
    P = body(t).apply(inertial(t))
    if interpolation == "usgscsm":
        union_times = np.union1d(body_times, pointing_times)
        if len(union_times) == 1:
            union_times = union_times + [0.0, 1.0]
        rotations = body(union_times) * pointing(union_times).inv()
        rows = np.linspace(union_times[0], union_times[-1], len(union_times))
        R = slerp(union_times, rotations, rows)
    else:
        rows = np.linspace(pointing_times[0], pointing_times[-1], len(pointing_times))
        if len(rows) == 1:
            rows = rows + [0.0, 1.0]
        R = body(rows) * pointing(rows).inv()
    limit_of = partial(extrapolation_limit, settings=settings)
    limits = limit_of(position_times), limit_of(pointing_times)
    sources = isd.source("instrument_position"), isd.source("instrument_pointing")
    rotation_warnings = *body_warnings, *pointing_warnings
    return States(
        t, P, rows, R, limits, sources, (*rotation_warnings, *position_warnings, *warnings)
    )


def _check_rows(isd: JsonFields, key: str, t: Float[np.ndarray, " n"]) -> None:
    if len(t) < 2:
        raise InputError(f"{isd.path}: {key} has {len(t)} row; 2 at least")
    check_times(t, isd.source(key))


def _positions(
    isd: JsonFields, t: Float[np.ndarray, " n"]
) -> tuple[Callable[[Times], Float[np.ndarray, "n 3"]], tuple[str, ...]]:
    """Positions in the inertial frame, metres, at times; warnings."""
    scale = unit_of(isd, "instrument_position", "km")
    P = scale * isd.array("instrument_position.positions", (len(t), 3))
    warnings: tuple[str, ...] = ()
    if isd.get("instrument_position.velocities") is not None:
        V = scale * isd.array("instrument_position.velocities", (len(t), 3))
        mismatch = contradiction(t, P, V, isd.source("instrument_position.velocities"))
        # Orbits are known to better than 100 m; a smaller error is interpolated as usgscsm does.
        uses_velocities = mismatch is None or mismatch.shift < 100
        if mismatch is not None:
            treatment = (
                "used all the same"
                if uses_velocities
                else "not used; positions are interpolated alone"
            )
            warnings = (
                f"{mismatch.message}: up to {mismatch.shift:.2g} m between the rows; {treatment}",
            )
        if uses_velocities:
            return CubicHermiteSpline(t, P, V), warnings
    # As for rotations, how far beyond the ends is for the caller to check.
    step = float(np.diff(t).max())
    table = position_table(t, P, method="usgscsm", order=3, gap=np.inf, extrapolate=step)
    return lambda times: np.array(jax.vmap(lambda time: interpolate(table, time))(times)), warnings


def _times(isd: JsonFields, key: str) -> Float[np.ndarray, " n"]:
    """Seconds since the centre time."""
    t = isd.array(f"{key}.ephemeris_times", (None,)) - isd.number("center_ephemeris_time")
    check_times(t, isd.source(key))
    return t


def _rotation_function(
    isd: JsonFields, key: str
) -> tuple[Float[np.ndarray, " n"], RotationFunction, tuple[str, ...]]:
    """Times, the rotation from J2000 into a frame as a function of times, and warnings."""
    t = _times(isd, key)
    R, length_warnings = _parse_rotations(
        isd, key, isd.array(f"{key}.quaternions", (len(t), 4))[:, [1, 2, 3, 0]]
    )
    fixed = isd.array(f"{key}.constant_rotation", (9,), np.eye(3).ravel()).reshape(3, 3)
    if not are_rotations(fixed):
        raise InputError(
            f"{isd.path}: {key}.constant_rotation is not a rotation; expected nine numbers of an "
            "orthogonal matrix, row by row"
        )
    constant = Rotation.from_matrix(fixed)
    if len(t) == 1:
        has_rates = isd.get(f"{key}.angular_velocities") is not None  # null where they are unknown
        rate = isd.array(f"{key}.angular_velocities", (1, 3))[0] if has_rates else np.zeros(3)
        rotation_at = lambda times: (
            constant * Rotation.from_rotvec(np.outer(times - t[0], rate)) * R[0]
        )
        return t, rotation_at, length_warnings
    return t, lambda times: constant * slerp(t, R, times), length_warnings


def _parse_rotations(
    isd: JsonFields, key: str, scalar_last: Float[np.ndarray, "n 4"]
) -> tuple[Rotation, tuple[str, ...]]:
    if not len(scalar_last):
        raise InputError(f"{isd.path}: {key}.quaternions is empty; expected a row for each time")
    values, length_warnings = normalise_quaternions(scalar_last, isd.source(f"{key}.quaternions"))
    return Rotation.from_quat(values), length_warnings
