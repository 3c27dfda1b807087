"""Traces of products of error components, which expectations, variances and skewness of their
quadratic forms are made of.

    T_kj = tr(M·V_k·M·V_j),    tr(M·V_i·M·V_j·M·V_l),    V = F·Fᵀ

Roots F of few columns have the products S_kj = F_kᵀ·M·F_j, and traces are sums over these. Of the
others one factor of a trace is replaced by random combinations F·ξ, E ξξᵀ = 1.
"""

from collections.abc import Iterator, Sequence
from itertools import permutations
from typing import Any

import numpy as np
from jaxtyping import Float

Columns = Float[np.ndarray, "columns rows"]


class Traces:
    """Sums over the columns of the roots `F`; index 0 is V = 1."""

    def __init__(self, F: Sequence[Any], redundancy: int):
        self.F, number = F, len(F) + 1
        self.T, self.cubes = np.zeros((number, number)), np.zeros((number,) * 3)
        self.T[0, 0] = redundancy
        self.products: dict[int, list[list[np.ndarray]]] = {}
        self._S: dict[tuple[int, int], np.ndarray] | None = None

    def add(self, k: int, columns: Columns, remaining: Columns, exact: bool) -> np.ndarray:
        """Add some columns of the root k, or combinations of them, of which M·F is what is
        `remaining`. Those of roots of few columns, `exact`, come first.

        **Returns:** the products F_kᵀ·M·F with them."""
        products = [np.asarray(root.T @ remaining.T) for root in self.F]
        # T_0k = tr(M·V_k) = tr(F_kᵀ·M·F_k), as M·M = M, and T_kj = ‖F_jᵀ·M·F_k‖²
        self.T[0, k + 1] += np.sum(columns * remaining)
        self.T[1:, k + 1] += [np.sum(y**2) for y in products]
        if exact:
            self.products.setdefault(k, []).append(products)
        else:
            S = self.S
            exact_roots = [*self.products]
            for i in exact_roots:
                for j in exact_roots:
                    # E (F_iᵀ·M·F_k·ξ)ᵀ·S_ij·(F_jᵀ·M·F_k·ξ)
                    cube = np.sum((S[i, j] @ products[j]) * products[i])
                    self.cubes[1 + k, 1 + i, 1 + j] += cube
        return products[k]

    def add_cubes(self, k: int, remaining: Columns, remaining_again: Columns, times: float) -> None:
        """Cubes of the root k with itself, from some combinations of its columns, of which M·F·ξ is
        `remaining` and M·F·(FᵀM·F·ξ) is `remaining_again`; `times`: all draws by those given
        here."""
        # With S = FᵀM·F, ‖M·F·S·ξ‖² = ξᵀ·S³·ξ, whose expectation is tr S³.
        self.cubes[1 + k, 1 + k, 1 + k] = times * np.sum(remaining_again**2)
        for j in self.products:
            y = [np.asarray(self.F[j].T @ rows.T) for rows in (remaining_again, remaining)]
            self.cubes[1 + k, 1 + k, 1 + j] = times * np.sum(y[0] * y[1])

    @property
    def S(self) -> dict[tuple[int, int], Float[np.ndarray, "columns columns"]]:
        """S of the roots of few columns."""
        if self._S is None:
            self._S = {
                (j, k): np.concatenate([part[j] for part in parts], axis=1)
                for k, parts in self.products.items()
                for j in self.products
            }
        return self._S

    def of_all(self) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, "k k k"]]:
        """T and the cubes."""
        # Random combinations, on one side of the traces, make it unsymmetric.
        T = self.T
        T[1:, 0] = T[0, 1:]
        T[1:, 1:] = (T[1:, 1:] + T[1:, 1:].T) / 2
        for (i, j, k), cube in self._cubes_of_few():
            self.cubes[1 + i, 1 + j, 1 + k] = cube
        return T, with_traces(self.cubes, T)

    def _cubes_of_few(self) -> Iterator[tuple[tuple[int, int, int], float]]:
        S, exact_roots = self.S, sorted(self.products)
        for i in exact_roots:
            for j in exact_roots:
                for k in exact_roots:
                    if i <= j <= k:
                        yield (i, j, k), float(np.sum((S[i, j] @ S[j, k]) * S[i, k]))


def with_traces(
    cubes: Float[np.ndarray, "k k k"], T: Float[np.ndarray, "k k"]
) -> Float[np.ndarray, "k k k"]:
    """All entries of the traces of three, which are symmetric in their axes, from at least one of
    every kind, the others zero; those with the independent part are T, as M·M = M."""
    orders = [np.transpose(cubes, order) for order in permutations(range(3))]
    number = np.maximum(np.sum([entries != 0 for entries in orders], 0), 1)
    mean = np.sum(orders, 0) / number
    for axis in range(3):
        np.moveaxis(mean, axis, 0)[0] = T
    return mean
