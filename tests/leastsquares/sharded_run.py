"""Solves problems on several devices and processes, and prints the results as JSON.

    python sharded_run.py DEVICES PROBLEMS [PROCESSES ID PORT [SIGNAL]]

DEVICES are those of this process; with PROCESSES, it is number ID of so many. SIGNAL: this process
gets it when the others rely on it.
"""

import json
import os
import sys
import time

if __name__ == "__main__":
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{flags} --xla_force_host_platform_device_count={sys.argv[1]}"

import jax
import numpy as np
from test_reductions import traverse

import jaxbundle
from jaxbundle.leastsquares import solution
from jaxbundle.leastsquares.problem import hold


def network():
    """A camera of three images, another of three; control points, two distances that share a
    point; what was held after the plan was made."""
    stations = jaxbundle.ring_of_stations(6, 5.0, 2.0, roll_every=2)
    axis = np.linspace(-1, 1, 3)
    targets = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    cameras = [
        jaxbundle.Camera(name, "brown", {"c": 20.0, "K1": 1e-4}, ("c", "K1"), {"c": 0.05})
        for name in "ab"
    ]
    given = jaxbundle.simulate(
        stations, targets, cameras, camera_of_station=[0, 1] * 3, noise=0.002, seed=2,
        disturb=0.005, distances=((1, 5), (5, 7)), distance_sigma=0.001, datum="control",
        control=(0, 8, 20, 26), control_sigma=0.001,
    )  # fmt: skip
    problem = jaxbundle.make_problem(jaxbundle.check_network(given))
    return hold(hold(problem, "image", 2, [2]), "point", 20)


PROBLEMS = {
    "network": network,
    "traverse, banded": lambda: traverse("banded"),
    "traverse, iterative": lambda: traverse("iterative"),
}


def solve(problem, start=None):
    """The minimum as lists; `start`: the values of another one."""
    if start is not None:
        leaves, structure = jax.tree.flatten(problem.data.start)
        start = [np.array(x, a.dtype) for x, a in zip(start["values"], leaves, strict=True)]
        start = jax.tree.unflatten(structure, start)
    minimum = solution.find_minimum(problem, start, atol=1e-7)
    return {
        "termination": int(minimum.termination),
        "cost": np.asarray(minimum.history.cost)[: int(minimum.iterations)].tolist(),
        "values": [np.asarray(x).tolist() for x in jax.tree.leaves(minimum.values)],
    }


def main(names, processes=1, rank=0, port=0, signal=0):
    jax.config.update("jax_enable_x64", True)
    if processes > 1:
        jaxbundle.join_processes(f"127.0.0.1:{port}", processes, rank, lost_after_seconds=10)
    if signal:
        solution.distribute = lambda _: (os.kill(os.getpid(), signal), time.sleep(10))
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, *_, **__: compiled.append(event) if "backend_compile" in event else None
    )
    problems = {name: PROBLEMS[name]() for name in names}
    worth = lambda: [solution._worth_sharing(p, p.data.start) for p in problems.values()]
    before, solution.MIN_SHARED_OBSERVATIONS = worth(), 0
    shared = {"small": before, "large": worth()}
    found = {name: solve(problem) for name, problem in problems.items()}
    first, again = len(compiled), None
    if processes == 1:
        again = solve(problems[names[0]], found[names[0]])
    compiled = [first, len(compiled) - first]
    print(json.dumps(found | {"compiled": compiled, "again": again, "shared": shared}))


if __name__ == "__main__":
    main(sys.argv[2].split("; "), *map(int, sys.argv[3:]))
