"""Hand–eye and robot–world: a camera on the hand of a robot, or before it."""

import dataclasses

import numpy as np
import pytest
from further_checks import check_jacobians
from scipy.spatial.transform import Rotation

import jaxbundle
from jaxbundle.errors import InputError
from jaxbundle.geometry import (
    matrix_from_omega_phi_kappa,
    matrix_from_quaternion,
    omega_phi_kappa_from_matrix,
)
from jaxbundle.io.results.result_project import adjusted_network, readjustable_network
from jaxbundle.leastsquares.problem import with_data
from jaxbundle.leastsquares.solution import find_minimum
from jaxbundle.network.kinds.fit_hand_eye import Rigid, motions, solve
from jaxbundle.network.tables import EXTERIOR
from jaxbundle.network.units import ANGLE_UNITS
from jaxbundle.planning.stations import Stations, stations_looking_at

N, SIGMA_P, SIGMA_R = 12, 2e-4, 3e-4
# camera on the hand (cam → hand) and object space in the base
X = Rigid(Rotation.from_euler("xyz", [0.3, -0.2, 1.1]).as_matrix(), np.array([0.05, -0.02, 0.11]))
Y = Rigid(Rotation.from_euler("xyz", [0.1, 0.2, -2.0]).as_matrix(), np.array([0.6, -0.3, 0.2]))
CAMERA = jaxbundle.Camera("cam", "brown", {"c": 20.0}, ("c",))
BOARD = np.stack(np.meshgrid(np.arange(7.0), np.arange(5.0), [0.0]), -1).reshape(-1, 3) * 0.04


def simulate(stations):
    return jaxbundle.simulate_with_truth(
        stations, BOARD - BOARD.mean(0), CAMERA, noise=0.004, seed=2, datum="control",
        control=range(len(BOARD)), control_sigma=0.0,
    )  # fmt: skip


@pytest.fixture(scope="module")
def seen():
    """A board, from places around it at all angles; and the true motion of the camera."""
    random = np.random.default_rng(3)
    place = random.uniform([-0.4, -0.4, 0.4], [0.4, 0.4, 0.8], (N, 3))
    stations = stations_looking_at(place, np.zeros(3))
    roll = stations.angles + random.uniform(-0.4, 0.4, (N, 3))
    return simulate(Stations(stations.position, roll))


def hands(made, type="eye-in-hand", noise=0.0, seed=4):
    """Rows of the robot, computed by matrices, with errors along and about the axes of its base."""
    images, random = made.truth.images, np.random.default_rng(seed)
    M = np.array([np.asarray(matrix_from_omega_phi_kappa(a)) for a in images.angles])
    camera = Rigid(np.swapaxes(M, 1, 2), images.position)  # camera → object
    if type == "eye-in-hand":  # object → base after camera → object after hand → camera
        hand = Y.compose(camera).compose(X.inverse)
    else:  # X: camera in the base; Y: object in the hand
        hand = X.compose(camera.inverse).compose(Y.inverse)
    turn = Rotation.from_rotvec(noise * SIGMA_R * random.normal(size=(len(M), 3))).as_matrix()
    q = Rotation.from_matrix(turn @ hand.R).as_quat()
    p = hand.t + noise * SIGMA_P * random.normal(size=hand.t.shape)
    return {"image": images.id, **dict(zip("XYZ", p.T)), **dict(zip(("qx", "qy", "qz", "qw"), q.T))}


def robot(network, rows, **section):
    section = {"sigma_position": SIGMA_P, "sigma_angle": SIGMA_R} | section
    return jaxbundle.add_further(network, robot_poses=rows, hand_eye=section)


def estimated(result, type="eye-in-hand"):
    """X and Y of a result, by its tables of poses."""
    pose = lambda name: (x[0] for x in result.values[name])
    names = ("camera on the hand", "robot base")
    if type != "eye-in-hand":
        names = ("camera on the base", "robot hand")
    (t, q), (centre, qf) = (pose(name) for name in names)
    R, Rf = (np.asarray(matrix_from_quaternion(x)) for x in (q, qf))
    return Rigid(R.T, np.asarray(t)), Rigid(Rf, -Rf @ (np.asarray(centre) + result.problem.origin))


@pytest.mark.parametrize("type", ["eye-in-hand", "eye-to-hand"])
def test_the_closed_form_is_exact_on_clean_data(seen, type):
    """To rounding; with a scale between robot and camera as well."""
    given = robot(seen.truth, hands(seen, type), type=type).further[0]
    A, B, _ = given.poses(seen.truth)
    one, other, scale = solve(A, B)
    if type != "eye-in-hand":
        one, other = other, one
    for found, true in ((one, X), (other, Y)):
        np.testing.assert_allclose(found.R, true.R, atol=1e-12)
        np.testing.assert_allclose(found.t, true.t, atol=1e-12)
    assert scale == pytest.approx(1, abs=1e-12)
    assert solve(A, Rigid(B.R, 0.25 * B.t))[2] == pytest.approx(4, abs=1e-11)


@pytest.mark.parametrize(
    "type", ["eye-in-hand", pytest.param("eye-to-hand", marks=pytest.mark.further)]
)
def test_clean_data_give_the_truth(seen, type):
    network = robot(seen.truth, hands(seen, type), type=type)
    result = jaxbundle.adjust(network)
    for found, true in zip(estimated(result, type), (X, Y)):
        np.testing.assert_allclose(found.R, true.R, atol=1e-10)
        np.testing.assert_allclose(found.t, true.t, atol=1e-10)
    name = "camera on the hand" if type == "eye-in-hand" else "camera on the base"
    place = [result.further_unknowns[name]["cam"][f"{a}0"]["value"] for a in "XYZ"]
    np.testing.assert_allclose(place, X.t, atol=1e-10)


def skew(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def tsai_lenz(A, B):
    """Tsai and Lenz (1989): modified Rodrigues vectors, then the shifts."""
    vector = lambda R: 2 * np.array([
        np.sin(np.linalg.norm(v) / 2) * v / np.linalg.norm(v)
        for v in Rotation.from_matrix(R).as_rotvec()
    ])  # fmt: skip
    a, b = vector(A.R), vector(B.R)
    rows = np.concatenate([skew(x + y) for x, y in zip(a, b)])
    p = np.linalg.lstsq(rows, (a - b).ravel() * -1.0)[0]
    half = p / np.sqrt(1 + p @ p)  # sin(θ/2) along the axis
    R = Rotation.from_quat([*half, np.sqrt(1 - half @ half)]).as_matrix()
    t = np.linalg.lstsq((A.R - np.eye(3)).reshape(-1, 3), (B.t @ R.T - A.t).ravel())[0]
    return Rigid(R, t)


def daniilidis(A, B):
    """Daniilidis (1999), equations 31 to 35: dual quaternions."""
    def dual(T):
        q = Rotation.from_matrix(T.R).as_quat(scalar_first=True)
        q *= np.where(q[:, :1] < 0, -1.0, 1.0)
        vector = 0.5 * (q[:, :1] * T.t + np.cross(T.t, q[:, 1:]))
        return q[:, 1:], vector

    rows = []
    for a, a2, b, b2 in zip(*dual(A), *dual(B)):
        one, other = np.c_[a - b, skew(a + b)], np.c_[a2 - b2, skew(a2 + b2)]
        rows += [np.c_[one, np.zeros((3, 4))], np.c_[other, one]]
    u, v = np.linalg.svd(np.concatenate(rows))[2][-2:].reshape(2, 2, 4).swapaxes(0, 1)
    # λ₁·v₁ + λ₂·v₂ with |q| = 1 and q·q' = 0
    (u1, u2), (w1, w2) = u, v
    best = []
    for s in np.roots([u1 @ w1, u1 @ w2 + u2 @ w1, u2 @ w2]).real:
        size = s * s * (u1 @ u1) + 2 * s * (u1 @ u2) + u2 @ u2
        best.append((size, s))
    size, s = max(best)
    q, q2 = (s * u1 + u2) / np.sqrt(size), (s * w1 + w2) / np.sqrt(size)
    R = Rotation.from_quat(q, scalar_first=True).as_matrix()
    t = 2 * (q[0] * q2[1:] - q2[0] * q[1:] + np.cross(q[1:], q2[1:]))
    return Rigid(R, t)


@pytest.mark.parametrize("method", [tsai_lenz, daniilidis])
def test_other_closed_forms_agree_on_clean_data(seen, method):
    """The peers of the noisy test are right, and so is ours."""
    A, B, _ = robot(seen.truth, hands(seen)).further[0].poses(seen.truth)
    found = method(*motions(A, B))
    np.testing.assert_allclose(found.R, X.R, atol=1e-9)
    np.testing.assert_allclose(found.t, X.t, atol=1e-9)


def error(found, true):
    turn = Rotation.from_matrix(found.R @ true.R.T).magnitude()
    return np.linalg.norm(found.t - true.t), turn


@pytest.mark.further
def test_noisy_data_are_better_than_closed_forms(seen):
    """Of Park and Martin, Tsai and Lenz, Daniilidis: the errors of the camera on the hand over 40
    draws; σ is that of the errors."""
    ours, closed, places, sigma = [], [], [], []
    for draw in range(40):
        random = np.random.default_rng(draw)
        rays = seen.truth.observations
        xy = rays.xy + 0.004 * random.normal(size=rays.xy.shape)
        network = seen.network.replace(observations=dataclasses.replace(rays, xy=xy))
        network = network.replace(observations=dataclasses.replace(
            network.observations, sigma=seen.network.observations.sigma))  # fmt: skip
        network = robot(network, hands(seen, noise=1.0, seed=100 + draw))
        result = jaxbundle.adjust(network)
        found, _ = estimated(result)
        ours.append(error(found, X))
        places.append(found.t - X.t)
        one = result.further_unknowns["camera on the hand"]["cam"]
        sigma.append([one[f"{a}0"]["sigma"] / result.sigma0 for a in "XYZ"])
        # the closed forms get the poses of the images without the robot
        alone = jaxbundle.adjust(network.replace(further=()))
        A, B, _ = network.further[0].poses(adjusted_network(alone))
        of_draw = [error(solve(A, B)[0], X)]
        of_draw += [error(method(*motions(A, B)), X) for method in (tsai_lenz, daniilidis)]
        closed.append(of_draw)
    ours, closed = np.sqrt(np.mean(np.square(ours), 0)), np.sqrt(np.mean(np.square(closed), 0))
    assert (ours < 0.95 * closed).all(), (ours, closed)
    z = np.array(places) / np.array(sigma)
    assert 0.8 < z.std() < 1.2 and np.abs(z.mean(0)).max() < 4 / np.sqrt(40)


@pytest.mark.further
@pytest.mark.parametrize("type", ["eye-in-hand", "eye-to-hand"])
def test_sigma_is_that_of_a_sample(seen, type):
    """200 draws of all image points and robot poses: positions, and the angles ω, φ, κ."""
    problem = jaxbundle.make_problem(robot(seen.truth, hands(seen, type), type=type))
    names, random, data = problem.further_tables, np.random.default_rng(8), problem.data
    found = {name: [] for name in names}
    normal = lambda sigma, n: sigma * random.normal(size=(n, 3))
    for _ in range(200):
        xy = data.measured["image"]
        p, R = (np.asarray(x) for x in data.measured["robot positions"])
        turn = Rotation.from_rotvec(normal(SIGMA_R, N)).as_matrix()
        measured = data.measured | {
            "image": xy + 0.004 * random.normal(size=np.shape(xy)),
            "robot positions": (p + normal(SIGMA_P, N), R),
            "robot rotations": (p, turn @ R),
        }
        changed = with_data(problem, dataclasses.replace(data, measured=measured))
        values = find_minimum(changed, data.start).values
        for name in names:
            M = np.asarray(matrix_from_quaternion(values[name].rotation[0]))
            angles = np.asarray(omega_phi_kappa_from_matrix(M))
            found[name].append([*np.asarray(values[name].position[0]), *angles])
    result = jaxbundle.adjust(robot(seen.network, hands(seen, type, noise=1.0), type=type))
    for name in names:
        one = next(iter(result.further_unknowns[name].values()))
        sigma = np.array([one[parameter]["sigma"] for parameter in EXTERIOR]) / result.sigma0
        sigma[3:] *= ANGLE_UNITS[seen.network.angle_unit]  # radians
        ratio = np.unwrap(np.array(found[name]), axis=0).std(0, ddof=1) / sigma
        assert (ratio > 0.88).all() and (ratio < 1.12).all(), (name, ratio)


def test_repeatability_is_a_variance_component(seen):
    """Given three times too small: the factors of positions and rotations say so."""
    rows = hands(seen, noise=3.0)
    result = jaxbundle.adjust(robot(seen.network, rows), estimate_components=True)
    assert result.sigma_factors["robot positions"] == pytest.approx(3, rel=0.4)
    assert result.sigma_factors["robot rotations"] == pytest.approx(3, rel=0.4)
    assert "robot positions" in result.report()
    again = readjustable_network(result).further[0].sigma
    for name, k in (("robot positions", 0), ("robot rotations", 3)):
        expected = result.sigma_factors[name] * (SIGMA_R if k else SIGMA_P)
        np.testing.assert_allclose(again[:, k : k + 3], expected)


def test_jacobians(seen):
    for type in ("eye-in-hand", "eye-to-hand"):
        problem = jaxbundle.make_problem(
            robot(seen.network, hands(seen, type, noise=1.0), type=type)
        )
        check_jacobians(problem, problem.data.start)


def motion(angle, axis, shift):
    """Stations that see the board from places a motion of the camera apart: turned about one axis
    of the object, or only shifted."""
    random = np.random.default_rng(5)
    R = Rotation.from_rotvec(angle * random.uniform(-1, 1, (N, 1)) * axis).as_matrix()
    place = np.array([0.0, 0.0, 0.6]) + shift * random.uniform(-1, 1, (N, 3))
    angles = np.array([omega_phi_kappa_from_matrix(r.T) for r in R])
    return Stations(np.einsum("nij,nj->ni", R, place), angles)


def test_degenerate_motions_are_named():
    planar = simulate(motion(0.5, np.array([0.0, 0.0, 1.0]), 0.1))
    network = robot(planar.network, hands(planar, noise=1.0))
    with pytest.raises(InputError, match="parallel axes.*along that axis is not determined"):
        jaxbundle.adjust(network)
    axis = X.R @ [0, 0, 1]  # of the camera, in the hand
    with pytest.raises(InputError) as told:
        jaxbundle.adjust(network)
    text = str(told.value).split("axes, (")[1].split(")")[0]
    named = np.array([float(x) for x in text.split(",")])
    assert abs(named @ axis) > 0.999
    shifted = simulate(motion(0.0, np.array([0.0, 0.0, 1.0]), 0.1))
    with pytest.raises(InputError, match="never turns.*position of the camera on the hand is not"):
        jaxbundle.adjust(robot(shifted.network, hands(shifted, noise=1.0)))
    few = jaxbundle.add_further(planar.network, robot_poses={
        k: v[:2] for k, v in hands(planar).items()
    }, hand_eye={"sigma_position": 1e-3, "sigma_angle": 1e-3})  # fmt: skip
    with pytest.raises(InputError, match="has 2 poses of the robot; at least 3"):
        jaxbundle.adjust(few)


@pytest.mark.further
def test_what_is_given_of_the_camera_makes_parallel_axes_enough():
    """A σ of its height along the axis; the rest is found."""
    planar = simulate(motion(0.5, np.array([0.0, 0.0, 1.0]), 0.1))
    angles = np.asarray(omega_phi_kappa_from_matrix(X.R.T))
    inf = float("inf")
    given = {"position": (X.t + 0.002).tolist(), "angles": (angles + 0.01).tolist(),
             "sigma_position": 0.003, "sigma_angle": inf}  # fmt: skip
    result = jaxbundle.adjust(robot(planar.network, hands(planar, noise=1.0), camera=given))
    found, _ = estimated(result)
    place, turn = error(found, X)
    assert place < 0.006 and turn < 0.005
    one = result.further_unknowns["camera on the hand"]["cam"]
    assert 0.001 < max(one[f"{a}0"]["sigma"] for a in "XYZ") < 0.004


def test_forms_of_attitudes(seen):
    """Rotation vector, roll–pitch–yaw, ω, φ, κ and quaternion are the same attitude."""
    rows = hands(seen)
    R = Rotation.from_quat(np.stack([rows[k] for k in ("qx", "qy", "qz", "qw")], 1))
    rest = {k: v for k, v in rows.items() if k[0] != "q"}
    given = {"qw": rows["qw"], **rows}
    (expected,) = robot(seen.network, given).further
    angles = np.array([omega_phi_kappa_from_matrix(m.T) for m in R.as_matrix()])
    degrees = seen.network.replace(angle_unit="deg")
    for names, values in (
        (("rx", "ry", "rz"), R.as_rotvec(degrees=True)),
        (("yaw", "pitch", "roll"), R.as_euler("ZYX", degrees=True)),
        (("omega", "phi", "kappa"), np.degrees(angles)),
    ):
        (found,) = robot(degrees, rest | dict(zip(names, values.T)), sigma_angle=0.1).further
        np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-12)
        np.testing.assert_allclose(found.sigma[:, 3:], np.radians(0.1))


@pytest.mark.further
def test_a_covariance_says_what_its_sigmas_say(seen):
    rows = hands(seen, noise=1.0)
    one = jaxbundle.adjust(robot(seen.network, rows))
    C = np.diag([SIGMA_P**2] * 3 + [SIGMA_R**2] * 3)
    upper = {f"c{i + 1}{j + 1}": [C[i, j]] * N for i in range(6) for j in range(i, 6)}
    two = jaxbundle.adjust(jaxbundle.add_further(seen.network, robot_poses=rows | upper))
    assert two.sigma0 == pytest.approx(one.sigma0, rel=1e-9)
    np.testing.assert_allclose(estimated(two)[0].t, estimated(one)[0].t, atol=1e-9)


@pytest.mark.parametrize("change, section, message", [
    ({"qw": None}, {}, "qw is missing"),
    ({"rx": [0.0] * N}, {}, "given twice"),
    ({"qw": [9.0] * N}, {}, "quaternion has the length"),
    ({}, {"sigma_position": -1}, "sigma_position"),
    ({}, {"type": "hand-in-eye"}, "eye-in-hand"),
    ({}, {"sigma": 1}, "unknown key 'sigma'"),
    ({}, {"camera": {"positon": [0, 0, 0]}}, "unknown key 'positon'"),
    ({"image": ["1"] * N}, {}, "image '1' is already"),
    ({"image": ["x"] * N}, {}, "image 'x' is"),
    ({"c11": [1.0] * N, "sX": [1.0] * N}, {}, "not both"),
])  # fmt: skip
def test_what_is_wrong_is_named(seen, change, section, message):
    rows = hands(seen) | change
    if change.get("qw", 0) is None:
        rows["qw"] = [None] * N
    with pytest.raises(InputError, match=message):
        robot(seen.network, rows, **section)


def test_a_missing_repeatability_is_named(seen):
    with pytest.raises(InputError, match="attitude of the hand is missing.*repeatability"):
        jaxbundle.add_further(
            seen.network, robot_poses=hands(seen), hand_eye={"sigma_position": 0.1}
        )


def test_in_a_project_and_back(seen, tmp_path):
    given = robot(seen.network.replace(angle_unit="deg"), hands(seen), sigma_angle=0.02)
    path = jaxbundle.write_project(given, tmp_path / "robot")
    (again,), (one,) = jaxbundle.read_network(str(path)).further, given.further
    np.testing.assert_allclose(again.rotation, one.rotation, atol=1e-14)
    np.testing.assert_allclose(again.sigma, one.sigma)
    assert again.settings == one.settings and again.image == one.image


@pytest.mark.further
def test_the_command_and_the_function(seen, tmp_path, command, capsys):
    """A project and a table of poses: matrices, σ, the repeatability of the robot."""
    rows = hands(seen, noise=1.0)
    path = jaxbundle.write_project(seen.network, tmp_path / "board")
    table = tmp_path / "robot.csv"
    lines = [",".join(rows)] + [",".join(map(str, row)) for row in zip(*rows.values())]
    table.write_text("\n".join(lines))
    found = jaxbundle.hand_eye(path, table, sigma_position=SIGMA_P, sigma_angle=SIGMA_R)
    T = found.camera()
    place, turn = error(Rigid(T[:3, :3], T[:3, 3]), X)
    sigma = np.sqrt(np.diag(found.covariance()))
    assert place < 4 * np.linalg.norm(sigma[:3]) and turn < 4 * np.linalg.norm(sigma[3:])
    np.testing.assert_allclose(found.frame[:3, :3], Y.R, atol=2e-3)
    assert found.repeatability["robot positions"] == pytest.approx(SIGMA_P, rel=0.5)
    told = command("hand-eye", path, "--poses", table, "--sigma-position", SIGMA_P,
                   "--sigma-angle", SIGMA_R, "--json", tmp_path / "out.json")  # fmt: skip
    assert told.status == 0 and "repeatability, robot positions" in told.out
    criteria = [f"robot.repeatability(position) < {3e3 * SIGMA_P} mm", "sigma0 < 2",
                "robot.sigma(position) < 1 m"]  # fmt: skip
    judged = jaxbundle.accept(found, criteria)
    assert judged.met and judged.rows[2].number == 6
    assert judged.rows[2].value >= sigma[:3].max() * (1 - 1e-9)
    assert not found.doubts and "warning" not in str(found)
    with pytest.raises(InputError, match="repeatability"):
        jaxbundle.hand_eye(path, table)
    with pytest.raises(InputError, match="camera is 'wrong'; expected one of"):
        found.covariance("wrong")
    told = command("hand-eye", path, "--poses", table, "--square", "0.03")
    assert told.status == 2 and "--square: it is for photographs of a board" in told.err
    # the camera is said to stand before the robot: no pose agrees
    wrong = jaxbundle.hand_eye(
        path, table, type="eye-to-hand", sigma_position=SIGMA_P, sigma_angle=SIGMA_R
    )
    assert "eye-to-hand, not eye-in-hand" in wrong.doubts[0] and wrong.doubts[0] in str(wrong)


@pytest.mark.further
def test_photographs_of_a_board(tmp_path):
    """Calibrated with the robot: its poses by the photographs themselves."""
    board = jaxbundle.Board(9, 6, 0.03)
    alone = jaxbundle.calibrate(["examples/board"], board, cross_validation=False)
    network = adjusted_network(alone.adjustment)
    made = type("Made", (), {"truth": network})
    rows = hands(made, noise=1.0)
    found = jaxbundle.hand_eye(
        ["examples/board"], rows, board=board, sigma_position=SIGMA_P,
        sigma_angle=float(np.degrees(SIGMA_R)),
    )  # fmt: skip
    T = found.camera()
    place, turn = error(Rigid(T[:3, :3], T[:3, 3]), X)
    assert place < 2e-3 and turn < 2e-3
