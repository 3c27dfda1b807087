"""Rendered photographs from folder to adjusted network: seconds by stage, memory, accuracy.

    python benchmarks/reconstruct.py [--set NAME | all] [--photographs N] [--width PIXELS]
                                     [--json FILE] [--folder FOLDER] [--colmap]
                                     [--pairs auto | sequence]

Photographs of a set (`photograph_sets.py`, `lifelike_sets.py`) are rendered into FOLDER/NAME (kept
there for the next run), by a camera whose principal distance and distortion are unknown to the
reconstruction. `--photographs` applies to the set `convergent`. Errors of the projection centres
are given after a similarity, relative to the distance from their centroid; c in σ. With --colmap
the incremental mapper of pycolmap, if installed, runs on the same folder in the same process, and
matches the same pairs: all, or five neighbours on each side with `--pairs sequence`. Processor
times include all threads. The exit status is 1 if a photograph of a scene is left out or placed in
another one, c or a centre is more than 4 σ off, or σ0 differs from 1 by more than 2 %.
"""

import json
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import machine
import numpy as np
from lifelike_sets import LIFELIKE
from photograph_sets import SETS, WIDTH, Shot, convergent, write

import jaxbundle
from jaxbundle.adjustment.orientation_covariance import orientation_covariance
from jaxbundle.errors import NotSolvedError
from jaxbundle.orientation.alignment import similarity
from jaxbundle.reconstruction.reconstruct import reconstruct
from jaxbundle.reconstruction.result import ReconstructedPart
from jaxbundle.reconstruction.settings import ReconstructionSettings
from jaxbundle.system.cores import allow_programs_at_once
from jaxbundle.tiepoints.pairs import CandidateSettings

SETS = SETS | LIFELIKE
LIMIT = 4.0


def centre_errors(truth, ids, X0):
    """Distances of the centres from the truth after a similarity, and its linear part."""
    X = np.array([truth[id].X0 for id in ids])
    A, t = similarity(X0, X)
    return A, X0 @ A.T + t - X


def error_over_sigma(result, truth, ids, A, e) -> float:
    """√(eᵀC⁻¹e/(3n − 7)) of the centres after the similarity, which takes seven of their 3n
    components; C is the joint covariance of the others. 1 is expected."""
    joint = orientation_covariance(result)
    if joint is None or len(ids) < 3:
        return np.nan
    rows = [joint.unknowns.index(("image", id, name)) for id in ids for name in ("X0", "Y0", "Z0")]
    turn = np.kron(np.eye(len(ids)), A)
    X = np.array([truth[id].X0 for id in ids])
    X = X - X.mean(0)
    spin = [np.cross(axis, X).ravel() for axis in np.eye(3)]
    G = np.column_stack([np.tile(np.eye(3), (len(ids), 1)), *spin, X.ravel()])
    left = np.linalg.qr(G, "complete")[0][:, 7:]
    C = left.T @ turn @ joint.matrix[np.ix_(rows, rows)] @ turn.T @ left
    d = left.T @ e.ravel()
    return float(np.sqrt(d @ np.linalg.solve(C, d) / len(d)))


def in_parts(truth, ids, e) -> float:
    """The root mean square of errors relative to the extent of the true centres."""
    X = np.array([truth[id].X0 for id in ids])
    extent = np.sqrt(((X - X.mean(0)) ** 2).sum(1).mean())
    return float(np.sqrt((e**2).sum(1).mean()) / extent)


def ours(folder: Path, truth: dict[str, Shot], pairs: str) -> dict:
    stages, last = {}, ["", time.perf_counter()]

    def tell(stage, done, total):
        now = time.perf_counter()
        if last[0]:
            stages[last[0]] = round(stages.get(last[0], 0.0) + now - last[1], 2)
        last[:] = [stage, now]

    start, processor = time.perf_counter(), time.process_time()
    try:
        found = reconstruct([folder], settings=ReconstructionSettings(pairs=pairs), progress=tell)
    except NotSolvedError as error:
        return {"failed": str(error), "parts": [], "left_out": dict.fromkeys(truth, "")}
    return {
        "seconds": time.perf_counter() - start, "processor": time.process_time() - processor,
        "stages": stages, "peak_mb": machine.peak_mb(),
        "parts": [of_part(part, truth) for part in found.parts],
        "left_out": dict(found.left_out), "notes": [*found.warnings, *found.notes],
    }  # fmt: skip


def of_part(part: ReconstructedPart, truth: dict[str, Shot]) -> dict:
    """The accuracy of a part; none for centres that belong elsewhere."""
    result = part.adjustment
    network, ids = result.network, result.network.images.id
    A, e = centre_errors(truth, ids, result.image_values[:, :3])
    C = np.einsum("ij,njk,lk->nil", A, result.image_covariance[:, :3, :3], A)
    sigma = np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    off = {}
    for c, camera in enumerate(network.cameras):
        first = next(id for k, id in enumerate(ids) if network.images.camera[k] == c)
        fx = result.cameras[camera.id]["parameters"]["fx"]
        if fx["sigma"]:
            off[camera.id] = abs(fx["value"] - truth[first].camera.parameters["fx"]) / fx["sigma"]
    return {
        "photographs": len(ids), "of": sorted({truth[id].part for id in ids}),
        "points": len(network.points), "image_points": len(network.observations),
        "centres_rms": in_parts(truth, ids, e),
        "centres_worst_sigma": float(np.abs(e / sigma).max()),
        "centres_over_sigma": error_over_sigma(result, truth, ids, A, e),
        "c_error_sigma": off, "sigma0": result.sigma0, "removed": len(result.removed),
        "factors": dict(part.factors),
    }  # fmt: skip


def colmap(folder: Path, truth: dict[str, Shot], pairs: str) -> dict | None:
    if not machine.installed("pycolmap"):
        return None
    import pycolmap

    with tempfile.TemporaryDirectory() as work:
        database = Path(work) / "database.db"
        start, processor = time.perf_counter(), time.process_time()
        sizes = {shot.camera.image_size for shot in truth.values()}
        one = len(sizes) == 1 and not any(shot.upright for shot in truth.values())
        mode = pycolmap.CameraMode.SINGLE if one else pycolmap.CameraMode.AUTO
        pycolmap.extract_features(database, folder, camera_mode=mode)
        if pairs == "sequence":
            options = pycolmap.SequentialPairingOptions()
            options.overlap = CandidateSettings().sequence_neighbours
            options.quadratic_overlap = False
            pycolmap.match_sequential(database, pairing_options=options)
        else:
            pycolmap.match_exhaustive(database)
        models = pycolmap.incremental_mapping(database, folder, work)
        seconds, processor = time.perf_counter() - start, time.process_time() - processor
        parts = []
        for model in sorted(models.values(), key=lambda m: -m.num_reg_images()):
            images = [model.images[k] for k in model.reg_image_ids()]
            X0 = np.array([image.projection_center() for image in images])
            ids = [image.name for image in images]
            parts.append({"photographs": len(ids), "of": sorted({truth[id].part for id in ids}),
                          "centres_rms": in_parts(truth, ids, centre_errors(truth, ids, X0)[1])})
    return {"seconds": seconds, "processor": processor, "parts": parts}


def run(
    name: str, shots: Sequence[Shot], folder: Path, beside: bool, pairs: str
) -> tuple[dict, list[str]]:
    """The figures of a set, and their errors."""
    write(shots, folder)
    truth = {shot.name: shot for shot in shots}
    figures = {"ours": ours(folder, truth, pairs)}
    if beside:
        figures["pycolmap"] = colmap(folder, truth, pairs)
    found, parts = figures["ours"], figures["ours"]["parts"]
    lost = [id for id in found["left_out"] if truth[id].part]
    wrong = [
        text for text, bad in (
            (f"left out: {', '.join(lost)}", lost),
            ("photographs in a part they do not belong to",
             any(len(p["of"]) != 1 or p["of"] == [0] for p in parts)),
            ("a scene is in pieces", len(parts) != len({s.part for s in shots} - {0})),
            (f"c is more than {LIMIT:g} σ off",
             any(not off < LIMIT for p in parts for off in p["c_error_sigma"].values())),
            (f"a centre is more than {LIMIT:g} σ off",
             any(not p["centres_worst_sigma"] < LIMIT for p in parts)),
            ("σ0 is not 1", any(not abs(p["sigma0"] - 1) < 0.02 for p in parts)),
        ) if bad
    ]  # fmt: skip
    return figures, [f"{name}: {text}" for text in wrong]


def main():
    parser = machine.parser_of(__doc__)
    parser.add_argument("--set", choices=[*SETS, "all"], default="convergent")
    parser.add_argument("--photographs", type=machine.positive, default=11)
    parser.add_argument("--width", type=machine.positive)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--colmap", action="store_true")
    parser.add_argument("--pairs", choices=("auto", "sequence"), default="auto")
    parser.add_argument("--json", type=machine.target, metavar="FILE")
    given = parser.parse_args()
    allow_programs_at_once()
    jaxbundle.enable_x64()
    figures: dict = {"machine": machine.machine()}
    wrong = []
    with tempfile.TemporaryDirectory() as temporary:
        for name in SETS if given.set == "all" else [given.set]:
            if name == "convergent":
                shots = convergent(given.width or 2800, given.photographs)
                folder = f"{name}_{given.photographs}_{given.width or 2800}"
            else:
                shots, folder = SETS[name](given.width or WIDTH), f"{name}_{given.width or WIDTH}"
            place = (given.folder or Path(temporary)) / folder
            figures[name], bad = run(name, shots, place, given.colmap, given.pairs)
            print(json.dumps({name: figures[name]}, indent=1, ensure_ascii=False), flush=True)
            wrong += bad
    machine.write_json(figures, given.json)
    return machine.verdict(wrong)


if __name__ == "__main__":
    sys.exit(main())
