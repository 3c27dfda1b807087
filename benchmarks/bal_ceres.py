"""Ceres' own example program `bundle_adjuster` on one BAL problem; prints JSON for `bal.py`.

    python benchmarks/bal_ceres.py PROBLEM --binary BINARY [--solver NAME] [--evaluations N]
        [--repeat N] [--threads N]

Tolerances are those of the example: function and gradient 1e-16, parameters 1e-8. Times are from
Ceres' own table, from the first evaluation on, without its preprocessor; an iteration is the
average of all after the first evaluation.
"""

import json
import re
import resource
import subprocess
import sys
from itertools import accumulate

import machine

ROW = re.compile(r"^\s*(\d+)\s+([-\d.e+]+).*?([-\d.e+]+)\s+([-\d.e+]+)\s*$")
SOLVERS = ("dense_schur", "sparse_schur", "iterative_schur")
PRECONDITIONER = "schur_jacobi"
"""Preconditioner of iterative_schur."""


def figures_of(text: str) -> dict:
    """Costs and times of the table that Ceres prints, one row an iteration."""
    rows = [tuple(map(float, m.group(2, 3, 4))) for m in map(ROW.match, text.splitlines()) if m]
    cost, iteration, at = zip(*rows)
    at = [t - at[0] + iteration[0] for t in at]
    costs = list(accumulate(cost, min))
    return {
        "cost": costs[-1], "evaluations": len(costs), "seconds": at[-1],
        "iteration_s": (at[-1] - at[0]) / max(len(costs) - 1, 1), "costs": costs, "at_s": at,
    }  # fmt: skip


def main() -> None:
    parser = machine.solver_parser(__doc__)
    parser.add_argument("--binary", required=True)
    parser.add_argument("--solver", choices=SOLVERS, default=SOLVERS[0])
    parser.add_argument("--threads", type=machine.positive, default=2)
    given = parser.parse_args()
    command = [
        given.binary, f"--input={given.problem}", f"--num_threads={given.threads}",
        f"--num_iterations={given.evaluations - 1}", f"--linear_solver={given.solver}",
        "--ordering=user",
    ]  # fmt: skip
    if given.solver == "iterative_schur":
        command.append(f"--preconditioner={PRECONDITIONER}")
    runs = []
    for _ in range(given.repeat):
        done = subprocess.run(command, capture_output=True, text=True)
        text, ended = done.stdout, re.search(r"Termination:\s+(.*)", done.stdout)
        if done.returncode or not ended:
            sys.exit(f"{given.binary} ended with status {done.returncode}, "
                     f"{'with' if ended else 'without'} the summary of Ceres")  # fmt: skip
        runs.append(figures_of(text) | {"ended": ended[1],
                                        "at_limit": "NO_CONVERGENCE" in ended[1]})  # fmt: skip
    best = min(runs, key=lambda run: run["seconds"])
    name = f"Ceres {re.search(r'Solver Summary .v ([0-9.]+)', text)[1]}, {given.solver}"
    peak = {"peak_mb": machine.peak_mb(resource.RUSAGE_CHILDREN)}
    json.dump(best | {"solver": name} | peak, sys.stdout)


if __name__ == "__main__":
    main()
