"""σ of a batch under errors that views share, against those of the engine."""

import dataclasses

import numpy as np
import pytest

import jaxbundle
from jaxbundle.adjustment.quality.correlated_errors import DEFAULTS
from jaxbundle.batches.error_sizes import batch_errors
from jaxbundle.leastsquares.quality.size_traces import with_traces
from jaxbundle.planning.stations import stations_looking_at

VIEWS, NOISE = 9, 0.2
CAMERA = jaxbundle.Camera(
    "cam", "opencv", {"fx": 1500.0, "fy": 1500.0, "cx": 999.5, "cy": 749.5, "k1": -0.05},
    free=("fx", "fy", "cx", "cy", "k1"), image_size=(2000, 1500),
)  # fmt: skip


@pytest.fixture(scope="module")
def network():
    """Views of a board of known points with an affine distortion in each."""
    rng = np.random.default_rng(3)
    u, v = np.meshgrid(np.arange(10) - 4.5, np.arange(7) - 3.0)
    board = 0.03 * np.stack([u.ravel(), v.ravel(), 0 * u.ravel()], 1)
    tilt, azimuth = np.radians(rng.uniform(15, 45, VIEWS)), rng.uniform(0, 2 * np.pi, VIEWS)
    X0 = rng.uniform(0.5, 0.8, VIEWS)[:, None] * np.stack(
        [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)], 1
    )
    placed = stations_looking_at(X0, np.zeros((VIEWS, 3)), roll=np.pi / 2 * (np.arange(VIEWS) % 4))
    exact = jaxbundle.simulate(placed, board, CAMERA, noise=NOISE, seed=4)
    points = dataclasses.replace(exact.points, position=board, role=("fixed",) * len(board))
    rays, a = exact.observations, 0.3 * rng.normal(size=VIEWS)
    x, y = ((rays.xy - rays.xy.mean(0)) / 900).T
    xy = rays.xy + a[rays.image, None] * np.stack([x, -y], 1)
    rays = dataclasses.replace(rays, xy=xy, sigma=np.ones_like(rays.sigma))
    # the domain of a batch
    return exact.replace(
        points=points, observations=rays, datum="control", residuals="measured"
    )


def of_batch(network, **options):
    rays = network.observations
    xy = np.full((1, VIEWS, len(network.points), 2), np.nan)
    xy[0, rays.image, rays.point] = rays.xy
    return jaxbundle.calibrate_batch(
        network.points.position, xy, CAMERA.image_size, free=CAMERA.free, **options
    )


@pytest.mark.further
def test_sizes_and_sigma_are_those_of_an_adjustment(network):
    result = jaxbundle.adjust(network, correlated=True)
    found = of_batch(network, correlated="camera")
    assert found.converged.all()
    named = {size.name: size.size for size in result.error_model.sizes}
    sizes = dict(zip(named, found.component_sizes[0]))
    assert len(named) == found.component_sizes.shape[1]
    for name, size in named.items():
        # errors along tracks are from random combinations in both
        assert sizes[name] == pytest.approx(size, rel=0.1, abs=0.02), name
    correlated = np.sqrt(np.diag(result.camera_covariance("cam")[1]))
    np.testing.assert_allclose(found.sigma[0], [result.cameras["cam"]["parameters"][n]["sigma"]
                                                for n in CAMERA.free], rtol=1e-3)  # fmt: skip
    np.testing.assert_allclose(found.sigma_correlated[0], correlated, rtol=0.1)
    stations = np.sqrt(np.diagonal(result.image_covariance, axis1=1, axis2=2))
    np.testing.assert_allclose(found.sigma_position_correlated[0], stations[:, :3], rtol=0.1)
    np.testing.assert_allclose(found.sigma_angles_correlated[0], stations[:, 3:], rtol=0.1)
    assert found.sigma_ratio > 1.2 and "under correlated errors" in str(found)
    row = found.row(0)
    assert row["parameters"]["fx"]["sigma_correlated"] == found.sigma_correlated[0, 0]
    assert {c["name"] for c in row["error_components"]} >= {"affine by view"}
    assert len(found.table()["sigma_fx_correlated"]) == 1


def test_traces_are_those_of_an_adjustment(network, monkeypatch):
    """The engine has the columns of all components, also of given points and along tracks."""
    result, seen = jaxbundle.adjust(network, correlated=True), []

    def watched(sums, *arguments):
        seen.append(sums)
        return batch_errors(sums, *arguments)

    monkeypatch.setattr(jaxbundle.batches.calibrate, "batch_errors", watched)
    of_batch(network, correlated="camera")
    T, equations = seen[0].traces.T[0], result.error_model.equations
    cubes = with_traces(seen[0].traces.cubes[0], T)
    # 16 random combinations of the columns of the last three, right to √(2/(16·r)) of matrices of
    # the effective rank r, of which smooth errors across a board have ten; rest: exact to single
    # precision
    few = np.ix_(range(5), range(5))
    np.testing.assert_allclose(T[few], equations.T[few], rtol=1e-3)
    scale = np.sqrt(np.diag(T))
    np.testing.assert_allclose(T / scale / scale[:, None], equations.T / scale / scale[:, None],
                               atol=0.2)  # fmt: skip
    few = np.ix_(range(5), range(5), range(5))
    np.testing.assert_allclose(cubes[few], equations.cubes[few], rtol=3e-3)
    for k in range(8):
        assert cubes[k, k, k] == pytest.approx(equations.cubes[k, k, k], rel=0.5), k


def test_sizes_of_a_batch_are_those_of_all_cameras_together(network):
    """Of one camera they are its own; cameras of too few views take them over."""
    alone, together = (of_batch(network, correlated=how) for how in ("camera", "batch"))
    np.testing.assert_allclose(together.sigma_correlated, alone.sigma_correlated, rtol=0.05)
    rays = network.observations
    xy = np.full((3, VIEWS, len(network.points), 2), np.nan)
    xy[:, rays.image, rays.point] = rays.xy
    xy[1, DEFAULTS.min_images - 2 :] = np.nan
    both = jaxbundle.calibrate_batch(
        network.points.position, xy, CAMERA.image_size, free=CAMERA.free, correlated="batch"
    )
    np.testing.assert_allclose(both.component_sizes[1, 1:], both.component_sizes[0, 1:])
    assert (both.sigma_correlated[1] > both.sigma_correlated[0]).all()
    by_camera = jaxbundle.calibrate_batch(
        network.points.position, xy, CAMERA.image_size, free=CAMERA.free, correlated="camera"
    )
    assert np.isnan(by_camera.component_sizes[1, 1:5]).all()
    assert np.isfinite(by_camera.sigma_correlated).all()
    plain = of_batch(network)
    assert plain.sigma_correlated is None and np.isnan(plain.sigma_ratio)
