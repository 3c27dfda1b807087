"""Sums over pairs of rows in chunks, against plain loops."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxbundle.network import pairs


@pytest.mark.parametrize("small", [pairs.SMALL, 0], ids=["one chunk length", "three"])
def test_sum_over_blocks(small, monkeypatch):
    monkeypatch.setattr(pairs, "SMALL", small)
    rng = np.random.default_rng(0)
    # Blocks of 1 to 900 pairs, so that every chunk length and several portions occur.
    count = 5000
    row = np.minimum(rng.geometric(0.3, count) - 1, 5)
    column = np.minimum(rng.geometric(0.5, count) - 1, 3)
    first, second = rng.integers(0, 300, count), rng.integers(0, 200, count)
    a, b = rng.normal(size=(300, 2, 4)), rng.normal(size=(200, 2, 3))
    table = pairs.make_pairs(first, second, row, column, 4, (300, 200))
    assert len(table.first) == (1 if small else len(pairs.CHUNK_LENGTHS))

    expected = np.zeros((6, 4, 4, 3))
    for i, j, r, c in zip(first, second, row, column):
        expected[r, c] += a[i].T @ b[j]
    found = np.zeros_like(expected)
    found[np.asarray(table.row), np.asarray(table.column)] = table.sum(
        jnp.asarray(a), jnp.asarray(b)
    )
    np.testing.assert_allclose(found, expected, atol=1e-11)
    # The other way round: partners times the block of the pair.
    Q = rng.normal(size=expected.shape)
    to_a, to_b = np.zeros_like(a), np.zeros_like(b)
    for i, j, r, c in zip(first, second, row, column):
        to_a[i] += b[j] @ Q[r, c].T
        to_b[j] += a[i] @ Q[r, c]
    blocks = jnp.asarray(Q[np.asarray(table.row), np.asarray(table.column)])
    nothing = jnp.zeros(a.shape), jnp.zeros(b.shape)
    found = table.spread(jnp.asarray(a), jnp.asarray(b), blocks, nothing)
    np.testing.assert_allclose(found[0], to_a, atol=1e-11)
    np.testing.assert_allclose(found[1], to_b, atol=1e-11)


def test_pairs_within_and_between_groups():
    group, other = np.array([0, 0, 0, 2, 5, 5]), np.array([0, 2, 2, 3, 5])
    found = set(zip(*pairs.pairs_within(group)))
    rows = range(len(group))
    assert found == {(i, j) for i in rows for j in rows if i < j and group[i] == group[j]}
    found = set(zip(*pairs.pairs_between(group, other)))
    expected = {(i, j) for i in rows for j in range(len(other)) if group[i] == other[j]}
    assert found == expected
    assert all(not len(x) for x in pairs.pairs_within(np.zeros(0)))
