"""Points at any distance in a result: direction and distance from the centre of the network."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.adjustment.problem import coordinates
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.display import print_in_one_screen
from jaxbundle.leastsquares.any_distance import is_at_infinity, shares
from jaxbundle.leastsquares.quality.error_components import Errors
from jaxbundle.types import not_none


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class FarPoints:
    """Points with a well-determined direction and a poorly determined distance.

    **Attributes:** `id`; `origin` [3] of the directions; `direction` [n, 3], unit
    vectors; `sigma_direction` [n, 2], the semi-axes of its ellipse across the ray, the larger one
    first (radians); `inverse_distance` and its σ (1/object unit), 0 and NaN for a point held at
    infinity; `at_infinity`. σ are those of the errors of the observations.
    """

    id: tuple[str, ...]
    origin: Float[np.ndarray, "3"]
    direction: Float[np.ndarray, "n 3"]
    sigma_direction: Float[np.ndarray, "n 2"]
    inverse_distance: Float[np.ndarray, " n"]
    sigma_inverse_distance: Float[np.ndarray, " n"]
    at_infinity: Bool[np.ndarray, " n"]

    @property
    def distance(self) -> Float[np.ndarray, " n"]:
        """From `origin`, object unit; infinite at infinity."""
        return _inverse(self.inverse_distance)

    @property
    def reach(self) -> Float[np.ndarray, "n 2"]:
        """The distances one σ nearer and farther, on the scale of the inverse distance; NaN for a
        point held at infinity."""
        # An interval of w is nearly symmetric about its estimate, one of 1/w is not.
        w, s = self.inverse_distance, self.sigma_inverse_distance
        return np.stack([_inverse(w + s), _inverse(np.maximum(w - s, 0.0))], 1)


def find_far_points(inspection: Inspection, errors: Errors) -> FarPoints | None:
    """The points at any distance of a solution; None if there are none."""
    problem = inspection.problem
    rows = np.flatnonzero(problem.at_any_distance & ~problem.excluded)
    if not len(rows):
        return None
    # The changes of such a row are two across its direction and one of the inverse distance w, all
    # without unit (`any_distance.shares`). σ of the direction is an ellipse, not two axes of X, Y,
    # Z.
    X = np.asarray(coordinates(inspection.adjusted))[rows]
    s = not_none(problem.lengths)[rows]
    share_across, share_along = shares(X, s)
    C = errors.covariance("point")[rows]
    ellipse = np.linalg.eigvalsh(C[:, :2, :2])[:, ::-1] * share_across[:, None] ** 2
    at_infinity = is_at_infinity(X, s)
    r = np.linalg.norm(X, axis=1)
    sigma = share_along * np.sqrt(np.clip(C[:, 2, 2], 0, None))
    ids = problem.network.points.id
    return FarPoints(
        tuple(ids[p] for p in rows),
        problem.origin,
        X / r[:, None],
        np.sqrt(np.clip(ellipse, 0, None)),
        np.where(at_infinity, 0.0, 1 / r),
        np.where(at_infinity & (sigma == 0), np.nan, sigma),
        at_infinity,
    )


def _inverse(w: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    with np.errstate(divide="ignore"):
        return 1 / w
