r"""The affinity a camera model has but was not given: is it missed?

`brown` and `brown-projected` have one principal distance; pixels that are not square, or a shear,
are left to b1 and b2, which a calibration does not estimate unless asked. Whether the residuals v
(over their σ) miss them is told by one step from the adjusted values, all other unknowns moving
with it, S·b = −Bᵀ·v (`linearised.lagrange_multipliers`); the cofactors of b are S⁻¹. It is the
score (Lagrange multiplier) test: no second adjustment is needed.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxbundle.calibration.linearised import lagrange_multipliers, linearise_image_points
from jaxbundle.cameras import get_model, is_own
from jaxbundle.display import shows_itself

AFFINE = ("b1", "b2")
CRITICAL = 4.0
"""|b|/σ above which a parameter is missed."""


@shows_itself
@dataclasses.dataclass(frozen=True)
class LeftOut:
    """Parameters that were held at 0: what they would be, σ, and the largest displacement of a
    point in the image they stand for, pixels."""

    names: tuple[str, ...]
    values: Float[np.ndarray, " k"]
    sigma: Float[np.ndarray, " k"]
    largest: float

    @property
    def missed(self) -> bool:
        return bool((np.abs(self.values) > CRITICAL * self.sigma).any())

    def __str__(self) -> str:
        each = ", ".join(
            f"{n} {b:.2g} ± {s:.1g}" for n, b, s in zip(self.names, self.values, self.sigma)
        )
        return (
            f"{' and '.join(self.names)} of the model are left out, and the residuals ask for them "
            f"({each}): points are displaced by up to {self.largest:.2f} px; pixels that are not "
            "square, or an affinity: free them (--free)"
        )


def left_out(adjustment) -> LeftOut | None:
    """The affine parameters of an adjusted camera that are not free; None where it has none.

    **Arguments:** the adjustment of one camera, with `image_size` and `pixel_size`.
    """
    given = adjustment.problem.network.cameras[0]
    model = get_model(given.model)
    known = () if is_own(model) else AFFINE
    names = tuple(n for n in known if n in model.parameters and n not in given.free)
    if not names or given.pixel_size is None or not adjustment.sigma0 > 0:
        return None
    columns = tuple(model.parameters.index(name) for name in names)
    found = linearise_image_points(adjustment.problem, adjustment.values, columns)
    score, S = lagrange_multipliers(adjustment, found, found.by_columns)
    cofactor = np.linalg.inv(S)
    b = -cofactor @ score
    sigma = adjustment.sigma0 * np.sqrt(np.diagonal(cofactor))
    # Δx = b1·x̄ + b2·ȳ, largest in a corner
    half = np.multiply(given.image_size, given.pixel_size) / 2
    reach = [half[AFFINE.index(name)] for name in names]
    return LeftOut(names, b, sigma, float(np.abs(b) @ reach / given.pixel_size[0]))
