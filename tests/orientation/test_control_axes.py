"""Control with a reversed axis, or in two units."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxbundle.orientation.control_axes import describe_wrong_axes
from jaxbundle.orientation.settings import DEFAULTS

FOOT, DOUBTED = 0.3048, DEFAULTS.doubted_axes
RNG = np.random.default_rng(4)
X = RNG.uniform(-1, 1, (7, 3)) * [20, 15, 4]
MODEL = 0.3 * X @ Rotation.from_euler("xyz", [0.4, -0.3, 2]).as_matrix() + [1, 2, 3]


@pytest.mark.parametrize("axes, words", [
    ([1, 1, 1], ""),
    ([-1, 1, 1], "better as a mirror image (by 0.0"),
    ([1, 1, -1], "better as a mirror image (by 0.0"),
    ([1, 1, 1 / FOOT], "better with heights in feet (by 0.0"),
    ([1 / FOOT, 1 / FOOT, 1], "better with X and Y in feet (by 0.0"),
])  # fmt: skip
def test_the_mistake_in_all_points_is_named(axes, words):
    control = X * axes + 0.02 * RNG.normal(size=X.shape)
    assert words in describe_wrong_axes(MODEL, control, "m")
    assert bool(words) == bool(describe_wrong_axes(MODEL, control, "m"))


def test_exchanged_x_and_y_are_a_mirror_image():
    said = describe_wrong_axes(MODEL, X[:, [1, 0, 2]], "m")
    assert "7 control points fit" in said and "better as a mirror image" in said


def test_what_noise_could_explain_is_only_doubted():
    """Noise of 0.8 m leaves the mirror image of these less than five times better."""
    noise = np.random.default_rng(1).normal(size=X.shape)
    control = X[:, [1, 0, 2]] + 0.8 * noise
    assert not describe_wrong_axes(MODEL, control, "m")
    assert "mirror image" in describe_wrong_axes(MODEL, control, "m", times_better=DOUBTED)


def test_nothing_is_said_of_three_points_or_of_a_plane():
    assert not describe_wrong_axes(MODEL[:3], X[:3, [1, 0, 2]], "m", times_better=DOUBTED)
    plane = X * [1, 1, 0]
    assert not describe_wrong_axes(plane, plane[:, [1, 0, 2]], "m", times_better=DOUBTED)


def test_exchanged_names_are_no_mirror_image():
    names = [1, 0, 2, 3, 4, 5, 6]
    assert not describe_wrong_axes(MODEL, X[names], "m", times_better=DOUBTED)
