"""Sets of rendered photographs with the defects of real ones, and their true projection centres.

    python benchmarks/lifelike_sets.py NAME FOLDER [--width PIXELS]

| name | photographs |
|---|---|
| `statue` | half around a statue on a square: paving, a building with mirroring windows, trees |
| `building` | along a front of columns, windows and ornaments that are alike, a hedge before it |
| `room` | a room with bare walls, pictures, identical books; some turned at one place |
| `courtyard` | all around inside a courtyard, opposite wings with identical windows and roofs |
| `drone` | from above, in strips with alternating headings; houses, trees, cars |
| `lake` | the same over a shore: half is water, with waves of its own in each photograph |
| `meadow` | the same over two layers of leaves that the wind moves; ground is seen between |
| `video` | 60 frames of a walk around the statue: close together, blurred by motion, no EXIF |

Every photograph has its own exposure, white balance and tone curve, vignetting and blur towards the
edges, photon noise, sharpening halos, JPEG of quality 85 (`video`: 70). People and a car are at
different places in each; clouds move; panes and bronze mirror the sky, so that reflections move
with the camera.
EXIF states a principal distance that is 5 % too long (`room`, `video`: none).
"""

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import machine
import numpy as np
from photograph_sets import Shot, arc, camera, write

import jaxbundle
from jaxbundle.orientation import batched
from jaxbundle.planning.rendering import Rendered, Scene, Sensor, camera_rays
from jaxbundle.planning.shapes import HeightField, Rectangle
from jaxbundle.planning.stations import stations_looking_at
from jaxbundle.planning.texture import Texture

WRONG = 1.05
"""Principal distance in EXIF, relative to the true one."""
QUALITY = 85
EVERY = 3.0
"""Distance of windows in a wing of the courtyard, and of its floors."""
CLOUDS = Texture(0.008, seed=77, mean=0.8, contrast=0.05)


@dataclasses.dataclass(frozen=True)
class Ellipsoid:
    """A closed surface with vertical axes: `centre`, half axes `radii`."""

    centre: tuple[float, float, float]
    radii: tuple[float, float, float]

    def distances(self, o, d):
        """Lengths of rays to the surface; inf if they miss it."""
        r = np.asarray(self.radii)
        o, d = (o - np.asarray(self.centre)) / r, d / r
        a, b, c = (d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - 1
        root = np.sqrt(np.maximum(b * b - a * c, 0))
        t = (-b - root) / a
        return np.where((b * b > a * c) & (t > 0), t, np.inf)

    def coordinates(self, X):
        """Arc about the vertical axis, and height."""
        x, y, z = np.moveaxis(X - np.asarray(self.centre), -1, 0)
        return self.radii[0] * np.arctan2(y, x), z

    def axes(self, X, size):
        """Normals, and how the texture's coordinates change."""
        x, y, z = np.moveaxis(X - np.asarray(self.centre), -1, 0)
        a, b, c = self.radii
        square = np.maximum(x * x + y * y, 1e-6)
        nil = np.zeros_like(x)
        arc = np.stack([-a * y / square, a * x / square, nil])
        return (x / a**2, y / b**2, z / c**2), _Directions(arc, np.stack([nil, nil, nil + 1]))


class _Directions:
    """Two directions of every point: their products with vectors."""

    def __init__(self, one, other):
        self.one, self.other = one, other

    def __matmul__(self, v):
        return np.stack([(self.one * v).sum(0), (self.other * v).sum(0)])


@dataclasses.dataclass(frozen=True)
class Leaves(Rectangle):
    """A plane of leaves: seen through where `pattern` is dark."""

    pattern: Texture = Texture(0.02)

    def distances(self, o, d):
        """Lengths of rays to a leaf."""
        t = super().distances(o, d)
        hit = np.isfinite(t)
        s, u = self.coordinates(o[hit] + t[hit][:, None] * d[hit])
        t[hit] = np.where(self.pattern(s, u, np.full(len(s), 0.01)) > 0.5, t[hit], np.inf)
        return t


@dataclasses.dataclass(frozen=True)
class Panes(Rectangle):
    """A rectangle in every field of `EVERY` × `EVERY` of a wall: the `limits` of both
    coordinates."""

    limits: tuple[float, float, float, float] = (0.0, 1.0, 0.0, 1.0)

    def distances(self, o, d):
        """Lengths of rays to one of them."""
        t = super().distances(o, d)
        hit = np.isfinite(t)
        s, u = (a % EVERY for a in self.coordinates(o[hit] + t[hit][:, None] * d[hit]))
        left, right, low, high = self.limits
        inside = (s > left) & (s < right) & (u > low) & (u < high)
        t[hit] = np.where(inside, t[hit], np.inf)
        return t


@dataclasses.dataclass
class Stage:
    """A scene under construction: surfaces, textures, and their reflectance."""

    texel: float
    shapes: list = dataclasses.field(default_factory=list)
    textures: list = dataclasses.field(default_factory=list)
    mirrors: dict[int, float] = dataclasses.field(default_factory=dict)

    def add(self, shape, seed, mirror=0.0, **texture) -> None:
        """A surface."""
        if mirror:
            self.mirrors[len(self.shapes)] = mirror
        self.shapes.append(shape)
        given = {"texel": self.texel, "side": 512, **texture}
        self.textures.append(Texture(seed=seed, **given))

    def box(self, corner, size, seed, **texture) -> None:
        """Four sides and the top of an upright box, each with its own texture."""
        (x, y, z), (a, b, c) = corner, size
        for k, (at, along, across) in enumerate((
            ((x, y, z), (a, 0, 0), (0, 0, c)), ((x + a, y, z), (0, b, 0), (0, 0, c)),
            ((x, y + b, z), (a, 0, 0), (0, 0, c)), ((x, y, z), (0, b, 0), (0, 0, c)),
            ((x, y, z + c), (a, 0, 0), (0, b, 0)),
        )):  # fmt: skip
            self.add(Rectangle(at, along, across), seed + k, **texture)

    def tree(self, x, y, z, side, seed) -> None:
        """Layers of leaves, one behind another."""
        for k in range(4):
            corner = (x - side / 2, y + 0.25 * k * side, z)
            pattern = Texture(0.03, seed=seed + k, side=512)
            self.add(Leaves(corner, (side, 0, 0), (0, 0, side), pattern), seed + k, mean=0.3,
                     contrast=0.15)  # fmt: skip

    def person(self, x, y, seed) -> None:
        """A person at a place."""
        self.add(Ellipsoid((x, y, 0.8), (0.28, 0.2, 0.85)), seed, contrast=0.15, mean=0.3)
        self.add(Ellipsoid((x, y, 1.72), (0.11, 0.11, 0.14)), seed + 1, contrast=0.08, mean=0.6)

    def with_others(self) -> "Stage":
        """A copy, to which objects of a single photograph can be added."""
        return dataclasses.replace(self, shapes=[*self.shapes], textures=[*self.textures],
                                   mirrors=dict(self.mirrors))  # fmt: skip


def _sky(direction, moved):
    """Clouds in a direction, 0 to 1, and brighter towards the sun."""
    x, y, z = direction
    azimuth, elevation = np.arctan2(y, x), np.arcsin(np.clip(z, -1, 1))
    grey = CLOUDS(azimuth + moved, elevation, np.full(len(x), 0.003))
    sun = np.clip(direction.T @ np.array([0.48, -0.64, 0.6]), 0, 1)
    return grey + 0.8 * sun**200


def taken(
    seed: int, mirrors: dict[int, float], blurred: float = 0.0
) -> Callable[[Rendered, Shot], np.ndarray]:
    """The processing of a consumer camera from light to file: RGB. `blurred`: the longest motion of
    the image during the exposure, relative to its width."""

    def finish(rendered: Rendered, shot: Shot):
        rng = np.random.default_rng(seed)
        grey = rendered.grey.astype(float)
        d = (camera_rays(shot.camera)[:-1, :-1] @ shot.M).astype(float)
        moved = 0.004 * seed
        sky = rendered.surface < 0
        grey[sky] = 255 * _sky(d[sky].T, moved)
        for k, share in mirrors.items():
            here = rendered.surface == k
            if here.any():
                ray = d[here].T
                normal = shot.scene.shapes[k].axes(rendered.point[here], 1e-3)[0]
                n = np.stack(np.broadcast_arrays(*normal, ray[0])[:3])
                n = n / np.linalg.norm(n, axis=0)
                ray = ray - 2 * (ray * n).sum(0) * n
                grey[here] = (1 - share) * grey[here] + share * 255 * _sky(ray, moved)
        rows, columns = grey.shape
        v, u = np.indices(grey.shape)
        r2 = ((u - columns / 2) ** 2 + (v - rows / 2) ** 2) / (columns / 2) ** 2
        grey = grey * rng.uniform(0.6, 1.25) * (1 - 0.28 * r2 + 0.03 * r2**2)
        soft = cv2.GaussianBlur(grey, (0, 0), 1.6 * columns / 1600)
        edge = np.clip((r2 - 0.25) / 1.3, 0, 1)
        grey = (1 - edge) * grey + edge * soft
        if blurred:
            grey = _moved(grey, blurred * columns * rng.uniform(), rng.uniform(0, np.pi))
        grey = np.clip(grey, 0, None) / 255
        grey = grey + np.sqrt(np.clip(grey, 0, 1) * 4e-4 + 2e-5) * rng.standard_normal(grey.shape)
        grey = np.clip(grey, 0, 1) ** rng.uniform(0.75, 1.0)
        grey = grey + 0.12 * (grey - 0.5) * (1 - np.abs(2 * grey - 1))
        grey = grey + 0.7 * (grey - cv2.GaussianBlur(grey, (0, 0), 1.2))
        balance = rng.uniform(0.88, 1.08, 3)
        return np.clip(np.rint(255 * grey[..., None] * balance), 0, 255).astype(np.uint8)

    return finish


def _moved(grey, distance: float, direction: float):
    """An image that moved by `distance` pixels during its exposure."""
    half = int(np.ceil(distance / 2)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for t in np.linspace(-distance / 2, distance / 2, 33):
        x, y = half + t * np.cos(direction), half + t * np.sin(direction)
        i, j = int(y), int(x)
        across, down = np.array([1 - x + j, x - j]), np.array([1 - y + i, y - i])
        kernel[i : i + 2, j : j + 2] += np.outer(down, across)
    return cv2.filter2D(grey, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT)


def _shots(prefix, stages, X0, at, width, focal, roll, exif=True, quality=QUALITY,
           blurred=0.0):  # fmt: skip
    X0, lens = np.asarray(X0, float), camera(width, focal)
    M = batched.matrices(stations_looking_at(X0, np.asarray(at, float), roll=roll).angles)
    told = ("Pocket", WRONG * focal) if exif else None
    return [
        Shot(f"{prefix}{k:02d}.jpg", Scene(tuple(s.shapes), tuple(s.textures)), lens, X0[k], M[k],
             Sensor(fine=1), quality=quality, exif=told, finish=taken(k, s.mirrors, blurred))
        for k, s in enumerate(stages)
    ]  # fmt: skip


def _front(stage: Stage, y, columns, rows, spacing=3.0) -> None:
    """A wall with windows that mirror, sills and a cornice."""
    long = spacing * columns
    stage.add(Rectangle((-long / 2, y, 0), (long, 0, 0), (0, 0, 3.6 * rows + 1)), 200,
              contrast=0.06, mean=0.6, side=2048)  # fmt: skip
    for k in range(columns):
        x = -long / 2 + spacing * (k + 0.28)
        for row in range(rows):
            z = 1.1 + 3.6 * row
            stage.add(Rectangle((x, y - 0.02, z), (1.3, 0, 0), (0, 0, 1.9)), 210, mirror=0.6,
                      contrast=0.1, mean=0.2)  # fmt: skip
            stage.add(Rectangle((x - 0.15, y - 0.2, z - 0.2), (1.6, 0, 0), (0, 0, 0.2)), 211)
    stage.add(Rectangle((-long / 2, y - 0.5, 3.6 * rows), (long, 0, 0), (0, 0, 0.5)), 213,
              period=1.5)  # fmt: skip


def _square(texel: float) -> Stage:
    """A statue on a square."""
    stage = Stage(texel)
    stage.add(Rectangle((-30, -30, 0), (60, 0, 0), (0, 60, 0)), 1, period=0.8, contrast=0.1)
    stage.box((-0.9, -0.9, 0), (1.8, 1.8, 0.35), 10, contrast=0.08)
    stage.box((-0.6, -0.6, 0.35), (1.2, 1.2, 1.25), 20, contrast=0.1)
    stage.add(Rectangle((-0.4, -0.61, 0.7), (0.8, 0, 0), (0, 0, 0.5)), 29, mirror=0.3)
    bronze = {"contrast": 0.11, "mean": 0.38}
    for k, (centre, radii) in enumerate((
        ((-0.16, 0, 2.1), (0.15, 0.18, 0.6)), ((0.18, -0.1, 2.1), (0.15, 0.18, 0.6)),
        ((0, 0, 2.95), (0.34, 0.22, 0.52)), ((0.02, 0.22, 2.6), (0.42, 0.16, 0.95)),
        ((-0.42, -0.15, 2.9), (0.11, 0.13, 0.42)), ((0.5, -0.2, 3.1), (0.3, 0.1, 0.12)),
        ((0.02, -0.04, 3.65), (0.16, 0.19, 0.23)),
    )):  # fmt: skip
        stage.add(Ellipsoid(centre, radii), 30 + k, mirror=0.15, **bronze)
    _front(stage, 16.0, 8, 2)
    stage.tree(-8, 9, 2.0, 5.0, 60)
    stage.tree(9, 11, 1.5, 6.0, 70)
    return stage


def statue(width: int) -> list[Shot]:
    rng = np.random.default_rng(31)
    n = 11
    stage = _square(0.5 * 6 / (0.9 * width))
    azimuth = np.radians(np.linspace(-160, -20, n)) + 0.04 * rng.normal(size=n)
    X0 = arc(1.0, azimuth, 0.0) * rng.uniform(5.0, 7.0, (n, 1)) + [0, 0, 1.7]
    X0[:, 2] += 0.15 * rng.normal(size=n)
    at = np.array([0, 0, 2.1]) + 0.25 * rng.normal(size=(n, 3))
    stages = []
    for k in range(n):
        one = stage.with_others()
        one.person(*rng.uniform([-3, -1.5], [3, 5]), 300 + 2 * k)
        one.person(*rng.uniform([-6, 2], [6, 8]), 340 + 2 * k)
        one.box((rng.uniform(-12, 8), 13, 0.3), (4.2, 1.8, 1.2), 400, mirror=0.4)
        stages.append(one)
    return _shots("s", stages, X0, at, width, 0.9, 0.03 * rng.normal(size=n))


def video(width: int) -> list[Shot]:
    rng = np.random.default_rng(38)
    n = 60
    stage = _square(0.5 * 6 / (0.9 * width))
    shaken = lambda size: np.convolve(rng.normal(size=n + 4), np.ones(5) / 5, "valid") * size
    azimuth = np.radians(np.linspace(-150, -30, n)) + shaken(0.01)
    X0 = arc(1.0, azimuth, 0.0) * (6.0 + shaken(0.3))[:, None] + [0, 0, 1.6]
    X0[:, 2] += shaken(0.08)
    at = np.array([0, 0, 2.1]) + np.stack([shaken(0.3) for _ in range(3)], 1)
    walker, stages = np.linspace(-5, 4, n), []
    for k in range(n):
        one = stage.with_others()
        one.person(walker[k], 3.0, 300)  # walks through the picture
        stages.append(one)
    return _shots("frame", stages, X0, at, width, 0.9, shaken(0.05), exif=False, quality=70,
                  blurred=0.004)  # fmt: skip


def building(width: int) -> list[Shot]:
    rng = np.random.default_rng(32)
    n, texel = 12, 0.5 * 13 / (0.95 * width)
    stage = Stage(texel)
    stage.add(Rectangle((-30, -30, 0), (60, 0, 0), (0, 30, 0)), 1, contrast=0.08, mean=0.4,
              side=2048)  # fmt: skip
    _front(stage, 0.0, 8, 3)
    for k in range(9):
        stage.add(Ellipsoid((-12 + 3 * k, -1.2, 3.2), (0.35, 0.35, 4.5)), 50, contrast=0.1)
        stage.box((-12.4 + 3 * k, -1.6, 0), (0.8, 0.8, 0.5), 55, contrast=0.1)
    stage.box((-3, -2.4, 0), (6, 2.4, 0.4), 60, contrast=0.12)
    stage.box((-1.2, -0.8, 0.4), (2.4, 0.8, 3.2), 70)
    for k in range(4):
        stage.tree(-11 + 7 * k + rng.normal(), -3.5, 0.0, 1.6, 80 + 5 * k)
    x = np.linspace(-9, 9, n)
    X0 = np.c_[x, -13 + 1.5 * rng.normal(size=n), 1.7 + 0.15 * rng.normal(size=n)]
    at = np.c_[0.55 * x + rng.normal(size=n), np.zeros(n), rng.uniform(3.2, 4.8, n)]
    stages = []
    for k in range(n):
        one = stage.with_others()
        for i in range(3):
            one.person(rng.uniform(-9, 9), rng.uniform(-7, -2), 300 + 6 * k + 2 * i)
        one.box((rng.uniform(-8, 4), -6, 0.3), (4.2, 1.8, 1.2), 400, mirror=0.4)
        stages.append(one)
    return _shots("b", stages, X0, at, width, 0.95, 0.03 * rng.normal(size=n))


def room(width: int) -> list[Shot]:
    rng = np.random.default_rng(33)
    n, texel, focal = 14, 0.5 * 3.5 / (0.7 * width), 0.7
    stage = Stage(texel)
    a, b, c = 6.0, 5.0, 2.6
    stage.add(Rectangle((0, 0, 0), (a, 0, 0), (0, b, 0)), 1, mirror=0.15, period=1.2, contrast=0.1)
    stage.add(Rectangle((0, 0, c), (a, 0, 0), (0, b, 0)), 2, contrast=0.008, mean=0.8)
    for k, (corner, along) in enumerate((
        ((0, 0, 0), (a, 0, 0)), ((a, 0, 0), (0, b, 0)), ((0, b, 0), (a, 0, 0)),
        ((0, 0, 0), (0, b, 0)),
    )):  # fmt: skip
        stage.add(Rectangle(corner, along, (0, 0, c)), 3 + k, contrast=0.012, mean=0.75)
    pictures = (((0.8, 0.02, 1.2), (1.1, 0, 0)), ((3.0, 0.02, 1.3), (0.7, 0, 0)),
                ((a - 0.02, 1, 1.2), (0, 1.4, 0)), ((a - 0.02, 3.2, 1.0), (0, 0.8, 0)),
                ((1.5, b - 0.02, 1.1), (1.3, 0, 0)), ((0.02, 2.0, 1.3), (0, 1.0, 0)))  # fmt: skip
    for k, (corner, along) in enumerate(pictures):
        stage.add(Rectangle(corner, along, (0, 0, 0.8)), 20 + k, mirror=0.08)
    for shelf in range(4):
        for k in range(8):
            stage.add(Rectangle((3.5 + 0.25 * k, b - 0.35, 0.2 + 0.5 * shelf), (0.22, 0, 0),
                                (0, 0, 0.36)), 40 + k % 3)  # fmt: skip
    stage.add(Rectangle((3.4, b - 0.3, 0), (2.2, 0, 0), (0, 0, 2.2)), 50, contrast=0.05, mean=0.3)
    stage.box((2.2, 1.8, 0.68), (1.5, 0.9, 0.06), 60, contrast=0.1)
    for x, y in ((2.2, 1.8), (3.6, 1.8), (2.2, 2.6), (3.6, 2.6)):
        stage.box((x, y, 0), (0.07, 0.07, 0.68), 70, contrast=0.05)
    stage.box((2.6, 2.0, 0.74), (0.25, 0.2, 0.3), 80)
    stage.add(Ellipsoid((3.2, 2.3, 0.88), (0.12, 0.12, 0.15)), 86, mirror=0.3)
    stage.box((0.3, 3.4, 0), (0.9, 1.3, 0.45), 90, contrast=0.1)
    turn = 2 * np.pi * np.arange(n) / n
    X0 = np.c_[3 + 1.7 * np.cos(turn), 2.4 + 1.4 * np.sin(turn), 1.5 + 0.15 * rng.normal(size=n)]
    X0[5] = X0[4] + [0.01, 0.02, 0]  # turned at one place
    X0[10] = X0[9] + [0.02, 0.0, 0.01]
    ahead = turn + np.pi + 0.25 * rng.normal(size=n)
    ahead[5], ahead[10] = ahead[4] + 0.5, ahead[9] + 0.45
    at = X0 + np.c_[2 * np.cos(ahead), 2 * np.sin(ahead), np.full(n, -0.45)]
    stages = [stage.with_others() for _ in range(n)]
    return _shots("r", stages, X0, at, width, focal, 0.03 * rng.normal(size=n), exif=False)


def _wing(stage: Stage, corner, along, columns, rows, seed) -> None:
    """A wing of plaster of its own, with windows, sills and a roof that all wings have."""
    corner, along = np.array([*corner, 0.0]), np.array([*along, 0.0])
    inward, long, high = np.cross([0, 0, 1.0], along), EVERY * columns, EVERY * rows + 1
    at = lambda z, out: tuple(corner + out * inward + [0, 0, z])
    across, up = tuple(long * along), (0, 0, EVERY * rows)
    stage.add(Rectangle(at(0, 0), across, (0, 0, high)), seed, contrast=0.06, mean=0.6, side=2048)
    stage.add(Panes(at(0, 0.02), across, up, (0.84, 2.14, 0.8, 2.6)), 210, mirror=0.6,
              contrast=0.1, mean=0.2, period=EVERY)  # fmt: skip
    stage.add(Panes(at(0, 0.2), across, up, (0.69, 2.29, 0.6, 0.8)), 211, period=EVERY)
    slope = tuple(-3.0 * inward + [0, 0, 2.5])
    stage.add(Rectangle(at(high, 0.4), across, slope), 213, period=1.5, contrast=0.12, mean=0.35)


def courtyard(width: int) -> list[Shot]:
    rng = np.random.default_rng(35)
    n, texel = 24, 0.5 * 14 / (0.9 * width)
    a, b = 15.0, 12.0
    stage = Stage(texel)
    stage.add(Rectangle((-a, -b, 0), (2 * a, 0, 0), (0, 2 * b, 0)), 1, contrast=0.08, mean=0.4,
              side=2048)  # fmt: skip
    for k, (corner, along, columns) in enumerate((
        ((-a, -b), (1, 0), 10), ((a, -b), (0, 1), 8), ((a, b), (-1, 0), 10), ((-a, b), (0, -1), 8),
    )):  # fmt: skip
        _wing(stage, corner, along, columns, 2, 200 + 20 * k)
    stage.box((12.5, 9.5, 0), (2.5, 2.5, 11.0), 300, contrast=0.08, mean=0.55)
    for k, (corner, size) in enumerate((
        ((-14.8, 2, 0), (0.5, 2.2, 3.0)), ((3, 11.5, 0), (2.2, 0.5, 3.2)),
        ((-6, -11.8, 0), (3, 0.6, 0.9)),
    )):  # fmt: skip
        stage.box(corner, size, 310 + 10 * k)
    stage.box((10, -10.8, 0), (4.2, 1.8, 1.4), 340, mirror=0.3)
    stage.tree(-12, 9.0, 1.5, 3.0, 350)
    stage.tree(8, -9.5, 1.0, 2.5, 360)
    turn = 2 * np.pi * np.arange(n) / n
    X0 = np.c_[9 * np.cos(turn), 7 * np.sin(turn), 1.7 + 0.1 * rng.normal(size=n)]
    X0 += 0.5 * rng.normal(size=(n, 3)) * [1, 1, 0]
    ahead = turn + np.pi + 0.12 * rng.normal(size=n)
    at = X0 + np.c_[10 * np.cos(ahead), 10 * np.sin(ahead), np.full(n, 1.3)]
    stages = []
    for k in range(n):
        one = stage.with_others()
        one.person(*rng.uniform([-6, -5], [6, 5]), 400 + 4 * k)
        stages.append(one)
    return _shots("y", stages, X0, at, width, 0.9, 0.03 * rng.normal(size=n))


def _flat(X, Y):
    """Heights of nearly level ground."""
    return 1.5 * np.sin(X / 25) * np.cos(Y / 30) + 0.4 * np.sin(X / 6 + Y / 9)


def _flight(prefix, seed, width, slope=0.0, change=lambda stage, k: None) -> list[Shot]:
    """A flight over ground with houses, trees and cars that rises by `slope` along X; `change` adds
    what a single photograph shows."""
    rng = np.random.default_rng(seed)
    high, focal, strips, each = 60.0, 0.75, 3, 5
    n = strips * each
    stage = Stage(0.5 * high / (focal * width))
    ground = lambda X, Y: slope * X + _flat(X, Y)
    stage.add(HeightField(ground, (-150, -130, 150, 130)), 1, side=2048, contrast=0.12, mean=0.4)
    for k in range(14):
        (x, y), (a, b) = rng.uniform([-50, -40], [50, 40]), rng.uniform(5, 12, 2)
        stage.box((x, y, slope * x - 1), (a, b, rng.uniform(4, 10)), 100 + 7 * k, contrast=0.1,
                  mean=rng.uniform(0.3, 0.7))  # fmt: skip
    for k in range(8):
        (x, y), r = rng.uniform([-50, -40], [50, 40]), rng.uniform(1.5, 4)
        stage.add(Ellipsoid((x, y, slope * x + r), (r, r, 1.3 * r)), 500 + k, contrast=0.15,
                  mean=0.3)  # fmt: skip
    along, aside = 0.25 * high / focal, 0.35 * 0.75 * high / focal
    X, Y = np.meshgrid(along * (np.arange(each) - 2), aside * (np.arange(strips) - 1))
    X0 = np.c_[X.ravel(), Y.ravel(), np.full(n, high)] + rng.normal(size=(n, 3)) * [1, 1, 0.7]
    at = (X0 + 0.03 * high * rng.normal(size=(n, 3))) * [1, 1, 0]
    stages = []
    for k in range(n):
        one = stage.with_others()
        for i in range(3):
            x, y = rng.uniform([-60, -50], [60, 50])
            one.box((x, y, slope * x), (4.2, 1.8, 1.5), 900 + 10 * k + i)
        change(one, k)
        stages.append(one)
    roll = np.where(np.arange(n) // each % 2 == 1, np.pi, 0.0) + 0.03 * rng.normal(size=n)
    return _shots(prefix, stages, X0, at, width, focal, roll)


def drone(width: int) -> list[Shot]:
    return _flight("n", 36, width)


def lake(width: int) -> list[Shot]:
    def waves(stage: Stage, k: int) -> None:
        stage.add(Rectangle((-150, -130, 0), (300, 0, 0), (0, 260, 0)), 2000 + k, mirror=0.5,
                  contrast=0.08, mean=0.2, side=2048)  # fmt: skip

    return _flight("l", 37, width, 0.08, waves)


def meadow(width: int) -> list[Shot]:
    def wind(stage: Stage, k: int) -> None:
        for layer, z in enumerate((1.8, 2.4)):
            pattern = Texture(0.1, seed=2000 + 2 * k + layer, side=1024)
            stage.add(Leaves((-150, -130, z), (300, 0, 0), (0, 260, 0), pattern),
                      2100 + 2 * k + layer, mean=0.3, contrast=0.12)  # fmt: skip

    return _flight("m", 39, width, change=wind)


LIFELIKE: dict[str, Callable[[int], list[Shot]]] = {
    f.__name__: f for f in (statue, building, room, courtyard, drone, lake, meadow, video)
}


def main():
    parser = machine.parser_of(__doc__)
    parser.add_argument("name", choices=LIFELIKE)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--width", type=machine.positive, default=1600)
    given = parser.parse_args()
    jaxbundle.enable_x64()
    write(LIFELIKE[given.name](given.width), given.folder)


if __name__ == "__main__":
    sys.exit(main())
