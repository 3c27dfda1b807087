"""Rendered photographs of a scene and some that do not belong to it, reconstructed."""

import dataclasses
import json

import cv2
import numpy as np
import pyproj
import pytest
from PIL import Image
from rendered_photographs import CAMERA, SIZE, F, corner, write_photographs

import jaxbundle
from jaxbundle.cli.gis_output import write_gis
from jaxbundle.errors import InputError
from jaxbundle.io.cameras.result_json import read_calibrated
from jaxbundle.io.results.result_json import result_text
from jaxbundle.orientation.alignment import similarity
from jaxbundle.reconstruction.parts import group_connected
from jaxbundle.reconstruction.photographs import assign_cameras, find_photographs
from jaxbundle.reconstruction.reconstruct import reconstruct
from jaxbundle.reconstruction.settings import ReconstructionSettings
from jaxbundle.tiepoints.features import FeatureSettings
from jaxbundle.tiepoints.verification import Pair

BAR = 0.001
"""σ of scale bars."""
SETTINGS = ReconstructionSettings(FeatureSettings(number=1500), points=250)


@pytest.fixture(scope="module")
def made(tmp_path_factory, memory_at_hand):
    """Truth, and what was made of six photographs with scale bars between coded targets, one of
    another scene, one cut short, one that is there twice, one without texture, a blurred copy of
    one and a reduced one of another; and the folder of matches."""
    folder = tmp_path_factory.mktemp("photographs")
    truth = write_photographs(folder, "a", 6, 1, markers=True)
    write_photographs(folder / "other", "c", 1, 11)
    (folder / "c0.png").write_bytes((folder / "other" / "c0.png").read_bytes())
    (folder / "cut.png").write_bytes((folder / "a1.png").read_bytes()[:20_000])
    (folder / "again.png").write_bytes((folder / "a2.png").read_bytes())
    cv2.imwrite(str(folder / "dull.png"), np.full(SIZE[::-1], 120, np.uint8))
    read = lambda name: cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(folder / "blurred.png"), cv2.GaussianBlur(read("a4.png"), (0, 0), 1.5))
    cv2.imwrite(str(folder / "reduced.jpg"), cv2.resize(read("a3.png"), None, fx=0.8, fy=0.8))
    stages, store = {}, folder / "kept"
    bars = [((0, 1), (3, 3)), ((1, 2), (2, 4))]
    length = lambda a, b: np.linalg.norm(corner(*a) - corner(*b))
    name = lambda of: f"{of[0]}-{of[1]}"
    distances = [{"from": name(a), "to": name(b), "value": length(a, b), "sigma": BAR}
                 for a, b in bars]  # fmt: skip
    found = reconstruct(
        [folder], settings=dataclasses.replace(SETTINGS, targets="aruco"), store=store,
        progress=lambda stage, done, total: stages.update({stage: (done, total)}),
        distances=distances,
    )  # fmt: skip
    return truth, found, stages, store


def test_all_photographs_of_a_scene_are_placed_and_foreign_ones_left_out(made):
    truth, found, _, _ = made
    (part,) = found.parts
    same_file = {"a2.png", "again.png"}
    assert set(part.adjustment.network.images.id) - same_file == set(truth) - same_file
    why = found.left_out
    copies = {"blurred.png": "a4.png", "reduced.jpg": "a3.png"}
    assert set(why) - same_file == {"c0.png", "cut.png", "dull.png", *copies}
    assert all(f"shows the same as {of}" in why[name] for name, of in copies.items())
    assert "truncated" in why["cut.png"] and "no texture" in why["dull.png"]
    assert "the same file as" in why.get("again.png", why.get("a2.png"))


def test_centres_and_principal_distance_are_within_their_sigma(made):
    truth, found, _, _ = made
    result = found.parts[0].adjustment
    assert result.converged
    ids = [id for id in result.network.images.id if id in truth]
    rows = [result.network.images.id.index(id) for id in ids]
    X = np.array([truth[id] for id in ids])
    X0 = result.image_values[rows, :3]
    A, t = similarity(X0, X)
    e = X0 @ A.T + t - X
    C = np.einsum("ij,njk,lk->nil", A, result.image_covariance[rows, :3, :3], A)
    sigma = np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    assert np.all(np.abs(e) < 3 * sigma)
    assert np.linalg.norm(e, axis=1).max() < 0.004
    c = result.cameras[result.network.cameras[0].id]["parameters"]["fx"]
    assert abs(c["value"] - F) < 3 * c["sigma"] < 1.0


def test_scale_bars_between_coded_targets_give_the_scale(made):
    truth, found, _, _ = made
    result = found.parts[0].adjustment
    rows = [k for k, id in enumerate(result.network.images.id) if id in truth]
    X = np.array([truth[result.network.images.id[k]] for k in rows])
    A, _ = similarity(result.image_values[rows, :3], X)
    # bars of 2.3 m, corners to a tenth of a pixel, which is 1.6 mm
    assert abs(np.cbrt(np.linalg.det(A)) - 1) < 3 * np.hypot(BAR, 0.0016) / 2.3
    assert len(result.network.distances) == 2
    assert any("coded targets (aruco)" in note for note in found.notes)


def test_weights_are_those_of_the_residuals(made):
    part = made[1].parts[0]
    assert abs(part.adjustment.sigma0 - 1) < 0.02
    # estimated from the residuals, they are not confirmed by them
    assert part.adjustment.global_test()["passed"] is None
    assert "confirmed" not in part.adjustment.report()
    assert set(part.adjustment.sigma_factors) == {f"image points {kind}" for kind in part.factors}
    assert 0.3 < part.factors["matched in the original"] < 1.6
    assert len(part.adjustment.removed) < 0.05 * len(part.adjustment.network.observations)


def test_the_camera_of_a_result_can_be_given_to_another(made, tmp_path):
    result = made[1].parts[0].adjustment
    file = tmp_path / "result.json"
    file.write_text("".join(result_text(result, True)))
    ((camera, (names, C)),) = read_calibrated(file)
    assert abs(camera.parameters["fy"] / camera.parameters["fx"] - 1) < 3 * SETTINGS.aspect_sigma
    x, y = (names.index(name) for name in ("fx", "fy"))
    sigma = np.sqrt(C[x, x] + C[y, y] - 2 * C[x, y]) / F
    assert 0.1 * SETTINGS.aspect_sigma < sigma < 1.1 * SETTINGS.aspect_sigma


def test_stages_end_and_what_was_found_is_kept(made):
    _, _, stages, store = made
    assert {"features", "matching", "verification", "start values"} <= set(stages)
    assert all(done == total for stage, (done, total) in stages.items() if "data" not in stage)
    assert len(list(store.glob("*.npz"))) > 12 and not list(store.glob("*.part*"))


@pytest.mark.further
def test_the_principal_point_of_few_photographs_is_estimated(tmp_path):
    """Held at the centre of the photographs it would bias the principal distance by many σ."""
    write_photographs(tmp_path, "a", 3, 2)
    found = reconstruct([tmp_path], settings=SETTINGS).parts[0].adjustment
    parameters = found.cameras[found.network.cameras[0].id]["parameters"]
    for name, true in CAMERA.parameters.items():
        one = parameters[name]
        assert one["free"] or name == "fy"
        # the largest of eight, and windows contain edges of the roof
        assert abs(one["value"] - true) < 4 * one["sigma"], name
    centre = (SIZE[0] - 1) / 2
    assert abs(centre - CAMERA.parameters["cx"]) > 4 * parameters["cx"]["sigma"]


@pytest.mark.further
def test_two_scenes_by_the_positions_in_their_files(tmp_path):
    """Twenty metres for a unit of the rendered scenes, which lie a kilometre apart."""
    truth = {}
    for number, (prefix, photographs) in enumerate((("a", 4), ("b", 3))):
        of = write_photographs(tmp_path, prefix, photographs, 1 + 6 * number)
        truth |= {k: 20 * X + [600_000 + 1000 * number, 5_300_000, 200] for k, X in of.items()}
    to_degrees = pyproj.Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True)
    for name, (x, y, height) in truth.items():
        longitude, latitude = to_degrees.transform(x, y)
        head = Image.Exif()
        head[0x010F] = "Rendered"
        gps = head.get_ifd(0x8825)
        parts = lambda a: (float(int(a)), float(int(a % 1 * 60)), a * 60 % 1 * 60)
        gps[1], gps[2], gps[3], gps[4] = "N", parts(latitude), "E", parts(longitude)
        gps[5], gps[6] = b"\0", height
        with Image.open(tmp_path / name) as image:
            image.copy().save(tmp_path / name, exif=head)
    settings = dataclasses.replace(SETTINGS, pairs="place", points=120)
    found = reconstruct([tmp_path], settings=settings)
    assert any("EPSG:32633" in note for note in found.notes) and not found.left_out
    assert [part.name for part in found.parts] == ["part 1", "part 2"]
    for part, prefix in zip(found.parts, "ab"):
        ids = part.adjustment.network.images.id
        assert set(ids) == {name for name in truth if name[0] == prefix}
        e = part.adjustment.image_values[:, :3] - [truth[id] for id in ids]
        assert np.abs(e).max() < 0.6
    # Of the largest part, in the system of the positions.
    largest, layers = found.parts[0], tmp_path / "block.geojson"
    assert largest.block.epsg == "EPSG:32633"
    write_gis(largest.adjustment, str(layers), largest.block.epsg)
    features = json.loads(layers.read_text("utf-8"))["features"]
    stations = {f["properties"]["id"]: f["geometry"]["coordinates"] for f in features
                if f["properties"]["layer"] == "stations"}  # fmt: skip
    to_map = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32633", always_xy=True).transform
    for name, (longitude, latitude, height) in stations.items():
        np.testing.assert_allclose((*to_map(longitude, latitude), height), truth[name], atol=0.6)


def test_geojson_of_a_frame_without_a_system_is_refused(made, tmp_path):
    (part,) = made[1].parts
    assert part.block.epsg == ""
    with pytest.raises(InputError, match="not written, all else is"):
        write_gis(part.adjustment, str(tmp_path / "a.geojson"), part.block.epsg)
    write_gis(part.adjustment, str(tmp_path / "a.gpkg"), part.block.epsg)
    assert (tmp_path / "a.gpkg").exists() and not (tmp_path / "a.geojson").exists()


def test_groups_of_connected_photographs():
    empty = np.zeros((0, 2), int)
    pair = lambda i, j: Pair((i, j), empty, np.zeros(0), np.eye(3), np.zeros(3), 0.1, "relative", 9)
    assert group_connected(6, [pair(4, 5), pair(0, 3), pair(5, 3)]) == [[0, 3, 4, 5], [1], [2]]


def test_what_cannot_be_used_is_refused(tmp_path):
    with pytest.raises(InputError, match="no photographs in this folder"):
        find_photographs([tmp_path])
    grey = np.random.default_rng(0).integers(0, 255, (80, 100), np.uint8)
    for name in ("one.png", "two.png"):
        cv2.imwrite(str(tmp_path / name), grey)
    with pytest.raises(InputError, match="1 of 2 photographs can be used.*the same file as one"):
        find_photographs([tmp_path])
    with pytest.raises(InputError, match="no such file"):
        find_photographs([tmp_path / "missing.jpg"])
    cv2.imwrite(str(tmp_path / "two.png"), grey[:70])
    found, _ = find_photographs([tmp_path])
    assert len(assign_cameras(found).cameras) == 2
    camera = jaxbundle.Camera("cam", "opencv", {"fx": 90.0, "fy": 90.0}, image_size=(100, 80))
    with pytest.raises(InputError, match="two.png: 100 × 70 pixels, but camera 'cam' has 100 × 80"):
        assign_cameras(found, camera)


def test_two_copies_of_one_photograph_are_too_few(tmp_path, command):
    write_photographs(tmp_path, "a", 1, 3)
    grey = cv2.imread(str(tmp_path / "a0.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(tmp_path / "copy.jpg"), grey, [cv2.IMWRITE_JPEG_QUALITY, 80])
    told = command("reconstruct", tmp_path, "--out", tmp_path / "out")
    assert told.status == 2 and "fewer than two photographs can be used" in told.err
    assert "shows the same as" in told.err


def test_the_command_refuses_before_it_writes(tmp_path, command):
    empty = tmp_path / "empty"
    empty.mkdir()
    out = tmp_path / "out"
    told = command("reconstruct", empty, "--out", out)
    assert told.status == 2 and "no photographs" in told.err and not out.exists()
    told = command("reconstruct", empty, "--out", out, "--features", "surf")
    assert told.status == 2 and "sift, akaze, orb" in told.err


@pytest.mark.parametrize("inner, left", [("new/out", False), ("empty", True)])
def test_bad_input_found_late_leaves_nothing(tmp_path, command, inner, left):
    """The size of the camera is compared with opened photographs, when --out has been made."""
    write_photographs(tmp_path / "photos", "a", 2, 3)
    camera, out = tmp_path / "camera.toml", tmp_path / inner
    camera.write_text(
        '[[camera]]\nid = "c"\nmodel = "opencv"\nfx = 9.0\nfy = 9.0\nimage_size = [9, 6]\n'
    )
    (tmp_path / "empty").mkdir()
    told = command("reconstruct", tmp_path / "photos", "--camera", camera, "--out", out)
    assert told.status == 2 and "camera 'c' has 9 × 6" in told.err
    assert out.exists() == left and not (tmp_path / "new").exists()
    assert not list((tmp_path / "empty").iterdir())
