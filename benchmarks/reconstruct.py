"""Rendered photographs from folder to adjusted network: seconds by stage, memory, accuracy.

    python benchmarks/reconstruct.py [--photographs N] [--width PIXELS] [--json FILE]
                                     [--folder FOLDER] [--colmap]

Convergent photographs of hills with a roof are rendered into FOLDER (kept there for the next run),
by a camera whose principal distance and distortion the reconstruction is not told. Errors of the
projection centres are those after a similarity, in parts of the distance to the object; c in σ.
With --colmap the incremental mapper of pycolmap runs on the same folder in the same process, where
it is installed. The exit status is 1 where a photograph is left out, c or a centre is more than 4 σ
off, or σ0 is not 1 to 2 %.
"""

import json
import os
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import machine
import numpy as np

import jaxbundle
from jaxbundle.orientation.alignment import similarity
from jaxbundle.planning.render import Scene, Sensor, render
from jaxbundle.planning.shapes import HeightField, Rectangle
from jaxbundle.planning.stations import stations_looking_at
from jaxbundle.planning.texture import Texture
from jaxbundle.reconstruction.reconstruct import reconstruct

DISTANCE, FOCAL, K1 = 6.0, 0.9, -0.08


def hills(X, Y):
    return 0.5 * np.sin(X / 1.5) * np.cos(Y / 2) + 0.2 * np.sin(2.1 * X + Y)


def write_photographs(folder: Path, number: int, width: int) -> dict:
    """Render what is not there yet; the truth."""
    height, f = 3 * width // 4, FOCAL * width
    rng = np.random.default_rng(0)
    azimuth = np.linspace(-0.9, 0.9, number)
    elevation = 0.75 + 0.25 * np.sin(5 * azimuth)
    X0 = DISTANCE * np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation),
         np.sin(elevation)], 1,
    )  # fmt: skip
    roll = np.where(np.arange(number) % 4 == 3, np.pi / 2, 0.05 * rng.normal(size=number))
    stations = stations_looking_at(X0, 0.3 * rng.normal(size=(number, 3)), roll=roll)
    camera = jaxbundle.Camera(
        "cam", "opencv",
        {"fx": f, "fy": f, "cx": 0.503 * width, "cy": 0.498 * height, "k1": K1},
        image_size=(width, height),
    )  # fmt: skip
    roof = Rectangle((-1.2, -1.0, 1.4), (2.0, 0, 0.4), (0, 2.0, 0))
    texel = 0.5 * DISTANCE / f
    scene = Scene((HeightField(hills, (-9, -9, 9, 9)), roof), (Texture(texel, seed=1, side=2048),))
    from jaxbundle.orientation import many

    M = many.matrices(stations.angles)
    for k in range(number):
        path = folder / f"photo_{k:03d}.jpg"
        if not path.exists():
            shot = render(scene, camera, X0[k], M[k], Sensor(noise=2.0, seed=k, fine=1))
            cv2.imwrite(str(path), shot.grey, [cv2.IMWRITE_JPEG_QUALITY, 95])
    return {"centres": {f"photo_{k:03d}.jpg": X0[k] for k in range(number)}, "c": f}


def centre_errors(truth, ids, X0):
    """Distances of the centres from the truth after a similarity, in parts of the distance."""
    X = np.array([truth["centres"][id] for id in ids])
    A, t = similarity(X0, X)
    return A, (X0 @ A.T + t - X)


def ours(folder: Path, truth) -> dict:
    stages, last = {}, ["", time.perf_counter()]

    def tell(stage, done, total):
        now = time.perf_counter()
        if last[0]:
            stages[last[0]] = stages.get(last[0], 0.0) + now - last[1]
        last[:] = [stage, now]

    start = time.perf_counter()
    found = reconstruct([folder], tell=tell)
    seconds = time.perf_counter() - start
    result = found.parts[0].adjustment
    ids = result.network.images.id
    A, e = centre_errors(truth, ids, result.image_values[:, :3])
    C = np.einsum("ij,njk,lk->nil", A, result.image_covariance[:, :3, :3], A)
    sigma = np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    c = next(iter(result.cameras.values()))["parameters"]["fx"]
    return {
        "photographs": len(ids), "seconds": seconds, "stages": stages,
        "peak_mb": machine.peak_mb(), "points": len(result.network.points),
        "image_points": len(result.network.observations),
        "centres_rms": float(np.sqrt((e**2).sum(1).mean()) / DISTANCE),
        "centres_worst_sigma": float(np.abs(e / sigma).max()),
        "c_error_sigma": float(abs(c["value"] - truth["c"]) / c["sigma"]),
        "sigma0": result.sigma0, "removed": len(result.removed),
    }  # fmt: skip


def colmap(folder: Path, truth) -> dict | None:
    if not machine.installed("pycolmap"):
        return None
    import pycolmap

    with tempfile.TemporaryDirectory() as work:
        database = Path(work) / "database.db"
        start = time.perf_counter()
        pycolmap.extract_features(
            database, folder, camera_mode=pycolmap.CameraMode.SINGLE
        )
        pycolmap.match_exhaustive(database)
        models = pycolmap.incremental_mapping(database, folder, work)
        seconds = time.perf_counter() - start
        best = max(models.values(), key=lambda m: m.num_reg_images())
        images = [best.images[k] for k in best.reg_image_ids()]
        X0 = np.array([image.projection_center() for image in images])
        _, e = centre_errors(truth, [image.name for image in images], X0)
    return {"photographs": len(images), "seconds": seconds,
            "centres_rms": float(np.sqrt((e**2).sum(1).mean()) / DISTANCE)}  # fmt: skip


def main():
    parser = machine.parser_of(__doc__)
    parser.add_argument("--photographs", type=machine.positive, default=11)
    parser.add_argument("--width", type=machine.positive, default=2800)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--colmap", action="store_true")
    parser.add_argument("--json", type=machine.target, metavar="FILE")
    given = parser.parse_args()
    jaxbundle.enable_x64()
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        truth = write_photographs(folder, given.photographs, given.width)
        figures = {"machine": machine.machine(), "ours": ours(folder, truth)}
        if given.colmap:
            figures["pycolmap"] = colmap(folder, truth)
    print(json.dumps(figures["ours"] | {"pycolmap": figures.get("pycolmap")}, indent=1))
    machine.write_json(figures, given.json)
    f = figures["ours"]
    wrong = [
        text for text, bad in (
            ("a photograph was left out", f["photographs"] < given.photographs),
            ("c is more than 4 σ off", not f["c_error_sigma"] < 4),
            ("a centre is more than 4 σ off", not f["centres_worst_sigma"] < 4),
            ("σ0 is not 1", not abs(f["sigma0"] - 1) < 0.02),
        ) if bad
    ]  # fmt: skip
    return machine.verdict(wrong)


if __name__ == "__main__":
    sys.exit(main())
