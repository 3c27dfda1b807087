"""1000 cameras, calibrated independently, against OpenCV in two processes in the same run.

    python benchmarks/calibration.py [--cameras N] [--repeat N] [--correlated batch|camera]
                                     [--field PX] [--json FILE]

Every camera: 20 views of a board of 11 × 8 corners, 1920 × 1080 pixels, σ = 0.3 pixels, OpenCV's
model of 5 coefficients. `jaxbundle.calibrate_batch` gives parameters, poses and all their standard
deviations, `cv2.calibrateCamera` parameters and poses; both find their own start values. The two
take turns; the best of all turns counts, compilation is reported separately.

The answers are checked: every camera has converged, the RMS is that of OpenCV to 1e-6 pixels (or
lower, if OpenCV has not converged after its 30 iterations), and the errors of the parameters
divided by their σ have standard deviation 1. Otherwise the exit status is 1. Without OpenCV
(`opencv-python-headless`) only our side is measured.
"""

import multiprocessing
import os
import resource
import sys
import time

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import machine
import numpy as np

VIEWS, COLUMNS, ROWS, SQUARE = 20, 11, 8, 0.03
SIZE, NOISE, PROCESSES = (1920, 1080), 0.3, 2


def board() -> np.ndarray:
    """Corners [88, 3], about their middle, in metres."""
    grid = np.mgrid[0:COLUMNS, 0:ROWS].T.reshape(-1, 2) * SQUARE
    return np.c_[grid - grid.mean(0), np.zeros(len(grid))]


def image(p, turn, shift, X):
    """Pixels of the corners by the formulas of OpenCV's documentation; `turn`: rotation vector."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = p
    angle = np.linalg.norm(turn)
    a, b, c = turn / angle
    K = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
    R = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    x, y, z = R @ X.T + shift[:, None]
    x, y = x / z, y / z
    r2 = x * x + y * y
    k = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = fx * (x * k + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + cx
    v = fy * (y * k + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + cy
    return np.stack([u, v], 1)


def simulate(seed: int, field: float = 0.0):
    """A camera's true parameters [9] and its images [20, 88, 2], every corner within the image;
    `field`: amplitude of waves on the sensor that no lens model has, pixels."""
    rng = np.random.default_rng(seed)
    f = rng.uniform(1200, 1600)
    focal = [f, f * rng.uniform(0.99, 1.01)]
    middle = [SIZE[0] / 2 + rng.normal(0, 10), SIZE[1] / 2 + rng.normal(0, 10)]
    p = np.array([
        *focal, *middle, rng.normal(-0.2, 0.05), rng.normal(0.05, 0.03), rng.normal(0, 1e-3),
        rng.normal(0, 1e-3), rng.normal(0, 0.01),
    ])  # fmt: skip
    X, views = board(), []
    while len(views) < VIEWS:
        turn = rng.normal(0, 0.35, 3) * [1, 1, 0.5]
        shift = rng.uniform([-0.2, -0.12, 0.35], [0.2, 0.12, 0.8])
        xy = image(p, turn, shift, X)
        if (xy > 5).all() and (xy < np.array(SIZE) - 5).all():
            u, v = (xy / SIZE).T
            waves = np.stack([np.sin(9 * u + 5 * v), np.cos(7 * v - 6 * u)], 1)
            views.append(xy + rng.normal(0, NOISE, xy.shape) + field * waves)
    # OpenCV takes 32-bit coordinates: both sides get the same numbers.
    return p, np.stack(views).astype(np.float32)


def opencv_start() -> None:
    """Warm up each process before timing."""
    import cv2

    cv2.setNumThreads(1)


def opencv_calibrate(views) -> float:
    """RMS of one camera by OpenCV."""
    import cv2

    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 30, np.finfo(float).eps)
    X = [board().astype(np.float32)] * len(views)
    return cv2.calibrateCamera(X, list(views), SIZE, None, None, criteria=criteria)[0]


def clock(function):
    """Result, wall-clock seconds, processor seconds (this process)."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = function()
    return result, time.perf_counter() - wall, time.process_time() - cpu


def main() -> int:
    parser = machine.parser_of(__doc__)
    parser.add_argument("--cameras", type=machine.positive, default=1000)
    parser.add_argument("--repeat", type=machine.positive, default=3)
    parser.add_argument("--correlated", choices=("batch", "camera"),
                        help="also σ under errors that image points share, beside those without")
    parser.add_argument("--field", type=float, default=0.0,
                        help="amplitude of waves on the sensor, px")  # fmt: skip
    parser.add_argument("--json", type=machine.target, help="file for the figures; - for stdout")
    options = parser.parse_args()
    n = options.cameras

    simulated = (simulate(seed, options.field) for seed in range(n))
    truth, images = (np.stack(column) for column in zip(*simulated))
    peer = None
    try:
        import cv2 as peer
    except ImportError:
        print("skipped: OpenCV: not installed (pip install opencv-python-headless)",
              file=sys.stderr)  # fmt: skip
    # Separate processes, before JAX starts its threads.
    pool = multiprocessing.get_context("spawn").Pool(PROCESSES, opencv_start) if peer else None

    import jaxbundle

    jaxbundle.enable_x64()
    X = board().astype(np.float32)
    ours = lambda: jaxbundle.calibrate_batch(X, images, SIZE)
    _, first, _ = clock(ours)
    turns, peer_turns, theirs = [], [], None
    if pool:
        pool.map(opencv_calibrate, list(images[:8]))
    for _ in range(options.repeat):
        batch, *seconds = clock(ours)
        turns.append(seconds)
        if pool:
            theirs, wall, _ = clock(lambda: pool.map(opencv_calibrate, list(images), chunksize=10))
            peer_turns.append(wall)
    if pool:
        pool.close()
        pool.join()
    shared = []
    if options.correlated:
        under_errors = lambda: jaxbundle.calibrate_batch(
            X, images, SIZE, correlated=options.correlated
        )
        under_errors()
        shared = [clock(under_errors)[2] for _ in range(options.repeat)]

    wall, cpu = (1e3 * min(column) / n for column in zip(*turns))
    error = (batch.values - truth) / batch.sigma
    figures = {
        "machine": machine.machine(),
        "cameras": n,
        "converged": int(batch.converged.sum()),
        "iterations": float(batch.iterations.mean()),
        "compilation_s": round(first - n * wall / 1e3, 2),
        "ms_per_camera": round(wall, 3),
        "processor_ms_per_camera": round(cpu, 3),
        "error_over_sigma": [round(float(s), 3) for s in error.std(0)],
        "median_rms": float(np.median(batch.rms)),
    }
    if shared:
        figures["correlated_processor_ms_per_camera"] = round(1e3 * min(shared) / n, 3)
        figures["correlated_ratio"] = round(1e3 * min(shared) / n / cpu, 2)
    wrong = [] if batch.converged.all() else ["not every camera has converged"]
    # Waves are no independent errors: the classical σ do not hold them.
    if not options.field and not (np.abs(error.std(0) - 1) < 5 / np.sqrt(2 * n)).all():
        wrong.append("errors of the parameters do not agree with their σ")
    if pool:
        spent = resource.getrusage(resource.RUSAGE_CHILDREN)
        difference = batch.rms - np.array(theirs)
        figures |= {
            "opencv": peer.__version__,
            "opencv_ms_per_camera": round(1e3 * min(peer_turns) / n, 3),
            "opencv_processor_ms_per_camera": round(
                1e3 * (spent.ru_utime + spent.ru_stime) / n / options.repeat, 3
            ),
            "ratio": round(min(peer_turns) / n / wall * 1e3, 2),
            "rms_difference_median": float(np.median(np.abs(difference))),
            "rms_difference_largest": float(np.abs(difference).max()),
            "rms_above_opencv_largest": float(difference.max()),
            "opencv_not_arrived": int((difference < -1e-6).sum()),
        }
        if not difference.max() < 1e-6:
            wrong.append("an RMS is above that of OpenCV")
    if options.json != "-":
        print(machine.in_words(figures["machine"]))
        for name, value in list(figures.items())[1:]:
            print(f"{name:32s} {value}")
    machine.write_json(figures, options.json)
    return machine.verdict(wrong)


if __name__ == "__main__":
    sys.exit(main())
