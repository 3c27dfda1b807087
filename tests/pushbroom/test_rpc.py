"""RPC: against numpy, there and back, derivatives of the way back, surfaces, statuses."""

import jax
import jax.flatten_util
import numpy as np
import pytest
from rpc_scenes import made_up, places

from jaxbundle.geometry import ellipsoid as el
from jaxbundle.pushbroom.rpc import polynomials as r
from jaxbundle.pushbroom.surfaces import Height
from jaxbundle.pushbroom.terrain import make_terrain

RPC = made_up()
PLACES = places(RPC)
POWERS = [
    (0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (2, 0, 0),
    (0, 2, 0), (0, 0, 2), (1, 1, 1), (3, 0, 0), (1, 2, 0), (1, 0, 2), (2, 1, 0), (0, 3, 0),
    (0, 1, 2), (2, 0, 1), (0, 2, 1), (0, 0, 3),
]  # fmt: skip
"""Exponents of L, P, H in the table of STDI-0002."""


def independent(rpc, longitude, latitude, height):
    L = (np.degrees(longitude) - rpc.longitude_offset) / rpc.longitude_scale
    P = (np.degrees(latitude) - rpc.latitude_offset) / rpc.latitude_scale
    H = (height - rpc.height_offset) / rpc.height_scale
    T = np.stack([L**i * P**j * H**k for i, j, k in POWERS])
    line = (rpc.line_numerator @ T) / (rpc.line_denominator @ T)
    sample = (rpc.sample_numerator @ T) / (rpc.sample_denominator @ T)
    return (
        rpc.line_offset + rpc.line_scale * line,
        rpc.sample_offset + rpc.sample_scale * sample,
    )


def test_against_the_published_order_of_terms():
    line, sample, status = r.project_points(RPC, *PLACES)
    expected = independent(jax.tree.map(np.asarray, RPC), *PLACES)
    np.testing.assert_allclose([line, sample], expected, rtol=0, atol=1e-8)
    assert (np.asarray(status) == r.RpcStatus.INSIDE).all()


def test_longitudes_are_the_same_after_a_turn():
    longitude, latitude, height = PLACES
    there = r.project_points(RPC, longitude, latitude, height)
    for turns in (-2, 1):
        again = r.project_points(RPC, longitude + 2 * np.pi * turns, latitude, height)
        np.testing.assert_allclose(again, there, atol=1e-7)


def test_there_and_back():
    longitude, latitude, height = PLACES
    line, sample, _ = r.project_points(RPC, *PLACES)
    east, north, status = r.locate_points(RPC, line, sample, height)
    np.testing.assert_allclose([east, north], [longitude, latitude], rtol=0, atol=1e-14)
    assert (np.asarray(status) == r.RpcStatus.INSIDE).all()
    again = r.project_points(RPC, east, north, height)
    np.testing.assert_allclose(again[:2], [line, sample], rtol=0, atol=1e-8)


def test_derivatives_of_the_way_back():
    """By every coefficient and by the place, against central differences."""
    rng = np.random.default_rng(0)
    place = np.array([1200.0, 3100.0, 250.0])
    flat, back = jax.flatten_util.ravel_pytree(RPC)
    flat = np.asarray(flat)

    @jax.jit
    def longitude_latitude(flat, place):
        east, north, _ = r.locate(back(flat), *place)
        return jax.numpy.stack([east, north])

    J = jax.jit(jax.jacfwd(longitude_latitude, (0, 1)))(flat, place)
    for direction, step in ((rng.normal(size=flat.size), 1e-6), (0 * flat, 1.0)):
        ahead = rng.normal(size=3) if step == 1.0 else np.zeros(3)
        move = lambda s: np.asarray(
            longitude_latitude(flat + s * direction, place + s * ahead)  # noqa: B023
        )
        numeric = (move(step) - move(-step)) / (2 * step)
        exact = J[0] @ direction + J[1] @ ahead
        np.testing.assert_allclose(exact, numeric, rtol=2e-6)


@pytest.mark.further
def test_second_derivatives_of_the_way_back():
    """Along a direction of the place and of all coefficients, against differences of the first."""
    rng = np.random.default_rng(1)
    flat, back = jax.flatten_util.ravel_pytree(RPC)
    place = np.array([1200.0, 3100.0, 250.0])
    of_flat, of_place = 1e-6 * rng.normal(size=flat.size), rng.normal(size=3)

    @jax.jit
    def along(s):
        def longitude(s):
            return r.locate(back(flat + s * of_flat), *(place + 300 * s * of_place))[0]

        first = jax.jvp(longitude, (s,), (1.0,))[1]
        return first, jax.grad(jax.grad(longitude))(s)

    h = 0.05
    numeric = (along(h)[0] - along(-h)[0]) / (2 * h)
    assert float(along(0.0)[1]) == pytest.approx(float(numeric), rel=1e-3)


@pytest.mark.further
def test_a_line_of_sight_on_surfaces():
    """Points on a height and on sloping terrain project back to their origin."""
    line, sample, _ = r.project_points(RPC, *PLACES)
    line, sample = np.asarray(line), np.asarray(sample)
    east, north, h, status = r.locate_points_on(RPC, Height(350.0), line, sample)
    np.testing.assert_allclose(h, 350.0, atol=1e-6)
    again = r.project_points(RPC, east, north, h)
    np.testing.assert_allclose(again[:2], [line, sample], rtol=0, atol=1e-7)
    assert (np.asarray(status) != r.RpcStatus.NOT_CONVERGED).all()
    step = np.radians(0.01)
    west, north = np.radians(179.7), np.radians(-23.1)
    column, row = np.meshgrid(np.arange(60), np.arange(60))
    slope = 100 + 7.0 * column + 5.0 * row
    terrain = make_terrain(slope, (west, north), (step, -step))
    east, latitude, h, _ = (np.asarray(v) for v in r.locate_points_on(RPC, terrain, line, sample))
    x = np.mod(east - west, 2 * np.pi) / step
    np.testing.assert_allclose(h, 100 + 7 * x + 5 * (north - latitude) / step, atol=1e-5)
    again = r.project_points(RPC, east, latitude, h)
    np.testing.assert_allclose(again[:2], [line, sample], rtol=0, atol=1e-7)


def test_the_chord_of_a_line_of_sight():
    o, d = r.sight(RPC, 1500.0, 1000.0)
    assert float(el.geodetic(el.WGS84, o)[2]) == pytest.approx(1000.0, abs=1e-6)
    assert float(np.linalg.norm(d)) == pytest.approx(1.0, abs=1e-12)
    assert float(np.dot(d, np.array(o))) < 0


@pytest.mark.parametrize("move, status", [
    ((0, 0, 0), r.RpcStatus.INSIDE), ((0.3, 0, 0), r.RpcStatus.OUTSIDE),
    ((0, 0, 1500.0), r.RpcStatus.OUTSIDE),
])  # fmt: skip
def test_inside_and_outside(move, status):
    centre = np.array([np.radians(179.98), np.radians(-23.4), 400.0])
    found = r.domain(RPC, *(centre + [np.radians(move[0]), np.radians(move[1]), move[2]]))
    assert r.RpcStatus(int(found)) == status
    line, sample = r.project(RPC, *(centre + [np.radians(move[0]), 0, move[2]]))
    _, _, back = r.locate(RPC, line, sample, centre[2] + move[2])
    assert r.RpcStatus(int(back)) == status and status.meaning


def test_what_leads_nowhere_is_said():
    """Lines that depend on the height alone fix no place."""
    blind = made_up(line_numerator=np.eye(20)[3], line_denominator=np.eye(20)[0])
    east, north, status = r.locate(blind, 100.0, 200.0, 300.0)
    assert np.isnan(east) and np.isnan(north) and int(status) == r.RpcStatus.NOT_CONVERGED
    pole = made_up(line_denominator=np.eye(20)[1])
    assert int(r.domain(pole, np.radians(179.98), np.radians(-23.4), 0.0)) == 2


def test_against_rasterio(tmp_path):
    """GDAL's own transformer, whose pixels count from the corner: half a pixel more."""
    from rasterio.rpc import RPC as Theirs
    from rasterio.transform import RPCTransformer

    away = made_up(longitude_offset=12.0)
    longitude, latitude, height = places(away)
    n = lambda a: np.asarray(a).tolist()
    theirs = Theirs(
        height_off=400.0, height_scale=600.0, lat_off=-23.4, lat_scale=0.11, line_off=3000.5,
        line_scale=3001.0, long_off=12.0, long_scale=0.12, samp_off=2500.0, samp_scale=2501.0,
        line_num_coeff=n(away.line_numerator), line_den_coeff=n(away.line_denominator),
        samp_num_coeff=n(away.sample_numerator), samp_den_coeff=n(away.sample_denominator),
    )  # fmt: skip
    with RPCTransformer(theirs) as transformer:
        row, column = transformer.rowcol(
            np.degrees(longitude), np.degrees(latitude), zs=height, op=lambda x: x
        )
    line, sample, _ = r.project_points(away, longitude, latitude, height)
    np.testing.assert_allclose(line, np.array(row) - 0.5, rtol=0, atol=1e-6)
    np.testing.assert_allclose(sample, np.array(column) - 0.5, rtol=0, atol=1e-6)
