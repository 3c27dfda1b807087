"""Roots of the weights of observations on the host: 1/σ [n, r], or whitening matrices W = L⁻¹
[n, r, r] of covariances C = L·Lᵀ, so that W·v has unit covariance. A residual without weight has
zeros in its row and column."""

import numpy as np
from jaxtyping import Bool, Float


def whitening(covariance: Float[np.ndarray, "*n r r"]) -> Float[np.ndarray, "*n r r"]:
    """W of covariances.

    **Raises:** `numpy.linalg.LinAlgError` if one is not positive definite."""
    return np.linalg.inv(np.linalg.cholesky(covariance))


def diagonal(weight: Float[np.ndarray, "n ..."]) -> Float[np.ndarray, "n r"]:
    """The diagonal of whitening matrices; weights 1/σ as they are."""
    return weight if weight.ndim == 2 else np.diagonal(weight, axis1=1, axis2=2)


def has_weight(weight: Float[np.ndarray, "n ..."]) -> Bool[np.ndarray, "n r"]:
    """Which residuals have weight."""
    return diagonal(weight) > 0


def inverse_sigma(weight: Float[np.ndarray, "n ..."]) -> Float[np.ndarray, "n r"]:
    """1/σ of the residuals, 0 without weight."""
    if weight.ndim == 2:
        return weight
    variance = np.diagonal(_covariance(weight), axis1=1, axis2=2)
    return np.where(has_weight(weight), 1 / np.sqrt(variance), 0.0)


def without_residual(W: Float[np.ndarray, "r r"], removed: int) -> Float[np.ndarray, "r r"]:
    """W of the residuals that remain: of their part of the covariance, not the rows that remain of
    W, which belong to all of them together."""
    # C of all residuals, its part without the removed one, and L⁻¹ of that: a marginal covariance.
    # Rows that remain of W alone would be those of a conditional one.
    stay = np.diagonal(W) > 0
    stay[removed] = False
    stay, root = np.flatnonzero(stay), np.zeros_like(W)
    root[np.ix_(stay, stay)] = whitening(_covariance(W[None])[0][np.ix_(stay, stay)])
    return root


def _covariance(W: Float[np.ndarray, "n r r"]) -> Float[np.ndarray, "n r r"]:
    """C, with a one on the diagonal for residuals without weight."""
    L = np.linalg.inv(W + np.eye(W.shape[-1]) * ~has_weight(W)[:, None])
    return L @ L.mT
