"""Many cameras before a board of 5 × 4 corners, in an `.npz`."""

from pathlib import Path

import numpy as np

BOARD = np.c_[np.mgrid[0:5, 0:4].T.reshape(-1, 2) * 0.1 - [0.2, 0.15], np.zeros(20)]


def images_of(cameras: int) -> np.ndarray:
    """Pixels [cameras, 6, 20, 2]: principal distances of about 1000, σ = 0.1 pixels."""
    rng = np.random.default_rng(0)
    images = np.empty((cameras, 6, 20, 2))
    for views in images:
        f = rng.uniform(900, 1100)
        for view in views:
            a, b = rng.uniform(-0.5, 0.5, 2)
            ca, sa, cb, sb = np.cos(a), np.sin(a), np.cos(b), np.sin(b)
            R = np.array([[cb, 0, sb], [sa * sb, ca, -sa * cb], [-ca * sb, sa, ca * cb]])
            x, y, z = R @ BOARD.T + [[0], [0], [1.2]]
            view[:] = np.stack([f * x / z + 640, f * y / z + 480], 1)
    return images + rng.normal(0, 0.1, images.shape)


def write_cameras(path: Path, images: np.ndarray, **arrays) -> Path:
    """The file; cameras are called "serial 0", …"""
    ids = [f"serial {i}" for i in range(len(images))]
    given = dict(object_points=BOARD, image_points=images, image_size=[1280, 960], ids=ids)
    np.savez(path, **given | arrays)
    return path
