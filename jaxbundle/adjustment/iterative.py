"""The reduced system without its matrix: preconditioned conjugate gradients.

S = A − ZᵀZ is only applied to vectors (Agarwal et al. 2010): Z·x spreads changes of images over the
rays of every point, Zᵀ gathers them again. No pair of rays is ever listed, so time and memory grow
with the rays alone. The rows of cameras and kept points, few, are there as matrices.

The blocks of S of every image, L·Lᵀ, precondition (Schur–Jacobi): solved is

    (L⁻¹·S·L⁻ᵀ)·y = L⁻¹·b,   x = L⁻ᵀ·y,

where every element of y is a change in units of its conditional σ, so that one norm measures all.
A free network is singular but consistent, which conjugate gradients do not mind.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from jaxbundle.adjustment.cholesky import cholesky_of_lower
from jaxbundle.adjustment.parts import Parts, to_images, to_points
from jaxbundle.network.structure import Structure

MOST_STEPS = 2000
"""Steps of conjugate gradients after which what was found so far is taken."""
LEAST = 1e-300


class ConjugateGradients(eqx.Module):
    """S applied to vectors, and the factors of its diagonal blocks, scaled.

    `tolerance`: the norm of the residual relative to that of the right-hand side."""

    structure: Structure
    image: Float[Array, "images w w"]
    ray: Float[Array, "rays 3 w"]
    border: Float[Array, "q images_w"]
    corner: Float[Array, "q q"]
    free: Float[Array, " n"]
    image_lower: Float[Array, "images w w"]
    corner_lower: Float[Array, "q q"]
    scale: Float[Array, " n"]
    tolerance: float = eqx.field(static=True)

    def solve(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        """S⁻¹·b to the tolerance."""
        right = self._divided(b)
        operator = lx.FunctionLinearOperator(
            lambda y: self._divided(self._times(self._divided(y, transposed=True))),
            jax.eval_shape(lambda: right),
            lx.positive_semidefinite_tag,
        )
        limit = jnp.maximum(self.tolerance * jnp.linalg.norm(right), LEAST)
        method = lx.CG(rtol=0.0, atol=limit, norm=optx.two_norm, max_steps=MOST_STEPS)
        y = lx.linear_solve(operator, right, method, throw=False).value
        return self._divided(y, transposed=True)

    @property
    def pivots(self) -> Float[Array, " n"]:
        """Square roots of the pivots of every block by itself."""
        images = jnp.diagonal(self.image_lower, axis1=1, axis2=2)
        return jnp.concatenate([images.ravel(), jnp.diagonal(self.corner_lower)])

    def _split(self, x):
        s = self.structure
        n = s.images * s.image_width
        return x[:n].reshape(s.images, s.image_width), x[n:]

    def _times(self, x):
        """S·x."""
        s = self.structure
        image, rest = self._split(x)
        gathered = to_images(s, self.ray, to_points(s, self.ray, image))
        y = jnp.einsum("nij,nj->ni", self.image, image) - s.total(gathered)
        y = y + (rest @ self.border).reshape(y.shape)
        rest = self.border @ image.ravel() + self.corner @ rest
        return s.agreed(jnp.concatenate([y.ravel(), rest])) + (1 - self.free) * x

    def _divided(self, x, transposed: bool = False):
        """L⁻¹·x of the diagonal blocks, or L⁻ᵀ·x."""
        trans = 1 if transposed else 0
        x = x if transposed else x * self.scale
        image, rest = self._split(x)
        divide = lambda L, b: solve_triangular(L, b, lower=True, trans=trans)
        image = jax.vmap(divide)(self.image_lower, image)
        rest = divide(self.corner_lower, rest) if rest.size else rest
        x = jnp.concatenate([image.ravel(), rest])
        return x * self.scale if transposed else x


def precondition(
    structure: Structure, parts: Parts, image, ray, scale, free, tolerance: float
) -> ConjugateGradients:
    """S for conjugate gradients; `parts` without pairs, `image`: the blocks of A, `ray`: Z."""
    s, n = structure, structure.images * structure.image_width
    held = lambda free: jnp.where(free > 0, 0.0, 1.0)
    of_images = lambda x: x[:n].reshape(s.images, s.image_width)
    scales, rest = of_images(scale), scale[n:]
    own = parts.own * scales[:, :, None] * scales[:, None, :]
    own = own + jax.vmap(jnp.diag)(held(of_images(free)))
    corner = parts.corner * rest[:, None] * rest[None, :] + jnp.diag(held(free[n:]))
    return ConjugateGradients(
        s, image, ray, parts.border, parts.corner, free, cholesky_of_lower(own),
        cholesky_of_lower(corner), scale, tolerance,
    )  # fmt: skip
