"""Rays of doubtful control points are compared with coordinates in the frame of the others."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxbundle.network.tables import Points
from jaxbundle.orientation.control_consistency import Discrepancies
from jaxbundle.reconstruction import control_choice
from jaxbundle.reconstruction.oriented_block import ControlSettings, MeasuredPoint


@pytest.mark.parametrize("agree", [True, False])
def test_positions_may_be_shifted_against_the_control_that_agrees(monkeypatch, agree):
    """By the median of the agreeing points A and B; by nothing where none agrees."""
    position = np.array([[0.0, 0, 0], [10, 0, 0], [5, 5, 0]])
    control = Points(("A", "B", "C"), ("control",) * 3, position, np.full((3, 3), 0.02))
    shift = np.array([1.0, -2.0, 0.5])
    block = SimpleNamespace(X=position[:2] + shift, row_of_determined={"A": 0, "B": 1})
    rays = lambda good: SimpleNamespace(rows=[0, 1], good=np.full(2, good))
    measured = {"A": rays(True), "B": rays(True), "C": rays(False)}
    assessed = SimpleNamespace(sigma=np.full((2, 3), 0.02), factor=1.0, used=np.full(2, agree))
    given = []
    settle = lambda block, choice, k, control, shift: given.append((k, shift))
    monkeypatch.setattr(control_choice, "_settle_by_coordinates", settle)
    for name in ("_name_wrong", "_name_exchanged", "_describe_error"):
        monkeypatch.setattr(control_choice, name, lambda *_: "")
    found = control_choice.choose_control(block, control, measured, [0, 1], assessed, 0.1)
    ((k, moved),) = given
    assert k == 2 and found.used.tolist() == [agree, agree, False]
    np.testing.assert_allclose(moved, shift if agree else np.zeros(3))


def test_points_that_the_block_does_not_have_are_used_by_their_rays():
    """Such as those whose rays data snooping removed, and that meet in the frame of control:
    nothing contradicts control points, and check points are never used."""
    control = Points(("A", "B"), ("control", "check"), np.eye(2, 3), np.full((2, 3), 0.02))
    rays = SimpleNamespace(rows=[0, 1], good=np.ones(2, bool), position=np.full(3, np.nan))
    assessed = SimpleNamespace(factor=1.0)
    block = SimpleNamespace(row_of_determined={}, settings=ControlSettings())
    found = control_choice.choose_control(
        block, control, {"A": rays, "B": rays}, [], assessed, 0.1
    )
    assert found.used.tolist() == [True, False] and found.reasons == {}


def many_points(compared_together, role="control"):
    """120 points, determined by the block to a millimetre, with errors of 0.3 m in the plane and
    0.6 m in height, of unknown σ; the first of the given role."""
    n, errors = 120, np.random.default_rng(1).normal(size=(120, 3)) * [0.3, 0.3, 0.6]
    roles = (role, *["control"] * (n - 1))
    control = Points(tuple(map(str, range(n))), roles, np.zeros((n, 3)), np.full((n, 3), np.nan))

    def compare(places, points):
        sigma = points.sigma[places].copy()
        sigma[[points.role[k] == "fixed" for k in places]] = 0.0
        C = 1e-6 * np.eye(3 * len(places)).reshape(len(places), 3, len(places), 3)
        return Discrepancies(
            errors[places], C, sigma, np.zeros((len(places), 3, 0))
        )  # fmt: skip

    settings = ControlSettings(compared_together=compared_together)
    block = SimpleNamespace(
        settings=settings, compare=compare, X=errors,
        row_of_determined={id: int(id) for id in control.id},
    )  # fmt: skip
    return block, control, errors


@pytest.mark.parametrize("assumed", [0.01, 0.45])
def test_sigma_of_control_in_groups_is_that_of_all_points(assumed):
    """Σd²/n of all used points, and as many redundancies, also when they are assessed in three
    groups; at the assumed σ, which is the least, where it is smaller than this."""
    block, control, errors = many_points(40)
    order, found = control_choice.assess_control(block, control, range(120), assumed)
    assert sorted(order) == list(range(120)) and found.used.sum() > 115  # 5 % suspect one by chance
    errors = errors[order][found.used]
    rms = np.sqrt([np.mean(errors[:, :2] ** 2), np.mean(errors[:, 2] ** 2)])
    expected = np.maximum(rms, assumed)[[0, 0, 1]]
    np.testing.assert_allclose(found.sigma, np.tile(expected, (120, 1)), rtol=1e-3)
    assert found.assumed == (assumed > rms[0], False)
    np.testing.assert_allclose(found.redundancy, (2 * len(errors), len(errors)), rtol=1e-3)


def test_control_without_sigma_is_not_held_exactly_beside_fixed_points():
    block, control, _ = many_points(200, "fixed")
    order, assessed = control_choice.assess_control(block, control, range(120), 0.01)
    ray = SimpleNamespace(rows=[0, 1], good=np.ones(2, bool), position=np.full(3, np.nan))
    measured = dict.fromkeys(control.id, ray)
    found = control_choice.choose_control(block, control, measured, order, assessed, 0.01)
    assert (found.sigma[1:] > 0.2).all()


@pytest.mark.parametrize("agree, used, reason", [
    ([True, False], True, ""),  # the other one is wrong
    ([True, True], False, "its 2 rays do not meet"),  # which of them is right?
    ([False, False], False, "its 2 rays do not meet"),
    ([True], True, ""),
    ([False], False, "its only ray, in a.jpg, misses its coordinates by 9 px, 2.5 m"),
])  # fmt: skip
def test_coordinates_settle_which_ray_is_right(agree, used, reason):
    """Of several that do not meet, if exactly one passes them; a single one must pass them."""
    n, rays = len(agree), np.array(agree)
    control = Points(("A",), ("control",), np.zeros((1, 3)), np.full((1, 3), 0.02))
    block = SimpleNamespace(
        settings=ControlSettings(), misses=lambda *_: np.where(rays, 0.0, 9.0),
        pixel_length=lambda *_: np.full(n, 1.0), distances=lambda *_: np.full(n, 2.5),
        name_of=lambda *_: "a.jpg",
    )  # fmt: skip
    point = MeasuredPoint(
        np.arange(n), np.zeros(n, int), np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 2, 3)),
        np.full(n, 0.5), np.zeros(n, bool), np.full(3, np.nan),
    )  # fmt: skip
    choice = control_choice.ControlChoice(
        {"A": point}, np.zeros(1, bool), control.sigma, {}, {}, None
    )
    control_choice._settle_by_coordinates(block, choice, 0, control, np.zeros(3))
    assert choice.used.tolist() == [used] and choice.reasons.get("A", "") == reason
    assert choice.points["A"].good.tolist() == (agree if used else [False] * n)
