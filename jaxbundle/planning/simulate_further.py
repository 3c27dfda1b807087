"""Further observations as they would be measured of a simulated network."""

import dataclasses
from collections.abc import Mapping
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxbundle.arguments import whole
from jaxbundle.errors import InputError
from jaxbundle.float64 import require_x64
from jaxbundle.leastsquares.rows import evaluate, scalars
from jaxbundle.network.declare import declare
from jaxbundle.network.tables import Network, require_network
from jaxbundle.planning.stations import LARGEST_SEED


def simulate_further(
    network: Network, truth: Network, *, unknowns: Mapping[str, PyTree] | None = None, seed: int = 0
) -> Network:
    """The network with its further observations measured anew, of a truth, with noise of their σ.

    **Arguments:** `network`: whose rows say what is measured, and how well (antennas, attitudes,
    differences, angles: what they hold as measured does not matter); `truth`: as
    `simulate_with_truth` gives it; `unknowns`: true values of the tables that further observations
    bring, by name, such as `{"GNSS strip": shifts}` [strips, 6] (sorted by name); those of the
    settings, lever arms and boresights, are true if not given.

    **Raises:** `InputError` for a table that is not there.
    """
    require_x64()
    random = np.random.default_rng(whole("seed", seed, least=0, most=LARGEST_SEED))
    known: set[str] = set()
    made = []
    for rows in require_network(network).further:
        field = rows.MEASURED
        declared = declare(truth.replace(further=(rows,)), np.zeros(3))
        values = {t.name: t.value for t in declared.tables}
        known |= set(values)
        values |= {name: v for name, v in (unknowns or {}).items() if name in values}
        if field:
            rows = rows.among(truth)
            seen = declared.observations[len(declared.layout.sets)]
            measured = jax.tree.leaves(seen.measured)[0] + _residuals(declared, seen, values)
            weight = seen.weight(np.shape(measured)[-1] if np.ndim(measured) > 1 else 1)
            noise = _noise(random, weight).reshape(np.shape(measured))
            rows = dataclasses.replace(rows, **{field: measured + noise})
        made.append(rows)
    for name in unknowns or {}:
        if name not in known:
            raise InputError(f"unknowns: there is no table {name!r}; known: {', '.join(known)}")
    return network.replace(further=tuple(made))


def _residuals(declared, seen, values):
    """Computed minus measured of all observations of a set."""
    spaces = [next(t.space for t in declared.tables if t.name == name) for name in seen.kind.of]
    touched = [
        jax.tree.map(lambda x, rows=rows: np.asarray(x)[rows], values[name])
        for name, rows in zip(seen.kind.of, seen.rows)
    ]
    found = np.asarray(_evaluated(seen.kind, tuple(spaces), touched, seen.measured))
    return found.reshape(np.shape(jax.tree.leaves(seen.measured)[0]))


@partial(jax.jit, static_argnums=(0, 1))
def _evaluated(kind, spaces, touched, measured):
    def one(touched, measured):
        blocks = [space.prepare(value) for space, value in zip(spaces, touched)]
        return jnp.stack(evaluate(kind, blocks, measured))

    return jax.vmap(one)(touched, scalars(measured))


def _noise(random, weight):
    """Errors of observations with these weights, 1/σ or L⁻¹; none where nothing was measured."""
    errors = random.normal(size=weight.shape[:2])
    if weight.ndim == 3:
        return np.linalg.solve(weight, errors[..., None])[..., 0]
    return np.where(weight > 0, errors / np.where(weight > 0, weight, 1.0), 0.0)
