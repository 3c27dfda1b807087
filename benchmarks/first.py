"""The first adjustment of a process: with and without compiled programs of an earlier one.

    python benchmarks/first.py [--input PROJECT] [--repeat N] [--json FILE]

Runs `jaxbundle adjust PROJECT --quiet` in pairs of separate processes: the first starts with an
empty temporary folder of compiled programs, the second uses what the first left there. The output
gives wall-clock and processor seconds from start to end of a process, the best of the pairs, and
those of a process that only imports JAX. Limits for a small network on two cores: 10 s and 3 s; a
limit that is not met is reported and does not change the exit status.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import machine

EXAMPLE = Path(__file__).parents[1] / "examples" / "convergent4" / "project.toml"
DEMANDED = {"empty folder of programs": 10.0, "full folder of programs": 3.0}


def seconds_of(command: list[str], folder: str) -> tuple[float, float]:
    """Wall-clock and processor seconds of a process."""
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": folder}
    begin = time.perf_counter()
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    clock = time.perf_counter() - begin
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} ended with status {process.returncode}")
    return clock, usage.ru_utime + usage.ru_stime


def main() -> None:
    parser = machine.parser_of(__doc__)
    parser.add_argument("--input", default=str(EXAMPLE), help="anything `adjust` reads")
    parser.add_argument("--repeat", type=machine.positive, default=3, help="pairs of processes")
    parser.add_argument("--json", type=machine.target, metavar="FILE",
                        help="write the figures; - for standard output")  # fmt: skip
    given = parser.parse_args()
    adjust = [sys.executable, "-m", "jaxbundle", "adjust", given.input, "--quiet"]
    runs = {"import of JAX": [], **{name: [] for name in DEMANDED}}
    for _ in range(given.repeat):
        with tempfile.TemporaryDirectory() as folder:
            runs["import of JAX"].append(seconds_of([sys.executable, "-c", "import jax"], folder))
            for name in DEMANDED:
                runs[name].append(seconds_of(adjust, folder))
    best = {
        name: dict(zip(("clock_s", "processor_s"), map(min, zip(*pairs))))
        for name, pairs in runs.items()
    }
    import jaxbundle

    jaxbundle.enable_x64()
    found = {"input": given.input, "machine": machine.machine()} | best
    if given.json != "-":
        print(machine.in_words(found["machine"]))
        for name, seconds in best.items():
            demand = ""
            if name in DEMANDED:
                met = "met" if seconds["clock_s"] <= DEMANDED[name] else "NOT MET"
                demand = f"   demanded {DEMANDED[name]:.0f}: {met}"
            print(f"{name:26}{seconds['clock_s']:6.2f} s, processor "
                  f"{seconds['processor_s']:6.2f} s{demand}")  # fmt: skip
    machine.write_json(found, given.json)


if __name__ == "__main__":
    main()
