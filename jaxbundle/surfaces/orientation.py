"""Contribution of the orientation of photographs to the covariance of points.

A point depends on the orientations of its images θₖ = (X0, Y0, Z0, ω, φ, κ, camera parameters) by

    dX = −N⁻¹·Σ Jₖᵀ·Bₖ·dθₖ,    N = Σ JₖᵀJₖ,    Jₖ = ∂(u, v)ₖ/∂X,    Bₖ = ∂(u, v)ₖ/∂θₖ,

so that C = ΣΣ Sₖ·Cₖₗ·Sₗᵀ with Sₖ = N⁻¹·Jₖᵀ·Bₖ. Cₖₗ is from an adjustment (`precision.csv`), or
diag(σ²) for k = l by the σ of images.csv, assumed uncorrelated, which is not true after an
adjustment: the true part may be smaller or larger. σ of 0, or none, adds nothing.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbundle.geometry import matrix_from_omega_phi_kappa, omega_phi_kappa_from_matrix
from jaxbundle.surfaces.views import (
    FrameView,
    OrientedImage,
    PhotographFrame,
    pixel_of,
    run_in_lanes,
)
from jaxbundle.system.cores import available_cores
from jaxbundle.system.programs import compile_once


def is_uncertain(view: OrientedImage) -> bool:
    """Whether an image has σ of its orientation."""
    return isinstance(view, FrameView) and bool(_covariance(view, view).any())


def orientation_covariance(
    views: Sequence[OrientedImage],
    X: Float[np.ndarray, "n 3"],
    used: Bool[np.ndarray, "n views"],
) -> Float[np.ndarray, "n 3 3"]:
    """The covariance of points due to that of the orientations of their images."""
    C = np.zeros((len(X), 3, 3))

    def add(rows: slice, factor: Float[np.ndarray, "n 3 k"]) -> None:
        C[rows] = factor @ np.swapaxes(factor, 1, 2)

    _each_factor(views, X, used, add)
    return C


def orientation_modes(
    views: Sequence[OrientedImage],
    X: Float[np.ndarray, "n 3"],
    used: Bool[np.ndarray, "n views"],
    direction: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n k"]:
    """The errors of points along a direction for a unit of each independent error of the
    orientations, S·W: points that share images share them, and M·Mᵀ is their covariance."""
    parts: dict[int, np.ndarray] = {}

    def add(rows: slice, factor: Float[np.ndarray, "n 3 k"]) -> None:
        parts[rows.start] = np.einsum("ni,nik->nk", direction[rows], factor)

    _each_factor(views, X, used, add)
    return np.concatenate([parts[k] for k in sorted(parts)]) if parts else np.zeros((len(X), 0))


def _each_factor(
    views: Sequence[OrientedImage],
    X: Float[np.ndarray, "n 3"],
    used: Bool[np.ndarray, "n views"],
    add: Callable[[slice, Float[np.ndarray, "n 3 k"]], None],
) -> None:
    """Call `add` with rows of the points and their S·W; not at all without σ of orientations."""
    uncertain = {
        k: view
        for k, view in enumerate(views)
        if isinstance(view, FrameView) and is_uncertain(view)
    }
    if not uncertain:
        return
    joint = np.block(
        [[_covariance(view, other) for other in uncertain.values()] for view in uncertain.values()]
    )
    # C of a point is S·W·(S·W)ᵀ, symmetric and positive whatever the rounding
    root = _square_root(joint)
    # held parameters have no errors; 1e-12 of a variance is its rounding
    scale = np.maximum(np.sqrt(np.diagonal(joint)), 1e-300)
    root = root[:, np.max(np.abs(root / scale[:, None]), axis=0) > 1e-6]
    # the matrices S of 32 768 points and four photographs take 20 MB a core
    together = 1 << 15

    def compute(first: int) -> None:
        rows = slice(first, first + together)
        T = _differentiate_points(views, uncertain, X[rows], used[rows])
        add(rows, (T.reshape(-1, len(root)) @ root).reshape(len(T), 3, -1))

    with ThreadPoolExecutor(available_cores()) as pool:
        list(pool.map(compute, range(0, len(X), together)))


def _square_root(C: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """A matrix W with W·Wᵀ = C, of units as different as those of orientations."""
    unit = np.sqrt(np.diagonal(C))
    scale = np.where(unit > 0, unit, 1.0)
    values, vectors = np.linalg.eigh(C / np.outer(scale, scale))
    return scale[:, None] * vectors * np.sqrt(np.maximum(values, 0))


def _differentiate_points(
    views: Sequence[OrientedImage],
    uncertain: Mapping[int, FrameView],
    X: Float[np.ndarray, "n 3"],
    used: Bool[np.ndarray, "n views"],
) -> Float[np.ndarray, "n 3 k"]:
    """The matrices Sₖ of these views, side by side."""
    J = np.stack([view.derivative(X) for view in views], 1) * used[:, :, None, None]
    N = np.einsum("nkij,nkil->njl", J, J)
    scale = np.trace(N, axis1=1, axis2=2)[:, None, None]
    # of a point with one ray, or parallel rays, N is singular: 1e-14 of its trace is added, 50
    # roundings, which changes no other point
    Q = np.linalg.inv(N / scale + 1e-14 * np.eye(3)) / scale
    return np.concatenate(
        [
            Q @ np.swapaxes(J[:, k], 1, 2) @ derivative_by_orientation(view, X)
            for k, view in uncertain.items()
        ],
        axis=2,
    )


def _covariance(view: FrameView, other: FrameView) -> Float[np.ndarray, "k l"]:
    """Covariance between the orientations of two photographs, cameras included."""
    if view.joint is not None and view.joint is other.joint:
        rows, columns = (
            view.joint.rows(v.name, v.camera.id, v.frame.model.parameters) for v in (view, other)
        )
        # −1: fixed in the adjustment
        C = view.joint.matrix[np.ix_(rows, columns)]
        return C * (rows >= 0)[:, None] * (columns >= 0)
    C = np.zeros((6 + len(view.frame.p), 6 + len(other.frame.p)))
    if view is other and view.joint is None:
        C[:6, :6] = np.diag(view.sigma**2)
    return C


def derivative_by_orientation(
    view: FrameView, X: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 2 k"]:
    """∂(u, v)/∂(X0, Y0, Z0, ω, φ, κ, parameters) of points, pixels per object unit, radian, unit of
    the parameter."""
    return run_in_lanes(_derivative, view.frame, X)


@compile_once
def _derivative(frame: PhotographFrame, X: Float[Array, "n 3"]) -> Float[Array, "n 2 k"]:
    angles = omega_phi_kappa_from_matrix(frame.M)

    def pixel(theta: Float[Array, " k"], X: Float[Array, "3"]) -> Float[Array, "2"]:
        M = matrix_from_omega_phi_kappa(theta[3:6])
        moved = eqx.tree_at(lambda f: (f.X0, f.M, f.p), frame, (theta[:3], M, theta[6:]))
        return pixel_of(moved, X)

    theta = jnp.concatenate([frame.X0, angles, frame.p])
    return jax.vmap(jax.jacfwd(pixel), (None, 0))(theta, X)
