"""Two strips flown in opposite directions with one scanner, in a local frame: shared unknowns are
estimated once."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxbundle.errors import InputError
from jaxbundle.network.tables import Observations
from jaxbundle.pushbroom.ancillary import attitude_table, position_table
from jaxbundle.pushbroom.ground_to_image import make_search, project_points
from jaxbundle.pushbroom.image import make_image
from jaxbundle.pushbroom.scanner import FocalLine, LineTimes
from jaxbundle.pushbroom.trajectory import Trajectory
from jaxbundle.refinement import FREE, Freedom, ScannerImage, local_points, refine, report

LINES, PIXELS, SIGMA = 600, 400, 0.2
MOUNTING, FOCAL = np.array([2e-3, -1.5e-3, 3e-3]), 5e-4
FREEDOM = Freedom(mounting=FREE, focal_length=1e-2, attitude=3 * (2e-5,), position=3 * (0.02,))


def strip(yaw, east, mounting=0.0, focal=0.0):
    """A line scanner 1000 m up that flies 300 m north (yaw 0) or south (yaw π)."""
    t = np.array([-1.0, 7.0])
    north = np.cos(yaw) * 50.0 * (t - 3)
    P = np.stack([0 * t + east, north, 0 * t + 1000.0], 1)
    optics = FocalLine(jnp.array([120.0 * (1 + focal)] + 10 * [0.0]), jnp.float64(0.09),
                       jnp.float64((PIXELS - 1) / 2), jnp.float64(0.0))  # fmt: skip
    return make_image(
        Trajectory(
            position_table(t, P, method="linear", gap=9.0),
            attitude_table(t, np.tile([0.0, 0.0, yaw], (2, 1)), method="linear", gap=9.0),
        ),
        LineTimes(jnp.float64(0.0), jnp.float64(0.01)), optics, LINES, PIXELS,
        mounting=mounting + np.zeros(3),
    )  # fmt: skip


@pytest.fixture(scope="module")
def strips():
    rng = np.random.default_rng(6)
    n = 30
    X = np.stack([rng.uniform(-70, 70, n), rng.uniform(-110, 110, n), rng.uniform(0, 60, n)], 1)
    image, point, xy = [], [], []
    for i, (yaw, east) in enumerate(((0.0, -40.0), (np.pi, 40.0))):
        true = strip(yaw, east, MOUNTING, FOCAL)
        found = project_points(true, make_search(true, None), jnp.asarray(X.T))
        seen = np.asarray(found.count) == 1
        point += np.flatnonzero(seen).tolist()
        image += [i] * int(seen.sum())
        xy.append(np.stack([found.line[0], found.pixel[0]], 1)[seen])
    xy = np.concatenate(xy)
    observations = Observations(np.array(image), np.array(point), xy + SIGMA * rng.normal(
        size=xy.shape), np.full(xy.shape, SIGMA))  # fmt: skip
    points = local_points(
        [f"P{k}" for k in range(n)], ["control" if k < 8 else "tie" for k in range(n)],
        np.where(np.arange(n)[:, None] < 8, X, np.nan),
        np.where(np.arange(n)[:, None] < 8, 0.02, 0.0),
    )  # fmt: skip
    images = [ScannerImage("north", strip(0.0, -40.0), None, FREEDOM, "imager"),
              ScannerImage("south", strip(np.pi, 40.0), None, FREEDOM, "imager")]  # fmt: skip
    return images, points, observations, X


@pytest.fixture(scope="module")
def found(strips):
    """With a wrong coordinate of a control point, which data snooping removes."""
    images, points, observations, X = strips
    wrong = points.X.copy()
    wrong[2, 1] += 3.0
    return refine(
        images, dataclasses.replace(points, X=wrong), observations, snooping="baarda"
    )


@pytest.mark.further
def test_mounting_and_focal_length_of_both_strips_are_one(strips, found):
    X = strips[-1]
    names = [str(name) for name in found.names]
    assert names.count("mounting pitch of sensor imager") == 1
    assert names.count("pitch bias of image north") == names.count("pitch bias of image south") == 1
    sensor = [k for k, name in enumerate(found.names) if name.owner == "sensor imager"]
    truth = dict(zip(("mounting pitch", "mounting roll", "mounting yaw"), MOUNTING))
    truth["focal length (relative)"] = FOCAL
    for k in sensor:
        error = found.estimate[k] - truth[found.names[k].parameter]
        assert abs(error) < 3.5 * found.inspection.sigma[k]
        assert found.inspection.sigma[k] < 2e-3
    assert 0.7 < found.sigma0 < 1.3
    # tie points had no coordinates: they began where their rays met
    chosen = found.inspection.declared.rays.points
    error = (found.positions - X[chosen]) / found.inspection.point_sigma
    assert 0.7 < np.sqrt(np.mean(error**2)) < 1.4


@pytest.mark.further
def test_control_coordinates_with_sigma_are_tested_too(strips, found):
    X = strips[-1]
    removed = [(b.kind, b.row) for b in found.removed]
    assert removed == [("control", 3 * 2 + 1)]
    at = int(np.flatnonzero(found.inspection.declared.rays.points == 2)[0])
    assert abs(found.positions[at, 1] - X[2, 1]) < 1.0
    assert "Y of control point P2" in report(found)


@pytest.mark.further
def test_a_tie_point_seen_from_one_place_is_refused(strips):
    images, points, observations, X = strips
    both = [images[0], dataclasses.replace(images[0], id="again")]
    rows = observations.image == 0
    first = observations.take(rows)
    twice = Observations(
        np.r_[first.image, first.image + 1], np.r_[first.point, first.point],
        np.concatenate([first.xy, first.xy]), np.concatenate([first.sigma, first.sigma]),
    )  # fmt: skip
    with pytest.raises(InputError, match="row 9: the rays of tie point 'P8' do not meet"):
        refine(both, points, twice)
