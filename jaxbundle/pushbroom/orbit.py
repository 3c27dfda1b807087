"""An orbit from one state vector: two bodies, and the flattening of the Earth (J2) if asked for.

    r̈ = −GM·r/r³ + a₂,      a₂ = −(3/2)·J2·GM·R²/r⁵·[(1 − 5z²/r²)·(x, y) ; (3 − 5z²/r²)·z]

(Vallado, 2013, Fundamentals of Astrodynamics, section 8.7.1), integrated by DOP853 of scipy in the
axes that the Earth has at the moment of the state, and turned back by its uniform rotation: so the
pole of J2 is that of the Earth, and no frame but the Earth-fixed one is needed. What is left out,
higher terms and drag, grows to some 10 m in a minute, to kilometres in a revolution.
"""

import numpy as np
from jaxtyping import Float
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from jaxbundle.errors import InputError
from jaxbundle.pushbroom.earth_frames import EARTH_RATE, GM, Rows

J2 = 1.08262668e-3
RADIUS = 6378137.0
"""The radius that belongs to J2, metres (WGS 84)."""
TOLERANCE = 1e-12
"""Of the integration, relative; 1e-5 m in a revolution."""


def state_orbit(
    times: Float[np.ndarray, " rows"],
    position: Float[np.ndarray, "3"],
    velocity: Float[np.ndarray, "3"],
    at: float = 0.0,
    j2: bool = True,
) -> tuple[Rows, Rows]:
    """Earth-fixed positions (m) and velocities (m/s) of a satellite whose state is known once.

    **Arguments:** `times` in seconds; `position`, `velocity` Earth-fixed, relative to the turning
    Earth, at the time `at`; `j2`: with the flattening of the Earth.

    **Raises:** `InputError` for a state below the ground, or an orbit that comes there.
    """
    times, position = np.asarray(times, float), np.asarray(position, float)
    spin = np.array([0.0, 0.0, EARTH_RATE])
    start = np.r_[position, np.asarray(velocity, float) + np.cross(spin, position)]
    if not np.linalg.norm(position) > RADIUS / 2:
        raise InputError(
            f"state: the position is {np.linalg.norm(position):.6g} m from the centre of the Earth;"
            " metres, Earth-fixed or in the frame that is told, are expected"
        )
    states = np.empty((len(times), 6))
    for part, order in ((times >= at, 1), (times < at, -1)):
        when = np.sort(times[part])[::order]
        if not len(when):
            continue
        found = solve_ivp(
            lambda t, y: np.r_[y[3:], acceleration(y[:3], j2)], (at, when[-1]), start, "DOP853",
            t_eval=when, rtol=TOLERANCE, atol=TOLERANCE * np.r_[np.full(3, 1e7), np.full(3, 1e4)],
            events=_ground,
        )  # fmt: skip
        if found.status:
            raise InputError(
                f"state: the orbit is at the ground at {found.t_events[0][0]:.6g} s; look at the "
                "velocity, its unit and frame"
            )
        states[part] = found.y.T[np.searchsorted(order * when, order * times[part])]
    back = Rotation.from_euler("z", -EARTH_RATE * (times - at)[:, None])
    P = back.apply(states[:, :3])
    return P, back.apply(states[:, 3:]) - np.cross(spin, P)


def acceleration(r: Float[np.ndarray, "3"], j2: bool = True) -> Float[np.ndarray, "3"]:
    """r̈ in metres a second squared."""
    distance = np.linalg.norm(r)
    central = -GM * r / distance**3
    if not j2:
        return central
    polar = 5 * (r[2] / distance) ** 2
    return central - 1.5 * J2 * GM * RADIUS**2 / distance**5 * r * (np.array([1, 1, 3.0]) - polar)


def _ground(t, y):
    return np.linalg.norm(y[:3]) - RADIUS


_ground.terminal = True
