"""Random problems by the engine and by dense algebra: values, σ, covariances, residuals, redundancy
numbers, tests, derivatives.

The 10 structures here have 4 variants each. `make random-problems` compares 500.
"""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_problems import Dense, Random, make_random

import jaxbundle
from jaxbundle import leastsquares as ls

STRUCTURES, VARIANTS = 10, 4
LARGEST_ERROR = 1e-7
"""Of statistics at the engine's own solution, relative: the condition of these problems (to 1e4,
squared in N) leaves eight digits."""
DISTANCE = 1e-4
"""Of the engine's solution from the dense one, in σ; iterations end at 1e-5."""
DIFFERENCES = 1e-6
"""Relative error of central differences of steps of 1e-5."""


@pytest.mark.parametrize("seed", [
    *range(3), *(pytest.param(seed, marks=pytest.mark.further) for seed in range(3, STRUCTURES)),
])  # fmt: skip
def test_as_dense_algebra(seed):
    for variant in range(VARIANTS):
        compare(seed, variant)


@pytest.mark.further
@pytest.mark.parametrize("seed", [0, 2])
def test_derivatives_as_differences_of_dense_algebra(seed):
    for variant in range(2):
        compare_derivatives(seed, variant)


def disturbed(seed: int, variant: int) -> Random:
    """The problem of a seed with start values that are off by 0.05."""
    given = make_random(seed, variant)
    rng = np.random.default_rng((seed, variant, 1))
    shift = lambda t: 0.05 * rng.normal(size=np.shape(t.value)) * t.free.reshape(np.shape(t.value))
    tables = [dataclasses.replace(t, value=t.value + shift(t)) for t in given.tables]
    return dataclasses.replace(given, tables=tables)


def compare(seed: int, variant: int = 0) -> None:
    given = disturbed(seed, variant)
    found, right = given.adjust(), Dense(given).solve()
    assert found.converged, f"{seed}, {variant}: {found.termination} {found.undetermined}"
    counts = found.counts
    assert (counts.observations, counts.unknowns) == (right.observations, right.unknowns)
    assert (counts.datum, counts.redundancy) == (right.defect, right.redundancy)
    # Statistics are those of the engine's own solution, to all digits.
    here = Dense(given, found.minimum.values)
    Q = here.cofactors
    sigma = np.sqrt(np.diag(Q))
    distance = here.estimable(right.vector() - here.vector())
    assert np.abs(distance / sigma).max() < DISTANCE
    np.testing.assert_allclose(found.vtpv, here.r @ here.r, rtol=1e-9)
    near = lambda a, b, **scale: np.testing.assert_allclose(
        a, b, rtol=LARGEST_ERROR, atol=LARGEST_ERROR, err_msg=f"seed {seed}, {variant}", **scale
    )
    own = here.projection if given.options.get("datum") == "minimal" else np.eye(len(Q))
    C = found.covariance(_Unknowns(given, here.free)) / found.sigma0**2
    near(own @ C @ own.T / np.outer(sigma, sigma), Q / np.outer(sigma, sigma))
    if given.options.get("datum") != "minimal":
        of_tables = [np.ravel(found[t.name].sigma) for t in given.tables]
        near(np.concatenate(of_tables)[here.free] / found.sigma0 / sigma, 1.0)
    for o, observations in enumerate(given.observations):
        table = {k: x.reshape(x.shape[0], -1)
                 for k, x in found.residuals(observations.kind.name).items()}  # fmt: skip
        compare_residuals(table, here, o, Q, found.sigma0, near)


def compare_residuals(table, here: Dense, o: int, Q, sigma0, near) -> None:
    """The rows of a residual table as r = diag(Q_vv·P), w = P·v/√diag(P·Q_vv·P), …"""
    used, unit = here.used[o] > 0, np.eye(here.used[o].shape[1])
    L = np.linalg.inv(here.root[o] + unit * ~used[:, None])
    C, P = L @ L.mT, here.root[o].mT @ here.root[o]
    v, A = np.einsum("nij,nj->ni", L, here.v[o]), L @ here.by_set[o]
    Qvv = C - A @ Q @ A.mT
    diagonal = lambda x: np.diagonal(x, axis1=1, axis2=2)
    near(table["sigma"][used], np.sqrt(diagonal(C))[used])
    near(table["v"][used] / table["sigma"][used], v[used] / table["sigma"][used])
    near(table["r"], np.where(used, diagonal(Qvv @ P), 0.0))
    controlled = used & (diagonal(P @ Qvv @ P) > 1e-4 * diagonal(P))
    at, of = np.sqrt(diagonal(P @ Qvv @ P)[controlled]), diagonal(P)[controlled]
    w = np.einsum("nij,nj->ni", P, v)[controlled] / at
    # Small redundancy numbers have fewer digits.
    rough = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)
    rough(table["w"][controlled], w)
    rough(table["tau"][controlled], w / sigma0)
    rough(table["mdb"][controlled], 4.13 / at)
    rough(table["external"][controlled], 4.13 * np.sqrt(np.maximum(of / at**2 - 1, 0)))


@dataclasses.dataclass(frozen=True, eq=False)
class _Unknowns:
    """The free unknowns of a problem as a function of its tables."""

    given: Random
    free: np.ndarray

    def __call__(self, values):
        return jnp.concatenate([jnp.ravel(values[t.name]) for t in self.given.tables])[self.free]


def compare_derivatives(seed: int, variant: int = 0) -> None:
    """Forward and reverse derivatives by all data against differences of the dense solution."""
    given = disturbed(seed, variant)
    found = given.adjust()
    problem, values = found.problem, found.minimum.values
    here, rng = Dense(given, values), np.random.default_rng((seed, variant, 2))
    held = {t.name: 1 - t.free.reshape(np.shape(t.value)) for t in given.tables}
    data = jax.tree.map(np.asarray, problem.data)
    along = type(data)(
        {name: held[name] * rng.normal(size=np.shape(x)) for name, x in data.start.items()},
        jax.tree.map(lambda x: rng.normal(size=x.shape), data.measured),
        jax.tree.map(lambda w: 0.1 * w * rng.normal(size=w.shape), data.weight),
    )
    if given.floats:  # As it does after the change.
        for measured in along.measured.values():
            mean = sum(measured["c"].values()) / len(measured["c"])
            measured["c"].update({slot: c - mean for slot, c in measured["c"].items()})
    unknowns = _Unknowns(given, here.free)
    solved = lambda data: unknowns(ls.solve(problem, data))
    # Under jit, where everything of the problem itself must be a constant.
    jvp = jax.jit(lambda data, along: jax.jvp(solved, (data,), (along,))[1])
    forward = here.estimable(np.asarray(jvp(data, along)))
    towards = here.estimable(rng.normal(size=len(here.free)))
    (back,) = jax.vjp(solved, data)[1](jnp.asarray(towards))
    pairs = zip(jax.tree.leaves(back), jax.tree.leaves(along), strict=True)
    reverse = sum(float(jnp.vdot(a, b)) for a, b in pairs)
    step = 1e-5
    moved = lambda s: jax.tree.map(lambda x, d: x + s * d, data, along)
    dense = lambda s: _dense_solution(given, held, values, moved(s))
    right = (dense(step) - dense(-step)) / (2 * step)
    size = np.abs(right).max()
    np.testing.assert_allclose(forward / size, right / size, atol=DIFFERENCES)
    np.testing.assert_allclose(
        reverse / size / np.linalg.norm(towards), towards @ right / size / np.linalg.norm(towards),
        atol=DIFFERENCES,
    )  # fmt: skip


def _dense_solution(given: Random, held, values, data) -> np.ndarray:
    observations = [
        dataclasses.replace(o, measured=data.measured[o.name]) for o in given.observations
    ]
    weights = [data.weight[o.name] for o in given.observations]
    roots = [w if w.ndim == 3 else np.eye(w.shape[1]) * w[:, :, None] for w in weights]
    start = {
        name: np.where(held[name] > 0, data.start[name], values[name]) for name in data.start
    }
    changed = dataclasses.replace(given, observations=observations)
    dense = Dense(changed, start, roots).solve()
    return dense.estimable(dense.vector())


def main(number: int, share: int = 0, shares: int = 1) -> int:
    """Compare the structures share, share + shares, … of `number` problems; 1 if any is wrong."""
    jaxbundle.enable_x64()
    wrong, done = [], 0
    for seed in range(share, -(-number // VARIANTS), shares):
        for variant in range(VARIANTS):
            try:
                compare(seed, variant)
                if (VARIANTS * seed + variant) % 10 == 0:
                    compare_derivatives(seed, variant)
            except AssertionError as error:
                wrong.append((seed, variant))
                print(f"seed {seed}, variant {variant}: {error}", flush=True)
        done += VARIANTS
        print(f"{done} problems, {len(wrong)} wrong", flush=True)
        jax.clear_caches()
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
