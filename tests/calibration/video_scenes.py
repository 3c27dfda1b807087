"""Simulated videos of a moving board by cameras on one mounting that are not synchronised."""

import numpy as np
import rig_scenes as scenes
from scipy.spatial.transform import Rotation

from jaxbundle.measure import Board, BoardViews

BOARD = Board(8, 6, 0.03)
FREE = scenes.FREE
MOUNTINGS = {
    "a": np.eye(4),
    "b": scenes.mounted((0.12, 0.01, -0.01), 2, 8, 1),
    "c": scenes.mounted((-0.11, 0.02, 0.02), -3, -9, -2),
}
"""Mountings, rig → camera."""

# By camera: offset (s) and rate of its clock.
CLOCKS = {"a": (0.0, 0.0), "b": (0.4321, 1e-4), "c": (-0.2345, -2e-4)}


def by_hand(t):
    """The board in the frame of camera a, as moved by hand: R [n, 3, 3], places of its middle."""
    place = np.stack([
        0.05 * np.sin(1.9 * t) + 0.06 * np.sin(0.7 * t + 1),
        0.05 * np.sin(1.3 * t + 0.5),
        -0.40 + 0.06 * np.sin(1.1 * t + 2),
    ], -1)  # fmt: skip
    turn = np.stack(
        [0.4 * np.sin(1.7 * t), 0.4 * np.sin(1.2 * t + 1), 0.3 * np.sin(0.9 * t + 2)], -1
    )
    return Rotation.from_rotvec(turn).as_matrix(), place


def evenly(t):
    """A board that moves with constant velocity, without a rotation."""
    place = np.array([-0.06, 0.02, -0.42]) + t[:, None] * [0.03, -0.015, 0.01]
    R = Rotation.from_rotvec([0.3, -0.25, 0.1]).as_matrix()
    return np.broadcast_to(R, (len(t), 3, 3)), place


def at_rest(t):
    """A board that does not move."""
    return evenly(0 * t)


def image(camera, motion, t):
    """Image points of the board, each at its own time; NaN outside."""
    R, place = motion(t)
    X = BOARD.points - BOARD.points.mean(0)
    T = MOUNTINGS[camera]
    Y = (np.einsum("nij,nj->ni", R, X) + place) @ T[:3, :3].T + T[:3, 3]
    lens = scenes.LENSES[list(MOUNTINGS).index(camera)]
    uv = np.array(lens.image_of(np.eye(3), np.zeros(3), Y))
    inside = ((uv > 3) & (uv < np.array(lens.size) - 4)).all(1)
    uv[~inside] = np.nan
    return uv, lens


def video(
    camera, frames, seed=0, noise=0.05, rate=30.0, motion=by_hand, clock=None, read_out=0.0
):  # fmt: skip
    """`BoardViews` of every frame that shows the whole board; the frame is in the name."""
    rng = np.random.default_rng([seed, ord(camera)])
    offset, drift = CLOCKS[camera] if clock is None else clock
    middle, names, found = (frames - 1) / rate / 2, [], []
    for k in range(frames):
        t = k / rate
        common = np.full(len(BOARD.points), t + offset + drift * (t - middle))
        uv, lens = image(camera, motion, common)
        # a row is exposed when it is read: the places are found by iteration
        for _ in range(6 if read_out else 0):
            line = (uv[:, 1] - (lens.size[1] - 1) / 2) / lens.size[1]
            uv, _ = image(camera, motion, common + read_out * line)
        if np.isfinite(uv).all():
            names.append(f"frame_{k:06d}.png")
            found.append(uv + noise * rng.normal(size=uv.shape))
    return BoardViews(BOARD, tuple(names), lens.size, np.array(found))
