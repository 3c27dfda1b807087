"""scipy.optimize.least_squares on one BAL problem; prints one line of JSON for `bal.py`.

    python benchmarks/bal_scipy.py PROBLEM [--evaluations N] [--repeat N]

Trust region reflective with LSMR, columns scaled by the Jacobian. Residuals and the blocks of the
exact sparse Jacobian are compiled by JAX (forward mode), so that the solver is compared and not
numerical differences. Times exclude compilation; an iteration is the whole solution divided by its
evaluations.
"""

import json
import sys
import time
from itertools import accumulate

import jax
import machine
import numpy as np
import scenes
import scipy
import snavely
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix


def functions(cameras, points, image, point, xy):
    """Residuals [2n] and their sparse Jacobian as functions of all unknowns in a row."""
    split = cameras.size
    of_all = lambda f: jax.jit(jax.vmap(f))
    rays = lambda x: (
        x[:split].reshape(-1, 9)[image], x[split:].reshape(-1, 3)[point], xy
    )  # fmt: skip
    value = of_all(snavely.residual)
    blocks = of_all(jax.jacfwd(snavely.residual, (0, 1)))
    columns = np.concatenate([
        image[:, None] * 9 + np.arange(9), split + point[:, None] * 3 + np.arange(3)
    ], 1)  # fmt: skip
    columns = np.repeat(columns, 2, 0).ravel()
    row_begins = 12 * np.arange(2 * len(xy) + 1)

    def jacobian(x):
        whole = np.concatenate(blocks(*rays(x)), 2).ravel()
        return csr_matrix((whole, columns, row_begins), (2 * len(xy), len(x)))

    return lambda x: np.asarray(value(*rays(x))).ravel(), jacobian


def main() -> None:
    given = machine.solver_parser(__doc__, evaluations=20, repeat=1).parse_args()
    jax.config.update("jax_enable_x64", True)
    cameras, points, *rays = scenes.read_bal(given.problem)
    start = np.concatenate([cameras.ravel(), points.ravel()])
    function, jacobian = functions(cameras, points, *rays)
    function(start), jacobian(start)  # compiled
    runs = []
    for _ in range(given.repeat):
        costs, at, begin = [], [], time.perf_counter()

        def told(x, costs=costs, at=at, begin=begin):
            v = function(x)
            costs.append(0.5 * float(v @ v))
            at.append(time.perf_counter() - begin)
            return v

        found = least_squares(
            told, start, jacobian, x_scale="jac", method="trf", max_nfev=given.evaluations,
            ftol=1e-12, xtol=1e-12, gtol=1e-12,
        )  # fmt: skip
        seconds = time.perf_counter() - begin
        runs.append({
            "cost": float(found.cost), "evaluations": int(found.nfev), "seconds": seconds,
            "iteration_s": seconds / found.nfev, "costs": list(accumulate(costs, min)), "at_s": at,
            "ended": found.message, "at_limit": found.status == 0,
        })  # fmt: skip
    best = min(runs, key=lambda run: run["seconds"])
    name = {"solver": f"scipy {scipy.__version__}, trf", "peak_mb": machine.peak_mb()}
    json.dump(best | name, sys.stdout)


if __name__ == "__main__":
    main()
