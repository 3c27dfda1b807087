"""Our solver on one BAL problem, in its own process; prints one line of JSON for `bal.py`.

    python benchmarks/bal_ours.py PROBLEM [--evaluations N] [--repeat N] [--devices N]
        [--reduction NAME] [--cache FOLDER]

The first call compiles; the difference from the best later one is reported as compilation: cold
with an empty folder of compiled programs or none, cached with a full one. Memory is read after the
first call, and once before anything but the import of JAX.
"""

import json
import sys
import time

import jax
import machine

memory = {"import_mb": machine.peak_mb()}

import numpy as np  # noqa: E402

import jaxbundle  # noqa: E402
from jaxbundle.choices import REDUCTIONS  # noqa: E402
from jaxbundle.leastsquares.iterations.solver import minimise_compiled  # noqa: E402
from jaxbundle.leastsquares.iterations.stopping import LIMIT, RELATIVE_COST, SETTLED, TERMINATIONS  # noqa: E402
from jaxbundle.leastsquares.problem import make_solver, pad_data  # noqa: E402
from jaxbundle.leastsquares.sharding import distribute, find_minimum_of_shards  # noqa: E402

ATOL = 1e-5


def prepare(path: str, evaluations: int, reduction: str | None):
    """The problem, and the function that solves it."""
    network = jaxbundle.check_network(jaxbundle.read_network(path))
    problem = jaxbundle.make_problem(network, reduction=reduction)
    solver = make_solver(problem, max_steps=evaluations, atol=ATOL)
    if len(jax.devices()) > 1:
        shards = distribute(problem)
        return problem, lambda: find_minimum_of_shards(shards, solver)
    data = pad_data(problem, problem.data)
    return problem, lambda: minimise_compiled(solver, data, data.start)


def main() -> None:
    parser = machine.solver_parser(__doc__)
    parser.add_argument("--devices", type=machine.positive, default=2, help="of the processor")
    parser.add_argument("--reduction", choices=REDUCTIONS)
    parser.add_argument("--cache", help="folder of compiled programs")
    given = parser.parse_args()
    jax.config.update("jax_num_cpu_devices", given.devices)
    jaxbundle.enable_x64()
    if given.cache:
        jaxbundle.keep_programs(given.cache)

    begin = time.perf_counter()
    problem, run = prepare(given.problem, given.evaluations, given.reduction)
    prepare_s = time.perf_counter() - begin

    def timed():
        begin = time.perf_counter()
        minimum = jax.block_until_ready(run())
        return minimum, time.perf_counter() - begin

    minimum, first = timed()
    memory["peak_mb"], memory["device_peak_mb"] = machine.peak_mb(), machine.device_peak_mb()
    seconds = min(timed()[1] for _ in range(given.repeat))
    number, termination = int(minimum.iterations), int(minimum.termination)
    costs = np.fmin.accumulate(np.asarray(minimum.history.cost)[:number])
    json.dump({
        "solver": f"jaxbundle, {problem.plan.reduction}",
        "reduction": problem.plan.reduction,
        "cost": float(costs[-1]),
        "evaluations": number,
        "ended": TERMINATIONS[termination],
        "at_limit": termination == LIMIT,
        "settled": termination in (SETTLED, RELATIVE_COST),
        "seconds": seconds,
        "iteration_s": seconds / number,
        "compile_s": first - seconds,
        "prepare_s": prepare_s,
        "costs": costs.tolist(),
        "at_s": (seconds / number * np.arange(1, number + 1)).tolist(),
        "machine": machine.machine(),
    } | memory, sys.stdout)  # fmt: skip


if __name__ == "__main__":
    main()
