"""An archive of cameras that unpacks to far more than it holds is refused before it is unpacked."""

import tracemalloc

import numpy as np
import pytest

from jaxbundle.errors import InputError
from jaxbundle.io.camera_stacks import read_camera_stack


def arrays(cameras, xy):
    return dict(
        object_points=np.ones((50, 3)), image_size=np.array([640, 480]),
        image_points=xy, visible=np.ones((cameras, 20, 50), bool),
    )  # fmt: skip


def test_measurements_unpack(tmp_path):
    """Corners to a tenth of a pixel, everything visible: packed as well as such arrays can be."""
    xy = np.random.default_rng(0).integers(0, 5000, (400, 20, 50, 2)) / 10
    np.savez_compressed(tmp_path / "a.npz", **arrays(400, xy))
    assert len(read_camera_stack(tmp_path / "a.npz").ids) == 400


def test_zeros_without_end(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", **arrays(4000, np.zeros((4000, 20, 50, 2))))
    tracemalloc.start()
    with pytest.raises(InputError, match=r"a\.npz: .*bytes that claim to unpack to 6[0-9]{7}"):
        read_camera_stack(tmp_path / "a.npz")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1e7
