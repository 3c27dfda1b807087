"""The reduced system S·x = b of images, cameras and kept points, assembled, scaled, factorised.

Dense, by one Cholesky factorisation, here; or banded (`banded.py`); or not at all, by conjugate
gradients (`iterative.py`). S is scaled to a unit diagonal (before elimination of the points). What
is held gets a one there.

A free network is singular along its datum directions G (similarities). They are made regular by
adding a one to as many diagonal elements, those of images far apart (`Structure.pins`): the
solution changes along G only.
"""

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float

from jaxbundle.adjustment.banded import factorise_band
from jaxbundle.adjustment.cholesky import cholesky_of_lower
from jaxbundle.adjustment.parts import Parts, parts_of
from jaxbundle.network.structure import Structure


class DenseFactor(eqx.Module):
    """S = L·Lᵀ, scaled."""

    structure: Structure
    lower: Float[Array, "n n"]
    scale: Float[Array, " n"]

    def solve(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        """S⁻¹·b."""
        return cho_solve((self.lower, True), b * self.scale) * self.scale

    def inverse(self) -> Parts:
        """The blocks of S⁻¹ where S has blocks."""
        Q = cho_solve((self.lower, True), jnp.diag(self.scale)) * self.scale[:, None]
        return parts_of(self.structure, Q)

    @property
    def pivots(self) -> Float[Array, " n"]:
        """Square roots of the pivots, 1 without correlation, 0 without determination."""
        return jnp.diagonal(self.lower)


def factorise_reduced(structure: Structure, parts: Parts, scale, free, regular=True):
    """The factor of S; NaN where it is not positive definite.

    **Arguments:** `scale` [n], `free` [n] (0: held); `regular`: whether to make the datum
    directions regular.
    """
    if structure.reduction == "banded":
        return factorise_band(structure, parts, scale, free, regular)
    S = dense_matrix(structure, parts, scale, free, regular)
    lower = cholesky_of_lower(S)
    return DenseFactor(structure, lower, scale)


def dense_matrix(
    structure: Structure, parts: Parts, scale, free, regular=True
) -> Float[Array, "n n"]:
    """S scaled, its datum directions made regular; only its lower triangle is right."""
    s = structure
    I, w, q = s.images, s.image_width, parts.corner.shape[0]
    index = jnp.arange(I)
    S = jnp.zeros((I, I, w, w))
    S = S.at[s.image_pairs.column, s.image_pairs.row].add(parts.pairs.transpose(0, 2, 1))
    S = S.at[index, index].add(parts.own).transpose(0, 2, 1, 3).reshape(I * w, I * w)
    if q:
        S = jnp.concatenate([jnp.pad(S, ((0, 0), (0, q))),
                             jnp.concatenate([parts.border, parts.corner], 1)])  # fmt: skip
    S = S * scale[:, None] * scale[None, :]
    more = jnp.where(free > 0, 0.0, 1.0)
    if s.defect:
        more = more.at[: I * w].add(regular * s.pins.ravel())
    return S + jnp.diag(more)
