"""What an adjustment leaves out because rays do not determine it, by name; and what start values
exclude, which comes back with the adjusted orientation."""

import dataclasses

import numpy as np
import pytest

import jaxbundle
from jaxbundle import Camera, grid_of_targets, ring_of_stations, simulate
from jaxbundle.io.results.result_json import result_dict
from jaxbundle.orientation.collinear import rays_coincide, see_collinear_points
from jaxbundle.orientation.incremental import Model
from jaxbundle.orientation.rays import Sights, in_plane, make_sights
from jaxbundle.planning.stations import Stations
from jaxbundle.report.page.adjustment import compose

TARGETS = grid_of_targets(5, 5, 0.5, relief=0.2, seed=1)
RING = ring_of_stations(4, 3.0, 2.5, roll_every=2)
LENS = Camera("cam", "brown", {"c": 24.0})


def network(stations=RING, targets=TARGETS, **options):
    given = {"noise": 0.002, "seed": 3, "disturb": 0.005} | options
    return simulate(stations, targets, LENS, **given)


def with_rays(given, keep):
    """The network with the image points for which keep(image id, point id)."""
    rays, images, points = given.observations, given.images.id, given.points.id
    rows = [keep(images[i], points[p]) for i, p in zip(rays.image, rays.point)]
    return given.replace(observations=rays.take(np.array(rows)))


def notes(result):
    return {note.thing: note for note in result.problem.network.left_out}


# --- the rule -------------------------------------------------------------------------------

SIGMA = 1e-4


def random_rays(centres, points, seed=0):
    """Sights of points from images at `centres`, all axes parallel, with noise."""
    rng = np.random.default_rng(seed)
    n, m = len(points), len(centres)
    image, point = np.repeat(np.arange(m), n), np.tile(np.arange(n), m)
    d = points[point] - centres[image]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    noise = rng.normal(0, SIGMA, d.shape)
    d = d + noise - d * (noise * d).sum(1, keepdims=True)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    seen = Sights(image, point, d, np.full(len(d), SIGMA), np.arange(len(d)), np.ones(m), n)
    model = Model.empty(seen)
    model.place(np.arange(m), centres, np.repeat(np.eye(3)[None], m, 0))
    model.X[:], model.known[:] = points, True
    return seen, model


@pytest.mark.parametrize("images", [2, 3, 5])
def test_rays_of_one_line_are_recognised_at_the_level_of_the_test(images):
    """4000 points on the line through the centres, and between the outer two of them."""
    along = np.array([1.0, 2.0, -2.0]) / 3
    centres = np.linspace(0, 1, images)[:, None] * along
    s = np.r_[np.linspace(2, 50, 3900), np.linspace(0.3, 0.45, 100)]
    seen, model = random_rays(centres, s[:, None] * along)
    line, one_place = rays_coincide(seen, model, np.ones(4000, bool))
    assert 0 <= (~line).sum() <= 12  # expected 4, at 0.1 %; 12 with P < 0.001
    assert not one_place.any()


def test_distant_points_and_near_ones_are_not_of_one_line():
    """Parallel rays from places apart give a direction; σ of a depth of a tenth is no line."""
    centres = np.array([[0.0, 0, 0], [1, 0, 0]])
    rng = np.random.default_rng(1)
    near = rng.uniform(-1, 1, (60, 3)) + [0, 0, -10]
    infinite = rng.uniform(-1, 1, (60, 3)) * 1e7 + [0, 0, -1e9]
    seen, model = random_rays(centres, np.concatenate([near, infinite]))
    model.known[60:] = False
    assert not rays_coincide(seen, model, np.ones(120, bool))[0].any()


def test_rays_that_fit_exactly_are_not_tested():
    """σ0 = 0, of exact measurements: every deviation would be significant, and p infinite."""
    seen, model = random_rays(np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[3.0, 0, 0]]))
    for found in rays_coincide(seen, model, np.ones(1, bool), factor=0.0):
        assert not found.any()
    # Of images fewer than three points are on a line all the same.
    assert see_collinear_points(seen, model, factor=0.0).all()
    three = np.arange(3.0)[:, None] * [0, 1, 0] + [3, 0, 0]
    assert not see_collinear_points(*random_rays(np.zeros((1, 3)), three), factor=0.0).any()


def test_images_from_one_place_are_named_as_such_for_their_points_only():
    centres = np.array([[0.0, 0, 0], [0, 0, 0], [1, 0, 0]])
    points = np.random.default_rng(2).uniform(-1, 1, (40, 3)) + [0, 0, -10]
    seen, model = random_rays(centres, points)
    twice = ~((seen.image == 2) & (seen.point < 5))
    cut = dataclasses.replace(seen, **{
        name: getattr(seen, name)[twice] for name in ("image", "point", "ray", "sigma", "row")
    })  # fmt: skip
    line, one_place = rays_coincide(cut, model, np.ones(40, bool))
    assert (line == (np.arange(40) < 5)).all() and (one_place == line).all()


def test_points_on_a_line_to_the_noise_of_the_rays():
    """Off the line by half and by ten times what is seen as σ."""
    centres = np.array([[0.0, 0, 0], [1, 0, 0]])
    along = np.linspace(-3, 3, 12)[:, None] * [1.0, 0.5, 0.2] + [0, 0, -10]
    for off, expected in ((0.5, True), (10, False)):
        shift = off * 10 * SIGMA * np.where(np.arange(12) % 2, 1, -1)[:, None] * [0, 1, 0]
        seen, model = random_rays(centres, along + shift)
        assert (see_collinear_points(seen, model) == expected).all()


def test_rays_beyond_the_side_have_coordinates_in_a_turned_camera():
    rng = np.random.default_rng(4)
    rays = rng.normal([3.0, 1.0, 0.5], 0.5, (30, 3))  # 80° to 110° from the axis −z
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    R, xy = in_plane(rays)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(R) > 0 and np.isfinite(xy).all()
    back = np.pad(xy, ((0, 0), (0, 1)), constant_values=-1.0) @ R
    np.testing.assert_allclose(back / np.linalg.norm(back, axis=1, keepdims=True), rays, atol=1e-14)
    before = np.array([[0.1, 0.2, -1.0], [0, 0, -1]])
    assert (in_plane(before)[0] == np.eye(3)).all()


# --- adjustments ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def twins():
    """Four images, the last of them twice, with noise of its own; '25' and '24' only in these."""
    stations = Stations(
        np.concatenate([RING.position, RING.position[3:]]),
        np.concatenate([RING.angles, RING.angles[3:]]),
    )
    return with_rays(network(stations), lambda i, p: p not in ("24", "25") or i in ("4", "5"))


@pytest.mark.further
def test_points_seen_only_from_one_place_are_left_out_by_name(twins):
    """They made the whole network singular."""
    result = jaxbundle.adjust(twins)
    assert result.converged
    note = notes(result)["tie point"]
    assert note.names == ("24", "25") and "one place (images '4', '5')" in note.why
    without = jaxbundle.adjust(with_rays(twins, lambda i, p: p not in ("24", "25")))
    assert result.vtpv == pytest.approx(without.vtpv, rel=1e-9)
    assert result.counts == without.counts
    head = result.report().split("Counts")[0]
    assert "Left out        2 tie points" in head
    assert "Left out" in str(result) and "2 tie points" in str(result)
    (left,) = result_dict(result, brief=True)["left_out"]
    assert left == {"kind": "tie point", "names": ["24", "25"], "reason": note.why}
    page = "".join(compose(result))
    assert "2 tie points" in page and "their distance is undetermined" in page


def test_what_is_left_out_is_kept_in_a_file(twins, tmp_path):
    result = jaxbundle.adjust(twins)
    result.save(tmp_path / "twins.npz")
    again = jaxbundle.load_adjustment(tmp_path / "twins.npz")
    assert notes(again) == notes(result)


def test_a_repeated_frame_is_named_with_the_one_it_repeats(twins):
    rays, images = twins.observations, twins.images.id
    xy, place = rays.xy.copy(), {(images[i], p): k for k, (i, p) in
                                 enumerate(zip(rays.image, rays.point))}  # fmt: skip
    for (image, point), k in place.items():
        if image == "5":
            xy[k] = xy[place["4", point]]
    copy = twins.replace(observations=dataclasses.replace(rays, xy=xy))
    result = jaxbundle.adjust(copy)
    assert result.converged and notes(result)["tie point"].names == ("24", "25")
    assert any("'5' repeats '4'" in line for line in result.warnings)


@pytest.mark.further
def test_an_image_of_two_points_and_one_of_a_line_are_left_out_by_name():
    """An image of few points ended in an error, one of a line in a singular network."""
    row = ("1", "2", "3", "4", "5")
    straight = TARGETS.copy()
    straight[:5, 1:] = straight[0, 1:]
    given = network(ring_of_stations(6, 3.0, 2.5, roll_every=2), straight)
    given = with_rays(given, lambda i, p: i != "2" or p in ("7", "19"))
    given = with_rays(given, lambda i, p: i != "5" or p in row)
    result = jaxbundle.adjust(given)
    assert result.converged
    names = {note.names: note.why for note in result.problem.network.left_out}
    assert "sees 2 known points of 2" in names["2",] and "on one line" in names["5",]
    without = jaxbundle.adjust(with_rays(given, lambda i, p: i not in ("2", "5")))
    assert result.vtpv == pytest.approx(without.vtpv, rel=1e-9)


def video(seed):
    """Six frames of a camera that moves along its axis; points '31' to '36' near the focus of
    expansion."""
    rng = np.random.default_rng(seed)
    stations = Stations(
        np.outer(np.arange(6), [0, 0, -0.5]), rng.normal(0, 0.002, (6, 3))
    )
    points = rng.uniform([-6, -4, -20], [6, 4, -8], (30, 3))
    depth = rng.uniform(15, 60, (6, 1))
    ahead = np.hstack([rng.uniform(-0.004, 0.004, (6, 2)), -np.ones((6, 1))]) * depth
    lens = Camera("cam", "opencv", {"fx": 1e3, "fy": 1e3, "cx": 639.5, "cy": 479.5},
                  image_size=(1280, 960))  # fmt: skip
    return simulate(stations, np.concatenate([points, ahead]), lens, noise=0.5, seed=seed,
                    disturb=(0.02, 0.002, 0.5), datum="inner")  # fmt: skip


@pytest.mark.further
def test_points_near_the_focus_of_expansion_cost_no_iterations():
    """They cost 50 to 90, or made the network singular."""
    result = jaxbundle.adjust(video(seed=0))
    assert result.converged and result.iterations < 15
    note = notes(result)["tie point"]
    assert len(note.names) >= 4 and all(int(name) > 30 for name in note.names)
    assert "line through the projection centres" in note.why
    assert 0.8 < result.sigma0 < 1.2


def fisheye(pose):
    """Ten images of 190°, without start values of points; poses off by `pose` (m, rad)."""
    rng = np.random.default_rng(5)
    X = rng.uniform([-4, -4, -2], [4, 4, 2], (70, 3))
    X = X[np.linalg.norm(X, axis=1) > 2.5]
    lens = Camera("cam", "kannala-brandt", {"fx": 300.0, "fy": 300.0, "cx": 499.5, "cy": 499.5},
                  image_size=(1000, 1000))  # fmt: skip
    stations = Stations(rng.uniform(-0.7, 0.7, (10, 3)), rng.uniform(-0.3, 0.3, (10, 3)))
    given = simulate(stations, X, lens, noise=0.3, seed=5, disturb=(*pose, 0.0), datum="inner")
    no_points = np.full_like(given.points.position, np.nan)
    return given.replace(points=dataclasses.replace(given.points, position=no_points))


@pytest.fixture(scope="module")
def good_start():
    return jaxbundle.adjust(fisheye((0.01, 0.001)))


@pytest.mark.further
def test_image_points_beyond_the_side_of_a_fisheye_give_start_values(good_start):
    """From 81° on they had no start values, and their points were seen in 0 placed images."""
    given = fisheye((0.01, 0.001))
    away = np.degrees(np.arccos(-make_sights(given).ray[:, 2]))
    assert (away > 81).mean() > 0.1 and away.max() > 92
    assert good_start.converged and not good_start.problem.network.left_out
    assert good_start.counts.observations == 2 * len(given.observations)
    assert 0.9 < good_start.sigma0 < 1.1


def test_what_poor_start_values_exclude_comes_back(good_start):
    given = fisheye((0.9, 0.15))
    first = jaxbundle.orient(given)
    assert len(first.left_out) + len(first.points_not_placed) > 20
    result = jaxbundle.adjust(given)
    assert result.converged and not result.problem.network.left_out
    assert result.counts == good_start.counts
    assert result.vtpv == pytest.approx(good_start.vtpv, rel=1e-6)
    assert "contradict the start values" not in " ".join(result.warnings)


@pytest.mark.further
def test_what_stays_out_contradicts_the_adjusted_orientation(good_start):
    given = fisheye((0.9, 0.15))
    rays, wrong = given.observations, [40, 200]
    xy = rays.xy.copy()
    xy[wrong] = 999 - xy[wrong]
    result = jaxbundle.adjust(given.replace(observations=dataclasses.replace(rays, xy=xy)))
    assert result.converged
    (note,) = result.problem.network.left_out
    ids = [f"{given.points.id[rays.point[k]]} in {given.images.id[rays.image[k]]}" for k in wrong]
    assert note.thing == "image point" and set(note.names) == set(ids)
    assert "contradict the adjusted orientation" in note.why
    assert result.counts.observations == good_start.counts.observations - 4
    assert "Left out        2 image points" in result.report().split("Counts")[0]
