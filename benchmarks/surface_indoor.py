"""Dense matching of a rendered stereo pair of a room: a large range of disparities, thin objects, a
wall of weak texture.

    python benchmarks/surface_indoor.py [--megapixels 6]

Says how many pixels have a point, of those that both photographs see as well, how many of the
points are off by more than 2 and 0.5 pixels, errors over σ, and the time.
"""

import argparse
import resource
import time

import numpy as np

import jaxbundle
from jaxbundle.planning.render import Scene, Sensor, render
from jaxbundle.planning.shapes import Rectangle
from jaxbundle.planning.texture import Texture
from jaxbundle.surface.reconstruct import find_bounds, reconstruct
from jaxbundle.surface.views import FrameView

BASE, DEPTH = 0.2, 5.0
ROOM = 2.6, 1.6


def box(x, y, near, w, h, d):
    """Front, both sides and the top of a box whose front is at Z = −near."""
    X, Y, Z = np.eye(3)
    corner = np.array([x, y, -near])
    return [Rectangle(tuple(c), tuple(a), tuple(b)) for c, a, b in (
        (corner, w * X, h * Y), (corner, -d * Z, h * Y), (corner + w * X, -d * Z, h * Y),
        (corner + h * Y, w * X, -d * Z))]  # fmt: skip


def room(texel):
    """Walls and a floor, boxes, poles 8 mm thick before them."""
    X, Y, Z = np.eye(3)
    a, b = ROOM
    corner = np.array([-a, -b, -DEPTH])
    walls = [Rectangle(tuple(c), tuple(u), tuple(v)) for c, u, v in (
        (corner, 2 * a * X, 2 * b * Y), (corner, 2 * a * X, DEPTH * Z),
        (corner, DEPTH * Z, 2 * b * Y), (corner + 2 * a * X, DEPTH * Z, 2 * b * Y),
        (corner + 2 * b * Y, 2 * a * X, DEPTH * Z))]  # fmt: skip
    things = [*box(-0.9, -0.8, 2.4, 0.7, 0.5, 0.6), *box(0.3, -1.2, 3.2, 0.9, 1.1, 0.5)]
    poles = [Rectangle((x, -0.7, -1.7), (0.008, 0, 0), (0, 1.3, 0)) for x in (-0.25, 0.1, 0.55)]
    wall = Texture(4 * texel, seed=1), Texture(2 * texel, seed=2)
    weak = Texture(2 * texel, seed=3, contrast=0.015)
    textures = [wall[0], wall[1], wall[1], weak, weak, *[Texture(texel, seed=4)] * len(things),
                *[Texture(texel, seed=5)] * len(poles)]  # fmt: skip
    return Scene((*walls, *things, *poles), tuple(textures))


def photographs(megapixels):
    """Two photographs, and the true points of the first's pixels."""
    rows = int(np.sqrt(megapixels * 1e6 / 1.5))
    size = int(1.5 * rows), rows
    f = size[0] * 0.95
    camera = jaxbundle.Camera("cam", "opencv", {
        "fx": f, "fy": f, "cx": (size[0] - 1) / 2, "cy": (size[1] - 1) / 2,
    }, image_size=size)  # fmt: skip
    scene = room(0.5 * 1.7 / f)
    shots = [render(scene, camera, np.array([x, 0, 0.0]), np.eye(3), Sensor(noise=1.5, seed=k))
             for k, x in enumerate((0.0, BASE))]  # fmt: skip
    views = [FrameView(f"photo_{k}", shot.grey, camera, np.array([x, 0, 0.0]), np.eye(3))
             for k, (shot, x) in enumerate(zip(shots, (0.0, BASE)))]  # fmt: skip
    return views, [shot.point for shot in shots], f


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--megapixels", type=float, default=6.0)
    jaxbundle.enable_x64()
    begin = time.perf_counter()
    views, truth, f = photographs(parser.parse_args().megapixels)
    print(f"{views[0].size} pixels, rendered in {time.perf_counter() - begin:.0f} s", flush=True)
    begin = time.perf_counter()
    bounds, _ = find_bounds(views, np.zeros((0, 3)))
    found = reconstruct(views, bounds, {0: [1]}, dense=True)
    taken = time.perf_counter() - begin
    true = f * BASE / -truth[0][..., 2]
    columns = np.arange(views[0].size[0]) - np.rint(true)
    inside = columns >= 0
    other = np.take_along_axis(f * BASE / -truth[1][..., 2],
                               np.where(inside, columns, 0).astype(int), axis=1)  # fmt: skip
    seen = inside & (np.abs(other - true) < 1)
    cloud = found.cloud
    v, u = cloud.uv.astype(int).T[::-1]
    error = f * BASE / -cloud.X[:, 2] - true[v, u]
    w = (cloud.X[:, 2] - truth[0][v, u][:, 2]) / cloud.sigma[:, 2]
    print(f"disparities {true.min():.0f} to {true.max():.0f}; {taken:.0f} s, "
          f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.1f} GB")
    print(f"{100 * len(cloud) / true.size:.1f} % of all pixels have a point, "
          f"{100 * seen[v, u].sum() / seen.sum():.1f} % of those both see; bad by 2 px "
          f"{100 * np.mean(np.abs(error) > 2):.2f} %, by 0.5 px "
          f"{100 * np.mean(np.abs(error) > 0.5):.2f} %; errors over σ: RMS "
          f"{np.sqrt(np.mean(w[np.abs(error) < 1] ** 2)):.2f}, within 3 "
          f"{100 * np.mean(np.abs(w) < 3):.1f} %")


if __name__ == "__main__":
    main()
