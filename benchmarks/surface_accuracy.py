"""The accuracy of surface points: rendered photographs of a known surface, two and four,
sparse and dense, with little and strong noise, occlusion, repeated texture, little overlap, none.

    python benchmarks/surface_accuracy.py [SCENE …] [--dense] [--sparse] [--seed N]

For every point: the largest error in any image, pixels, and the error of the height over its σ.
Required: 95 % within 0.2 pixel, RMS of the errors over σ 0.9 to 1.1 (dense: 0.75 to 1.1, since
relief and steps are on the safe side), 99 % within 3 σ, under 1 % farther off than a pixel.
"""

import argparse
import time

import numpy as np

import jaxbundle
from jaxbundle.planning.rendering import Scene, Sensor, render
from jaxbundle.planning.shapes import HeightField, Rectangle, Shape
from jaxbundle.planning.texture import Texture
from jaxbundle.surfaces.reconstruct import find_bounds, reconstruct_surface
from jaxbundle.surfaces.views import FrameView

SIZE, F = (480, 360), 480.0
HEIGHT = 10.0
OUTLIER = 1.0
"""Pixels."""
CAMERA = jaxbundle.Camera(
    "cam", "opencv", {"fx": F, "fy": F, "cx": 239.5, "cy": 179.5, "k1": -0.05}, image_size=SIZE
)
STEREO = ((-1.0, 0, HEIGHT), (1.0, 0, HEIGHT))
CONVERGENT = ((-2.2, -1.5, HEIGHT), (2.2, -1.5, HEIGHT), (2.2, 1.5, HEIGHT), (-2.2, 1.5, HEIGHT))
NARROW = ((-2.9, 0, HEIGHT), (2.9, 0, HEIGHT))


def hills(X, Y):
    return 0.6 * np.sin(X / 2) * np.cos(Y / 3)


def scene(roof=True, seed=1, **texture):
    """Hills, and a roof above them."""
    shapes: list[Shape] = [HeightField(hills, (-15, -15, 15, 15))]
    if roof:
        shapes.append(Rectangle((-1.2, -1.2, 2.0), (2.0, 0, 0), (0, 2.0, 0)))
    return Scene(tuple(shapes), (Texture(0.01, seed=seed, side=1024, **texture),))


def towards(X0, target=(0.0, 0.0, 0.0)):
    """Rotation from object to a camera at X0 that looks at a place, x to the right."""
    z = np.subtract(X0, target)
    z = z / np.linalg.norm(z)
    x = np.cross((0, 1.0, 0), z)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def photographs(places, what, noise=2.0, convergent=False, fine=2, seed=1):
    """Views, and the true points of their pixels."""
    views, truth = [], []
    for k, X0 in enumerate(places):
        M = towards(X0) if convergent else np.eye(3)
        sensor = Sensor(noise=noise, seed=10 * seed + k, gain=1 - 0.05 * k, fine=fine)
        shot = render(what, CAMERA, X0, M, sensor)
        views.append(FrameView(f"photo_{k}", shot.grey, CAMERA, np.array(X0, float), M))
        truth.append(shot.point)
    return views, truth


BLANK = {"blank": lambda s, t: s > 0.5}
SCENES = {
    "two": ({}, {}),
    "two, little noise": ({}, {"noise": 0.5}),
    "two, strong noise": ({}, {"noise": 8.0}),
    "two, no roof": ({"roof": False}, {}),
    "four": ({}, {"places": CONVERGENT}),
    "four, little noise": ({}, {"places": CONVERGENT, "noise": 0.5}),
    "four, strong noise": ({}, {"places": CONVERGENT, "noise": 8.0}),
    "repeated": ({"period": 0.8}, {}),
    "little overlap": ({}, {"places": NARROW}),
    "no texture": (BLANK, {"fine": 8}),
}
"""Arguments of `scene` and of `photographs`."""


def make(name, seed=1):
    """The views of a scene, and its true points."""
    shapes, shots = SCENES[name]
    shots = {"places": STEREO, "convergent": shots.get("places") is CONVERGENT} | shots
    return photographs(what=scene(seed=seed, **shapes), seed=seed, **shots)


def figures(views, truth, cloud):
    """The largest errors in any image, pixels, and normalised errors of heights."""
    v, u = cloud.uv.astype(int).T[::-1]
    true = truth[v, u]
    seen = np.isfinite(true).all(1)
    misses = [np.linalg.norm(o.project(cloud.X) - o.project(true), axis=1) for o in views]
    miss = np.max(np.nan_to_num(misses, nan=0.0), axis=0)
    w = (cloud.X[:, 2] - true[:, 2]) / cloud.sigma[:, 2]
    return np.where(seen, miss, np.inf), np.where(seen, w, np.inf)


def row(views, truth, **options):
    """The figures of one scene."""
    bounds, _ = find_bounds(views, np.zeros((0, 3)), (-1.5, 3.0))
    partners = {0: list(range(1, len(views)))}
    begin = time.perf_counter()
    found = reconstruct_surface(views, bounds, partners, **options)
    taken = time.perf_counter() - begin
    miss, w = figures(views, truth[0], found.cloud)
    good = miss < OUTLIER
    tried = found.bases[0]["points"]
    return {
        "points": len(miss), "% of tried": 100 * len(miss) / tried,
        "% < 0.2": 100 * np.mean(miss < 0.2), "RMS": np.sqrt(np.mean(w[good] ** 2)),
        "RMS robust": 1.4826 * np.median(np.abs(w)),
        "% < 3s": 100 * np.mean(np.abs(w) < 3), "% out": 100 * np.mean(~good),
        "factor": found.bases[0]["variance_factor"], "s": taken,
    }, found, miss, w  # fmt: skip


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("scenes", nargs="*", help="parts of names; all if none")
    parser.add_argument("--dense", action="store_true")
    parser.add_argument("--sparse", action="store_true")
    parser.add_argument("--seed", type=int, default=1, help="of texture and noise")
    given = parser.parse_args()
    jaxbundle.enable_x64()
    ways = {"sparse": {"step": 4}, "dense": {"dense": True}}
    both = given.dense == given.sparse
    for name in SCENES:
        if given.scenes and not any(part in name for part in given.scenes):
            continue
        made = make(name, given.seed)
        for way, options in ways.items():
            if both or getattr(given, way):
                found = row(*made, **options)[0]
                print(f"{name:20} {way:7}" + "".join(f"  {k} {v:.3g}" for k, v in found.items()),
                      flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
