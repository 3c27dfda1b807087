"""Resection and relative orientation of 10 000 random configurations: success and errors.

    python benchmarks/orientation.py [--number N] [--noise SIGMA] [--json FILE]

Randomly rotated cameras see points 4 to 12 units away, in images of ±0.8 principal distances; pairs
have a base of 1 in any direction and are rotated by some 0.2 rad about each axis. Every row of the
table has the successes, quantiles of the error, names of the failures, and microseconds per item
without compilation. The error is the largest of the components of X0 (object unit) or of b, and of
the elements of M. Below 1e-6 it is a success; with noise, if the errors are within the 0.999
quantile of χ² by their cofactors (one in a thousand is expected outside). The exit status is 1 if a
row has significantly fewer successes than 0.997 of its number.

    resection, 3 points       all solutions; one of them is the truth
    resection, 3 + 1 points   the solution chosen by a fourth point, refined
    resection, n points       one triangle, refined with all points
    relative, 5 points        all solutions; one of them is the truth
    relative, n points        five or eight points, chosen, refined
"""

import collections
import os
import sys
import time
from functools import partial

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import machine
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import jaxbundle
from jaxbundle.orientation import (
    Status,
    five_points,
    orientations,
    relative_orientation,
    resection,
    three_points,
)

EXACT, CONFIDENCE, BATCH = 1e-6, 0.999, 1000
LEAST = 0.997


def images(rng, N, n, noise):
    xy = rng.uniform(-0.8, 0.8, (N, n, 2))
    Y = np.concatenate([xy, -np.ones((N, n, 1))], 2) * rng.uniform(4, 12, (N, n, 1))
    M, X0 = Rotation.random(N, rng=rng).as_matrix(), 5 * rng.normal(size=(N, 3))
    X = np.einsum("kji,knj->kni", M, Y) + X0[:, None]
    return (xy + noise * rng.normal(size=xy.shape), X), (M, X0)


def pairs(rng, N, n, noise):
    xy = rng.uniform(-0.8, 0.8, (N, n, 2))
    Y = np.concatenate([xy, -np.ones((N, n, 1))], 2) * rng.uniform(4, 12, (N, n, 1))
    M = Rotation.from_rotvec(0.2 * rng.normal(size=(N, 3))).as_matrix()
    b = rng.normal(size=(N, 3))
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    Z = np.einsum("kij,knj->kni", M, Y - b[:, None])
    other = -Z[..., :2] / Z[..., 2:]
    error = lambda: noise * rng.normal(size=xy.shape)
    return (xy + error(), other + error()), (M, b)


def run(function, data):
    """Results of all items in batches, and the seconds without compilation."""
    compiled = jax.jit(jax.vmap(function))
    jax.block_until_ready(compiled(*(a[:BATCH] for a in data)))
    parts, start = [], time.perf_counter()
    for k in range(0, len(data[0]), BATCH):
        parts.append(jax.tree.map(np.asarray, compiled(*(a[k : k + BATCH] for a in data))))
    seconds = time.perf_counter() - start
    return jax.tree.map(lambda *a: np.concatenate(a), *parts), seconds


def row(name, error, success, status, seconds):
    """Figures of a line of the table."""
    return {
        "name": name, "success": float(success.mean()),
        "error": np.quantile(error, [0.5, 0.9, 0.99, 0.999, 1]).tolist(),
        "us": 1e6 * seconds / len(error),
        "named": dict(collections.Counter(Status(int(s)).name for s in status if s)),
    }  # fmt: skip


def show(f):
    quantiles = "  ".join(f"{q:8.1e}" for q in f["error"])
    names = ", ".join(f"{n} {k}" for k, n in f["named"].items())
    line = f"{f['name']:34} {100 * f['success']:8.2f}  {quantiles}  {f['us']:7.0f}  {names}"
    print(line, flush=True)


def nearest(M, t, valid, truth):
    """Error of the solution nearest to the truth."""
    error = np.abs(M - truth[0][:, None]).max((2, 3))
    error = np.maximum(error, np.abs(t - truth[1][:, None]).max(2))
    return np.where(valid, error, np.inf).min(1)


def within(delta, cofactor, noise):
    size = delta.shape[1]
    usable = np.isfinite(cofactor).all((1, 2))
    inverse = np.linalg.inv(np.where(usable[:, None, None], cofactor, np.eye(size)))
    square = np.einsum("ki,kij,kj->k", delta, inverse, delta) / noise**2
    return usable & (square < chi2.ppf(CONFIDENCE, size))


def resections(rng, N, n, noise):
    data, (M, X0) = images(rng, N, n, noise)
    result, seconds = run(resection, data)
    error = np.maximum(np.abs(result.pose.X0 - X0).max(1), np.abs(result.pose.M - M).max((1, 2)))
    delta, Q = result.pose.X0 - X0, result.cofactor[:, :3, :3]
    success = within(delta, Q, noise) if noise else error < EXACT
    return row(f"resection, {n} points, σ = {noise:g}", error, success, result.status, seconds)


def relatives(rng, N, n, noise, method):
    data, (M, b) = pairs(rng, N, n, noise)
    result, seconds = run(partial(relative_orientation, method=method), data)
    error = np.maximum(np.abs(result.b - b).max(1), np.abs(result.M - M).max((1, 2)))
    turn = result.M @ M.swapaxes(1, 2)
    delta, Q = Rotation.from_matrix(turn).as_rotvec(), result.cofactor[:, :3, :3]
    success = within(delta, Q, noise) if noise else error < EXACT
    name = f"relative, {n} points, {method}, σ = {noise:g}"
    return row(name, error, success, result.status, seconds)


def rows(N, noise):
    """Lines of the table, one at a time."""
    rng = np.random.default_rng(0)
    (xy, X), truth = images(rng, N, 3, 0.0)
    rays = np.concatenate([xy, -np.ones((N, 3, 1))], 2)
    (poses, valid), seconds = run(three_points, (rays, X))
    error = nearest(poses.M, poses.X0, valid, truth)
    yield row("resection, 3 points, all solutions", error, error < EXACT, [], seconds)
    for n, sigma in ((4, 0.0), (10, 0.0), (10, noise)):
        yield resections(rng, N, n, sigma)
    data, truth = pairs(rng, N, 5, 0.0)

    def all_solutions(xy1, xy2):
        E, valid = five_points(xy1, xy2)
        M, b = jax.vmap(orientations)(E)
        return M.reshape(-1, 3, 3), b.reshape(-1, 3), valid.repeat(4)

    (M, b, valid), seconds = run(all_solutions, data)
    error = nearest(M, b, valid, truth)
    yield row("relative, 5 points, all solutions", error, error < EXACT, [], seconds)
    for n, sigma, method in (
        (6, 0.0, "five"), (10, 0.0, "five"), (10, noise, "five"),
        (8, 0.0, "eight"), (10, 0.0, "eight"), (10, noise, "eight"),
    ):  # fmt: skip
        yield relatives(rng, N, n, sigma, method)


def complaints(rows, number):
    """Rows with too few successes; four standard deviations of their number are chance."""
    least = LEAST - 4 * np.sqrt(LEAST * (1 - LEAST) / number)
    return [
        f"{f['name']}: {100 * f['success']:.2f} % successes, at least {100 * least:.2f} expected"
        for f in rows if not f["success"] >= least
    ]  # fmt: skip


def main():
    parser = machine.parser_of(__doc__)
    parser.add_argument("--number", type=machine.positive, default=10_000)
    parser.add_argument("--noise", type=float, default=2e-4)
    parser.add_argument("--json", type=machine.target, metavar="FILE",
                        help="write the figures; - for standard output")  # fmt: skip
    given = parser.parse_args()
    jaxbundle.enable_x64()
    found = {"machine": machine.machine(), "rows": []}
    table = given.json != "-"
    if table:
        print(machine.in_words(found["machine"]))
        print(f"{'':34} success %       50 %      90 %      99 %    99.9 %       max       µs",
              " named")  # fmt: skip
    for figures in rows(given.number, given.noise):
        found["rows"].append(figures)
        if table:
            show(figures)
    machine.write_json(found, given.json)
    return machine.verdict(complaints(found["rows"], given.number))


if __name__ == "__main__":
    sys.exit(main())
