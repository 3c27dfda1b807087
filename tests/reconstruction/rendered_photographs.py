"""Rendered convergent photographs as files: hills with a roof, by a camera with distortion."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

import jaxbundle
from jaxbundle.planning.render import Scene, Sensor, render
from jaxbundle.planning.shapes import HeightField, Rectangle
from jaxbundle.planning.texture import Texture

SIZE, F, K1 = (400, 300), 370.0, -0.08
CAMERA = jaxbundle.Camera(
    "cam", "opencv",
    {"fx": F, "fy": F, "cx": 201.5, "cy": 148.0, "k1": K1}, image_size=SIZE,
)  # fmt: skip


def hills(X, Y):
    return 0.5 * np.sin(X / 1.5) * np.cos(Y / 2) + 0.2 * np.sin(2.1 * X + Y)


def scene(seed):
    roof = Rectangle((-1.2, -1.0, 1.4), (2.0, 0, 0.4), (0, 2.0, 0))
    shapes = HeightField(hills, (-9, -9, 9, 9)), roof
    return Scene(shapes, (Texture(0.012, seed=seed, side=512),))


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


def write_photographs(folder, prefix, number, seed, camera=CAMERA):
    """Photographs as PNG files; returns their true projection centres by file name."""
    folder.mkdir(parents=True, exist_ok=True)
    world, truth = scene(seed), {}
    for k, (X0, M) in enumerate(zip(*stations(number, seed))):
        shot = render(world, camera, X0, M, Sensor(noise=1.5, seed=k + 100 * seed, fine=2))
        name = f"{prefix}{k}.png"
        cv2.imwrite(str(folder / name), shot.grey)
        truth[name] = X0
    return truth
