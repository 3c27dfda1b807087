"""Contribution of the orientation of images to the covariance of points.

A point depends on the orientations of its images θₖ: of a photograph (X0, Y0, Z0, ω, φ, κ, camera
parameters), of scanner and RPC images the unknowns of their refinement (`ground_orientation`), by

    dX = −N⁻¹·Σ Jₖᵀ·Bₖ·dθₖ,    N = Σ JₖᵀJₖ,    Jₖ = ∂(u, v)ₖ/∂X,    Bₖ = ∂(u, v)ₖ/∂θₖ,

so that C = ΣΣ Sₖ·Cₖₗ·Sₗᵀ with Sₖ = N⁻¹·Jₖᵀ·Bₖ. Cₖₗ is from an adjustment (`precision.csv`), or, of
photographs, diag(σ²) for k = l by the σ of images.csv, assumed uncorrelated, which is not true
after an adjustment: the true part may be smaller or larger. σ of 0, or none, adds nothing.

With W·Wᵀ = C the columns of S·W are the errors of a point for a unit of each independent error:
points that share images share them.
"""

import dataclasses
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.surfaces.scanner_views import GroundView
from jaxbundle.surfaces.views import FrameView, OrientedImage
from jaxbundle.system.cores import available_cores


def is_uncertain(view: OrientedImage) -> bool:
    """Whether an image has σ of its orientation."""
    return isinstance(view, FrameView | GroundView) and bool(_covariance(view, view).any())


@dataclasses.dataclass(frozen=True)
class OrientationErrors:
    """The independent errors of the orientations of some images; `uncertain`: by number those with
    σ; `root`: W, a row for each of their unknowns."""

    views: Sequence[OrientedImage]
    uncertain: tuple[int, ...]
    root: Float[np.ndarray, "unknowns k"]

    def factors(
        self, X: Float[np.ndarray, "n 3"], is_used: Bool[np.ndarray, "n views"]
    ) -> Float[np.ndarray, "n 3 k"]:
        """S·W of points."""
        T = np.zeros((len(X), 3, self.root.shape[1]))
        if not T.size:
            return T
        J = np.zeros((len(X), len(self.views), 2, 3))
        for k, view in enumerate(self.views):
            if is_used[:, k].any():
                J[is_used[:, k], k] = view.derivative(X[is_used[:, k]])
        N = np.einsum("nkij,nkil->njl", J, J)
        # Without a ray a point has no errors from any.
        scale = np.maximum(np.trace(N, axis1=1, axis2=2), 1e-300)[:, None, None]
        # Of a point with one ray, or parallel rays, N is singular: 1e-14 of its trace is added, 50
        # roundings, which changes no other point.
        Q = np.linalg.inv(N / scale + 1e-14 * np.eye(3)) / scale
        first_row = 0
        for k in self.uncertain:
            view, is_of_view = self.views[k], is_used[:, k]
            assert isinstance(view, FrameView | GroundView)
            rows = slice(first_row, first_row + len(view.unknowns))
            first_row = rows.stop
            if is_of_view.any():
                B = view.derivative_by_orientation(X[is_of_view])
                S = Q[is_of_view] @ np.swapaxes(J[is_of_view, k], 1, 2) @ B
                T[is_of_view] += (S.reshape(-1, S.shape[2]) @ self.root[rows]).reshape(
                    *S.shape[:2], -1
                )
        return T


def orientation_errors(views: Sequence[OrientedImage]) -> OrientationErrors:
    """The errors of the orientations of some images; none without σ."""
    uncertain = {
        k: view
        for k, view in enumerate(views)
        if isinstance(view, FrameView | GroundView) and is_uncertain(view)
    }
    if not uncertain:
        return OrientationErrors(views, (), np.zeros((0, 0)))
    joint = np.block(
        [[_covariance(view, other) for other in uncertain.values()] for view in uncertain.values()]
    )
    # C of a point is S·W·(S·W)ᵀ, symmetric and positive whatever the rounding
    root = _square_root(joint)
    # Held parameters have no errors; 1e-12 of a variance is its rounding.
    scale = np.maximum(np.sqrt(np.diagonal(joint)), 1e-300)
    root = root[:, np.max(np.abs(root / scale[:, None]), axis=0) > 1e-6]
    return OrientationErrors(views, tuple(uncertain), root)


def orientation_covariance(
    views: Sequence[OrientedImage],
    X: Float[np.ndarray, "n 3"],
    is_used: Bool[np.ndarray, "n views"],
) -> Float[np.ndarray, "n 3 3"]:
    """The covariance of points due to that of the orientations of their images."""
    C, errors = np.zeros((len(X), 3, 3)), orientation_errors(views)
    if not errors.uncertain:
        return C
    points_at_once = _points_at_once(errors)

    def compute(begin: int) -> None:
        rows = slice(begin, begin + points_at_once)
        factor = errors.factors(X[rows], is_used[rows])
        C[rows] = factor @ np.swapaxes(factor, 1, 2)

    with ThreadPoolExecutor(available_cores()) as pool:
        list(pool.map(compute, range(0, len(X), points_at_once)))
    return C


def orientation_modes(
    views: Sequence[OrientedImage] | OrientationErrors,
    X: Float[np.ndarray, "n 3"],
    is_used: Bool[np.ndarray, "n views"],
    direction: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n k"]:
    """The errors of points along a direction for a unit of each independent error of the
    orientations, S·W: points that share images share them, and M·Mᵀ is their covariance."""
    errors = views if isinstance(views, OrientationErrors) else orientation_errors(views)
    M = np.zeros((len(X), errors.root.shape[1]))
    points_at_once = _points_at_once(errors)

    def compute(begin: int) -> None:
        rows = slice(begin, begin + points_at_once)
        M[rows] = np.einsum("ni,nik->nk", direction[rows], errors.factors(X[rows], is_used[rows]))

    with ThreadPoolExecutor(available_cores()) as pool:
        list(pool.map(compute, range(0, len(X), points_at_once)))
    return M


def _points_at_once(errors: OrientationErrors) -> int:
    """Points whose S·W are computed together."""
    # 4 million numbers, 34 MB a core: 32 768 points of seven photographs, fewer of a large block
    return max(256, min(1 << 15, (1 << 22) // max(3 * errors.root.shape[1], 1)))


def _square_root(C: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """A matrix W with W·Wᵀ = C, of units as different as those of orientations."""
    unit = np.sqrt(np.diagonal(C))
    scale = np.where(unit > 0, unit, 1.0)
    values, vectors = np.linalg.eigh(C / np.outer(scale, scale))
    return scale[:, None] * vectors * np.sqrt(np.maximum(values, 0))


def _covariance(
    view: FrameView | GroundView, other: FrameView | GroundView
) -> Float[np.ndarray, "k l"]:
    """Covariance between the orientations of two images, cameras included."""
    if view.joint is not None and view.joint is other.joint:
        rows, columns = (view.joint.index(v.unknowns) for v in (view, other))
        # −1: fixed in the adjustment
        C = view.joint.matrix[np.ix_(rows, columns)]
        return C * (rows >= 0)[:, None] * (columns >= 0)
    C = np.zeros((len(view.unknowns), len(other.unknowns)))
    if view is other and view.joint is None and isinstance(view, FrameView):
        C[:6, :6] = np.diag(view.sigma**2)
    return C
