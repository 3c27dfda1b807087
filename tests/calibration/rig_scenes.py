"""Simulated rigs: cameras in a row over a board that is moved, and back to back between walls."""

import numpy as np
import render

from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.measure import Board, BoardViews

LENSES = [
    render.Lens.of(fx=310.0 + k, fy=311.0, cx=241.0, cy=178.0 - k, k1=-0.1, k2=0.03, p1=4e-4)
    for k in range(4)
]
BOARD = Board(8, 7, 0.03, "charuco", marker=0.02)
OTHER = Board(8, 7, 0.03, "charuco", marker=0.02, first_marker=30)
FREE = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


def rotation(*angles):
    """R of ω, φ, κ in degrees."""
    return np.asarray(matrix_from_omega_phi_kappa(np.radians(np.array(angles, float))))


def matrix(R, t):
    """[4, 4] of R·x + t."""
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = R, t
    return found


def mounted(base, *angles):
    """A mounting, rig → camera: R·(Y − b)."""
    R = rotation(*(angles or (0, 0, 0)))
    return matrix(R, -R @ np.array(base, float))


def image(lens, pose, board, rng=None, noise=0.0):
    """Image points of a board by its pose (board → camera), NaN outside; None if few are inside."""
    M = pose[:3, :3]
    X0 = -M.T @ pose[:3, 3]
    ahead = (board.points - X0) @ M.T
    xy = lens.image_of(M, X0, board.points)
    if rng is not None:
        xy = xy + noise * rng.normal(size=xy.shape)
    inside = ((xy > 3) & (xy < np.array(lens.size) - 4)).all(1) & (ahead[:, 2] < -0.05)
    xy[~inside] = np.nan
    return xy if inside.sum() >= 16 else None


def views(poses, boards, rng, noise, lenses=LENSES):
    """`BoardViews` of every camera by board; `poses[camera][board]`: epoch → board to camera."""
    found = {}
    for (camera, of_boards), lens in zip(poses.items(), lenses):
        found[camera] = {}
        for name, by_epoch in of_boards.items():
            seen = {e: image(lens, p, boards[name], rng, noise) for e, p in by_epoch.items()}
            seen = {e: xy for e, xy in seen.items() if xy is not None}
            if seen:
                names = tuple(f"{camera}_{e:03d}.png" for e in seen)
                xy = np.array([*seen.values()])
                found[camera][name] = BoardViews(boards[name], names, lens.size, xy)
    return found


CHAIN = {
    "c0": mounted((0, 0, 0)),
    "c1": mounted((0.30, 0.01, -0.01), 2, 10, 1),
    "c2": mounted((0.58, -0.01, 0.02), -3, 18, -2),
    "c3": mounted((0.84, 0.02, 0.05), 1, 30, 3),
}
"""Mountings, rig → camera."""


def chain(seed=0, noise=0.05, epochs=12):
    """A moved board before neighbouring cameras of a row: at each epoch two of them see it."""
    rng = np.random.default_rng(seed)
    shapes = np.random.default_rng(1)  # the same network at every seed of the noise
    names, poses = list(CHAIN), {name: {"board": {}} for name in CHAIN}
    for pair in range(3):
        for i in range(epochs):
            # seen from the middle of two cameras, tilted, near and far, rolled
            R = rotation(*(shapes.uniform(-25, 25, 2)), (0, 90, 180, 270)[i % 4])
            away = np.array([0.0, 0.0, -shapes.uniform(0.4, 0.6)])
            middle = matrix(R, away + [*shapes.uniform(-0.03, 0.03, 2), 0]) @ matrix(
                np.eye(3), -BOARD.points.mean(0)
            )
            left, right = CHAIN[names[pair]], CHAIN[names[pair + 1]]
            centre = -0.5 * sum(m[:3, :3].T @ m[:3, 3] for m in (left, right))
            turn = rotation(0, (5, 14, 24)[pair], 0)
            rig = np.linalg.inv(matrix(turn, -turn @ centre)) @ middle
            for name in names[pair : pair + 2]:
                poses[name]["board"][pair * epochs + i] = CHAIN[name] @ rig
    made = views(poses, {"board": BOARD}, rng, noise)
    return {camera: by_board["board"] for camera, by_board in made.items()}


BACK = mounted((0.02, 0.03, 0.12), 3, 176, 4)
"""The camera that looks back."""
BOARDS = {"front": BOARD, "rear": OTHER}
REAR = matrix(rotation(2, 183, -3), (0.05, -0.02, 1.15))
"""Where the rear board is: its frame → that of the front board."""


def motions(kind="any", epochs=16):
    """Poses of the first camera before the front board, board → camera."""
    rng, found = np.random.default_rng(2), []
    for i in range(epochs):
        angles, shift = rng.uniform(-22, 22, 3), rng.uniform(-0.07, 0.07, 3)
        angles[2] += (0, 90, 180, 270)[i % 4]
        if kind == "axis":
            angles, shift = angles * [0, 1, 0], shift * [1, 0, 1]
            angles[1] = rng.uniform(-25, 25)
        if kind == "shift":
            angles = np.array([5.0, 8.0, 0.0])
        R = rotation(*angles)
        at = BOARD.points.mean(0) + [0, 0, 0.5] + shift
        found.append(matrix(R, -R @ at))
    return found


def back_to_back(seed=0, noise=0.05, kind="any", epochs=16, moved=()):
    """Two cameras that look away from each other, each at a board of its own on a wall; at the
    epochs `moved` the rear board is elsewhere."""
    rng = np.random.default_rng(seed)
    front = dict(enumerate(motions(kind, epochs)))
    rear = {e: BACK @ pose @ REAR for e, pose in front.items()}
    for e in moved:
        rear[e] = rear[e] @ matrix(rotation(0, 0, 4), (0, 0, 0.01))  # lateral shifts show least
    poses = {"a": {"front": front}, "b": {"rear": rear}}
    return views(poses, BOARDS, rng, noise)


PAGE = matrix(rotation(0, -35, 1), (0.235, 0.0, 0.01))
"""The second page of an open book: its frame → that of the first."""
PAIR = {"a": mounted((0, 0, 0)), "b": mounted((0.2, 0.01, -0.02), 1, 20, 2)}


def book(seed=0, noise=0.05, epochs=14):
    """Two boards fixed to each other at an angle, moved before two cameras; at the first epochs
    one camera sees only one of them."""
    rng, shapes = np.random.default_rng(seed), np.random.default_rng(4)
    poses = {name: {"first": {}, "second": {}} for name in PAIR}
    for e in range(epochs):
        R = rotation(*shapes.uniform(-20, 20, 2), (0, 90, 180, 270)[e % 4])
        shift = matrix(R, [0.08, *shapes.uniform(-0.03, 0.03, 1), -shapes.uniform(0.6, 0.8)])
        other = PAGE[:3, :3] @ OTHER.points.mean(0) + PAGE[:3, 3]
        body = shift @ matrix(np.eye(3), -(BOARD.points.mean(0) + other) / 2)
        for name, mounting in PAIR.items():
            poses[name]["first"][e] = mounting @ body
            if e >= 4 or name == "b":
                poses[name]["second"][e] = mounting @ body @ PAGE
    return views(poses, {"first": BOARD, "second": OTHER}, rng, noise)
