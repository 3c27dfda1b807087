"""Weak networks are reported: what is weakly determined, and the remedy.

Four images of 25 targets; of the first two shapes (with and without control) all share one solver.
"""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import jaxbundle
from jaxbundle import Camera, grid_of_targets, ring_of_stations, simulate, stations_looking_at
from jaxbundle.adjustment.problem import make_problem
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.adjustment.quality.weakness import (
    VAGUE_RATIO,
    Weakness,
    weakness,
    weakness_of_unsolved,
)
from jaxbundle.cli.outputs import why_not
from jaxbundle.network.build import make_further
from jaxbundle.network.repetitions import warn_of_repetitions
from jaxbundle.orientation import one_place
from jaxbundle.orientation.one_place import name_one_place
from jaxbundle.planning.stations import Stations
from jaxbundle.report.head import failure_facts, warnings

TARGETS = grid_of_targets(5, 5, 0.5, relief=0.2, seed=1)
RING = ring_of_stations(4, 3.0, 2.5, roll_every=2)
ONE_PLACE = stations_looking_at(
    np.repeat(RING.position[:1], 4, 0),
    np.array([[0, 0, 0], [3, 1, 0], [-2, 2, 0], [2, -3, 0]]) / 10,
)
NADIR = Stations(
    np.array([[-4, -4, 30], [4, -4, 30], [-4, 4, 30], [4, 4, 30]]) / 10, np.zeros((4, 3))
)
CONTROL = {"control": (0, 4, 20, 24), "control_sigma": 0.002, "datum": "control"}


def camera(id="cam", **options):
    return Camera(id, "brown", {"c": 24.0}, free=("c",), **options)


def network(stations, cameras=None, targets=TARGETS, **options):
    cameras = cameras or camera()
    return simulate(stations, targets, cameras, noise=0.002, seed=3, disturb=0.005, **options)


def without_start_values(network):
    images, points = network.images, network.points
    tie = points.has_role("tie")[:, None]
    return network.replace(
        images=dataclasses.replace(
            images, position=images.position * np.nan, angles=images.angles * np.nan
        ),
        points=dataclasses.replace(points, position=np.where(tie, np.nan, points.position)),
    )


def said(result):
    return " | ".join(result.warnings)


def exchanged(given, *ids):
    a, b = (given.points.id.index(id) for id in ids)
    X = given.points.position.copy()
    X[[a, b]] = X[[b, a]]
    return given.replace(points=dataclasses.replace(given.points, position=X))


@pytest.mark.further
def test_exchanged_control_points_among_others_are_a_warning():
    six = CONTROL | {"control": (0, 4, 10, 12, 20, 24)}
    found = jaxbundle.orient(without_start_values(exchanged(network(RING, **six), "1", "5")))
    assert "if '1' and '5' are exchanged" in found.finding
    assert found.finding in found.network.warnings and found.finding in str(found)


@pytest.mark.further
def test_exchanged_control_points_are_named_where_nothing_else_can_be_had():
    result = jaxbundle.adjust(exchanged(network(RING, **CONTROL), "1", "5"))
    assert not result.converged
    (finding,) = result.findings
    assert "'1' and '5' are exchanged" in finding and finding in result.warnings
    lacking = without_start_values(exchanged(network(RING, **CONTROL), "1", "5"))
    with pytest.raises(jaxbundle.NotSolvedError, match="'1' and '5' are exchanged"):
        jaxbundle.adjust(lacking)
    sound = without_start_values(network(RING, **CONTROL))
    assert jaxbundle.orient(sound).finding == ""


@pytest.fixture(scope="module")
def sound():
    return jaxbundle.adjust(network(RING, **CONTROL))


def test_a_sound_network_says_nothing(sound):
    assert sound.converged and sound.warnings == ()
    assert sound.weakness.worst < 0.002


def test_weak_lines_compare_with_the_extent():
    for worst, said in ((0.05, "a σ is up to 0.05 of the"), (1.5, "a σ is larger than the")):
        (line,) = Weakness(("c of camera cam",), worst).lines
        assert f"{said} principal distance" in line


@pytest.mark.further
def test_blunders_do_not_make_good_geometry_weak():
    """σ0 is that of 3 in 100 rays, which are wrong by 150 σ."""
    given = network(RING, **CONTROL)
    xy = given.observations.xy.copy()
    xy[[10, 44, 83]] += 0.3
    result = jaxbundle.adjust(
        given.replace(observations=dataclasses.replace(given.observations, xy=xy))
    )
    assert result.converged and result.sigma0 > 20
    assert result.weakness.unknowns == () and "poorly determined" not in said(result)


@pytest.mark.further
def test_exchanged_control_points_do_not_make_good_geometry_weak():
    six = CONTROL | {"control": (0, 4, 10, 12, 20, 24)}
    result = jaxbundle.adjust(exchanged(network(RING, **six), "11", "13"))
    assert "'11' and '13' are exchanged" in said(result)
    assert result.converged and result.sigma0 > 30 and "poorly determined" not in said(result)


@pytest.mark.further
def test_images_from_one_place_are_named_where_there_is_no_solution():
    result = jaxbundle.adjust(network(ONE_PLACE))
    assert not result.converged
    assert "images '1', '2', '3', '4' were taken from one place" in said(result)
    assert " of image " in " ".join(result.weakness.unknowns)
    with pytest.raises(jaxbundle.NotSolvedError, match="one place"):
        assert result.cameras
    assert "one place" in result.report().replace("\n  ", " ")


def test_images_from_one_place_solved_by_control_have_no_depth():
    result = jaxbundle.adjust(network(ONE_PLACE, **CONTROL))
    assert result.converged
    assert "images taken from one place, or nearly" in said(result)
    sigma = np.stack([result.points[f"s{axis}"] for axis in "XYZ"], 1)
    rows = [result.points["id"].tolist().index(id) for id in result.weakness.points]
    assert (np.linalg.norm(sigma[rows], axis=1) > 0.3).all()  # of about 3.9 m
    assert len(rows) > 12


def test_two_images_from_one_place_are_told_from_two_that_are_not():
    two = lambda stations: network(Stations(stations.position[:2], stations.angles[:2]), camera())
    assert "'1', '2'" in name_one_place(two(ONE_PLACE))
    assert name_one_place(two(RING)) == ""


def test_all_images_from_one_place_are_counted(monkeypatch):
    """Of 300 images 200 are tested."""
    sights = SimpleNamespace(image=np.arange(300), images=300)
    monkeypatch.setattr(one_place, "make_sights", lambda _: sights)
    monkeypatch.setattr(one_place, "_is_rotation", lambda *_: True)
    images = SimpleNamespace(id=[f"i{k}" for k in range(300)])
    assert "and 295 more were taken" in name_one_place(SimpleNamespace(images=images))


def test_a_narrow_field_cannot_tell_a_turn_from_a_shift():
    """Two vertical images of a flat object are shifts of each other, to 2 µm of noise."""
    stations = Stations(NADIR.position[:2], NADIR.angles[:2])
    flat = network(stations, targets=TARGETS * [1, 1, 0])
    of = lambda c: flat.replace(
        cameras=(dataclasses.replace(flat.cameras[0], parameters={"c": c}),)
    )
    assert name_one_place(of(24.0)) == ""
    assert name_one_place(of(4000.0)) == ""


@pytest.mark.further
def test_parameters_that_are_hardly_separated_are_named_at_the_limit():
    """Views of a narrow field that are not rolled: fy, cy and the pitch of the images are alike."""
    start = {"fx": 3e3, "fy": 3e3, "cx": 960.0, "cy": 540.0, "alpha": 0.05, "beta": 1.1}
    lens = Camera("cam", "eucm", start, free=("fx", "fy", "cx", "cy", "alpha", "beta"))
    ring = ring_of_stations(8, 3.0, 0.5)
    narrow = simulate(ring, TARGETS, lens, noise=0.3, seed=2, image_format=(1920, 1080))
    result = jaxbundle.adjust(narrow, max_iterations=2)
    said = why_not(result)
    assert not result.converged and "hardly separated" in said
    named = said.split("hardly separated")[1].split("; hold")[0]
    assert "fy of camera cam" in named and "omega" not in named and "fx" not in named


@pytest.mark.parametrize("size", [
    None, pytest.param((0.006, 0.006), marks=pytest.mark.further),
])  # fmt: skip
def test_c_in_pixels_is_named_where_the_adjustment_fails(size):
    """c begins at 4000 of 0.006 mm, and is free."""
    pixels = Camera("cam", "brown", {"c": 4000.0}, free=("c",), pixel_size=size)
    result = jaxbundle.adjust(network(RING, **CONTROL).replace(cameras=(pixels,)))
    assert not result.converged
    (line,) = (line for line in result.warnings if "is c in pixels" in line)
    assert line in result.findings and ("in mm (24)" in line) == (size is not None)
    with pytest.raises(jaxbundle.NotSolvedError, match="is c in pixels"):
        assert result.cameras
    assert "one place" not in said(result)
    told = why_not(result)  # names of what is not determined do not hide the cause
    assert result.undetermined and "is c in pixels" in told


@pytest.mark.further
def test_c_in_pixels_is_the_first_cause_of_a_far_off_chi_square():
    """It cannot be distinguished from a long lens; only misfits are checked for it."""
    lens = Camera("cam", "brown", {"c": 400.0}, free=("c",))
    given = network(RING, lens, TARGETS / 20, **CONTROL)
    sigma = given.observations.sigma / 10
    rays = dataclasses.replace(given.observations, sigma=sigma)
    result, misfit = (jaxbundle.adjust(n) for n in (given, given.replace(observations=rays)))
    assert result.converged and misfit.converged and misfit.sigma0 > 5 * result.sigma0
    assert "in pixels" not in said(result)
    assert "is c in pixels" in said(misfit)
    assert "the likeliest first: a principal distance in pixels instead of mm" in misfit.doubts[-1]


def test_c_in_pixels_is_named_where_no_start_values_are_found():
    given = without_start_values(network(RING))
    pixels = dataclasses.replace(given.cameras[0], parameters={"c": 4000.0})
    rays = given.observations
    few = given.replace(cameras=(pixels,), observations=rays.take(rays.point < 4))
    with pytest.raises(jaxbundle.NotSolvedError, match="no start values .* is c in pixels"):
        jaxbundle.orient(few)


def test_vertical_images_name_the_principal_distance(monkeypatch):
    result = jaxbundle.adjust(network(NADIR, **CONTROL))
    first, *others = result.weakness.unknowns
    assert first == "c of camera cam" and others and all("Z0 of image" in n for n in others)
    assert "c needs depth or convergent images" in said(result)
    assert result.converged
    c = result.cameras["cam"]["parameters"]["c"]
    assert VAGUE_RATIO * c["sigma"] > c["value"]
    # The directions of a factor give what the cofactors give.
    given = result.weakness
    monkeypatch.setattr("jaxbundle.leastsquares.quality.weakness.SMALL_SYSTEM", 0)
    found = weakness(Inspection(result.problem, result.values), result.sigma0)
    assert found.unknowns == given.unknowns
    assert found.worst == pytest.approx(c["sigma"] / c["value"], rel=1e-3)
    assert given.worst == pytest.approx(c["sigma"] / c["value"], rel=1e-9)


def test_a_camera_for_every_image_with_a_wide_prior_is_named():
    cameras = [camera(f"c{i}", sigma={"c": 24.0}) for i in range(4)]
    flat = TARGETS * [1, 1, 0]
    problem = make_problem(network(NADIR, cameras, flat, **CONTROL))
    found = weakness_of_unsolved(problem, problem.data.start)
    assert {f"c of camera c{i}" for i in range(4)} <= set(found.unknowns)


def test_what_repeats_another_is_named():
    given = network(RING)
    images, rays = given.images, given.observations
    again = np.flatnonzero(rays.image == 0)
    rows = np.concatenate([np.arange(len(rays)), again])
    image = np.concatenate([rays.image, np.full(len(again), 4)])
    repeated = given.replace(
        images=dataclasses.replace(images.take(np.array([0, 1, 2, 3, 0])), id=(*images.id, "copy")),
        observations=dataclasses.replace(rays.take(rows), image=image),
    )
    (line,) = warn_of_repetitions(repeated).warnings
    assert "'copy' repeats '1'" in line and "remove one" in line
    assert warn_of_repetitions(given).warnings == ()
    # One coordinate in the last digit, and it is another measurement.
    xy = repeated.observations.xy.copy()
    xy[-1, 0] = np.nextafter(xy[-1, 0], 99)
    other = repeated.replace(observations=dataclasses.replace(repeated.observations, xy=xy))
    assert warn_of_repetitions(other).warnings == ()
    twin = rays.xy.copy()
    twin[rays.point == 7] = twin[rays.point == 3]
    other = given.replace(observations=dataclasses.replace(rays, xy=twin))
    (line,) = warn_of_repetitions(other).warnings
    assert "'8' repeats '4'" in line
    # Of many only the first few are named.
    same = given.replace(observations=dataclasses.replace(rays, xy=0 * rays.xy))
    line, *_ = warn_of_repetitions(same).warnings
    assert line.count("repeats") == 5 and " and " in line


@pytest.mark.further
def test_an_observation_without_derivatives_is_named():
    """An angle at a point whose other end starts in the same place."""
    given = network(RING)
    ids, X = given.points.id, given.points.position.copy()
    X[2] = X[1]
    rows = {"from": ids[0], "at": ids[1], "to": ids[2], "value": 1.0, "sigma": 0.1}
    given = given.replace(
        points=dataclasses.replace(given.points, position=X),
        further=make_further({"angles": [rows]}, 1.0),
    )
    found = jaxbundle.adjust(given)
    assert not found.converged
    (cause,) = found.findings
    assert "no derivative" in cause
    assert f"angles of point {ids[0]} and point {ids[1]} and point {ids[2]};" in cause
    # The report gives it as the reason, not among the warnings, without the remedy for others.
    reason = dict(failure_facts(found))[""]
    assert "no derivative" in reason and cause not in warnings(found)
    assert "behind their cameras" not in found.report()
