"""Cameras on one mounting: truth, Monte Carlo, OpenCV, photographs that do not belong together."""

import copy
import dataclasses
from functools import partial
from types import SimpleNamespace

import board_photographs as taken
import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import render
from test_calibrate import VIEWS

import jaxbundle
from jaxbundle.batches.epochs import epoch_keys
from jaxbundle.calibration import BoardViews, calibrate_cameras, calibrate_rig
from jaxbundle.calibration.files import calibrations_dict, fill_rig, json_text, save_rig_plots
from jaxbundle.calibration.rig.calibrate import require_solved
from jaxbundle.calibration.rig.declare import Rig, adjust_rig, declare_rig, leave_out
from jaxbundle.calibration.rig.network import network_of_views
from jaxbundle.calibration.rig.report import rig_dict, rig_text
from jaxbundle.cameras import get_model, image_ray, project
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.geometry import (
    matrix_from_omega_phi_kappa,
    matrix_from_quaternion,
    quaternion_from_matrix,
)
from jaxbundle.io.exchange import convert
from jaxbundle.io.formats import read_network
from jaxbundle.leastsquares import Pose, PoseValue
from jaxbundle.network.tables import STATED, UNIT, Camera

NOISE = 0.05
RIGHT = render.Lens.of(fx=600.0, fy=602.0, cx=236.0, cy=181.0, k1=-0.1, k2=0.03, p1=-2e-4, p2=1e-4)
ANGLES = np.array([1.0, 6.0, -2.0])
TURN = np.asarray(matrix_from_omega_phi_kappa(np.radians(ANGLES)))
BASE = np.array([0.03, 0.004, -0.01])


def right_of(views):
    """Poses of the right camera."""
    return [(TURN @ M, X0 + M.T @ BASE) for M, X0 in views]


def pair(seed=0, noise=NOISE, moved=(), board=taken.BOARD.points):
    """Views of both cameras; at the epochs `moved` the board moved before the right one."""
    rng = np.random.default_rng(seed)
    middle = tuple(taken.BOARD.points.mean(0)[:2] + [0.01, 0])
    poses = taken.poses(VIEWS, middle=middle)
    other = right_of(poses)
    for e in moved:
        M, X0 = other[e]
        other[e] = M, X0 + [0.01, 0.005, 0.0]
    found = {}
    for name, lens, views in (("left", render.LENS, poses), ("right", RIGHT, other)):
        xy = np.array([lens.image_of(M, X0, board) for M, X0 in views])
        xy = xy + noise * rng.normal(size=xy.shape)
        names = tuple(f"{name}_{e:03d}.png" for e in range(VIEWS))
        found[name] = BoardViews(taken.BOARD, names, lens.size, xy)
    return found


def place(centres, matrices):
    return PoseValue(np.array(centres), np.array([quaternion_from_matrix(M) for M in matrices]))


def as_rig(views, **options):
    """The rig of views, started from the truth."""
    model = get_model("opencv")
    cameras = tuple(
        Camera(name, "opencv", dict(zip(model.parameters, lens.parameters)), model.parameters[:9])
        for name, lens in zip(views, (render.LENS, RIGHT))
    )
    middle = taken.BOARD.points.mean(0)
    poses = taken.poses(VIEWS, middle=tuple(middle[:2] + [0.01, 0]))
    seen = [np.nonzero(v.visible) for v in views.values()]
    epoch, point = np.concatenate(seen, 1)
    xy = np.concatenate([v.xy[rows] for v, rows in zip(views.values(), seen)])
    return Rig(
        cameras, place([np.zeros(3), BASE], [np.eye(3), TURN]), tuple(map(str, range(VIEWS))),
        place([X0 - middle for _, X0 in poses], [M for M, _ in poses]), taken.BOARD.ids,
        taken.BOARD.points - middle, epoch, np.repeat([0, 1], [len(rows[0]) for rows in seen]),
        point, xy, np.ones(xy.shape), **options,
    )  # fmt: skip


def base_of(found):
    """Base of the right camera and its σ."""
    mounting = found["mounting"]
    return mounting.value.position[1], mounting.sigma[1, :3]


@pytest.fixture(scope="module")
def both():
    return calibrate_cameras(pair(), rig=True, snooping=None, cross_validation=False)


@pytest.fixture(scope="module")
def rig(both):
    return both.rig


@pytest.mark.further
def test_a_rig_leaves_the_program(both, rig, tmp_path):
    """The files of `--out`, and those that `convert` makes of the JSON, are the same; the mounting
    in them is the truth."""
    fill_rig(rig.network(), tmp_path / "rig")
    (tmp_path / "result.json").write_text(json_text(both.to_dict(True)))
    said = (tmp_path / "rig" / "conversions.txt").read_text()
    assert "distances from 'left': 'right'" in said and "not written" not in said
    flip, mounting = np.diag([1.0, -1, -1]), rig.mountings["right"]
    for name, file in (("stereo.yaml", ""), ("mrcal", "right.cameramodel"),
                       ("camera_info", "right.yaml")):  # fmt: skip
        convert(tmp_path / "result.json", tmp_path / name)
        texts = [(place / name / file).read_text() for place in (tmp_path, tmp_path / "rig")]
        assert texts[0] == texts[1]
    for name in ("stereo.yaml", "mrcal", "camera_info", "camchain.yaml"):
        images = read_network(tmp_path / "rig" / name).images
        M = [np.asarray(matrix_from_omega_phi_kappa(angles)) for angles in images.angles]
        R, base = M[1] @ M[0].T, M[0] @ (images.position[1] - images.position[0])
        np.testing.assert_allclose(R, mounting.rotation, atol=1e-9)
        np.testing.assert_allclose(base, mounting.base, atol=1e-9)
        assert np.abs((base - BASE) / mounting.sigma[:3]).max() < 3
    stereo = cv2.FileStorage(str(tmp_path / "stereo.yaml"), cv2.FILE_STORAGE_READ)
    np.testing.assert_allclose(stereo.getNode("R").mat(), flip @ mounting.rotation @ flip)


@pytest.mark.further
def test_the_views_of_a_rig_are_a_network_with_the_same_minimum(rig):
    """Exact mountings are conditions with a thousandth of the σ of a ray there."""
    network = network_of_views(rig)
    assert network.observations.sigma_origin == UNIT
    result = jaxbundle.adjust(network)
    np.testing.assert_allclose(result.sigma0, rig.sigma0, rtol=1e-3)
    for name in rig.names:
        found, sigma = result.camera_parameters(name), rig.sigma[name]
        away = [(found[p] - rig.parameters[name][p]) / s for p, s in sigma.items()]
        assert np.abs(away).max() < 0.01
    halves = jaxbundle.replicate(result, by="points", repeat=2)
    assert not halves.failed and halves.dof == sum(map(len, rig.sigma.values()))
    stated = copy.copy(rig)
    stated.cameras = {
        name: SimpleNamespace(
            adjustment=SimpleNamespace(sigma_origin=STATED, network=calibration.adjustment.network),
            camera=calibration.camera,
        )
        for name, calibration in rig.cameras.items()
    }
    assert network_of_views(stated).observations.sigma_origin == STATED
    known = rig.rig.known._replace(bases=[SimpleNamespace()])
    other = SimpleNamespace(rig=dataclasses.replace(rig.rig, known=known))
    assert network_of_views(other) is None


def test_mounting_and_cameras_are_the_truth(rig):
    assert rig.converged and len(rig.epochs) == VIEWS
    mounting = rig.mountings["right"]
    error = np.concatenate([mounting.base - BASE, mounting.angles - ANGLES]) / mounting.sigma
    assert np.abs(error).max() < 3
    assert abs(mounting.length - np.linalg.norm(BASE)) < 3 * mounting.length_sigma
    for name, lens in (("left", render.LENS), ("right", RIGHT)):
        truth = dict(zip(get_model("opencv").parameters, lens.parameters))
        for parameter, sigma in rig.sigma[name].items():
            assert abs(rig.parameters[name][parameter] - truth[parameter]) < 3.5 * sigma
            # together the cameras are known better than each by itself
            assert sigma < 1.02 * rig.cameras[name].sigma[parameter]
        assert rig.rms[name] == pytest.approx(NOISE * np.sqrt(2), rel=0.05)
    assert rig.camera("left").parameters["fx"] == rig.parameters["left"]["fx"]
    assert "right: base 0.03" in str(rig)


def test_opencv_has_the_same_residuals():
    """From the same numbers of 32 bits, which OpenCV takes; ours from poor start values."""
    views, board = pair(), taken.BOARD.points.astype(np.float32)
    corners = {name: [xy.astype(np.float32) for xy in v.xy] for name, v in views.items()}
    given = {name: dataclasses.replace(v, xy=np.float64(corners[name]))
             for name, v in views.items()}  # fmt: skip
    points = np.float64(board) - taken.BOARD.points.mean(0)
    rig = as_rig(given)
    cameras = tuple(
        dataclasses.replace(c, parameters={n: f * x for n, x in c.parameters.items()})
        for c, f in zip(rig.cameras, (1.02, 0.97))
    )
    b = rig.mounting.position + [[0, 0, 0], [0.01, -0.01, 0.02]]
    mounting = rig.mounting._replace(position=b)
    pose = rig.pose._replace(position=rig.pose.position * 1.1)
    found = adjust_rig(dataclasses.replace(
        rig, cameras=cameras, mounting=mounting, pose=pose, points=points
    ))  # fmt: skip
    assert found.converged
    start = []
    for lens in (render.LENS, RIGHT):
        fx, fy, cx, cy, *distortion = lens.parameters[:9]
        start += [np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(distortion)]
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 300, 1e-14)
    rms, *_, R, T, _, _ = cv2.stereoCalibrate(
        [board] * VIEWS, corners["left"], corners["right"], *start, (480, 360),
        criteria=stop, flags=cv2.CALIB_USE_INTRINSIC_GUESS,
    )  # fmt: skip
    ours = np.sqrt(found.vtpv / (found.counts.observations / 2))
    assert ours == pytest.approx(rms, abs=1e-8)
    D = np.diag([1.0, -1, -1])
    b, q = (x[1] for x in found["mounting"].value)
    np.testing.assert_allclose(D @ R @ D, matrix_from_quaternion(q), atol=1e-5)
    np.testing.assert_allclose(-D @ R.T @ T.ravel(), b, atol=1e-5)


@pytest.mark.parametrize("name", ["left", "right"])
def test_uncertainty_in_the_rig_is_that_of_mounting_and_camera(rig, name):
    """Of points held in the frame of the reference camera, by differences of their images."""
    k, distance, model = rig.names.index(name), 0.5, get_model("opencv")
    p, mounting = rig.values("camera")[k], PoseValue(*(x[k] for x in rig.values("mounting")))
    C, free = rig.covariance(name), 9
    np.testing.assert_allclose(C[:6, :6], rig.result["mounting"].covariance[k], rtol=1e-6, atol=0)
    np.testing.assert_allclose(C[6:, 6:], rig.result["camera"].covariance[k], rtol=1e-6, atol=0)
    stated = rig.uncertainty(name, distance, grid=(4, 3))
    M = np.asarray(matrix_from_quaternion(mounting.rotation))
    rays = jax.vmap(lambda uv: jnp.stack(image_ray(model, tuple(p), *uv)))(stated.uv.reshape(-1, 2))
    Y = mounting.position + distance * np.asarray(rays) @ M

    @jax.jit
    @partial(jax.vmap, in_axes=(None, 0))
    def image(change, Y):
        moved = Pose().retract(mounting, change[:6])
        q = jnp.asarray(p).at[:free].add(change[6:])
        return jnp.stack(project(model, tuple(q), *Pose().prepare(moved).ray(Y)))

    step = 1e-3 * np.sqrt(np.diagonal(C)) + 1e-9
    J = np.array([(image(h, Y) - image(-h, Y)) / (2 * h.max()) for h in np.diag(step)])
    expected = np.einsum("anx,ab,bny->nxy", J, C, J)
    size = np.abs(expected).max()
    np.testing.assert_allclose(stated.covariance.reshape(-1, 2, 2), expected, atol=1e-5 * size)


def test_maps_and_coverage_of_a_rig(rig, tmp_path):
    text, numbers = rig_text(rig), rig_dict(rig)
    assert "the rig, at infinity" in text and "% of the image's cells" in text
    for name in rig.names:
        counts = rig.coverage(name).counts
        assert counts.sum() == VIEWS * 54 == np.sum(numbers["quality"][name]["coverage"]["counts"])
        far, turned = rig.uncertainty(name), rig.uncertainty(name, frame="rotation")
        assert turned.middle < far.middle
        assert rig.uncertainty(name) is far
    for arguments, said in ((("middle",), "not of the rig"), (("left", -1.0), "positive"),
                            (("left", 1.0, "scene"), "frame must be one of")):  # fmt: skip
        with pytest.raises(InputError, match=said):
            rig.uncertainty(*arguments)
    save_rig_plots(rig, tmp_path)
    assert {f"rig_{name}_{what}.png" for name in rig.names
            for what in ("coverage", "uncertainty", "uncertainty_far")} == {
        path.name for path in tmp_path.iterdir()
    }  # fmt: skip


def test_redundancy_numbers_say_how_much_of_an_error_a_residual_shows():
    """∂v/∂l = −r for a small error of one coordinate."""
    rig = as_rig(pair())
    found = adjust_rig(rig)
    r = rig.in_order(found.solution.reliability.redundancy)
    assert r.sum() == pytest.approx(found.counts.redundancy)
    row, by = int(r[:, 0].argmin()), 1e-3
    xy = rig.xy.copy()
    xy[row, 0] += by
    there = adjust_rig(dataclasses.replace(rig, xy=xy))
    v = [rig.in_order(one.solution.residuals)[row, 0] for one in (found, there)]
    assert (v[1] - v[0]) / by == pytest.approx(-r[row, 0], rel=1e-3)


WRONG = (("left", 4, 7), ("right", 9, 30))
"""Points with gross errors: camera, epoch, number."""


@pytest.fixture(scope="module")
def flawed():
    """Calibrations that kept everything: at two epochs the board moved, two points are wrong."""
    views = pair(moved=(3, 8))
    for name, e, p in WRONG:
        views[name].xy[e, p] += [0.6, -0.4]
    return calibrate_cameras(views, snooping=None, cross_validation=False)


@pytest.mark.further
def test_what_only_the_mounting_shows_is_removed(flawed):
    """Epochs that are not simultaneous, then single points: named, and without effect."""
    found = calibrate_rig(flawed.cameras, snooping="pope")
    assert {epoch for epoch, _ in found.left_out} == {"3", "8"} and len(found.epochs) == VIEWS - 2
    assert "photographs not simultaneous" in found.left_out[0][1]
    mounting = found.mountings["right"]
    assert (np.abs(mounting.base - BASE) < 3.5 * mounting.sigma[:3]).all()
    ids = taken.BOARD.ids
    said = {f"point {ids[p]} in image {name} {e}" for name, e, p in WRONG}
    assert {r.name for r in found.removed} == said
    tested = found.residuals
    assert len(tested["tau"]) == 2 * (2 * (VIEWS - 2) * len(ids) - 2) == found.used.sum() * 2
    assert tested["r"].sum() == pytest.approx(found.redundancy)
    assert np.nanmax(np.abs(tested["tau"])) < 5
    rig = as_rig(pair())
    rays = np.isin(rig.epoch, (3, 8))
    for name, e, p in WRONG:
        of = rig.camera == found.names.index(name)
        rays |= of & (rig.epoch == e) & (rig.point == p)
    without = leave_out(rig, adjust_rig(rig), rays)
    assert found.sigma0 == pytest.approx(without.sigma0 / 0.1, rel=1e-9)
    np.testing.assert_allclose(mounting.base, base_of(without)[0], atol=1e-9)
    both = dataclasses.replace(flawed, rig=found)
    text, document = rig_text(found), calibrations_dict(both)
    assert document["verdict"]["state"] == "doubtful"
    assert document["verdict"]["words"] in " ".join(both.report()[:1000].split())
    document = document["rig"]
    assert "Data snooping: removed observations" in text and all(name in text for name in said)
    assert {item["name"] for item in document["removed"]} == said
    assert len(document["residuals"]) == len(tested["tau"])
    assert "residuals" not in rig_dict(found, brief=True)


def test_without_snooping_every_epoch_stays_and_is_named(flawed):
    """With `--snooping none` the program removes nothing."""
    found = calibrate_rig(flawed.cameras, snooping=None)
    assert found.left_out == () and {"3", "8"} <= {*found.epochs} and len(found.epochs) == VIEWS
    assert {epoch for epoch, _ in found.contradicting} >= {"3", "8"} and not found.removed
    assert "kept, but does not fit the mounting" in found.contradicting[0][1]


def test_a_camera_that_is_not_tied_is_named():
    """Never at the same moment: the mounting of the right camera."""
    rig = as_rig(pair())
    found = adjust_rig(rig)
    apart = leave_out(rig, found, rig.epoch % 2 == rig.camera)
    assert not apart.converged
    with pytest.raises(NotSolvedError, match="not determined: .*of mounting right.*share too few"):
        require_solved(apart)


def test_cameras_of_other_models_have_tables_of_their_own():
    rig = as_rig(pair())
    third = Camera("third", "brown", {"c": 5.0}, ("c",))
    cameras = (rig.cameras[0], third, rig.cameras[1])
    rig = dataclasses.replace(
        rig, cameras=cameras, camera=np.arange(len(rig.camera)) % 3,
        mounting=place([np.zeros(3)] * 3, [np.eye(3)] * 3),
    )  # fmt: skip
    tables, observations = declare_rig(rig)
    names = {t.name: t for t in tables}
    assert [o.kind.of[2] for o in observations] == ["camera, opencv", "camera, brown"]
    for given in observations:
        labels = np.array(names[given.kind.of[2]].labels)[given.rows[2]]
        assert (labels == np.array([c.id for c in cameras])[given.rows[1]]).all()
    measured = {o.name: o.measured for o in observations}
    np.testing.assert_array_equal(rig.in_order(measured), rig.xy)


def test_points_of_the_object_are_exact_weighted_or_free():
    rig = as_rig(pair())
    seen = rig.point != 5
    parts = {f: getattr(rig, f)[seen] for f in ("epoch", "camera", "point", "xy", "sigma")}
    free, _ = declare_rig(dataclasses.replace(rig, points_free=True, **parts))
    # what no camera sees keeps its place
    np.testing.assert_array_equal(free[-1].free[:, 0] == 0, np.arange(len(rig.points)) == 5)
    tables, (*_, control) = declare_rig(dataclasses.replace(rig, point_sigma=5e-4))
    assert tables[-1].free.all() and control.sigma == 5e-4 and control.kind.of == ("point",)
    np.testing.assert_array_equal(control.measured, rig.points)
    assert not declare_rig(rig)[0][-1].free.any() and len(declare_rig(rig)[1]) == 1


@pytest.mark.further
def test_a_bent_board_is_estimated_with_the_rig():
    """Scale comes from the board on the whole; σ0 and the shape come out right."""
    nominal = taken.BOARD.points
    away = (nominal - nominal.mean(0))[:, 0] / 0.12
    true = nominal + np.outer(5e-4 * (away**2 - np.mean(away**2)), [0, 0, 1])
    rig = as_rig(pair(board=true))
    known = adjust_rig(rig)
    free = adjust_rig(dataclasses.replace(rig, points_free=True))
    assert known.converged and free.converged
    assert known.sigma0 > 1.3 * NOISE
    assert free.sigma0 == pytest.approx(NOISE, rel=0.05)
    assert free.counts.redundancy == known.counts.redundancy - nominal.size + 7
    points = free["point"]
    error = points.value - (true - true.mean(0))
    assert np.sqrt(np.mean((error / points.sigma) ** 2)) == pytest.approx(1, abs=0.2)
    # Inner constraints: no shift, rotation or scale along the adjusted points is left.
    change = points.value - rig.points
    np.testing.assert_allclose(change.mean(0), 0, atol=1e-9)
    np.testing.assert_allclose(np.cross(points.value, change).sum(0), 0, atol=1e-9)
    assert abs((points.value * change).sum()) < 1e-9
    base, sigma = base_of(free)
    assert (np.abs(base - BASE) < 3.5 * sigma).all()


def test_photographs_are_paired_by_name():
    left, right = ("x/01.png", "x/02.png", "x/03.png"), ("02.jpg", "01.jpg", "03.jpg")
    keys = epoch_keys({"a": left, "b": right})
    assert keys == {"a": ["01", "02", "03"], "b": ["02", "01", "03"]}
    left, right = ("l_009.png", "l_10.png", "l_11.png"), ("r9.png", "r10.png", "r11.png")
    keys = epoch_keys({"a": left, "b": right})
    assert keys["a"] == keys["b"] == ["9", "10", "11"]
    with pytest.raises(InputError, match="cannot be paired by their names .a: 'p.png', 'q.png'"):
        epoch_keys({"a": ("p.png", "q.png"), "b": ("r.png", "s.png")})


def test_what_is_no_rig_is_refused(rig):
    views = pair()["left"]
    with pytest.raises(InputError, match="a rig has at least two cameras"):
        calibrate_cameras({"left": views}, rig=True)
    with pytest.raises(InputError, match="camera right: only 1 photograph"):
        calibrate_cameras({"right": views.take([0]), "left": views}, rig=True)
    with pytest.raises(InputError, match="a rig has at least two cameras"):
        calibrate_rig({"left": rig.cameras["left"]})
    with pytest.raises(InputError, match="camera left: photographs must be files.*but are 3"):
        calibrate_rig({"left": 3, "right": 4})
    with pytest.raises(InputError, match="model: for the calibration of each camera"):
        calibrate_rig(rig.cameras, model="brown")
    with pytest.raises(InputError, match="snooping must be one of pope, baarda or None"):
        calibrate_rig(rig.cameras, snooping="tau")


def test_what_is_given_is_checked(both):
    given = both.cameras
    for options, said in (
        ({"mountings": {"x": {"position": [0, 0, 0]}}}, "no camera 'x' is given"),
        ({"mountings": {"left": {"position": [0, 0, 0]}}}, "'left' is the reference camera"),
        ({"bodies": {"room": ["wall"]}}, "body 'room': no camera has seen a board 'wall'"),
        ({"bodies": {"room": ["board"]}, "fixed": True}, "give either fixed or bodies"),
        ({"seen_by": {"wall": ["left"]}}, "seen_by: there is no board 'wall'"),
    ):
        with pytest.raises(InputError, match=said):
            calibrate_rig(given, **options)


def test_a_rig_is_judged_and_certified(rig):
    import jaxbundle

    cameras = jaxbundle.calibration.Calibrations(rig.cameras, rig)
    worst = max(rig.sigma[name]["fx"] for name in rig.names)
    base = rig.mountings[rig.names[1]].length_sigma
    criteria = [
        f"sigma(fx) <= {worst * (1 + 1e-12):.17g} px", f"sigma({rig.names[0]}:fx) < 1 px",
        f"sigma(base) < {1.01e3 * base} mm", f"sigma(base) < {0.99e3 * base} mm",
        "sigma(rotation) < 10 deg", "rms < 1 px", "epochs >= 3", f"redundancy >= {rig.redundancy}",
    ]  # fmt: skip
    for result in (rig, cameras):
        found = jaxbundle.accept(result, criteria)
        assert [row.met for row in found.rows] == [True, True, True, False, *[True] * 4]
    page = jaxbundle.certificate(cameras).html()
    assert 'id="mountings"' in page and page.count("Uncertainty budget") >= 1


@pytest.mark.further
def test_a_rig_has_the_errors_that_its_photographs_share(both):
    """An affine distortion of each photograph, far above the noise: σ of mountings and cameras
    under it beside the classical ones; without such errors they are the classical ones."""
    rng, views = np.random.default_rng(5), pair()
    shaken, true = {}, []
    for name, given in views.items():
        x = (given.xy - np.nanmean(given.xy, (0, 1))) / 240
        a = 0.6 * rng.normal(size=(VIEWS, 1, 1))
        # one of two affine distortions, at the edge of the measured area
        half = np.nanmax(np.ptp(given.xy.reshape(-1, 2), axis=0)) / 2
        true.append(np.sqrt(np.mean(a**2) / 2) * half / 240)
        shaken[name] = dataclasses.replace(given, xy=given.xy + a * x * [1, -1])
    options = {"snooping": None, "cross_validation": False, "correlated": True}
    rig = calibrate_cameras(shaken, rig=True, **options).rig
    sizes = {size.name: size for size in rig.error_model.sizes}
    found = [size for name, size in sizes.items() if name.startswith("affine by photograph of ")]
    np.testing.assert_allclose([size.size for size in found], true, rtol=0.4)
    assert all(size.score > 4 for size in found)
    told = rig_dict(rig, brief=True)
    assert {c["name"] for c in told["error_components"]} == set(sizes)
    for name in rig.names:
        for parameter, entry in told["cameras"][name].items():
            if entry["sigma"]:
                assert entry["sigma_correlated"] == rig.correlated_sigma[name][parameter]
        assert rig.stated_sigma[name]["fx"] == rig.correlated_sigma[name]["fx"]
        assert rig.correlated_sigma[name]["fx"] > 1.2 * rig.sigma[name]["fx"]
    mounting, classical = (m["right"] for m in (rig.mountings, rig.classical_mountings))
    error = np.concatenate([mounting.base - BASE, mounting.angles - ANGLES]) / mounting.sigma
    assert np.abs(error).max() < 3.5
    entry = told["mountings"]["right"]
    np.testing.assert_allclose(entry["sigma_base"], classical.sigma[:3])
    np.testing.assert_allclose(entry["sigma_base_correlated"], mounting.sigma[:3])
    plain = calibrate_cameras(views, rig=True, **options).rig
    np.testing.assert_allclose(
        plain.covariance("right"), plain.covariance("right", classical=True), rtol=0.5
    )
