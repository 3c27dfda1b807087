"""Line scanner images by the face of all oriented images, and from files to a DSM."""

import json

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
import rasterio

from jaxbundle.io.scanner.writing import write_scanner_image
from jaxbundle.planning.rendering import Scene, Sensor, render_rays
from jaxbundle.planning.shapes import HeightField
from jaxbundle.planning.texture import Texture
from jaxbundle.pushbroom import Trajectory, attitude_table, make_image, position_table
from jaxbundle.pushbroom.scanner import FocalLine, LineTimes
from jaxbundle.surfaces.point_files import read_cloud
from jaxbundle.surfaces.scanner_views import ScannerView
from jaxbundle.surfaces.views import line_of_sight

LINES, PIXELS = 120, 100


def strip(pitch, behind=0.0):
    """Over a local frame, flown north 1000 m high with a restless attitude."""
    t = np.linspace(-2.0, 4.0, 25)
    P = np.stack([0 * t, 50 * t - behind, 1000 + 2 * np.sin(t)], 1)
    angles = np.stack([pitch + 1e-3 * np.sin(2 * t), 1e-3 * np.cos(t), 0 * t], 1)
    parameters = jnp.array([120.0, *np.zeros(10)])
    optics = FocalLine(parameters, jnp.float64(0.05), jnp.float64((PIXELS - 1) / 2),
                       jnp.float64(0.0))  # fmt: skip
    return make_image(
        Trajectory(position_table(t, P), attitude_table(t, angles, method="spline")),
        LineTimes(jnp.float64(0.0), jnp.float64(0.01)), optics, LINES, PIXELS,
    )  # fmt: skip


def view_of(image, grey=None):
    grey = np.zeros((LINES, PIXELS), np.float32) if grey is None else grey
    return ScannerView("strip", grey, image, None, None)


@pytest.fixture(scope="module")
def view():
    return view_of(strip(0.2))


@pytest.mark.further
def test_points_are_projected_where_they_came_from(view):
    uv = np.random.default_rng(0).uniform([2, 2], [PIXELS - 3, LINES - 3], (50, 2))
    h = np.linspace(-20, 40, 50)
    X = view.points(uv, h)
    np.testing.assert_allclose(view.parameter(X), h)
    np.testing.assert_allclose(view.project(X), uv, atol=1e-5)


@pytest.mark.further
def test_the_derivative_is_that_of_the_projection(view):
    uv = np.array([[30.0, 40], [70, 90]])
    X = view.points(uv, np.array([3.0, 8.0]))
    J = view.derivative(X)
    for k in range(3):
        step = 0.02 * np.eye(3)[k]
        slope = (view.project(X + step) - view.project(X - step)) / 0.04
        np.testing.assert_allclose(J[:, :, k], slope, atol=2e-4)
    along = view.points(uv, np.array([13.0, 18.0])) - X
    d = along / np.linalg.norm(along, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs(np.sum(d * line_of_sight(J), 1)), 1, atol=1e-9)


def ground(X, Y):
    return 4 * np.sin(X / 12) * np.cos(Y / 15)


def seen_by(image, scene, seed):
    """Grey values of a strip: every pixel's line of sight meets the ground."""
    v, u = np.indices((LINES + 1, PIXELS + 1)).reshape(2, -1)
    uv = np.stack([u, v], 1).astype(float)
    top, bottom = (view_of(image).points(uv, np.full(len(uv), h)) for h in (50.0, -50.0))
    d = (bottom - top) / np.linalg.norm(bottom - top, axis=1, keepdims=True)
    shape = LINES + 1, PIXELS + 1, 3
    return render_rays(scene, top.reshape(shape), d.reshape(shape), Sensor(noise=2, seed=seed)).grey


def write_strips(folder, names):
    """A strip looking ahead and one looking back, with their scanner files; returns the texture."""
    texture = Texture(0.25, seed=2, side=512)
    scene = Scene((HeightField(ground, (-120, -120, 120, 220)),), (texture,))
    for name, sign in zip(names, (1, -1)):
        image = strip(0.2 * sign, sign * 1000 * np.tan(0.2))
        write_scanner_image(folder, name, image, None)
        cv2.imwrite(str(folder / f"{name}.tif"), seen_by(image, scene, sign + 1))
    return texture


@pytest.mark.further
def test_scanner_files_become_a_cloud_a_dsm_and_an_orthophoto(tmp_path, command):
    texture = write_strips(tmp_path, ("ahead", "back"))
    out = tmp_path / "out"
    told = command(
        "surface", tmp_path / "ahead.toml", tmp_path / "back.toml", "--out", out, "--zmin", -9,
        "--zmax", 9, "--pairs", "ahead.tif,back.tif", "--dense", "--step", 2, "--dsm", 1.5,
        "--orthophoto-of", "back.tif", "--json", "-",
    )  # fmt: skip
    assert told.status == 0, told.err
    report = json.loads(told.out)
    assert report["system"] is None and report["sigma_includes"] == ["matching"]
    cloud = read_cloud(out / "cloud.csv")
    assert len(cloud) > 0.5 * LINES * PIXELS / 4
    w = (cloud.X[:, 2] - ground(cloud.X[:, 0], cloud.X[:, 1])) / cloud.sigma[:, 2]
    assert 0.6 < np.sqrt(np.mean(w[np.abs(w) < 5] ** 2)) < 1.3 and (np.abs(w) > 5).mean() < 0.02
    with rasterio.open(out / "orthophoto.tif") as raster, rasterio.open(out / "dsm.tif") as dsm:
        grey, height = raster.read(1), dsm.read(1)
        assert raster.transform == dsm.transform and raster.nodata == 0 and raster.crs is None
        rows, columns = np.nonzero((grey > 0) & (height > -100))
        x, y = raster.xy(rows, columns)
    assert len(x) > 0.5 * (height > -100).sum()
    true = texture(np.array(x), np.array(y), np.full(len(x), 1.5))
    assert np.corrcoef(grey[rows, columns], true)[0, 1] > 0.8
