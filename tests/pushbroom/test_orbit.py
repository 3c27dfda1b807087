"""Orbits from one state: circles, Kepler's laws, the drift of the node, files."""

import numpy as np
import pytest
from pushbroom_scenes import LINES, PIXELS, PLACE, locate, orbit, satellite
from scanner_files import TEXT, write_scanner
from scipy.spatial.transform import Rotation

from jaxbundle.errors import InputError
from jaxbundle.io.scanner.read import read_scanner
from jaxbundle.pushbroom.earth_frames import EARTH_RATE, GM
from jaxbundle.pushbroom.flight import Flight, true_image
from jaxbundle.pushbroom.orbit import J2, RADIUS, acceleration, state_orbit
from jaxbundle.pushbroom.surfaces import Ground

START = tuple(v[0] for v in orbit([0.0]))
RATE = np.sqrt(GM / (RADIUS + PLACE[0]) ** 3)


def inertial(t, P, V):
    turn = Rotation.from_euler("z", EARTH_RATE * t[:, None])
    return turn.apply(P), turn.apply(V + np.cross([0, 0, EARTH_RATE], P))


def test_without_flattening_it_is_a_circle():
    """Over more than a revolution, to and fro, from a state that is not the first."""
    t = np.array([-900.0, 4000.0, 0.0, 50.0, 6500.0])
    P, V = (v[0] for v in orbit([120.0]))
    for found, expected in zip(state_orbit(t, P, V, at=120.0, j2=False), orbit(t)):
        np.testing.assert_allclose(found, expected, atol=1e-3)


def test_with_flattening_the_node_drifts():
    """By −(3/2)·n·J2·(R/r)²·cos i, while r·v energy and the polar angular momentum stay."""
    t = np.linspace(0, 20 * 2 * np.pi / RATE, 2001)
    r, v = inertial(t, *state_orbit(t, *START))
    h = np.cross(r, v)
    node = np.unwrap(np.arctan2(h[:, 0], -h[:, 1]))
    height = RADIUS + PLACE[0]
    expected = -1.5 * RATE * J2 * (RADIUS / height) ** 2 * np.cos(PLACE[1])
    assert np.polyfit(t, node, 1)[0] == pytest.approx(expected, rel=0.01)
    distance = np.linalg.norm(r, axis=1)
    flattening = J2 * (RADIUS / distance) ** 2 * (1.5 * (r[:, 2] / distance) ** 2 - 0.5)
    energy = (v**2).sum(1) / 2 - GM / distance * (1 - flattening)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-9)
    np.testing.assert_allclose(h[:, 2], h[0, 2], rtol=1e-9)


def test_the_acceleration_is_the_gradient_of_the_potential():
    def potential(r):
        d = np.linalg.norm(r)
        return GM / d * (1 - J2 * (RADIUS / d) ** 2 * (1.5 * (r[2] / d) ** 2 - 0.5))

    for r in np.random.default_rng(2).normal(size=(5, 3)) * 4e6 + 3e6:
        steps = 10.0 * np.eye(3)
        expected = [(potential(r + s) - potential(r - s)) / 20 for s in steps]
        np.testing.assert_allclose(acceleration(r), expected, atol=1e-7)


@pytest.mark.parametrize("frame", ["ITRF", "GCRF"])
def test_a_state_in_a_file(tmp_path, frame):
    """The image of the tables from one state, Kepler; J2 moves it by metres in seconds."""
    from jaxbundle.pushbroom.earth_frames import to_earth

    P, V = START
    if frame == "GCRF":
        R = to_earth(frame, "2016-06-22T04:00:12.25", [0.0])[0]
        P, V = R.T @ P, R.T @ (V + np.cross([0, 0, EARTH_RATE], P))
    state = f"state = {[*map(float, P), *map(float, V)]}\nspan = [-6.0, 11.0]\nframe = '{frame}'"
    moved = []
    for j2 in ("false", "true"):
        text = TEXT.replace('table = "positions.csv"', f"{state}\nj2 = {j2}")
        image = read_scanner(write_scanner(tmp_path, text)).image
        places = np.array([0.0, LINES - 1]), np.array([0.0, PIXELS - 1])
        X, expected = (np.array(locate(i, Ground(), *places)) for i in (image, satellite()))
        moved.append(np.linalg.norm(X - expected, axis=0))
    assert moved[0].max() < (1e-3 if frame == "ITRF" else 0.3)
    assert moved[1][0].max() < 0.5 and 0.01 < moved[1][1].max() < 1.0


def test_a_flight_from_a_state():
    """The simulated trajectory of a circle, and of one of its states."""
    circle = dict(zip(("height", "inclination", "node", "argument"), PLACE))
    state = {"state": np.concatenate(START), "j2": False}
    flights = [Flight(100, 50, 0.01, satellite().optics, track) for track in (circle, state)]
    tables = [true_image(flight).trajectory.position for flight in flights]
    np.testing.assert_allclose(*(np.asarray(table.values) for table in tables), atol=1e-4)


@pytest.mark.parametrize("old, new, words", [
    ("6000000.0, ", "6.0, ", ["[position]", "centre of the Earth"]),
    ("6000000.0, ", "6000000.0, ", ["[position]", "6e+06 m", "below the ground"]),
    ("7500.0", "0.0", ["[position]", "reaches the ground"]),
    ("[-6.0, 11.0]", "[11.0, -6.0]", ["[position]", "forward"]),
    ("state", "stat", ["'stat'", "'state'"]),
])  # fmt: skip
def test_what_is_refused(tmp_path, old, new, words):
    state = "state = [6000000.0, 0.0, 3000000.0, 0.0, 7500.0, 0.0]\nspan = [-6.0, 11.0]".replace(
        old, new
    ).replace("3000000.0", "3.0" if old[0] == "6" else "3000000.0")
    if old == "7500.0":
        state = state.replace("11.0", "3000.0")
    text = TEXT.replace('table = "positions.csv"', state)
    with pytest.raises(InputError) as refused:
        read_scanner(write_scanner(tmp_path, text))
    for word in words:
        assert word in str(refused.value), refused.value
