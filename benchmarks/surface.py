"""Throughput of matching for surfaces: correlation along segments compared with cv2.matchTemplate,
in one run; and the whole chain from pixels to points with covariance.

    python benchmarks/surface.py [--points 4000]

Windows of 21 × 21 pixels, a base and two other images, 100 positions along each segment. OpenCV
compares the same windows, as they are, along an equally long row.
"""

import argparse
import time

import cv2
import numpy as np

import jaxbundle
from jaxbundle.planning.rendering import Scene, Sensor, render
from jaxbundle.planning.shapes import HeightField
from jaxbundle.planning.texture import Texture
from jaxbundle.surfaces.correlation import correlate, make_pyramid
from jaxbundle.surfaces.reconstruct import find_bounds, reconstruct_surface
from jaxbundle.surfaces.segments import segments, windows
from jaxbundle.surfaces.views import FrameView

HALF, POSITIONS = 10, 100
SIZE, F = (1000, 750), 1000.0


def hills(X, Y):
    return 0.8 * np.sin(X / 2) * np.cos(Y / 3)


def photographs():
    """Three photographs that look straight down."""
    camera = jaxbundle.Camera(
        "cam", "opencv", {"fx": F, "fy": F, "cx": 499.5, "cy": 374.5, "k1": -0.05}, image_size=SIZE
    )
    scene = Scene((HeightField(hills, (-20, -20, 20, 20)),), (Texture(0.005, 1, 1024),))
    centres = [np.array(X0, float) for X0 in ((0, 0, 10), (1.2, 0, 10), (0, 1.2, 10))]
    shots = [render(scene, camera, X0, np.eye(3), Sensor(noise=2, seed=k)).grey
             for k, X0 in enumerate(centres)]  # fmt: skip
    return [FrameView(f"photo {k}", grey, camera, X0, np.eye(3))
            for k, (grey, X0) in enumerate(zip(shots, centres))]  # fmt: skip


def along_segments(views, pyramids, uv):
    """Seconds for the correlations of all points in both other images."""
    begin = time.perf_counter()
    for other, pyramid in zip(views[1:], pyramids[1:]):
        q = views[0].bounds(uv, -1.5, 1.5)
        shape = windows(views[0], other, views[0].points(uv, q.mean(1)))
        part = segments(views[0], other, uv, q)
        correlate((views[0], other), (pyramids[0], pyramid), uv, part, shape, level=0,
                  half_window=HALF, steps=POSITIONS)  # fmt: skip
    return time.perf_counter() - begin


def match_template(views, uv):
    """Seconds of cv2.matchTemplate for as many windows and positions, along rows."""
    cv2.setNumThreads(1)
    w = 2 * HALF + 1
    begin = time.perf_counter()
    for other in views[1:]:
        for u, v in uv.astype(int):
            template = views[0].grey[v - HALF : v + HALF + 1, u - HALF : u + HALF + 1]
            first = min(max(u - (POSITIONS + w) // 2, 0), SIZE[0] - POSITIONS - w + 1)
            strip = other.grey[v - HALF : v + HALF + 1, first : first + POSITIONS + w - 1]
            cv2.matchTemplate(strip, template, cv2.TM_CCOEFF_NORMED)
    return time.perf_counter() - begin


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=4000)
    number = parser.parse_args().points
    jaxbundle.enable_x64()
    views = photographs()
    pyramids = [make_pyramid(view.grey, 0) for view in views]
    rng = np.random.default_rng(0)
    uv = np.rint(rng.uniform([250, 250], [750, 500], (number, 2)))
    along_segments(views, pyramids, uv)  # compiled
    ours, theirs = along_segments(views, pyramids, uv), match_template(views, uv)
    print(f"correlation: {60 * number / ours:,.0f} points a minute; by cv2.matchTemplate on one "
          f"core, which shapes no windows, {60 * number / theirs:,.0f}: ratio {theirs / ours:.2f}")
    bounds, _ = find_bounds(views, np.zeros((0, 3)), (-1.5, 1.5))
    for step, name in ((20, "compiling"), (int(np.sqrt(SIZE[0] * SIZE[1] / number)), "")):
        begin = time.perf_counter()
        found = reconstruct_surface(views, bounds, {0: [1, 2]}, step=step)
        taken = time.perf_counter() - begin
        if not name:
            tried = found.bases[0]["points"]
            print(f"from pixels to points with covariance, guide included: {tried} points tried, "
                  f"{len(found.cloud)} found, {60 * tried / taken:,.0f} a minute")  # fmt: skip


if __name__ == "__main__":
    main()
