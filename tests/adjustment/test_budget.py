"""Effects of errors of held quantities and of measurements on the results, compared with networks
adjusted again with the held value, or the measurement, shifted."""

import dataclasses
import json
from functools import cache

import numpy as np
import pytest
from adjustment_checks import make, solved, synthetic

import jaxbundle
from jaxbundle.adjustment.adjust import adjust
from jaxbundle.adjustment.problem import make_problem
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_omega_phi_kappa, quaternion_from_matrix
from jaxbundle.leastsquares.problem import with_data
from jaxbundle.network.tables import EXTERIOR

HELD = dict(images=5, points=10, fixed=4, held=((0, (3, 4, 5)), (1, (0,))), noise=3.0)
"""Fixed points, an image whose rotation is held and one whose X0 is; large residuals."""
FREE = ("c", "x0", "y0", "K1")


@cache
def held_network():
    return adjust(synthetic(**HELD)[0])


def results_of(values):
    """c, x0, y0, K1, and all points and centres."""
    names = list(jaxbundle.cameras.get_model("brown").parameters)
    camera = np.asarray(values["camera"])[0, [names.index(name) for name in FREE]]
    return camera, np.asarray(values["point"]), np.asarray(values["image"].position)


def with_start(problem, **tables):
    return dataclasses.replace(problem.data, start=problem.data.start | tables)


def shifted(problem, name, h):
    """The data with one held value shifted."""
    kind, id, parameter = name.split(":")
    start = problem.data.start
    if kind == "camera":
        names = list(jaxbundle.cameras.get_model("brown").parameters)
        camera = np.array(start["camera"])
        camera[0, names.index(parameter)] += h
        return with_start(problem, camera=camera)
    if kind == "point":
        point = np.array(start["point"])
        point[problem.network.points.id.index(id), "XYZ".index(parameter)] += h
        return with_start(problem, point=point)
    i, k = problem.network.images.id.index(id), EXTERIOR.index(parameter)
    if k < 3:
        position = np.array(start["image"].position)
        position[i, k] += h
        return with_start(problem, image=start["image"]._replace(position=position))
    angles = np.array(problem.network.images.angles[i])
    angles[k - 3] += h
    rotation = np.array(start["image"].rotation)
    rotation[i] = quaternion_from_matrix(matrix_from_omega_phi_kappa(angles))
    return with_start(problem, image=start["image"]._replace(rotation=rotation))


def differences(problem, name, h):
    """Central differences of adjusted quantities, per unit of held ones, times `h`."""
    ends = [results_of(solved(problem, shifted(problem, name, s * h)).values)
            for s in (1, -1)]  # fmt: skip
    return [(a - b) / 2 for a, b in zip(*ends)]


STEPS = {"camera:cam:K3": 1e-9, "camera:cam:b1": 1e-5, "point:P1:Z": 1e-3, "point:P2:X": 1e-3,
         "image:image 0:phi": 1e-4, "image:image 1:X0": 1e-3}  # fmt: skip


def test_a_budget_is_what_the_adjustment_does_with_a_shifted_value():
    found = held_network()
    budget = jaxbundle.sensitivity(found, STEPS)
    problem, named = found.problem, [one.name for one in budget.results]
    for c, (name, h) in enumerate(STEPS.items()):
        camera, point, _ = differences(problem, name, h)
        effects = dict(zip(named, budget.effects[c]))
        size = found.camera_covariance("cam")[1].diagonal() ** 0.5
        np.testing.assert_allclose(
            [effects[f"camera:cam:{p}"] for p in FREE], camera, atol=2e-5 * size.max(), rtol=2e-4
        )
        free = point[4:]
        np.testing.assert_allclose(
            [effects[f"points:{axis}"] for axis in "XYZ"], np.sqrt((free**2).mean(0)), rtol=2e-4
        )
    own = dict(zip(named, budget.sigma))
    for name, parameters in found.cameras.items():
        for p in FREE:
            assert own[f"camera:{name}:{p}"] == pytest.approx(parameters["parameters"][p]["sigma"])
    np.testing.assert_allclose(budget.total**2, budget.sigma**2 + (budget.effects**2).sum(0))
    np.testing.assert_allclose(budget.shares.sum(0), 1)
    assert "K3 of camera cam" in str(budget)
    assert len(budget.table()["result"]) == len(named) * (len(STEPS) + 2)


def test_errors_of_several_things_add_in_squares_and_a_common_one_by_amount():
    found = held_network()
    points = [f"point:P{i}:Z" for i in range(4)]
    single = jaxbundle.sensitivity(found, dict.fromkeys(points, 1e-3))
    bend = dict(zip(points, (1e-3, -2e-3, 0.0, 1e-3)))
    both = jaxbundle.sensitivity(found, {"point:*:Z": 1e-3, "bent": bend})
    c = [one.name for one in both.results].index("camera:cam:c")
    np.testing.assert_allclose(both.effects[0], np.sqrt((single.effects**2).sum(0)), rtol=1e-9)
    amounts = np.array(list(bend.values())) / 1e-3
    assert both.effects[1, c] == pytest.approx(amounts @ single.effects[:, c], rel=1e-8)
    assert [len(cause.errors) for cause in both.causes] == [4, 1]


@pytest.mark.parametrize(
    ("network", "name", "step"),
    [
        pytest.param("free", "camera:cam:K3", 1e-9, marks=pytest.mark.further),
        pytest.param("one fixed point", "point:P0:X", 1e-3, marks=pytest.mark.further),
    ],
)
def test_a_budget_where_the_network_floats(network, name, step):
    """Also if it floats about a held point: the datum moves with the point."""
    problem = make(network)
    found = adjust(problem.network)
    budget = jaxbundle.sensitivity(found, {name: step}, of=("cameras", "points"))
    camera, point, _ = differences(problem, name, step)
    effects = dict(zip((one.name for one in budget.results), budget.effects[0]))
    size = found.camera_covariance("cam")[1].diagonal() ** 0.5
    away = np.array([effects[f"camera:cam:{p}"] for p in FREE]) - camera
    assert (np.abs(away) < 1e-4 * size + 2e-4 * np.abs(camera)).all()
    of_points = [effects[f"points:{axis}"] for axis in "XYZ"]
    moving = point[0 if network == "free" else 1 :]
    np.testing.assert_allclose(of_points, np.sqrt((moving**2).mean(0)), rtol=1e-3)


def test_a_design_has_a_budget_before_anything_is_measured():
    network, _ = synthetic(**HELD | dict(noise=0.0, disturbance=0.0))
    problem = make_problem(network)
    planned = jaxbundle.sensitivity(problem, {"camera:cam:K3": 1e-9}, of="camera:cam:c")
    blank = with_data(problem, problem.with_image_coordinates(
        problem.data, np.zeros_like(problem.data.measured["image"])
    ))  # fmt: skip
    again = jaxbundle.sensitivity(blank, {"camera:cam:K3": 1e-9}, of="camera:cam:c")
    np.testing.assert_allclose(again.effects, planned.effects, rtol=1e-9)
    camera, *_ = differences(problem, "camera:cam:K3", 1e-9)
    assert planned.effects[0, 0] == pytest.approx(camera[0], rel=1e-4)


@pytest.mark.further
def test_the_influence_of_a_measurement_is_what_shifting_it_does():
    found = held_network()
    problem = found.problem
    influence = jaxbundle.influence(found, of=(("camera", "cam", "c"), "point:P7:Z"))
    assert influence.derivatives.shape == (len(found.residuals["v"]), 2)
    np.testing.assert_allclose((influence.effects**2).sum(0), 1, atol=0.1)
    table = influence.table("camera:cam:c")
    assert (np.diff(np.abs(table["effect"])) <= 0).all()
    order = np.argsort(-np.abs(influence.effects[:, 0]))
    for row in order[[0, 5]]:
        ray, axis = divmod(int(row), 2)
        sigma = 1 / problem.image_weights[ray, axis]
        ends = []
        for sign in (1, -1):
            xy = np.array(problem.data.measured["image"])
            xy[ray, axis] += 0.3 * sign * sigma
            data = problem.with_image_coordinates(problem.data, xy)
            values = solved(problem, data).values
            ends.append([results_of(values)[0][0], np.asarray(values["point"])[7, 2]])
        slope = (np.array(ends[0]) - ends[1]) / (0.6 * sigma)
        np.testing.assert_allclose(influence.derivatives[row], slope, rtol=1e-3, atol=1e-4)
    assert "Influence on c of camera cam" in str(influence)


@pytest.mark.parametrize(
    ("held", "of", "said"),
    [
        ({"camera:cam:c": 1}, "cameras", "is estimated"),
        ({"camera:cam:K33": 1}, "cameras", "there is no 'K33'"),
        ({"camera:cem:K3": 1}, "cameras", "there is no camera 'cem'"),
        ({"lens:cam:K3": 1}, "cameras", "unknown kind 'lens'"),
        ({"camera:cam:K3": -1}, "cameras", "σ of camera:cam:K3"),
        ({"K3": 1}, "cameras", "KIND:ID:NAME"),
        ({}, "cameras", "by name"),
        ({"camera:cam:K3": 1}, "point:P99:X", "there is no point 'P99'"),
    ],
)
def test_what_is_asked_wrongly_is_named(held, of, said):
    with pytest.raises(InputError, match=said):
        jaxbundle.sensitivity(held_network(), held, of)


def test_the_mean_over_points_has_no_influence():
    with pytest.raises(InputError, match="single results"):
        jaxbundle.influence(held_network(), "points")


@pytest.mark.further
def test_the_command_writes_the_budget(command, tmp_path):
    project = "examples/convergent4/project4.toml"
    run = command("adjust", project, "--budget", "camera:cam:K3=1e-7", "--out", tmp_path / "out",
                  "--json", tmp_path / "a.json", "--no-plots")  # fmt: skip
    assert run.status == 0, run.err
    assert "Error budget" in run.out and "K3 of camera" in run.out
    budget = json.loads((tmp_path / "a.json").read_text())["budget"]
    assert budget["held"]["camera:cam:K3"] == {"sigma": 1e-7, "errors": 1}
    one = budget["results"]["camera:cam:c"]
    total = one["sigma"] ** 2 + one["held"]["camera:cam:K3"]["effect"] ** 2
    assert one["total"] ** 2 == pytest.approx(total)
    assert "camera:cam:c,total" in (tmp_path / "out" / "budget.csv").read_text()
    assert "Error budget" in (tmp_path / "out" / "report.txt").read_text()
    assert "Error budget" in (tmp_path / "out" / "report.html").read_text()
    for wrong in ("camera:cam:K3", "camera:cam:K3=x", "camera:cam:c=1"):
        run = command("adjust", project, "--budget", wrong)
        assert run.status == 2 and len(run.err.strip().splitlines()) == 1
