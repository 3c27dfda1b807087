"""Ceres as it comes with pycolmap on one BAL problem; prints one line of JSON for `bal.py`.

    python benchmarks/bal_pycolmap.py PROBLEM [--solver NAME] [--evaluations N] [--repeat N]
        [--threads N]

COLMAP's camera RADIAL is Snavely's (f, k1, k2) with a principal point, held at 0 here; its camera
looks along +z with y down, that of a BAL problem along −z with y up: both are rotated by 180° about
x. Every image has its own camera, there is no loss function and no fixed datum, so the cost is that
of the problem. One difference remains: COLMAP drops the rays of points behind the camera while they
are there. Therefore ½Σv² of all rays is computed here too, for the start values and the result; the
costs are `comparable` only if both agree with Ceres.

Times are those of Ceres' minimizer, without COLMAP's preparation and Ceres' preprocessor. In COLMAP
pose and interior orientation of an image are two parameter blocks, in Ceres' own `bundle_adjuster`
one block of nine, so Ceres cannot use its compiled sizes 2, 3, 9 here.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile

import machine
import numpy as np
import scenes
from bal_ceres import PRECONDITIONER, SOLVERS, figures_of

try:
    import pycolmap
except ImportError:
    pycolmap = None

TURN = np.diag([1.0, -1.0, -1.0])
SAME = 1e-6
"""Relative difference of costs of the same rays; Ceres' table of costs has seven digits."""


def reconstruction(cameras, points, image, point, xy) -> pycolmap.Reconstruction:
    """A BAL problem for COLMAP, numbered from 1 as there."""
    whole = pycolmap.Reconstruction()
    order = np.argsort(image, kind="stable")
    first = np.searchsorted(image[order], np.arange(len(cameras) + 1))
    row_in_image = np.empty(len(image), int)
    row_in_image[order] = np.arange(len(image)) - first[image[order]]
    for i, (M, camera) in enumerate(zip(scenes.matrices(cameras[:, :3]), cameras)):
        f, k1, k2 = camera[6:]
        whole.add_camera_with_trivial_rig(pycolmap.Camera(
            model="RADIAL", width=1, height=1, params=[f, 0, 0, k1, k2], camera_id=i + 1
        ))  # fmt: skip
        rows = order[first[i] : first[i + 1]]
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(TURN @ M), TURN @ camera[3:6])
        whole.add_image_with_trivial_frame(
            pycolmap.Image(name=str(i), keypoints=xy[rows] * [1, -1], camera_id=i + 1,
                           image_id=i + 1), pose,
        )  # fmt: skip
    order = np.argsort(point, kind="stable")
    first = np.searchsorted(point[order], np.arange(len(points) + 1))
    elements = [
        pycolmap.TrackElement(i + 1, row)
        for i, row in zip(image[order].tolist(), row_in_image[order].tolist())
    ]
    for X, begin, end in zip(points, first[:-1], first[1:]):
        whole.add_point3D(X, pycolmap.Track(elements[begin:end]))
    return whole


def values_of(whole: pycolmap.Reconstruction, cameras, points):
    """Cameras and points of a BAL problem, back from COLMAP."""
    cameras, points = cameras.copy(), points.copy()
    for number, image in whole.images.items():
        pose = image.cam_from_world().matrix()
        cameras[number - 1, :3] = scenes.rotation_vectors(TURN @ pose[:, :3])
        cameras[number - 1, 3:6] = TURN @ pose[:, 3]
        cameras[number - 1, 6:] = np.asarray(image.camera.params)[[0, 3, 4]]
    for number, point in whole.points3D.items():
        points[number - 1] = point.xyz
    return cameras, points


def options_of(given) -> pycolmap.BundleAdjustmentOptions:
    """As in Ceres' example: its tolerances, no loss function; the given solver and threads."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = True
    options.refine_principal_point = options.print_summary = False
    options.ceres.auto_select_solver_type = False
    options.ceres.min_num_residuals_for_cpu_multi_threading = 0
    solver = options.ceres.solver_options
    solver.linear_solver_type = given.solver.upper()
    solver.preconditioner_type = PRECONDITIONER.upper()
    solver.num_threads, solver.max_num_iterations = given.threads, given.evaluations - 1
    solver.function_tolerance = solver.gradient_tolerance = 1e-16
    solver.parameter_tolerance = 1e-8
    solver.logging_type, solver.minimizer_progress_to_stdout = "PER_MINIMIZER_ITERATION", True
    return options


def solved(adjuster):
    """Summary of a solution, and what it printed on the standard output of the process."""
    kept = os.dup(1)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 1)
        try:
            summary = adjuster.solve().ceres_summary
        finally:
            os.dup2(kept, 1)
            os.close(kept)
        file.seek(0)
        return summary, file.read().decode()


def main() -> None:
    parser = machine.solver_parser(__doc__)
    parser.add_argument("--solver", choices=SOLVERS, default=SOLVERS[0])
    parser.add_argument("--threads", type=machine.positive, default=2)
    given = parser.parse_args()
    if pycolmap is None:
        sys.exit("pycolmap is not installed (pip install pycolmap)")
    cameras, points, *rays = scenes.read_bal(given.problem)
    config = pycolmap.BundleAdjustmentConfig()
    for i in range(len(cameras)):
        config.add_image(i + 1)
    runs, options = [], options_of(given)
    for _ in range(given.repeat):
        whole = reconstruction(cameras, points, *rays)
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, whole)
        summary, text = solved(adjuster)
        runs.append(figures_of(text) | {
            "cost": summary.final_cost, "ended": summary.message.rstrip("."),
            "at_limit": "Maximum number of iterations" in summary.message,
        })  # fmt: skip
    best = min(runs, key=lambda run: run["seconds"])
    peak_mb = machine.peak_mb()
    said = np.array([summary.initial_cost, summary.final_cost])
    of_all = np.array([
        scenes.half_square(*values, *rays)
        for values in ((cameras, points), values_of(whole, cameras, points))
    ])  # fmt: skip
    json.dump(best | {
        "solver": f"Ceres {pycolmap.__ceres_version__} of pycolmap {pycolmap.__version__}, "
                  f"{given.solver}",
        "comparable": bool((np.abs(said - of_all) < SAME * of_all).all()),
        "costs_of_all_rays": of_all.tolist(),
        "costs_said": said.tolist(),
        "peak_mb": peak_mb,
    }, sys.stdout)  # fmt: skip


if __name__ == "__main__":
    main()
