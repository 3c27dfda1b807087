r"""The affinity a camera model has but was not given: is it missed?

`brown` and `brown-projected` have one principal distance; pixels that are not square, or a shear,
are left to b1 and b2, which a calibration does not estimate unless asked. Whether the residuals v
(over their σ) miss them is told by one step from the adjusted values, all other unknowns moving
with it,

    S·b = −Bᵀ·v,      S = BᵀB − (JᵀB)ᵀ·Q·(JᵀB)

with B = ∂v/∂b, J = ∂v/∂unknowns, Q their cofactors; the cofactors of b are S⁻¹. It is the score
(Lagrange multiplier) test: no second adjustment is needed.

Source: Rao (1948), Proceedings of the Cambridge Philosophical Society 44, 50-57.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment import residuals
from jaxbundle.adjustment.jacobian import zero_tangent
from jaxbundle.cameras import get_model, is_own
from jaxbundle.network.arrays import retract

AFFINE = ("b1", "b2")
CRITICAL = 4.0
"""|b|/σ above which a parameter is missed."""


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
    problem = adjustment.problem
    B, v, rows = _rows(problem.structure, columns, adjustment.values, problem.data)
    B, v = np.asarray(B), np.asarray(v)
    S = B @ B.T - np.asarray(adjustment.inspection.propagate(rows))
    cofactor = np.linalg.inv(S)
    b = -cofactor @ (B @ v)
    sigma = adjustment.sigma0 * np.sqrt(np.diagonal(cofactor))
    # Δx = b1·x̄ + b2·ȳ, largest in a corner
    half = np.multiply(given.image_size, given.pixel_size) / 2
    reach = [half[AFFINE.index(name)] for name in names]
    return LeftOut(names, b, sigma, float(np.abs(b) @ reach / given.pixel_size[0]))


@eqx.filter_jit
def _rows(structure, columns, values, data):
    """B [k, n], v [n] and JᵀB as k rows of the unknowns' tangents."""

    def of(tangent, b):
        at = retract(structure, values, tangent)
        moved = at.camera.at[0, jnp.array(columns)].add(b)
        at = dataclasses.replace(at, camera=moved)
        return residuals(structure, at, data).image.ravel()

    zero, none = zero_tangent(structure), jnp.zeros(len(columns))
    v = of(zero, none)
    B = jax.jacfwd(of, 1)(zero, none).T
    _, back = jax.vjp(lambda tangent: of(tangent, none), zero)
    rows = jax.vmap(lambda column: back(column)[0])(B)
    return B, v, rows
