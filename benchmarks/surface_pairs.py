"""Dense matching of real rectified pairs with true disparities, compared with OpenCV's semi-global
matching of the same pair and range.

    python benchmarks/surface_pairs.py FOLDER [PAIR …] [--processes] [--outliers] [--json FILE]

FOLDER has a folder for each pair, with the files of one of the public sets as they are: `im0`,
`im1` and `disp0*.pfm` (Middlebury 2014, ETH3D), `view1`, `view5` and `disp1` (Middlebury 2005 and
2006, of a third of the size), `im2`, `im6` and `disp2` (2003 in folders `*_4`, 2001 in `*_8`), or
`left`, `right` and `disparity.npz` (scikit-image 0.16). None is part of this repository.

Of every pair: the share of pixels with a disparity, of all with a true one and of those visible in
both photographs (by the true disparities); of these disparities NMAD (1.4826 times the median
deviation from the median), median, and the shares wrong by more than 0.5, 1 and 2 pixels; errors
over σ: robust σ and the shares beyond 3 and 5. True disparities of whole steps add the σ of their
rounding. Seconds are of the processor, second call; `--processes` adds the first call of a process
without programs of an earlier one and with them, their programs, and the memory beyond that of the
imports. The last line has the means of all pairs.

`--outliers` prints instead how many disparities of the search are wrong by more than a pixel, by
the distance from the nearest step or gap, with texture of their own and without: what
`outliers_at_step`, `outlier_range` and `textured_outliers` of `DisparityRefinementSettings` state.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import cv2
import jax
import machine
import numpy as np

import jaxbundle
from jaxbundle.surfaces import dense
from jaxbundle.surfaces.dense import DenseSettings
from jaxbundle.surfaces.disparity_refinement import (
    DisparityRefinementSettings,
    _find_steps,
    _match_windows,
)
from jaxbundle.surfaces.reconstruct import find_bounds, reconstruct_surface
from jaxbundle.surfaces.views import FrameView

SETS = (
    ("left", "right", "disparity", 1.0, 0.0),
    ("im0", "im1", "disp0", 1.0, 0.0),
    ("view1", "view5", "disp1", 3.0, 1 / 3),
    ("im2", "im6", "disp2", None, None),
)
"""Names of the files, true disparities by their values, their steps."""
MARGIN = 4.0
"""Pixels searched beyond the true disparities."""


def read_pair(folder):
    """Grey photographs, true disparities (NaN: unknown), and the step they are rounded to."""
    found = [(files, scale, step) for *names, scale, step in SETS
             if all(files := [sorted(folder.glob(f"{name}*")) for name in names])]  # fmt: skip
    if not found:
        raise SystemExit(f"{folder}: no pair with true disparities")
    files, scale, step = found[0]
    if scale is None:
        scale = float(folder.name.rsplit("_", 1)[-1])
        step = 1 / scale
    images = [cv2.imread(str(f[0]), cv2.IMREAD_GRAYSCALE) for f in files[:2]]
    path = files[2][0]
    if path.suffix == ".npz":
        true = next(iter(np.load(path).values())).astype(float)
    else:
        true = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(float)
        true = true[..., 0] if true.ndim == 3 else true
    true = np.where(np.isfinite(true) & (true > 0), true / scale, np.nan)
    return SimpleNamespace(name=folder.name, left=images[0], right=images[1], true=true, step=step)


def seen_by_both(true):
    """Pixels whose place in the other photograph is inside, and not taken by a nearer surface."""
    rows, columns = true.shape
    place = np.arange(columns) - true
    known = np.isfinite(true) & (place >= 0)
    r, c = np.nonzero(known)
    nearest = np.full((rows, columns + 2), -np.inf)
    for k in (0, 1):
        np.maximum.at(nearest, (r, np.floor(place[r, c]).astype(int) + k), true[r, c])
    seen = known.copy()
    seen[r, c] = true[r, c] > nearest[r, np.rint(place[r, c]).astype(int)] - 1
    return seen


def views_of(pair):
    """The pair as photographs of the normal case: disparity f·b/−Z with f = columns and b = 1."""
    rows, columns = pair.left.shape
    f = float(columns)
    camera = jaxbundle.Camera("cam", "opencv", {
        "fx": f, "fy": f, "cx": float(columns // 2), "cy": float(rows // 2),
    }, image_size=(columns, rows))  # fmt: skip
    return [FrameView(f"photo_{k}", grey, camera, np.array([x, 0, 0.0]), np.eye(3))
            for k, (grey, x) in enumerate(((pair.left, 0.0), (pair.right, 1.0)))], f  # fmt: skip


def range_of(pair):
    """The lowest and the highest disparity that are searched."""
    return max(np.nanmin(pair.true) - MARGIN, 1.0), np.nanmax(pair.true) + MARGIN


def match(pair):
    """Disparities and their σ by `reconstruct_surface`, NaN where there are none."""
    views, f = views_of(pair)
    low, high = range_of(pair)
    bounds, _ = find_bounds(views, np.zeros((0, 3)), (-f / low, -f / high))
    cloud = reconstruct_surface(views, bounds, {0: [1]}, dense=True).cloud
    v, u = cloud.uv.astype(int).T[::-1]
    d, sigma = np.full((2, *pair.true.shape), np.nan)
    d[v, u] = -f / cloud.X[:, 2]
    sigma[v, u] = cloud.sigma[:, 2] * d[v, u] ** 2 / f
    return d, sigma


def semi_global(pair):
    """Disparities by OpenCV with the parameters of its own sample; NaN where it has none."""
    low, high = (int(round(a)) for a in range_of(pair))
    number = -(-(high - low + 1) // 16) * 16
    matcher = cv2.StereoSGBM.create(low, number, 3, 8 * 9, 32 * 9, 1, 63, 10, 100, 32)
    found = matcher.compute(pair.left, pair.right).astype(float) / 16
    return np.where(found >= low, found, np.nan), None


def figures(pair, d, sigma):
    """The figures of a result, by name."""
    known, seen = np.isfinite(pair.true), seen_by_both(pair.true)
    there = known & np.isfinite(d)
    e = (d - pair.true)[there]
    middle = np.median(e)
    found = {
        "% of all": 100 * there.sum() / known.sum(),
        "% of seen": 100 * (there & seen).sum() / seen.sum(),
        "hidden": 100 * (there & ~seen).sum() / there.sum(),
        "NMAD": 1.4826 * np.median(np.abs(e - middle)),
        "median": middle,
        **{f"> {k}": 100 * np.mean(np.abs(e) > k) for k in (0.5, 1, 2)},
    }
    if sigma is not None:
        w = np.abs(e) / np.hypot(sigma[there], pair.step / np.sqrt(12))
        found |= {"robust": 1.4826 * np.median(w), "> 3 σ": 100 * np.mean(w > 3),
                  "> 5 σ": 100 * np.mean(w > 5)}  # fmt: skip
    return found


DISTANCES = (0, 1.1, 2.1, 3.1, 4.1, 6.1, 9, 12, 16, 25, np.inf)


def outliers(pair):
    """Pixels, and those wrong by more than a pixel, by texture and distance, as parts of all."""
    settings = DenseSettings()
    low, high = range_of(pair)
    lowest = int(low)
    right = np.full(pair.left.shape, np.nan, np.float32)
    right[:, lowest:] = pair.right[:, : right.shape[1] - lowest]
    images = SimpleNamespace(left=pair.left.astype(np.float32), right=right)
    left, right = dense._prepare(images)
    inside, span = np.isfinite(images.left), int(np.ceil(high)) - lowest
    start = dense._search(left, right, inside, np.isfinite(images.right), span, settings)
    sizes, textured = _match_windows(left, right, start, settings.refinement)
    distance, _ = _find_steps(start, inside, settings.refinement)
    far = np.isfinite(sizes[1].disparity) & (distance > DISTANCES[6])
    # the common offset of a pair is one of its true disparities
    offset = np.nanmedian((sizes[1].disparity + lowest - pair.true)[far])
    error = start + lowest - pair.true - offset
    known = np.isfinite(error)
    bins = [np.where(known & (textured == own), np.digitize(distance, DISTANCES), 0)
            for own in (True, False)]  # fmt: skip
    count = lambda which: [np.bincount(b[which], minlength=len(DISTANCES))[1:] for b in bins]
    return np.stack([count(known), count(known & (np.abs(error) > 1))]) / known.sum()


def print_outliers(pairs):
    """The table of all pairs, each of the same weight, beside the formula of the settings."""
    shares, wrong = np.sum([outliers(pair) for pair in pairs], axis=0)
    settings = DisparityRefinementSettings()
    print("  distance  textured: %  wrong    others: %  wrong  formula")
    for k, (low, high) in enumerate(zip(DISTANCES, DISTANCES[1:])):
        middle = (low + min(high, 2 * low)) / 2
        P = settings.outliers_at_step * np.exp(-middle / settings.outlier_range)
        cells = "".join(f" {100 * shares[i, k] / shares.sum():12.1f} "
                        f"{100 * wrong[i, k] / shares[i, k]:6.1f}" for i in (0, 1))  # fmt: skip
        print(f"{low:4g}–{high:4g} {cells}  {100 * settings.textured_outliers * P:.1f}, "
              f"{100 * P:.1f}")  # fmt: skip


def measure(work, *arguments):
    """The result of a call, and its seconds of the processor and on the clock."""
    begin = time.process_time(), time.perf_counter()
    found = work(*arguments)
    return found, (time.process_time() - begin[0], time.perf_counter() - begin[1])


def first_call(folder):
    """The first call in this process: seconds, programs, memory."""
    pair = read_pair(folder)
    programs = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, seconds, **_: programs.append(seconds)
        if name == "/jax/core/compile/backend_compile_duration" else None)  # fmt: skip
    jax.numpy.zeros(1).block_until_ready()
    before, imports = machine.peak_mb(), len(programs)
    _, seconds = measure(match, pair)
    return {"s": seconds[0], "programs": len(programs) - imports,
            "compiling s": sum(programs[imports:]), "MB": machine.peak_mb() - before}  # fmt: skip


def first_calls(folder):
    """`first_call` in processes of their own, with an empty folder of programs and a full one."""
    with tempfile.TemporaryDirectory() as programs:
        environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": programs}
        command = [sys.executable, __file__, str(folder.parent), folder.name, "--first"]
        return [json.loads(subprocess.run(command, env=environment, check=True,
                                          capture_output=True, text=True).stdout)
                for _ in range(2)]  # fmt: skip


def main():
    parser = machine.parser_of(__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("pairs", nargs="*", help="names of folders; all if none")
    parser.add_argument("--processes", action="store_true", help="first calls, too")
    parser.add_argument("--outliers", action="store_true", help="wrong disparities by distance")
    parser.add_argument("--first", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--json", type=machine.target, metavar="FILE",
                        help="write the figures; - for standard output")  # fmt: skip
    given = parser.parse_args()
    jaxbundle.enable_x64()
    names = given.pairs or sorted(p.name for p in given.folder.iterdir() if p.is_dir())
    if given.first:
        jaxbundle.keep_programs()
        print(json.dumps(first_call(given.folder / names[0])))
        return
    if given.outliers:
        return print_outliers([read_pair(given.folder / name) for name in names])
    told = {}
    for name in names:
        pair = read_pair(given.folder / name)
        match(pair)  # compiled
        found, seconds = measure(match, pair)
        theirs, their_seconds = measure(semi_global, pair)
        row = {"ours": figures(pair, *found) | {"s": seconds[0]},
               "OpenCV": figures(pair, *theirs) | {"s": their_seconds[0]}}  # fmt: skip
        if given.processes:
            row["without programs"], row["with programs"] = first_calls(given.folder / name)
        told[name] = row
        if given.json != "-":
            print(f"{name}: {pair.left.shape[1]} × {pair.left.shape[0]} pixels, disparities "
                  f"{np.nanmin(pair.true):.0f} to {np.nanmax(pair.true):.0f}")  # fmt: skip
            for who, values in row.items():
                print(f"  {who:16}" + "  ".join(f"{k} {v:.3g}" for k, v in values.items()),
                      flush=True)  # fmt: skip
    for who in ("ours", "OpenCV"):
        rows = [row[who] for row in told.values()]
        means = {k: np.mean([row[k] for row in rows]) for k in rows[0]}
        if given.json != "-":
            print(f"mean of {len(rows)}, {who}: "
                  + "  ".join(f"{k} {v:.3g}" for k, v in means.items()))  # fmt: skip
    machine.write_json(told | {"machine": machine.machine()}, given.json)


if __name__ == "__main__":
    main()
