"""Dense matching of a rendered stereo pair of a room: a large range of disparities, thin objects, a
wall of weak texture; compared with OpenCV's semi-global matching of the same pair.

    python benchmarks/surface_indoor.py [--megapixels 6] [--gain 1] [--shade 0] [--sparse]

The right photograph is taken with another exposure (`--gain`), and darker towards one side by a
fraction `--shade`. The output gives the fraction of pixels with a point, of all and of those that
both photographs see, the fraction of points off by more than 0.5, 1 and 2 pixels, errors over σ,
and the time.
"""

import argparse
import dataclasses
import resource
import time

import cv2
import numpy as np

import jaxbundle
from jaxbundle.planning.rendering import Scene, Sensor, render
from jaxbundle.planning.shapes import Rectangle
from jaxbundle.planning.texture import Texture
from jaxbundle.surfaces.reconstruct import find_bounds, reconstruct_surface
from jaxbundle.surfaces.views import FrameView

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


def photographs(megapixels, gain=1.0, shade=0.0):
    """Two photographs, and the true points of their pixels."""
    rows = int(np.sqrt(megapixels * 1e6 / 1.5))
    size = int(1.5 * rows), rows
    f = size[0] * 0.95
    camera = jaxbundle.Camera("cam", "opencv", {
        "fx": f, "fy": f, "cx": (size[0] - 1) / 2, "cy": (size[1] - 1) / 2,
    }, image_size=size)  # fmt: skip
    scene = room(0.5 * 1.7 / f)
    shots = [render(scene, camera, np.array([x, 0, 0.0]), np.eye(3),
                    Sensor(noise=1.5, seed=k, gain=gain if k else 1.0))
             for k, x in enumerate((0.0, BASE))]  # fmt: skip
    darker = np.rint(shots[1].grey * np.linspace(1, 1 - shade, size[0])).astype(np.uint8)
    shots[1] = dataclasses.replace(shots[1], grey=darker)
    views = [FrameView(f"photo_{k}", shot.grey, camera, np.array([x, 0, 0.0]), np.eye(3))
             for k, (shot, x) in enumerate(zip(shots, (0.0, BASE)))]  # fmt: skip
    return views, [shot.point for shot in shots], f


def semi_global(views, low, high):
    """Disparities by OpenCV with the parameters of its own sample; NaN where it has none."""
    number = -(-(high - low + 1) // 16) * 16
    matcher = cv2.StereoSGBM.create(low, number, 3, 8 * 9, 32 * 9, 1, 63, 10, 100, 32)
    found = matcher.compute(*(view.grey for view in views)).astype(float) / 16
    return np.where(found >= low, found, np.nan)


def say(name, error, seen):
    """The fraction of pixels with a disparity, and the errors of these."""
    known = np.isfinite(error)
    bad = [100 * np.mean(np.abs(error[known]) > limit) for limit in (0.5, 1, 2)]
    print(f"{name}: {100 * known.mean():.1f} % of all pixels have a point, "
          f"{100 * known[seen].mean():.1f} % of those both see; off by more than 0.5, 1, 2 px: "
          + ", ".join(f"{b:.2f}" for b in bad) + " %")  # fmt: skip


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--megapixels", type=float, default=6.0)
    parser.add_argument("--gain", type=float, default=1.0)
    parser.add_argument("--shade", type=float, default=0.0)
    parser.add_argument("--sparse", action="store_true")
    given = parser.parse_args()
    jaxbundle.enable_x64()
    begin = time.perf_counter()
    views, truth, f = photographs(given.megapixels, given.gain, given.shade)
    print(f"{views[0].size} pixels, rendered in {time.perf_counter() - begin:.0f} s", flush=True)
    true = f * BASE / -truth[0][..., 2]
    columns = np.arange(views[0].size[0]) - np.rint(true)
    inside = columns >= 0
    other = np.take_along_axis(f * BASE / -truth[1][..., 2],
                               np.where(inside, columns, 0).astype(int), axis=1)  # fmt: skip
    seen = inside & (np.abs(other - true) < 1)
    begin = time.perf_counter()
    bounds, _ = find_bounds(views, np.zeros((0, 3)))
    options = {"step": 4} if given.sparse else {"dense": True}
    cloud = reconstruct_surface(views, bounds, {0: [1]}, **options).cloud
    taken = time.perf_counter() - begin
    v, u = cloud.uv.astype(int).T[::-1]
    error = np.full(true.shape, np.nan)
    error[v, u] = f * BASE / -cloud.X[:, 2] - true[v, u]
    print(f"disparities {true.min():.0f} to {true.max():.0f}; {taken:.0f} s, "
          f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.1f} GB")
    tried = (slice(None, None, 4),) * 2 if given.sparse else (slice(None),) * 2
    say("sparse" if given.sparse else "dense", error[tried], seen[tried])
    w, near = (cloud.X[:, 2] - truth[0][v, u][:, 2]) / cloud.sigma[:, 2], np.abs(error[v, u]) < 1
    print(f"errors over σ: RMS {np.sqrt(np.mean(w[near] ** 2)):.2f}, within 3 "
          f"{100 * np.mean(np.abs(w) < 3):.1f} %")
    plain = semi_global(views, int(true.min()) - 8, int(true.max()) + 8)
    say("OpenCV", (plain - true)[tried], seen[tried])


if __name__ == "__main__":
    main()
