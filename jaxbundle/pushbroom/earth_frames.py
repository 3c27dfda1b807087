"""Transformation of inertial frames to Earth-fixed ones at the epochs of a table.

    GCRF    the celestial system of the IERS, x_ITRF = W·R3(ERA)·Q·x_GCRF        (IAU 2006/2000A)
    J2000   mean equator and equinox of J2000.0: GCRF less the frame bias (23 mas, 0.8 m)
    TEME    true equator, mean equinox, of two-line elements: x_ITRF = W·R3(GMST82)·x_TEME

(IERS Conventions 2010, chapter 5; Vallado et al., 2006, AIAA 2006-6753). W is the polar motion.
Velocities are reduced by the Earth's rotation, V = R·v − Ω × P. Neglecting UT1 − UTC (below 0.9 s)
moves the ground by up to 400 m, neglecting the pole (below 0.6″) by up to 19 m.

Needs pyerfa; two-line elements need sgp4 (both in the extra `geo`).
"""

import datetime
import warnings
from typing import Literal, NamedTuple, overload

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84
from jaxbundle.network.columns import did_you_mean
from jaxbundle.types import Numbers

FRAMES = ("ITRF", "GCRF", "J2000", "TEME")
# Angular velocity of the Earth, rad/s (WGS 84).
EARTH_RATE = 7.292115e-5
# Geocentric gravitational constant, m³/s² (WGS 84).
GM = 3.986004418e14
ARCSECOND = np.pi / 648000
# The radius of the equator above which the height of an orbit is, metres.
EQUATOR = float(WGS84.a)
# Seconds of a day; ERFA's quasi Julian date of UTC stretches the day of a leap second.
DAY = 86400.0

Matrices = Float[np.ndarray, "rows 3 3"]
Rows = Float[np.ndarray, "rows 3"]


class EarthOrientation(NamedTuple):
    """UT1 − UTC in seconds, pole coordinates in arcseconds (IERS Bulletin A or C04); default
    zero."""

    ut1_utc: float = 0.0
    x_pole: float = 0.0
    y_pole: float = 0.0


def to_earth(
    frame: str,
    epoch: str,
    times: Numbers,
    orientation: EarthOrientation = EarthOrientation(),  # noqa: B008
) -> Matrices:
    """The matrices R with x_ITRF = R·x_frame.

    **Arguments:** `frame` of `FRAMES`; `epoch` in UTC, ISO 8601; `times` in seconds since it.

    **Raises:** `InputError` for an unknown frame, an invalid date, and without pyerfa.
    """
    if frame not in FRAMES:
        raise InputError(f"unknown frame {frame!r}{did_you_mean(frame, FRAMES)}")
    times = np.asarray(times, float)
    if frame == "ITRF":
        return np.broadcast_to(np.eye(3), (len(times), 3, 3))
    try:
        import erfa
    except ImportError:
        raise InputError("inertial frames need pyerfa: pip install 'jaxbundle[geo]'") from None
    day, part = julian_date(epoch)
    part = part + times / DAY
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)  # leap seconds of years to come
        ut1 = erfa.utcut1(day, part, orientation.ut1_utc)
        tt = erfa.taitt(*erfa.utctai(day, part))
    pole = orientation.x_pole * ARCSECOND, orientation.y_pole * ARCSECOND
    # TEME: the equinox of GMST82; the same sidereal time that the elements were made with
    if frame == "TEME":
        return erfa.pom00(*pole, 0.0) @ _rotations_about("z", -erfa.gmst82(*ut1)).as_matrix()
    matrices = erfa.c2t06a(*tt, *ut1, *pole)
    if frame == "J2000":
        # At the epoch J2000.0, as the frame is fixed.
        bias, _, _ = erfa.bp06(2451545.0, 0.0)
        matrices = matrices @ bias.T
    return matrices


@overload
def turn_positions(
    R: Matrices, positions: Rows, velocities: Rows, orientation: EarthOrientation = ...
) -> tuple[Rows, Rows]: ...


@overload
def turn_positions(
    R: Matrices, positions: Rows, velocities: None = ..., orientation: EarthOrientation = ...
) -> tuple[Rows, None]: ...


@overload
def turn_positions(
    R: Matrices, positions: Rows, velocities: Rows | None, orientation: EarthOrientation = ...
) -> tuple[Rows, Rows | None]: ...


def turn_positions(
    R: Matrices,
    positions: Rows,
    velocities: Rows | None = None,
    orientation: EarthOrientation = EarthOrientation(),  # noqa: B008
) -> tuple[Rows, Rows | None]:
    """Earth-fixed positions, and velocities relative to the turning Earth, of inertial ones."""
    P = np.einsum("nij,nj->ni", R, positions)
    if velocities is None:
        return P, None
    x, y = orientation.x_pole * ARCSECOND, orientation.y_pole * ARCSECOND
    # Ω is along the celestial intermediate pole, up to 0.6″ off the z axis: 1.5 mm/s in a low orbit
    spin = EARTH_RATE * np.array([x, -y, 1.0])
    return P, np.einsum("nij,nj->ni", R, velocities) - np.cross(spin, P)


def turn_quaternions(R: Matrices, quaternions: Float[np.ndarray, "rows 4"]) -> np.ndarray:
    """Quaternions (w, x, y, z) camera → Earth-fixed of those camera → inertial."""
    turned = Rotation.from_matrix(R) * Rotation.from_quat(np.roll(quaternions, -1, axis=1))
    return np.roll(turned.as_quat(), 1, axis=1)


def two_line_orbit(
    first: str,
    second: str,
    epoch: str,
    times: Numbers,
    orientation: EarthOrientation = EarthOrientation(),  # noqa: B008
) -> tuple[Rows, Rows]:
    """Earth-fixed positions (m) and velocities (m/s) of two-line elements by SGP4.

    Accurate to about 1 km at the epoch of the elements, degrading by 1 to 3 km per day.
    """
    try:
        from sgp4.api import SGP4_ERRORS, Satrec
    except ImportError:
        raise InputError("two-line elements need sgp4: pip install 'jaxbundle[geo]'") from None
    first, second = first.strip(), second.strip()
    for number, line in enumerate((first, second), 1):
        # Modulo 10 of the digits, a minus sign counting 1.
        checksum = str(sum(int(c) if c.isdigit() else c == "-" for c in line[:68]) % 10)
        if not (len(line) == 69 and line[:2] == f"{number} " and checksum == line[68]):
            raise InputError(
                f"two-line elements, line {number}: {line!r} is damaged (69 characters, the last "
                "the checksum, are expected); copy it again"
            )
    if first[2:7] != second[2:7]:
        raise InputError("two-line elements: the lines belong to two satellites; copy them again")
    satellite = Satrec.twoline2rv(first, second)
    times = np.asarray(times, float)
    day, part = julian_date(epoch)
    error, km, km_s = satellite.sgp4_array(np.full(len(times), day), part + times / DAY)
    if error.any():
        row = int((error != 0).argmax())
        raise InputError(f"two-line elements at {times[row]:g} s: {SGP4_ERRORS[int(error[row])]}")
    R = to_earth("TEME", epoch, times, orientation)
    return turn_positions(R, 1e3 * km, 1e3 * km_s, orientation)


def check_orbit_height(height: float, where: str = "", lowest: float = 100e3) -> None:
    """Refuse the height of a circular orbit on which no satellite stays, metres; `where` begins
    the message. `lowest`: the edge of space (FAI), below which the air stops satellites within a
    revolution.

    **Raises:** `InputError`."""
    if not height >= lowest:
        raise InputError(
            f"{where}height is {height:g}; expected metres above the equator, {lowest:g} or "
            "more of an orbit: is it in kilometres?"
        )


def circular_orbit(
    times: Float[np.ndarray, " rows"],
    height: float,
    inclination: float,
    node: float = 0.0,
    argument: float = 0.0,
    radius: float = EQUATOR,
) -> tuple[Rows, Rows]:
    """Earth-fixed positions (m) and velocities (m/s) on a circular orbit about the rotating Earth.

    **Arguments:** `height` above a sphere of this `radius` (WGS 84: its semi-major axis), metres;
    `inclination`; longitude of the ascending `node` and `argument` of latitude at t = 0, radians.
    Kepler's rate, no perturbations.

    **Raises:** `InputError` for an orbit on which no satellite stays.
    """
    times = np.asarray(times, float)
    r = radius + height
    check_orbit_height(r - EQUATOR)
    rate = np.sqrt(GM / r**3)
    u = argument + rate * times
    plane = _rotations_about("z", node - EARTH_RATE * times) * _rotations_about(
        "x", np.array([inclination])
    )
    P = plane.apply(r * np.stack([np.cos(u), np.sin(u), 0 * u], 1))
    V = plane.apply(r * rate * np.stack([-np.sin(u), np.cos(u), 0 * u], 1))
    return P, V - np.cross([0, 0, EARTH_RATE], P)


def julian_date(epoch: str) -> tuple[float, float]:
    """Two parts of the (quasi) Julian date of an epoch in UTC, ISO 8601."""
    try:
        moment = datetime.datetime.fromisoformat(str(epoch))
    except ValueError:
        raise InputError(
            f"epoch {epoch!r} is not a date; ISO 8601 in UTC is expected, such as "
            "2024-03-01T10:20:30.5"
        ) from None
    if moment.tzinfo is not None:
        moment = moment.astimezone(datetime.UTC).replace(tzinfo=None)
    days = (moment - datetime.datetime(2000, 1, 1)).days
    midnight = datetime.datetime(2000, 1, 1) + datetime.timedelta(days)
    return 2451544.5 + days, (moment - midnight).total_seconds() / DAY


def _rotations_about(axis: Literal["x", "z"], angles: Float[np.ndarray, " n"]) -> Rotation:
    return Rotation.from_euler(axis, angles[:, None])
