"""Design of networks: aims against dense algebra, gradients against differences, conditions kept,
gains confirmed by simulation, refusals by name. All networks are six stations and ten targets, so
that they share the program of the aim."""

import contextlib
import dataclasses
import itertools
import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxbundle
from jaxbundle.choices import DESIGNED
from jaxbundle.errors import InputError
from jaxbundle.network.subsets import keep_images
from jaxbundle.network_design.aims import Aim, measure, smallest_redundancy, task_of
from jaxbundle.network_design.feasible import start_at
from jaxbundle.network_design.pairs import make_pairs
from jaxbundle.network_design.priors import use_prior_tables
from jaxbundle.network_design.proof import prove
from jaxbundle.network_design.realise import problem_of
from jaxbundle.network_design.search import configuration, make_program
from jaxbundle.network_design.settings import DesignSettings
from jaxbundle.network_design.variables import choose_variables, turn_axis

PAGE = (Path(__file__).parents[2] / "docs" / "design.md").read_text(encoding="utf-8")
SIGMA = 0.002


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The names defined by the code of docs/design.md, which writes a project."""
    names = {}
    with contextlib.chdir(tmp_path_factory.mktemp("page")):
        for code in re.findall(r"```python\n(.*?)```", PAGE, re.S):
            exec(code, names)
    return names


@pytest.fixture(scope="module")
def network(page):
    """Six stations in a row, ten targets."""
    return page["planned"]


@pytest.fixture(scope="module")
def designed(page):
    return page["designed"]


@pytest.fixture(scope="module")
def site(page):
    return page["site"]


def images(stations, angles, targets, c, x0):
    """Collinearity, without distortion, by scipy's rotations."""
    found = []
    for X0, (omega, phi, kappa) in zip(stations, angles):
        M = Rotation.from_euler("XYZ", [omega, phi, kappa]).as_matrix().T
        ray = (targets - X0) @ M.T
        found.append(-c * ray[:, :2] / ray[:, 2:] + [x0, 0.0])
    return np.array(found)


def dense(network):
    """The cofactors of the points under inner constraints, and redundancy numbers [I, P, 2]: by
    pseudo-inverse of the normal equations reduced to the points, J by differences."""
    I, P = len(network.images), len(network.points)  # noqa: E741
    x = np.concatenate([network.images.position.ravel(), network.images.angles.ravel(),
                        [20.0, 0.0], network.points.position.ravel()])  # fmt: skip

    def f(x):
        pose, rest = x[: 6 * I], x[6 * I :]
        X0, angles = pose.reshape(2, I, 3)
        return images(X0, angles, rest[2:].reshape(P, 3), *rest[:2]).ravel()

    J = np.array([(f(x + h) - f(x - h)) / 2e-5 for h in 1e-5 * np.eye(len(x))]).T / SIGMA
    k = 6 * I + 2
    N = J.T @ J
    reduced = N[k:, k:] - N[k:, :k] @ np.linalg.solve(N[:k, :k], N[:k, k:])
    C = np.linalg.pinv(reduced, rcond=1e-9, hermitian=True)
    scale = 1 / np.sqrt(np.diag(N))
    Q = scale[:, None] * np.linalg.pinv(N * scale * scale[:, None], 1e-10) * scale
    r = 1 - np.einsum("ij,jk,ik->i", J, Q, J)
    blocks = np.array([C[3 * p : 3 * p + 3, 3 * p : 3 * p + 3] for p in range(P)])
    return blocks, r.reshape(I, P, 2)


@pytest.fixture(scope="module")
def plain(network):
    """The network with a camera without distortion."""
    camera = dataclasses.replace(network.cameras[0], parameters={"c": 20.0})
    return network.replace(cameras=(camera,))


@pytest.fixture(scope="module")
def oracle(plain):
    return dense(plain)


@pytest.mark.further
def test_aims_are_those_of_dense_algebra(plain, oracle):
    blocks, _ = oracle
    pairs = make_pairs(plain, Aim(), jaxbundle.Conditions(), SIGMA)
    values = pairs.problem.data.start
    measured = pairs.measured(values)
    assert measured.all()
    aim = Aim("determinant")
    pairs = dataclasses.replace(pairs, task=task_of(pairs.problem, aim))
    assert pairs.aim_at(measured, values) == pytest.approx(measure(aim, blocks), rel=1e-5)
    variances = np.trace(blocks, axis1=1, axis2=2) / 3
    assert measure(Aim("mean"), blocks) == pytest.approx(np.sqrt(variances.mean()))
    root = np.prod(np.linalg.det(blocks)) ** (1 / (2 * 3 * len(blocks)))
    assert measure(Aim("determinant"), blocks) == pytest.approx(root)
    worst = np.sqrt(variances.max())
    assert worst < measure(Aim("worst"), blocks) < 10 ** (1 / 24) * worst


@pytest.mark.further
def test_the_smallest_redundancy_number(plain, oracle):
    problem = jaxbundle.make_problem(plain)
    assert smallest_redundancy(problem) == pytest.approx(oracle[1].min(), rel=1e-5)


@pytest.mark.further
def test_gradient_against_differences(network, site):
    """By stations, directions, roll and targets, with all conditions soft."""
    conditions = dataclasses.replace(
        site, focus=(0.5, 5.0), incidence=1.4, normals=(0, 0, 1),
        obstacles=(((0.2, -0.1, 0.1), (0.4, 0.1, 0.5)),),
    )  # fmt: skip
    pairs = make_pairs(network, Aim(), conditions, SIGMA)
    start = start_at(pairs)
    variables = choose_variables(start.values, DESIGNED, np.arange(6), np.arange(10))
    design = configuration(pairs, variables)
    program = make_program(pairs, design)
    x = variables.vector(start) + 0.01 * np.random.default_rng(1).standard_normal(72)
    aside, h = np.random.default_rng(2).standard_normal(72), 1e-4
    for name in ("worst", "determinant"):
        object.__setattr__(pairs, "task", task_of(pairs.problem, Aim(name)))
        _, slope = program(x, start, 0.2)
        ends = [program(x + k * h * aside, start, 0.2)[0] for k in (-2, -1, 1, 2)]
        difference = (8 * (ends[2] - ends[1]) - (ends[3] - ends[0])) / (12 * h)
        assert slope @ aside == pytest.approx(difference, rel=1e-5), name


def test_a_station_turns_to_its_point():
    q = np.array([0.7, -0.1, 0.5, 0.3])
    for away in np.random.default_rng(0).standard_normal((5, 3)):
        w, x, y, z = np.asarray(turn_axis(q, away))
        M = Rotation.from_quat([x, y, z, w]).as_matrix()
        np.testing.assert_allclose(M @ away / np.linalg.norm(away), [0, 0, -1], atol=1e-12)


@pytest.mark.further
def test_a_row_of_stations_spreads_out(designed, site):
    assert designed.gain > 2
    assert designed.path[0].aim > designed.path[-1].aim
    images, points = designed.network.images, designed.network.points
    low, high = np.array(site.room)
    assert ((images.position >= low - 1e-9) & (images.position <= high + 1e-9)).all()
    away = np.linalg.norm(images.position[:, None] - images.position, axis=-1)
    assert away[np.triu_indices(6, 1)].min() > site.apart * 0.999
    rays = designed.network.observations
    length = np.linalg.norm(images.position[rays.image] - points.position[rays.point], axis=1)
    assert length.min() > 1 and length.max() < 6
    assert (np.abs(rays.xy) < [12.05, 8.05]).all()
    assert "times smaller" in str(designed)
    bounded = dataclasses.replace(designed, bound=designed.after.aim / 2)
    assert "(50 % less)" in str(bounded)


def test_simulated_networks_confirm_the_design(page, designed):
    proof = page["proof"]
    assert proof.failed == 0 and proof.agrees
    assert proof.predicted == pytest.approx(designed.after.aim, rel=1e-4)


@pytest.mark.further
def test_a_reliability_is_proved_without_points_that_are_free(plain):
    """By the projection centres, whose σ the adjustment has, too."""
    points = dataclasses.replace(plain.points, role=("fixed",) * len(plain.points))
    problem = problem_of(plain.replace(points=points))
    assert prove(problem, Aim("reliability"), 100).agrees


@pytest.mark.further
def test_the_best_photographs_are_those_of_brute_force(page, designed, site):
    four = page["four"]
    pairs = make_pairs(designed.network, Aim(), site, SIGMA)
    values = pairs.problem.data.start
    measured, image = pairs.measured(values), pairs.problem.image
    best = min(
        pairs.aim_at(measured & np.isin(image, chosen), values)
        for chosen in itertools.combinations(range(6), 4)
    )
    assert four.after.aim == pytest.approx(best, rel=1e-4)
    assert 0.5 * best < four.bound <= best * 1.001
    assert len(four.dropped) == 2 and four.after.photographs == 4
    assert sum(four.weights.values()) == pytest.approx(4, abs=1e-3)


@pytest.mark.further
def test_a_further_photograph(network, site):
    few = DesignSettings(candidates=6, refined=1)
    five = keep_images(network, np.arange(6) < 5)
    found = jaxbundle.design(five, order="third", conditions=site, max_iterations=4, settings=few)
    assert found.gain > 1.3 and found.after.photographs == 6
    assert found.added == ("new 6",)
    kept = found.network.observations.take(found.network.observations.image < 5)
    np.testing.assert_array_equal(kept.xy, five.observations.xy)
    assert len(found.tried[1]) == 6


@pytest.mark.further
def test_a_minimal_datum_is_worse_than_inner_constraints(network):
    found = jaxbundle.design(network.replace(datum="minimal"), order="zero")
    assert found.gain > 1.2 and found.network.datum == "inner"


def test_a_board_is_held_where_the_camera_was(designed):
    poses, images = designed.board_poses, designed.network.images
    np.testing.assert_allclose(
        np.linalg.inv(poses)[:, :3, 3], images.position, atol=1e-9
    )
    middle = poses[:, :3, 3]
    assert (middle[:, 2] > 0).all()


def refused(network, message, aim="mean", **options):
    with pytest.raises(InputError, match=message):
        jaxbundle.design(network, aim, **options)


@pytest.mark.further
def test_what_cannot_be_designed_is_refused(network, site):
    camera = network.cameras[0]
    conditions = jaxbundle.Conditions
    refused(network, 'the condition "distance"', conditions=conditions(
        room=site.room, distance=(50, 60)))  # fmt: skip
    refused(network, "together for any target", conditions=conditions(
        room=site.room, distance=(1.0, 2.0), focus=(3.0, 9.0)))  # fmt: skip
    cover = tuple(
        ((-3, -3, z), (3, 3, z + 0.1)) for z in (-1.2, 1.2)
    ) + tuple(
        (tuple(np.where(np.arange(3) == a, s - 0.05, -1.9)),
         tuple(np.where(np.arange(3) == a, s + 0.05, 1.9))) for a in (0, 1) for s in (-1.8, 1.8)
    )  # fmt: skip
    outside = ((2.5, -4, 0.2), (4, 4, 3))
    refused(network, "all targets are hidden", conditions=conditions(room=outside, obstacles=cover))
    one = network.points.position[4]
    refused(network, "1 of 10 targets cannot be measured from any", conditions=conditions(
        room=site.room, obstacles=((tuple(one - 0.05), tuple(one + 0.05)),)))  # fmt: skip
    with pytest.raises(InputError, match="incidence needs the normals"):
        conditions(incidence=1.0)
    with pytest.raises(InputError, match="the box from"):
        conditions(room=((0, 0, 0), (1, 0, 1)))
    blind = network.replace(cameras=(dataclasses.replace(camera, image_size=None),))
    refused(blind, "its field of view is not known")


@pytest.mark.further
def test_priors_in_tables_are_information_as_in_columns(network):
    """As in the folder of an adjusted network, whose priors have values of their own."""
    ids, camera = network.images.id[:3], network.cameras[0]
    rows = {"image": ids, **{f"{axis}0": np.zeros(3) for axis in "XYZ"},
            **{f"s{axis}0": np.full(3, 0.01) for axis in "XYZ"}}  # fmt: skip
    rows |= {name: [None] * 3 for a in ("omega", "phi", "kappa") for name in (a, f"s{a}")}
    observed = {"camera": [camera.id], "parameter": ["c"], "value": [21.0], "sigma": [0.005]}
    tables = jaxbundle.add_further(network, exterior_priors=rows, camera_parameters=observed)
    sigma = network.images.sigma.copy()
    sigma[:3, :3] = 0.01
    columns = network.replace(
        images=dataclasses.replace(network.images, sigma=sigma),
        cameras=(dataclasses.replace(camera, sigma={"c": 0.005}),),
    )
    aims = []
    for given in (use_prior_tables(tables), columns, network):
        pairs = make_pairs(given, Aim(), jaxbundle.Conditions(), SIGMA)
        values = pairs.problem.data.start
        aims.append(pairs.aim_at(pairs.measured(values), values))
    assert aims[0] == pytest.approx(aims[1], rel=1e-9) and aims[0] != pytest.approx(aims[2])
    with pytest.raises(InputError, match="omit the other observations"):
        jaxbundle.design(jaxbundle.add_further(
            tables, velocities={"image": ids}, rolling_shutter={"line_time": 1e-5, "free": ["vX"]}
        ))  # fmt: skip


@pytest.mark.further
def test_an_aim_that_the_datum_decides_is_refused(network, site):
    refused(network, "depends on the datum", Aim("mean", (("point", "3", "Z"),)))
    refused(network.replace(datum="minimal"), "inner constraints")
    height = lambda values: values["point"][0, 2] - values["point"][1, 2]
    refused(network, "depends on the datum", Aim("mean", height))
    ratio = lambda v: (((v["point"][0] - v["point"][1]) ** 2).sum()
                       / ((v["point"][2] - v["point"][3]) ** 2).sum()).reshape(1)  # fmt: skip
    for aim in (Aim("mean", ratio), Aim("mean", (("camera", "cam", "c"),))):
        make_pairs(network, aim, site, SIGMA)


def test_units_of_cameras_are_not_mixed(network):
    camera = dataclasses.replace(network.cameras[0], free=("c", "K1"))
    refused(network.replace(cameras=(camera,)),
            "different units", Aim("mean", "cameras"))  # fmt: skip


@pytest.fixture
def project(page, tmp_path):
    """The planned project without observations."""
    folder = tmp_path / "planned"
    path = jaxbundle.write_project(page["planned"], folder)
    (folder / "observations.csv").unlink()
    text = path.read_text().replace('observations = "observations.csv"\n', "")
    path.write_text(text.replace("[project]\n", "[project]\nsigma_image = 0.002\n"))
    return folder


def test_from_project_to_project(command, project, tmp_path):
    out = tmp_path / "out"
    told = command(
        "design", project, "--room=-4,-4,0.2,4,4,3", "--distance", "1,6", "--apart", "0.4",
        "--iterations", "3", "--draws", "0", "--out", out,
    )  # fmt: skip
    assert told.status == 0, told.err
    assert "times smaller" in told.out and told.out == (out / "report.txt").read_text()
    result = json.loads((out / "design.json").read_text())
    fields = set(re.findall(r"`(\w+)`", " ".join(
        line.split("|")[1] for line in PAGE.splitlines() if line.startswith("| `")
    )))  # fmt: skip
    assert set(result) <= fields
    assert result["gain"] == pytest.approx(result["before"]["aim"] / result["after"]["aim"])
    written = jaxbundle.read_network(out)
    stations = result["stations"][written.images.id[2]]
    assert [stations[k] for k in ("X0", "Y0", "Z0")] == pytest.approx(written.images.position[2])
    assert len(written.observations) == result["after"]["image_points"]
    for name in ("before", "after", "path"):
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_refusals_in_one_line(command, project, tmp_path):
    normals = tmp_path / "normals.csv"
    normals.write_text("id,NX,NY,NZ\n1,0,0,1\n")
    for options, message in (
        (("--distance", "50,60", "--room=-4,-4,0.2,4,4,3"), "no station can satisfy"),
        (("--room", "1,2,3"), "6 numbers"),
        (("--of", "point:3:Z"), "depends on the datum"),
        (("--of", "camera"), "points, cameras"),
        (("--aim", "mena"), "did you mean 'mean'"),
        (("--incidence", "60"), "incidence needs the normals"),
        (("--incidence", "60", "--normals", normals), "no row for point '2'"),
        (("--order", "second"), "needs the number of candidates"),
        (("--stations", "1,77"), "there is no image '77'"),
        (("--order", "zero", "--photographs", "2", "--aim", "reliability"), "order \"zero\""),
    ):
        told = command("design", project, *options, "--draws", "0")
        assert told.status == 2 and message in told.err, (options, told.err)
        assert told.err.count("\n") == 1


def test_normals_of_a_table(command, project, tmp_path):
    """Targets that all look down are seen from nowhere above."""
    normals = tmp_path / "normals.csv"
    rows = [f"{k},0,0,-1" for k in range(1, 11)]
    normals.write_text("\n".join(["id,NX,NY,NZ", *rows]))
    told = command("design", project, "--incidence", "60", "--normals", normals,
                   "--room=-4,-4,1.5,4,4,3")  # fmt: skip
    assert told.status == 2 and 'the condition "incidence"' in told.err
