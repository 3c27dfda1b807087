"""One step of many small fits to grey values at once, as of corners (`saddles`) and of edges
(`straight_edges`): least squares with pseudo-observations of the unknowns."""

import numpy as np
from jaxtyping import Float


def normal_equations(
    J: Float[np.ndarray, "n pixels unknowns"],
    r: Float[np.ndarray, "n pixels"],
    weight: Float[np.ndarray, "n pixels"],
    prior: Float[np.ndarray, "... unknowns"],
    prior_residual: Float[np.ndarray, "n unknowns"],
    noise: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "n unknowns unknowns"], Float[np.ndarray, "n unknowns"]]:
    """Normal matrices and right hand sides, in units of the variance of the grey values.

    **Arguments:** `r`: observed − computed, of the pixels' `weight`; `prior`: weights 1/σ² of the
    pseudo-observations, `prior_residual`: their values less the unknowns; `noise`: σ of the grey
    values."""
    p, identity = prior * noise[:, None] ** 2, np.eye(J.shape[2])
    weighted = J * weight[:, :, None]
    N = np.matmul(weighted.transpose(0, 2, 1), J) + p[:, :, None] * identity
    # Few pixels may leave an unknown open: a billionth of the trace, far above rounding and far
    # below the weight of any observation.
    N = N + 1e-9 * np.trace(N, axis1=1, axis2=2)[:, None, None] * identity
    return N, np.einsum("npi,np->ni", weighted, r) + p * prior_residual


def noise_of_residuals(
    r: Float[np.ndarray, "n pixels"], weight: Float[np.ndarray, "n pixels"], unknowns: int
) -> Float[np.ndarray, " n"]:
    """σ of the grey values from the residuals of each fit, at least that of rounding."""
    freedom = np.maximum(weight.sum(1) - unknowns, 1)
    # Rounding to whole grey values is uniform over ±½, of variance ∫x²dx = 1/12.
    return np.sqrt(np.maximum((weight * r**2).sum(1) / freedom, 1 / 12))
