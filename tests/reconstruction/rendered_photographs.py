"""Rendered convergent photographs as files: hills with a roof, by a camera with distortion.

On request a plate with four ArUco markers lies on the hills.
"""

import dataclasses

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

import jaxbundle
from jaxbundle.planning.rendering import Scene, Sensor, render
from jaxbundle.planning.shapes import HeightField, Rectangle
from jaxbundle.planning.texture import Texture

SIZE, F, K1 = (400, 300), 370.0, -0.08
CAMERA = jaxbundle.Camera(
    "cam", "opencv",
    {"fx": F, "fy": F, "cx": 201.5, "cy": 148.0, "k1": K1}, image_size=SIZE,
)  # fmt: skip


def hills(X, Y):
    return 0.5 * np.sin(X / 1.5) * np.cos(Y / 2) + 0.2 * np.sin(2.1 * X + Y)


SIDE, PITCH = 0.8, 1.1
"""Of a marker, and from one to the next."""
PLATE = (0.9, -2.9, 0.9)


@dataclasses.dataclass(frozen=True)
class Markers(Texture):
    """White, with markers 0 and 1 of DICT_4X4_50, and beyond them in t 2 and 3."""

    def __call__(self, s, t, width):
        words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        bits = np.stack([words.generateImageMarker(k, 6) for k in range(4)]) / 255
        number = (s // PITCH).astype(int) + 2 * (t // PITCH).astype(int)
        column, row = (
            np.floor((a % PITCH - (PITCH - SIDE) / 2) / SIDE * 6).astype(int) for a in (s, -t)
        )
        inside = (np.minimum(row, column) >= 0) & (np.maximum(row, column) < 6) & (number < 4)
        black = bits[np.clip(number, 0, 3), np.clip(row, 0, 5), np.clip(column, 0, 5)] < 0.5
        return np.where(inside & black, 0.1, 0.9)


def corner(number, k):
    """Where corner k (1 to 4, clockwise from the upper left one) of a marker lies."""
    begin = np.array([number % 2, number // 2]) * PITCH + (PITCH - SIDE) / 2
    at = [(0, 1), (1, 1), (1, 0), (0, 0)][k - 1]
    return np.array(PLATE) + [*(begin + SIDE * np.array(at)), 0]


def scene(seed, markers=False):
    roof = Rectangle((-1.2, -1.0, 1.4), (2.0, 0, 0.4), (0, 2.0, 0))
    shapes, textures = [HeightField(hills, (-9, -9, 9, 9)), roof], [
        Texture(0.012, seed=seed, side=512)
    ] * 2
    if markers:
        shapes.append(Rectangle(PLATE, (2 * PITCH, 0, 0), (0, 2 * PITCH, 0)))
        textures.append(Markers(0.012))
    return Scene(tuple(shapes), tuple(textures))


def stations(number, seed, spread=1.3):
    """Projection centres on an arc above the ground, and rotations: every fourth turned by 90°."""
    rng = np.random.default_rng(seed)
    azimuth = np.linspace(-spread / 2, spread / 2, number) - 0.6
    out = np.stack([np.cos(azimuth), np.sin(azimuth), 0.9 + 0.25 * np.sin(5 * azimuth)], 1)
    X0 = 6.0 * out + 0.2 * rng.normal(size=(number, 3))
    roll = np.where(np.arange(number) % 4 == 3, np.pi / 2, 0) + 0.05 * rng.normal(size=number)
    return X0, [_looking(X, 0.3 * rng.normal(size=3), k) for X, k in zip(X0, roll)]


def _looking(X0, at, roll):
    z = (X0 - at) / np.linalg.norm(X0 - at)
    x = np.cross([0, 0, 1.0], z)
    x /= np.linalg.norm(x)
    M = np.stack([x, np.cross(z, x), z])
    return Rotation.from_rotvec([0, 0, -roll]).as_matrix() @ M


def write_photographs(folder, prefix, number, seed, camera=CAMERA, markers=False):
    """Photographs as PNG files; returns their true projection centres by file name."""
    folder.mkdir(parents=True, exist_ok=True)
    world, truth = scene(seed, markers), {}
    for k, (X0, M) in enumerate(zip(*stations(number, seed))):
        shot = render(world, camera, X0, M, Sensor(noise=1.5, seed=k + 100 * seed, fine=2))
        name = f"{prefix}{k}.png"
        cv2.imwrite(str(folder / name), shot.grey)
        truth[name] = X0
    return truth
