"""What the orientation of photographs adds to the covariance of points.

A point is moved by its images' exterior orientations θₖ = (X0, Y0, Z0, ω, φ, κ) by

    dX = −N⁻¹·Σ Jₖᵀ·Bₖ·dθₖ,    N = Σ JₖᵀJₖ,    Jₖ = ∂(u, v)ₖ/∂X,    Bₖ = ∂(u, v)ₖ/∂θₖ,

so that C = Σ Sₖ·diag(σ²)·Sₖᵀ with Sₖ = N⁻¹·Jₖᵀ·Bₖ. The σ are those of images.csv, taken as
uncorrelated, which after an adjustment they are not: the true part may be smaller or larger. σ of
0, or none, adds nothing.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.geometry import matrix_from_omega_phi_kappa, omega_phi_kappa_from_matrix
from jaxbundle.surface.views import FrameView, OrientedImage, in_lanes, pixel_of


def is_uncertain(view: OrientedImage) -> bool:
    """Whether an image has a σ of its orientation."""
    return isinstance(view, FrameView) and bool((view.sigma > 0).any())


def orientation_covariance(
    views: Sequence[OrientedImage],
    X: Float[np.ndarray, "n 3"],
    used: Bool[np.ndarray, "n views"],
) -> Float[np.ndarray, "n 3 3"]:
    """The covariance of points by that of the orientations of the images that see them."""
    C = np.zeros((len(X), 3, 3))
    if not any(map(is_uncertain, views)):
        return C
    J = np.stack([view.derivative(X) for view in views], 1) * used[:, :, None, None]
    N = np.einsum("nkij,nkil->njl", J, J)
    scale = np.trace(N, axis1=1, axis2=2)[:, None, None]
    Q = np.linalg.pinv(N / scale) / scale
    for k, view in enumerate(views):
        if isinstance(view, FrameView) and is_uncertain(view):
            S = Q @ np.swapaxes(J[:, k], 1, 2) @ by_orientation(view, X)
            C += (S * view.sigma**2) @ np.swapaxes(S, 1, 2)
    return C


def by_orientation(view: FrameView, X: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2 6"]:
    """∂(u, v)/∂(X0, Y0, Z0, ω, φ, κ) of points, pixels per object unit and radian."""
    return in_lanes(_derivative, view.frame, X)


@eqx.filter_jit
def _derivative(frame, X):
    angles = omega_phi_kappa_from_matrix(frame.M)

    def pixel(theta, X):
        M = matrix_from_omega_phi_kappa(theta[3:])
        moved = eqx.tree_at(lambda f: (f.X0, f.M), frame, (theta[:3], M))
        return pixel_of(moved, X)

    theta = jnp.concatenate([frame.X0, angles])
    return jax.vmap(jax.jacfwd(pixel), (None, 0))(theta, X)
