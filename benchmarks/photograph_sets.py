"""Sets of rendered photographs that are difficult to orient, with their true projection centres.

    python benchmarks/photograph_sets.py NAME FOLDER [--width PIXELS]

| name | photographs |
|---|---|
| `convergent` | hills with a roof, every fourth photograph turned about its axis |
| `facade` | identical windows, pillars in front, sky, passers-by, exposures, JPEG of quality 75 |
| `chain` | a long facade of identical windows, each photograph sees a part of it |
| `loop` | all around a fountain, 24 degrees from one to the next |
| `wide` | hills, 27 degrees from one to the next |
| `depth` | a square seen by pedestrians, objects 3 to 40 m away |
| `portrait` | a facade, three of the photographs stored upright |
| `cameras` | two cameras of different sizes and principal distances, given by EXIF |
| `parts` | hills and a facade that have nothing in common |
| `scenes` | hills and the square of `depth`, which have nothing in common |
| `foreign` | hills, and three photographs of other places |
| `turntable` | a fountain that turns by 18 degrees before a still camera and a still room |
| `frames` | hills, 40 frames of a video carried by hand, 1 degree from one to the next |

Unless stated otherwise, the principal distance is unknown.
"""

import dataclasses
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import machine
import numpy as np

import jaxbundle
from jaxbundle.orientation import batched
from jaxbundle.planning.rendering import Rendered, Scene, Sensor, render
from jaxbundle.planning.shapes import HeightField, Rectangle
from jaxbundle.planning.stations import stations_looking_at
from jaxbundle.planning.texture import Texture

FOCAL, K1 = 0.9, -0.08
WIDTH = 1600


@dataclasses.dataclass(frozen=True)
class Shot:
    """A photograph to be rendered: its scene and camera, centre and rotation; how it is stored;
    `part`: photographs of one number belong together, 0: none; `finish`: turns the rendered image
    into a photograph."""

    name: str
    scene: Scene
    camera: jaxbundle.Camera
    X0: np.ndarray
    M: np.ndarray
    sensor: Sensor
    quality: int = 95
    upright: bool = False
    exif: tuple[str, float] | None = None
    part: int = 1
    finish: Callable[[Rendered, "Shot"], np.ndarray] | None = None


def camera(width: int, focal: float = FOCAL) -> jaxbundle.Camera:
    """A camera with distortion and an off-centre principal point."""
    height, f = 3 * width // 4, focal * width
    parameters = {"fx": f, "fy": f, "cx": 0.503 * width, "cy": 0.498 * height, "k1": K1}
    return jaxbundle.Camera("cam", "opencv", parameters, image_size=(width, height))


def shots(
    prefix: str, scenes, X0, at, width: int, roll=0.0, focal: float = FOCAL, gain=None, **stored
) -> list[Shot]:
    """Photographs from X0 towards `at`, of one scene or of one scene each."""
    X0 = np.asarray(X0, float)
    n = len(X0)
    scenes = scenes if isinstance(scenes, list) else [scenes] * n
    gain = np.ones(n) if gain is None else gain
    placed = stations_looking_at(X0, np.asarray(at, float), roll=roll)
    M, lens = batched.matrices(placed.angles), camera(width, focal)
    return [
        Shot(f"{prefix}{k:02d}.jpg", scenes[k], lens, X0[k], M[k],
             Sensor(gain[k], noise=2.0, seed=k, fine=1, background=215.0), **stored)
        for k in range(n)
    ]  # fmt: skip


def hills_scene(texel: float, seed: int = 1) -> Scene:
    """Hills with a roof."""
    height = lambda X, Y: 0.5 * np.sin(X / 1.5) * np.cos(Y / 2) + 0.2 * np.sin(2.1 * X + Y)
    roof = Rectangle((-1.2, -1.0, 1.4), (2.0, 0, 0.4), (0, 2.0, 0))
    texture = Texture(texel, seed=seed, side=2048)
    return Scene((HeightField(height, (-9, -9, 9, 9)), roof), (texture,))


def arc(radius: float, azimuth, elevation) -> np.ndarray:
    """Places around the origin, azimuth 0 in the direction of X."""
    a, e = np.broadcast_arrays(azimuth, elevation)
    return radius * np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], 1)


def facade_scene(columns: int, texel: float, people: Sequence = (), pillars: bool = True) -> Scene:
    """A wall in the plane Y = 0 with identical windows every 3 m, identical pillars, the ground."""
    long, window, pillar = 3.0 * columns, Texture(texel, seed=5), Texture(texel, seed=6)
    wall = Texture(texel, seed=3, contrast=0.07, mean=0.6)
    shapes = [Rectangle((-long / 2, 0, 0), (long, 0, 0), (0, 0, 9.5)),
              Rectangle((-long / 2, 0, 0), (long, 0, 0), (0, -20, 0))]  # fmt: skip
    textures = [wall, Texture(texel, seed=4, contrast=0.1, mean=0.35)]
    for k in range(columns):
        x = -long / 2 + 3.0 * k
        for row in range(3):
            shapes.append(Rectangle((x + 0.8, -0.12, 0.9 + 3 * row), (1.4, 0, 0), (0, 0, 1.8)))
            textures.append(window)
        if pillars:
            shapes.append(Rectangle((x - 0.25, -1.6, 0), (0.5, 0, 0), (0, 0, 8)))
            textures.append(pillar)
    for k, (x, y) in enumerate(people):
        shapes.append(Rectangle((x, y, 0), (0.6, 0, 0), (0, 0, 1.8)))
        textures.append(Texture(texel, seed=100 + k))
    return Scene(tuple(shapes), tuple(textures))


def facade(width: int) -> list[Shot]:
    rng = np.random.default_rng(7)
    n, texel = 12, 0.5 * 17 / (FOCAL * width)
    azimuth = np.radians(np.linspace(-145, -35, n))
    X0 = arc(17.0, azimuth, 0.0) + [0, 0, 1.7] + 0.4 * rng.normal(size=(n, 3)) * [1, 1, 0.3]
    at = np.c_[2.5 * rng.normal(size=n), np.zeros(n), rng.uniform(3.5, 5.5, n)]
    people = [np.c_[rng.uniform(-9, 9, 5), rng.uniform(-9, -3, 5)] for _ in range(n)]
    scenes = [facade_scene(7, texel, who) for who in people]
    gain = rng.uniform(0.55, 1.25, n)
    return shots("f", scenes, X0, at, width, 0.03 * rng.normal(size=n), gain=gain, quality=75)


def chain(width: int) -> list[Shot]:
    rng = np.random.default_rng(8)
    n, texel = 14, 0.5 * 9 / (FOCAL * width)
    x = np.linspace(-20, 20, n)
    X0 = np.c_[x, -9 + 0.6 * rng.normal(size=n), 3 + 0.8 * rng.normal(size=n)]
    at = np.c_[x + 1.2 * rng.normal(size=n), np.zeros(n), 4 + 0.3 * rng.normal(size=n)]
    return shots("c", facade_scene(17, texel), X0, at, width, 0.03 * rng.normal(size=n))


def fountain_scene(texel: float) -> Scene:
    """A bowl with a rim, a box in the middle of it, paving."""

    def height(X, Y):
        r = np.hypot(X, Y)
        return 0.7 * np.exp(-(((r - 2.2) / 0.25) ** 2)) + 0.9 * np.exp(-((r / 0.8) ** 2))

    faces = [Rectangle((-0.4, s * 0.4, 0.4), (0.8, 0, 0), (0, 0, 1.6)) for s in (-1, 1)]
    faces += [Rectangle((s * 0.4, -0.4, 0.4), (0, 0.8, 0), (0, 0, 1.6)) for s in (-1, 1)]
    top = Rectangle((-0.4, -0.4, 2.0), (0.8, 0, 0), (0, 0.8, 0))
    shapes = HeightField(height, (-14, -14, 14, 14)), *faces, top
    textures = [Texture(texel, seed=20 + k) for k in range(len(shapes))]
    return Scene(shapes, tuple(textures))


def loop(width: int) -> list[Shot]:
    rng = np.random.default_rng(9)
    n, texel = 15, 0.5 * 7 / (FOCAL * width)
    X0 = arc(7.0, np.arange(n) * 2 * np.pi / n, 0.4 + 0.1 * rng.normal(size=n))
    at = 0.3 * rng.normal(size=(n, 3)) + [0, 0, 0.5]
    return shots("l", fountain_scene(texel), X0, at, width, 0.05 * rng.normal(size=n), quality=85)


def wide(width: int) -> list[Shot]:
    rng = np.random.default_rng(10)
    n, texel = 6, 0.5 * 6 / (FOCAL * width)
    X0 = arc(6.0, np.radians(27) * (np.arange(n) - n / 2), 0.85 + 0.1 * rng.normal(size=n))
    return shots("w", hills_scene(texel), X0, 0.3 * rng.normal(size=(n, 3)), width,
                 np.where(np.arange(n) % 3 == 2, np.pi / 2, 0.0))  # fmt: skip


def depth(width: int) -> list[Shot]:
    rng = np.random.default_rng(11)
    n, texel = 10, 0.5 * 5 / (FOCAL * width)
    shapes = [Rectangle((-40, -5, 0), (80, 0, 0), (0, 60, 0)),
              Rectangle((-40, 42, 0), (80, 0, 0), (0, 0, 12))]  # fmt: skip
    for k in range(14):
        x, y, side = rng.uniform(-14, 14), 4 + 2.2 * k, rng.uniform(0.8, 2.2)
        shapes += [Rectangle((x, y, 0), (side, 0, 0), (0, 0, side)),
                   Rectangle((x, y, 0), (0, side, 0), (0, 0, side)),
                   Rectangle((x, y, side), (side, 0, 0), (0, side, 0))]  # fmt: skip
    textures = [Texture(texel * (1 + k % 4), seed=40 + k, side=512) for k in range(len(shapes))]
    x = np.linspace(-4, 4, n)
    X0 = np.c_[x, rng.uniform(-1.5, 1.5, n), 1.7 + 0.4 * rng.normal(size=n)]
    at = np.c_[0.3 * x, np.full(n, 12.0), np.full(n, 1.0)]
    return shots("d", Scene(tuple(shapes), tuple(textures)), X0, at, width, gain=np.full(n, 0.9))


def portrait(width: int) -> list[Shot]:
    rng = np.random.default_rng(12)
    n, texel = 10, 0.5 * 14 / (FOCAL * width)
    turned = np.arange(n) % 4 == 2
    X0 = arc(14.0, np.radians(np.linspace(-130, -50, n)), 0.0) + [0, 0, 2.5]
    at = np.c_[1.5 * rng.normal(size=n), np.zeros(n), rng.uniform(3, 5, n)]
    roll = np.where(turned, -np.pi / 2, 0.0)
    found = shots("p", facade_scene(7, texel), X0, at, width, roll)
    return [dataclasses.replace(s, upright=bool(t)) for s, t in zip(found, turned)]


def cameras(width: int) -> list[Shot]:
    rng = np.random.default_rng(13)
    n, texel = 12, 0.5 * 6 / (FOCAL * width)
    X0 = arc(6.0, np.linspace(-0.8, 0.8, n), 0.8 + 0.15 * rng.normal(size=n))
    at, scene = 0.3 * rng.normal(size=(n, 3)), hills_scene(texel)
    one = shots("a", scene, X0[::2], at[::2], width, exif=("One", FOCAL))
    two = shots("b", scene, X0[1::2], at[1::2], 7 * width // 8 // 4 * 4, focal=1.2,
                exif=("Two", 1.2))  # fmt: skip
    return one + two


def parts(width: int) -> list[Shot]:
    return [*map(_other, facade(width)[3:9]), *convergent(width, 8)]


def scenes(width: int) -> list[Shot]:
    return [*map(_other, depth(width)[2:8]), *convergent(width, 8)]


def _other(shot: Shot) -> Shot:
    return dataclasses.replace(shot, name=f"other_{shot.name}", part=2)


def foreign(width: int) -> list[Shot]:
    others = [facade(width)[5], loop(width)[2], depth(width)[4]]
    rename = lambda s: dataclasses.replace(s, name=f"foreign_{s.name}", part=0)
    return [*map(rename, others), *convergent(width, 8)]


def convergent(width: int, number: int = 11) -> list[Shot]:
    """Photographs of hills, every fourth turned about its axis."""
    rng = np.random.default_rng(0)
    azimuth = np.linspace(-0.9, 0.9, number)
    X0 = arc(6.0, azimuth, 0.75 + 0.25 * np.sin(5 * azimuth))
    roll = np.where(np.arange(number) % 4 == 3, np.pi / 2, 0.05 * rng.normal(size=number))
    scene = hills_scene(0.5 * 6 / (FOCAL * width))
    return shots("photo_", scene, X0, 0.3 * rng.normal(size=(number, 3)), width, roll)


def turntable(width: int) -> list[Shot]:
    """The room is a picture of a facade, the same behind all."""
    n, texel = 20, 0.5 * 7 / (FOCAL * width)
    scene = fountain_scene(texel)
    disc = HeightField(scene.shapes[0].height, (-2.6, -2.6, 2.6, 2.6))
    scene = Scene((disc, *scene.shapes[1:]), scene.textures)
    X0 = arc(7.0, np.arange(n) * 2 * np.pi / n, 0.45)
    found = shots("t", scene, X0, np.tile([0.0, 0, 0.5], (n, 1)), width)
    far = facade(width)[4]
    room = render(far.scene, far.camera, far.X0, far.M, far.sensor).grey

    def before_the_room(rendered: Rendered, shot: Shot) -> np.ndarray:
        noise = np.random.default_rng(shot.sensor.seed).normal(0, 2, room.shape)
        still = np.clip(room + noise, 0, 255).astype(np.uint8)
        return np.where(rendered.surface >= 0, rendered.grey, still)

    return [dataclasses.replace(shot, finish=before_the_room) for shot in found]


def frames(width: int) -> list[Shot]:
    rng = np.random.default_rng(15)
    n, texel = 40, 0.5 * 6 / (FOCAL * width)
    shake = lambda size: np.cumsum(size * rng.normal(size=(n, 3)), 0)
    X0 = arc(6.0, np.radians(np.arange(n) - n / 2), 0.8) + shake(0.01)
    return shots("v", hills_scene(texel), X0, shake(0.01), width, quality=80)


SETS: dict[str, Callable[[int], list[Shot]]] = {
    f.__name__: f
    for f in (
        convergent, facade, chain, loop, wide, depth, portrait, cameras, parts, scenes, foreign,
        turntable, frames,
    )  # fmt: skip
}


def write(shots: Sequence[Shot], folder: Path) -> None:
    """Render the missing photographs."""
    folder.mkdir(parents=True, exist_ok=True)
    for shot in shots:
        path = folder / shot.name
        if not path.exists():
            rendered = render(shot.scene, shot.camera, shot.X0, shot.M, shot.sensor)
            _store(shot.finish(rendered, shot) if shot.finish else rendered.grey, shot, path)


def _store(pixels, shot: Shot, path: Path) -> None:
    from PIL import Image

    head = Image.Exif()
    if shot.exif is not None:
        model, focal = shot.exif
        head[0x010F], head[0x0110] = "Rendered", f"Rendered {model}"
        rows, columns = pixels.shape[:2]
        head.get_ifd(0x8769)[0xA405] = round(focal * columns * 43.2666 / np.hypot(columns, rows))
    pixels = np.rot90(pixels, -1) if shot.upright else pixels
    Image.fromarray(np.ascontiguousarray(pixels)).save(path, quality=shot.quality, exif=head)


def main():
    parser = machine.parser_of(__doc__)
    parser.add_argument("name", choices=SETS)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--width", type=machine.positive, default=WIDTH)
    given = parser.parse_args()
    jaxbundle.enable_x64()
    write(SETS[given.name](given.width), given.folder)


if __name__ == "__main__":
    sys.exit(main())
