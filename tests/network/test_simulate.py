"""Simulated networks: the truth fits the image coordinates, and adjustment finds it again."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbundle
from jaxbundle import Camera, InputError, cameras
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.planning.simulate import simulate, simulate_with_truth
from jaxbundle.planning.stations import (
    Stations,
    aerial_block,
    cloud_of_targets,
    grid_of_targets,
    ring_of_stations,
    stations_looking_at,
)

CAMERAS = {
    "brown": ({"c": 20.0, "x0": 0.11, "y0": -0.07, "K1": 2e-4, "K2": -1e-6, "P1": 3e-5,
               "b1": -1e-3}, (24.0, 16.0)),
    "brown-projected": ({"c": 20.0, "x0": 0.02, "K1": -2e-4, "K2": 1e-6, "P2": -3e-5},
                        (24.0, 16.0)),
    "usgs": ({"c": 150.0, "x0": -0.03, "K0": -5e-5, "K1": 4e-8, "P1": -8e-7, "P3": 1e-6},
             (180.0, 120.0)),
    "bingo": ({"c": 127.0, "x0": -0.05, "y0": 0.16, "p25": 16.3, "p26": -1.8,
               "format_factor": 1.28}, (192.0, 108.0)),
    "opencv": ({"fx": 1000.0, "fy": 1004.0, "cx": 640.3, "cy": 477.6, "k1": -0.2, "p1": 1.8e-3,
                "k4": 0.01, "s1": 1e-3}, (1280, 960)),
    "kannala-brandt": ({"fx": 700.0, "fy": 703.0, "cx": 642.0, "cy": 478.0, "k1": 0.1,
                        "k2": 0.05}, (1280, 960)),
    "snavely": ({"f": 500.0, "k1": -0.12, "k2": 0.03}, (640.0, 480.0)),
}  # fmt: skip
RING = ring_of_stations(5, radius=3.0, height=2.0, roll_every=2)
BROWN = Camera("cam", "brown", CAMERAS["brown"][0], free=("c", "x0", "y0", "K1"))
TARGETS = cloud_of_targets(60, (3.0, 3.0, 1.0), seed=3)


def camera_rays(network):
    """[r, s, q] of every image point, from the values of the network."""
    images, points, rows = network.images, network.points, network.observations
    M = np.asarray(jax.vmap(matrix_from_omega_phi_kappa)(jnp.asarray(images.angles)))
    offset = points.position[rows.point] - images.position[rows.image]
    return np.einsum("nij,nj->ni", M[rows.image], offset)


def parameters_in_order(camera):
    model = cameras.get_model(camera.model)
    values = {**cameras.default_parameters(model), **camera.parameters}
    return model, tuple(values[name] for name in model.parameters)


@partial(jax.jit, static_argnums=(0, 1))
@partial(jax.vmap, in_axes=(None, None, None, 0, 0))
def residual(model, domain, p, ray, xy):
    return jnp.stack(cameras.residual(model, domain, p, tuple(ray), tuple(xy)))


def image_residuals(network, domain):
    model, p = parameters_in_order(network.cameras[0])
    return np.asarray(residual(model, domain, p, camera_rays(network), network.observations.xy))


@pytest.mark.parametrize("domain", ["corrected", "measured"])
@pytest.mark.parametrize("name", CAMERAS)
def test_truth_has_no_residuals(name, domain):
    parameters, size = CAMERAS[name]
    camera = Camera("cam", name, parameters)
    made = simulate_with_truth(
        RING, TARGETS, camera, noise=0.5, seed=5, image_format=size, residuals=domain
    )
    assert made.truth.residuals == domain
    assert len(made.truth.observations) > 100
    exact = np.abs(image_residuals(made.truth, domain)).max()
    assert exact < 1e-11 * max(size)
    without = simulate(RING, TARGETS, camera, noise=0, image_format=size, residuals=domain)
    np.testing.assert_array_equal(without.observations.xy, made.truth.observations.xy)
    np.testing.assert_array_equal(without.observations.sigma, 1.0)
    # a network with noise: the noise asked for
    v = made.network.observations.xy - made.truth.observations.xy
    assert v.std() == pytest.approx(0.5, rel=4 / np.sqrt(2 * v.size))
    np.testing.assert_array_equal(made.network.observations.sigma, 0.5)


def test_the_adjustment_sees_no_residuals_either():
    made = simulate_with_truth(
        RING, TARGETS, BROWN, noise=0, image_format=(24, 16), distances=[(0, 1)], control=[2, 5, 9],
        control_sigma=0.01,
    )  # fmt: skip
    problem = jaxbundle.make_problem(made.truth)
    r = Inspection(problem, problem.data.start).residuals
    for name in ("image", "control", "distance"):
        rows = r[name]
        assert len(rows) and np.abs(rows).max() < 1e-9


@pytest.mark.parametrize("name", ["brown", "opencv", "snavely"])
def test_all_and_only_what_lies_in_the_format_is_imaged(name):
    parameters, size = CAMERAS[name]
    camera = Camera("cam", name, parameters)
    targets = cloud_of_targets(300, 9.0, seed=1)  # around and behind the stations too
    truth = simulate_with_truth(
        RING, targets, camera, noise=0, image_format=size, min_rays=1
    ).truth
    assert (camera_rays(truth)[:, 2] < 0).all()
    low = np.array([-0.5, -0.5]) if name == "opencv" else -np.array(size) / 2
    xy = truth.observations.xy
    assert (xy >= low).all() and (xy <= low + size).all()

    # the same from the formulas, for every target in every image
    model, p = parameters_in_order(camera)
    M = np.asarray(jax.vmap(matrix_from_omega_phi_kappa)(jnp.asarray(RING.angles)))
    rays = np.einsum("nij,npj->npi", M, targets - RING.position[:, None]).reshape(-1, 3)

    @jax.jit
    @jax.vmap
    def there_and_back(ray):
        xy = cameras.project(model, p, *ray)
        return jnp.stack(xy), jnp.stack(cameras.image_ray(model, p, *xy))

    image, back = (np.asarray(x) for x in there_and_back(jnp.asarray(rays)))
    inside = (rays[:, 2] < 0) & ((image >= low) & (image <= low + size)).all(1)
    found = np.zeros((len(RING), len(targets)), bool)
    numbers = np.array([int(id) - 1 for id in truth.points.id])
    found[truth.observations.image, numbers[truth.observations.point]] = True
    found = found.ravel()
    assert not (found & ~inside).any()
    # what is missing was folded back into the image from far outside
    lost = inside & ~found
    direction = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    assert not (np.linalg.norm(back - direction, axis=1)[lost] < 1e-6).any()
    if name == "brown":
        assert not lost.any()


def test_a_folded_distortion_images_nothing_twice():
    camera = Camera("cam", "snavely", {"f": 500.0, "k1": -0.4})
    one = stations_looking_at([[0.0, 0.0, 10.0], [0.1, 0.0, 10.0]], [0.0, 0.0, 0.0])
    targets = np.stack([np.linspace(0.5, 30, 60), np.zeros(60), np.zeros(60)], 1)
    truth = simulate_with_truth(one, targets, camera, noise=0, image_format=(800, 800)).truth
    first = truth.observations.take(truth.observations.image == 0)
    # f·ρ·(1 − 0.4·ρ²) turns at ρ = √(1/1.2); ρ = X/10 here
    X = truth.points.position[first.point, 0]
    assert 8 < X.max() < 10 * np.sqrt(1 / 1.2)
    assert (np.diff(first.xy[np.argsort(X), 0]) > 0).all()


def test_a_fisheye_sees_behind_the_image_plane():
    parameters, _ = CAMERAS["kannala-brandt"]
    camera = Camera("cam", "kannala-brandt", {**parameters, "k1": 0.0, "k2": 0.0})
    one = stations_looking_at([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]], [0.0, 0.0, -1.0])
    targets = [[5.0, 0.0, 1.0], [5.0, 0.0, -1.0], [0.0, 4.0, -9.0]]
    network = simulate(one, targets, camera, noise=0)
    assert set(network.points.id) == {"1", "2", "3"}


def test_the_format_of_the_camera_is_the_default():
    in_mm = dataclasses.replace(BROWN, image_size=(2400, 1600), pixel_size=(0.01, 0.01))
    by_camera = simulate(RING, TARGETS, in_mm, noise=0)
    by_hand = simulate(RING, TARGETS, BROWN, noise=0, image_format=(24, 16))
    np.testing.assert_array_equal(by_camera.observations.xy, by_hand.observations.xy)
    everything = simulate(RING, TARGETS, BROWN, noise=0)
    assert len(everything.observations) > len(by_hand.observations)


def equal(a, b):
    return all(
        np.array_equal(x, y)
        for x, y in (
            (a.observations.xy, b.observations.xy), (a.observations.image, b.observations.image),
            (a.observations.point, b.observations.point), (a.points.position, b.points.position),
            (a.images.position, b.images.position), (a.images.angles, b.images.angles),
        )
    )  # fmt: skip


def test_a_seed_makes_one_network():
    def make(seed):
        return simulate(RING, TARGETS, BROWN, noise=0.01, seed=seed, disturb=0.01, max_rays=3)

    assert equal(make(4), make(4))
    assert not equal(make(4), make(5))


def test_start_values_are_true_or_disturbed():
    exact = simulate_with_truth(RING, TARGETS, BROWN, noise=0.01)
    np.testing.assert_array_equal(exact.network.points.position, exact.truth.points.position)
    np.testing.assert_array_equal(exact.network.images.angles, exact.truth.images.angles)
    many = cloud_of_targets(2000, 2.0)
    made = simulate_with_truth(RING, many, BROWN, noise=0.01, disturb=(0.3, 0.0, 0.05))
    error = made.network.points.position - made.truth.points.position
    assert error.std() == pytest.approx(0.05, rel=0.05)
    assert (made.network.images.position != made.truth.images.position).all()
    np.testing.assert_array_equal(made.network.images.angles, made.truth.images.angles)


def test_roles():
    options = dict(noise=0.01, image_format=(24, 16), seed=2, disturb=0.01)
    made = simulate_with_truth(
        RING, TARGETS, BROWN, control=[0, 7], control_sigma=(0.1, 0.2, 0.3), check=[3], **options
    )
    points, true = made.network.points, made.truth.points.position
    role = dict(zip(points.id, points.role))
    assert [role[id] for id in ("1", "8", "4", "2")] == ["control", "control", "check", "tie"]
    np.testing.assert_array_equal(points.sigma[points.has_role("control")], [[0.1, 0.2, 0.3]] * 2)
    wrong = (points.position != true).all(1)
    np.testing.assert_array_equal(wrong, ~points.has_role("check"))
    fixed = simulate_with_truth(RING, TARGETS, BROWN, control=[0, 7], **options)
    chosen = fixed.network.points.has_role("fixed")
    assert chosen.sum() == 2
    np.testing.assert_array_equal(
        fixed.network.points.position[chosen], fixed.truth.points.position[chosen]
    )


def test_rays_of_a_point_are_limited():
    def rays(**options):
        rows = simulate(RING, TARGETS, BROWN, noise=0.01, image_format=(24, 16), **options)
        return np.bincount(rows.observations.point)

    assert rays().max() == 5
    limited = rays(max_rays=3)
    assert limited.max() == 3 and len(limited) == len(rays())
    few = rays(min_rays=4)
    assert few.min() >= 4 and len(few) == (rays() >= 4).sum()


def test_incidence_is_limited():
    normal = [0.0, 0.0, 1.0]
    made = simulate(
        RING, TARGETS, BROWN, noise=0, normals=normal, max_incidence=np.radians(50), min_rays=1
    )
    rows = made.observations
    ray = made.images.position[rows.image] - made.points.position[rows.point]
    angle = np.degrees(np.arccos(ray[:, 2] / np.linalg.norm(ray, axis=1)))
    assert 45 < angle.max() <= 50


TRUE = {"c": 20.0, "x0": 0.11, "y0": -0.07, "K1": 2e-4}


@pytest.fixture(scope="module")
def adjusted():
    """A ring of five photographs with ten fixed points, from poor start values: truth, result."""
    made = simulate_with_truth(
        RING, TARGETS, dataclasses.replace(BROWN, parameters=TRUE),
        start=dataclasses.replace(BROWN, parameters={"c": 20.5}), noise=0.002, seed=11,
        image_format=(24, 16), disturb=0.01, datum="control", control=range(0, 60, 6),
    )  # fmt: skip
    result = jaxbundle.adjust(made.network)
    assert result.converged and result.warnings == ()
    return made.truth, result


@pytest.mark.further
def test_the_adjustment_finds_the_true_camera(adjusted):
    _, result = adjusted
    assert abs(result.sigma0 - 1) < 4 / np.sqrt(2 * result.redundancy)
    for name, value in TRUE.items():
        entry = result.cameras["cam"]["parameters"][name]
        assert abs(entry["value"] - value) < 4 * entry["sigma"], name
        # a useful network: the parameter really is determined
        assert entry["sigma"] < 0.1 * abs(value), name


def test_the_adjustment_finds_the_true_points_and_stations(adjusted):
    truth, result = adjusted
    tie = truth.points.has_role("tie")
    difference = (result.point_values - truth.points.position)[tie]
    w = np.einsum(
        "pi,pij,pj->p", difference, np.linalg.inv(result.point_covariance[tie]), difference
    )
    # χ² with 3 degrees of freedom each: mean 3; they are correlated, so the limit is wide
    assert 1.5 < w.mean() < 5
    pose = np.abs(result.image_values - np.hstack([RING.position, RING.angles]))
    sigma = np.sqrt(np.diagonal(result.image_covariance, axis1=1, axis2=2))
    assert (pose < 4 * sigma).all()


def test_a_camera_for_every_station():
    several = [
        Camera(f"cam{i}", "brown", {"c": 20.0 + i, "K1": 1e-4 * i}, free=("c",)) for i in range(5)
    ]
    made = simulate_with_truth(RING, TARGETS, several, noise=0, image_format=(24, 16))
    np.testing.assert_array_equal(made.truth.images.camera, np.arange(5))
    for i, camera in enumerate(several):
        keep = made.truth.observations.image == i
        rows = made.truth.observations.take(keep)
        one = made.truth.replace(cameras=(camera,), observations=rows)
        assert np.abs(image_residuals(one, "corrected")).max() < 1e-10
    shared = simulate(RING, TARGETS, several[:2], noise=0, camera_of_station=[0, 1, 1, 0, 1])
    assert shared.images.camera.tolist() == [0, 1, 1, 0, 1]


def test_a_big_network_is_made_in_batches(monkeypatch):
    """Batches change nothing, the last one smaller than the others."""
    whole = simulate(RING, TARGETS, BROWN, noise=0.01, image_format=(24, 16))
    monkeypatch.setattr("jaxbundle.planning.simulate.RAYS_AT_ONCE", 2 * len(TARGETS))
    parts = simulate(RING, TARGETS, BROWN, noise=0.01, image_format=(24, 16))
    np.testing.assert_allclose(parts.observations.xy, whole.observations.xy, rtol=0, atol=1e-12)
    assert len(parts.observations) == len(whole.observations)


def test_stations_look_where_they_are_told():
    position = np.array([[3.0, 1.0, 2.0], [0.0, 0.0, 5.0], [-4.0, 0.0, 1.0]])
    at = np.array([0.5, 0.2, 0.1])
    for roll in (0.0, 0.7):
        stations = stations_looking_at(position, at, roll=roll)
        M = np.asarray(jax.vmap(matrix_from_omega_phi_kappa)(jnp.asarray(stations.angles)))
        ray = np.einsum("nij,nj->ni", M, at - position)
        np.testing.assert_allclose(ray[:, :2], 0, atol=1e-12)
        assert (ray[:, 2] < 0).all()
        # up is in the upper half, turned by −roll as seen in the camera that turned by roll
        up = M @ np.array([0.0, 0.0, 1.0])
        turned = np.arctan2(up[:, 0], up[:, 1])
        np.testing.assert_allclose(turned, roll, atol=1e-12)


def test_a_camera_that_looks_straight_down_is_not_turned():
    stations = stations_looking_at([[1.0, 2.0, 7.0]], [1.0, 2.0, 0.0])
    np.testing.assert_allclose(stations.angles, 0, atol=1e-15)


def test_aerial_block():
    block = aerial_block(3, 4, height=1000.0, footprint=(900.0, 600.0), centre=(10.0, 20.0, 50.0))
    assert len(block) == 12
    np.testing.assert_allclose(block.position.mean(0), [10, 20, 1050])
    strips = block.position.reshape(3, 4, 3)
    np.testing.assert_allclose(np.abs(np.diff(strips[..., 0], axis=1)), 360)
    np.testing.assert_allclose(np.diff(strips[..., 1], axis=0), 420)
    np.testing.assert_allclose(np.abs(block.angles[:, 2]).reshape(3, 4)[:, 0], [0, np.pi, 0])
    np.testing.assert_allclose(block.angles[:, :2], 0, atol=1e-15)
    # forward: the axis meets the ground ahead of the camera
    tilted = aerial_block(2, 2, height=10.0, footprint=(9.0, 6.0), heading=0.3, tilt=0.2)
    M = np.asarray(jax.vmap(matrix_from_omega_phi_kappa)(jnp.asarray(tilted.angles)))
    flight = tilted.position[1] - tilted.position[0]
    axis = -M[0, 2]
    ahead = np.array([np.cos(0.3), np.sin(0.3), 0.0])
    np.testing.assert_allclose(flight / np.linalg.norm(flight), ahead, atol=1e-12)
    np.testing.assert_allclose(
        axis, np.sin(0.2) * ahead - np.cos(0.2) * np.array([0, 0, 1]), atol=1e-12
    )


def test_grid_of_targets():
    grid = grid_of_targets(4, 3, (2.0, 1.0), relief=0.5, centre=(1.0, 2.0, 3.0))
    assert grid.shape == (12, 3)
    np.testing.assert_allclose(grid[:4, 0], [-2, 0, 2, 4])
    np.testing.assert_allclose(grid[::4, 1], [1, 2, 3])
    assert np.abs(grid[:, 2] - 3).max() <= 0.5 < 10 * grid[:, 2].std()


GOOD = dict(noise=0.01, image_format=(24, 16))


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(noise=-1), "noise is -1"),
        (dict(image_format=(24, 0)), "image_format is"),
        (dict(control=[99]), "control holds an index that is not among the 60 targets"),
        (dict(control=[1], check=[1]), "control point and a check point at once"),
        (dict(control=[1], control_sigma=(0, 1, 1)), "must be given for all three axes or"),
        (dict(camera_of_station=[0, 0]), "camera_of_station must be 5 indices below 1"),
        (dict(max_incidence=1.0), "give normals"),
        (dict(datum="iner"), "datum must be one of"),
        (dict(distances=[(0, 60)]), "distances name an index"),
        (dict(image_format=(1e-3, 1e-3)), "no target is imaged often enough"),
    ],
)
def test_impossible_arguments_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        simulate(RING, TARGETS, BROWN, **{**GOOD, **change})


def test_impossible_stations_are_refused():
    with pytest.raises(InputError, match=r"stations: position has the shape \(3,\)"):
        Stations([0.0, 0.0, 0.0], [[0.0, 0.0, 0.0]])
    with pytest.raises(InputError, match="2 positions but 1 rows of angles"):
        Stations(np.zeros((2, 3)), np.zeros((1, 3)))
    with pytest.raises(InputError, match="station 1 is at the point it looks at"):
        stations_looking_at([[0.0, 0.0, 0.0]], [0.0, 0.0, 0.0])
    with pytest.raises(InputError, match="targets, row 2: nan is not a finite number"):
        simulate(RING, [[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]], BROWN, noise=0.01)
