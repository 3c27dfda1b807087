"""shareloc and rpcm on the points of `rpc_speed.py`; without this project, in any interpreter.

    python benchmarks/rpc_speed_peers.py FOLDER ROUNDS

FOLDER has `image.tif` with the coefficients in its tags, and `points.npy`: line, sample, height,
longitude, latitude (degrees). Prints JSON: by program the processor's seconds and the largest
difference of the ground points in degrees.
"""

import importlib.util
import json
import logging
import sys
import time
import warnings
from pathlib import Path

import numpy as np

warnings.simplefilter("ignore")
logging.disable(logging.WARNING)


def processor_seconds(work, rounds):
    """The least of several rounds, after one that compiles."""
    work()
    best = np.inf
    for _ in range(rounds):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return best


def measure_rpcm(raster, points, rounds):
    """The centre of the first pixel is (0, 0)."""
    from rpcm.rpc_model import rpc_from_geotiff

    rpc = rpc_from_geotiff(str(raster))
    l, s, h, east, north = points
    locate = lambda: rpc.localization(s, l, h)
    return {
        "seconds": {"locate": processor_seconds(locate, rounds),
                    "project": processor_seconds(lambda: rpc.projection(east, north, h), rounds)},
        "difference": float(np.abs(np.array(locate()) - [east, north]).max()),
    }  # fmt: skip


def measure_shareloc(raster, points, rounds):
    """The centre of the first pixel is (0.5, 0.5)."""
    from shareloc.geomodels import GeoModel

    rpc = GeoModel(str(raster), "RPC")
    l, s, h, east, north = points
    locate = lambda: rpc.direct_loc_h(l + 0.5, s + 0.5, h)
    return {
        "seconds": {"locate": processor_seconds(locate, rounds),
                    "project": processor_seconds(lambda: rpc.inverse_loc(east, north, h), rounds)},
        "difference": float(np.abs(np.asarray(locate())[:, :2].T - [east, north]).max()),
    }  # fmt: skip


def main():
    """Measure what is installed."""
    folder, rounds = Path(sys.argv[1]), int(sys.argv[2])
    points = np.load(folder / "points.npy")
    programs = {"shareloc": measure_shareloc, "rpcm": measure_rpcm}
    found = {
        name: work(folder / "image.tif", points, rounds)
        for name, work in programs.items()
        if importlib.util.find_spec(name) is not None
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
