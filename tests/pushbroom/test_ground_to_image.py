"""Ground to image: the inverse of locate, all passages, what is not in the image, derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pushbroom_scenes import (
    LINES,
    PERIOD,
    PIXELS,
    above_a_plane,
    focal_line,
    geodetic,
    locate,
    orbit,
    satellite,
)

from jaxbundle.geometry import ellipsoid as el
from jaxbundle.pushbroom.ancillary import attitude_table, position_table
from jaxbundle.pushbroom.corrections import Corrections
from jaxbundle.pushbroom.ground_to_image import (
    ProjectionStatus,
    make_search,
    project_from,
    project_near,
    project_points,
)
from jaxbundle.pushbroom.image import make_image
from jaxbundle.pushbroom.image_to_ground import locate_points
from jaxbundle.pushbroom.scanner import AngleTable, LineTimes
from jaxbundle.pushbroom.surfaces import Ground, Height, Plane
from jaxbundle.pushbroom.terrain import make_terrain
from jaxbundle.pushbroom.trajectory import Trajectory

rng = np.random.default_rng(2)
SOME_LINES = np.r_[-0.4, np.linspace(0, LINES - 1, 21), LINES - 0.6]
SOME_PIXELS = np.r_[-0.45, np.linspace(0, PIXELS - 1, 17), PIXELS - 0.55]


def at_heights(image):
    """Points on the ellipsoid, below it and high above it: [surfaces, 3, lines, pixels]."""
    heights = [Height(h) for h in (0.0, -400.0, 1500.0, 4000.0, 8000.0)]
    return [np.array(locate(image, s, SOME_LINES, SOME_PIXELS)) for s in heights]


def on_other_surfaces(image):
    """Points on the ellipsoid, a sphere, a rough terrain: [surfaces, 3, lines, pixels]."""
    surfaces = [Ground(), Ground(el.sphere(6360e3))]
    points = [np.array(locate(image, s, SOME_LINES, SOME_PIXELS)) for s in surfaces]
    longitude, latitude, _ = np.array(geodetic(tuple(points[0])))
    step = 5e-4
    corner = longitude.min() - 4 * step, latitude.max() + 4 * step
    size = [int((v.max() - v.min()) / step) + 9 for v in (latitude, longitude)]
    terrain = make_terrain(500 * rng.random((40, 40)), corner, (
        (size[1] * step) / 39, -(size[0] * step) / 39
    ))  # fmt: skip
    return [*points, np.array(locate(image, terrain, SOME_LINES, SOME_PIXELS))]


def table_optics():
    """A curved line of detectors, as a table of angles."""
    u = np.linspace(-1, 1, PIXELS)
    return AngleTable(jnp.asarray(0.014 * u + 1e-4 * u**3), jnp.asarray(2e-4 * u**2 + 1e-5))


LINEAR = "linear, normalised, a table of angles"
CORRECTED = "hermite, angles in the orbit by splines, uneven times, light time, aberration"
# lagrange with slerp, there and back: test_csm, test_scanner_file
CASES = {
    LINEAR: satellite("linear", "linear", 4, table_optics()),
    # refraction, slow to compile here, is undone by `apparent_point` alike: test_locate
    CORRECTED: satellite("hermite", "angles", 4, times=LineTimes(
        jnp.float64(0), jnp.float64(0),
        jnp.asarray(PERIOD * (np.arange(LINES) + rng.uniform(-0.2, 0.2, LINES))),
    ), corrections=Corrections(True, True, False)),
}  # fmt: skip


points_at = jax.jit(locate_points)
SIZE = 5 * len(SOME_LINES) * len(SOME_PIXELS)
"""Points in one call, more than a chunk; always so many, to share a compiled program."""


def placed(image, X, earth=el.WGS84, most=1):
    """`project_points` of few points [3, n], among others that are ignored."""
    n = X.shape[1]
    found = project_points(
        image, make_search(image, earth), np.pad(X, [(0, 0), (0, SIZE - n)], "wrap"), most=most
    )
    return jax.tree.map(lambda a: np.asarray(a)[..., :n], found)


@pytest.mark.parametrize("name, points", [
    pytest.param(name, points, marks=pytest.mark.further) if name == LINEAR else (name, points)
    for name, points in [*((name, at_heights) for name in CASES), (LINEAR, on_other_surfaces)]
])  # fmt: skip
def test_project_undoes_locate(name, points):
    """To 1e-6 pixel over the whole image, on every surface."""
    X = np.concatenate([p.reshape(3, -1) for p in points(CASES[name])], axis=1)
    assert np.isfinite(X).all()
    found = placed(CASES[name], X)
    lines, pixels = (a.ravel() for a in np.meshgrid(SOME_LINES, SOME_PIXELS, indexing="ij"))
    times = X.shape[1] // lines.size
    np.testing.assert_allclose(found.line[0], np.tile(lines, times), atol=1e-6)
    np.testing.assert_allclose(found.pixel[0], np.tile(pixels, times), atol=1e-6)
    assert (found.count == 1).all() and (found.status == ProjectionStatus.SEEN).all()


def test_project_from_a_place_near_by():
    image = CASES[LINEAR]
    X = locate(image, Ground(), SOME_LINES, SOME_PIXELS)
    line, pixel = project_from(image, make_search(image), tuple(X), SOME_LINES[:, None] + 25.0, 7.0)
    np.testing.assert_allclose(line, np.broadcast_to(SOME_LINES[:, None], line.shape), atol=1e-6)
    np.testing.assert_allclose(pixel, np.broadcast_to(SOME_PIXELS, line.shape), atol=1e-6)


def rocking(size, period, angles=(0.0, 0.0, 0.0)):
    """A pitching camera above a plane that sees the ground forwards, backwards, and forwards
    again."""
    image = above_a_plane()
    t = np.arange(-0.1, 6.2, 0.02)
    nod = np.stack([size * np.sin(2 * np.pi * t / period), 0 * t, 0 * t], 1) + angles
    return eqx.tree_at(
        lambda i: i.trajectory.attitude, image, attitude_table(t, nod, method="spline")
    )


@pytest.mark.further
def test_in_a_local_frame():
    image = rocking(0.0, 1.0, (0.01, 0.1, 0.2))
    X = np.array(locate(image, Plane(30.0), SOME_LINES, SOME_PIXELS)).reshape(3, -1)
    found = placed(image, X, None, most=3)
    lines = np.repeat(SOME_LINES, len(SOME_PIXELS))
    np.testing.assert_allclose(found.line[0], lines, atol=1e-6)


@pytest.mark.further
def test_where_a_point_is_that_is_not_in_the_image():
    image = rocking(0.0, 1.0)
    # the line of detectors is 0.3 mm ahead of the axis of 120 mm: 2.5 m on the ground
    X = np.array([
        [0.0, 100.0, 0.0], [0.0, 0.0, 0.0], [0.0, 400.0, 0.0], [150.0, 100.0, 0.0],
        [0.0, 100.0, 2000.0],
    ]).T  # fmt: skip
    found = placed(image, X, None, most=3)
    assert list(found.status) == [
        getattr(ProjectionStatus, name) for name in ("SEEN", "BEFORE", "AFTER", "BESIDE", "HIDDEN")
    ]  # fmt: skip
    np.testing.assert_allclose(found.line[0, 0], (100 - 2.5) / 0.5)
    assert np.isnan(found.line[:, 1:]).all() and list(found.count) == [1, 0, 0, 0, 0]
    assert all(status.meaning for status in ProjectionStatus)


@pytest.mark.further
def test_the_other_side_of_the_earth():
    image = CASES[LINEAR]
    seen = np.array(locate(image, Ground(), SOME_LINES[5:6], SOME_PIXELS[5:6])).ravel()
    o = np.array(image.trajectory.position.values[6])
    d = (seen - o) / np.linalg.norm(seen - o)
    behind = o + 1.29e7 * d
    found = placed(image, np.stack([seen, behind], 1))
    assert list(found.status) == [ProjectionStatus.SEEN, ProjectionStatus.HIDDEN]


@pytest.mark.further
def test_all_lines_that_see_a_point():
    """Against the changes of sign over 100 000 times, in numpy."""
    size, period = 0.06, 2.0
    image = rocking(size, period)
    X = np.stack([rng.uniform(-40, 40, 50), rng.uniform(40, 260, 50), rng.uniform(0, 30, 50)])
    t = np.linspace(-0.5 * 0.01, (LINES - 0.5) * 0.01, 100_001)
    pitch = size * np.sin(2 * np.pi * t / period)
    # and some near the places where the image turns back, seen twice within a few lines or not
    reach = 50 * t + 1000 * np.tan(pitch + np.arctan(0.3 / 120))
    turn = np.flatnonzero(np.diff(np.sign(np.diff(reach)))) + 1
    beside = reach[turn[:, None]] + np.array([-1.0, -0.1, -0.01, 0.01, 0.1, 1.0])
    X = np.c_[X, np.stack([0 * beside.ravel(), beside.ravel(), 0 * beside.ravel()])]
    found = placed(image, X, None, most=3)
    # the sight through the detectors, turned by the pitch, meets Z at Y:
    for k in range(X.shape[1]):
        down = 1000 - X[2, k]
        angle = pitch + np.arctan(0.3 / 120)
        ahead = X[1, k] - (50 * t + down * np.tan(angle))
        place = np.flatnonzero(ahead[1:] * ahead[:-1] < 0)
        assert found.count[k] == len(place)
        lines = np.array(found.line[:, k])
        np.testing.assert_allclose(lines[: len(place)], t[place] / 0.01, atol=0.01)
        assert np.isnan(lines[len(place) :]).all()
    assert set(np.unique(found.count)) >= {1, 3} and len(turn) == 6


def test_a_point_is_found_though_its_first_passages_are_beside_it():
    """The camera looks to the left, then down: of each point the first line that sees it, against
    pitch and roll over 100 000 times, in numpy."""
    roll = lambda t: 0.2 / (1 + np.exp(8 * (t - 2.2)))
    t = np.arange(-0.1, 6.2, 0.02)
    angles = np.stack([0.06 * np.sin(np.pi * t), roll(t), 0 * t], 1)
    image = eqx.tree_at(
        lambda i: i.trajectory.attitude, above_a_plane(), attitude_table(t, angles, method="spline")
    )
    X = np.array([[0.0, Y, 0.0] for Y in (70.0, 120.0, 150.0, 170.0, 200.0)]).T
    found = jax.tree.map(np.asarray, project_points(image, make_search(image, None), X, most=1))
    t = np.linspace(0, (LINES - 1) * 0.01, 100_001)
    # the ray to the point in the camera: slopes ahead and across, pitch turned first
    pitch, row = 0.06 * np.sin(np.pi * t), 0.3 / 120
    half = 0.05 * PIXELS / 2 / 120
    places = (3,), (3, 1), (3, 1), (3, 0), (1, 0)
    for k in range(X.shape[1]):
        ahead, down = X[1, k] - 50 * t, -1000.0
        forward = np.cos(pitch) * ahead + np.sin(pitch) * down
        depth = np.cos(pitch) * down - np.sin(pitch) * ahead
        across, depth = -np.sin(roll(t)) * depth, np.cos(roll(t)) * depth
        passages = np.flatnonzero(np.diff(np.sign(-forward / depth - row)))
        seen = passages[np.abs(across / depth)[passages] < half]
        # none of three, the second, the first
        assert (len(passages), *(list(passages).index(v) for v in seen[:1])) == places[k]
        assert (found.status[k] == ProjectionStatus.SEEN) == (len(seen) > 0)
        if len(seen):
            np.testing.assert_allclose(found.line[0, k], t[seen[0]] / 0.01, atol=0.02)
        else:
            assert found.status[k] == ProjectionStatus.BESIDE and found.count[k] == 0
            assert np.isnan(found.line[0, k])


@pytest.mark.further
def test_nothing_is_seen_through_the_earth():
    """In a whole orbit every point has the Earth between it and the camera half of the time."""
    t = np.arange(-30.0, 5700.0, 10.0)
    image = make_image(
        Trajectory(
            position_table(t, *orbit(t)),
            attitude_table(t, np.zeros((len(t), 3)), method="spline", reference="orbit"),
        ),
        LineTimes(jnp.float64(0.0), jnp.float64(5600 / LINES)), focal_line(), LINES, PIXELS,
    )  # fmt: skip
    X = np.array(locate(image, Ground(), SOME_LINES, SOME_PIXELS)).reshape(3, -1)
    found = placed(image, X, most=3)
    assert (found.count == 1).all()
    lines = np.repeat(SOME_LINES, len(SOME_PIXELS))
    np.testing.assert_allclose(found.line[0], lines, atol=1e-6)


@pytest.mark.further
def test_the_footprint_changes_nothing():
    """With it and without, on points in the image, beside it, and above all heights it knows."""
    image = CASES[LINEAR]
    search = make_search(image)
    assert search.footprint is not None
    lines = rng.uniform(-0.5, LINES - 0.5, SIZE // 5)
    pixels = rng.uniform(-0.5, PIXELS - 0.5, SIZE // 5)
    X = [np.array(points_at(image, Height(h), lines, pixels)) for h in (-2e3, -900, 9e3, 2e4)]
    X.append(X[1] + rng.uniform(-2e4, 2e4, X[1].shape))
    X = np.concatenate(X, axis=1)
    every = eqx.tree_at(lambda s: s.footprint, search, None)
    fast, slow = (project_points(image, s, X, most=1) for s in (search, every))
    np.testing.assert_array_equal(fast.status, slow.status)
    np.testing.assert_array_equal(fast.count, slow.count)
    np.testing.assert_allclose(fast.line, slow.line, atol=1e-6)
    np.testing.assert_allclose(fast.pixel, slow.pixel, atol=1e-6)
    assert len(set(np.asarray(fast.status).tolist())) >= 4
    known = np.array(fast.line[0, : 4 * len(lines)])
    np.testing.assert_allclose(known, np.tile(lines, 4), atol=1e-6)


def test_an_image_that_turns_back_or_spins_has_no_footprint():
    """There is one while the flight, 50 m/s, is faster than the nod, 1500·π·size 500 m below."""
    assert make_search(rocking(0.0, 1.0), None).footprint is not None
    assert make_search(rocking(0.006, 2.0), None).footprint is not None
    assert make_search(rocking(0.012, 2.0), None).footprint is None
    image, t = above_a_plane(), np.arange(-0.1, 6.2, 0.02)
    # at 90 m beside the track a turn of 1 rad/s is faster than the flight
    for turn, once in ((0.02, True), (1.0, False)):
        turns = np.stack([0 * t, 0 * t, turn * t], 1)
        spinning = eqx.tree_at(
            lambda i: i.trajectory.attitude, image, attitude_table(t, turns, method="spline")
        )
        assert (make_search(spinning, None).footprint is not None) == once


@pytest.mark.further
def test_derivatives_by_every_parameter():
    """`project_near` against differences, each leaf of the image in a random direction."""
    image = satellite("hermite", "slerp", corrections=Corrections(True, True, False))
    places = np.array([10.3, 541.7]), np.array([20.0, 380.5])
    X = jax.jit(locate_points)(image, Ground(), *places).T
    arrays, static = eqx.partition(image, eqx.is_inexact_array)

    def at(arrays, X):
        near = jax.vmap(project_near, (None, 0, 0, 0))
        return jnp.stack(near(eqx.combine(arrays, static), X, places[0] + 3, places[1] - 2))

    change = jax.jit(lambda a, da: jax.jvp(at, a, da))
    draw = np.random.default_rng(3)
    leaves, tree = jax.tree.flatten(jax.tree.map(np.asarray, (arrays, X)))
    for k, leaf in enumerate(leaves):
        direction = [np.zeros_like(a) for a in leaves]
        direction[k] = draw.normal(size=leaf.shape)
        turn = jax.tree.unflatten(tree, direction)
        found, exact = (np.array(v) for v in change((arrays, X), turn))
        np.testing.assert_allclose(found, places, atol=1e-6)
        # A ten-thousandth of a pixel: the times of the knots act far from linearly.
        step = min(1e-4 / max(np.abs(exact).max(), 1e-9), 1e3)
        ends = [leaves[:k] + [leaf + s * step * direction[k]] + leaves[k + 1 :] for s in (1, -1)]
        moved = [np.array(change(jax.tree.unflatten(tree, end), turn)[0]) for end in ends]
        difference = (moved[0] - moved[1]) / (2 * step)
        np.testing.assert_allclose(exact, difference, atol=1e-5 * np.abs(exact).max() + 1e-8)
