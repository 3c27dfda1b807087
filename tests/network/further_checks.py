"""Checks of every further kind of observations: Jacobians against differences, σ against a
sample."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxbundle.leastsquares.indexing.rows import evaluate, scalars
from jaxbundle.leastsquares.problem import with_data
from jaxbundle.leastsquares.solution import find_minimum

STENCIL = ((1, 8 / 12), (-1, -8 / 12), (2, -1 / 12), (-2, 1 / 12))


def check_jacobians(problem, values, skip=("image coordinates",)):
    """∂v/∂δ of one observation of every kind, as the engine differentiates it and by differences of
    finite changes of what it touches."""
    system, tables = problem, values
    random = np.random.default_rng(3)
    for given in system.observations:
        kind, row = given.kind, given.number // 2
        if kind.name in skip:
            continue
        spaces = [system.declared.spaces[name] for name in kind.of]
        touched = [jax.tree.map(lambda x, r=rows[row]: jnp.asarray(x)[r], tables[name])
                   for name, rows in zip(kind.of, given.rows)]  # fmt: skip
        one_row = jax.tree.map(lambda x, row=row: x[row : row + 1], given.measured)
        measured = jax.tree.map(lambda x: x[0], scalars(one_row))
        along = [random.normal(size=s.width) for s in spaces]

        def moved(step, spaces=spaces, touched=touched, along=along, kind=kind, measured=measured):
            blocks = [s.move(s.prepare(x), tuple(step * d))
                      for s, x, d in zip(spaces, touched, along)]  # fmt: skip
            return jnp.stack(evaluate(kind, blocks, measured))

        @jax.jit
        @jax.vmap
        def retracted(step, spaces=spaces, touched=touched, along=along, kind=kind,
                      measured=measured):  # fmt: skip
            blocks = [s.prepare(s.retract(x, step * d))
                      for s, x, d in zip(spaces, touched, along)]  # fmt: skip
            return jnp.stack(evaluate(kind, blocks, measured))

        slope = np.asarray(jax.jit(jax.jacfwd(moved))(0.0))
        h, (steps, factors) = 5e-5, np.transpose(STENCIL)
        differences = factors / h @ np.asarray(retracted(h * steps))
        assert np.abs(slope).max() > 1e-6, kind.name
        np.testing.assert_allclose(slope, differences, rtol=1e-7, atol=1e-7, err_msg=kind.name)


def sample(problem, values, tables, draws=24):
    """Values of tables of vectors, and positions of frames, from that many draws of everything that
    was measured, solved from the values; all by the program that is compiled already."""
    random, data = np.random.default_rng(8), problem.data
    drawn = ("image", "control", *problem.further_sets)
    found = {name: [] for name in tables}
    for _ in range(draws):
        measured = {
            name: _noisy(random, given, data.weight[name]) if name in drawn else given
            for name, given in data.measured.items()
        }
        changed = dataclasses.replace(data, measured=measured)
        minimum = find_minimum(with_data(problem, changed), values)
        for name in tables:
            value = minimum.values[name]
            value = value if hasattr(value, "shape") else value[0]
            found[name].append(np.asarray(value))
    return {name: np.array(x) for name, x in found.items()}


def _noisy(random, measured, weight):
    """The first of the arrays measured with noise of its weights (1/σ, or L⁻¹)."""
    leaves, tree = jax.tree.flatten(measured)
    weight, first = np.asarray(weight), np.asarray(leaves[0])
    # Of image points on lines both coordinates, of which the residual takes one direction.
    noise = random.normal(size=first.reshape(len(first), -1).shape)
    if weight.ndim == 3:
        noise = np.linalg.solve(weight, noise[..., None])[..., 0]
    else:
        noise = np.where(weight > 0, noise / np.where(weight > 0, weight, 1), 0)
    leaves[0] = first + noise.reshape(first.shape)
    return jax.tree.unflatten(tree, leaves)
