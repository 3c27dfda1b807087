"""RPC images in a refinement: truth, a dense solution, blunders, undetermined biases, terrain."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rpc_block import SIGMA_CONTROL, SIGMA_RPC, block, moved
from test_with_photographs import photograph

from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.geometry.ellipsoid import WGS84, earth_fixed, geodetic
from jaxbundle.network.tables import Distances
from jaxbundle.pushbroom.rpc.bias import RpcBias, project_compensated
from jaxbundle.pushbroom.rpc.polynomials import project_points
from jaxbundle.pushbroom.terrain import make_terrain
from jaxbundle.refinement import HeightModel, point_rows, prior_of_bias, prior_of_errors, refine
from jaxbundle.report.refinement_verdict import conclude_refinement


@pytest.fixture(scope="module")
def scene():
    return block(rpc=4, scanner=0, points=24, control=5, checks=2, degree=1, rays=4)


@pytest.fixture(scope="module")
def case(scene):
    arguments, bias = scene.draw(np.random.default_rng(2))
    return arguments, bias, refine(*arguments)


def with_priors(images, sigma):
    return [dataclasses.replace(one, bias_sigma=sigma) for one in images]


def test_biases_and_points_come_back(scene, case):
    _, bias, result = case
    assert len(result.names) == bias.size == 24
    assert (np.abs(result.estimate - bias.ravel()) < 3 * result.inspection.sigma).all()
    np.testing.assert_allclose(result.bias("R2").line, result.estimate[12:15])
    by_id = {row["id"]: row for row in point_rows(result)}
    ties = [k for k, role in enumerate(scene.roles) if role == "tie"]
    X = np.array([[by_id[f"P{k}"][c] for c in "XYZ"] for k in ties])
    sigma = np.array([[by_id[f"P{k}"][f"s{c}"] for c in "XYZ"] for k in ties])
    assert (np.abs(X - scene.X[ties]) < 4 * sigma).all()
    check = result.check
    assert (np.abs(check.difference) < 4 * check.sigma).all() and set(check.id) == {"P5", "P6"}


def test_counts_add_up(case):
    (_, _, observations), _, result = case
    n = result.counts()
    checks = np.isin(observations.point, (5, 6)).sum()
    assert n["image coordinates"] == 2 * (len(observations) - checks)
    assert (n["control coordinates"], n["priors"], n["shared unknowns"]) == (15, 24, 24)
    assert n["point coordinates"] == 3 * 22
    observed = n["image coordinates"] + n["control coordinates"] + n["priors"]
    redundancy = observed - n["point coordinates"] - n["shared unknowns"]
    assert n["redundancy"] == result.redundancy == redundancy
    # redundancy numbers of all observations, priors included, add up to the redundancy
    r = result.inspection.solution.reliability.redundancy
    assert sum(float(x.sum()) for x in r.values()) == pytest.approx(redundancy, rel=1e-9)
    rays = result.rays()
    assert sum(rays.values()) == 22 and sum(k * m for k, m in rays.items()) == len(
        result.image_points()
    )
    assert result.to_dict()["counts"] == n


def test_the_same_as_a_dense_solution(scene, case):
    """σ and the minimum of equations written here, without declarations."""
    (images, points, observations), _, result = case
    chosen = result.inspection.declared.rays.points
    used = np.isin(observations.point, chosen)
    i, p, xy = observations.image[used], observations.point[used], observations.xy[used]
    at = np.searchsorted(chosen, p)
    rpc = jax.tree.map(lambda *x: jnp.stack(x), *(one.image.rpc for one in images))
    prior = np.stack([one.bias_sigma for one in images]).ravel()
    control = np.flatnonzero(np.array(scene.roles)[chosen] == "control")

    @jax.jit
    def rows(y):
        bias, X = y[:24].reshape(4, 2, 3), y[24:].reshape(-1, 3)

        def image_of(i, X):
            one = jax.tree.map(lambda x: x[i], rpc)
            place = geodetic(WGS84, tuple(X))
            return jnp.stack(project_compensated(one, RpcBias(*bias[i]), *place))

        v = (jax.vmap(image_of)(i, X[at]) - xy) / SIGMA_RPC
        off = jnp.einsum("pij,pj->pi", points.axes[chosen[control]],
                         X[control] - points.X[chosen[control]]) / SIGMA_CONTROL  # fmt: skip
        return jnp.concatenate([v.ravel(), off.ravel(), y[:24] / prior])

    y = np.concatenate([result.estimate, result.positions.ravel()])
    J, v = np.asarray(jax.jit(jax.jacfwd(rows))(y)), np.asarray(rows(y))
    Q = np.linalg.inv(J.T @ J)
    sigma = np.sqrt(np.diagonal(Q))
    assert np.abs((Q @ J.T @ v) / sigma).max() < 1e-4
    assert v @ v == pytest.approx(result.sigma0**2 * result.redundancy, rel=1e-8)
    np.testing.assert_allclose(result.inspection.sigma, result.sigma0 * sigma[:24], rtol=1e-6)
    X = np.array([[row[f"s{c}"] for c in "XYZ"] for row in point_rows(result)])
    np.testing.assert_allclose(X.ravel(), result.sigma0 * sigma[24:], rtol=1e-5)


def test_compensated_coefficients_contain_the_bias(scene, case):
    _, _, result = case
    ground = tuple(np.asarray(v) for v in geodetic(WGS84, tuple(scene.X.T)))
    for k, one in enumerate(result.images):
        rpc = result.image(one.id).rpc
        found = np.stack(project_points(rpc, *ground)[:2], 1)
        terms = np.einsum("ak,kp->pa", result.estimate.reshape(4, 2, 3)[k], scene.terms[k, :3])
        np.testing.assert_allclose(found, scene.places[k] + terms, atol=5e-3)


def test_blunders_in_control_and_tie_points_are_named(scene, case):
    (images, points, observations), _, result = case
    ties = np.array([role == "tie" for role in scene.roles])
    row = int(np.flatnonzero(ties[observations.point])[7])
    # the third axis of a control point, up, is seen by all rays
    X = points.X.copy()
    X[3] += 12.0 * points.axes[3, 2]
    wrong = dataclasses.replace(points, X=X), moved(observations, row, [0.0, 8.0])
    found = refine(images, *wrong, snooping="baarda", significance=1e-4)
    named = {blunder.name for blunder in found.removed}
    image = images[observations.image[row]].id
    assert named == {"up of control point P3", f"point P{observations.point[row]} in image {image}"}
    assert found.sigma0 < 1.3 and result.robust_sigma0 == pytest.approx(1.0, abs=0.25)


@pytest.mark.further
def test_undetermined_biases_are_named(scene, case):
    (images, points, observations), _, _ = case
    # no measurement in one image
    seen = observations.take(observations.image != 2)
    with pytest.raises(NotSolvedError, match="do not determine the .* of image R2"):
        refine(with_priors(images, prior_of_bias(1)), points, seen)
    # no control: all images may shift together, and only priors say by how much
    loose = dataclasses.replace(points, role=("tie",) * 24, X=np.full_like(points.X, np.nan))
    shifts = [0, 3, 6, 9, 12, 15, 18, 21]
    for sigma, low, high in ((np.inf, 30.0, np.inf), (6.0, 2.0, 6.0)):
        found = refine(with_priors(images, prior_of_bias(1, sigma, 0.8)), loose, observations)
        told = [w for w in found.warnings if "determine the" in w]
        assert "sample shift of image R" in told[0] and "line shift of image R" in told[1]
        assert all("only priors, if any, separate them" in w for w in told)
        assert (low < found.inspection.sigma[shifts]).all()
        assert (found.inspection.sigma[shifts] < high).all()


def terrain_of(scene, cover=1.0):
    """A plane terrain model of 50 × 50 heights over the points, or over a part of these, and the
    points on it."""
    place = np.stack([np.asarray(v) for v in geodetic(WGS84, tuple(scene.X.T))[:2]], 1)
    low, high = place.min(0), place.max(0)
    margin = 0.1 * (high - low)
    low, high = low - margin, low - margin + cover * (high - low + 2 * margin)
    step = (high - low) / 49
    heights = 100.0 + 300.0 * np.linspace(0, 1, 50)[:, None] + 200.0 * np.linspace(0, 1, 50)
    terrain = make_terrain(heights, low, step)
    x, y = ((place - low) / step).T
    on = 100.0 + 300.0 * y / 49 + 200.0 * x / 49
    return terrain, np.stack(earth_fixed(WGS84, (*place.T, on)), 1)


@pytest.mark.further
def test_terrain_heights_are_observations(scene):
    terrain, X = terrain_of(scene)
    ground = tuple(np.asarray(v) for v in geodetic(WGS84, tuple(X.T)))
    places = np.stack([np.stack(project_points(one.image.rpc, *ground)[:2], 1)
                       for one in scene.images])  # fmt: skip
    on_terrain = dataclasses.replace(scene, X=X, places=places)
    (images, points, observations), bias = on_terrain.draw(np.random.default_rng(4))
    without = refine(images, points, observations)
    model = HeightModel(terrain, 0.5, "dem.tif")
    found = refine(images, points, observations, terrain=model)
    heights, ties = found.terrain_heights(), scene.roles.count("tie")
    assert len(heights) == ties == found.counts()["terrain heights"]
    assert found.redundancy == without.redundancy + ties
    on_plane = found.inspection.declared.levelled
    up = lambda result: result.inspection.point_sigma[on_plane, 2].mean() / result.sigma0
    assert up(found) < 0.5 < up(without)
    assert (np.abs(found.estimate - bias.ravel()) < 3.5 * found.inspection.sigma).all()
    assert conclude_refinement(found).findings[1][:2] == ("Terrain", "met")
    assert not any("dem.tif does not fit" in w for w in found.warnings)
    # another surface, 50 m, ten σ, higher and lower by turns: more than images take up
    hilly = np.asarray(terrain.heights) + 50.0 * np.where(np.arange(50) // 5 % 2, 1, -1)
    wrong = dataclasses.replace(terrain, heights=jnp.asarray(hilly))
    unfit = refine(images, points, observations, terrain=HeightModel(wrong, 5.0, "dem.tif"))
    assert any(w.startswith(f"dem.tif does not fit: residuals of {ties} heights") for w in
               unfit.warnings)  # fmt: skip
    verdict = conclude_refinement(unfit)
    assert verdict.findings[1][:2] == ("Terrain", "not met")
    assert "heights of the terrain" in verdict.words
    report = unfit.report()
    assert "; the terrain model does not fit, the a priori σ" in report
    of_tests = report[report.index("Image points and terrain heights with the largest tests") :]
    assert "terrain (m)" in of_tests
    # a building: the terrain is 15 m too low at one point
    tie = int(np.flatnonzero(np.array(scene.roles) == "tie")[4])
    cells = np.asarray(terrain.heights).copy()
    column, row, _ = (float(v) for v in terrain.grid(jnp.asarray(X[tie])))
    cells[int(row) : int(row) + 2, int(column) : int(column) + 2] -= 15.0
    lower = dataclasses.replace(terrain, heights=jnp.asarray(cells))
    found = refine(images, points, observations, terrain=model._replace(terrain=lower),
                   snooping="baarda", significance=1e-4)  # fmt: skip
    assert f"terrain height of point P{tie}" in {blunder.name for blunder in found.removed}
    # half of the area
    part, _ = terrain_of(scene, cover=0.5)
    found = refine(images, points, observations, terrain=model._replace(terrain=part))
    told = next(w for w in found.warnings if w.startswith("dem.tif has no height at"))
    assert 0 < len(found.terrain_heights()) < ties and "P" in told
    away = dataclasses.replace(part, origin=(part.origin[0] + 0.1, part.origin[1]))
    with pytest.raises(InputError, match="dem.tif: none of the .* tie points"):
        refine(images, points, observations, terrain=model._replace(terrain=away))


def test_what_is_refused(case):
    (images, points, observations), _, _ = case
    swapped = dataclasses.replace(observations, xy=observations.xy[:, ::-1])
    with pytest.raises(InputError, match="line and pixel seem to be exchanged"):
        refine(images, points, swapped)
    outside = moved(observations, 3, [9000.0, 0.0])
    with pytest.raises(InputError, match="row 4: .* is off the image, which has 4000"):
        refine(images, points, outside)
    with pytest.raises(InputError, match=r"shape \[2, 2\]"):
        refine(with_priors(images, np.ones((2, 2))), points, observations)
    with pytest.raises(InputError, match="degree 3"):
        prior_of_bias(3)


def test_stated_errors_become_pixels(scene):
    """3 m on the ground are a pixel, and the view adds nothing to horizontal errors."""
    sigma = prior_of_errors(scene.images[0].image.rpc, 1, 6.0, 0.3)
    np.testing.assert_allclose(sigma, [[2.0, 0.1, 0.1]] * 2, rtol=0.02)


@pytest.mark.further
def test_together_with_rigorous_images_and_photographs():
    """Twelve images with RPC, six line scanners, twenty photographs: the truth, σ of a few draws
    (of 200: benchmarks/rpc_block.py), blunders, an undetermined bias."""
    scene, rng = block(photographs=20), np.random.default_rng(3)
    largest, squares = [], []
    for _ in range(3):
        arguments, bias = scene.draw(rng)
        frames, to_truth, distance = scene.draw_photographs(rng)
        result = refine(*arguments, frames)
        truth = {
            "image R": bias, "image S": scene.attitudes, "photograph ": to_truth,
            "camera ": np.array([distance]),
        }  # fmt: skip
        error = np.array(result.estimate)
        for owner, values in truth.items():
            error[[k for k, n in enumerate(result.names) if n.owner.startswith(owner)]] -= (
                values.ravel()
            )
        C = result.covariance / result.sigma0**2
        scale = np.sqrt(np.diagonal(C))
        normed = error / scale
        largest.append(np.abs(normed).max())
        # the errors of one draw have much in common: by their whole covariance, χ² with 211
        squares.append(normed @ np.linalg.solve(C / np.outer(scale, scale), normed))
    # 633 in all: their mean square has a σ of √(2/633) = 0.056; one of 4.5 σ is 0.4 % likely
    assert len(error) == 211 and max(largest) < 4.5
    assert abs(np.sum(squares) / 633 - 1) < 0.2
    assert result.global_test()["passed"]
    assert min(result.rays()) >= 3
    # rigorous images first, and everything by id
    assert [one.id for one in result.images][:6] == [f"S{k}" for k in range(6)]
    assert type(result.image("R3")) is not type(result.image("S3"))
    # a blunder in a control point, and in a tie point of an image of each type
    images, points, observations = arguments
    ties = np.array([role == "tie" for role in scene.roles])[observations.point]
    of_rpc = observations.image < 12
    rpc, rigorous = (int(np.flatnonzero(ties & which)[5]) for which in (of_rpc, ~of_rpc))
    X = points.X.copy()
    X[2] += 15.0 * points.axes[2, 0]
    wrong = moved(moved(observations, rpc, [6.0, 0.0]), rigorous, [0.0, -5.0])
    found = refine(images, dataclasses.replace(points, X=X), wrong, frames, snooping="pope")
    named = [blunder.name for blunder in found.removed]
    told = [f"point P{observations.point[k]} in image {images[observations.image[k]].id}"
            for k in (rpc, rigorous)]  # fmt: skip
    assert set(named) == {"east of control point P2", *told}
    # an image that nothing is measured in
    free = [dataclasses.replace(one, bias_sigma=prior_of_bias(1)) if one.id == "R7" else one
            for one in images]  # fmt: skip
    with pytest.raises(NotSolvedError, match="do not determine the .* of image R7"):
        refine(free, points, observations.take(observations.image != 7), frames)


@pytest.mark.further
def test_together_with_a_photograph():
    """Images with RPC, line scanners and a photograph that share their points."""
    scene = block(rpc=4, scanner=2, points=40, control=6, checks=0, rays=3)
    arguments, bias = scene.draw(np.random.default_rng(3))
    frames = photograph(scene.X, np.random.default_rng(1))
    frames = dataclasses.replace(frames, distances=Distances.none())
    result = refine(*arguments, frames)
    of_rpc = [k for k, n in enumerate(result.names) if n.owner.startswith("image R")]
    error = (result.estimate[of_rpc] - bias.ravel()) / result.inspection.sigma[of_rpc]
    assert np.abs(error).max() < 3 and result.global_test()["passed"]
    assert result.inputs.ids[-1] == "F" and min(result.rays()) >= 4


def test_what_leaves_its_prior_is_named(case):
    """Biases of the stated size are within their priors; priors of a hundredth of it are left."""
    (images, *others), _, result = case
    assert not any("beyond their priors" in line for line in result.warnings)
    tight = [dataclasses.replace(one, bias_sigma=one.bias_sigma / 100) for one in images]
    (said,) = [w for w in refine(tight, *others).warnings if "beyond their priors" in w]
    assert "check heights" in said
