"""A DSM of two satellite images with RPC against the truth: a hilly town under two passes of a line
scanner, flat roofs of strong and weak texture, another exposure and a cloud in the second image.

    python benchmarks/surface_satellite.py [--pixels 900] [--sparse]

The images are simulated along two orbits, half a metre per pixel, base-to-height ratio 0.5; the
coefficients are fitted to the scanner. The output gives the fraction of cells with a height and
with one within 1 m of the truth, RMSE and median of the errors, the fraction off by more than 3 m,
the number of points under the cloud, and the time.
"""

import argparse
import resource
import time

import jax.numpy as jnp
import numpy as np

import jaxbundle
from jaxbundle.geometry.ellipsoid import WGS84, geodetic
from jaxbundle.planning.rendering import Scene, Sensor, first_hits, render_rays
from jaxbundle.planning.shapes import HeightField, Rectangle
from jaxbundle.planning.texture import Texture
from jaxbundle.pushbroom.flight import Flight, true_image
from jaxbundle.pushbroom.image_to_ground import locate_point
from jaxbundle.pushbroom.rpc.fitting import fit_image
from jaxbundle.pushbroom.scanner import FocalLine
from jaxbundle.pushbroom.surfaces import Ground
from jaxbundle.surfaces.dsm import make_dsm
from jaxbundle.surfaces.reconstruct import ground_bounds, reconstruct_surface
from jaxbundle.surfaces.relative import align_all
from jaxbundle.surfaces.scanner_views import RpcView, neighbourhood

GSD, ORBIT, SPEED = 0.5, 650e3, 6.9e3
PITCHES = -0.22, 0.22
HEIGHTS = -40.0, 110.0
CELL = 1.0


def hills(X, Y):
    return 15 * np.sin(X / 130) * np.cos(Y / 110)


def town(side):
    """Hills and houses of 8 to 60 m, every third with a roof of weak texture."""
    rng = np.random.default_rng(3)
    shapes, textures = [HeightField(hills, (-2 * side, -2 * side, 2 * side, 2 * side))], [
        Texture(GSD / 2, seed=1)
    ]
    kinds = [Texture(GSD / 2, seed=2), Texture(GSD / 2, seed=4), Texture(GSD / 2, 5, contrast=0.03)]
    X, Y, Z = np.eye(3)
    number = int(side / 60)
    for k, (i, j) in enumerate(np.ndindex(number, number)):
        x, y = ((a + 0.5) / number - 0.5 for a in (i, j))
        w, h = rng.uniform(12, 30, 2)
        top = float(hills(x * side, y * side)) + rng.uniform(8, 60 if k % 4 == 0 else 20)
        corner = np.array([x * side, y * side, top])
        for c, a, b in (
            (corner, w * X, h * Y), (corner, w * X, -80 * Z), (corner, h * Y, -80 * Z),
            (corner + h * Y, w * X, -80 * Z), (corner + w * X, h * Y, -80 * Z),
        ):  # fmt: skip
            shapes.append(Rectangle(tuple(c), tuple(a), tuple(b)))
            textures.append(kinds[k % 3])
    return Scene(tuple(shapes), tuple(textures))


def passes(pixels, pitches=PITCHES):
    """Scanner images that look at one place ahead and back."""
    optics = FocalLine(jnp.array([10_000.0, *np.zeros(10)]), jnp.float64(10_000 * GSD / ORBIT),
                       jnp.float64((pixels - 1) / 2), jnp.float64(0.0))  # fmt: skip

    def image(pitch, argument, node):
        return true_image(Flight(
            lines=pixels, pixels=pixels, period=GSD / SPEED, optics=optics, angles={"pitch": pitch},
            track={"height": ORBIT, "inclination": np.radians(97.8), "node": node,
                   "argument": argument},
        ))  # fmt: skip

    def middle(*where):
        X = locate_point(image(*where), Ground(WGS84), (pixels - 1) / 2, (pixels - 1) / 2)
        return np.array([float(a) for a in geodetic(WGS84, X)[:2]])

    start = 0.7, 1.9
    target = middle(0.0, *start)
    for pitch in pitches:
        place = np.array(start)
        for _ in range(4):
            off = middle(pitch, *place) - target
            J = np.stack([(middle(pitch, *(place + 1e-4 * e)) - off - target) / 1e-4
                          for e in np.eye(2)], 1)  # fmt: skip
            place = place - np.linalg.solve(J, off)
        yield image(pitch, *place), target


def photograph(view, scene, sensor):
    """The image of a scene in a view."""
    columns, rows = view.size
    v, u = np.indices((rows + 1, columns + 1)).reshape(2, -1)
    uv = np.stack([u, v], 1).astype(float)
    top, bottom = (view.points(uv, np.full(len(uv), h)) for h in HEIGHTS[::-1])
    d = (bottom - top) / np.linalg.norm(bottom - top, axis=1, keepdims=True)
    o, d = (a.reshape(rows + 1, columns + 1, 3) for a in (top, d))
    return render_rays(scene, o, d, sensor)


def images(pixels):
    """Two views of the town, the scene, and where the cloud is in the second image."""
    scene = town(pixels * GSD)
    views = []
    for k, (image, target) in enumerate(passes(pixels)):
        rpc = fit_image(image, WGS84, (-200.0, 300.0))[0].rpc
        view = RpcView(f"pass_{k}", np.zeros((pixels, pixels), np.float32), rpc,
                       neighbourhood(*target))  # fmt: skip
        shot = photograph(view, scene, Sensor(noise=1.5, seed=k, gain=1 - 0.25 * k, offset=20 * k))
        grey = shot.grey.astype(np.uint16) * 9 + 200
        views.append(RpcView(view.name, grey, rpc, view.neighbourhood))
    v, u = np.indices((pixels, pixels)) / pixels
    cloud = np.hypot(u - 0.7, (v - 0.3) * 1.5) + 0.02 * np.sin(40 * u) * np.cos(33 * v) < 0.1
    white = np.clip(2300 + 60 * np.sin(70 * u) * np.cos(50 * v), 0, 2495)
    rng = np.random.default_rng(9)
    grey = np.where(cloud, white + 13 * rng.standard_normal(cloud.shape), views[1].grey)
    views[1].grey = grey.astype(np.uint16)
    return views, scene, cloud


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--pixels", type=int, default=900)
    parser.add_argument("--sparse", action="store_true")
    given = parser.parse_args()
    jaxbundle.enable_x64()
    begin = time.perf_counter()
    views, scene, hidden = images(given.pixels)
    print(f"{views[0].size} pixels, made in {time.perf_counter() - begin:.0f} s", flush=True)
    begin = time.perf_counter()
    bounds, _ = ground_bounds(views, HEIGHTS)
    said = align_all(views, bounds)
    options = {"step": 2} if given.sparse else {"dense": True}
    cloud = reconstruct_surface(views, bounds, {0: [1]}, **options).cloud
    taken = time.perf_counter() - begin
    dsm = make_dsm(cloud, CELL)
    x, y = dsm.centres()
    half = 0.46 * given.pixels * GSD
    inside = (np.abs(x) < half) & (np.abs(y) < half)
    o = np.stack([x, y, np.full_like(x, 500.0)], -1)
    down = np.broadcast_to(np.array([0.0, 0, -1]), o.shape)
    truth = 500.0 - first_hits(scene, o, down)[0]
    error = (dsm.height - truth)[inside]
    known = np.isfinite(error)
    e = error[known]
    place = np.rint(np.nan_to_num(views[1].project(cloud.X), nan=-1)).astype(int)
    there = ((place >= 0) & (place < given.pixels)).all(1)
    under = hidden[place[there, 1], place[there, 0]].sum()
    print(f"{taken:.0f} s, {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.1f} GB; "
          + "; ".join(said))
    share = lambda what: f"{100 * np.mean(what):.2f} %"
    print(f"{len(cloud)} points, {under} of them under the cloud; of the cells {share(known)} have "
          f"a height, {share(np.abs(np.nan_to_num(error, nan=9)) < 1)} within 1 m; of these "
          f"heights {share(np.abs(e) > 3)} are off by more than 3 m; RMSE "
          f"{np.sqrt(np.mean(e**2)):.2f} m, median error {np.median(e):.3f} m, robust σ "
          f"{1.4826 * np.median(np.abs(e)):.3f} m")  # fmt: skip
    point = first_hits(scene, np.concatenate([cloud.X[:, :2], np.full((len(cloud), 1), 500.0)],
                                             1)[None],
                       np.broadcast_to(np.array([0.0, 0, -1]), (1, len(cloud), 3)))[0][0]
    off = cloud.X[:, 2] - 500 + point
    w, near = off / cloud.sigma[:, 2], np.abs(off) < 1
    print(f"errors of points over σ, of those within 1 m: RMS {np.sqrt(np.mean(w[near] ** 2)):.2f},"
          f" within 3 {100 * np.mean(np.abs(w[near]) < 3):.1f} %")  # fmt: skip


if __name__ == "__main__":
    main()
