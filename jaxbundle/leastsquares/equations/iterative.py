"""The reduced system without its matrix: preconditioned conjugate gradients.

S = A − Zᵀ·Z is only applied to vectors (Agarwal et al. 2010): Z·x spreads changes of kept rows over
their incidences, Zᵀ gathers them again. No pair of incidences is ever listed, so time and memory
grow with the incidences alone. The blocks of S of every kept row, L·Lᵀ, are the preconditioner
(Schur–Jacobi):

    (L⁻¹·S·L⁻ᵀ)·y = L⁻¹·b,   x = L⁻ᵀ·y,

where every element of y is a change in units of its conditional σ, so that one norm fits all. A
problem that may float is singular but consistent, which conjugate gradients tolerate.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Float, Int

from jaxbundle.leastsquares.equations.normal import (
    Normal,
    average_over_devices,
    gather,
    scatter,
    times_kept,
)
from jaxbundle.leastsquares.equations.reduced import Reduced
from jaxbundle.leastsquares.indexing.plan import Tangent


class ConjugateGradients(eqx.Module):
    """S = A − Zᵀ·Z scaled, applied to vectors, and L⁻¹ of its diagonal blocks.

    - `tolerance`: the norm of the residual relative to that of the right-hand side.
    - `reachable`: the relative residual that rounding allows in one run. Below it the search
      directions are noise, and steps may drift, above all along open motions. Solutions with a
      smaller `tolerance` are refined once more. A solution that misses both is NaN.
    - `max_steps`, `max_refinement_steps`: more show that the system cannot be solved so. In exact
      arithmetic conjugate gradients end after as many steps as unknowns; a tolerance of 1e-2 takes
      some tens.
    """

    normal: Normal
    Z: dict[str, Float[Array, "chunks length w v"]]
    scale: Tangent
    lower_inverse: dict[str, Float[Array, "rows w w"]]
    tolerance: float = eqx.field(static=True)
    reachable: float = eqx.field(static=True, default=1e-10)
    max_steps: int = eqx.field(static=True, default=2000)
    max_refinement_steps: int = eqx.field(static=True, default=100)

    def solve(self, b: Tangent) -> Tangent:
        times = lambda indices, x: {
            g: jnp.einsum(indices, M, x[g]) for g, M in self.lower_inverse.items()
        }
        # One preconditioner on both sides keeps the operator symmetric. The residual is then in
        # units of σ with all else given, radians beside metres: one norm, one tolerance.
        scale, scale_back = (lambda x: times("nij,nj->ni", x)), (lambda x: times("nji,nj->ni", x))
        right, tag = scale(b), lx.positive_semidefinite_tag
        product = lambda y: scale(self._times(scale_back(y)))
        operator = lx.FunctionLinearOperator(product, jax.eval_shape(lambda: right), tag)

        def improved(
            y: Tangent, residual: Tangent, tolerance: float, steps: int
        ) -> tuple[Tangent, Tangent]:
            """y refined with the residual `residual`, if that decreases it; and the new
            residual."""
            # Lineax annotates a float, but accepts an array. 1e-300: a right-hand side of zeros
            # has its solution at once, instead of 0/0.
            limit: Any = jnp.maximum(tolerance * optx.two_norm(residual), 1e-300)
            method = lx.CG(rtol=0.0, atol=limit, norm=optx.two_norm, max_steps=steps)
            change = lx.linear_solve(operator, residual, method, throw=False).value
            better = jax.tree.map(jnp.add, y, change)
            residual_after = jax.tree.map(jnp.subtract, right, product(better))
            # Near the limit of rounding a run may end worse than it began.
            is_smaller = optx.two_norm(residual_after) < optx.two_norm(residual)
            return jax.tree.map(
                partial(jnp.where, is_smaller), (better, residual_after), (y, residual)
            )

        nothing = jax.tree.map(jnp.zeros_like, right)
        reached = max(self.tolerance, self.reachable)
        # Iterative refinement: the second run solves for the error of the first, whose residual is
        # computed from scratch. One run to the full tolerance would iterate on rounding.
        y, residual = improved(nothing, right, reached, self.max_steps)
        if self.tolerance < self.reachable:
            reachable_tolerance = self.tolerance / self.reachable
            y, residual = improved(y, residual, reachable_tolerance, self.max_refinement_steps)
        # NaN if it is not solved: the step is rejected, and more damping makes it easier. Half a
        # step would be taken for the whole one, a step of zero for the end of the iterations.
        # Twice: the residual is computed anew, not by the recursion that met the limit.
        solved = optx.two_norm(residual) <= 2 * reached * optx.two_norm(right)
        return scale_back(jax.tree.map(lambda x: jnp.where(solved, x, jnp.nan), y))

    def inverse(self) -> Reduced:
        raise ValueError(
            "conjugate gradients have no factor to read an inverse from; see `problem.with_factor`"
        )

    @property
    def pivots(self) -> Float[Array, " n"]:
        """The pivots of every block alone."""
        inverses = [jnp.diagonal(M, axis1=1, axis2=2).ravel() for M in self.lower_inverse.values()]
        return 1 / jnp.concatenate(inverses)

    def _times(self, x: Tangent) -> Tangent:
        """S·x."""
        plan = self.normal.plan
        x = {g: rows * self.scale[g] for g, rows in x.items()}
        product = times_kept(plan, self.normal.blocks, x)
        for g, subtrahend in gather(plan, self.Z, scatter(plan, self.Z, x)).items():
            product[g] = product[g] - subtrahend
        return average_over_devices(plan, {g: rows * self.scale[g] for g, rows in product.items()})


def precondition(
    normal: Normal,
    Z: dict[str, Float[Array, "chunks length w v"]],
    S: Reduced,
    scale: Tangent,
    tolerance: float,
) -> ConjugateGradients:
    """S for conjugate gradients, `S.diagonal_blocks` its diagonal blocks scaled."""
    lower_inverse = {g: inverse_of_lower(B) for g, B in S.diagonal_blocks.items()}
    return ConjugateGradients(normal, Z, scale, lower_inverse, tolerance)


def inverse_of_lower(B: Float[Array, "rows w w"]) -> Float[Array, "rows w w"]:
    """L⁻¹ of B = L·Lᵀ: elimination transforms (B, 1) to (Lᵀ, L⁻¹); NaN if B is not positive
    definite.

    A loop over the w columns: LAPACK's loop over the rows waits inside the thread pool, where
    the programs of several devices could deadlock.
    """
    w = B.shape[1]

    # Gaussian elimination without pivoting, which a positive definite matrix does not need.
    def eliminate(
        k: Int[Array, ""], augmented: Float[Array, "rows w v"]
    ) -> Float[Array, "rows w v"]:
        row = augmented[:, k] / jnp.sqrt(augmented[:, k, k])[:, None]
        below_pivot = jnp.where(jnp.arange(w) > k, row[:, :w], 0.0)
        return (augmented - below_pivot[:, :, None] * row[:, None]).at[:, k].set(row)

    augmented = jnp.concatenate([B, jnp.broadcast_to(jnp.eye(w), B.shape)], -1)
    return jax.lax.fori_loop(0, w, eliminate, augmented)[:, :, w:]
