"""Image points and principal points outside the image, in pixels and in millimetres."""

import numpy as np
import pytest

from jaxbundle.network import Camera
from jaxbundle.network.build import make_network
from jaxbundle.network.image_bounds import is_outside, outside_warnings

SIZE = dict(image_size=(640, 480), pixel_size=(0.01, 0.02))
PIXELS = Camera("a", "opencv", dict(fx=500.0, fy=500.0, cx=320.0, cy=240.0), **SIZE)
MM = Camera("a", "brown", dict(c=5.0), **SIZE)


@pytest.mark.parametrize("camera, low, high", [
    (PIXELS, (-0.5, -0.5), (639.5, 479.5)), (MM, (-3.2, -4.8), (3.2, 4.8)),
])  # fmt: skip
def test_the_edge_of_the_image(camera, low, high):
    low, high = np.array(low), np.array(high)
    corners = np.array([low, high, [low[0], high[1]], [high[0], low[1]]])
    middle = (low + high) / 2
    assert not is_outside(camera, middle + 0.9999 * (corners - middle)).any()
    assert is_outside(camera, middle + 1.0001 * (corners - middle)).all()


def test_without_a_size_nothing_is_outside():
    far = np.full((1, 2), 1e6)
    assert not is_outside(Camera("a", "opencv", PIXELS.parameters), far).any()
    assert not is_outside(Camera("a", "brown", dict(c=5.0), image_size=(640, 480)), far).any()


def seen(camera, xy):
    ids = [str(i) for i in range(len(xy))]
    return make_network(
        [camera], {"id": ["i"], "camera": ["a"]}, {"id": ids, "role": ["tie"] * len(xy),
                                                   **dict.fromkeys("XYZ", np.zeros(len(xy)))},
        {"image": ["i"] * len(xy), "point": ids, "x": xy[:, 0], "y": xy[:, 1]}, image_unit="mm",
    )  # fmt: skip


def test_a_file_that_counts_from_the_corner_is_told():
    """Points all over the image, in mm from its centre, and the same from its lower left corner."""
    x, y = np.meshgrid(np.linspace(-3, 3, 7), np.linspace(-4, 4, 5))
    xy = np.stack([x.ravel(), y.ravel()], 1)
    network = seen(MM, xy)
    assert outside_warnings(network.cameras, network) == ()
    shifted = xy + [3.2, 4.8]
    beyond = (shifted > [3.2, 4.8]).any(1)
    network = seen(MM, shifted)
    (told,) = outside_warnings(network.cameras, network)
    first = int(beyond.argmax())
    assert f"{beyond.sum()} of 35 image points outside the image of 640 × 480" in told
    assert f"point '{first}' of image 'i'" in told and "from the image centre" in told


def test_a_principal_point_of_another_size_is_told():
    other = Camera("b", "opencv", PIXELS.parameters | dict(cx=1012.0), image_size=(640, 480))
    (told,) = outside_warnings([PIXELS, MM, other])
    assert "camera 'b': the principal point (1012, 240) px is outside" in told
