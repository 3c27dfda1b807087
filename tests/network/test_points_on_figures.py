"""Planes, lines, circles, spheres, cylinders, shapes that are known, differences and angles."""

import dataclasses

import numpy as np
import pytest
from further_checks import check_jacobians, sample

import jaxbundle
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_omega_phi_kappa, matrix_from_quaternion
from jaxbundle.leastsquares.solution import find_minimum
from jaxbundle.network.build import make_further
from jaxbundle.network.kinds.figures import Figures
from jaxbundle.network.kinds.fit_figures import FEWEST, fit

random = np.random.default_rng(11)
AXIS = np.array([0.2, -0.3, 0.93]) / np.linalg.norm([0.2, -0.3, 0.93])
TILT = np.linalg.svd(AXIS[None])[2][1:]  # two directions across it
SIZES = {"plane": 8, "line": 5, "circle": 7, "sphere": 9, "cylinder": 10}
CENTRES = {"plane": [1, 1, 0.2], "line": [-1, 1, 0.4], "circle": [1, -1, 0.3],
           "sphere": [-1, -1, 0.5], "cylinder": [0, 0, 0.5]}  # fmt: skip
RADIUS = {"circle": 0.6, "sphere": 0.5, "cylinder": 0.4}
SIGMA = 2e-4


def points_of(type: str):
    """Points of a figure about its centre, exactly on it."""
    n, along = SIZES[type], random.uniform(-0.8, 0.8, SIZES[type])
    turn = np.linspace(0, 2 * np.pi, n, endpoint=False)
    about = np.cos(turn)[:, None] * TILT[0] + np.sin(turn)[:, None] * TILT[1]
    if type == "plane":
        x = random.uniform(-0.7, 0.7, (n, 2)) @ TILT
    elif type == "line":
        x = along[:, None] * AXIS
    elif type == "sphere":
        x = random.normal(size=(n, 3))
        x *= RADIUS[type] / np.linalg.norm(x, axis=1, keepdims=True)
    else:
        x = RADIUS[type] * about + (type == "cylinder") * along[:, None] * AXIS
    return np.array(CENTRES[type]) + x


BOARD = np.array([[0.0, 0, 0], [0.4, 0, 0], [0.4, 0.3, 0], [0, 0.3, 0.05]])
PLACES = [np.array([0.3, 1.4, 0.1]), np.array([-1.4, 0.2, 0.3])]


@pytest.fixture(scope="module")
def simulated():
    """A free network of six photographs about all these points."""
    points = [points_of(type) for type in SIZES]
    R = np.stack([*TILT, AXIS]) * np.linalg.det(np.stack([*TILT, AXIS]))
    points += [place + BOARD @ R for place in PLACES]
    stations = jaxbundle.ring_of_stations(6, radius=5.0, height=3.0, roll_every=2)
    return jaxbundle.simulate_with_truth(
        stations, np.concatenate(points), jaxbundle.Camera("cam", "brown", {"c": 30.0}, ("c",)),
        noise=0.003, seed=5, disturb=(0.02, 0.005, 0.02),
    )  # fmt: skip


def tables(sigma):
    """Every figure, both boards, two height differences, an angle, by id."""
    ids = iter(range(1, 100))
    figures = [
        {"figure": f"the {type}", "type": type, "point": str(next(ids)), "sigma": sigma}
        for type, n in SIZES.items() for _ in range(n)
    ]  # fmt: skip
    shapes = [
        {"shape": name, "point": str(next(ids)), "x": x, "y": y, "z": z, "sigma": sigma}
        for name in ("board 1", "board 2") for x, y, z in BOARD
    ]  # fmt: skip
    return {"figures": figures, "shapes": shapes}


def conditioned(network, sigma, truth=None, **more):
    given = tables(sigma) | more
    if truth is not None:
        X = truth.points.position
        given["differences"] = [
            {"from": "1", "to": "2", "dX": None, "dY": None, "dZ": X[1, 2] - X[0, 2],
             "sdX": None, "sdY": None, "sdZ": SIGMA},
        ]  # fmt: skip
        u, v = X[0] - X[1], X[8] - X[1]
        angle = np.arccos(u @ v / np.linalg.norm(u) / np.linalg.norm(v))
        given["angles"] = [{"from": "1", "at": "2", "to": "9", "value": angle, "sigma": 1e-4}]
    return network.replace(further=make_further(given, 1.0))


@pytest.fixture(scope="module")
def result(simulated):
    return jaxbundle.adjust(conditioned(simulated.network, SIGMA, simulated.truth))


@pytest.mark.further
def test_counts_and_datum(result):
    """Figures and an angle move with the network; known shapes have a scale; a height difference
    shows a tilt: what is open are three shifts and two turns."""
    assert result.converged and 0.8 < result.sigma0 < 1.2
    assert result.counts.datum == 5
    rows = sum(n * (2 if t in ("line", "circle") else 1) for t, n in SIZES.items())
    assert result.counts.other == rows + 3 * 8 + 1 + 1
    assert result.residuals["r"].sum() == pytest.approx(result.redundancy, abs=1e-6)


@pytest.mark.further
def test_figures_are_found(simulated, result):
    """Radii within 3.5 σ; adjusted points off their figures by no more than σ allows."""
    found = result.further_unknowns
    for type, radius in RADIUS.items():
        one = found[f"radius of {type}"][f"the {type}"]["R"]
        assert 0 < one["sigma"] < 1e-3
        assert abs(one["value"] - radius) < 3.5 * one["sigma"], type
    X, first = result.point_values, 0
    for type, n in SIZES.items():
        _, M, _ = fit(type, X[first : first + n])
        if type != "sphere":  # free of the network's own turn: angles between axes and normals
            assert found[type][f"the {type}"]["omega"]["sigma"] > 0
        first += n
    report = result.report()
    for words in ("Plane", "Radius of cylinder", "the sphere", "known shapes", "angles"):
        assert words in report


def test_as_many_points_determine_a_figure_as_it_has_unknowns():
    """Plane 3, line 4, circle 3 + 3, sphere 4, cylinder 4 + 1, by the conditions of a point."""
    unknowns = {"plane": (3, 1), "line": (4, 2), "circle": (6, 2), "sphere": (4, 1),
                "cylinder": (5, 1)}  # fmt: skip
    assert FEWEST == {type: -(-n // of_point) for type, (n, of_point) in unknowns.items()}


def test_the_axis_of_a_cylinder_is_found_where_no_principal_axis_is_near():
    """Points along a helix of one turn, as long as wide."""
    turn = np.linspace(0, 6, 12)
    X = np.outer(np.cos(turn), TILT[0]) + np.outer(np.sin(turn), TILT[1]) + np.outer(turn / 3, AXIS)
    _, M, radius = fit("cylinder", X)
    assert np.abs(np.linalg.svd(X - X.mean(0))[2] @ AXIS).max() < np.cos(np.radians(10))
    assert np.abs(M[2] @ AXIS) > np.cos(np.radians(7)) and radius == pytest.approx(1.0, rel=0.05)


def test_known_shapes_start_where_their_points_are(simulated):
    """Each from its own points: x = M·(X − X0) holds for every point of the true network."""
    start = jaxbundle.make_problem(conditioned(simulated.truth, SIGMA)).data.start
    pose, X = start["shape"], np.asarray(start["point"])[-2 * len(BOARD) :]
    for k in range(2):
        M = np.asarray(matrix_from_quaternion(pose.rotation[k]))
        x = (X[len(BOARD) * k :][: len(BOARD)] - pose.position[k]) @ M.T
        np.testing.assert_allclose(x, BOARD, atol=1e-9)


@pytest.mark.further
def test_shapes_that_begin_turned(simulated):
    """Exact shapes whose points begin turned by 40°: conditions that hold them less lead near the
    minimum, which is that of the exact ones alone, in a few iterations instead of many."""
    network, turn = simulated.network, matrix_from_omega_phi_kappa(np.radians([40.0, 20, 30]))
    position = network.points.position.copy()
    for k in (1, 2):
        own = slice(len(position) - k * len(BOARD), len(position) - (k - 1) * len(BOARD))
        middle = position[own].mean(0)
        position[own] = (position[own] - middle) @ np.asarray(turn) + middle
    points = dataclasses.replace(network.points, position=position)
    network = conditioned(network.replace(points=points), 0.0, figures=None)
    result = jaxbundle.adjust(network)
    problem = jaxbundle.make_problem(network)
    alone = find_minimum(problem, problem.data.start, max_steps=300)
    cost = float(alone.history.cost[int(alone.iterations) - 1])
    assert result.converged and result.iterations < 12 < int(alone.iterations) / 2
    assert np.isclose(result.vtpv, 2 * cost, rtol=1e-6)


@pytest.mark.further
def test_jacobians(result):
    check_jacobians(result.problem, result.values)


@pytest.mark.further
def test_sigma_is_that_of_a_sample(simulated, result):
    problem = jaxbundle.make_problem(conditioned(simulated.truth, SIGMA, simulated.truth))
    names = [f"radius of {type}" for type in RADIUS]
    found = sample(problem, problem.data.start, names)
    for name, values in found.items():
        ratio = values.std(0) / (result.unknowns(name).sigma / result.sigma0)
        assert (np.abs(ratio - 1) < 4 / np.sqrt(2 * len(values))).all(), (name, ratio)


@pytest.mark.further
def test_exact_conditions_hold(simulated):
    """What is exact is the limit of a small σ: points lie on their figures to 1e-7 of the extent.
    (A circle has two conditions a point, a sphere one; boards three.)"""
    exact = jaxbundle.adjust(conditioned(simulated.network, "exact", simulated.truth))
    assert exact.converged
    X, first = exact.point_values, 0
    for type, n in SIZES.items():
        origin, M, radius = fit(type, X[first : first + n])
        x, y, z = ((X[first : first + n] - origin) @ M.T).T
        off = {"sphere": np.sqrt(x**2 + y**2 + z**2) - radius,
               "circle": np.abs(np.hypot(x, y) - radius) + np.abs(z),
               "line": np.hypot(x, y), "plane": z}  # fmt: skip
        if type in off:  # of a cylinder `fit` only approximates the axis
            assert np.abs(off[type]).max() < 1e-6, type
        first += n
    boards = X[first : first + 4], X[first + 4 : first + 8]
    for board in boards:
        between = lambda x: np.linalg.norm(x[:, None] - x[None], axis=2)
        np.testing.assert_allclose(between(board), between(BOARD), atol=1e-6)


@pytest.mark.further
def test_a_plane_through_collinear_points_is_named(simulated):
    """The points of the line as a plane: its turn about them is open."""
    line = [r["point"] for r in tables(SIGMA)["figures"] if r["type"] == "line"]
    plane = [{"figure": "sheet", "type": "plane", "point": p, "sigma": "exact"} for p in line]
    network = conditioned(simulated.network, SIGMA, figures=plane, shapes=None)
    result = jaxbundle.adjust(network)
    words = " ".join(map(str, result.undetermined)) + " ".join(result.warnings)
    assert "turn x of plane sheet" in words or "turn y of plane sheet" in words


def test_a_project_keeps_them(simulated, tmp_path):
    network = conditioned(simulated.network, "exact", simulated.truth)
    path = jaxbundle.write_project(network.replace(angle_unit="gon"), tmp_path / "figures")
    again = jaxbundle.read_network(path)
    assert len(again.further) == 4
    for one, other in zip(network.further, again.further):
        for (name, column), again in zip(one.columns(1.0).items(), other.columns(1.0).values()):
            assert column == again if isinstance(column, list | tuple) else np.allclose(
                column, again, rtol=1e-14, equal_nan=True
            ), name  # fmt: skip


@pytest.mark.parametrize("table, row, message", [
    ("figures", {"type": "plain"}, "row 1: type is 'plain'; did you mean 'plane'"),
    ("figures", {"point": "99"}, "row 1: point '99' is unknown"),
    ("figures", {"radius": 2.0}, "row 1: a plane has no radius"),
    ("figures", {"figure": "the line"}, "'the line' is a line here, but a plane"),
    ("shapes", {"x": None}, "row 1: x is missing"),
    ("angles", {"at": "1"}, "row 1: expected 3 different points"),
    ("differences", {"sdZ": None}, "row 1: expected a difference dX, dY or dZ with its σ"),
])  # fmt: skip
def test_what_is_wrong_is_named(simulated, table, row, message):
    given = tables(SIGMA) | {
        "angles": [{"from": "1", "at": "2", "to": "3", "value": 1.0, "sigma": 1e-3}],
        "differences": [{"from": "1", "to": "2", "dX": None, "dY": None, "dZ": 1.0,
                         "sdX": None, "sdY": None, "sdZ": 1e-3}],
    }  # fmt: skip
    given[table][0] |= row
    with pytest.raises(InputError, match=message):
        for one in make_further(given, 1.0):
            one.check(simulated.network)


def test_one_radius_of_a_figure_holds_for_all_rows_and_two_are_refused(simulated):
    rows = [r for r in tables(SIGMA)["figures"] if r["type"] == "sphere"]
    rows[1] |= {"radius": 2.0}
    (figures,) = make_further({"figures": rows}, 1.0)
    of_radius = lambda figures: next(
        table for table in figures.declare(simulated.network, np.zeros(3)).tables
        if table.name == "radius of sphere"
    )  # fmt: skip
    assert of_radius(figures).value.tolist() == [2.0] and not of_radius(figures).free.any()
    rows[2] |= {"radius": 2.5}
    with pytest.raises(InputError, match="radius of 2.5 here, but of 2 in .*row 2"):
        make_further({"figures": rows}, 1.0)


def test_too_few_points_are_refused(simulated):
    given = {"figures": [r for r in tables(SIGMA)["figures"] if r["type"] == "sphere"][:3]}
    network = simulated.network.replace(further=make_further(given, 1.0))
    with pytest.raises(InputError, match="sphere 'the sphere' has 3 usable points; at least 4"):
        jaxbundle.make_problem(network)


@pytest.mark.parametrize("type, residuals", [("plane", 1), ("line", 2)])
def test_a_condition_has_the_sigma_of_its_point(type, residuals):
    """In every direction across the figure."""
    sigma, rows = np.array([0.01, 0.5]), np.arange(2)
    found = Figures._observe_points(type, (type,), (0 * rows,), rows, sigma)
    expected = np.tile(1 / sigma[:, None], (1, residuals))
    np.testing.assert_allclose(found.weight(residuals), expected)
