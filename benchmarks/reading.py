"""Reading files beside their own programs: COLMAP models by pycolmap, LAS by laspy, BAL by NumPy.

    python benchmarks/reading.py [--bal FILE] [--images N] [--per-image N] [--points N] [--las N]
                                 [--repeat N] [--json FILE]

A model of --images × --per-image image points is simulated and written in both forms of COLMAP, a
cloud of --las points as LAS; each is read in this process by jaxbundle and by the other program in
turn, --repeat times after a first one that compiles: medians of the seconds, and the ratio of the
medians of processor time, which other work on the machine does not change. Peers that are not
installed are listed as skipped.
The other programs give their own objects: pycolmap's model has tracks and all features, laspy's
cloud x, y, z without colours; NumPy only splits the numbers of a BAL problem. jaxbundle gives a
checked network, or cloud with colours. Exit status 1 if what both read differs.
"""

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import machine
import numpy as np


def in_turn(
    ours: Callable[[], Any], theirs: Callable[[], Any] | None, repeat: int
) -> tuple[dict[str, float], Any, Any]:
    """Seconds and processor seconds of both, medians; what both read."""
    times: dict[str, list[float]] = {}
    for _ in range(repeat + 1):
        found: list[Any] = [None, None]
        for k, (name, function) in enumerate((("ours", ours), ("theirs", theirs))):
            if function is None:
                continue
            found[k] = None  # the last one is freed before the clock runs
            begin, cpu = time.perf_counter(), time.process_time()
            found[k] = function()
            times.setdefault(name, []).append(time.perf_counter() - begin)
            times.setdefault(f"{name}_cpu", []).append(time.process_time() - cpu)
    medians = {name: float(np.median(some[1:])) for name, some in times.items()}
    return {"first": times["ours"][0]} | medians, *found


def write_model(folder: Path, images: int, points: int, per_image: int, text: bool) -> None:
    """A model of COLMAP by its documentation alone, binary or text."""
    import struct

    rng = np.random.default_rng(7)
    xyz = rng.normal(size=(points, 3))
    seen = np.array([np.sort(rng.choice(points, per_image, replace=False)) for _ in range(images)])
    xy = rng.uniform(0, 1000, (images, per_image, 2))
    q, t = rng.normal(size=(images, 4)), rng.normal(size=(images, 3))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    tracks: list[list[tuple[int, int]]] = [[] for _ in range(points)]
    for i, row in enumerate(seen.tolist()):
        for k, p in enumerate(row):
            tracks[p].append((i + 1, k))
    if text:
        (folder / "cameras.txt").write_text("1 SIMPLE_RADIAL 1000 1000 900 500 500 -0.1\n")
        with (folder / "images.txt").open("w") as file:
            for i in range(images):
                pose = " ".join(map(repr, [*q[i].tolist(), *t[i].tolist()]))
                rays = " ".join(
                    f"{x!r} {y!r} {p + 1}" for (x, y), p in zip(xy[i].tolist(), seen[i].tolist())
                )
                file.write(f"{i + 1} {pose} 1 {i}.jpg\n{rays}\n")
        with (folder / "points3D.txt").open("w") as file:
            for p, X in enumerate(xyz.tolist()):
                track = " ".join(f"{i} {k}" for i, k in tracks[p])
                file.write(f"{p + 1} {X[0]!r} {X[1]!r} {X[2]!r} 1 2 3 0.5 {track}\n")
        return
    camera = struct.pack("<QIiQQ4d", 1, 1, 2, 1000, 1000, 900, 500, 500, -0.1)
    (folder / "cameras.bin").write_bytes(camera)
    ray = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
    with (folder / "images.bin").open("wb") as file:
        file.write(struct.pack("<Q", images))
        for i in range(images):
            rays = np.zeros(per_image, ray)
            rays["xy"], rays["point"] = xy[i], seen[i] + 1
            file.write(struct.pack("<I7dI", i + 1, *q[i], *t[i], 1) + f"{i}.jpg\0".encode())
            file.write(struct.pack("<Q", per_image) + rays.tobytes())
    with (folder / "points3D.bin").open("wb") as file:
        file.write(struct.pack("<Q", points))
        for p in range(points):
            head = struct.pack("<Q3d3BdQ", p + 1, *xyz[p], 1, 2, 3, 0.5, len(tracks[p]))
            file.write(head + np.array(tracks[p], "<u4").tobytes())


def read_colmap(folder: Path, repeat: int) -> dict[str, Any]:
    from jaxbundle.io import read_network

    try:
        import pycolmap

        read: Any = lambda: pycolmap.Reconstruction(folder)
    except ImportError:
        read = None
    result, network, model = in_turn(lambda: read_network(folder), read, repeat)
    result |= {"observations": len(network.observations), "peer": "pycolmap"}
    if model is None:
        return result | {"skipped": True}
    same = model.compute_num_observations() == len(network.observations)
    X = np.array([model.points3D[int(id)].xyz for id in network.points.id[:1000]])
    same &= bool((X == network.points.position[:1000]).all())
    colours = np.array([model.points3D[int(id)].color for id in network.points.id[:1000]])
    same &= bool((colours == network.points.colour[:1000]).all())
    return result | {"same": same}


def read_las(path: Path, number: int, repeat: int) -> dict[str, Any]:
    import laspy

    from jaxbundle.surfaces.point_files import read_cloud

    rng = np.random.default_rng(1)
    header = laspy.LasHeader(point_format=2, version="1.2")  # with colours
    header.scales, header.offsets = np.full(3, 0.001), np.zeros(3)
    las = laspy.LasData(header)
    las.x, las.y, las.z = (rng.uniform(0, 1000, number) for _ in range(3))
    las.write(path)
    del las

    def coordinates():
        las = laspy.read(path)
        return np.stack([las.x, las.y, las.z], 1)

    result, cloud, X = in_turn(lambda: read_cloud(path), coordinates, repeat)
    same = bool((cloud.X == X).all())
    return result | {"peer": "laspy", "observations": number, "same": same}


def read_bal(path: Path, repeat: int) -> dict[str, Any]:
    import bz2
    import gzip

    from jaxbundle.io import read_network

    opener = {".bz2": bz2.open, ".gz": gzip.open}.get(path.suffix, open)

    def numbers():
        with opener(path, "rb") as file:
            return np.array(file.read().split(), float)

    result, network, values = in_turn(lambda: read_network(path), numbers, repeat)
    n = len(network.observations)
    xy = values[3 : 3 + 4 * n].reshape(-1, 4)[:, 2:]
    same = bool((xy == network.observations.xy).all())
    return result | {"peer": "numpy: split, float", "observations": n, "same": same}


def main() -> int:
    parser = machine.parser_of(__doc__)
    parser.add_argument("--bal", type=Path, metavar="FILE", help="a BAL problem")
    parser.add_argument("--images", type=machine.positive, default=500)
    parser.add_argument("--per-image", type=machine.positive, default=2000, help="image points")
    parser.add_argument("--points", type=machine.positive, default=200_000)
    parser.add_argument("--las", type=machine.positive, default=10_000_000, help="points")
    parser.add_argument("--repeat", type=machine.positive, default=5)
    parser.add_argument("--json", type=machine.target, metavar="FILE", help="figures")
    given = parser.parse_args()
    import jaxbundle

    jaxbundle.enable_x64()
    jaxbundle.keep_programs()
    results: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as name:
        for form in ("binary", "text"):
            folder = Path(name) / form
            folder.mkdir()
            write_model(folder, given.images, given.points, given.per_image, form == "text")
            results[f"COLMAP, {form}"] = read_colmap(folder, given.repeat)
        results["LAS"] = read_las(Path(name) / "cloud.las", given.las, given.repeat)
    if given.bal:
        results[f"BAL, {given.bal.name}"] = read_bal(given.bal, given.repeat)
    found = {"machine": machine.machine(), "results": results}
    if given.json != "-":
        print(machine.in_words(found["machine"]))
        print(f"{'input':<34} {'points':>9} {'first s':>8} {'s':>7} {'peer s':>7}  ratio  peer")
        for name, r in results.items():
            ratio = r["ours_cpu"] / r.get("theirs_cpu", np.nan)
            print(
                f"{name:<34} {r['observations']:>9} {r['first']:>8.2f} {r['ours']:>7.2f} "
                f"{r.get('theirs', np.nan):>7.2f} {ratio:>6.2f}  {r['peer']}"
                + (" (skipped: not installed)" if r.get("skipped") else "")
            )
    machine.write_json(found, given.json)
    return machine.verdict([f"{name}: both differ" for name, r in results.items()
                            if not r.get("same", True)])  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
