"""Rays of doubtful control points are compared with coordinates in the frame of the others."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxbundle.network.tables import Points
from jaxbundle.reconstruction import control_choice


@pytest.mark.parametrize("agree", [True, False])
def test_positions_may_be_shifted_against_the_control_that_agrees(monkeypatch, agree):
    """By the median of the agreeing points A and B; by nothing where none agrees."""
    position = np.array([[0.0, 0, 0], [10, 0, 0], [5, 5, 0]])
    control = Points(("A", "B", "C"), ("control",) * 3, position, np.full((3, 3), 0.02))
    shift = np.array([1.0, -2.0, 0.5])
    block = SimpleNamespace(X=position[:2] + shift, determined={"A": 0, "B": 1})
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
