"""jaxls (github.com/brentyi/jaxls) on one BAL problem; prints one line of JSON for `bal.py`.

    PYTHON benchmarks/bal_jaxls.py PROBLEM [--evaluations N] [--repeat N]

Points are eliminated (by jaxls itself), the rest is solved by dense Cholesky; the initial damping
is 1e2 as in the BAL benchmark of jaxls; the given number of iterations is run, without a stopping
criterion. Times exclude compilation.
"""

import json
import sys
import time
from itertools import accumulate

import jax
import jax.numpy as jnp
import machine
import numpy as np
import scenes
import snavely

DAMPING = 1e2


def cost(values, camera, point, xy):
    """Residuals of an image point."""
    return snavely.residual(values[camera], values[point], xy)


def problem_of(jaxls, cameras, points, image, point, xy):
    """The problem, analysed, and its start values."""

    class CameraVar(jaxls.Var[jax.Array], default_factory=lambda: jnp.zeros(9)):
        """Nine parameters of an image."""

    class PointVar(jaxls.Var[jax.Array], default_factory=lambda: jnp.zeros(3)):
        """An object point."""

    every_camera, every_point = CameraVar(jnp.arange(len(cameras))), PointVar(
        jnp.arange(len(points))
    )
    rays = CameraVar(jnp.asarray(image)), PointVar(jnp.asarray(point)), jnp.asarray(xy)
    problem = jaxls.LeastSquaresProblem([jaxls.Cost(cost, rays)], [every_camera, every_point])
    start = jaxls.VarValues.make([
        every_camera.with_value(jnp.asarray(cameras)), every_point.with_value(jnp.asarray(points))
    ])  # fmt: skip
    return problem.analyze(), start


def main() -> None:
    given = machine.solver_parser(__doc__, evaluations=30).parse_args()
    try:
        import jaxls

        jaxls.LeastSquaresProblem  # noqa: B018
    except (ImportError, AttributeError):
        sys.exit("jaxls of github.com/brentyi/jaxls is not installed in this environment")
    jax.config.update("jax_enable_x64", True)
    problem, start = problem_of(jaxls, *scenes.read_bal(given.problem))

    def timed():
        begin = time.perf_counter()
        found = jax.block_until_ready(problem.solve(
            start, linear_solver="dense_cholesky", verbose=False, return_summary=True,
            trust_region=jaxls.TrustRegionConfig(lambda_initial=DAMPING),
            termination=jaxls.TerminationConfig(
                max_iterations=given.evaluations, early_termination=False
            ),
        ))  # fmt: skip
        return found[1], time.perf_counter() - begin

    summary, first = timed()
    peak_mb = machine.peak_mb()
    seconds = min(timed()[1] for _ in range(given.repeat))
    number = int(summary.iterations)
    # Its history contains Σv², also of rejected steps.
    costs = list(accumulate((0.5 * np.asarray(summary.cost_history)[:number]).tolist(), min))
    json.dump({
        "solver": f"jaxls {jaxls.__version__}, JAX {jax.__version__}",
        "cost": costs[-1], "evaluations": number, "ended": "iteration limit", "at_limit": True,
        "seconds": seconds, "iteration_s": seconds / number, "compile_s": first - seconds,
        "costs": costs, "at_s": (seconds / number * np.arange(1, number + 1)).tolist(),
        "peak_mb": peak_mb,
    }, sys.stdout)  # fmt: skip


if __name__ == "__main__":
    main()
