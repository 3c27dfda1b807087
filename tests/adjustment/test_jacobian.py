"""The Jacobian in blocks against forward mode through everything, and against differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adjustment_checks import (
    CAMERAS,
    NETWORKS,
    block_jacobian,
    camera,
    dense_jacobian,
    flat,
    flat_residuals,
    free_parameters,
    make,
    synthetic,
)

from jaxbundle.adjustment.jacobian import free_tangent, jacobian
from jaxbundle.adjustment.residuals import residuals
from jaxbundle.cameras import MODEL_NAMES
from jaxbundle.network import make_structure

ROUNDING = 1e-10
"""Of a column's norm: two orders of the same operations; measured 1e-14 to 1e-12."""

DIFFERENCES = 1e-7
"""Of a column's norm: a step of 0.1 σ is 2.5e-5 of the principal distance, its square the
relative error of central differences; rounding is smaller."""


def free_sets(model):
    names = free_parameters(model)
    return (), names[:1], names, (names[0], names[-1])


def assert_columns_agree(J, other, tolerance):
    size = np.maximum(np.linalg.norm(other, axis=0), np.linalg.norm(J, axis=0))
    difference = np.linalg.norm(J - other, axis=0)
    assert np.isfinite(J).all()
    assert (difference <= tolerance * size).all()


def by_differences(structure, values, data, J):
    """Central differences with steps that move the residuals by 0.1 σ."""
    size = np.linalg.norm(J, axis=0)
    step = np.diag(np.where(size > 0, 0.1 / np.where(size > 0, size, 1), 0.0))
    ends = jax.vmap(lambda change: flat_residuals(structure, values, data, change))
    difference = (ends(step) - ends(-step)).T / 2
    return np.asarray(difference) / np.where(size > 0, np.diag(step), 1)


@pytest.mark.parametrize("domain", ["corrected", "measured"])
@pytest.mark.parametrize("shift", range(4))
def test_every_model_and_free_set(domain, shift):
    # One camera a model, each with another of the four free sets; over the shifts, all of them.
    cameras = [
        camera(name, name, free_sets(name)[(i + shift) % 4]) for i, name in enumerate(MODEL_NAMES)
    ]
    assert set(CAMERAS) == set(MODEL_NAMES)
    two_images_each = np.repeat(np.arange(len(cameras)), 2)
    network, _ = synthetic(
        cameras=cameras, of_image=two_images_each, images=len(two_images_each), points=4,
        domain=domain,
    )  # fmt: skip
    structure, data, _ = make_structure(network)
    J = np.asarray(block_jacobian(structure, data.start, data))
    free = flat(free_tangent(structure))
    assert (np.linalg.norm(J[:, free == 0], axis=0) == 0).all()
    assert (np.linalg.norm(J[:, free > 0], axis=0) > 0).all()
    dense = np.asarray(dense_jacobian(structure, data.start, data))
    assert_columns_agree(J, dense, ROUNDING)
    assert_columns_agree(J, by_differences(structure, data.start, data, J), DIFFERENCES)


@eqx.filter_jit
def both_products(structure, data, vector):
    jac = jacobian(structure, data.start, data)
    rows = residuals(structure, data.start, data)
    return jac, rows, jac.mv(vector), jac.transposed_mv(rows), jac.transpose().mv(rows)


@pytest.mark.parametrize("name", NETWORKS)
def test_every_kind_of_network(name):
    problem = make(name)
    structure, data = problem.structure, problem.data
    rng = np.random.default_rng(1)
    vector = jax.tree.map(
        lambda f: jnp.asarray(rng.normal(size=f.shape)), free_tangent(structure)
    )
    jac, rows, product, transposed, operator = both_products(structure, data, vector)
    J = np.asarray(block_jacobian(structure, data.start, data))
    assert_columns_agree(J, np.asarray(dense_jacobian(structure, data.start, data)), ROUNDING)
    scale = np.linalg.norm(J, axis=0).max()
    np.testing.assert_allclose(flat(product), J @ flat(vector), atol=1e-12 * scale)
    np.testing.assert_allclose(flat(transposed), J.T @ flat(rows), atol=1e-12 * scale**2)
    np.testing.assert_allclose(flat(operator), flat(transposed))
    np.testing.assert_allclose(flat(product) @ flat(rows), flat(vector) @ flat(transposed))
    assert jac.as_matrix().shape == (jac.out_size(), jac.in_size()) == J.shape
    expected = problem.counts.observations + problem.counts.pseudo_observations
    assert (np.linalg.norm(J, axis=1) > 0).sum() == expected
