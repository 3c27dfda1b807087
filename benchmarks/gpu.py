"""Everything that should be fast on a GPU, on the GPU and on the processor of the same machine.

    python benchmarks/gpu.py [--bal FOLDER] [--parts NAME ...] [--seconds N] [--json FILE]

Needs Python, JAX (for a GPU: with CUDA), equinox, optimistix, lineax and scipy; no network. BAL
problems are read from FOLDER (`problem-16-22106-pre.txt`, `problem-49-7776-pre.txt`, plain, .gz or
.bz2); without it they are skipped and said. Every part runs in processes of its own: on the default
device with an empty folder of compiled programs ("first": compilation included, "best" of the calls
after it), again with the programs kept by the first ("second process"), and on the processor. What
does not fit into the time (480 s) is listed as left out. Without a GPU only the processor is
measured.

    bal 16, bal 49     a whole solution, and one evaluation
    street, arc        the same, of a banded and of a full reduced system
    1000, 10000        cameras of 20 views × 88 points, calibrated independently
    to ground, back    pixels of a line scanner to the ellipsoid, and ground points to pixels
    gradient           of one principal distance by all image coordinates of the arc

"Limit": the time in which the device can move the bytes that must move, at the bandwidth of a copy
measured in the same process: of an evaluation the measurements, weights and row numbers once and
the blocks W of all incidences three times (written, and read by elimination and substitution); of
cameras their measurements once an iteration; of a scanner coordinates in and out.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import machine

HERE = Path(__file__).parent
BAL = {"bal 16": "problem-16-22106-pre.txt", "bal 49": "problem-49-7776-pre.txt"}
SCENES = {"street": ("street", 600, 60_000), "arc": ("arc", 120, 20_000)}
PARTS = (*BAL, *SCENES, "cameras 1000", "cameras 10000", "to ground", "back", "gradient")
COLUMNS = ("first", "best", "per evaluation", "limit", "device MB")
LONGEST = 150
"""Seconds of one process."""


def main() -> int:
    parser = machine.parser_of(__doc__)
    parser.add_argument("--bal", type=Path, metavar="FOLDER")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, metavar="NAME")
    parser.add_argument("--seconds", type=machine.positive, default=480, help="of everything")
    parser.add_argument("--json", type=machine.target, metavar="FILE")
    parser.add_argument("--part", choices=PARTS, help="one part, in this process")
    given = parser.parse_args()
    if given.part:
        print(json.dumps(measure(given.part, given.bal)))
        return 0
    end = time.monotonic() + given.seconds
    devices = find_devices()
    print(machine.in_words(devices))
    figures, wrong = {"machine": devices, "parts": {}}, []
    runs = ["processor"] if devices["platform"] == "cpu" else [
        "device", "second process", "processor"
    ]  # fmt: skip
    print(f"{'':12} {'':15}" + "".join(f"{column:>16}" for column in COLUMNS))
    with tempfile.TemporaryDirectory() as folder:
        for part in given.parts:
            for run in runs:
                row = run_part(part, run, given.bal, Path(folder) / part.replace(" ", "-"), end)
                figures["parts"].setdefault(part, {})[run] = row
                print(in_a_line(part, run, row), flush=True)
                wrong += [f"{part}, {run}: {row['wrong']}"] if row.get("wrong") else []
                machine.write_json(figures, given.json if given.json != "-" else None)
    if given.json == "-":
        machine.write_json(figures, "-")
    return machine.verdict(wrong)


def find_devices() -> dict:
    """The default devices, by a process of their own, which gives their memory back."""
    code = "import json, machine, jax; print(json.dumps(machine.machine()))"
    found = subprocess.run([sys.executable, "-c", code], cwd=HERE, capture_output=True, text=True)
    if found.returncode:
        sys.exit(f"JAX cannot be started:\n{found.stderr[-1000:]}")
    return json.loads(found.stdout.splitlines()[-1]) | {"float64": True}


def run_part(part: str, run: str, bal: Path | None, cache: Path, end: float) -> dict:
    """The figures of a part in a process of its own; `wrong` or `left out` if there are none."""
    left = end - time.monotonic()
    if part in BAL and find_problem(part, bal) is None:
        return {"left out": f"no {BAL[part]} (--bal FOLDER)"}
    if left < 10:
        return {"left out": "no time left"}
    cache = cache.with_name(f"{cache.name}-{'processor' if run == 'processor' else 'device'}")
    cache.mkdir(parents=True, exist_ok=True)
    environment = os.environ | {
        "JAX_COMPILATION_CACHE_DIR": str(cache), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "PYTHONPATH": os.pathsep.join([str(HERE.parent), os.environ.get("PYTHONPATH", "")]),
    }  # fmt: skip
    if run == "processor":
        environment["JAX_PLATFORMS"] = "cpu"
    command = [sys.executable, __file__, "--part", part, *(("--bal", str(bal)) if bal else ())]
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=min(left, LONGEST)
        )
    except subprocess.TimeoutExpired:
        return {"left out": f"not finished within {min(left, LONGEST):.0f} s"}
    if done.returncode:
        return {"wrong": " ".join(done.stderr.split())[-300:]}
    return json.loads(done.stdout.splitlines()[-1])


def in_a_line(part: str, run: str, row: dict) -> str:
    begin = f"{part:12} {run:15}"
    if "left out" in row:
        return f"{begin} left out: {row['left out']}"
    if "wrong" in row and "best" not in row:
        return f"{begin} WRONG: {row['wrong']}"
    seconds = [row["first"], row["best"], row.get("per evaluation"), row["limit"]]
    cells = ["–" if s is None else f"{s:.3g} s" if s >= 1 else f"{1e3 * s:.3g} ms" for s in seconds]
    memory = row.get("device MB")
    cells.append("–" if memory is None else f"{memory:.0f}")
    return begin + "".join(f"{cell:>16}" for cell in cells) + f"   {row.get('rate', '')}"


# ------------------------------------------------------------------ one part, in this process


def measure(part: str, bal: Path | None) -> dict:
    import jax

    import jaxbundle

    jaxbundle.enable_x64()
    begin = time.perf_counter()
    if part in BAL or part in SCENES:
        found = _solve(jax, _problem(part, bal))
    elif part.startswith("cameras"):
        found = _calibrate(jax, int(part.split()[1]))
    elif part == "gradient":
        found = _gradient(jax, _problem("arc", bal))
    else:
        found = _scan(jax, part)
    memory = machine.device_peak_mb()  # before the arrays of `_bandwidth`
    found["limit"] = found.pop("bytes") / _bandwidth(jax)
    return found | {
        "seconds": time.perf_counter() - begin, "device MB": memory,
        "MB": machine.peak_mb(), "device": jax.devices()[0].device_kind,
    }  # fmt: skip


def find_problem(part: str, bal: Path | None) -> Path | None:
    names = [BAL[part] + end for end in ("", ".gz", ".bz2")]
    return next((bal / name for name in names if (bal / name).exists()), None) if bal else None


def _problem(part: str, bal: Path | None):
    import jaxbundle

    if part in BAL:
        path = find_problem(part, bal)
    else:
        path = Path(tempfile.mkdtemp()) / f"{part}.txt"
        kind, images, points = SCENES[part]
        made = [sys.executable, str(HERE / "scenes.py"), kind, str(images), str(points), "0", path]
        subprocess.run(made, check=True, stdout=subprocess.DEVNULL)
    network = jaxbundle.check_network(jaxbundle.read_network(str(path)))
    return jaxbundle.make_problem(network)


def _timed(jax, run, least=3, seconds=5.0):
    """The result, the time of the first call, and the best of some more."""
    times = []
    while len(times) < least + 1 or sum(times[1:]) < seconds and len(times) < 50:
        begin = time.perf_counter()
        result = jax.block_until_ready(run())
        times.append(time.perf_counter() - begin)
    return result, {"first": times[0], "best": min(times[1:])}


def _solve(jax, problem) -> dict:
    from jaxbundle.leastsquares.iterations.solver import minimise_compiled
    from jaxbundle.leastsquares.iterations.stopping import TERMINATIONS, converged
    from jaxbundle.leastsquares.problem import make_solver, pad_data

    solver, data = make_solver(problem, max_steps=60), pad_data(problem, problem.data)
    minimum, found = _timed(jax, lambda: minimise_compiled(solver, data, data.start))
    evaluations = int(minimum.iterations)
    found |= {"evaluations": evaluations, "cost": float(minimum.history.cost[evaluations - 1])}
    found["per evaluation"] = found["best"] / evaluations
    found["rate"] = f"{evaluations} evaluations, {problem.plan.reduction}"
    if not bool(converged(minimum.termination)):
        found["ended"] = TERMINATIONS[int(minimum.termination)]
    return found | {"bytes": evaluations * _bytes_of_evaluation(problem)}


def _bytes_of_evaluation(problem) -> int:
    """See the module: 8 bytes a number, 4 a row number."""
    plan = problem.plan
    e = problem.table(plan.eliminated).space.width if plan.eliminated else 0
    W = sum(8 * e * plan.groups[g].width * at.eliminated.size for g, at in plan.incidences.items())
    seen = sum(
        o.number * (8 * 2 * problem.weights(o.name).shape[1] + 4 * len(o.kind.of))
        for o in problem.observations
    )
    return 3 * W + seen


def _gradient(jax, problem) -> dict:
    import dataclasses

    import jaxbundle.leastsquares as ls

    camera = next(t.name for t in problem.tables if t.title == "camera" or "camera" in t.name)

    @jax.jit
    def gradient(measured):
        distance = lambda m: jax.numpy.ravel(
            ls.solve(problem, dataclasses.replace(problem.data, measured=m))[camera]
        )[0]
        return jax.grad(distance)(measured)

    slopes, found = _timed(jax, lambda: gradient(problem.data.measured))
    finite = all(bool(jax.numpy.isfinite(x).all()) for x in jax.tree.leaves(slopes))
    return found | ({} if finite else {"wrong": "the gradient is not finite"}) | {
        "bytes": 10 * _bytes_of_evaluation(problem), "rate": "ten evaluations' bytes",
    }  # fmt: skip


def _calibrate(jax, cameras: int) -> dict:
    import calibration
    import numpy as np

    import jaxbundle

    # A hundred cameras, repeated: simulating each takes longer than calibrating it.
    truth, images = zip(*map(calibration.simulate, range(100)))
    turn = -(-cameras // 100)
    images = np.tile(np.stack(images), (turn, 1, 1, 1))[:cameras]
    X = calibration.board().astype(np.float32)
    batch, found = _timed(
        jax, lambda: jaxbundle.calibrate_batch(X, images, calibration.SIZE), least=2
    )
    error = ((batch.values - np.tile(np.stack(truth), (turn, 1))[:cameras]) / batch.sigma)[:100]
    if not (batch.converged.all() and (np.abs(error.std(0) - 1) < 0.36).all()):  # 5/√200
        found["wrong"] = "not converged, or errors of the parameters do not agree with their σ"
    iterations = float(batch.iterations.mean())
    found["rate"] = f"{1e3 * found['best'] / cameras:.3g} ms a camera"
    return found | {"bytes": int(images.size * 8 * iterations)}


def _scan(jax, part: str) -> dict:
    import numpy as np
    import pushbroom

    from jaxbundle.pushbroom.ground_to_image import make_search, project_from
    from jaxbundle.pushbroom.image_to_ground import locate_lines
    from jaxbundle.pushbroom.surfaces import Ground

    scan, ground, rows = pushbroom.image(), Ground(), 512
    lines = np.arange(rows) * 1.0
    locate = jax.jit(lambda scan: locate_lines(scan, ground, lines, pushbroom.U))
    pixels = rows * pushbroom.PIXELS
    if part == "to ground":
        X, found = _timed(jax, lambda: locate(scan))
        moved = 24 * pixels
    else:
        X, search = tuple(locate(scan)), make_search(scan)
        back = jax.jit(lambda scan, X: project_from(
            scan, search, X, lines[:, None] + 9.0, pushbroom.U + 4.0
        ))  # fmt: skip
        seen, found = _timed(jax, lambda: back(scan, X))
        off = np.abs(np.asarray(seen[0]) - lines[:, None]).max()
        found |= {} if off < 1e-3 else {"wrong": f"off by {off:.3g} lines"}
        moved = 40 * pixels
    found["rate"] = f"{pixels / found['best'] / 1e6:.4g} Mpx/s"
    return found | {"bytes": moved}


def _bandwidth(jax) -> float:
    """Bytes read and written by a copy, per second."""
    size = 1 << (27 if jax.default_backend() != "cpu" else 24)
    x = jax.numpy.zeros(size)
    copy = jax.jit(lambda x: x + 1.0)
    _, found = _timed(jax, lambda: copy(x), least=5, seconds=0.5)
    return 2 * 8 * size / found["best"]


if __name__ == "__main__":
    sys.exit(main())
