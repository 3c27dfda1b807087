"""The first adjustment of a process: compiling everything, and with the programs of one before.

    python benchmarks/first.py [--input PROJECT] [--repeat N] [--json FILE]

`jaxbundle adjust PROJECT` in processes of their own. The first finds an empty (temporary) folder
of programs; the second, and a third on a pseudo-terminal, find what the first left there. The first
two are run with `--quiet`, which prints the report alone; the third shows its progress too, as for
a person.
Reported are the seconds from the start of a process to its end, on the clock and of the processor,
the best of the rounds, beside those of a process that only imports JAX. The limits for a small
network are multiples of its processor time, which depend little on the machine: what was measured
(docs/performance.md) and a fifth; missing one is reported and does not change the exit status.
"""

import os
import pty
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import machine

EXAMPLE = Path(__file__).parents[1] / "examples" / "convergent4" / "project.toml"
EMPTY, FULL, TERMINAL = "empty folder of programs", "full folder of programs", "full, on a terminal"
IMPORT = "import of JAX"
LIMITS = {EMPTY: 11.5, FULL: 6.4}


def seconds_of(command: list[str], folder: str, terminal: bool = False) -> tuple[float, float]:
    """Seconds of a process, on the clock and of the processor."""
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": folder}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # an installed package has its bytecode
    controller, output = pty.openpty() if terminal else (None, subprocess.DEVNULL)
    begin = time.perf_counter()
    process = subprocess.Popen(command, env=environment, stdout=output,
                               stderr=output if terminal else None)  # fmt: skip
    if controller is not None:
        threading.Thread(target=read_all, args=(controller,), daemon=True).start()
    _, status, usage = os.wait4(process.pid, 0)
    clock = time.perf_counter() - begin
    if terminal:
        os.close(output)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} ended with status {process.returncode}")
    return clock, usage.ru_utime + usage.ru_stime


def read_all(controller: int) -> None:
    """Read what is printed on a pseudo-terminal, until it is closed."""
    try:
        while os.read(controller, 1 << 16):
            pass
    except OSError:
        pass  # how Linux reports the end
    os.close(controller)


def main() -> None:
    parser = machine.parser_of(__doc__)
    parser.add_argument("--input", default=str(EXAMPLE), help="anything `adjust` reads")
    parser.add_argument("--repeat", type=machine.positive, default=3, help="rounds of processes")
    parser.add_argument("--json", type=machine.target, metavar="FILE",
                        help="write the figures; - for standard output")  # fmt: skip
    given = parser.parse_args()
    adjust = [sys.executable, "-m", "jaxbundle", "adjust", given.input]
    runs = {IMPORT: [], EMPTY: [], FULL: [], TERMINAL: []}
    for _ in range(given.repeat):
        with tempfile.TemporaryDirectory() as folder:
            runs[IMPORT].append(seconds_of([sys.executable, "-c", "import jax"], folder))
            for name in LIMITS:
                runs[name].append(seconds_of([*adjust, "--quiet"], folder))
            for _ in range(2):  # the report has programs of its own
                last = seconds_of(adjust, folder, terminal=True)
            runs[TERMINAL].append(last)
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
            limit, times = "", seconds["processor_s"] / best[IMPORT]["processor_s"]
            if name in LIMITS:
                limit = f", limit {LIMITS[name]:g}: {'met' if times <= LIMITS[name] else 'NOT MET'}"
            print(f"{name:26}{seconds['clock_s']:6.2f} s, processor "
                  f"{seconds['processor_s']:6.2f} s, {times:.2f} of importing JAX{limit}")
    machine.write_json(found, given.json)


if __name__ == "__main__":
    main()
