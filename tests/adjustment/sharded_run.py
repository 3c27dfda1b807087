"""Adjusts networks on several devices and processes, and prints what it found as JSON.

    python sharded_run.py DEVICES [PROCESSES ID PORT [SIGNAL]]

DEVICES are those of this process; with PROCESSES, it is number ID of so many. SIGNAL: this process
gets it when the others rely on it.
"""

import json
import os
import sys
import time

devices, *rest = map(int, sys.argv[1:])
processes, rank, port, signal = (*rest, *(1, 0, 0, 0)[len(rest) :])
os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={devices}"

import jax  # noqa: E402

import jaxbundle  # noqa: E402

jax.config.update("jax_enable_x64", True)
if processes > 1:
    jaxbundle.join_processes(f"127.0.0.1:{port}", processes, rank, lost_after_seconds=10)

import numpy as np  # noqa: E402
from adjustment_checks import make  # noqa: E402

from jaxbundle import solution  # noqa: E402
from jaxbundle.adjustment.sharding import distribute, find_minimum_of_shards  # noqa: E402
from jaxbundle.adjustment.solve import make_solver  # noqa: E402


def compiled_twice(problem):
    """How many programs an adjustment compiles, and the same once more."""
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, *_, **__: compiled.append(event) if "backend_compile" in event else None
    )
    numbers = []
    for _ in range(2):
        before = len(compiled)
        solution.minimise(problem, problem.data.start, atol=1e-9)
        numbers.append(len(compiled) - before)
    return numbers


solution.RAYS_TO_SHARE = 0
COUNTS = {
    "shared cameras of two models": (2,),
    "free with distances": (1, 2, 4),
    "free with distances by iterative": (2,),
}

found = {}
for name, counts in COUNTS.items() if processes == 1 else [("free with distances", None)]:
    name, _, reduction = name.partition(" by ")
    problem = make(name, reduction or None)
    solver = make_solver(problem, atol=1e-9)
    for count in counts or (jax.device_count(),):
        shards = distribute(problem, jax.devices()[:count])
        if signal:
            os.kill(os.getpid(), signal)
            time.sleep(10)
        minimum = find_minimum_of_shards(solver, shards, problem.data.start)
        cost = np.asarray(minimum.history.cost)[: int(minimum.iterations)]
        found[f"{name}, {count}{reduction}"] = {
            "termination": int(minimum.termination),
            "cost": cost.tolist(),
            "camera": np.asarray(minimum.values.camera).tolist(),
        }
if processes == 1:
    found["compiled"] = compiled_twice(make("free with distances"))
print(json.dumps(found))
