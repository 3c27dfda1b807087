"""Interpolation of positions and attitudes against scipy, and what is refused."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline, CubicSpline, KroghInterpolator, interp1d
from scipy.spatial.transform import Rotation, Slerp

from jaxbundle.errors import InputError
from jaxbundle.network.tables import Source
from jaxbundle.pushbroom.ancillary import attitude_table, check_covered, continuous, position_table
from jaxbundle.pushbroom.interpolation import interpolate, rate
from jaxbundle.pushbroom.trajectory import (
    Trajectory,
    attitude_at,
    matrix_from_pitch_roll_yaw,
    orbital_frame,
    rotation_at,
    trajectory_in_pieces,
)

rng = np.random.default_rng(1)
TIMES = np.cumsum(rng.uniform(0.5, 1.5, 12))
VALUES = np.stack([np.sin(TIMES), np.cos(0.7 * TIMES), TIMES**2], 1)
RATES = np.stack([np.cos(TIMES), -0.7 * np.sin(0.7 * TIMES), 2 * TIMES], 1)
BETWEEN = np.r_[TIMES[0], rng.uniform(TIMES[0], TIMES[-1], 40), TIMES[5], TIMES[-1]]
at = jax.jit(jax.vmap(interpolate, (None, 0)))
turned = jax.jit(jax.vmap(attitude_at, (None, 0)))


rates = jax.jit(jax.vmap(rate, (None, 0)))
pieces = jax.jit(trajectory_in_pieces)


@jax.jit
def with_derivatives(table, values, change, t):
    """Value, rate, and the derivative in the direction of a change of the values."""
    of = lambda values: interpolate(eqx.tree_at(lambda table: table.values, table, values), t)
    value, weight = jax.jvp(of, (values,), (change,))
    return value, rate(table, t), weight


def lagrange(order):
    """Newton's form of the polynomial through the rows about t."""

    def value(t):
        i = np.clip(np.searchsorted(TIMES, t, side="right") - 1, 0, len(TIMES) - 2)
        first = np.clip(i - (order - 1) // 2, 0, len(TIMES) - order - 1)
        rows = slice(first, first + order + 1)
        return KroghInterpolator(TIMES[rows], VALUES[rows])(t)

    return lambda times: np.array([value(t) for t in times])


def as_usgscsm(order):
    """As many rows before t as after it, (order + 1)/2 at most on each side."""

    def value(t):
        i = np.clip(np.searchsorted(TIMES, t, side="right") - 1, 0, len(TIMES) - 2)
        half = min(i + 1, len(TIMES) - 1 - i, (order + 1) // 2)
        rows = slice(i + 1 - half, i + 1 + half)
        return KroghInterpolator(TIMES[rows], VALUES[rows])(t)

    return lambda times: np.array([value(t) for t in times])


ORACLES = {
    "linear": interp1d(TIMES, VALUES, axis=0),
    "hermite": CubicHermiteSpline(TIMES, VALUES, RATES),
    "spline": CubicSpline(TIMES, VALUES),
    "lagrange 3": lagrange(3),
    "lagrange 7": lagrange(7),
    "usgscsm 3": as_usgscsm(3),
    "usgscsm 7": as_usgscsm(7),
}


def table_of(name, values=VALUES, **options):
    method, *order = name.split()
    order = {"order": int(order[0])} if order else {}
    return position_table(TIMES, values, RATES, method=method, **order, **options)


@pytest.mark.parametrize("name", ORACLES)
def test_positions_between_the_rows(name):
    found = at(table_of(name), BETWEEN)
    np.testing.assert_allclose(found, ORACLES[name](BETWEEN), rtol=1e-12, atol=1e-11)


@pytest.mark.parametrize("name", ORACLES)
def test_rates_and_derivatives_by_the_rows(name):
    """The rate against differences in time; the derivative by a row is the weight of the row."""
    table = table_of(name)
    t = TIMES[4] + 0.3
    h = 1e-5
    difference = (ORACLES[name]([t + h]) - ORACLES[name]([t - h]))[0] / (2 * h)
    change = np.zeros_like(VALUES)
    change[4] = 1
    value, speed, weight = with_derivatives(table, VALUES, change, t)
    np.testing.assert_allclose(speed, difference, atol=1e-6)
    moved, *_ = with_derivatives(table, VALUES + change, change, t)
    np.testing.assert_allclose(weight, moved - value, atol=1e-11)


@pytest.mark.parametrize("name", ORACLES)
def test_nothing_is_extrapolated(name):
    ends = np.array([TIMES[0] - 1e-9, TIMES[-1] + 1e-9])
    assert np.isnan(at(table_of(name), np.r_[ends, BETWEEN][: len(BETWEEN)])[:2]).all()


POSITIONS = Source("positions.csv", 10 + np.arange(20) + (np.arange(20) > 4) * 2, "line")


def test_gaps_are_not_bridged():
    keep = np.r_[0:5, 11]
    table = position_table(TIMES[keep], VALUES[keep], method="linear", gap=3)
    inside, before = TIMES[8], TIMES[3] + 0.1
    found = at(table, np.r_[inside, before, BETWEEN][: len(BETWEEN)])
    assert np.isnan(found[0]).all() and np.isfinite(found[1]).all()
    with pytest.raises(InputError, match="positions.csv, line 17: image line 1 .* in the gap"):
        check_covered(table, [before, inside], POSITIONS)
    wide = position_table(TIMES[keep], VALUES[keep], method="linear", gap=100)
    check_covered(wide, [before, inside], POSITIONS)


@pytest.mark.parametrize("rows", [(0, 4, 12), (0, 5, 8, 12), (0, 2, 7, 12), (0, 1, 12)])
def test_splines_end_at_gaps(rows):
    """Against scipy's splines of the rows between gaps: of two a line, of three a parabola."""
    runs = list(zip(rows, rows[1:]))
    t = TIMES + 50.0 * np.repeat(np.arange(len(runs)), np.diff(rows))
    table = position_table(t, VALUES, method="spline", gap=10)
    for first, last in runs:
        if last - first > 1:
            inside = np.linspace(t[first], t[last - 1], len(BETWEEN), endpoint=False)
            own = CubicSpline(t[first:last], VALUES[first:last])
            np.testing.assert_allclose(at(table, inside), own(inside), rtol=1e-12, atol=1e-10)
    assert np.isnan(at(table, np.full(len(BETWEEN), t[rows[1]] - 1.0))).all()


ROTATIONS = Rotation.from_euler(
    "XYZ", np.stack([0.2 * np.sin(TIMES), 3 + 0.1 * TIMES, 0.3 * np.cos(TIMES)], 1)
)
QUATERNIONS = np.roll(ROTATIONS.as_quat(), 1, axis=1)


def test_slerp():
    signs = rng.choice([-1, 1], len(TIMES))[:, None]
    table = attitude_table(TIMES, signs * QUATERNIONS)
    peer = Slerp(TIMES, ROTATIONS)(BETWEEN).as_matrix()
    np.testing.assert_allclose(turned(table, BETWEEN), peer, atol=1e-14)


@pytest.mark.parametrize("method, oracle", [
    ("linear", lambda q: interp1d(TIMES, q, axis=0)), ("spline", lambda q: CubicSpline(TIMES, q)),
])  # fmt: skip
def test_normalised_polynomials(method, oracle):
    signs = rng.choice([-1, 1], len(TIMES))[:, None]
    table = attitude_table(TIMES, signs * QUATERNIONS, method=method)
    peer = Rotation.from_quat(np.roll(oracle(continuous(QUATERNIONS))(BETWEEN), -1, axis=1))
    np.testing.assert_allclose(turned(table, BETWEEN), peer.as_matrix(), atol=1e-14)


@pytest.mark.parametrize("name", [*ORACLES, "slerp"])
def test_pieces_are_the_interpolation_itself(name):
    """Values, rates, gaps and what is beyond the ends, of all methods by one program."""
    method, *_ = name.split()
    position = table_of(name if name != "slerp" else "linear", gap=1.4, extrapolate=0.1)
    method = "spline" if method == "hermite" else method
    attitude = attitude_table(TIMES, QUATERNIONS, method=method, gap=1.4, extrapolate=0.1)
    given = Trajectory(position, attitude)
    found = pieces(given)
    ends = TIMES[0] - 0.05, TIMES[-1] + 0.05, TIMES[0] - 0.2
    t, scale = np.r_[ends, BETWEEN][: len(BETWEEN)], np.abs(VALUES).max()
    np.testing.assert_allclose(at(found.position, t), at(position, t), atol=1e-13 * scale)
    np.testing.assert_allclose(rates(found.position, t), rates(position, t), atol=1e-12 * scale)
    # A polynomial instead of sines, over steps of the given size.
    np.testing.assert_allclose(turned(found.attitude, t), turned(attitude, t), atol=2e-9)


def test_angles_of_the_published_order():
    """R of eq. 2-3 of Hakim et al.: Rx(θ₂)·Ry(θ₁)·Rz(θ₃)."""
    angles = np.stack([0.2 * np.sin(TIMES), 0.1 * np.cos(TIMES), np.pi * TIMES / 6], 1)
    wrapped = (angles + np.pi) % (2 * np.pi) - np.pi
    table = attitude_table(TIMES, wrapped, method="spline")
    peer = Rotation.from_euler("XYZ", CubicSpline(TIMES, angles)(BETWEEN)).as_matrix()
    np.testing.assert_allclose(turned(table, BETWEEN), peer, atol=1e-13)
    pitch, roll, yaw = 0.1, 0.2, 0.3
    c1, s1, c2, s2 = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    c3, s3 = np.cos(yaw), np.sin(yaw)
    R = jax.jit(matrix_from_pitch_roll_yaw)(jnp.array([pitch, roll, yaw]))
    np.testing.assert_allclose(R, [
        [c1 * c3, -c1 * s3, s1],
        [c2 * s3 + c3 * s1 * s2, c2 * c3 - s1 * s2 * s3, -c1 * s2],
        [s2 * s3 - c2 * c3 * s1, c3 * s2 + c2 * s1 * s3, c1 * c2],
    ], atol=1e-15)  # fmt: skip


def test_orbital_frame():
    """Right, forward, up of a platform above the equator that flies north."""
    axes = jax.jit(orbital_frame)(jnp.array([7e6, 0, 0]), jnp.array([100.0, 0, 7e3]))
    np.testing.assert_allclose(axes.T, [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-15)
    position = position_table(TIMES, 7e6 * np.stack(
        [np.cos(1e-3 * TIMES), 0 * TIMES, np.sin(1e-3 * TIMES)], 1
    ))  # fmt: skip
    level = attitude_table(TIMES, np.zeros((12, 3)), method="linear", reference="orbit")
    t = TIMES[6]
    a = 1e-3 * t
    expected = [[0, 1, 0], [-np.sin(a), 0, np.cos(a)], [np.cos(a), 0, np.sin(a)]]
    R = jax.jit(rotation_at)(Trajectory(position, level), t)
    np.testing.assert_allclose(R.T, expected, atol=1e-10)


SOURCE = Source("att.csv", np.arange(12) + 2, "line")


def broken(array, row, value):
    array = array.copy()
    array[row] = value
    return array


@pytest.mark.usefixtures("wrong_types")
@pytest.mark.parametrize("make, words", [
    (lambda: position_table(broken(TIMES, 4, TIMES[3]), VALUES, source=SOURCE), ["line 6", "tw"]),
    (lambda: position_table(broken(TIMES, 4, 0.1), VALUES, source=SOURCE), ["line 6", "sort"]),
    (lambda: position_table(broken(TIMES, 4, np.nan), VALUES, source=SOURCE), ["line 6", "time"]),
    (lambda: position_table(TIMES, broken(VALUES, 2, np.inf), source=SOURCE), ["line 4"]),
    (lambda: position_table(TIMES, VALUES, method="hermite", source=SOURCE), ["velocities"]),
    (lambda: position_table(TIMES, VALUES, method="splin", source=SOURCE), ["mean 'spline'"]),
    (lambda: position_table(TIMES, VALUES, order=12, source=SOURCE), ["12 rows", "needs 13"]),
    (lambda: position_table(TIMES[:5], VALUES, source=SOURCE), ["att.csv", "(5,)"]),
    (lambda: attitude_table(TIMES, broken(QUATERNIONS, 7, [1, 1, 0, 0]), source=SOURCE),
     ["line 9", "1.41421", "w, x, y, z"]),
    (lambda: attitude_table(TIMES, broken(QUATERNIONS, 7, np.nan), source=SOURCE), ["line 9"]),
    (lambda: attitude_table(TIMES, VALUES, source=SOURCE), ["slerp", "linear"]),
    (lambda: attitude_table(TIMES, VALUES[:, :2], method="linear", source=SOURCE),
     ["att.csv", "(12, 2)", "pitch, roll, yaw"]),
])  # fmt: skip
def test_bad_tables_are_refused_with_their_row(make, words):
    with pytest.raises(InputError) as refused:
        make()
    for word in words:
        assert word in str(refused.value)


def test_times_outside_are_refused():
    with pytest.raises(InputError, match="positions.csv: image line 1 is at .* outside the table"):
        check_covered(table_of("linear"), [TIMES[2], TIMES[-1] + 1], POSITIONS)
