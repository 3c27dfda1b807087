"""Length measurement errors by hand, as in VDI/VDE 2634-1 and ISO 14253-1; accuracy of ASPRS."""

import dataclasses

import numpy as np
import pytest

import jaxbundle
from jaxbundle.certificates.lengths import (
    CONFORMS,
    FAILS,
    OPEN,
    CalibratedLengths,
    LengthTest,
    PermissibleError,
    join_length_tests,
    length_errors,
    read_lengths,
    read_mpe,
)
from jaxbundle.certificates.positional import PositionalAccuracy, positional_accuracy
from jaxbundle.certificates.quantities import find_quantity
from jaxbundle.errors import InputError


def length_test(errors, sigma, mpe=None, **changes):
    n = len(errors)
    lengths = CalibratedLengths(
        tuple((f"A{i}", f"B{i}") for i in range(n)), np.arange(1.0, n + 1),
        np.full(n, sigma), tuple(f"line {i // 5}" for i in range(n)),
    )  # fmt: skip
    return LengthTest(
        lengths, lengths.value + errors, np.full(n, 1e-5), "m", 2.0 * n, mpe, **changes
    )


def test_errors_by_hand():
    """E = l_m − l_k; the characteristic is the largest |E|, not the mean."""
    test = length_test(np.array([3e-5, -8e-5, 1e-5]), 0.0)
    np.testing.assert_allclose(test.error, [3e-5, -8e-5, 1e-5], atol=1e-12)
    assert test.largest == pytest.approx(8e-5, rel=1e-9)
    assert test.rms == pytest.approx(np.sqrt((9 + 64 + 1) / 3) * 1e-5, rel=1e-9)
    assert test.verdict == "" and test.verdicts == ()


@pytest.mark.parametrize(
    ("error", "verdict"),
    [
        (40e-6, CONFORMS),
        (-40e-6, CONFORMS),
        (43e-6, OPEN),
        (57e-6, OPEN),
        (59e-6, FAILS),
        (-59e-6, FAILS),
    ],
)
def test_the_decision_rule_of_iso_14253(error, verdict):
    """MPE 50 µm, u = 5 µm: g = 1.645 · 5 = 8.2 µm: conformity to 41.8, nonconformity from 58.2."""
    mpe = PermissibleError(50e-6)
    test = length_test(np.array([error]), 5e-6, mpe)
    assert test.guard_band[0] == pytest.approx(8.224e-6, rel=1e-3)
    assert test.verdicts == (verdict,) and test.verdict == verdict
    simple = dataclasses.replace(test, rule="simple acceptance")
    assert simple.verdict == (CONFORMS if abs(error) <= 50e-6 else FAILS)


def test_one_length_that_fails_fails_the_test():
    mpe = PermissibleError(50e-6)
    assert length_test(np.array([10e-6, 90e-6, 50e-6]), 5e-6, mpe).verdict == FAILS
    assert length_test(np.array([10e-6, 20e-6, 50e-6]), 5e-6, mpe).verdict == OPEN


def test_a_permissible_error_is_read():
    """min(A + L/K, B), the forms of ISO 10360-2."""
    assert read_mpe("50 um", "mm")(np.array([1000.0])) == pytest.approx(0.05)
    mpe = read_mpe("20 um + L/50000, max 0.05 mm", "m")
    np.testing.assert_allclose(mpe(np.array([0.5, 1.0, 9.0])), [30e-6, 40e-6, 50e-6])
    for text in ("50", "L/1000", "50 deg", "50 um + L", "50 um +", ""):
        with pytest.raises(InputError, match="MPE"):
            read_mpe(text, "m")
    with pytest.raises(InputError, match="is no length"):
        read_mpe("50 um", "model")


def test_the_arrangement_that_vdi_wants():
    """Seven lines of five lengths, the longest two thirds of the diagonal."""
    test = length_test(np.zeros(35), 0.0)
    assert [met for *_, met in test.requirements()] == [True, True, False]
    wide = dataclasses.replace(test, diagonal=50.0)
    assert [met for *_, met in wide.requirements()] == [True, True, True]
    # Three repetitions of a length are one length of its line, and are listed.
    repeated = join_length_tests([test] * 3)
    assert repeated.requirements()[:3] == test.requirements()
    assert repeated.requirements()[3][1:] == ("≥ 3", "3", True)
    twice = join_length_tests([test, length_test(np.zeros(34), 0.0)])
    assert twice.requirements()[3][2:] == ("1", False)
    few = length_test(np.zeros(9), 0.0)
    assert [met for *_, met in few.requirements()][:2] == [False, False]


def test_repetitions_are_joined(convergent4):
    one, two = length_test(np.array([1e-5]), 1e-6), length_test(np.array([-9e-5]), 1e-6)
    joined = join_length_tests([one, two, one])
    assert joined.largest == pytest.approx(9e-5)
    # The characteristic that criteria name is the same, wherever the worst repetition stands.
    (error,) = find_quantity(convergent4, joined, "LME", "").values.values()
    assert error == pytest.approx(9e-5)
    with pytest.raises(InputError, match="one unit"):
        join_length_tests([one, dataclasses.replace(two, unit="mm")])
    with pytest.raises(InputError, match="at least one"):
        join_length_tests([])


def test_lengths_of_an_adjustment(field):
    result, targets = field
    pairs = [(12, 13), (13, 14), (15, 19)]
    true = [np.linalg.norm(targets[a] - targets[b]) for a, b in pairs]
    table = {
        "from": [str(a + 1) for a, _ in pairs], "to": [str(b + 1) for _, b in pairs],
        "value": true, "sigma": [1e-6] * 3,
    }  # fmt: skip
    test = length_errors(result, table, mpe="1 mm")
    place = {id: i for i, id in enumerate(result.points["id"])}
    P = result.point_values
    expected = [np.linalg.norm(P[place[str(a + 1)]] - P[place[str(b + 1)]]) for a, b in pairs]
    np.testing.assert_allclose(test.measured, expected)
    # σ: from the joint covariance of both ends
    a, b = (("point", table[end][0]) for end in ("from", "to"))
    C = result.covariance(*((*p, axis) for p in (a, b) for axis in "XYZ"))
    u = (P[place["14"]] - P[place["13"]]) / expected[0]
    g = np.concatenate([-u, u])
    assert test.sigma[0] == pytest.approx(np.sqrt(g @ C @ g), rel=1e-9)
    assert (np.abs(test.error) < 5 * test.sigma).all() and test.verdict == CONFORMS
    assert jaxbundle.accept(result, "LME < 1 mm", lengths=table).met
    assert "no calibrated lengths" in jaxbundle.accept(result, "LME < 1 mm").unmet[0]
    with pytest.raises(InputError, match="11 – 12 is a distance of the adjustment"):
        length_errors(result, {"from": ["11"], "to": ["12"], "value": [1.0], "sigma": [1e-6]})
    with pytest.raises(InputError, match="no length has both points"):
        length_errors(result, {"from": ["x"], "to": ["12"], "value": [1.0], "sigma": [1e-6]})


def test_lengths_to_check_points_are_measured_and_those_between_control_not(field):
    result, targets = field
    pairs = [(6, 7), (7, 12), (0, 1), (2, 12)]
    true = [float(np.linalg.norm(targets[a] - targets[b])) for a, b in pairs]
    table = {
        "from": [str(a + 1) for a, _ in pairs], "to": [str(b + 1) for _, b in pairs],
        "value": true, "sigma": [1e-6] * 4,
    }  # fmt: skip
    test = length_errors(result, table, mpe="1 mm")
    assert test.between_control == (("1", "2"),) and not test.missing
    assert test.lengths.ends == (("7", "8"), ("8", "13"), ("3", "13"))
    checks = dict(zip(result.check_points.id, result.check_points.position))
    adjusted = dict(zip(result.points["id"], result.point_values))
    expected = [
        np.linalg.norm(checks["7"] - checks["8"]), np.linalg.norm(checks["8"] - adjusted["13"])
    ]  # fmt: skip
    np.testing.assert_allclose(test.measured[:2], expected)
    assert (np.abs(test.error) < 5 * test.sigma).all() and test.verdict == CONFORMS
    assert "not tested, both ends are control points: 1 – 2" in str(test)
    # One that is missing leaves the verdict open, and is not accepted.
    more = {name: [*values, value] for (name, values), value in zip(table.items(),
            ("no", "13", 1.0, 1e-6))}  # fmt: skip
    assert length_errors(result, more, mpe="1 mm").verdict == OPEN
    assert not jaxbundle.accept(result, "LME < 1 mm", lengths=more).met
    with pytest.raises(InputError, match="every length is between control points"):
        length_errors(result, {"from": ["1"], "to": ["2"], "value": [1.0], "sigma": [1e-6]})


def test_lengths_of_a_network_without_scale_are_refused(field):
    """One control point leaves rotations and the scale open."""
    network = field[0].network
    points, none = (
        network.points,
        dataclasses.replace(
            network.distances, points=np.zeros((0, 2), int), value=np.zeros(0), sigma=np.zeros(0)
        ),
    )
    one = dataclasses.replace(
        points, role=tuple("control" if id == "1" else "tie" for id in points.id),
        sigma=np.where(np.array(points.id)[:, None] == "1", points.sigma, np.nan),
    )  # fmt: skip
    free = jaxbundle.adjust(network.replace(points=one, distances=none, datum="inner"))
    assert free.counts.datum == 4
    with pytest.raises(InputError, match="has no scale"):
        length_errors(free, {"from": ["13"], "to": ["14"], "value": [1.0], "sigma": [1e-6]})


def test_bad_tables_of_lengths():
    good = {"from": ["a"], "to": ["b"], "value": [1.0], "sigma": [0.0]}
    assert len(read_lengths(good)) == 1
    for change, why in (
        ({"to": ["a"]}, "same point"), ({"value": [-1.0]}, "positive"),
        ({"sigma": [-1.0]}, "sigma"),
        ({"lin": [1]}, "unknown column 'lin'"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=why):
            read_lengths(good | change)


# --- check points ---------------------------------------------------------------------------


def test_asprs_accuracy_by_hand():
    """RMSE of the fit and of the survey add in squares, per axis and together."""
    d = np.array([[0.03, -0.04, 0.05], [-0.03, 0.04, -0.05]])
    sigma = np.full((2, 3), 0.02)
    found = PositionalAccuracy(("a", "b"), d, sigma, "m", 0.06, 0.05)
    np.testing.assert_allclose(found.rmse_axes, [0.03, 0.04, 0.05])
    assert found.rmse_h == pytest.approx(np.sqrt(0.03**2 + 0.04**2 + 2 * 0.02**2))
    assert found.rmse_v == pytest.approx(np.sqrt(0.05**2 + 0.02**2))
    assert found.rmse_3d == pytest.approx(np.hypot(found.rmse_h, found.rmse_v))
    assert found.verdict == "not met" and not found.enough
    assert "meets the horizontal accuracy class of 6.00 cm" in found.statements()[0]
    assert "does not meet the vertical" in found.statements()[1]
    assert "30" in found.statements()[-1]
    assert found.remarks() == []


def test_asprs_heights_only_means_and_poor_surveys():
    d = np.full((30, 3), np.nan)
    d[:, 2] = 0.02
    found = PositionalAccuracy(tuple(map(str, range(30))), d, np.full((30, 3), 0.015), "m")
    assert found.number == (0, 30) and found.enough
    assert found.rmse_v == pytest.approx(0.025)
    assert len(found.statements()) == 1
    said = " ".join(found.remarks())
    assert "mean error in Z" in said and "vertical survey" in said


def test_asprs_tests_only_directions_that_have_check_points():
    """A class without points is neither met nor silently passed; σ that are not stated are not
    0."""
    d = np.array([[0.03, 0.04, np.nan], [0.03, -0.04, np.nan]])
    sigma = np.array([[0.02, 0.02, np.nan], [np.nan] * 3])
    found = PositionalAccuracy(("a", "b"), d, sigma, "m", 0.1, 0.1)
    assert found.survey == (pytest.approx(np.hypot(0.02, 0.02)), 0.0)
    assert found.verdict == "" and dataclasses.replace(found, vertical_class=None).verdict == "met"
    assert dataclasses.replace(found, horizontal_class=0.01).verdict == "not met"
    said = " ".join([*found.statements(), *found.remarks()])
    assert "vertical accuracy class of 10.0 cm RMSE_V is not tested: no check point has Z" in said
    assert "stated of 1 of 2 check points" in said and "vertical survey" not in said
    only_x = dataclasses.replace(found, difference=np.array([[0.03, np.nan, np.nan]] * 2))
    assert only_x.number == (0, 0) and not only_x.enough


def test_check_points_without_differences_leave_the_certificate(field, monkeypatch):
    result, _ = field
    blank = np.full_like(result.check_points.difference, np.nan)
    unknown = dataclasses.replace(result.check_points, difference=blank)
    monkeypatch.setattr(result, "check_points", unknown)
    (part,) = jaxbundle.certificate(result).parts
    assert part.accuracy is None and "no check points with given coordinates" in part.no_accuracy


def test_asprs_of_an_adjustment(field):
    result, _ = field
    found = positional_accuracy(result)
    np.testing.assert_allclose(found.rmse_axes, result.check_points.rms)
    rows = jaxbundle.accept(
        result, ["check.rms < 1 m", "check.rms(H) < 1 m", "check.max < 1 m", "check.number > 3"]
    ).rows  # fmt: skip
    assert rows[0].value == pytest.approx(np.linalg.norm(found.rmse_axes))
    assert rows[1].value == pytest.approx(np.hypot(*found.rmse_axes[:2]))
    assert rows[2].value == pytest.approx(np.abs(result.check_points.difference).max())
