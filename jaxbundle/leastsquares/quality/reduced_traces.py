"""Traces of products of error components from reduced matrices (`error_products`), exactly.

Of roots F of few columns all traces are sums over products of S = FᵀMF; a component V with a block
for every cluster of observations adds powers of M·V and R_n = F̃ᵀ·V·(M·V)ⁿ⁻¹·F̃, F̃ = M·F.

The forms q_k = vᵀV_k·v of residuals with the covariance M·Σ·M have the covariance

    cov(q_i, q_j) = 2·tr(V_i·MΣM·V_j·MΣM),     Σ = θ_0 + F·Θ·Fᵀ + θ_t·V

With K = F̃ᵀΣF̃ = θ_0·S + S·Θ·S + θ_t·R_1 and B = θ_0 + S·Θ, the parts of it are (½ of each)

    two of few columns     ‖K_ij‖²
    the independent one    Σ_ab θ_a·θ_b·tr(M·V_a·M·V_i·M·V_b)
    V and few columns      tr_j(B·R_1·Bᵀ + θ_t·(B·R_2 + R_2·Bᵀ) + θ_t²·R_3)
    V with itself          Σ_ab θ_a·θ_b·tr(V·M·V_a·M·V·M·V_b·M)
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.leastsquares.quality.size_traces import with_traces

Matrix = Float[np.ndarray, "n m"]


class Powers(NamedTuple):
    """tr((MV)ⁿ) of n = 1 … 4; of the columns F̃ = M·F of few the diagonal of F̃ᵀVF̃, and F̃ᵀVF̃,
    F̃ᵀVMVF̃, F̃ᵀVMVMVF̃."""

    traces: Float[np.ndarray, "4"]
    diagonal: Float[np.ndarray, " q"]
    R1: Matrix
    R2: Matrix
    R3: Matrix


class ReducedTraces:
    """T and the traces of three (`size_traces`) of the independent part, index 0, and components:
    the `columns` of S of every one, None of that with `powers`."""

    def __init__(
        self,
        S: Matrix,
        columns: Sequence[slice | None],
        powers: Powers | None,
        redundancy: int,
    ):
        self.S, self.columns, self.powers = S, columns, powers
        self.few = [(k, c) for k, c in enumerate(columns, 1) if c is not None]
        self.many = next((k for k, c in enumerate(columns, 1) if c is None), None)
        number = len(columns) + 1
        self.T, cubes = np.zeros((number, number)), np.zeros((number,) * 3)
        # tr(M·M) = tr(M): M is a projector, and its trace the redundancy.
        self.T[0, 0] = redundancy
        for i, a in self.few:
            self.T[0, i] = np.trace(S[a, a])
            for j, b in self.few:
                self.T[i, j] = np.sum(S[a, b] ** 2)
                for k, c in self.few:
                    # tr(S_ab·S_bc·S_ca) does not depend on the order.
                    if i <= j <= k:
                        cubes[i, j, k] = np.sum((S[a, b] @ S[b, c]) * S[a, c])
        if powers is not None:
            t = self.many
            self.T[0, t], self.T[t, t], cubes[t, t, t] = powers.traces[:3]
            for i, a in self.few:
                self.T[i, t] = np.sum(powers.diagonal[a])
                cubes[i, t, t] = np.trace(powers.R2[a, a])
                for j, b in self.few:
                    cubes[i, j, t] = np.sum(S[a, b] * powers.R1[a, b])
        # Those of one order are filled, and none is negative.
        self.T = np.maximum(self.T, self.T.T)
        self.cubes = with_traces(cubes, self.T)

    def covariance_of_forms(self, theta: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k k"]:
        """The covariance of the forms of residuals of normal errors of sizes θ."""
        S, sizes = self.S, np.zeros(len(self.S))
        for k, a in self.few:
            sizes[a] = theta[k]
        by_column, covariance = S * sizes, np.zeros(self.T.shape)
        # K = F̃ᵀΣF̃: what the errors of all components give in the columns of the roots.
        K = theta[0] * S + by_column @ S
        if self.powers is not None:
            t, R1, R2, R3 = self.many, *self.powers[2:]
            of_t = theta[t]
            K = K + of_t * R1
            B = theta[0] * np.eye(len(S)) + by_column
            BR = B @ R2
            combined = B @ R1 @ B.T + of_t * (BR + BR.T) + of_t**2 * R3
            # V between the columns of a component, through both Σ.
            for k, a in self.few:
                covariance[k, t] = covariance[t, k] = np.trace(combined[a, a])
            R = R1 * sizes
            mixed = 2 * (theta[0] * np.trace(R2 * sizes) + of_t * np.trace(R3 * sizes))
            powers = (
                np.array([theta[0] ** 2, 2 * theta[0] * of_t, of_t**2]) @ self.powers.traces[1:]
            )
            covariance[t, t] = powers + mixed + np.sum(R * R.T)
        for i, a in self.few:
            for j, b in self.few:
                covariance[i, j] = np.sum(K[a, b] ** 2)
        covariance[0] = np.einsum("a,b,ajb->j", theta, theta, self.cubes)
        covariance[:, 0] = covariance[0]
        return 2 * covariance
