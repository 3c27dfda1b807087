"""The test of a calibration for bias: quiet on clean data, finds a missing K2 and a bent board."""

import board_photographs as taken
import numpy as np
import pytest
import render
from test_calibrate import simulated

from jaxbundle.calibration import calibrate
from jaxbundle.calibration.bias import cells_of_four, find_bias
from jaxbundle.calibration.observation_equations import linearise_image_points
from jaxbundle.cameras import get_model

FEW = ("fx", "fy", "cx", "cy", "k1", "p1", "p2")


def lens(**changes):
    """The lens with other parameters."""
    names = get_model("opencv").parameters
    return render.Lens.of(**dict(zip(names, render.LENS.parameters)) | changes)


def bias_of(lens=render.LENS, bend=0.0, seed=0, **given):
    X = taken.BOARD.points
    away = (X - X.mean(0))[:, 0] / 0.12
    views = simulated(lens, points=X + np.outer(bend * away**2, [0, 0, 1]), seed=seed)
    return calibrate(views, snooping=None, cross_validation=False, **given)


@pytest.fixture(scope="module")
def clean():
    return bias_of()


def test_clean_data_have_none(clean):
    found = clean.bias
    assert found.found == () and found.cells == 144 and set(found.tests) == {
        "cells", "camera", "board"}  # fmt: skip
    assert found.corner_sigma == pytest.approx(0.05, rel=0.15)
    assert abs(found.ratio) < 0.3 and "no bias" in found.sentence
    assert not any("bias" in line for line in clean.advice)
    assert not any(bias_of(seed=seed).bias.found for seed in range(1, 6))


def test_cells_are_the_dense_model_with_a_pose_each(clean):
    """Ω' and r' by one dense solution with 144 poses and one camera."""
    problem = clean.adjustment.problem
    cells = cells_of_four(problem, taken.BOARD.grid)
    found = linearise_image_points(problem, clean.adjustment.values)
    rows = cells.ravel()
    A = np.zeros((2 * len(rows), 6 * len(cells) + 9))
    for k in range(len(cells)):
        A[8 * k : 8 * k + 8, 6 * k : 6 * k + 6] = found.slopes["image"][cells[k]].reshape(8, 6)
    A[:, -9:] = found.slopes["camera"][rows].reshape(-1, 9)
    scale = np.linalg.norm(A, axis=0)
    Q, R = np.linalg.qr(A / scale)
    assert abs(np.diagonal(R)).min() > 1e-8
    v = found.v[rows].ravel()
    rest = v - Q @ (Q.T @ v)
    more, own = clean.bias.tests["cells"].degrees
    assert own == len(v) - A.shape[1] and more + own == clean.adjustment.redundancy
    F = (clean.adjustment.vtpv - rest @ rest) / more / (rest @ rest / own)
    assert clean.bias.tests["cells"].F == pytest.approx(F, rel=1e-6)


@pytest.mark.further
def test_a_missing_k2_is_of_the_camera():
    """Another camera to compile than that of the other tests."""
    for seed in range(2):
        found = bias_of(lens(k2=-0.4), free=FEW, seed=seed)
        assert found.bias.found[0] == "camera" and "another camera model" in found.bias.sentence
        assert found.bias.sentence in found.advice


def test_a_bent_board_is_of_the_board():
    found = bias_of(bend=5e-4).bias
    assert found.found[0] == "board" and "cells" in found.found and found.ratio > 0.3
    assert found.corner_sigma == pytest.approx(0.05, rel=0.15)  # the bend leaves no trace in it
    assert "estimate the points of the board" in found.sentence


@pytest.mark.further
def test_a_board_that_is_known_to_its_sigma_is_control():
    """Pseudo-observations of the board take part in Ω'."""
    found = bias_of(board_sigma=1e-4, sigma_image=0.05).bias
    assert found.found == () and found.tests["cells"].degrees[0] == 936
    assert 0.7 < found.tests["cells"].F < 1.3


def test_too_few_cells(clean):
    assert find_bias(clean.adjustment, (1, 54)) is None
