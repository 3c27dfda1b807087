"""RPC: million points per second of processor, beside GDAL, shareloc and rpcm.

    OPENBLAS_NUM_THREADS=1 python benchmarks/rpc_speed.py [--points N] [--peers PYTHON]

The coefficients are those of the image of `pushbroom.py`: 10 000 lines of 8000 pixels of 4.7 m from
500 km, all terms in use. Every program reads them from the tags of one GeoTIFF, and gets the same
`--points` random positions of the image and heights from 0 to 1000 m: to the ground and back. Time
is that of the processor, all threads together; the best of several rounds counts. The ground points
must agree with ours within a thousandth of a pixel, otherwise the exit status is 1; so must the
8 million points a second that are required from the image to the ground.

GDAL is called through rasterio, with its default threshold of 0.1 pixel and with 1e-6 pixel.
shareloc and rpcm (`rpc_speed_peers.py`) run in the interpreter `--peers`, of an environment of
their own (`pip install shareloc rpcm`); those that are not installed there are left out. shareloc
stops at 1e-6 pixel, rpcm at 1e-9 of half the image.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import machine
import numpy as np

import jaxbundle

jaxbundle.enable_x64()

from pushbroom import LINES, PIXELS, image  # noqa: E402

from jaxbundle.geometry.ellipsoid import WGS84  # noqa: E402
from jaxbundle.io import write_rpc  # noqa: E402
from jaxbundle.pushbroom.rpc.fitting import fit_image  # noqa: E402
from jaxbundle.pushbroom.rpc.polynomials import locate_points, project_points  # noqa: E402

REQUIRED = 8.0
"""Million points a second of processor from the image to the ground."""


def processor_seconds(work, rounds: int) -> float:
    """The least of several rounds, after one that compiles."""
    work()
    best = np.inf
    for _ in range(rounds):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return best


def ours(rpc, places, ground, rounds: int) -> dict[str, float]:
    """Seconds for all points; longitudes and latitudes in radians."""
    l, s, h = (jax.numpy.asarray(v) for v in places)
    east, north = (jax.numpy.asarray(v) for v in ground)
    locate = lambda: jax.block_until_ready(locate_points(rpc, l, s, h))
    project = lambda: jax.block_until_ready(project_points(rpc, east, north, h))
    return {
        "locate": processor_seconds(locate, rounds),
        "project": processor_seconds(project, rounds),
    }


def gdal(
    raster: Path, places, ground, rounds: int, **options: float
) -> tuple[dict[str, float], float]:
    """Seconds for all points, and the largest difference from ours in degrees."""
    import rasterio
    from rasterio.transform import RPCTransformer

    l, s, h = places
    east, north = (np.degrees(v) for v in ground)
    with rasterio.open(raster) as source, RPCTransformer(source.rpcs, **options) as transformer:
        locate = lambda: transformer.xy(l, s, zs=h, offset="center")
        seconds = {
            "locate": processor_seconds(locate, rounds),
            "project": processor_seconds(
                lambda: transformer.rowcol(east, north, zs=h, op=lambda x: x), rounds
            ),
        }
        off = np.abs(np.array(locate()) - [east, north]).max()
    return seconds, float(off)


def peers(python: str, folder: Path, rounds: int) -> dict:
    """What `rpc_speed_peers.py` says in another interpreter."""
    script = Path(__file__).with_name("rpc_speed_peers.py")
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        # -P: not the folder of the script, whose coverage.py numba would import
        [python, "-P", str(script), str(folder), str(rounds)],
        capture_output=True, text=True, check=False, env=environment,
    )  # fmt: skip
    if done.returncode:
        print(done.stderr.strip().splitlines()[-1:], file=sys.stderr)
        return {}
    return json.loads(done.stdout)


def main() -> int:
    """Run, print, check."""
    import rasterio

    parser = machine.parser_of(__doc__)
    parser.add_argument("--points", type=machine.positive, default=1_000_000)
    parser.add_argument("--rounds", type=machine.positive, default=5)
    parser.add_argument("--peers", metavar="PYTHON", help="interpreter with shareloc and rpcm")
    parser.add_argument("--json", type=machine.target, metavar="FILE",
                        help="write the figures; - for standard output")  # fmt: skip
    given = parser.parse_args()
    rpc = fit_image(image(), WGS84, (0.0, 1000.0))[0].rpc
    rng, n = np.random.default_rng(0), given.points
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        raster = Path(folder) / "image.tif"
        with rasterio.open(raster, "w", driver="GTiff", width=PIXELS, height=LINES, count=1,
                           dtype="uint8", SPARSE_OK=True):  # fmt: skip
            pass
        write_rpc(raster, rpc)
        places = (rng.uniform(0, LINES - 1, n), rng.uniform(0, PIXELS - 1, n),
                  rng.uniform(0, 1000, n))  # fmt: skip
        ground = tuple(np.asarray(v) for v in locate_points(rpc, *places)[:2])
        np.save(Path(folder) / "points.npy", np.stack([*places, *np.degrees(ground)]))
        seconds = {"jaxbundle": ours(rpc, places, ground, given.rounds)}
        differences = {}
        for name, options in (("GDAL", {}), (EXACT_GDAL, {"RPC_PIXEL_ERROR_THRESHOLD": 1e-6})):
            of = gdal(raster, places, ground, given.rounds, **options)
            seconds[name], differences[name] = of
        if given.peers:
            for name, told in peers(given.peers, Path(folder), given.rounds).items():
                seconds[name] = told["seconds"]
                differences[name] = told["difference"]
    again = np.stack(project_points(rpc, *ground, places[2])[:2])
    differences["jaxbundle"] = float(np.abs(again - places[:2]).max()) * PIXEL_DEGREES
    rates = {name: {way: n / 1e6 / s for way, s in of.items()} for name, of in seconds.items()}
    wrong = [
        f"{name}: ground points differ by {off / PIXEL_DEGREES:.3g} pixel"
        for name, off in differences.items()
        # by default GDAL stops below 0.1 pixel in lines and in samples
        if not off < (0.2 if name == "GDAL" else 1e-3) * PIXEL_DEGREES
    ]
    if rates["jaxbundle"]["locate"] < REQUIRED:
        wrong.append(f"{rates['jaxbundle']['locate']:.2f} of {REQUIRED:g} million points a second")
    found = {"machine": machine.machine(), "points": n, "million_points_a_second": rates,
             "difference_degrees": differences}  # fmt: skip
    if given.json != "-":
        print(machine.in_words(found["machine"]))
        print(f"{n} points, million points per second of processor")
        for name, of in rates.items():
            print(f"{name:16} to the ground {of['locate']:7.2f}   to the image {of['project']:7.2f}"
                  f"   differs by {differences[name] / PIXEL_DEGREES:.1e} pixel")  # fmt: skip
    machine.write_json(found, given.json)
    return machine.verdict(wrong)


EXACT_GDAL = "GDAL, 1e-6 pixel"
PIXEL_DEGREES = np.degrees(4.7 / 6.37e6)
"""About, of the image: 4.7 m."""

if __name__ == "__main__":
    sys.exit(main())
