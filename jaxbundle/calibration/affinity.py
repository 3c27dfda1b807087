r"""Test for a missing affinity of the camera model.

`brown` and `brown-projected` have one principal distance; non-square pixels and shear are modelled
by b1 and b2, which are not estimated by default. Whether the residuals v (over their σ) require
them is tested by one step from the adjusted values, with all other unknowns adapting, S·b = −Bᵀ·v
(`observation_equations.lagrange_multipliers`); the cofactors of b are S⁻¹. This is the score
(Lagrange multiplier) test: no second adjustment is needed.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.result import Adjustment
from jaxbundle.calibration.observation_equations import lagrange_multipliers, linearise_image_points
from jaxbundle.cameras import get_model, is_own
from jaxbundle.display import print_in_one_screen
from jaxbundle.types import not_none

AFFINE = ("b1", "b2")


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class MissingAffinity:
    """Parameters that were held at 0: their estimates, σ, and the largest image displacement they
    cause, pixels."""

    names: tuple[str, ...]
    values: Float[np.ndarray, " k"]
    sigma: Float[np.ndarray, " k"]
    largest: float

    @property
    def missed(self) -> bool:
        # From 4 σ: σ0 contains the neglected affinity itself, and other errors of the model; by
        # chance once in 16 000.
        return bool((np.abs(self.values) > 4.0 * self.sigma).any())

    def __str__(self) -> str:
        values_in_words = ", ".join(
            f"{n} {b:.2g} ± {s:.1g}" for n, b, s in zip(self.names, self.values, self.sigma)
        )
        return (
            f"{' and '.join(self.names)} of the model are held, but the residuals require them "
            f"({values_in_words}): points are displaced by up to {self.largest:.2f} px; non-square "
            "pixels, or an affinity: free them (--free)"
        )


def find_missing_affinity(adjustment: Adjustment) -> MissingAffinity | None:
    """The affine parameters of an adjusted camera that are not free; None if it has none.

    **Arguments:** the adjustment of one camera, with `image_size` and `pixel_size`.
    """
    camera = adjustment.problem.network.cameras[0]
    model = get_model(camera.model)
    affine_names = () if is_own(model) else AFFINE
    names = tuple(n for n in affine_names if n in model.parameters and n not in camera.free)
    if not names or camera.pixel_size is None or not adjustment.sigma0 > 0:
        return None
    columns = tuple(model.parameters.index(name) for name in names)
    linearised = linearise_image_points(adjustment.problem, adjustment.values, columns)
    score, S = lagrange_multipliers(adjustment, linearised, linearised.by_columns)
    # S is the normal matrix of b after the elimination of all other unknowns (Schur): its inverse
    # is the cofactor matrix of b as if it had been estimated with them
    cofactor = np.linalg.inv(S)
    b = -cofactor @ score
    sigma = adjustment.sigma0 * np.sqrt(np.diagonal(cofactor))
    # Δx = b1·x̄ + b2·ȳ, largest in a corner
    half_size = np.multiply(not_none(camera.image_size), camera.pixel_size) / 2
    reach = [half_size[AFFINE.index(name)] for name in names]
    return MissingAffinity(names, b, sigma, float(np.abs(b) @ reach / camera.pixel_size[0]))
