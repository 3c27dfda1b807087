"""Inputs of surfaces: folders of photographs with masks, COLMAP models, the σ of orientations,
colours, large rasters by blocks."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import rasterio
from surface_scenes import CAMERA, SIZE, F

from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.io.networks.orientation_covariance import (
    OrientationCovariance,
    read_orientation_covariance,
    write_orientation_covariance,
)
from jaxbundle.network.tables import EXTERIOR
from jaxbundle.surfaces import scanner_inputs
from jaxbundle.surfaces.correlation import make_pyramid
from jaxbundle.surfaces.inputs import find_photographs, read_views
from jaxbundle.surfaces.intersection import intersect
from jaxbundle.surfaces.matching import _drop_worst_rays, _Rays
from jaxbundle.surfaces.orientation import (
    is_uncertain,
    orientation_covariance,
)
from jaxbundle.surfaces.views import FrameView

ANGLES = np.array([[0.02, -0.1, 0.3], [-0.05, 0.12, 0.1], [0.1, 0.05, -0.2]])
CENTRES = np.array([[-1.0, 0, 10], [1.0, 0.2, 10], [0.1, 1.5, 9.5]])
SIGMA = np.array([0.02, 0.01, 0.03, 1e-3, 2e-3, 5e-4])


def views(sigma, angles=ANGLES, centres=CENTRES, camera=CAMERA, joint=None):
    blank = np.zeros(SIZE[::-1], np.uint8)
    return [
        FrameView(str(k), blank, camera, X0, np.asarray(matrix_from_omega_phi_kappa(a)), s,
                  joint=joint)
        for k, (X0, a, s) in enumerate(zip(centres, angles, sigma))
    ]  # fmt: skip


def test_uncertain_orientations_move_points_as_their_covariance_says():
    """Intersections again with every orientation moved by its σ, one parameter at a time."""
    sigma = [SIGMA, np.zeros(6), 2 * SIGMA]
    X = np.array([[0.3, 0.2, 0.1], [-0.5, 0.6, 1.0]])
    given = views(sigma)
    assert [is_uncertain(v) for v in given] == [True, False, True]
    uv = np.stack([v.project(X) for v in given], 1)
    used = np.array([[True, True, True], [True, True, False]])
    unit = np.broadcast_to(np.eye(2), (2, 3, 2, 2))
    expected = np.zeros((2, 3, 3))
    for k, s in enumerate(sigma):
        for j in np.flatnonzero(s):
            angles, centres = ANGLES.copy(), CENTRES.copy()
            (centres if j < 3 else angles)[k, j % 3] += 0.01 * s[j]
            moved = intersect(views(sigma, angles, centres), uv, unit, used, X).X
            d = (moved - X) / 0.01
            expected += d[:, :, None] * d[:, None]
    found = orientation_covariance(given, X, used)
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=1e-9)
    assert not orientation_covariance(views([None] * 3), X, used).any()


def test_a_point_without_its_worst_ray_keeps_the_weights_of_the_others():
    """As if only the others had been intersected, each with its own covariance."""
    X = np.array([[0.3, 0.2, 0.1], [-0.5, 0.6, 1.0]])
    given, rng = tuple(views([None] * 3)), np.random.default_rng(2)
    uv = np.stack([v.project(X) for v in given], 1) + rng.normal(size=(2, 3, 2))
    uv[1, 2] += 20.0
    covariance = rng.uniform(0.5, 3.0, (2, 3, 1, 1)) * np.eye(2)
    table = _Rays(given, uv, covariance, np.ones((2, 3), bool))
    first = table.intersect(X)
    changed, found = _drop_worst_rays(table, first, np.array([False, True]))
    assert changed.is_used.tolist() == [[True] * 3, [True, True, False]]
    again = intersect(given, uv, covariance, changed.is_used, first.X)
    for name in ("X", "covariance", "rays", "vtpv"):
        expected = [getattr(first, name)[0], getattr(again, name)[1]]
        np.testing.assert_allclose(getattr(found, name), expected, rtol=1e-9)


def test_one_input_is_an_image_by_its_name_or_a_project(tmp_path):
    """Of an image alone, `surface` says that it needs another; a folder holds photographs."""
    for name in ("a.tif", "a.TIF", "a_RPC.TXT", "a.RPB", "a.json"):
        assert scanner_inputs.is_ground_image(Path(name)), name
    for name in ("project", "images.csv", "project.toml"):
        assert not scanner_inputs.is_ground_image(Path(name)), name
    (tmp_path / "A.TOML").write_text("[scanner]\n")
    assert scanner_inputs.is_ground_image(tmp_path / "A.TOML")


@pytest.mark.parametrize("name, kind", [
    ("a.tif", "rpc"), ("a.RPB", "rpc"), ("a_RPC.TXT", "rpc"), ("rpc.xml", "rpc"),
    ("attitude.XML", "scanner"), ("a.toml", "scanner"), ("A.TOML", "scanner"),
    ("a.json", "scanner"), ("a.dim", "scanner"), ("a.IMD", "scanner"),
])  # fmt: skip
def test_a_file_is_read_as_what_its_name_says_or_its_content(tmp_path, monkeypatch, name, kind):
    """XML is of polynomials or of a scanner: the first, if it can be read as such."""
    path, raster = tmp_path / name, tmp_path / "a.tif"
    path.write_bytes(b"")

    def read_rpc(given):
        if given.name == "attitude.XML":
            raise InputError("no coefficients")
        return "rpc"

    scanner = SimpleNamespace(image="image", earth="earth")
    monkeypatch.setattr(scanner_inputs, "read_rpc", read_rpc)
    monkeypatch.setattr(scanner_inputs, "find_coefficients", lambda given: given)
    monkeypatch.setattr(scanner_inputs, "read_scanner", lambda _: scanner)
    monkeypatch.setattr(scanner_inputs, "find_raster", lambda *_: raster)
    expected = "rpc" if kind == "rpc" else ("image", "earth")
    assert scanner_inputs._orientation(path, None) == (expected, raster)


def test_a_joint_covariance_of_orientations_and_camera_moves_points_as_it_says(tmp_path):
    """Every unknown moved on its own, and their covariance over these directions: D·C·Dᵀ; from the
    file as it was written, in degrees."""
    unknowns = tuple(("image", id, name) for id in ("0", "2") for name in EXTERIOR)
    unknowns += (("camera", CAMERA.id, "fx"),)
    rng, sigma = np.random.default_rng(1), np.concatenate([SIGMA, 2 * SIGMA, [1.5]])
    L = rng.normal(size=(13, 13))
    R = L @ L.T
    matrix = R / np.sqrt(np.outer(R.diagonal(), R.diagonal())) * np.outer(sigma, sigma)
    file = tmp_path / "precision.csv"
    write_orientation_covariance(OrientationCovariance(unknowns, matrix), file, np.pi / 180)
    joint = read_orientation_covariance(file, np.pi / 180)
    np.testing.assert_allclose(joint.matrix, matrix, rtol=1e-13)
    X = np.array([[0.3, 0.2, 0.1], [-0.5, 0.6, 1.0]])
    given = views([None] * 3, joint=joint)
    assert [is_uncertain(v) for v in given] == [True, True, True]  # the camera is that of all
    uv = np.stack([v.project(X) for v in given], 1)
    used, unit = np.ones((2, 3), bool), np.broadcast_to(np.eye(2), (2, 3, 2, 2))
    D = np.zeros((2, 3, 13))
    for j, (kind, id, name) in enumerate(unknowns):
        angles, centres, camera, step = ANGLES.copy(), CENTRES.copy(), CAMERA, 0.01 * sigma[j]
        if kind == "camera":
            moved = {**CAMERA.parameters, name: CAMERA.parameters[name] + step}
            camera = dataclasses.replace(CAMERA, parameters=moved)
        else:
            i = EXTERIOR.index(name)
            (centres if i < 3 else angles)[int(id), i % 3] += step
        at = intersect(views([None] * 3, angles, centres, camera), uv, unit, used, X).X
        D[:, :, j] = (at - X) / step
    found = orientation_covariance(given, X, used)
    np.testing.assert_allclose(found, D @ matrix @ np.swapaxes(D, 1, 2), rtol=0.03, atol=1e-7)
    text = file.read_text().replace("image,2,X0", "image,2,X0,", 1)
    file.write_text(text)
    with pytest.raises(InputError, match="cells where the header has"):
        read_orientation_covariance(file, 1.0)


def test_the_derivative_by_the_orientation_is_that_of_the_projection():
    X = np.array([[0.3, 0.2, 0.1]])
    B = views([SIGMA] * 3)[0].derivative_by_orientation(X)[0]
    for j in range(6):
        both = []
        for sign in (1, -1):
            angles, centres = ANGLES.copy(), CENTRES.copy()
            (centres if j < 3 else angles)[0, j % 3] += sign * 1e-5
            both.append(views([None] * 3, angles, centres)[0].project(X)[0])
        np.testing.assert_allclose(B[:, j], (both[0] - both[1]) / 2e-5, rtol=1e-5, atol=1e-4)


def test_photographs_are_found_beside_masks_and_depths(tmp_path):
    for name in ("im0.png", "im0.pfm", "masks/im0.png", "left/a.JPG", "left/a.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    found = find_photographs(["im0", "a", "im0.png"], tmp_path)
    assert [p.relative_to(tmp_path).as_posix() for p in found] == ["im0.png", "left/a.JPG",
                                                                   "im0.png"]  # fmt: skip
    # a file of another kind, too, if there is no image: its reader says what can be read
    (tmp_path / "left/b.sketch").write_bytes(b"")
    assert find_photographs(["b"], tmp_path) == [tmp_path / "left/b.sketch"]
    (tmp_path / "im0.jpg").write_bytes(b"")
    with pytest.raises(InputError, match=r"im0: there are .*im0\.jpg, .*im0\.png"):
        find_photographs(["im0"], tmp_path)


def test_a_colmap_folder_gives_oriented_photographs_in_colour(tmp_path):
    """R_cv = diag(1, −1, −1)·M, t = −R_cv·X0; pixels counted from the corner."""
    photos = tmp_path / "images"
    photos.mkdir()
    colour = np.random.default_rng(0).integers(0, 256, (*SIZE[::-1], 3), np.uint8)
    (tmp_path / "cameras.txt").write_text(f"1 PINHOLE {SIZE[0]} {SIZE[1]} {F} {F} 128 96\n")
    (tmp_path / "points3D.txt").write_text("")
    # M = 1: half a turn about x, as a quaternion (w, x, y, z)
    rows = [f"{k + 1} 0 1 0 0 {-x} {y} {z} 1 {k}.png\n\n" for k, (x, y, z) in enumerate(CENTRES)]
    (tmp_path / "images.txt").write_text("".join(rows))
    for k in range(3):
        cv2.imwrite(str(photos / f"{k}.png"), colour)
    found, network, said = read_views(tmp_path, photos)
    assert not said and not network.points.id
    np.testing.assert_allclose([v.X0 for v in found], CENTRES, atol=1e-12)
    np.testing.assert_allclose([v.M for v in found], [np.eye(3)] * 3, atol=1e-12)
    np.testing.assert_allclose(found[1].project(CENTRES[1:2] - [0, 0, 5]), [[127.5, 95.5]])
    assert (found[0].colours()[..., ::-1] == colour).all() and found[0].grey.ndim == 2
    (tmp_path / "images.txt").write_text(rows[0])
    with pytest.raises(InputError, match="1 oriented images; a surface needs at least two"):
        read_views(tmp_path, photos)


def test_a_raster_is_read_by_blocks_and_keeps_its_bits(tmp_path):
    rng = np.random.default_rng(1)
    deep = rng.integers(0, 4000, (1, 70, 50), np.uint16)
    bands = rng.integers(0, 255, (3, 70, 50), np.uint8)
    for name, values in (("deep.tif", deep), ("colour.tif", bands)):
        with rasterio.open(tmp_path / name, "w", driver="GTiff", width=50, height=70, nodata=7,
                           count=len(values), dtype=values.dtype,
                           transform=rasterio.Affine.scale(2)) as raster:  # fmt: skip
            raster.write(values)
    found = scanner_inputs.read_grey(tmp_path / "deep.tif", pixels_at_once=50 * 9)
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found, np.where(deep[0] == 7, 0, deep[0]))
    grey = scanner_inputs.read_grey(tmp_path / "colour.tif", pixels_at_once=50 * 9)
    expected = np.tensordot([0.3, 0.59, 0.11], np.where(bands == 7, 0, bands), 1)
    np.testing.assert_allclose(grey, expected, rtol=1e-5)


def test_a_pyramid_is_sampled_alike_from_all_kinds_of_grey_values():
    deep = np.random.default_rng(2).integers(0, 4000, (61, 90), np.uint16)
    a, b = make_pyramid(deep, 2), make_pyramid(deep.astype(np.float32), 2)
    uv = np.stack(np.meshgrid(np.arange(30.0, 80), np.arange(20.0, 40)), -1) + 0.3
    for level in range(3):
        np.testing.assert_array_equal(a.sample(level, uv), b.sample(level, uv))
    means = deep[:60].reshape(30, 2, 45, 2).mean((1, 3))
    np.testing.assert_allclose(a.levels[1], means, rtol=1e-6)
    # bilinear at the full resolution; nothing outside
    part = 0.49 * deep[20, 30] + 0.21 * (deep[20, 31] + deep[21, 30].astype(float))
    assert a.sample(0, uv)[0, 0] == pytest.approx(part + 0.09 * deep[21, 31], rel=0.01)
    assert np.isnan(a.sample(0, uv + [60, 0])[0, -1])
