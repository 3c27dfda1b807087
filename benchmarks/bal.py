"""BAL problems and synthetic ones of their kind: our solver and Ceres, on one machine, in one run.

    python benchmarks/bal.py PROBLEM ... [--ceres BINARY] [--solver NAME] [--repeat N] [--json FILE]
    python benchmarks/bal.py --street IMAGES POINTS | --arc IMAGES POINTS ...

PROBLEM is a file in the BAL format (.txt, .gz, .bz2). BINARY is Ceres' own example program
`bundle_adjuster` (built from its sources; environment variable BUNDLE_ADJUSTER); without it our
solver runs alone. Both use two cores: Ceres two threads, we two CPU devices of JAX.

Told are the final cost ½Σv², the time of an iteration (the whole solution divided by its
iterations, compilation apart), the time from the start values to 1.0001 × the lower final cost, and
their ratios. The exit status is 1 where our final cost is higher than Ceres' by 1e-6.
"""

import argparse
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import equinox as eqx  # noqa: E402
import jax  # noqa: E402
import numpy as np  # noqa: E402
import scenes  # noqa: E402

import jaxbundle  # noqa: E402
from jaxbundle.adjustment.sharding import distribute, find_minimum_of_shards  # noqa: E402
from jaxbundle.adjustment.solve import make_solver  # noqa: E402
from jaxbundle.adjustment.solver import minimise  # noqa: E402

CORES = 2


def ours(path: Path, evaluations: int, repeat: int) -> dict:
    """Our solver on all devices."""
    begin = time.perf_counter()
    network = jaxbundle.check_network(jaxbundle.read_network(path))
    problem = jaxbundle.make_problem(network)
    solver = make_solver(problem, max_steps=evaluations, atol=1e-5)
    if len(jax.devices()) > 1:
        shards = distribute(problem)
        run = lambda: find_minimum_of_shards(solver, shards, problem.data.start)  # noqa: E731
    else:
        compiled = eqx.filter_jit(minimise)
        run = lambda: compiled(solver, problem.data, problem.data.start)  # noqa: E731
    prepare = time.perf_counter() - begin

    def timed():
        begin = time.perf_counter()
        minimum = jax.block_until_ready(run())
        return minimum, time.perf_counter() - begin

    minimum, first = timed()
    seconds = min(timed()[1] for _ in range(repeat))
    number = int(minimum.iterations)
    cost = np.asarray(minimum.history.cost)[:number]
    return {
        "cost": float(np.nanmin(cost)),
        "costs": cost.tolist(),
        "evaluations": number,
        "seconds": seconds,
        "iteration_s": seconds / number,
        "compile_s": first - seconds,
        "prepare_s": prepare,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
    }


ROW = re.compile(r"^\s*(\d+)\s+([-\d.e+]+).*?([-\d.e+]+)\s+([-\d.e+]+)\s*$")


def ceres(path: Path, binary: str, solver: str, iterations: int, repeat: int) -> dict:
    """Ceres' bundle_adjuster: the best of some runs."""
    command = [
        binary, f"--input={path}", f"--num_threads={CORES}", f"--num_iterations={iterations}",
        f"--linear_solver={solver}", "--ordering=user",
    ]  # fmt: skip
    if solver == "iterative_schur":
        command.append("--preconditioner=schur_jacobi")
    runs = []
    for _ in range(repeat):
        text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        rows = [ROW.match(line) for line in text.splitlines()]
        rows = [(float(m[2]), float(m[4])) for m in rows if m]
        cost, at = np.array(rows).T
        runs.append((at[-1] - at[0], cost, at - at[0]))
    seconds, cost, at = min(runs, key=lambda run: run[0])
    cost = np.minimum.accumulate(cost)
    return {
        "cost": float(cost[-1]), "costs": cost.tolist(), "iterations": len(cost) - 1,
        "seconds": seconds, "iteration_s": seconds / max(len(cost) - 1, 1), "at_s": at.tolist(),
    }  # fmt: skip


def time_to(figures: dict, cost: float) -> float:
    """Seconds from the start values until the cost was reached; infinite if it was not."""
    reached = np.flatnonzero(np.asarray(figures["costs"]) <= cost)
    if not len(reached):
        return float("inf")
    if "at_s" in figures:
        return figures["at_s"][reached[0]]
    return (reached[0] + 1) * figures["iteration_s"]


def compare(name: str, path: Path, arguments) -> dict:
    """Both solvers on one problem."""
    found = {"problem": name, "ours": ours(path, arguments.evaluations, arguments.repeat)}
    lowest = found["ours"]["cost"]
    if arguments.ceres:
        found["ceres"] = ceres(
            path, arguments.ceres, arguments.solver, arguments.evaluations, arguments.repeat
        )
        lowest = min(lowest, found["ceres"]["cost"])
    for program in ("ours", "ceres"):
        if program in found:
            found[program]["to_1.0001_s"] = time_to(found[program], 1.0001 * lowest)
    return found


def told(found: dict) -> str:
    """The figures for people."""
    o = found["ours"]
    lines = [
        found["problem"],
        f"  ours   cost {o['cost']:.4f}, {o['evaluations']} evaluations, "
        f"{1e3 * o['iteration_s']:.1f} ms an iteration, {o['to_1.0001_s']:.3f} s to 1.0001 × "
        f"the cost; preparation {o['prepare_s']:.1f} s, compilation {o['compile_s']:.1f} s, "
        f"peak {o['peak_mb']:.0f} MB",
    ]
    if "ceres" in found:
        c = found["ceres"]
        lines += [
            f"  Ceres  cost {c['cost']:.4f}, {c['iterations']} iterations, "
            f"{1e3 * c['iteration_s']:.1f} ms an iteration, {c['to_1.0001_s']:.3f} s to 1.0001 × "
            "the cost",
            f"  ratio  {o['iteration_s'] / c['iteration_s']:.2f} an iteration, "
            f"{o['to_1.0001_s'] / c['to_1.0001_s']:.2f} to 1.0001 × the cost",
        ]
    return "\n".join(lines)


def main() -> int:
    """Run, print, check."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("problems", nargs="*", type=Path)
    parser.add_argument("--street", nargs=2, type=int, metavar=("IMAGES", "POINTS"))
    parser.add_argument("--arc", nargs=2, type=int, metavar=("IMAGES", "POINTS"))
    parser.add_argument("--ceres", default=os.environ.get("BUNDLE_ADJUSTER"))
    parser.add_argument("--solver", default="dense_schur",
                        help="of Ceres: dense_schur, sparse_schur, iterative_schur")  # fmt: skip
    parser.add_argument("--evaluations", type=int, default=60)
    parser.add_argument("--repeat", type=int, default=3, help="timed runs; the best counts")
    parser.add_argument("--devices", type=int, default=CORES)
    parser.add_argument("--json", metavar="FILE")
    arguments = parser.parse_args()
    jax.config.update("jax_num_cpu_devices", arguments.devices)
    jaxbundle.enable_x64()
    all_found = []
    with tempfile.TemporaryDirectory() as folder:
        todo = [(path.name, path) for path in arguments.problems]
        for kind in ("street", "arc"):
            if size := getattr(arguments, kind):
                path = Path(folder) / f"{kind}-{size[0]}.txt"
                scenes.write_bal(path, *getattr(scenes, kind)(*size))
                todo.append((path.stem, path))
        for name, path in todo:
            plain = scenes.unpacked(path, Path(folder))
            all_found.append(compare(name, plain, arguments))
            print(told(all_found[-1]), flush=True)
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(all_found, indent=1))
    worse = [
        f["problem"] for f in all_found
        if "ceres" in f and f["ours"]["cost"] > (1 + 1e-6) * f["ceres"]["cost"]
    ]  # fmt: skip
    for name in worse:
        print(f"WRONG: {name}: our final cost is higher", file=sys.stderr)
    return 1 if worse else 0


if __name__ == "__main__":
    sys.exit(main())
