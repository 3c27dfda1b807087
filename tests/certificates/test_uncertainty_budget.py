"""The uncertainty budget after the GUM: against dense algebra, and the published example H.1."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from adjustment_checks import linearise, synthetic

import jaxbundle
from jaxbundle.adjustment import uncertainty_budget as uncertainty_budget_module
from jaxbundle.adjustment.adjust import adjust
from jaxbundle.adjustment.budget_inputs import BudgetLine, HeldInput, Measurand
from jaxbundle.adjustment.uncertainty_budget import (
    UncertaintyBudget,
    coverage_factor,
    uncertainty_budget,
)
from jaxbundle.errors import InputError

HELD = dict(images=5, points=10, fixed=4, held=((0, (3, 4, 5)), (1, (0,))))
"""As in test_budget.py, whose programs it shares."""
PARAMETERS = ("c", "x0", "y0", "K1")


def adjusted(noise, **changes):
    return adjust(synthetic(**{**HELD, "noise": noise, **changes})[0])


def published(ends=16):
    """The budget of an end gauge, GUM (JCGM 100:2008), H.1, table H.1 and H.1.6: nm."""
    line = lambda words, u, nu, kind="B": BudgetLine(
        words, 1, kind, "normal", nu, u, "nm", np.ones(1), np.array([u])
    )
    lines = (
        line("standard", 25.0, 18.0),
        line("difference", 9.7, 25.6, "A"),
        line("expansion", 2.9, 50.0),
        line("temperature", 16.6, 2.0),
    )
    gauge = Measurand("l", "length of the gauge", 50000838.0, "nm")
    none = {name: np.zeros(0) for name in ("kind", "image", "point", "axis", "uncertainty")}
    return UncertaintyBudget((gauge,), lines, 0.99, np.array([32.0]), none, np.zeros((0, 1)))


def test_the_published_example_of_an_end_gauge():
    """H.1.5: u_c = 32 nm; H.1.6: ν_eff = 16, t₀.₉₉(16) = 2.92, U = 93 nm."""
    found = published()
    assert round(found.combined[0]) == 32
    assert int(found.degrees[0]) == 16
    assert coverage_factor(0.99, 16) == pytest.approx(2.92, abs=0.005)
    # the example rounds u_c and truncates ν_eff: 2.92 · 32
    assert found.expanded[0] == pytest.approx(93, abs=1.5)


def test_coverage_factors_are_those_of_table_g2():
    """JCGM 100:2008, table G.2: t_p(ν) for 95 % and 95.45 %."""
    published = ((1, 12.71, 13.97), (5, 2.57, 2.65), (20, 2.09, 2.13), (100, 1.984, 2.025))
    for nu, t95, t9545 in published:
        assert coverage_factor(0.95, nu) == pytest.approx(t95, abs=0.005)
        assert coverage_factor(0.9545, nu) == pytest.approx(t9545, abs=0.006)
    assert coverage_factor(0.95, math.inf) == pytest.approx(1.960, abs=5e-4)


def test_the_sum_of_the_budget_is_the_covariance():
    """With residuals too small for the curvature: Σ(c·u)² is s²·N⁻¹, of the engine and dense."""
    # residuals in the measured image: those of the corrected one have σ of corrected coordinates
    result = adjusted(1e-6, held=(), domain="measured")
    budget = uncertainty_budget(result)
    names, C = result.camera_covariance("cam")
    assert names == [one.name.split(":")[2] for one in budget.measurands]
    np.testing.assert_allclose(budget.combined, np.sqrt(np.diag(C)), rtol=1e-6)
    np.testing.assert_allclose(budget.sigma, np.sqrt(np.diag(C)), rtol=1e-9)
    dense = linearise(result.problem, result.values)
    _, free = result.problem.free_parameters(0)
    Q = np.diag(dense.Q)[dense.columns["camera"][0][free]]
    np.testing.assert_allclose(budget.combined, result.sigma0 * np.sqrt(Q), rtol=1e-6)
    np.testing.assert_allclose(budget.degrees, result.redundancy, rtol=1e-9)
    # every single input: the sum of squares over the list of them
    for m, one in enumerate(budget.measurands):
        rows = budget.measurements(one.name)
        np.testing.assert_allclose((rows["contribution"] ** 2).sum(), budget.combined[m] ** 2)
    assert len(rows["image"]) == dense.J.shape[0]


def test_image_coordinates_have_the_unit_of_the_camera_model():
    """Measured in pixels, adjusted in the millimetres of the model."""
    network = synthetic(**{**HELD, "noise": 1.0})[0]
    result = adjust(network.replace(image_unit="px"))
    rows = result.residuals
    assert {*rows["unit"][rows["kind"] == "image"]} == {"mm"}
    assert result.variance_components["image coordinates"].unit == "mm"
    of_image = [line for line in uncertainty_budget(result).lines if "image" in line.words]
    assert of_image and {line.unit for line in of_image} == {"mm"}


@pytest.mark.further
def test_estimated_sigmas_have_the_redundancy_of_their_own_group():
    """Of control in X, Y, Z each; the priors of two stations are as stated."""
    changes = dict(fixed=0, control=4, held=(), distances=((5, 7), (6, 8)), domain="measured")
    network = synthetic(**{**HELD, "noise": 1.0, **changes})[0]
    result = adjust(network, estimate_components=True)
    components, factors = result.variance_components, result.sigma_factors
    lines = {line.words: line for line in uncertainty_budget(result).lines}
    estimated = [axis for axis in "XYZ" if factors.get(f"control points in {axis}", 1) != 1]
    assert estimated
    for axis in "XYZ":
        line = lines[f"control {axis}"]
        assert line.kind == ("A" if axis in estimated else "B")
        if axis in estimated:
            redundancy = components[f"control points in {axis}"].redundancy
            assert line.degrees == pytest.approx(redundancy)


@pytest.mark.further
@pytest.mark.parametrize(("noise", "tolerance"), [(1e-6, 1e-5), (1.0, 0.05)])
def test_types_of_inputs_are_kept_apart(noise, tolerance):
    """Image coordinates by their residuals, control and distances as stated: the law of
    propagation with the sensitivities of the estimate, in dense algebra; with residuals of one σ
    to the curvature, which is 3 % in this weak network."""
    changes = dict(fixed=0, control=4, held=(), distances=((5, 7), (6, 8)), domain="measured")
    result = adjusted(noise, **changes)
    budget = uncertainty_budget(result)
    dense = linearise(result.problem, result.values)
    kinds = result.residuals["kind"]
    image = kinds == "image"
    s = math.sqrt(
        ((result.residuals["v"] / result.residuals["sigma"])[image] ** 2).sum()
        / result.residuals["r"][image].sum()
    )
    of_image = np.concatenate([
        np.full(np.size(result.inspection.residuals[o.name]), o.name in result.problem.image_rows)
        for o in result.problem.observations
    ])  # fmt: skip
    # x = −N⁻¹·Jᵀ·v of weighted rows: one σ of a row changes x by a column of N⁻¹Jᵀ
    G = dense.Q @ dense.J.T * np.where(of_image, s, 1.0)
    _, free = result.problem.free_parameters(0)
    expected = np.sqrt((G**2).sum(1))[dense.columns["camera"][0][free]]
    np.testing.assert_allclose(budget.combined, expected, rtol=tolerance)
    assert {line.kind for line in budget.lines if "image" in line.words} == {"A"}
    assert {line.kind for line in budget.lines if "image" not in line.words} == {"B"}
    assert sum("distance" in line.words for line in budget.lines) == 2


def test_held_inputs_by_limits_and_their_degrees_of_freedom():
    """Their effects are those of the error budget; limits ± a are a/√3; ν of several parts."""
    result = adjusted(1.0)
    half, name = 3e-9, "camera:cam:K3"
    alone = uncertainty_budget(result)
    found = uncertainty_budget(result, held={name: HeldInput.from_limits(half)})
    effects = jaxbundle.sensitivity(result, {name: half / math.sqrt(3)}, of="cameras").effects[0]
    np.testing.assert_allclose(found.combined**2, alone.combined**2 + effects**2)
    line = found.lines[-1]
    assert (line.kind, line.distribution) == ("B", "rectangular") and math.isinf(line.degrees)
    np.testing.assert_allclose(line.sensitivity * half / math.sqrt(3), effects)
    share = (alone.combined / found.combined) ** 4
    np.testing.assert_allclose(found.degrees, alone.degrees / share)
    known = uncertainty_budget(result, held={name: HeldInput(half / math.sqrt(3), degrees=4)})
    other = (effects / found.combined) ** 4
    np.testing.assert_allclose(known.degrees, 1 / (share / alone.degrees + other / 4))
    assert (known.k > found.k).all()
    assert HeldInput.from_expanded(2.0, 2.0).uncertainty == 1.0
    with pytest.raises(InputError, match="one of normal, rectangular"):
        HeldInput(1.0, "flat")
    with pytest.raises(InputError, match="degrees must be a positive number"):
        HeldInput(1.0, degrees=0)


@pytest.mark.further
def test_the_sensitivity_is_how_the_adjustment_follows_an_input():
    """With large residuals: shifting one measurement, and adjusting again."""
    result = adjusted(3.0)
    budget = uncertainty_budget(result, "camera:cam:c")
    rows = budget.measurements()
    ids, points = result.network.images.id, result.network.points.id
    network = result.network
    for k in (0, 3):
        ray = np.flatnonzero(
            (network.observations.image == ids.index(rows["image"][k]))
            & (network.observations.point == points.index(rows["point"][k]))
        )[0]
        column = "xy".index(rows["axis"][k])
        found = []
        for sign in (1, -1):
            xy = network.observations.xy.copy()
            xy[ray, column] += sign * 1e-4
            moved = network.replace(
                observations=jaxbundle.network.tables.Observations(
                    network.observations.image, network.observations.point, xy,
                    network.observations.sigma,
                )
            )  # fmt: skip
            found.append(adjust(moved, second_minimum=False).camera_parameters("cam")["c"])
        slope = (found[0] - found[1]) / 2e-4
        assert slope == pytest.approx(rows["sensitivity"][k], rel=2e-4)


def test_values_units_and_functions():
    result = adjusted(1.0)
    P = result.points
    budget = uncertainty_budget(result, ("point:P7:Z", "image:image 2:phi", "camera:cam:x0"))
    z, phi, x0 = budget.measurands
    row = list(P["id"]).index("P7")
    assert z.value == pytest.approx(P["Z"][row], abs=1e-12) and z.unit == "m"
    assert phi.value == pytest.approx(result.images["phi"][2]) and phi.unit == "rad"
    assert x0.unit == "mm" and x0.value == result.camera_parameters("cam")["x0"]
    distance = lambda values: jnp.linalg.norm(values["point"][7] - values["point"][8])
    of = uncertainty_budget(result, distance, units="m")
    assert of.measurands[0].value == pytest.approx(
        np.linalg.norm(result.point_values[7] - result.point_values[8])
    )
    assert of.measurands[0].unit == "m"
    for wrong, why in (("points", "a mean over all has no budget"), ("camera:cam:K9", "K9")):
        with pytest.raises(InputError, match=why):
            uncertainty_budget(result, wrong)
    with pytest.raises(InputError, match="between 0 and 1"):
        uncertainty_budget(result, coverage=95)
    with pytest.raises(InputError, match="adjust or jaxbundle.calibrate"):
        uncertainty_budget(3)


def test_independent_errors_of_size_zero_add_nothing(convergent4, monkeypatch):
    """Where shared components explain all errors, the unit of weight must not stand for them."""
    of_unit = uncertainty_budget(convergent4)
    monkeypatch.setattr(uncertainty_budget_module, "image_scale", lambda _: (0.0, 23.0))
    of_zero = uncertainty_budget(convergent4)
    assert (of_unit.combined > 0).all()
    np.testing.assert_array_equal(of_zero.combined, 0.0)


@pytest.mark.further
def test_errors_that_image_points_share_are_lines_of_their_own(convergent4):
    """Of a model whose components are known, the sum is the covariance under it."""
    rng = np.random.default_rng(5)
    stations = jaxbundle.ring_of_stations(10, 3.0, 3.0, roll_every=2)
    targets = jaxbundle.cloud_of_targets(30, (2.0, 2.0, 0.8), seed=3)
    camera = jaxbundle.Camera("cam", "brown", {"c": 20.0}, ("c", "x0", "y0"))
    network = jaxbundle.simulate(stations, targets, camera, noise=1e-3, seed=2)
    # an affine distortion of each photograph: orientations do not take it up
    rays, affine = network.observations, 3e-4 * rng.standard_normal((10, 1))
    moved = jaxbundle.network.tables.Observations(
        rays.image, rays.point, rays.xy * (1 + affine[rays.image] * [1, -1]), rays.sigma
    )
    result = jaxbundle.adjust(network.replace(observations=moved), correlated=True)
    budget = uncertainty_budget(result)
    stated = result.correlated_camera_covariance("cam")
    # a budget states degrees of freedom; a covariance is wider instead
    result.keep(result.error_model.as_estimated, None)
    C = result.correlated_camera_covariance("cam")
    assert (np.diag(stated) > np.diag(C)).all()
    shared = [line for line in budget.lines if "shared" in line.words]
    assert shared and all(1 <= line.degrees < 1000 for line in shared)
    np.testing.assert_allclose(budget.sigma, np.sqrt(np.diag(C)), rtol=1e-6)
    # the independent part has the exact derivatives, the components those of the covariance
    np.testing.assert_allclose(budget.combined, budget.sigma, rtol=0.02)


def test_it_prints_and_is_a_table(convergent4):
    budget = jaxbundle.uncertainty_budget(convergent4)
    text = str(budget)
    assert "c of camera cam" in text and "ν_eff" in text
    columns = budget.table()
    assert len({len(c) for c in columns.values()}) == 1
    whole = columns["input"] == "combined"
    np.testing.assert_allclose(columns["contribution"][whole], budget.combined)
    for m, one in enumerate(budget.measurands):
        own = (columns["measurand"] == one.name) & ~whole
        np.testing.assert_allclose(columns["share"][own].sum(), 1)
        value, U = (float(x) for x in budget.result_rows()[m][1:3])
        assert abs(value - one.value) <= U and U == pytest.approx(budget.expanded[m], rel=0.06)


def test_u_and_U_have_one_form(convergent4):
    budget = jaxbundle.uncertainty_budget(convergent4, of=("camera:cam:c", "camera:cam:K3"))
    for one, row in zip(budget.measurands, budget.result_rows()):
        assert ("e" in row[2]) == ("e" in row[4]), one.words
        # U = k·u, within the digits that are shown
        assert float(row[2]) == pytest.approx(float(row[5]) * float(row[4]), rel=0.06)
