"""What the first results of a process cost: programs, tracing, lowering, compiling, the rest.

    python benchmarks/compiling.py [--jobs NAME ...] [--kept] [--json FILE]

    adjust       `jaxbundle.adjust` of four photographs, and the text of the report
    solve        the differentiable solution
    gradient     of the principal distance by all image coordinates
    second       a directional derivative of that gradient
    check        `check_gradients` of the solution, two directions

Every job runs in a process of its own with an empty folder of programs; with `--kept` in a second
one, which finds those of the first. `--quick`: with `enable_x64(compile_quickly=True)`. Seconds are
of the processor, of tracing, lowering and compiling those that JAX reports (on the clock);
"programs" counts what was compiled or loaded.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # an installed package has its bytecode

import machine

EXAMPLE = Path(__file__).parents[1] / "examples" / "convergent4" / "project.toml"
JOBS = ("adjust", "solve", "gradient", "second", "check")
PARTS = {
    "jaxpr_trace_duration": "tracing",
    "jaxpr_to_mlir_module_duration": "lowering",
    "backend_compile_duration": "compiling",
}


def run(job: str, folder: str, quickly: bool) -> dict[str, float]:
    """A job in this process."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    import jaxbundle

    jaxbundle.enable_x64(compile_quickly=quickly)
    jaxbundle.keep_programs(folder)
    seconds, programs = Counter(), 0

    def count(event: str, duration: float, **_: str) -> None:
        nonlocal programs
        part = event.rpartition("/")[2]
        if part in PARTS:
            seconds[PARTS[part]] += duration
            programs += part == "backend_compile_duration"

    jax.monitoring.register_event_duration_secs_listener(count)
    begin = time.process_time()
    network = jaxbundle.read_network(EXAMPLE)
    if job == "adjust":
        str(jaxbundle.adjust(network))
    else:
        problem = jaxbundle.make_problem(jaxbundle.check_network(network))
        data, xy = problem.data, problem.data.measured["image"]

        def distance(xy: jax.Array) -> jax.Array:
            moved = eqx.tree_at(lambda d: d.measured["image"], data, xy)
            return jaxbundle.solve(problem, moved)["camera"][0, 0]

        one = jnp.zeros_like(xy).at[0, 0].set(1.0)
        jobs = {
            "solve": jax.jit(distance),
            "gradient": jax.jit(jax.grad(distance)),
            "second": jax.jit(lambda xy: jax.jvp(jax.grad(distance), (xy,), (one,))[1]),
            "check": lambda _: jaxbundle.check_gradients(problem, directions=2).forward,
        }
        jax.block_until_ready(jobs[job](xy))
    return {"processor": time.process_time() - begin, "programs": programs, **seconds}


def main() -> None:
    parser = machine.parser_of(__doc__)
    parser.add_argument("--jobs", nargs="+", choices=JOBS, default=JOBS, metavar="NAME")
    parser.add_argument("--kept", action="store_true", help="also with the programs of the first")
    parser.add_argument("--quick", action="store_true", help="compile with little optimisation")
    parser.add_argument("--json", type=machine.target, metavar="FILE",
                        help="write the figures; - for standard output")  # fmt: skip
    parser.add_argument("--run", nargs=2, metavar=("NAME", "FOLDER"), help="in this process")
    given = parser.parse_args()
    if given.run:
        print(json.dumps(run(*given.run, given.quick)))
        return
    print(machine.in_words(machine.machine()))
    names = ("processor", *PARTS.values())
    print(f"{'':24}{'programs':>10}" + "".join(f"{name:>12}" for name in names))
    found = {}
    for job in given.jobs:
        with tempfile.TemporaryDirectory() as folder:
            for state in ("first", "second")[: 1 + given.kept]:
                command = [sys.executable, __file__, "--run", job, folder]
                command += ["--quick"] * given.quick
                output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
                row = found[f"{job}, {state} process"] = json.loads(output.splitlines()[-1])
                seconds = "".join(f"{row.get(name, 0.0):10.2f} s" for name in names)
                print(f"{job + ', ' + state:24}{row['programs']:10d}{seconds}", flush=True)
    machine.write_json(found, given.json)


if __name__ == "__main__":
    main()
