"""Thousands of cameras by `jaxbundle batch`: time and memory by number, and a run killed and
resumed.

    python benchmarks/population.py [--cameras N N ...] [--json FILE]

The cameras are those of `calibration.py` (20 views of 88 corners), 1000 of them, the others the
same with other noise; three in a hundred are corrupted (no measurements, infinite ones, a corner
far off in all views). Each number of cameras is one `.npz`, read by `jaxbundle batch` in a separate
process, which writes parameters, covariances and poses of all. First the smallest number is run
once to compile, and once killed by SIGKILL when half of its lines are written and started again:
its lines must equal those of the uninterrupted run.

Exit status 1 if a line is missing or differs, a good camera has not converged, the time per
additional camera grows by more than a third from one number to the next, or the peak memory by more
than 20 kB per additional camera.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import calibration
import machine
import numpy as np

DISTINCT = 1000
SPOILT = 100
GROWTH, BYTES = 4 / 3, 20e3


def write_cameras(path: Path, images, number: int) -> None:
    """An `.npz` of this many cameras, three in a hundred corrupted."""
    rng = np.random.default_rng(number)
    xy = np.empty((number, *images.shape[1:]), np.float32)
    for first in range(0, number, len(images)):
        some = xy[first : first + len(images)]
        some[:] = images[: len(some)]
        if first:
            some += rng.normal(0, calibration.NOISE, some.shape)
    xy[0::SPOILT] = np.nan
    xy[1::SPOILT, 3] = np.inf
    xy[2::SPOILT, :, 40] += 300
    np.savez(path, object_points=calibration.board(), image_points=xy,
             image_size=calibration.SIZE, ids=[f"serial {i}" for i in range(number)])  # fmt: skip


def start(cameras: Path, lines: Path) -> subprocess.Popen:
    command = [sys.executable, "-m", "jaxbundle", "batch", str(cameras), "--json-lines",
               str(lines), "--quiet"]  # fmt: skip
    return subprocess.Popen(command)


def run(cameras: Path, lines: Path) -> tuple[float, float]:
    """Wall-clock seconds, peak resident memory in MB."""
    begin, peak = time.perf_counter(), 0.0
    process = start(cameras, lines)
    status = Path(f"/proc/{process.pid}/status")
    while process.poll() is None:
        try:
            found = [line for line in status.read_text().splitlines() if "VmHWM" in line]
            peak = max(peak, *(int(line.split()[1]) * 1024 / 1e6 for line in found))
        except (OSError, TypeError):
            pass
        time.sleep(0.02)
    if process.returncode:
        raise SystemExit(f"jaxbundle batch ended with {process.returncode}")
    return time.perf_counter() - begin, peak


def rows_of(lines: Path) -> dict[str, str]:
    found = lines.read_text().splitlines()
    rows = {json.loads(line)["key"]: line for line in found}
    assert len(rows) == len(found), "a key occurs twice"
    return rows


def killed(cameras: Path, lines: Path, half: int) -> int:
    """The number of lines after SIGKILL, sent when half of them were written."""
    process = start(cameras, lines)
    number = lambda: lines.read_bytes().count(b"\n") if lines.exists() else 0
    while number() < half:
        if process.poll() is not None:
            raise SystemExit("ended before it could be killed")
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.wait()
    return number()


def main() -> int:
    parser = machine.parser_of(__doc__)
    parser.add_argument("--cameras", type=machine.positive, nargs="+", default=[1000, 3000, 10_000])
    parser.add_argument("--json", type=machine.target, help="file for the figures; - for stdout")
    options = parser.parse_args()
    numbers = sorted(set(options.cameras))
    _, images = zip(*map(calibration.simulate, range(min(DISTINCT, numbers[-1]))))
    images, wrong, sizes = np.stack(images), [], []
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        files = [folder / f"cameras_{number}.npz" for number in numbers]
        for number, file in zip(numbers, files):
            write_cameras(file, images, number)
        run(files[0], folder / "compiled.jsonl")
        left = killed(files[0], folder / "killed.jsonl", numbers[0] // 2)
        run(files[0], folder / "killed.jsonl")
        once = rows_of(folder / "compiled.jsonl")
        if rows_of(folder / "killed.jsonl") != once or len(once) != numbers[0]:
            wrong.append("the lines after a kill are not those of one run")
        for number, file in zip(numbers, files):
            lines = folder / f"{number}.jsonl"
            seconds, peak = run(file, lines)
            status = [json.loads(line)["status"] for line in rows_of(lines).values()]
            good = [s for i, s in enumerate(status) if i % SPOILT > 2]
            sizes.append({
                "cameras": number, "s": round(seconds, 2), "peak_mb": round(peak),
                "lines_mb": round(lines.stat().st_size / 1e6), "input_mb": round(
                    file.stat().st_size / 1e6
                ), "converged": status.count("converged"),
            })  # fmt: skip
            if good.count("converged") != len(good) or len(status) != number:
                wrong.append(f"{number} cameras: not every good one has converged")
            lines.unlink()
    slopes = []
    for a, b in zip(sizes, sizes[1:]):
        more = b["cameras"] - a["cameras"]
        b["ms_per_further_camera"] = round(1e3 * (b["s"] - a["s"]) / more, 3)
        slopes.append(b["ms_per_further_camera"])
        if b["peak_mb"] - a["peak_mb"] > BYTES * more / 1e6 + 30:
            wrong.append(f"memory grows from {a['peak_mb']} to {b['peak_mb']} MB")
    if any(b > GROWTH * a for a, b in zip(slopes, slopes[1:])):
        wrong.append("time is not linear in the number of cameras")
    import jaxbundle

    jaxbundle.enable_x64()
    figures = {"machine": machine.machine(), "killed_after_lines": left, "sizes": sizes}
    if options.json != "-":
        print(machine.in_words(figures["machine"]))
        print(f"killed after {left} of {numbers[0]} lines, resumed")
        for size in sizes:
            print(*(f"{name} {value};" for name, value in size.items()))
    machine.write_json(figures, options.json)
    return machine.verdict(wrong)


if __name__ == "__main__":
    sys.exit(main())
