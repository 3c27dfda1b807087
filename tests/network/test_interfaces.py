"""Cameras behind windows and domes, and above water."""

import dataclasses

import numpy as np
import pytest
from further_checks import check_jacobians, sample

import jaxbundle
from jaxbundle.adjustment.quality.fixed_quantities import find_causes
from jaxbundle.cli.budget_option import held_of
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.io.results.result_project import adjusted_network, readjustable_network
from jaxbundle.planning.stations import Stations

WATER, GLASS = 1.334, 1.49
SIGMA = 0.002
CAMERA = jaxbundle.Camera("cam", "brown", {"c": 20.0}, ())
FLAT = {"interface": "window", "type": "flat", "camera": "cam", "Z": -0.03, "omega": 0.02,
        "phi": -0.01, "index": WATER, "thickness": 0.01, "index_window": GLASS}  # fmt: skip
DOME = {"interface": "dome", "type": "dome", "camera": "cam", "X": 0.004, "Y": -0.003, "Z": 0.006,
        "radius": 0.07, "index": WATER, "thickness": 0.006, "index_window": GLASS}  # fmt: skip
SURFACE = {"interface": "water", "type": "flat", "Z": 1.0, "index": WATER, "omega": 0.0}


@pytest.fixture(scope="module")
def dived():
    """Eight stations around 40 targets, four of them control; under water."""
    return jaxbundle.simulate_with_truth(
        jaxbundle.ring_of_stations(8, radius=2.0, height=1.0, roll_every=2),
        jaxbundle.cloud_of_targets(40, 0.8, seed=4), CAMERA, noise=SIGMA, seed=2,
        datum="control", control=[0, 9, 18, 27], control_sigma=0.0005, disturb=(0.01, 0.003, 0.01),
    )  # fmt: skip


@pytest.fixture(scope="module")
def above():
    """Nine cameras of a rig above a tank, looking down; targets in the water, and two on its
    edge."""
    x = np.linspace(-0.6, 0.6, 3)
    grid = np.stack(np.meshgrid(x, x, [2.2]), -1).reshape(-1, 3)
    stations = Stations(grid, np.random.default_rng(5).uniform(-0.15, 0.15, (9, 3)))
    X = np.random.default_rng(7).uniform([-1, -1, -0.5], [1, 1, 0.8], (60, 3))
    X[:3] = [[-0.9, 0.8, 1.05], [0.9, 0.7, 1.1], [0.1, -0.9, 1.08]]
    return jaxbundle.simulate_with_truth(
        stations, X, CAMERA, noise=SIGMA, seed=2, datum="control", control=[0, 1, 2],
        control_sigma=0.0005, disturb=(0.01, 0.003, 0.01),
    )  # fmt: skip


def with_interfaces(network, *rows):
    return jaxbundle.add_further(network, interfaces=list(rows))


def refracted(made, truth_row, row=None):
    """The network with image points through the true interface, and another one given."""
    network = with_interfaces(made.network, truth_row)
    network = jaxbundle.simulate_further(network, made.truth)
    return network if row is None else with_interfaces(network, row)


def snell(d, normal, ratio):
    cosine = d @ normal
    return ratio * d + (np.sqrt(1 - ratio**2 * (1 - cosine**2)) - ratio * cosine) * normal


def trace(row, pose, d):
    """A ray in the camera as point and direction behind its interface, object space; by Snell's
    law at the places where it meets the planes or spheres."""
    X0, M = pose
    n1, n2, n3 = 1.0, row.get("index_window", row["index"]), row["index"]
    place = np.array([row.get(k, 0.0) for k in "XYZ"])
    angles = np.array([row.get("omega", 0.0), row.get("phi", 0.0), 0.0])
    tilt = np.asarray(matrix_from_omega_phi_kappa(angles))
    at = np.zeros(3)
    if "camera" not in row:
        at, d = X0, M.T @ d
    t = row.get("thickness", 0.0)
    for radius, n, n_next in ((row.get("radius"), n1, n2), (row.get("radius", 0) + t, n2, n3)):
        if row["type"] == "dome":
            b = d @ (place - at)
            at = at + d * (b + np.sqrt(b**2 - (place - at) @ (place - at) + radius**2))
            normal = (at - place) / radius
        else:
            normal = -tilt[2]
            at = at + d * (normal @ (place - at)) / (normal @ d)
            place = place + t * normal
        d = snell(d, normal, n / n_next)
    return (X0 + M.T @ at, M.T @ d) if "camera" in row else (at, d)


@pytest.mark.parametrize("case, row", [("dived", FLAT), ("dived", DOME), ("above", SURFACE)])
def test_simulated_image_points_see_their_points_by_snells_law(request, case, row):
    made = request.getfixturevalue(case)
    network = refracted(made, row)
    noise = made.network.observations.xy - made.truth.observations.xy
    xy, truth = network.observations.xy - noise, made.truth
    for ray in range(0, len(xy), 7):
        image, point = (x[ray] for x in (truth.observations.image, truth.observations.point))
        d = np.array([*xy[ray], -20.0]) / np.linalg.norm([*xy[ray], 20.0])
        M = np.asarray(matrix_from_omega_phi_kappa(truth.images.angles[image]))
        at, along = trace(row, (truth.images.position[image], M), d)
        away = truth.points.position[point] - at
        if case == "above" and truth.points.position[point, 2] > 1:
            continue  # above the water
        assert np.linalg.norm(np.cross(along, away)) < 1e-9
    assert np.abs(xy - truth.observations.xy).max() > 0.1  # it is seen


@pytest.mark.parametrize("case, row, spread", [
    ("dived", FLAT, {"sZ": 0.01, "somega": "free", "sphi": "free", "sindex": "free"}),
    pytest.param("dived", DOME, {"sX": "free", "sY": "free", "sZ": "free", "sindex": 0.01},
                 marks=pytest.mark.further),
    pytest.param("above", SURFACE, {"sZ": "free", "somega": "free", "sphi": "free",
                                    "sindex": "free"}, marks=pytest.mark.further),
])  # fmt: skip
def test_what_is_free_is_found(request, case, row, spread):
    """From start values that are off, the truth within 4 σ; what is weighted stays near."""
    made = request.getfixturevalue(case)
    off = {"Z": row["Z"] + 0.004, "index": 1.33}
    if case == "above":
        off = {"Z": 1.05, "omega": 0.01, "phi": -0.01, "index": 1.33}
    network = refracted(made, row, row | off | spread)
    result = jaxbundle.adjust(network)
    assert result.converged and 0.85 < result.sigma0 < 1.15
    found = {name: next(iter(rows.values())) for name, rows in result.further_unknowns.items()}
    media = found.pop("medium")
    (geometry,) = found.values()
    assert abs(media["index"]["value"] - WATER) < 4 * media["index"]["sigma"]
    for name in ("X", "Y", "Z", "omega", "phi"):
        if f"s{name}" in spread:
            one = geometry.get(f"{name}0", geometry.get(name))
            truth = row.get(name, 0.0) if name != "omega" or case != "above" else 0.0
            assert 0 < one["sigma"] and abs(one["value"] - truth) < 4 * one["sigma"], name
    X = made.truth.points.position
    difference = np.linalg.norm(result.point_values - X, axis=1)
    assert np.median(difference) < 2e-3
    assert "Medium" in result.report()
    if case == "above":  # without the interface the same image points do not fit
        straight = jaxbundle.adjust(network.replace(further=()))
        assert not straight.converged or straight.sigma0 > 10 * result.sigma0


@pytest.mark.further
@pytest.mark.parametrize("case, row, spread", [
    ("dived", FLAT, {"sZ": "free", "somega": "free", "sphi": "free", "sindex": "free"}),
    ("above", SURFACE, {"sZ": "free", "somega": "free", "sphi": "free", "sindex": "free"}),
    ("dived", DOME, {"sX": "free", "sY": "free", "sZ": "free", "sindex": 0.002}),
])  # fmt: skip
def test_sigma_is_that_of_a_sample(request, case, row, spread):
    """200 draws of everything measured."""
    made = request.getfixturevalue(case)
    exact = refracted(dataclasses.replace(made, network=made.truth), row, row | spread)
    problem = jaxbundle.make_problem(exact)
    name = problem.further_tables[0]
    found = sample(problem, problem.data.start, (name, "medium"), draws=200)
    result = jaxbundle.adjust(refracted(made, row, row | spread))
    unknowns = {k: next(iter(v.values())) for k, v in result.further_unknowns.items()}
    drawn = {"index": found["medium"][:, 0, 2]}
    drawn |= {f"{axis}0": found[name][:, 0, k] for k, axis in enumerate("XYZ")}
    estimated = unknowns[name] | unknowns["medium"]
    sigma = {k: one["sigma"] / result.sigma0 for k, one in estimated.items()}
    # a plane moves along its normal alone: X and Y of its point follow from its tilt
    of = [k for k in sigma if k in drawn and (k[0] not in "XY" or case == "dived")]
    ratio = {k: drawn[k].std(ddof=1) / sigma[k] for k in of}
    assert all(0.88 < r < 1.12 for r in ratio.values()), ratio


def test_jacobians(dived):
    network = refracted(dived, FLAT, FLAT | {"sZ": 0.01, "somega": 0.1, "sphi": 0.1, "sindex": 0.1})
    problem = jaxbundle.make_problem(network)
    check_jacobians(problem, problem.data.start, skip=())
    network = refracted(dived, DOME, DOME | {"sX": 0.01, "sindex": 0.1, "sradius": 0.01})
    problem = jaxbundle.make_problem(network)
    check_jacobians(problem, problem.data.start, skip=())


def test_start_values_through_a_window(dived):
    """None given: those of rays behind the window."""
    network = refracted(dived, FLAT)
    nan = lambda x, *names: dataclasses.replace(
        x, **{n: np.full_like(getattr(x, n), np.nan) for n in names}
    )
    tie = network.points.has_role("tie")[:, None]
    points = dataclasses.replace(
        network.points, position=np.where(tie, np.nan, network.points.position)
    )
    images = nan(network.images, "position", "angles")
    result = jaxbundle.adjust(network.replace(images=images, points=points))
    assert result.converged and len(result.images["id"]) == 8 and 0.85 < result.sigma0 < 1.15


@pytest.mark.parametrize("row", [FLAT, pytest.param(DOME, marks=pytest.mark.further)])
def test_a_camera_without_an_interface_beside_one_with(row):
    """In the air and in the water: the dry camera sees as it would alone."""
    dry = dataclasses.replace(CAMERA, id="dry")
    made = jaxbundle.simulate_with_truth(
        jaxbundle.ring_of_stations(4, radius=2.0, height=1.0),
        jaxbundle.cloud_of_targets(20, 0.8, seed=4), [CAMERA, dry],
        camera_of_station=[0, 1, 0, 1], noise=SIGMA, seed=2,
        datum="control", control=[0, 5, 10, 15], control_sigma=0.0005,
    )  # fmt: skip
    network = refracted(made, row)
    of_dry = network.images.camera[network.observations.image] == 1
    change = np.abs(network.observations.xy - made.network.observations.xy).max(1)
    assert change[of_dry].max() < 1e-13 < 1e-3 < np.median(change[~of_dry])
    result = jaxbundle.adjust(network)
    assert result.converged and 0.8 < result.sigma0 < 1.2


@pytest.mark.further
def test_a_surface_moves_with_a_free_network_and_a_held_one_fixes_it(above):
    """Inner datum: a free surface leaves the seven of a similarity open; a held one gives its
    height and tilts; two shifts, a rotation and the scale stay open."""
    free = SURFACE | {"sZ": "free", "somega": "free", "sphi": "free"}
    tie = dataclasses.replace(
        above.truth.points, role=("tie",) * len(above.truth.points),
        sigma=np.full_like(above.truth.points.sigma, np.nan),
    )  # fmt: skip
    network = refracted(above, SURFACE, free).replace(points=tie, datum="inner")
    assert jaxbundle.make_problem(network).counts.datum == 7
    held = with_interfaces(network, SURFACE)
    assert jaxbundle.make_problem(held).counts.datum == 4
    one, two = jaxbundle.adjust(network), jaxbundle.adjust(held)
    assert one.redundancy == two.redundancy and one.sigma0 == pytest.approx(two.sigma0, rel=1e-6)


@pytest.mark.parametrize("change, message", [
    ({"type": "flt"}, "type is 'flt'; did you mean 'flat'"),
    ({"camera": "cma"}, "camera 'cma' is unknown; did you mean 'cam'"),
    ({"index": 133.0}, "index is 133; expected an index of refraction"),
    ({"index": None}, "index is missing"),
    ({"thickness": None}, "both or neither"),
    ({"index_window": None}, "both or neither"),
    ({"radius": 0.1}, "a flat interface has no radius"),
    ({"sX": 0.1}, "a flat interface has no sX"),
    ({"Z": 0.03}, "the camera looks along −z"),
    ({"sindex": -1.0}, "sindex is -1; it must be positive"),
    ({"sindex_camera": 0.1}, "sindex_camera is given, but no index_camera"),
    ({"distance": 1.0}, "unknown column 'distance'"),
    (DOME | {"radius": None}, "radius is missing"),
    (DOME | {"camera": None}, "camera is missing: a dome is before one camera"),
    (DOME | {"X": 0.2}, "from the centre of its dome, outside of the radius"),
    (DOME | {"omega": 0.2}, "a dome interface has no omega"),
])  # fmt: skip
def test_what_is_wrong_is_named(dived, change, message):
    row = change if change.get("type") == "dome" else FLAT | change
    with pytest.raises(InputError, match=message):
        with_interfaces(dived.network, row)


def test_the_error_of_a_held_index_has_no_unit(dived):
    """In a project in degrees an angle is one, an index of refraction is not."""
    network = with_interfaces(dived.network, FLAT).replace(angle_unit="deg")
    problem = jaxbundle.make_problem(network)
    held = {"medium:window:index": 1e-4, "flat port:window:omega": 1e-3}
    index, omega = find_causes(problem, {t.name: t.value for t in problem.tables}, held)
    assert not index.angle and omega.angle
    names = ("medium:window:index=1e-4", "flat port:window:omega=0.1")
    given = held_of(list(names), network)
    assert list(given.values()) == pytest.approx([1e-4, np.radians(0.1)])


def test_what_does_not_go_together_is_named(dived):
    network = dived.network
    with pytest.raises(InputError, match="a dome port, but a flat port in"):
        with_interfaces(network, FLAT, DOME)
    with pytest.raises(InputError, match="two interfaces before one camera"):
        with_interfaces(network, FLAT, FLAT | {"interface": "other"})
    with pytest.raises(InputError, match="interface 'window' is already in interfaces, row 1"):
        with_interfaces(network, FLAT, FLAT)
    moving = {"velocities": {"image": network.images.id}, "rolling_shutter": {"line_time": 1e-5}}
    with pytest.raises(InputError, match="velocities are for straight rays"):
        jaxbundle.add_further(network, interfaces=[FLAT], **moving)


@pytest.mark.parametrize("row", [FLAT | {"sZ": 0.01, "sphi": "free"}, DOME | {"sindex": "free"},
                                 SURFACE | {"sZ": "free"}])  # fmt: skip
def test_in_a_project_and_back(dived, tmp_path, row):
    network = with_interfaces(dived.network.replace(angle_unit="deg"), row)
    path = jaxbundle.write_project(network, tmp_path / "port")
    (again,) = jaxbundle.read_network(str(path)).further
    (one,) = network.further
    for name in ("value", "sigma"):
        np.testing.assert_allclose(getattr(again, name), getattr(one, name), rtol=1e-14)
    assert (again.interface, again.type, again.camera) == (one.interface, one.type, one.camera)


@pytest.mark.further
def test_the_adjusted_network_has_the_adjusted_interface(above):
    spread = {"sZ": 0.1, "somega": "free", "sphi": "free", "sindex": 0.01}
    result = jaxbundle.adjust(refracted(above, SURFACE, SURFACE | {"Z": 1.02} | spread))
    # a σ of the points is 5e-4; control has no part in the adjusted network
    again = jaxbundle.adjust(adjusted_network(result))
    np.testing.assert_allclose(again.point_values, result.point_values, atol=2e-5)
    (one,) = adjusted_network(result).further
    found = result.further_unknowns
    assert one.value[0, 2] == pytest.approx(found["interface"]["water"]["Z0"]["value"])
    assert np.isnan(one.sigma).all()
    whole = jaxbundle.adjust(readjustable_network(result))
    np.testing.assert_allclose(whole.point_values, result.point_values, atol=1e-7)
    assert whole.sigma0 == pytest.approx(result.sigma0, rel=1e-6)


@pytest.mark.further
def test_predicted_precision_is_through_the_interface(above):
    """σ of a design, which predicts its image points, is that of the adjusted network."""
    network = refracted(above, SURFACE, SURFACE | {"sZ": "free", "sindex": 0.01})
    problem = jaxbundle.make_problem(network)
    result = jaxbundle.adjust(network)
    data = dataclasses.replace(problem.data, start=result.values)
    found = jaxbundle.precision(problem, data)
    sigma = np.stack([result.points[f"s{a}"] for a in "XYZ"], 1) / result.sigma0
    np.testing.assert_allclose(found.points, sigma, rtol=2e-3)


def test_an_interface_in_the_project_file(dived, tmp_path):
    """As an entry, and its σ from there."""
    path = jaxbundle.write_project(refracted(dived, FLAT).replace(further=()), tmp_path / "port")
    entry = "\n".join(f"{k} = {v!r}" for k, v in (FLAT | {"sZ": "free", "sindex": 0.002}).items())
    path.write_text(path.read_text() + f"\n[[interface]]\n{entry}\n")
    (one,) = jaxbundle.read_network(str(path)).further
    assert one.camera == ("cam",) and one.sigma[0, 2] == np.inf and one.sigma[0, 7] == 0.002
    assert np.isnan(one.sigma[0, 3:7]).all() and one.value[0, 6] == GLASS
