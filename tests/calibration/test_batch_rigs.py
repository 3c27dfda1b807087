"""Rigs, moving cameras, splines and cameras in millimetres in a batch: each its own network."""

import json
from pathlib import Path

import board_photographs as taken
import cv2
import numpy as np
import pytest
import render
from scipy.spatial.transform import Rotation
from test_calibrate import VIEWS
from test_rig import ANGLES, BASE, RIGHT, pair, right_of

import jaxbundle
from jaxbundle.batches.run_on_files import run_batch
from jaxbundle.calibration import calibrate_cameras
from jaxbundle.errors import InputError

POINTS = taken.BOARD.points
FREE = ["fx", "fy", "cx", "cy", "k1"]
TRUTH = [np.array(lens.parameters) for lens in (render.LENS, RIGHT)]


def seen(**options):
    return np.array([view.xy for view in pair(**options).values()])


@pytest.fixture(scope="module")
def rigs():
    """Images of five rigs: the second has one missing view, the third a board that moved, the
    fourth gross errors, the fifth no measurements in its right camera."""
    xy = np.array([seen(seed=seed, moved=(3,) if seed == 2 else ()) for seed in range(5)])
    xy[1, 0, 2] = np.nan
    xy[3, 1, :, 7] += 3.0
    xy[4, 1] = np.nan
    return xy


def calibrate(xy, **options):
    given = dict(cameras=["left", "right"]) | options
    return jaxbundle.calibrate_rigs(POINTS, xy, render.LENS.size, **given)


def mounting(row):
    return row["further_unknowns"]["mounting"]["right of rig"]


@pytest.mark.further
def test_each_rig_has_its_status_and_is_that_of_calibrate(rigs, tmp_path):
    found = calibrate(rigs, snooping="pope")
    assert found.status.tolist() == ["converged"] * 4 + ["not solved"]
    first, second, third, fourth, fifth = found.rows
    assert "camera right" in fifth["error"] and found.adjustments[4] is None
    assert second["views"] == 2 * VIEWS - 1 and third["views"] == 2 * VIEWS - 2
    assert list(third["epochs_not_used"]) == ["3"] and "not simultaneous" in str(third)
    assert len(fourth["removed"]) == VIEWS
    truth = [*BASE, *np.radians(ANGLES)]
    for row in found.rows[:4]:
        # the network's mounting is M_ref·(X0 − X0_ref), R: in the frame of the reference
        for value, one in zip(truth[:3], list(mounting(row).values())[:3]):
            assert abs(one["value"] - value) < 4 * one["sigma"]
    single = calibrate_cameras(
        pair(seed=0), rig=True, snooping=None, cross_validation=False
    ).rig
    base = single.mountings["right"]
    one = list(mounting(first).values())
    assert [x["value"] for x in one[:3]] == pytest.approx(base.base, abs=1e-3 * base.sigma.min())
    assert [x["sigma"] for x in one[:3]] == pytest.approx(base.sigma[:3], rel=1e-3)
    for name in ("left", "right"):
        of = first["cameras"][name]["parameters"]
        for parameter, sigma in single.sigma[name].items():
            near = pytest.approx(single.parameters[name][parameter], abs=1e-3 * sigma)
            assert of[parameter]["value"] == near
            assert of[parameter]["sigma"] == pytest.approx(sigma, rel=1e-3)
    assert first["rms"] == pytest.approx(np.sqrt(np.mean([r**2 for r in single.rms.values()])),
                                         rel=1e-6)  # fmt: skip
    # as a line of `jaxbundle batch`, it is a rig for other programs
    (tmp_path / "rigs.jsonl").write_text(json.dumps({"key": "car", "settings": {}} | first))
    rig = jaxbundle.io.read_network(tmp_path / "rigs.jsonl#car")
    assert [camera.image_size for camera in rig.cameras] == [render.LENS.size] * 2
    assert rig.cameras[1].parameters["fx"] == first["cameras"]["right"]["parameters"]["fx"]["value"]
    length = np.linalg.norm(rig.images.position[1] - rig.images.position[0])
    assert length == pytest.approx(np.linalg.norm([x["value"] for x in one[:3]]))
    table = found.population(list("abcde")).table()
    assert "right fx" in table and "mounting right of rig X0" in table
    assert not any("left of rig" in name for name in table)  # the reference is held
    assert "4 converged, 1 not solved" in str(found)


@pytest.mark.further
def test_without_snooping_they_are_misfits(rigs):
    found = calibrate(np.concatenate([rigs[:4], rigs[:1], rigs[:1]]))
    assert found.status[[0, 1, 4, 5]].tolist() == ["converged"] * 4
    assert found.status[2] == found.status[3] == "misfit"
    # Nobody stated a σ of image coordinates.
    assert found.adjustments[0].global_test()["sigma_origin"] == "unit"
    assert not any("χ²" in said for said in found.adjustments[0].warnings)


@pytest.mark.further
def test_arrays_of_rigs_in_a_file(rigs, tmp_path):
    """Killed and restarted: the same lines; other settings are refused."""
    path, file = tmp_path / "rigs.npz", tmp_path / "rigs.jsonl"
    np.savez(path, object_points=POINTS, image_points=rigs[[0, 4]], image_size=render.LENS.size,
             ids=["r1", "r2"], cameras=["left", "right"])  # fmt: skip
    again = lambda **options: run_batch([path], file, **dict(brief=True) | options)
    assert again() == {"converged": 1, "not solved": 1}
    whole = file.read_text()
    row = json.loads(whole.splitlines()[0])
    assert row["key"] == "rigs.npz#r1" and "images" not in row and mounting(row)["X0"]["sigma"] > 0
    file.write_text(whole[: len(whole) // 2])
    again()
    assert file.read_text() == whole
    assert again() == {"converged": 1, "not solved": 1, "skipped": 2}
    with pytest.raises(InputError, match="rig was None, is .*sigma_position"):
        again(settings=["rig.sigma_position=0.001"])
    with pytest.raises(InputError, match="--set free=fx: of cameras and rigs sigma_image"):
        again(settings=["free=fx"])


@pytest.mark.further
def test_folders_of_rigs(command, tmp_path, monkeypatch):
    """Simultaneous photographs by their numbers; a folder with one camera fails alone."""
    monkeypatch.chdir(tmp_path)
    views = taken.poses(6)
    for name, lens, poses in (("left", render.LENS, views), ("right", RIGHT, right_of(views))):
        (tmp_path / "rig" / name).mkdir(parents=True)
        for e, picture in enumerate(taken.rendered(lens, poses)):
            cv2.imwrite(f"rig/{name}/{name[0]}_{e:03d}.png", picture)
    (tmp_path / "rig" / "notes").mkdir()
    (tmp_path / "bad" / "left").mkdir(parents=True)
    (tmp_path / "rig" / "left" / "l_000.png").rename("bad/left/l_000.png")
    given = ("batch", "rig", "bad", "--board", "9x6", "--square", 0.03)
    told = command(*given, "--rig", "--json-lines", "rigs.jsonl", "--table", "rigs.csv")
    assert told.status == 0, told.err
    good, bad = map(json.loads, Path("rigs.jsonl").read_text().splitlines())
    assert good["status"] == "converged" and good["rms"] < 0.1
    assert "expected a folder of photographs for every camera of the rig" in bad["error"]
    assert good["image_size"] == {"left": [480, 360], "right": [480, 360]}
    assert good["images"].keys() >= {"left/l_001.png", "right/r_000.png"}
    X0 = mounting(good)["X0"]
    assert abs(X0["value"] - BASE[0]) < 4 * X0["sigma"]
    assert "mounting right of rig X0" in Path("rigs.csv").read_text().splitlines()[0]
    told = command(*given, "--json-lines", "cameras.jsonl")
    assert "in left, right in it: give --rig" in told.out


def moving(seed: int, line: float, speed, turn):
    """Image points of a camera that moves while it reads its lines; its velocities."""
    rng = np.random.default_rng(seed)
    velocity = rng.normal(0, [*speed, *turn], (VIEWS, 6))
    found = []
    for (M, X0), move in zip(taken.poses(VIEWS), velocity):
        uv = render.LENS.image_of(M, X0, POINTS)
        for _ in range(15):
            t = line * (uv[:, 1] - (render.LENS.size[1] - 1) / 2)
            uv = np.array([
                render.LENS.image_of(
                    Rotation.from_rotvec(move[3:] * s).as_matrix() @ M, X0 + move[:3] * s, p[None]
                )[0] for p, s in zip(POINTS, t)
            ])  # fmt: skip
        found.append(uv)
    return np.array(found) + 0.05 * rng.normal(size=(VIEWS, len(POINTS), 2)), velocity


@pytest.mark.further
def test_a_rolling_shutter_in_a_batch():
    """Hand-held cameras: with priors of their motion the result is within its σ of the truth,
    without the rolling shutter far off."""
    line, speed, turn = 3e-5, [0.3, 0.3, 0.1], [0.3] * 3
    made = [moving(seed, line, speed, turn) for seed in range(2)]
    xy = np.array([views for views, _ in made])[:, None]
    names = ("vX", "vY", "vZ", "wx", "wy", "wz")
    section = {"line_time": line, "sigma": dict(zip(names, [*speed, *turn]))}
    rolled = calibrate(xy, cameras=None, free=FREE, rolling_shutter=section, sigma_image=0.05)
    still = calibrate(xy, cameras=None, free=FREE)
    assert rolled.status.tolist() == ["converged"] * 2
    for row, (_, velocity), result in zip(rolled.rows, made, rolled.adjustments):
        assert row["rms"] < 0.1
        of = result.unknowns("velocity")
        z = (of.value - velocity) / of.sigma
        assert 0.6 < np.sqrt(np.mean(z**2)) < 1.4
        for name, value in zip(FREE, TRUTH[0]):
            one = row["cameras"]["cam"]["parameters"][name]
            assert abs(one["value"] - value) < 4 * one["sigma"], name
    assert min(row["rms"] for row in still.rows) > 0.2
    error = [row["cameras"]["cam"]["parameters"]["fx"]["value"] - TRUTH[0][0] for row in still.rows]
    assert np.abs(error).max() > 5


@pytest.mark.further
def test_models_that_calibrate_batch_refuses():
    """In millimetres, and a grid of splines: from the same arrays, as a camera each."""
    xy = seen()[:1][None]
    mm = calibrate(xy, cameras=None, model="brown", free=["c", "x0", "y0", "K1"], pixel_size=0.005)
    of = mm.rows[0]["cameras"]["cam"]["parameters"]
    assert mm.status[0] == "converged"
    assert abs(of["c"]["value"] - 620 * 0.005) < 5 * of["c"]["sigma"]
    with pytest.raises(InputError, match="is in mm: give the size of a pixel"):
        calibrate(xy, cameras=None, model="brown", free=["c"])
    grid = calibrate(xy, cameras=None, model="spline-6x5-60")
    assert grid.status[0] == "converged" and grid.rows[0]["rms"] < 0.09


@pytest.mark.parametrize("given, said", [
    (dict(cameras=["left"]), "cameras must be 2 different names"),
    (dict(visible=np.ones((5, 2))), "visible must have the shape"),
    (dict(rolling_shutter=3), "rolling_shutter is 3; expected a table of settings"),
    (dict(rolling_shutter={"free": ["vX"]}), "rolling_shutter: line_time"),
    (dict(rolling_shutter={"line_time": 1e-5, "sigma": {"vx": 1}}), "unknown 'vx'.*'vX'"),
    (dict(rig={"sigma_posit": 1}), "sigma_posit"),
    (dict(pixel_size=-1), "pixel size -1"),
    (dict(snooping="baarda"), "snooping"),
])  # fmt: skip
def test_what_is_wrong_is_named(rigs, given, said):
    with pytest.raises(InputError, match=said):
        calibrate(rigs, **given)
    with pytest.raises(InputError, match=r"shape \[rigs, cameras, epochs, points, 2\]"):
        calibrate(rigs[0])
