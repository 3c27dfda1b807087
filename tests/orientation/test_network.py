"""A whole network without start values: the same adjustment as with them, and what cannot be
placed is named."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import jaxbundle
from jaxbundle import Camera, InputError, NotSolvedError
from jaxbundle.adjustment.adjust import adjust
from jaxbundle.adjustment.orient import orient
from jaxbundle.adjustment.problem import make_problem
from jaxbundle.leastsquares.iterations.stopping import converged
from jaxbundle.leastsquares.solution import find_minimum
from jaxbundle.network.check import check_network
from jaxbundle.network.subsets import keep_images
from jaxbundle.orientation.network import find_start_values, lacks_start_values
from jaxbundle.planning.stations import Stations

EXAMPLES = Path(__file__).parents[2] / "examples"
CASES = Path(__file__).parents[3] / "shared" / "cases"
pytestmark = pytest.mark.slow

FORMAT = (92.0, 60.0)
TRUE = Camera("aerial", "brown", {"c": 100.0, "x0": 0.1, "K1": 2e-6})
NOMINAL = Camera("aerial", "brown", {"c": 98.0}, free=("c", "x0", "y0", "K1"))


def bare(network, images=True, points=True):
    """Without the start values of the images, of the tie points."""
    if images:
        nothing = np.full((len(network.images), 3), np.nan)
        network = network.replace(
            images=dataclasses.replace(network.images, position=nothing, angles=nothing)
        )
    if points:
        tie = network.points.has_role("tie")[:, None]
        position = np.where(tie, np.nan, network.points.position)
        network = network.replace(points=dataclasses.replace(network.points, position=position))
    return network


def with_blunders(network, part, size, seed=5):
    rng = np.random.default_rng(seed)
    rays = network.observations
    bad = rng.random(len(rays)) < part
    xy = rays.xy + bad[:, None] * rng.uniform(-size, size, rays.xy.shape)
    return network.replace(observations=dataclasses.replace(rays, xy=xy))


def block(strips=3, images=5, points=220, control=(0, 1, 2, 3), start=NOMINAL):
    """An aerial block over hills, control in its corners, and its truth."""
    stations = jaxbundle.aerial_block(
        strips, images, height=1000, footprint=(920, 600), forward_overlap=0.6, side_overlap=0.3
    )
    reach = np.abs(stations.position[:, :2]).max(0) + 0.45 * np.array([920, 600])
    targets = jaxbundle.cloud_of_targets(points, (*(2 * reach), 100.0), seed=1)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    targets[:8, :2] = np.concatenate([0.55 * corners, 0.3 * corners]) * reach
    return jaxbundle.simulate_with_truth(
        stations, targets, TRUE, start=start, noise=0.005, seed=2, image_format=FORMAT,
        control=control, control_sigma=0.02, datum="control" if len(control) else "inner",
    )  # fmt: skip


@pytest.fixture(scope="module")
def with_control():
    """A block with eight control points, and its truth."""
    return block(control=range(8), start=TRUE)


@pytest.fixture(scope="module")
def solid():
    """Ten images of 81 targets."""
    return close_up(jaxbundle.grid_of_targets(9, 9, 0.6, relief=0.5))


def close_up(targets, **options):
    """Ten convergent images of targets."""
    stations = jaxbundle.ring_of_stations(10, 6.0, 5.0, roll_every=2)
    return jaxbundle.simulate(
        stations, targets, TRUE, start=NOMINAL, noise=0.002, image_format=FORMAT, **options
    )


def assert_same_answer(network, without):
    """Adjusted, both have the same vᵀPv, redundancy and parameters of cameras."""
    (expected, sum), (found, other) = map(minimum, (network, orient(without).network))
    assert other == pytest.approx(sum, rel=1e-9)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-12)


def minimum(network):
    """The parameters of the cameras, and vᵀPv and redundancy, at the minimum."""
    problem = make_problem(check_network(network))
    found = find_minimum(problem, problem.data.start, atol=1e-8)
    assert converged(int(found.termination))
    vtpv = 2 * np.nanmin(np.asarray(found.history.cost))
    return np.asarray(found.values["camera"]), (vtpv, problem.counts.redundancy)


# --- start values alone: these tests share their programs


@pytest.mark.further
def test_control_seen_once_throughout(with_control):
    """Eight control points, each measured in a single image."""
    rays = with_control.network.observations
    first = np.zeros(len(rays), bool)
    first[np.unique(rays.point, return_index=True)[1]] = True
    network = with_control.network.replace(observations=rays.take(first | (rays.point >= 8)))
    found = orient(bare(network))
    assert found.frame == "in the frame given" and not found.images_not_placed
    off = found.network.images.position - with_control.truth.images.position
    assert np.abs(off).max() < 0.05 * 1000


@pytest.mark.further
def test_a_strip_that_hangs_together_by_pairs():
    """With few points in three images resection stops, and a pair continues."""
    simulation = block(1, 11, 130, control=())
    found = orient(bare(simulation.network))
    assert not found.images_not_placed
    truth, position = simulation.truth.images.position, found.network.images.position
    along = np.linalg.norm(np.diff(position, axis=0), axis=1)
    assert np.ptp(along) < 0.3 * along.mean()
    assert len(truth) == len(position)


@pytest.mark.further
def test_several_cameras_of_several_models():
    """A metric camera, one in pixels and a fisheye around the same targets."""
    pixels = {"fx": 2000.0, "fy": 2000.0, "cx": 1499.5, "cy": 999.5, "k1": -0.1}
    fisheye = {"fx": 1200.0, "fy": 1200.0, "cx": 1499.5, "cy": 999.5, "k1": 0.02}
    cameras = (
        jaxbundle.Camera("metric", "brown", {"c": 24.0}, image_size=(3000, 2000),
                         pixel_size=(0.012, 0.012)),
        jaxbundle.Camera("pixels", "opencv", pixels, image_size=(3000, 2000)),
        jaxbundle.Camera("fisheye", "kannala-brandt", fisheye, image_size=(3000, 2000)),
    )  # fmt: skip
    stations = jaxbundle.ring_of_stations(9, 6.0, 5.0, roll_every=2)
    targets = jaxbundle.grid_of_targets(9, 9, 0.6, relief=0.5)
    network = jaxbundle.simulate(
        stations, targets, cameras, noise=0.01, camera_of_station=[0, 1, 2] * 3
    )
    found = orient(bare(network))
    assert not found.images_not_placed and not found.points_not_placed
    ratio = [
        np.linalg.norm(n.images.position[:, None] - n.images.position[None], axis=-1)
        for n in (found.network, network)
    ]
    scale = np.median(ratio[0][ratio[1] > 0] / ratio[1][ratio[1] > 0])
    assert np.abs(ratio[0] / scale - ratio[1]).max() < 0.05 * ratio[1].max()


@pytest.mark.parametrize(
    "what", ["y downward", pytest.param("X and Y exchanged", marks=pytest.mark.further)]
)
def test_a_mirror_is_named(what):
    """Control in a left-handed system, or images with y downward: both fit in part, and are a
    mirror image in truth."""
    targets = jaxbundle.cloud_of_targets(40, (4.0, 3.0, 1.5), seed=3)
    network = bare(close_up(targets, control=range(8), control_sigma=1e-3, datum="control"))
    rays, points = network.observations, network.points
    if what == "y downward":
        network = network.replace(
            observations=dataclasses.replace(rays, xy=rays.xy * np.array([1, -1]))
        )
    else:
        exchanged = dataclasses.replace(
            points, position=points.position[:, [1, 0, 2]], sigma=points.sigma[:, [1, 0, 2]]
        )
        network = network.replace(points=exchanged)
    with pytest.raises(NotSolvedError, match="8 control points .* better as a mirror image"):
        orient(network)


@pytest.mark.further
def test_half_a_network_is_none(solid):
    """Two parts that share nothing: `orient` places one and names the other, `adjust` refuses."""
    network = bare(solid)
    rays = network.observations
    apart = (rays.image < 5) == (rays.point < 40)
    network = network.replace(observations=rays.take(apart))
    assert len(orient(network).images_not_placed) == 5
    with pytest.raises(NotSolvedError, match="for 5 of 10 images"):
        adjust(network)


def test_what_cannot_be_placed_is_named_with_the_reason(solid):
    """An image with two points of the others, a point seen by that image and one more."""
    network = bare(solid)
    rays = network.observations
    keep = (rays.image != 4) | np.isin(rays.point, [10, 11])
    found = orient(network.replace(observations=rays.take(keep)))
    assert list(found.images_not_placed) == [network.images.id[4]]
    assert "2 known points of 2" in found.images_not_placed[network.images.id[4]]
    assert network.images.id[4] in str(found)
    assert len(found.network.images) == 9
    warning = next(w for w in found.network.notes if w.startswith("left out 1 image"))
    assert network.images.id[4] in warning


def test_what_is_given_stays(solid):
    """Start values of two images: they keep them, the others follow in their frame; two places
    alone would leave a turn about their line open."""
    network = solid
    without, two = bare(network), np.arange(10) < 2
    images = without.images
    given = dataclasses.replace(
        images,
        position=np.where(two[:, None], network.images.position, np.nan),
        angles=np.where(two[:, None], network.images.angles, np.nan),
    )
    found = orient(without.replace(images=given)).network
    np.testing.assert_array_equal(found.images.position[two], network.images.position[two])
    assert np.abs(found.images.position - network.images.position).max() < 0.5


def test_rays_that_miss_by_more_than_any_distortion_are_left_out(solid):
    """Three times 3 % of the radius of the image, the distortion that a wide-angle lens may have:
    the adjustment decides about a ray that is off by 7 %, not about one that is off by 15 %."""
    rays = solid.observations
    xy, radius = rays.xy.copy(), np.quantile(np.hypot(*rays.xy.T), 0.95)
    xy[[3, 500]] += np.array([[0.0, 0.07], [0.15, 0.0]]) * radius
    spoilt = solid.replace(observations=dataclasses.replace(rays, xy=xy))
    (left,) = find_start_values(spoilt).left_out
    image, point = solid.images.id[rays.image[500]], solid.points.id[rays.point[500]]
    assert image in left and point in left


def test_approximate_points_are_enough(solid):
    network = solid
    found = orient(bare(network, points=False)).network
    np.testing.assert_array_equal(found.points.position, network.points.position)
    assert np.abs(found.images.position - network.images.position).max() < 0.5


def test_a_distance_gives_the_scale():
    targets = jaxbundle.grid_of_targets(9, 9, 0.6, relief=0.5)
    network = close_up(targets, distances=[(0, 80)], distance_sigma=1e-4)
    found = orient(bare(network))
    assert "to scale" in found.frame
    a, b = (found.network.points.position[found.network.points.id.index(k)] for k in ("1", "81"))
    assert np.linalg.norm(a - b) == pytest.approx(network.distances.value[0], rel=1e-9)


def test_too_few_points_in_common_are_counted():
    """Five, where a relative orientation needs six."""
    network = bare(close_up(jaxbundle.cloud_of_targets(5, (4.0, 3.0, 1.5), seed=3)))
    with pytest.raises(NotSolvedError, match=r"6 points in common .* needs: 5 at most \('1', '"):
        orient(network)


def test_images_from_one_place_have_no_answer():
    turns = Stations(np.zeros((4, 3)), 0.1 * np.random.default_rng(0).normal(size=(4, 3)))
    targets = jaxbundle.cloud_of_targets(60, (4, 4, 2), centre=(0, 0, -10))
    network = jaxbundle.simulate(turns, targets, TRUE, noise=0.002)
    with pytest.raises(NotSolvedError, match="no start values found.*rays meet at an angle"):
        orient(bare(network))


def test_bad_data_is_found_before():
    network = bare(close_up(jaxbundle.grid_of_targets(9, 9, 0.6)))
    xy = network.observations.xy.copy()
    xy[3, 1] = np.nan
    rays = dataclasses.replace(network.observations, xy=xy)
    with pytest.raises(InputError, match="row 4: y of point"):
        orient(network.replace(observations=rays))


@pytest.mark.further
def test_control_seen_once_gives_the_frame():
    """Of the four control points of this network two are in one image each; far away, and in
    millimetres."""
    shift, scale = (4.6e5, 5.1e6, 300.0), 1000.0
    network = jaxbundle.read_network(EXAMPLES / "bingo_indoor" / "project.toml")
    points, images = network.points, network.images
    network = network.replace(
        points=dataclasses.replace(
            points, position=points.position * scale + shift, sigma=points.sigma * scale
        ),
        images=dataclasses.replace(images, position=images.position * scale + shift),
    )
    found = orient(bare(network))
    assert found.frame == "in the frame given"
    off = found.network.images.position - network.images.position
    assert np.abs(off).max() < 0.5 * scale
    assert_same_answer(network, found.network)


# --- and the adjustment from them


def test_adjust_needs_no_start_values(convergent4):
    """With its σ."""
    project = EXAMPLES / "convergent4" / "project.toml"
    network = jaxbundle.read_network(project, overrides=("sigma_image=1", "sigma_origin=unit"))
    without = bare(network)
    assert lacks_start_values(without) and not lacks_start_values(network)
    found = adjust(without)
    assert found.redundancy == convergent4.redundancy
    assert found.sigma0 == pytest.approx(convergent4.sigma0, rel=1e-8)
    (table,), (others,) = (one.cameras.values() for one in (convergent4, found))
    free = {name: entry for name, entry in table["parameters"].items() if entry["free"]}
    assert len(free) == 10
    for name, entry in free.items():
        other = others["parameters"][name]
        assert abs(other["value"] - entry["value"]) < 1e-4 * entry["sigma"]
        assert other["sigma"] == pytest.approx(entry["sigma"], rel=1e-5)


def test_an_example_needs_no_start_values():
    network = jaxbundle.read_network(EXAMPLES / "resection63" / "project.toml")
    assert_same_answer(network, bare(network))


def test_details_of_a_single_photograph_are_left_out_by_name():
    """As many tie points as control, all measured once: no start values would determine them."""
    control = jaxbundle.read_network(EXAMPLES / "resection63" / "project.toml")
    names = control.points.id[4:]
    roles = lambda ties: (*control.points.role[:-ties], *("tie",) * ties)
    as_ties = lambda ties: control.replace(
        points=dataclasses.replace(control.points, role=roles(ties))
    )
    found = adjust(bare(as_ties(len(names))))
    started = adjust(as_ties(len(names)))
    assert found.redundancy == 2 and found.vtpv == pytest.approx(started.vtpv, rel=1e-9)
    for result in (found, started):
        (note,) = result.problem.network.left_out
        assert note.names == names and not note.measured
    # Where there are no others, they are why nothing can be solved.
    with pytest.raises(NotSolvedError, match="no start values for 8 of 8 points"):
        adjust(bare(as_ties(8), images=False))


@pytest.mark.skipif(not CASES.is_dir(), reason="the folder ../shared/cases is not here")
def test_a_case_needs_no_start_values():
    network = jaxbundle.read_network(CASES / "riva_3dfield" / "project.toml")
    assert_same_answer(network, bare(network))


@pytest.mark.further
def test_control_in_the_corners_of_a_block():
    """No image sees enough control: pairs first, then the transformation to the control."""
    simulation = block()
    found = orient(bare(simulation.network))
    assert not found.images_not_placed and not found.points_not_placed and "given" in found.frame
    off = found.network.images.position - simulation.truth.images.position
    assert np.abs(off).max() < 0.05 * 1000  # the principal distance is 2 % wrong
    assert_same_answer(simulation.network, bare(simulation.network))


@pytest.mark.further
def test_one_measurement_in_twenty_wrong(with_control):
    """Most blunders are left out with the start values, the rest by data snooping."""
    network = bare(with_blunders(with_control.network, 0.05, 20.0))
    found = orient(network)
    assert not found.images_not_placed
    off = found.network.images.position - with_control.truth.images.position
    assert np.abs(off).max() < 0.2 * 1000
    result = adjust(network, snooping="pope")
    off = result.image_values[:, :3] - with_control.truth.images.position
    sigma = np.stack([result.images[f"s{axis}"] for axis in ("X0", "Y0", "Z0")], 1)
    assert np.abs(off / sigma).max() < 5
    assert abs(result.sigma0 - 1) < 0.15


@pytest.mark.further
def test_blunders_that_leave_least_squares_no_solution(with_control):
    """Even with good start values, observations that contradict them completely are removed before
    data snooping."""
    spoilt = with_blunders(with_control.network, 0.05, 20.0)
    assert not adjust(spoilt).converged
    result = adjust(spoilt, snooping="pope")
    off = result.image_values[:, :3] - with_control.truth.images.position
    sigma = np.stack([result.images[f"s{axis}"] for axis in ("X0", "Y0", "Z0")], 1)
    assert np.abs(off / sigma).max() < 5
    assert any("that contradict the adjusted" in warning for warning in result.notes)


@pytest.mark.further
def test_a_plane_without_control():
    """With an image that cannot be placed: the result is that without it."""
    network = close_up(jaxbundle.grid_of_targets(9, 9, 0.6))
    rays = network.observations
    keep = (rays.image != 4) | np.isin(rays.point, [10, 11])
    without = keep_images(network, np.arange(10) != 4)
    assert_same_answer(without, bare(network.replace(observations=rays.take(keep))))


@pytest.mark.further
def test_a_principal_distance_far_from_the_truth():
    """Observations left out because they contradict the given one come back with the adjusted
    one."""
    true = Camera("wide", "brown", {"c": 50.0, "K1": -2e-6})
    start = Camera("wide", "brown", {"c": 40.0}, free=("c", "x0", "y0", "K1"))
    near = dataclasses.replace(start, parameters={"c": 50.0})
    network, other = (
        jaxbundle.simulate(
            jaxbundle.ring_of_stations(10, 3.2, 2.4, roll_every=2),
            jaxbundle.grid_of_targets(9, 9, 0.5), true, start=camera, noise=0.002,
            image_format=FORMAT, control=(0, 8, 40, 72, 80), control_sigma=1e-4, datum="control",
        )
        for camera in (near, start)
    )  # fmt: skip
    (camera, counts), found = minimum(network), adjust(bare(other))
    values = [entry["value"] for entry in found.cameras["wide"]["parameters"].values()]
    np.testing.assert_allclose(values, camera[0], rtol=1e-6, atol=1e-12)
    assert (found.vtpv, found.redundancy) == pytest.approx(counts, rel=1e-9)


@pytest.mark.further
def test_an_image_first_placed_by_repeated_parts_is_placed_again():
    """Of the points of the first pair, image '1' shows others that look alike: as from where '2'
    is. Most of its points, known only later, do not agree with that."""
    network = close_up(jaxbundle.cloud_of_targets(400, (4.0, 3.0, 1.5), seed=3))
    rays, part = network.observations, np.repeat(["pair", "late", "link"], [300, 70, 30])
    there, group = rays.image, part[rays.point]
    wrong = (group == "pair") & (there == 0) & (rays.point < 35)
    seen = wrong | ((group == "pair") & np.isin(there, [4, 5]))
    seen |= (group == "late") & ((there == 0) | (there > 5))
    seen |= (group == "link") & (there > 3)
    xy = rays.xy.copy()
    neighbour = {p: xy[k] for k, p in enumerate(rays.point) if there[k] == 1}
    xy[wrong] = [neighbour[p] for p in rays.point[wrong]]
    found = orient(bare(network.replace(observations=dataclasses.replace(rays, xy=xy).take(seen))))
    images = found.network.images
    assert len(images) == 7 and images.id[0] == "1"
    true = network.images.position[[network.images.id.index(id) for id in images.id]]
    ratio = lambda X: np.linalg.norm(X[0] - X[1:], axis=1) / np.linalg.norm(X[1] - X[2])
    np.testing.assert_allclose(ratio(images.position), ratio(true), rtol=0.1)


@pytest.mark.further
def test_handheld_control_is_not_refused(with_control):
    """σ of control a twelfth of its extent, with one measurement under a wrong name: start values
    are found, and the wrong measurement is named."""
    network = with_control.network
    control = np.flatnonzero(network.points.has_role("control"))
    sigma, X = network.points.sigma.copy(), network.points.position.copy()
    extent = np.ptp(X[control], axis=0).max()
    sigma[control] = extent / 12
    X[control] += extent / 12 * np.random.default_rng(2).standard_normal((len(control), 3))
    points = dataclasses.replace(network.points, position=X, sigma=sigma)
    rays = network.observations
    xy = rays.xy.copy()
    wrong = int(np.flatnonzero(rays.point == control[-1])[0])
    xy[wrong] += [15.0, -9.0]
    network = bare(network.replace(points=points, observations=dataclasses.replace(rays, xy=xy)))
    found = orient(network)
    assert not found.images_not_placed and not found.finding
    name = f"{points.id[control[-1]]} in {network.images.id[rays.image[wrong]]}"
    assert found.left_out == (name,)
