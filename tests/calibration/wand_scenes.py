"""Rendered frames of a wand waved before cameras that stand still."""

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from jaxbundle.cameras import get_model, project
from jaxbundle.measure import Board, BoardViews


def markers_in_images(camera, R, X0, ends, places):
    """Image points [frames, markers, 2] of markers at `places` (0 to 1) between the `ends`
    [frames, 2, 3] of a wand."""
    X = ends[:, :1] + np.asarray(places)[:, None] * (ends[:, 1:] - ends[:, :1])
    p = tuple(camera.parameters.values())
    uv = project(get_model(camera.model), p, *np.moveaxis((X - X0) @ R.T, -1, 0))
    return np.stack([np.asarray(one) for one in uv], -1)


def wave(frames, seed=5, length=0.5):
    """Ends of a wand at different places, in different directions."""
    rng = np.random.default_rng(seed)
    middle = rng.uniform([-0.8, -0.8, 0.5], [0.8, 0.8, 1.6], (frames, 3))
    along = rng.normal(size=(frames, 3))
    along *= length / np.linalg.norm(along, axis=1)[:, None]
    return np.stack([middle - along / 2, middle + along / 2], 1)


BOARD = Board(8, 6, 0.1)


def views_of_board(room, name, seed=0, epochs=12, noise=0.1):
    """A board in the middle of the `room`, turned towards its first two cameras, as one sees it."""
    shape, rng = np.random.default_rng(3), np.random.default_rng([seed, 7, int(name[1])])
    k, camera = int(name[1]), room.CAMERAS[name]
    p, size = tuple(camera.parameters.values()), np.array(camera.image_size)
    z = (room.PLACES[0] + room.PLACES[1]) / 2 - [0, 0, 1]
    z /= np.linalg.norm(z)
    x = np.cross([0, 0, 1.0], z) / np.linalg.norm(np.cross([0, 0, 1.0], z))
    facing = np.stack([x, np.cross(z, x), z], 1)
    names, found = [], []
    for epoch in range(epochs):
        angles = [*shape.uniform(-25, 25, 2), 90 * (epoch % 4)]
        R = facing @ Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
        X = (BOARD.points - BOARD.points.mean(0)) @ R.T + [0, 0, 1] + shape.uniform(-0.5, 0.5, 3)
        ray = (X - room.PLACES[k]) @ room.ROTATIONS[k].T
        uv = np.stack([np.asarray(a) for a in project(get_model(camera.model), p, *ray.T)], -1)
        inside = ((uv > 3) & (uv < size - 4)).all(1)
        uv = np.where(inside[:, None], uv + noise * rng.normal(size=uv.shape), np.nan)
        if inside.sum() >= 20:
            names.append(f"f_{epoch:03d}.png")
            found.append(uv)
    return BoardViews(BOARD, tuple(names), camera.image_size, np.array(found))


def render_frame(uv, size, rng, radius=3.0, dark=False, lamps=((100, 60),)):
    """A grey frame [rows, columns] with discs at `uv` before a textured wall with lamps; noise of
    two grey values."""
    columns, rows = size
    y, x = np.mgrid[:rows, :columns].astype(np.float32)
    wall = 60 + 15 * np.sin(x / 23) * np.cos(y / 31)
    for place in lamps:
        wall += 190 * (np.hypot(x - place[0], y - place[1]) < 12)
    grey = 255 - wall if dark else wall
    level = -150 if dark else 150
    for u, v in uv:
        low = int(u) - 12, int(v) - 12
        # disc by the area of pixels within it, eight times finer than a pixel, and blurred
        fine = (np.arange(24 * 8) + 0.5) / 8 - 0.5
        disc = np.hypot(fine[None] + low[0] - u, fine[:, None] + low[1] - v) < radius
        part = gaussian_filter(disc.astype(float), 6.0).reshape(24, 8, 24, 8).mean((1, 3))
        there = [slice(max(low[k], 0), min(low[k] + 24, size[k])) for k in (1, 0)]
        cut = tuple(
            slice(s.start - low[k], s.stop - low[k]) for s, k in zip(there, (1, 0))
        )
        if all(s.stop > s.start for s in there):
            grey[tuple(there)] += level * part[cut]
    return np.clip(np.rint(grey + 2 * rng.normal(size=grey.shape)), 0, 255).astype(np.uint8)
