"""Cameras above water and a board in it, beside AquaCal, on its own simulation.

    python -m venv /tmp/peer && /tmp/peer/bin/pip install aquacal
    python benchmarks/refraction.py --peer /tmp/peer/bin/python [--cameras 8] [--frames 50]

AquaCal (2.1) simulates cameras, water surface and board, detects with noise of 0.5 px, finds start
values and estimates what both estimate: the poses of all cameras but the first and of all boards,
the height of the water, and fx, fy, cx, cy of every camera. We take the same image points and its
start values of the cameras; boards start from `cv2.solvePnP` as if there were no water. Printed:
seconds of either (its stages 3 and 3b; ours with compiling, and again), and errors against the
truth. Ours has σ of everything as well.
"""

import argparse
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np


def run_peer(cameras: int, frames: int, out: str) -> None:
    """Simulate and calibrate by AquaCal, in its own interpreter."""
    from aquacal.calibration import extrinsics as stage_2
    from aquacal.core.board import BoardGeometry
    from aquacal.datasets import pipelines, synthetic

    board = synthetic.BoardConfig(
        squares_x=12, squares_y=9, square_size=0.06, marker_size=0.045, dictionary="DICT_5X5_100"
    )
    intrinsics, poses, water = synthetic.generate_camera_array(
        cameras, layout="ring", spacing=0.3, seed=42
    )
    centres = {name: pose.C for name, pose in poses.items()}
    boards = synthetic.generate_board_trajectory(
        frames, centres, water, board=board, xy_extent=0.3, seed=42
    )
    scenario = synthetic.SyntheticScenario(
        name="calibration", board_config=board, intrinsics=intrinsics, extrinsics=poses,
        water_zs=water, board_poses=boards, noise_std=0.5, description="", n_air=1.0,
        n_water=1.333, seed=42,
    )  # fmt: skip
    began = {}

    def remember(*args, **options):
        began.update(stage_2.estimate_extrinsics(*args, **options))
        return dict(began)

    pipelines.estimate_extrinsics = remember
    times: dict = {}
    start = time.perf_counter()
    result, detections = pipelines.calibrate_synthetic(scenario, 1.333, timings_out=times)
    print("AquaCal", times, "in all", time.perf_counter() - start, flush=True)
    names = list(intrinsics)
    rows = [
        (c, f, int(corner), *xy)
        for f, frame in detections.frames.items()
        for c, name in enumerate(names)
        if name in frame.detections
        for corner, xy in zip(
            frame.detections[name].corner_ids, frame.detections[name].corners_2d.reshape(-1, 2)
        )
    ]
    stack = lambda of: np.array([of(name) for name in names])
    np.savez(
        out,
        rows=np.array(rows),
        corners=BoardGeometry(board).corner_array
        if hasattr(BoardGeometry(board), "corner_array")
        else np.array([x for _, x in sorted(BoardGeometry(board).corner_positions.items())]),
        K=stack(lambda n: intrinsics[n].K),
        distortion=stack(lambda n: intrinsics[n].dist_coeffs),
        image_size=np.array(intrinsics[names[0]].image_size),
        R=stack(lambda n: poses[n].R),
        C=stack(lambda n: poses[n].C),
        start_R=stack(lambda n: began[n].R),
        start_C=stack(lambda n: began[n].C),
        water=water[names[0]],
        peer_K=stack(lambda n: result.cameras[n].intrinsics.K),
        peer_R=stack(lambda n: result.cameras[n].extrinsics.R),
        peer_C=stack(lambda n: result.cameras[n].extrinsics.C),
        peer_water=result.cameras[names[0]].water_z,
        peer_seconds=sum(times.values()),
    )


def boards_from_one_camera(data, frames):
    """R, t of every board in the world, by the camera that sees most of it, through air."""
    import cv2

    camera, frame, corner = data["rows"][:, :3].astype(int).T
    found = {}
    for f in frames:
        seen = np.flatnonzero(frame == f)
        c = np.bincount(camera[seen]).argmax()
        seen = seen[camera[seen] == c]
        _, turn, t = cv2.solvePnP(
            data["corners"][corner[seen]], data["rows"][seen, 3:], data["K"][c],
            data["distortion"][c],
        )  # fmt: skip
        R = data["start_R"][c].T
        place = R @ t.ravel() + data["start_C"][c]
        # as if the water were air a board appears at 3/4 of its depth
        place[2] += (place[2] - 1.0) / 3
        found[f] = (R @ cv2.Rodrigues(turn)[0], place)
    return found


def network_of(data):
    """The network of cameras, boards and surface."""
    import jaxbundle
    from jaxbundle.geometry import omega_phi_kappa_from_matrix

    rows, D = data["rows"], np.diag([1.0, -1.0, -1.0])
    cameras, images = [], []
    names = ("k1", "k2", "p1", "p2", "k3")
    for c, K in enumerate(data["K"]):
        values = dict(fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2])
        values |= dict(zip(names, np.resize(data["distortion"][c], 5)))
        cameras.append(jaxbundle.Camera(
            f"cam{c}", "opencv", {k: float(v) for k, v in values.items()},
            ("fx", "fy", "cx", "cy"), image_size=tuple(data["image_size"].tolist()),
        ))  # fmt: skip
        angles = np.asarray(omega_phi_kappa_from_matrix(D @ data["start_R"][c]))
        row = dict(zip(("X0", "Y0", "Z0", "omega", "phi", "kappa"), (*data["start_C"][c], *angles)))
        held = 0.0 if not c else None  # the first gives the datum
        row |= dict.fromkeys(("sX0", "sY0", "sZ0", "somega", "sphi", "skappa"), held)
        images.append({"id": f"im{c}", "camera": f"cam{c}"} | row)
    frames = np.unique(rows[:, 1].astype(int))
    boards = boards_from_one_camera(data, frames)
    used = np.unique(rows[:, 1:3].astype(int), axis=0)
    place = data["corners"][used[:, 1]]
    X = np.array([boards[f][0] @ x + boards[f][1] for (f, _), x in zip(used, place)])
    ids = [f"{f}-{k}" for f, k in used.tolist()]
    network = jaxbundle.make_network(
        cameras, images, {"id": ids, "X": X[:, 0], "Y": X[:, 1], "Z": X[:, 2]},
        {
            "image": [f"im{int(c)}" for c in rows[:, 0]],
            "point": [f"{int(f)}-{int(k)}" for f, k in rows[:, 1:3]],
            "x": rows[:, 3], "y": rows[:, 4],
        },
        image_unit="px", sigma_image=0.5, residuals="measured",
        shapes={"shape": [str(f) for f in used[:, 0]], "point": ids,
                "x": place[:, 0], "y": place[:, 1], "z": place[:, 2]},
        # z down, into the water; z of the plane up
        interfaces=[{"interface": "water", "type": "flat", "Z": 1.0, "sZ": "free", "omega": np.pi,
                     "index": 1.333}],
    )  # fmt: skip
    return network


def errors(data, K, R, C, water):
    """Largest errors of focal lengths (%), principal points (px), rotations (°), positions and
    water (mm)."""
    of = np.array([[K[:, 0, 0], K[:, 1, 1]], [data["K"][:, 0, 0], data["K"][:, 1, 1]]])
    turn = np.einsum("nij,nkj->nik", R, data["R"])
    angle = np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1))
    return (
        100 * np.abs(of[0] / of[1] - 1).max(),
        np.linalg.norm(K[:, :2, 2] - data["K"][:, :2, 2], axis=1).max(),
        np.degrees(angle).max(),
        1e3 * np.linalg.norm(C - data["C"], axis=1).max(),
        1e3 * abs(water - float(data["water"])),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peer", help="a Python that has aquacal")
    parser.add_argument("--cameras", type=int, default=8)
    parser.add_argument("--frames", type=int, default=50)
    parser.add_argument("--data", help="the file of an earlier run of the peer")
    parser.add_argument("--as-peer", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.as_peer:
        run_peer(given.cameras, given.frames, given.as_peer)
        return
    path = given.data or str(Path(tempfile.mkdtemp()) / "aquacal.npz")
    if not given.data:
        numbers = ["--cameras", str(given.cameras), "--frames", str(given.frames)]
        subprocess.run([given.peer, __file__, "--as-peer", path, *numbers], check=True)
    import jaxbundle
    from jaxbundle.geometry import matrix_from_omega_phi_kappa

    jaxbundle.enable_x64()
    data = np.load(path)
    print(f"{len(data['K'])} cameras, {len(np.unique(data['rows'][:, 1]))} boards, "
          f"{len(data['rows'])} image points")  # fmt: skip
    for run in ("first", "again"):
        start = time.perf_counter()
        network = network_of(data)
        built = time.perf_counter()
        result = jaxbundle.adjust(network)
        solved = time.perf_counter()
        unknowns = result.further_unknowns["interface"]["water"]["Z0"]
        done = time.perf_counter()
        print(f"jaxbundle, {run}: {done - start:.1f} s (network and start values "
              f"{built - start:.1f}, adjustment {solved - built:.1f}, σ {done - solved:.1f}), "
              f"{result.iterations} iterations, σ0 {result.sigma0:.4f}")  # fmt: skip
    values = [result.camera_parameters(f"cam{c}") for c in range(len(data["K"]))]
    K = np.array([[[v["fx"], 0, v["cx"]], [0, v["fy"], v["cy"]], [0, 0, 1]] for v in values])
    M = np.array([np.asarray(matrix_from_omega_phi_kappa(a)) for a in result.image_values[:, 3:]])
    ours = errors(data, K, np.diag([1.0, -1.0, -1.0]) @ M, result.image_values[:, :3],
                  unknowns["value"])  # fmt: skip
    peer = errors(data, *(data[f"peer_{n}"] for n in ("K", "R", "C", "water")))
    seconds = float(data["peer_seconds"])
    print(f"AquaCal: {seconds:.1f} s, {seconds / (done - start):.0f} times ours")
    print("largest errors:  focal length %  principal point px  rotation °  position mm  water mm")
    for name, found in (("jaxbundle", ours), ("AquaCal", peer)):
        print(f"{name:16}" + "".join(f"{x:14.4f}" for x in found))
    off = abs(unknowns["value"] - float(data["water"]))
    print(f"height of the water: error {1e3 * off:.3f} mm, σ {1e3 * unknowns['sigma']:.3f} mm")


if __name__ == "__main__":
    main()
