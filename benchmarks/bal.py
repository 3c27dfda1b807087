"""BAL problems and synthetic ones of their kind: our solver and Ceres, on one machine, in one run.

    python benchmarks/bal.py PROBLEM ... [--ceres BINARY] [--solver NAME] [--scipy] [--repeat N]
        [--reduction dense|banded|iterative] [--json FILE] [--baseline]
    python benchmarks/bal.py --street IMAGES POINTS | --arc IMAGES POINTS ...

PROBLEM is a file in the BAL format (.txt, .gz, .bz2). BINARY is Ceres' own example program
`bundle_adjuster` (built from its sources; environment variable BUNDLE_ADJUSTER); without it our
solver runs alone. Both use two cores: Ceres two threads, we two CPU devices of JAX. --scipy adds
scipy's least_squares (trf, differences of grouped columns) for a few evaluations.

Told are the final cost ½Σv², the time of an iteration (the whole solution divided by its
iterations, compilation apart), the time from the start values to 1.0001 × the lower final cost, and
their ratios. The exit status is 1 where our final cost is higher than Ceres' by 1e-6, and with
--baseline where it is higher than that in baseline.json by 1e-6 or an iteration takes four times as
long as there (--write-baseline makes a new one).
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
from jax.flatten_util import ravel_pytree  # noqa: E402
from scipy.optimize import least_squares  # noqa: E402
from scipy.sparse import coo_matrix  # noqa: E402

import jaxbundle  # noqa: E402
from jaxbundle.adjustment.jacobian import zero_tangent  # noqa: E402
from jaxbundle.adjustment.residuals import residuals  # noqa: E402
from jaxbundle.adjustment.sharding import distribute, find_minimum_of_shards  # noqa: E402
from jaxbundle.adjustment.solve import make_solver  # noqa: E402
from jaxbundle.adjustment.solver import minimise  # noqa: E402
from jaxbundle.network.arrays import retract  # noqa: E402
from jaxbundle.network.reduction import REDUCTIONS  # noqa: E402

CORES = 2
SCIPY_EVALUATIONS = 5


BASELINE = Path(__file__).parent / "baseline.json"
SLOWER = 4.0
"""An iteration may take so many times as long as in the baseline, on whatever machine."""


def ours(path: Path, evaluations: int, repeat: int, reduction: str | None) -> dict:
    """Our solver on all devices."""
    begin = time.perf_counter()
    network = jaxbundle.check_network(jaxbundle.read_network(path))
    problem = jaxbundle.make_problem(network, reduction)
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
        "reduction": problem.structure.reduction,
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
        rows = [[float(m[i]) for i in (2, 3, 4)] for m in rows if m]
        cost, iteration, at = np.array(rows).T
        # From the first evaluation on, without the preprocessor before it.
        at = at - at[0] + iteration[0]
        runs.append((at[-1] - at[0], cost, at))
    seconds, cost, at = min(runs, key=lambda run: run[0])
    cost = np.minimum.accumulate(cost)
    return {
        "cost": float(cost[-1]), "costs": cost.tolist(), "iterations": len(cost) - 1,
        "seconds": seconds, "iteration_s": (seconds - at[0]) / max(len(cost) - 1, 1),
        "at_s": at.tolist(),
    }  # fmt: skip


def of_scipy(path: Path, evaluations: int) -> dict:
    """scipy.optimize.least_squares, the Jacobian by differences of columns that touch no row
    together."""
    network = jaxbundle.check_network(jaxbundle.read_network(path))
    problem = jaxbundle.make_problem(network, "dense")
    s, data = problem.structure, problem.data
    zero, unravel = ravel_pytree(zero_tangent(s))
    image_rows = s.images * s.image_width
    row = np.arange(2 * s.rays).reshape(-1, 2, 1)
    image, point = np.asarray(s.image), np.asarray(s.point)
    columns = np.concatenate([
        image[:, None] * s.image_width + np.arange(s.image_width),
        image_rows + point[:, None] * 3 + np.arange(3),
    ], 1)[:, None]  # fmt: skip
    row, columns = (x.ravel() for x in np.broadcast_arrays(row, columns))
    touched = coo_matrix((np.ones(len(row), int), (row, columns)), (2 * s.rays, zero.size)).tocsr()
    rows = eqx.filter_jit(lambda x: residuals(s, retract(s, data.start, unravel(x)), data).image)
    function = lambda x: np.asarray(rows(x)).ravel()  # noqa: E731
    function(np.asarray(zero))  # compiled

    begin = time.perf_counter()
    found = least_squares(
        function, np.asarray(zero), jac_sparsity=touched, x_scale="jac", method="trf",
        max_nfev=evaluations, ftol=1e-12, xtol=1e-12, gtol=1e-12,
    )  # fmt: skip
    seconds = time.perf_counter() - begin
    return {"cost": float(found.cost), "iterations": int(found.nfev), "seconds": seconds,
            "iteration_s": seconds / max(found.nfev, 1)}  # fmt: skip


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
    found = {"problem": name}
    found["ours"] = ours(path, arguments.evaluations, arguments.repeat, arguments.reduction)
    lowest = found["ours"]["cost"]
    if arguments.ceres:
        found["ceres"] = ceres(
            path, arguments.ceres, arguments.solver, arguments.evaluations, arguments.repeat
        )
        lowest = min(lowest, found["ceres"]["cost"])
    if arguments.scipy:
        found["scipy"] = of_scipy(path, SCIPY_EVALUATIONS)
    for program in ("ours", "ceres"):
        if program in found:
            found[program]["to_1.0001_s"] = time_to(found[program], 1.0001 * lowest)
    return found


def told(found: dict) -> str:
    """The figures for people."""
    o = found["ours"]
    lines = [
        found["problem"],
        f"  ours   {o['reduction']}: cost {o['cost']:.4f}, {o['evaluations']} evaluations, "
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
    if "scipy" in found:
        s = found["scipy"]
        lines.append(
            f"  scipy  cost {s['cost']:.4f} after {s['iterations']} evaluations, "
            f"{1e3 * s['iteration_s']:.0f} ms each"
        )
    return "\n".join(lines)


def against_baseline(all_found: list[dict]) -> list[str]:
    """What is worse than in the committed baseline: tight on cost, loose on time."""
    baseline, worse = json.loads(BASELINE.read_text()), []
    for found in all_found:
        name, now = found["problem"], found["ours"]
        if name not in baseline:
            continue
        then = baseline[name]
        if now["cost"] > (1 + 1e-6) * then["cost"]:
            worse.append(f"{name}: cost {now['cost']:.6f}, {then['cost']:.6f} in the baseline")
        if now["iteration_s"] > SLOWER * then["iteration_s"]:
            worse.append(
                f"{name}: {1e3 * now['iteration_s']:.1f} ms an iteration, "
                f"{1e3 * then['iteration_s']:.1f} in the baseline"
            )
    return worse


def write_baseline(all_found: list[dict]) -> None:
    """Keep these figures in baseline.json, with those of other problems."""
    baseline = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    for found in all_found:
        figures = found["ours"]
        baseline[found["problem"]] = {
            name: figures[name] for name in ("reduction", "cost", "evaluations", "iteration_s")
        }
    BASELINE.write_text(json.dumps(baseline, indent=1, sort_keys=True) + "\n")


def main() -> int:
    """Run, print, check."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("problems", nargs="*", type=Path)
    parser.add_argument("--street", nargs=2, type=int, metavar=("IMAGES", "POINTS"))
    parser.add_argument("--arc", nargs=2, type=int, metavar=("IMAGES", "POINTS"))
    parser.add_argument("--ceres", default=os.environ.get("BUNDLE_ADJUSTER"))
    parser.add_argument("--solver", default="dense_schur",
                        help="of Ceres: dense_schur, sparse_schur, iterative_schur")  # fmt: skip
    parser.add_argument("--scipy", action="store_true")
    parser.add_argument("--reduction", choices=REDUCTIONS, help="chosen if not given")
    parser.add_argument("--baseline", action="store_true", help="compare with baseline.json")
    parser.add_argument("--write-baseline", action="store_true")
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
    worse = [f"{name}: our final cost is higher" for name in worse]
    if arguments.write_baseline:
        write_baseline(all_found)
    elif arguments.baseline:
        worse += against_baseline(all_found)
    for line in worse:
        print(f"WRONG: {line}", file=sys.stderr)
    return 1 if worse else 0


if __name__ == "__main__":
    sys.exit(main())
