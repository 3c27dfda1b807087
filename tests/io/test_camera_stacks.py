"""Archives of cameras: those that unpack to far more than they hold; what a camera is known by."""

import tracemalloc

import numpy as np
import pytest

from jaxbundle.batches.stacks import read_camera_stack
from jaxbundle.errors import InputError
from jaxbundle.io.text.stored_rows import StoredRows


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


def test_what_is_not_visible_does_not_count(tmp_path):
    """A camera with more views beside it, or another number where nothing is seen: the same."""
    rng = np.random.default_rng(1)
    X, xy = rng.normal(size=(50, 3)), rng.uniform(0, 400, (1, 6, 50, 2))
    seen = rng.uniform(size=(1, 6, 50)) < 0.8
    seen[..., 7] = False
    wide = np.zeros((2, 9, 50, 2))
    wide[:1, :6], wide[1] = xy, rng.uniform(0, 400, (9, 50, 2))
    seen_wide = np.ones((2, 9, 50), bool)
    seen_wide[0] = False
    seen_wide[:1, :6] = seen
    other = X.copy()
    other[7] = np.nan
    found, missing = [], np.where(seen[..., None], xy, np.nan)
    for object_points, image_points, visible in (
        (X, xy, seen), (other, wide, seen_wide), (X, missing, np.ones(seen.shape, bool)),
    ):  # fmt: skip
        np.savez(tmp_path / "a.npz", object_points=object_points, image_points=image_points,
                 image_size=(640, 480), visible=visible)  # fmt: skip
        stack = read_camera_stack(tmp_path / "a.npz")
        found.append([stack.fingerprint(i) for i in range(len(stack.ids))])
    assert found[0][0] == found[1][0] == found[2][0] != found[1][1]


def test_big_arrays_are_read_where_they_lie(tmp_path):
    """The same cameras and fingerprints as of a compressed archive, without all of it in memory."""
    rng = np.random.default_rng(2)
    xy = rng.uniform(0, 400, (900, 20, 50, 2)).round(1)
    given = arrays(900, xy) | {"object_points": rng.normal(size=(900, 50, 3)).round(3)}
    np.savez(tmp_path / "a.npz", **given)
    np.savez_compressed(tmp_path / "b.npz", **given)
    tracemalloc.start()
    stored = read_camera_stack(tmp_path / "a.npz")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 0.4 * xy.nbytes
    packed = read_camera_stack(tmp_path / "b.npz")
    for chosen in ([0, 1, 2], [899, 3, 4, 7]):
        found, known = (stack.arguments(np.array(chosen)) for stack in (stored, packed))
        for name in ("object_points", "image_points", "visible"):
            np.testing.assert_array_equal(found[name], known[name])
        np.testing.assert_array_equal(found["image_points"], xy[chosen])
    assert stored.fingerprint(899) == packed.fingerprint(899)


def test_points_of_each_rig_are_read_where_they_lie(tmp_path):
    """Of 1000 rigs of 2 cameras with an epoch of 50 points: a megabyte of them."""
    given = arrays(1000, np.zeros((1000, 2, 1, 50, 2)))
    given |= {"visible": np.ones((1000, 2, 1, 50), bool), "object_points": np.ones((1000, 50, 3))}
    np.savez(tmp_path / "a.npz", **given)
    assert isinstance(read_camera_stack(tmp_path / "a.npz").object_points, StoredRows)


def test_a_byte_that_was_changed_is_found(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, **arrays(200, np.zeros((200, 20, 50, 2))))
    garbled = bytearray(path.read_bytes())
    garbled[len(garbled) // 2] ^= 1
    path.write_bytes(garbled)
    with pytest.raises(InputError, match="not a readable .npz"):
        read_camera_stack(path)
