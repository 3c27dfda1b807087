"""Maps of a whole image with RPC: `pushbroom correct` beside GDAL's warp, in one run.

    OPENBLAS_NUM_THREADS=1 python benchmarks/maps.py [--size 10000] [--bands 4] [--resampling bilinear] [--json FILE]

An image of 10 000 lines of 10 000 pixels of 0.5 m from 500 km, 20° off the nadir, 4 bands of 16
bits, with coefficients fitted to the rigorous model, on terrain with cells of 30 m (σ 60 m). Both
programs read the same files and write a tiled GeoTIFF of the same pixels in the zone of UTM, each
in a process of its own, so that its memory is its own. GDAL (rasterio, `rpcs` and `RPC_DEM`) runs
with its default tolerance of 0.125 pixel and with the tolerance of `correct`, on one thread and on
two. The bands have the line and the pixel of the image as their values, so that the map says which
position it shows: its distance from the exact model, without any approximation, is taken at random
pixels (`distance`, in pixels of the image).
"""  # noqa: E501 (a command line)

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import machine
import numpy as np

# Values of a band change by 64 a line or pixel, so that whole numbers resolve a 64th of it, and
# begin anew every 1000 lines.
STEPS, FOLD = 64.0, 64_000
GDAL = {"gdal, 1 thread": (1, 0.125), "gdal, 2 threads": (2, 0.125),
        "gdal, 2 threads, 0.02": (2, 0.02)}  # fmt: skip


def scanner(size):
    """An even scanner, 20° off the nadir, with a slow turn."""
    import jax.numpy as jnp

    from jaxbundle.pushbroom.ancillary import attitude_table, position_table
    from jaxbundle.pushbroom.earth_frames import circular_orbit
    from jaxbundle.pushbroom.image import make_image
    from jaxbundle.pushbroom.scanner import AnglePolynomial, LineTimes
    from jaxbundle.pushbroom.trajectory import Trajectory

    period, half = 0.5 / 7100, size / 2 * 1e-6
    t = np.arange(-8.0, size * period + 9)
    angles = np.stack([0.01 + 2e-4 * t, 0.35 + 3e-4 * t + 1e-5 * t**2, 0.02 - 1e-4 * t], 1)
    position = position_table(t, *circular_orbit(t, 5e5, np.radians(97.4), 0.3, 0.6))
    optics = AnglePolynomial(
        jnp.array([0, half, 0, half**3 / 3]), jnp.array([0.001, 0, 1e-5]),
        jnp.float64((size - 1) / 2), jnp.float64(size / 2),
    )  # fmt: skip
    attitude = attitude_table(t, angles, method="spline", reference="orbit")
    return make_image(
        Trajectory(position, attitude), LineTimes(jnp.float64(0.0), jnp.float64(period)), optics,
        size, size,
    )  # fmt: skip


def make(folder, size, bands):
    """Image with RPC, terrain."""
    import jax.numpy as jnp
    import rasterio
    from scipy.ndimage import gaussian_filter

    from jaxbundle.geometry.ellipsoid import WGS84, geodetic
    from jaxbundle.io import write_rpc
    from jaxbundle.pushbroom import Ground, fit_image, locate_lines

    scan = scanner(size)
    ends = jnp.linspace(0, size - 1, 9)
    X = np.asarray(locate_lines(scan, Ground(), ends, ends))
    longitude, latitude, _ = (np.degrees(np.asarray(v)) for v in geodetic(WGS84, tuple(X)))
    step = 1 / 3600
    west, north = longitude.min() - 0.05, latitude.max() + 0.05
    shape = [int(np.ceil((np.ptp(v) + 0.1) / step)) for v in (latitude, longitude)]
    z = gaussian_filter(np.random.default_rng(0).normal(size=shape), 8)
    with rasterio.open(
        folder / "dem.tif", "w", driver="GTiff", width=shape[1], height=shape[0], count=1,
        dtype="float32", crs="EPSG:4326", tiled=True,
        transform=rasterio.transform.Affine(step, 0, west, 0, -step, north),
    ) as target:  # fmt: skip
        target.write((300 + 60 * z / z.std()).astype("float32"), 1)
    write_rpc(folder / "image_RPC.TXT", fit_image(scan, WGS84, (0.0, 700.0))[0].rpc)
    rng = np.random.default_rng(1)
    with rasterio.open(
        folder / "image.tif", "w", driver="GTiff", width=size, height=size, count=bands,
        dtype="uint16", tiled=True, blockxsize=256, blockysize=256, interleave="pixel",
    ) as target:  # fmt: skip
        pixels = (STEPS * np.arange(size) % FOLD + 100).astype("uint16")
        for first in range(0, size, 512):
            lines = np.arange(first, min(first + 512, size))
            values = np.empty((bands, len(lines), size), "uint16")
            values[0] = (STEPS * lines % FOLD + 100)[:, None]
            values[1] = pixels
            values[2:] = rng.integers(1, 4000, (1, 1, size))
            target.write(values, window=((first, first + len(lines)), (0, size)))


def ours(folder, resampling, **options):
    """`correct`."""
    import jaxbundle

    jaxbundle.enable_x64()
    from jaxbundle.pushbroom import correct

    start = time.perf_counter()
    correct(folder / "image.tif", None, folder / "ours.tif", crs=options["crs"], spacing=0.5,
            dem=folder / "dem.tif", resampling=resampling)  # fmt: skip
    return time.perf_counter() - start


def gdal(folder, resampling, threads, tolerance):
    """GDAL's warp to the same pixels."""
    import rasterio
    from rasterio.warp import Resampling, reproject

    with rasterio.open(folder / "ours.tif") as same:
        profile = same.profile | {"compress": None, "BIGTIFF": "IF_SAFER"}
    start = time.perf_counter()
    # its cache as large as that of `correct`
    with rasterio.Env(GDAL_CACHEMAX=256), rasterio.open(
        folder / "image.tif"
    ) as source, rasterio.open(folder / "gdal.tif", "w", **profile) as target:
        every = [*range(1, source.count + 1)]
        reproject(
            rasterio.band(source, every), rasterio.band(target, every), rpcs=source.rpcs,
            src_crs="EPSG:4326", dst_crs=profile["crs"], dst_transform=profile["transform"],
            dst_nodata=0, resampling=Resampling[resampling], num_threads=threads,
            tolerance=tolerance, RPC_DEM=str(folder / "dem.tif"), warp_mem_limit=256,
        )  # fmt: skip
    return time.perf_counter() - start


def distance(folder, name, number=20_000):
    """Median and largest distance of the positions of a map from the exact model, pixels."""
    import jax
    import rasterio
    from pyproj import Transformer

    import jaxbundle

    jaxbundle.enable_x64()
    from jaxbundle.geometry.ellipsoid import WGS84
    from jaxbundle.io import read_rpc
    from jaxbundle.io.rasters.terrain_models import read_terrain
    from jaxbundle.pushbroom.rpc.polynomials import project_points
    from jaxbundle.pushbroom.terrain import bilinear

    terrain = read_terrain(folder / "dem.tif", WGS84)
    rpc = read_rpc(folder / "image_RPC.TXT")
    rng = np.random.default_rng(2)
    with rasterio.open(folder / name) as map_:
        rows, columns = (np.sort(rng.integers(0, n, number)) for n in map_.shape)
        rng.shuffle(columns)
        back = Transformer.from_crs(map_.crs, "EPSG:4326", always_xy=True)
        at = map_.transform * (columns + 0.5, rows + 0.5)
        values = map_.read([1, 2])[:, rows, columns].astype(float)
    longitude, latitude = (np.radians(v) for v in back.transform(*at))
    x, y = ((v - o) / s for v, o, s in zip((longitude, latitude), terrain.origin, terrain.step))
    height = np.asarray(jax.vmap(lambda x, y: bilinear(terrain.heights, x, y))(x, y))
    line, sample, _ = (np.asarray(v) for v in project_points(rpc, longitude, latitude, height))
    shown = (values > 0).all(0)
    with rasterio.open(folder / "image.tif") as image:
        size = image.shape
    off = (values - 100) / STEPS - np.stack([line, sample])
    fold = FOLD / STEPS
    # where values begin anew, or the image ends, none is interpolated
    for v, n in ((line, size[0]), (sample, size[1])):
        shown &= (v % fold > 4) & (v % fold < fold - 4) & (v > 4) & (v < n - 5)
    off = np.hypot(*(off - fold * np.round(off / fold)))[shown]
    return float(np.median(off)), float(off.max())


def task(name, folder, resampling, crs):
    """Seconds and MB of one program in a process of its own."""
    command = [sys.executable, __file__, "--task", name, "--folder", str(folder), "--resampling",
               resampling, "--crs", crs]  # fmt: skip
    found = subprocess.run(command, capture_output=True, text=True)
    if found.returncode:
        raise SystemExit(found.stderr)
    return json.loads(found.stdout.splitlines()[-1])


def run_task(arguments):
    folder = Path(arguments.folder)
    if arguments.task == "make":
        import jaxbundle

        jaxbundle.enable_x64()
        make(folder, arguments.size, arguments.bands)
        return {}
    if arguments.task == "ours":
        seconds = ours(folder, arguments.resampling, crs=arguments.crs)
    else:
        seconds = gdal(folder, arguments.resampling, *GDAL[arguments.task])
    return {"seconds": seconds, "cpu_seconds": time.process_time(), "MB": machine.peak_mb()}


def main():
    parser = machine.parser_of(__doc__)
    parser.add_argument("--json", type=machine.target, metavar="FILE")
    parser.add_argument("--size", type=machine.positive, default=10_000)
    parser.add_argument("--bands", type=machine.positive, default=4)
    parser.add_argument("--resampling", default="bilinear")
    parser.add_argument("--crs", default="EPSG:32637")
    parser.add_argument("--folder", help="made inputs are kept there")
    parser.add_argument("--task", help="of a process of this program")
    arguments = parser.parse_args()
    if arguments.task:
        print(json.dumps(run_task(arguments)))
        return 0
    with tempfile.TemporaryDirectory() as work:
        folder = Path(arguments.folder or work)
        folder.mkdir(exist_ok=True)
        if not (folder / "image_RPC.TXT").exists():
            import jaxbundle

            jaxbundle.enable_x64()
            make(folder, arguments.size, arguments.bands)
        figures = {}
        for name in ("ours", *GDAL):
            figures[name] = task(name, folder, arguments.resampling, arguments.crs)
            off = distance(folder, "ours.tif" if name == "ours" else "gdal.tif")
            figures[name] |= dict(zip(("median_distance", "largest_distance"), off))
            print(name, {k: round(v, 4) for k, v in figures[name].items()}, flush=True)
    machine.write_json({"machine": machine.machine()} | figures, arguments.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
