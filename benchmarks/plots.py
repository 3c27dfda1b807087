"""Cost against iteration and against time, one row of figures per problem."""

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

ROUNDING = 1e-6
"""Ceres prints costs with seven digits."""


def draw(all_found: list[dict], path: str) -> None:
    """Excess over the lowest cost of all comparable solvers, relative, on logarithmic axes."""
    figure, axes = plt.subplots(
        len(all_found), 2, figsize=(11, 4 * len(all_found)), squeeze=False, layout="constrained"
    )
    for found, (left, right) in zip(all_found, axes):
        solvers = [
            f for f in found.values()
            if isinstance(f, dict) and "costs" in f and f.get("comparable", True)
        ]  # fmt: skip
        lowest = min((f["cost"] for f in solvers), default=1.0)
        for f in solvers:
            excess = np.maximum(np.array(f["costs"]) / lowest - 1, ROUNDING)
            left.loglog(np.arange(1, len(excess) + 1), excess, label=f["solver"])
            right.loglog(f["at_s"], excess)
        left.set(xlabel="evaluation", ylabel="cost / lowest cost − 1")
        left.set_title(found["key"].split(", reduction")[0])
        right.set(xlabel="seconds from the start values, compilation apart")
        left.legend(fontsize="small")
    figure.savefig(path)
