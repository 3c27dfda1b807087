"""Pushbroom: million pixels per second, from the image to the ground and back.

    OPENBLAS_NUM_THREADS=1 python benchmarks/pushbroom.py [--json FILE] [--map]

An image of 10 000 lines of 8000 pixels of 4.7 m from 500 km: positions every second (Lagrange,
order 7), quaternions at 10 Hz (slerp), a lens with distortion. Blocks of lines are given to two
threads in turn, as `correct` does; the best of several rounds counts. `--map` also corrects a whole
image of 10 000 × 8000 random pixels to a GeoTIFF. Every figure is printed next to its required
value; results are checked first, and a wrong answer ends with exit status 1, regardless of time.

    ellipsoid      X, Y, Z on the ellipsoid           geodetic     the same to λ, φ, h
    terrain        first hit with a rough model       jacobian     ∂(X, Y, Z)/∂(3 angles, 3 shifts)
    raster         ground → image, near a known place search       ground → image, nothing known
    rpc_project    ground → image by RPC              rpc_locate   the way back, heights given
    gdal_project   the same by GDAL (rasterio)        gdal_locate
"""

import os
import sys
import tempfile
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import equinox as eqx
import jax
import jax.numpy as jnp
import machine
import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

import jaxbundle

jaxbundle.enable_x64()

from jaxbundle.geometry.ellipsoid import WGS84, geodetic, residual  # noqa: E402
from jaxbundle.pushbroom.ancillary import attitude_table, position_table  # noqa: E402
from jaxbundle.pushbroom.earth_frames import circular_orbit  # noqa: E402
from jaxbundle.pushbroom.ground_to_image import make_search, project_from, project_points  # noqa: E402
from jaxbundle.pushbroom.image import make_image  # noqa: E402
from jaxbundle.pushbroom.image_to_ground import locate_lines  # noqa: E402
from jaxbundle.pushbroom.rpc.fitting import fit_image  # noqa: E402
from jaxbundle.pushbroom.rpc.polynomials import locate_points as rpc_locate  # noqa: E402
from jaxbundle.pushbroom.rpc.polynomials import project_points as rpc_project  # noqa: E402
from jaxbundle.pushbroom.scanner import FocalLine, LineTimes  # noqa: E402
from jaxbundle.pushbroom.surfaces import Ground  # noqa: E402
from jaxbundle.pushbroom.terrain import bilinear, make_terrain  # noqa: E402
from jaxbundle.pushbroom.trajectory import Trajectory, orbital_frame  # noqa: E402

LINES, PIXELS, PERIOD, ORBIT = 10_000, 8000, 1 / 1500, (5e5, np.radians(97.4), 0.3, 0.6)
DEMANDS = {
    "ellipsoid": 50, "geodetic": 10, "terrain": 2, "jacobian": 3, "raster": 10, "search": 10,
    "rpc_project": None, "rpc_locate": 8, "gdal_project": None, "gdal_locate": None,
}  # fmt: skip
U = jnp.arange(float(PIXELS))


def image():
    t = np.arange(-8.0, LINES * PERIOD + 9)
    position = position_table(t, *circular_orbit(t, *ORBIT))
    t = np.arange(-1, LINES * PERIOD + 1, 0.1)
    frame = np.asarray(jax.vmap(orbital_frame)(*circular_orbit(t, *ORBIT)))
    wobble = np.stack([2e-5 * np.sin(4.4 * t), 3e-5 * np.sin(6.9 * t), 2e-5 * np.sin(1.9 * t)], 1)
    turns = Rotation.from_matrix(frame) * Rotation.from_euler("XYZ", wobble)
    lens = jnp.zeros(11).at[0].set(1050.0).at[3].set(1e-8)
    optics = FocalLine(lens, jnp.asarray(0.01), jnp.asarray((PIXELS - 1) / 2), jnp.asarray(0.0))
    return make_image(
        Trajectory(position, attitude_table(t, np.roll(turns.as_quat(), 1, axis=1))),
        LineTimes(jnp.asarray(0.0), jnp.asarray(PERIOD)), optics, LINES, PIXELS,
    )  # fmt: skip


def rough_terrain(scan):
    """Cells of 30 m under the image, σ 150 m about 500 m."""
    X = locate_lines(scan, Ground(), jnp.linspace(0, LINES - 1, 16), U[::500])
    longitude, latitude, _ = (np.asarray(v) for v in geodetic(WGS84, tuple(X)))
    step = 30 / 6.37e6
    west, north = longitude.min() - 1e-3, latitude.max() + 1e-3
    shape = (int((north - latitude.min() + 1e-3) / step),
             int((longitude.max() + 1e-3 - west) / step))  # fmt: skip
    z = gaussian_filter(np.random.default_rng(0).normal(size=shape), 8)
    return make_terrain(500 + 150 * z / z.std(), (west, north), (step, -step))


def six_parameters(scan, p):
    """The image with small rotations p[:3], in radians, and shifts p[3:], in metres."""
    return eqx.tree_at(lambda i: (i.offsets.attitude, i.offsets.position), scan, (p[:3], p[3:]))


def rate(work, blocks, size, rounds):
    """Best million pixels per second of blocks given to two threads."""
    run = lambda block: jax.block_until_ready(work(block))
    run(blocks[0])
    best = np.inf
    with ThreadPoolExecutor(2) as threads:
        for _ in range(rounds):
            start = time.perf_counter()
            list(threads.map(run, blocks))
            best = min(best, time.perf_counter() - start)
    return size * len(blocks) / best / 1e6


def measure(rounds):
    scan = image()
    ground, terrain, search = Ground(), rough_terrain(scan), make_search(scan)
    locate = jax.jit(locate_lines)
    to_degrees = jax.jit(lambda s, l: jnp.stack(geodetic(WGS84, locate_lines(s, ground, l, U))))
    jacobian = jax.jit(lambda s, l: jax.jacfwd(
        lambda p: locate_lines(six_parameters(s, p), ground, l, U)
    )(jnp.zeros(6)))  # fmt: skip
    lines = lambda rows: [jnp.arange(k, k + rows) * 1.0 for k in range(100, 100 + 8 * rows, rows)]
    blocks = [(l, locate(scan, ground, l, U)) for l in lines(8)]
    back = lambda block: project_from(
        scan, search, tuple(block[1]), block[0][:, None] + 9.0, U + 4.0
    )
    spread = np.random.default_rng(0).uniform(0, [[LINES - 1], [PIXELS - 1]], (2, 100_000))
    X = jax.jit(jax.vmap(lambda l, u: locate_lines(scan, ground, l[None], u[None])[:, 0, 0]))(
        *spread
    ).T

    wrong = []
    check = lambda name, error, limit: wrong.append(name) if not error <= limit else None
    Y = locate(scan, terrain, lines(4)[0], U)
    x, y, h = terrain.grid(tuple(Y))
    surface = jax.vmap(jax.vmap(lambda a, b: bilinear(terrain.heights, a, b)))(x, y)
    check("ellipsoid", np.abs(residual(WGS84, blocks[0][1])).max(), 1e-12)
    check("terrain", np.abs(h - surface).max(), 1e-4)
    found = back(blocks[0])
    check("raster", np.abs(found[0] - blocks[0][0][:, None]).max(), 1e-6)
    check("raster", np.abs(found[1] - U).max(), 1e-6)
    places = project_points(scan, search, X)
    check("search", np.abs(np.stack([places.line[0], places.pixel[0]]) - spread).max(), 1e-6)

    rpc = fit_image(scan, WGS84, (0.0, 1000.0))[0].rpc
    l, u = (v.ravel() for v in np.meshgrid(np.arange(8.0) + 4000, U, indexing="ij"))
    h = np.linspace(0.0, 1000.0, len(l))
    east, north, _ = rpc_locate(rpc, l, u, h)
    again = rpc_project(rpc, east, north, h)
    check("rpc_locate", np.abs(np.stack(again[:2]) - [l, u]).max(), 1e-6)

    return {
        "ellipsoid": rate(lambda l: locate(scan, ground, l, U), lines(64), 64 * PIXELS, rounds),
        "geodetic": rate(lambda l: to_degrees(scan, l), lines(64), 64 * PIXELS, rounds),
        "terrain": rate(lambda l: locate(scan, terrain, l, U), lines(16), 16 * PIXELS, rounds),
        "jacobian": rate(lambda l: jacobian(scan, l), lines(8), 8 * PIXELS, rounds),
        "raster": rate(back, blocks, 8 * PIXELS, rounds),
        "search": rate(lambda X: project_points(scan, search, X), [X] * 2, X.shape[1], rounds),
        "rpc_project": rate(lambda h: rpc_project(rpc, east, north, h), [h] * 8, len(h), rounds),
        "rpc_locate": rate(lambda h: rpc_locate(rpc, l, u, h), [h] * 8, len(h), rounds),
        **gdal_rates(rpc, (l, u, h), (east, north), rounds, check),
    }, wrong  # fmt: skip


def gdal_rates(rpc, place, ground, rounds, check):
    """Of GDAL's transformer in two threads, checked against ours; its first pixel begins at 0."""
    from rasterio.rpc import RPC
    from rasterio.transform import RPCTransformer

    names = {"line": "line", "sample": "samp", "longitude": "long", "latitude": "lat",
             "height": "height"}  # fmt: skip
    given = {}
    for name, short in names.items():
        given[f"{short}_off"] = float(getattr(rpc, f"{name}_offset"))
        given[f"{short}_scale"] = float(getattr(rpc, f"{name}_scale"))
    for field, key in (("line_numerator", "line_num_coeff"), ("line_denominator", "line_den_coeff"),
                       ("sample_numerator", "samp_num_coeff"),
                       ("sample_denominator", "samp_den_coeff")):  # fmt: skip
        given[key] = np.asarray(getattr(rpc, field)).tolist()
    (l, u, h), (east, north) = place, (np.degrees(np.asarray(v)) for v in ground)
    # of its own for every thread: GDAL's is not shared
    make = lambda: RPCTransformer(RPC(**given))
    rows, columns = make().rowcol(east, north, zs=h, op=lambda x: x)
    check("gdal_project", np.abs(np.stack([rows, columns]) - 0.5 - [l, u]).max(), 1e-3)
    project = lambda _: make().rowcol(east, north, zs=h, op=lambda x: x)
    locate = lambda _: make().xy(l, u, zs=h, offset="center")
    return {
        "gdal_project": rate(project, [0] * 8, len(h), rounds),
        "gdal_locate": rate(locate, [0] * 8, len(h), rounds),
    }


def map_seconds():
    """Seconds to correct a whole image to UTM, with the reading and writing of the rasters."""
    import rasterio

    from jaxbundle.io.rasters.correction import map_of, write_corrected
    from jaxbundle.io.rasters.maps import MapSystem

    scan, ground = image(), Ground()
    system = MapSystem(WGS84, "EPSG:32637")
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        source, target = Path(folder) / "image.tif", Path(folder) / "map.tif"
        with rasterio.open(source, "w", driver="GTiff", width=PIXELS, height=LINES, count=1,
                           dtype="uint16", tiled=True) as raster:  # fmt: skip
            rng = np.random.default_rng(0)
            raster.write(rng.integers(1, 4000, (1, LINES, PIXELS), dtype=np.uint16))
        start = time.perf_counter()
        grid = map_of(scan, ground, system, None)
        write_corrected(source, target, scan, make_search(scan), ground, system, grid)
        return time.perf_counter() - start, grid


def main():
    parser = machine.parser_of(__doc__)
    parser.add_argument("--json", type=machine.target, metavar="FILE",
                        help="write the figures; - for standard output")  # fmt: skip
    parser.add_argument("--rounds", type=machine.positive, default=5)
    parser.add_argument("--map", action="store_true", help="also correct a whole image")
    arguments = parser.parse_args()
    rates, wrong = measure(arguments.rounds)
    if arguments.json != "-":
        print(machine.in_words(machine.machine()))
        for name, value in rates.items():
            demand = f"demanded {DEMANDS[name]}" if DEMANDS[name] else ""
            print(f"{name:10} {value:8.2f} Mpixel/s   {demand}")
    if arguments.map:
        rates["map_seconds"], grid = map_seconds()
        if arguments.json != "-":
            print(f"map        {rates['map_seconds']:8.1f} s          demanded below 60 "
                  f"({grid.rows} × {grid.columns} pixels of {grid.size:g} m)")  # fmt: skip
    machine.write_json({"machine": machine.machine()} | rates, arguments.json)
    return machine.verdict([f"{name} misses its limit" for name in wrong])


if __name__ == "__main__":
    sys.exit(main())
