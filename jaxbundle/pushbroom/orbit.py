"""An orbit from one state vector: Kepler motion, optionally with J2.

    r̈ = −GM·r/r³ + a₂,      a₂ = −(3/2)·J2·GM·R²/r⁵·[(1 − 5z²/r²)·(x, y) ; (3 − 5z²/r²)·z]

(Vallado, 2013, Fundamentals of Astrodynamics, section 8.7.1), integrated by scipy's DOP853 in the
Earth axes at the time of the state, and rotated back uniformly: the pole of J2 is that of the
Earth, and only the Earth-fixed frame is needed. The neglected higher terms and drag grow to about
10 m in a minute, to kilometres in a revolution.
"""

import numpy as np
from jaxtyping import Float
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84
from jaxbundle.pushbroom.earth_frames import EARTH_RATE, GM, Rows

# The second zonal harmonic of the Earth, −√5·C̄₂₀ of EGM96 with C̄₂₀ = −484.165371736e-6.
J2 = 1.08262668e-3
# The reference radius of J2, metres.
RADIUS = float(WGS84.a)


def state_orbit(
    times: Float[np.ndarray, " rows"],
    position: Float[np.ndarray, "3"],
    velocity: Float[np.ndarray, "3"],
    at: float = 0.0,
    j2: bool = True,
) -> tuple[Rows, Rows]:
    """Earth-fixed positions (m) and velocities (m/s) of a satellite from one state.

    **Arguments:** `times` in seconds; `position`, `velocity` Earth-fixed, relative to the rotating
    Earth, at the time `at`; `j2`: include J2.

    **Raises:** `InputError` for a state below the ground, or an orbit that reaches it.
    """
    times, position = np.asarray(times, float), np.asarray(position, float)
    spin = np.array([0.0, 0.0, EARTH_RATE])
    start = np.r_[position, np.asarray(velocity, float) + np.cross(spin, position)]
    # As for the orbit (`_ground`).
    if not np.linalg.norm(position) > RADIUS:
        raise InputError(
            f"state: the position is {np.linalg.norm(position):.6g} m from the centre of the Earth,"
            " below the ground; metres, Earth-fixed or in the stated frame, are expected"
        )
    states = np.empty((len(times), 6))
    tolerance = 1e-12  # relative: 1e-5 m in a revolution
    # Forward and backward from the epoch: `solve_ivp` integrates in one direction.
    for part, order in ((times >= at, 1), (times < at, -1)):
        sorted_times = np.sort(times[part])[::order]
        if not len(sorted_times):
            continue
        solution = solve_ivp(
            lambda _, y: np.r_[y[3:], acceleration(y[:3], j2)],
            (at, sorted_times[-1]),
            start,
            "DOP853",
            t_eval=sorted_times,
            rtol=tolerance,
            atol=tolerance * np.r_[np.full(3, 1e7), np.full(3, 1e4)],
            events=_ground,
        )
        if solution.status < 0:
            raise InputError(
                "state: the orbit cannot be computed; check position and velocity, their unit and "
                "frame"
            )
        if solution.status:
            raise InputError(
                f"state: the orbit reaches the ground at {solution.t_events[0][0]:.6g} s; check "
                "the velocity, its unit and frame"
            )
        # Times need not be sorted, but those of the integration are.
        states[part] = solution.y.T[np.searchsorted(order * sorted_times, order * times[part])]
    # From the axes at the epoch to those that have turned since.
    to_present = Rotation.from_euler("z", -EARTH_RATE * (times - at)[:, None])
    P = to_present.apply(states[:, :3])
    return P, to_present.apply(states[:, 3:]) - np.cross(spin, P)


def acceleration(r: Float[np.ndarray, "3"], j2: bool = True) -> Float[np.ndarray, "3"]:
    """r̈ in metres a second squared."""
    distance = np.linalg.norm(r)
    central = -GM * r / distance**3
    if not j2:
        return central
    polar = 5 * (r[2] / distance) ** 2
    return central - 1.5 * J2 * GM * RADIUS**2 / distance**5 * r * (np.array([1, 1, 3.0]) - polar)


def _ground(_: float, y: Float[np.ndarray, "6"]) -> float:
    return float(np.linalg.norm(y[:3])) - RADIUS


_ground.terminal = True
