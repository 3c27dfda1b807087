"""GNSS and INS: projection centres and attitudes with lever arm, boresight, shifts and drifts."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from further_checks import check_jacobians, sample

import jaxbundle
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_omega_phi_kappa, quaternion_from_matrix
from jaxbundle.leastsquares.spaces import Pose, PoseValue, Rotation
from jaxbundle.network.build import make_further
from jaxbundle.network.kinds.antennas import antenna_misclosure
from jaxbundle.network.kinds.attitudes import ATTITUDE

ARM, TURN = np.array([0.3, -0.2, 0.8]), np.radians([0.4, -0.3, 0.6])
SHIFT = {"north": np.array([0.4, -0.2, 0.3]), "south": np.array([-0.1, 0.5, 0.2])}
DRIFT = {"north": np.array([0.01, 0.02, -0.01]), "south": np.array([-0.02, 0.0, 0.01])}
SIGMA, ANGLE_SIGMA = 0.02, np.radians(0.003)


@pytest.fixture(scope="module")
def flight():
    """Two strips flown in opposite directions over hilly ground, five control points; the truth."""
    stations = jaxbundle.aerial_block(
        strips=2, images_per_strip=5, height=100.0, footprint=(90.0, 60.0), forward_overlap=0.7,
        side_overlap=0.4,
    )  # fmt: skip
    random = np.random.default_rng(4)
    turns = random.uniform(-1, 1, (10, 3)) * [0.1, 0.1, 0.4]  # else a lever arm is a shift
    stations = dataclasses.replace(stations, angles=stations.angles + turns)
    return jaxbundle.simulate_with_truth(
        stations, random.uniform([-60, -60, -6], [60, 60, 6], (60, 3)),
        jaxbundle.Camera("cam", "brown", {"c": 40.0}, ("x0",)), noise=0.002, seed=3,
        image_format=(36.0, 24.0), datum="control", control=[0, 1, 2, 3, 4], control_sigma=0.02,
        disturb=(0.1, 0.001, 0.1),
    )  # fmt: skip


def measured(truth, seed=0, noise=1.0):
    """Tables of antennas and attitudes at the true images."""
    random, images = np.random.default_rng(seed), truth.images
    M = np.array([np.asarray(matrix_from_omega_phi_kappa(a)) for a in images.angles])
    strip = ["north" if k < len(M) // 2 else "south" for k in range(len(M))]
    t = 2.0 * np.arange(len(M))
    middle = {s: t[[x == s for x in strip]].mean() for s in SHIFT}
    place = images.position + M.transpose(0, 2, 1) @ ARM
    place += [SHIFT[s] + DRIFT[s] * (time - middle[s]) for s, time in zip(strip, t)]
    place += noise * SIGMA * random.normal(size=place.shape)
    antennas = {"image": images.id, "strip": strip, "t": t} | dict(zip("XYZ", place.T))
    antennas |= {f"s{a}": np.full(len(M), SIGMA) for a in "XYZ"}
    B = np.asarray(matrix_from_omega_phi_kappa(TURN))
    angles = np.array([
        np.asarray(jaxbundle.geometry.omega_phi_kappa_from_matrix(B.T @ m)) for m in M
    ]) + noise * ANGLE_SIGMA * random.normal(size=(len(M), 3))  # fmt: skip
    attitudes = {"image": images.id} | dict(zip(("omega", "phi", "kappa"), angles.T))
    return antennas, attitudes | {f"s{a}": np.full(len(M), ANGLE_SIGMA)
                                  for a in ("omega", "phi", "kappa")}  # fmt: skip


SECTIONS = {
    "antenna": {"free": ["ax", "ay", "az", "shift", "drift"]},
    "attitude": {"free": ["boresight"]},
}


def with_sensors(network, antennas, attitudes, **sections):
    given = {"antennas": antennas, **SECTIONS, "attitudes": attitudes} | sections
    if attitudes is None:
        given = {k: v for k, v in given.items() if not k.startswith("attitude")}
    further = make_further(given, 1.0)
    return network.replace(further=further)


@pytest.fixture(scope="module")
def result(flight):
    return jaxbundle.adjust(with_sensors(flight.network, *measured(flight.truth)))


def test_the_truth_is_found(flight, result):
    assert result.converged and 0.8 < result.sigma0 < 1.2
    found = result.further_unknowns
    expected = {"lever arm": {"cam": ARM}, "boresight": {"cam": TURN}}
    expected["GNSS strip"] = {s: [*SHIFT[s], *DRIFT[s]] for s in SHIFT}
    for table, rows in expected.items():
        for row, values in rows.items():
            for value, one in zip(values, found[table][row].values(), strict=True):
                assert 0 < one["sigma"] < 0.2
                assert abs(one["value"] - value) < 3.5 * one["sigma"], (table, row)
    assert found["GNSS clock"]["offset"]["seconds"]["sigma"] == 0
    # 10 images with 6 equations each; 3 + 3 + 12 unknowns.
    kinds = result.residuals["kind"]
    assert (kinds == "antenna positions").sum() == (kinds == "attitudes").sum() == 30
    assert result.residuals["r"].sum() == pytest.approx(result.redundancy, abs=1e-6)
    report = result.report()
    assert "Lever arm" in report and "Boresight" in report and "antenna positions" in report


def test_residuals_at_the_truth_are_those_of_the_formula(flight):
    """Exact data, true values: no residual, and M = ΔM·M_INS."""
    antennas, attitudes = measured(flight.truth, noise=0.0)
    network = with_sensors(
        flight.truth, antennas, attitudes, attitude={"boresight": list(TURN)},
        antenna={"lever_arm": list(ARM), "free": ["shift", "drift"]},
    )  # fmt: skip
    images = flight.truth.images
    declared = [f.declare(network, np.zeros(3)) for f in network.further]
    for row in range(len(images)):
        M = np.asarray(matrix_from_omega_phi_kappa(images.angles[row]))
        q = np.asarray(quaternion_from_matrix(M))
        pose = Pose().prepare(PoseValue(images.position[row], q))
        seen = declared[0].observations[0]
        strip = "north" if row < 5 else "south"
        v = antenna_misclosure(pose, ARM, (*SHIFT[strip], *DRIFT[strip]), (0.0,),
                    jax.tree.map(lambda x, row=row: x[row], seen.measured))  # fmt: skip
        np.testing.assert_allclose(v, 0, atol=1e-9)
        boresight = Rotation().prepare(declared[1].tables[0].value[0])
        given = jnp.asarray(declared[1].observations[0].measured[row])
        v = ATTITUDE.residual(pose, boresight, given)
        np.testing.assert_allclose(v, 0, atol=1e-9)


def test_they_are_simulated_as_the_formula_says(flight):
    """Measured again from the truth: as `measured` computes by hand, and with noise of their σ."""
    antennas, attitudes = measured(flight.truth, noise=0.0)
    by_hand = with_sensors(
        flight.network, antennas, attitudes, attitude={"boresight": list(TURN)},
        antenna={"lever_arm": list(ARM), "free": ["shift", "drift"]},
    )  # fmt: skip
    shifts = np.array([[*SHIFT[s], *DRIFT[s]] for s in ("north", "south")])
    unknowns, off = {"GNSS strip": shifts}, []
    for seed in range(8):
        made = jaxbundle.simulate_further(by_hand, flight.truth, unknowns=unknowns, seed=seed)
        off.append([(one.position - other.position) / SIGMA if k == 0 else
                    (one.angles - other.angles) / ANGLE_SIGMA
                    for k, (one, other) in enumerate(zip(made.further, by_hand.further))
                    ])  # fmt: skip
    off = np.array(off)
    assert np.abs(off.mean((0, 2, 3))).max() < 4 / np.sqrt(240)
    np.testing.assert_allclose(off.std((0, 2, 3)), 1, atol=4 / np.sqrt(480))
    with pytest.raises(InputError, match="there is no table 'GNSS'"):
        jaxbundle.simulate_further(by_hand, flight.truth, unknowns={"GNSS": shifts})


def test_jacobians(result):
    check_jacobians(result.problem, result.values)


def test_sigma_is_that_of_a_sample(flight, result):
    exact = with_sensors(flight.truth, *measured(flight.truth, noise=0.0))
    problem = jaxbundle.make_problem(exact)
    found = sample(problem, problem.data.start, ("lever arm", "GNSS strip"))
    for table, values in found.items():
        sigma = result.unknowns(table).sigma / result.sigma0
        ratio = values.std(0) / sigma
        assert (np.abs(ratio - 1) < 4 / np.sqrt(2 * len(values))).all(), (table, ratio)


def test_free_shifts_leave_the_place_of_a_network_open(flight):
    """No control, every strip with a shift: scale and rotations are those of GNSS, the place is
    given by inner constraints; with a prior of the shifts nothing is open."""
    points = flight.network.points
    network = flight.network.replace(
        points=dataclasses.replace(points, role=("tie",) * len(points)), datum="inner"
    )  # fmt: skip
    antenna = {"lever_arm": list(ARM), "free": ["shift"]}  # drifts would take scale and turns
    problem = jaxbundle.make_problem(
        with_sensors(network, *measured(flight.truth), antenna=antenna)
    )  # fmt: skip
    assert problem.counts.datum == 3
    antenna |= {"sigma": {"shift": 1.0}}
    known = jaxbundle.make_problem(
        with_sensors(network, *measured(flight.truth), antenna=antenna)
    )  # fmt: skip
    assert known.counts.datum == 0


@pytest.mark.further
def test_a_lever_arm_that_never_turns_is_named(flight, result):
    """Positions of one image of each strip: the lever arm is a shift of the strip, exactly."""
    antennas, attitudes = measured(flight.truth)
    shown = np.repeat([0, 9], 5)  # the same two, the shapes of the others
    shown = {k: np.array(v, dtype=object)[shown] for k, v in antennas.items()}
    network = with_sensors(flight.network, shown, attitudes)
    found = jaxbundle.adjust(network)
    names = " ".join(map(str, found.undetermined)) + " ".join(found.warnings)
    assert "lever arm" in names or "GNSS strip" in names


@pytest.mark.further
def test_antennas_give_the_frame(flight):
    """No control, no start values: the places of the antennas are the datum."""
    network, images = flight.network, flight.network.images
    nowhere = dataclasses.replace(images, position=np.full((10, 3), np.nan),
                                  angles=np.full((10, 3), np.nan))  # fmt: skip
    points = dataclasses.replace(
        network.points, role=("tie",) * len(network.points),
        position=np.full((len(network.points), 3), np.nan),
    )  # fmt: skip
    antennas, attitudes = measured(flight.truth)
    offset = np.array([[(SHIFT if s == "north" else SHIFT)[s] for s in antennas["strip"]]])[0]
    drift = [DRIFT[s] for s in antennas["strip"]]
    t = np.array(antennas["t"])
    strips = np.array(antennas["strip"])
    since = t - np.array([t[strips == s].mean() for s in strips])
    place = np.stack([antennas[a] for a in "XYZ"], 1) - offset - drift * since[:, None]
    antennas |= dict(zip("XYZ", place.T))
    network = with_sensors(
        network.replace(images=nowhere, points=points), antennas, attitudes,
        antenna={"lever_arm": list(ARM)}, attitude={"boresight": list(TURN)},
    )  # fmt: skip
    result = jaxbundle.adjust(network)
    assert result.converged and result.counts.datum == 0
    off = (result.point_values - flight.truth.points.position[: len(result.point_values)])
    sigma = np.sqrt(np.diagonal(result.point_covariance, axis1=1, axis2=2))
    assert np.abs(off / sigma).max() < 5


def test_a_project_keeps_them(flight, tmp_path, result):
    network = with_sensors(flight.network, *measured(flight.truth))
    path = jaxbundle.write_project(network.replace(angle_unit="deg"), tmp_path / "flight")
    again = jaxbundle.read_network(path)
    assert [type(f) for f in again.further] == [type(f) for f in network.further]
    for one, other in zip(network.further, again.further):
        for name, column in one.columns(1.0).items():
            if isinstance(column, tuple):
                assert column == other.columns(1.0)[name]
            else:
                np.testing.assert_allclose(column, other.columns(1.0)[name], rtol=1e-14)
    overrides = ["antenna.free=shift", "antenna.sigma.shift=0.3"]
    changed = jaxbundle.read_network(path, overrides=overrides)
    assert changed.further[0].settings["free"] == ["shift"]
    assert changed.further[0].settings["sigma"] == {"shift": 0.3}


@pytest.mark.parametrize("change, message", [
    ({"image": "IMG 99"}, "row 1: image 'IMG 99' is unknown"),
    ({"sX": -1.0}, "row 1: sX is -1"),
    ({"t": np.nan}, "row 1: t is missing"),
    ({"rXY": 1.5}, "row 1: the correlations"),
])  # fmt: skip
def test_what_is_wrong_is_named(flight, change, message):
    antennas, _ = measured(flight.truth)
    ((name, value),) = change.items()
    column = list(antennas.get(name, [0.0] * len(antennas["X"])))
    antennas[name] = [value, *column[1:]]
    with pytest.raises(InputError, match=message):
        network = with_sensors(flight.network, antennas, None)
        network.further[0].check(network)


def test_unknown_settings_are_refused(flight):
    antennas, _ = measured(flight.truth)
    with pytest.raises(InputError, match=r"\[antenna\]: unknown key 'leverarm'; did you mean"):
        with_sensors(flight.network, antennas, None, antenna={"leverarm": [0, 0, 0]})


@pytest.mark.parametrize("setting, message", [
    ("antenna.fre=shift", "unknown key 'fre'; did you mean 'free'"),
    ("antenna.sigma=3", "sigma is 3.0; expected a table of names and numbers"),
    ("antenna.free=3", "unknown 3.0"),
    ("antenna.sigma.shift=abc", "sigma of shift must be a positive number, but is 'abc'"),
    ("antenna.lever_arm=abc", "lever_arm is 'abc'; expected 3 numbers"),
    ("rolling_shutter.line_time=1e-5", "given, but no table velocities"),
])  # fmt: skip
def test_settings_that_cannot_be_end_in_a_line(flight, tmp_path, setting, message):
    network = with_sensors(flight.network, *measured(flight.truth))
    path = jaxbundle.write_project(network, tmp_path / "flight")
    with pytest.raises(InputError, match=message):
        jaxbundle.make_problem(jaxbundle.read_network(path, overrides=[setting]))


@pytest.mark.further
def test_a_budget_of_lever_arm_and_boresight(flight):
    """Against adjustments with the held lever arm, or a held angle of the boresight, changed."""
    sensors = measured(flight.truth)

    def adjusted(arm=ARM, turn=TURN):
        held = {"antenna": {"lever_arm": list(arm), "free": ["shift", "drift"]},
                "attitude": {"boresight": list(turn)}}  # fmt: skip
        return jaxbundle.adjust(with_sensors(flight.network, *sensors, **held))

    unit = np.eye(3)
    cases = {
        "lever arm:cam:az": (0.02, lambda h: adjusted(arm=ARM + h * unit[2])),
        "boresight:cam:phi": (1e-4, lambda h: adjusted(turn=TURN + h * unit[1])),
    }
    found = adjusted()
    budget = jaxbundle.sensitivity(found, {name: step for name, (step, _) in cases.items()})
    names = [one.name for one in budget.results]
    for effects, (step, again) in zip(budget.effects, cases.values()):
        ends = [again(sign * step) for sign in (1, -1)]
        plus, minus = (end.camera_parameters("cam")["x0"] for end in ends)
        change = (plus - minus) / 2
        assert effects[names.index("camera:cam:x0")] == pytest.approx(change, rel=1e-2, abs=1e-7)
        moved = (ends[0].image_values - ends[1].image_values) / 2
        known = np.sqrt((moved**2).mean(0))
        at = [names.index(f"images:{p}") for p in ("X0", "Y0", "Z0", "omega", "phi", "kappa")]
        assert (np.abs(effects[at] - known) < 1e-2 * known + 2e-3 * budget.sigma[at]).all()
