"""What half and double of the engine's tuned figures cost: the measurements behind their reasons.

    python benchmarks/constants.py PROBLEM ... [--only NAME ...] [--repeat N] [--json FILE]

PROBLEM is a file in the BAL format; `random`: disturbed small problems of
`tests/leastsquares/random_problems.py`; or `singular`: the pivots that rounding leaves of normal
matrices with one dependent unknown. Every figure is changed in the source as it is imported, in a
process of its own, so that nothing else differs; figures may be constants of a module, fields of a
settings object, or defaults of an argument. The table gives for every value the evaluations until
the solution, the relative difference of ½vᵀPv from that of the figure in force, the processor time
of an evaluation, and the seconds to compile. Times are the least of --repeat runs; on a busy
machine only differences above a tenth mean something.
"""

import argparse
import ast
import importlib.abc
import importlib.util
import json
import os
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
ENGINE = HERE.parent / "jaxbundle" / "leastsquares"

FIGURES = {
    "equations/elimination.py": {"at_once": ("2048", "8192")},
    "indexing/settings.py": {
        "masked_below": ("0", "10_000"),
        "chunk_lengths": ("(128, 32, 8)", "(512, 128, 32)"),
        "max_padding": ("0.05", "0.2"),
        "small_part": ("1000", "4000", "100_000"),
        "pair_chunk_lengths": ("(128, 32, 6)", "(512, 128, 24)"),
        "few_pairs": ("25_000", "100_000", "1_000_000"),
    },
    "iterations/search.py": {
        "sufficient_decrease": ("5e-4", "2e-3", "0.1"),
        "initial": ("5e3", "2e4", "1e2", "1e6"),
        "pin_datum_from": ("5e7", "2e8", "1e6", "1e10"),
        "relative_residual": ("5e-3", "2e-2", "0.1", "1e-6"),
    },
    "iterations/stopping.py": {
        "rounding": ("1e-14", "4e-14"),
        "cost_rounding": ("5e-16", "2e-15"),
        "noise_floor": ("5e-15", "2e-14"),
        "near_solution": ("0.05", "0.2", "0.01", "1.0"),
        "quadratic_gain": ("0.9", "0.975"),
        "quadratic_decrease": ("0.25", "1.0"),
        "max_rejected_undamped": ("1", "4"),
    },
}
"""By file of the engine, the figures and the values beside the one in force."""


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("problems", nargs="+", metavar="PROBLEM")
    parser.add_argument("--only", nargs="+", help="names of figures")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--reduction", help="solver of the reduced system")
    parser.add_argument("--json", type=Path, help="file for all results")
    parser.add_argument("--run", nargs=3, metavar=("FILE", "NAME", "VALUE"), help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.run:
        print(json.dumps(run(given.problems[0], given)))
        return 0
    results = []
    for problem in given.problems:
        if problem == "singular":
            print_singular_pivots()
            continue
        before = measure(problem, given, "", "", "")
        print(f"\n{Path(problem).name}, in force: {describe(before)}", flush=True)
        for file, figures in FIGURES.items():
            for name, values in figures.items():
                if given.only and name not in given.only:
                    continue
                for value in values:
                    found = measure(problem, given, file, name, value)
                    change = found["cost"] / before["cost"] - 1
                    print(f"{name} = {value}: {describe(found)}, cost {change:+.1e}", flush=True)
                    results.append({"problem": problem, "name": name, "value": value, **found})
        results.append({"problem": problem, "name": "", "value": "", **before})
    if given.json:
        given.json.write_text(json.dumps(results, indent=1))
    return 0


def describe(found: dict) -> str:
    return (
        f"{found['evaluations']} evaluations, {found['ms']:.2f} ms each, compiled in "
        f"{found['compile_s']:.1f} s, {found['settled']} settled"
    )


def measure(problem: str, given: argparse.Namespace, file: str, name: str, value: str) -> dict:
    """The result of one process with a figure changed."""
    options = ["--repeat", str(given.repeat)]
    options += ["--reduction", given.reduction] if given.reduction else []
    command = [sys.executable, __file__, problem, *options, "--run", file, name, value]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ, check=False)
    if done.returncode:
        raise SystemExit(f"{name} = {value}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def run(problem: str, given: argparse.Namespace) -> dict:
    """One measurement, in this process."""
    file, name, value = given.run
    change = ChangedFigure(ENGINE / file, name, value)
    if name:
        sys.meta_path.insert(0, change)
    found = run_random() if problem == "random" else run_bal(problem, given)
    if name and not change.places:
        raise SystemExit(f"{file} has no figure {name}")
    return found


class ChangedFigure(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports one module with every assignment and default of a name replaced."""

    def __init__(self, path: Path, name: str, value: str):
        self.path, self.name = path, name
        self.value = ast.parse(value or "0", mode="eval").body
        self.places = 0

    def find_spec(self, fullname, path=None, target=None):
        parts = fullname.split(".")
        if Path(*parts[-2:]).with_suffix(".py") != Path(*self.path.parts[-2:]):
            return None
        return importlib.util.spec_from_file_location(fullname, self.path, loader=self)

    def create_module(self, spec):
        return None

    def exec_module(self, module) -> None:
        tree = ast.parse(self.path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.Assign | ast.AnnAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                if any(isinstance(t, ast.Name) and t.id == self.name for t in targets):
                    self.replace(node)
            elif isinstance(node, ast.arguments):
                named = [*node.posonlyargs, *node.args][-len(node.defaults) or None :]
                for group, values in ((named, node.defaults), (node.kwonlyargs, node.kw_defaults)):
                    for k, argument in enumerate(group[: len(values)]):
                        if argument.arg == self.name and values[k] is not None:
                            values[k], self.places = self.value, self.places + 1
        exec(compile(ast.fix_missing_locations(tree), self.path, "exec"), module.__dict__)

    def replace(self, node: ast.Assign | ast.AnnAssign) -> None:
        """The new value, also inside `eqx.field(default=…)`."""
        self.places += 1
        if isinstance(node.value, ast.Call):
            for keyword in node.value.keywords:
                if keyword.arg == "default":
                    keyword.value = self.value
        else:
            node.value = self.value


def print_singular_pivots(matrices: int = 1260) -> None:
    """The last pivot, relative to its diagonal element, of random normal matrices of which one
    unknown is a combination of the others: 0 but for rounding."""
    import numpy as np

    rng, last = np.random.default_rng(0), []
    for k in range(matrices):
        n = (5, 20, 60, 200)[min(k // 400, 3)]
        J = rng.normal(size=(3 * n, n)) * 10.0 ** rng.uniform(-4, 4, n)
        J[:, -1] = J[:, :-1] @ (rng.normal(size=n - 1) / np.linalg.norm(J[:, :-1], axis=0))
        N = J.T @ J
        scale = 1 / np.sqrt(np.diag(N))
        C = N * scale * scale[:, None]
        L = np.linalg.cholesky(C[:-1, :-1])
        last.append(C[-1, -1] - np.sum(np.linalg.solve(L, C[:-1, -1]) ** 2))
    size = np.abs(last)
    print(
        f"{matrices} singular matrices of 5 to 200 unknowns: last pivot {np.median(size):.1e} "
        f"(median), {size.max():.1e} (largest), {100 * np.mean(np.less(last, 0)):.0f} % negative"
    )


def run_bal(problem: str, given: argparse.Namespace) -> dict:
    import jax

    import jaxbundle

    jaxbundle.enable_x64()
    from jaxbundle.leastsquares.iterations.solver import minimise_compiled
    from jaxbundle.leastsquares.iterations.stopping import RELATIVE_COST, SETTLED
    from jaxbundle.leastsquares.problem import make_solver, pad_data

    network = jaxbundle.check_network(jaxbundle.read_network(problem))
    problem = jaxbundle.make_problem(network, reduction=given.reduction)
    solver, data = make_solver(problem, max_steps=300), pad_data(problem, problem.data)

    def timed():
        begin = time.process_time()
        minimum = jax.block_until_ready(minimise_compiled(solver, data, data.start))
        return minimum, time.process_time() - begin

    minimum, first = timed()
    seconds = min(timed()[1] for _ in range(given.repeat))
    number = int(minimum.iterations)
    cost = minimum.history.cost[:number][minimum.history.accepted[:number]].min()
    return {
        "evaluations": number,
        "cost": float(cost),
        "ms": 1e3 * seconds / number,
        "compile_s": first - seconds,
        "settled": int(int(minimum.termination) in (SETTLED, RELATIVE_COST)),
    }


def run_random() -> dict:
    """Ten small problems, each twice: disturbed by 0.05 and by 0.5."""
    sys.path.insert(0, str(HERE.parent / "tests" / "leastsquares"))
    import dataclasses

    import numpy as np
    from random_problems import make_random

    import jaxbundle

    jaxbundle.enable_x64(compile_quickly=True)
    evaluations, cost, settled, begin = 0, 0.0, 0, time.process_time()
    for seed in range(5):
        for variant, size in ((0, 0.05), (1, 0.5)):
            given = make_random(seed, variant)
            rng = np.random.default_rng((seed, variant, 1))
            tables = [
                dataclasses.replace(
                    t,
                    value=t.value
                    + size * rng.normal(size=np.shape(t.value)) * t.free.reshape(np.shape(t.value)),
                )
                for t in given.tables
            ]
            found = dataclasses.replace(given, tables=tables).adjust()
            evaluations += found.iterations + 1
            settled += found.converged
            cost += found.vtpv if found.converged else 0.0
    seconds = time.process_time() - begin
    return {"evaluations": evaluations, "cost": cost, "ms": 0.0, "compile_s": seconds,
            "settled": settled}  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
