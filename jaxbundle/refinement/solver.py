"""Marquardt's method for few images and many points, carried by optimistix.

The equations are those of `optimistix.AbstractGaussNewton` under a trust region; ours is the
descent. With J = [A B], A by the m shared unknowns and B by the three of the one point that a row
touches, the columns of all points are found by three products with J, those of A by m. Points are
eliminated,

    V_p = Σ BᵀB,   W_p = Σ BᵀA,   Ã = A − B·V_p⁻¹·W_p,   (ÃᵀÃ)·δ = −Ãᵀv,   δ_p = −V_p⁻¹·(Σ Bᵀv + W_p·δ)

and the reduced system is dense. Damping adds λ·diag(N) (Marquardt, 1963).

It has *settled* when d² = gᵀN⁻¹g ≤ (`atol`·σ₀)², without damping: no unknown would move by more
than `atol` of its σ. A system that cannot be solved without damping therefore never settles. Less
cannot be asked of the trust region: Earth-fixed coordinates are rounded to a nanometre, and vᵀPv
with them. One step without damping (`polished`) takes away what is left.
"""  # noqa: E501

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Bool, Float, Int

from jaxbundle.adjustment.small_cholesky import backward, cholesky, forward, rows_of
from jaxbundle.refinement.equations import System, Unknowns, compiled_rescaled, residuals

DAMPING = 1e-4
"""λ of the first step."""
LEAST_SIGMA0 = 1e-2
"""σ₀ below this counts as this: data without noise settle, too."""


class Rows(eqx.Module):
    """The Jacobian: A, B and the point of every row."""

    shared: Float[Array, "rows m"]
    point: Float[Array, "rows 3"]
    of: Int[Array, " rows"]


def points_of_rows(system: System) -> Int[Array, " rows"]:
    """The point that each row touches; rows that touch none have B = 0."""
    parts = [jnp.repeat(rays.point, 2) for rays in system.rays]
    parts.append(jnp.repeat(jnp.arange(system.X.shape[0]), 3))
    rest = system.prior.shape[0] + 6 * len(system.frames)
    return jnp.concatenate([*parts, jnp.zeros(rest, int)])


def jacobian(times: Callable, system: System) -> Rows:
    """The Jacobian from products with it, `times(Unknowns)`."""
    m, P = system.prior.shape[0], system.X.shape[0]
    by_shared = lambda e: times(Unknowns(e, jnp.zeros((P, 3))))
    by_point = lambda e: times(Unknowns(jnp.zeros(m), jnp.tile(e, (P, 1))))
    A = jax.vmap(by_shared, out_axes=1)(jnp.eye(m))
    B = jax.vmap(by_point, out_axes=1)(jnp.eye(3))
    return Rows(A, B, points_of_rows(system))


class Reduced(eqx.Module):
    """The normal equations after elimination of the points: S = ÃᵀÃ + λD of the shared unknowns.

    `lower` the factor of S scaled by `scale`; `points` those of V_p.
    """

    tilde: Float[Array, "rows m"]
    coupling: Float[Array, "points 3 m"]
    points: Float[Array, "points 3 3"]
    lower: Float[Array, "m m"]
    scale: Float[Array, " m"]
    jacobian: Rows

    def step(self, v: Float[Array, " rows"]) -> Unknowns:
        """−N⁻¹·Jᵀv; NaN if N is singular."""
        J = self.jacobian
        Bv = jax.ops.segment_sum(J.point * v[:, None], J.of, self.points.shape[0])
        right = J.shared.T @ v - jnp.einsum("pim,pi->m", self.coupling, self._by_points(Bv))
        shared = -self.scale * cho_solve((self.lower, True), self.scale * right)
        return Unknowns(shared, -self._by_points(Bv + self.coupling @ shared))

    def _by_points(self, b):
        """V_p⁻¹·b_p."""
        return _solve_points(self.points, b)

    @property
    def cofactor(self) -> Float[Array, "m m"]:
        """Q = S⁻¹."""
        Q = cho_solve((self.lower, True), jnp.eye(self.scale.shape[0]))
        return Q * self.scale * self.scale[:, None]

    @property
    def point_cofactor(self) -> Float[Array, "points 3 3"]:
        """V_p⁻¹."""
        identity = jnp.broadcast_to(jnp.eye(3), self.points.shape)
        return _solve_points(self.points, identity)


def reduce(J: Rows, free: Float[Array, "points 3"], damping: Float[Array, ""]) -> Reduced:
    """Form the normal equations, damp them, eliminate the points."""
    P = free.shape[0]
    sums = lambda rows: jax.ops.segment_sum(rows, J.of, P)
    V = sums(J.point[:, :, None] * J.point[:, None, :])
    diagonal = jnp.diagonal(V, axis1=1, axis2=2)
    more = jnp.where(free > 0, damping * diagonal, 1.0)
    V = V + more[:, :, None] * jnp.eye(3)
    W = sums(J.point[:, :, None] * J.shared[:, None, :])
    VW = _solve_points(V, W)
    tilde = J.shared - jnp.einsum("ri,rim->rm", J.point, VW[J.of])
    # not ÃᵀÃ: with damping B·V⁻¹ is no projection
    N = J.shared.T @ J.shared
    D = jnp.where(jnp.diagonal(N) > 0, jnp.diagonal(N), 1.0)
    S = N - jnp.einsum("pim,pin->mn", W, VW) + damping * jnp.diag(D)
    scale = 1 / jnp.sqrt(D)
    lower = jnp.linalg.cholesky(S * scale * scale[:, None])
    return Reduced(tilde, W, V, lower, scale, J)


def _solve_points(V, b):
    """V_p⁻¹·b_p of all points, scaled to a unit diagonal; b [points, 3] or [points, 3, k]."""
    diagonal = jnp.diagonal(V, axis1=1, axis2=2)
    scale = 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))
    L = cholesky(rows_of(V * scale[:, :, None] * scale[:, None, :]))
    if b.ndim == 2:
        columns = [b[:, i] * scale[:, i] for i in range(3)]
        x = backward(L, forward(L, columns))
        return jnp.stack(x, 1) * scale
    columns = [(b[:, i] * scale[:, i, None]).T for i in range(3)]
    x = backward(L, forward(L, columns))
    return jnp.stack([c.T for c in x], 1) * scale[:, :, None]


class Damped(eqx.Module):
    """What the descent knows at the accepted unknowns."""

    jacobian: Rows
    v: Float[Array, " rows"]
    decrement: Float[Array, ""]


class PointDescent(optx.AbstractDescent):
    """The step −(N + λD)⁻¹g by elimination of the points; λ = `DAMPING`/step size."""

    system: System

    def init(self, y, f_info_struct):
        rows, m = f_info_struct.residual.shape[0], self.system.prior.shape[0]
        J = Rows(jnp.zeros((rows, m)), jnp.zeros((rows, 3)), points_of_rows(self.system))
        return Damped(J, jnp.zeros(rows), jnp.asarray(jnp.inf))

    def query(self, y, f_info, state):
        J = jacobian(f_info.jac.mv, self.system)
        v = f_info.residual
        step = reduce(J, self.system.free, jnp.asarray(0.0)).step(v)
        decrement = -jnp.vdot(f_info.jac.mv(step), v)
        return Damped(J, v, jnp.where(jnp.isfinite(decrement), decrement, jnp.inf))

    def step(self, step_size, state):
        reduced = reduce(state.jacobian, self.system.free, DAMPING / step_size)
        step = reduced.step(state.v)
        finite = jax.tree.map(lambda d: jnp.where(jnp.isfinite(d), d, 0.0), step)
        return finite, optx.RESULTS.successful


class PointSolver(optx.AbstractGaussNewton):
    """Gauss–Newton by `PointDescent` under a trust region, with the end said above."""

    descent: PointDescent
    redundancy: Float[Array, ""]
    atol: float = 1e-4
    rtol: float = 0.0
    search: optx.ClassicalTrustRegion = optx.ClassicalTrustRegion()
    norm: ClassVar[Callable] = staticmethod(optx.max_norm)
    verbose: ClassVar[Callable] = staticmethod(lambda **_: None)

    def terminate(self, fn, y, args, options, state, tags):
        known = state.descent_state
        sigma0 = jnp.sqrt(jnp.vdot(known.v, known.v) / jnp.maximum(self.redundancy, 1.0))
        limit = (self.atol * jnp.maximum(sigma0, LEAST_SIGMA0)) ** 2
        settled = (known.decrement <= limit) & ~state.first_step
        return settled, state.result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        settled, _ = self.terminate(fn, y, args, options, state, tags)
        return y, aux, {"settled": settled}


class Solution(eqx.Module):
    """Adjusted unknowns, whether they settled, and after how many steps."""

    unknowns: Unknowns
    settled: Bool[Array, ""]
    steps: Int[Array, ""]


@eqx.filter_jit
def solve(
    system: System, start: Unknowns, redundancy: Float[Array, ""], max_steps: int = 60
) -> Solution:
    """Adjust with the scales S that the system has."""
    found = optx.least_squares(
        lambda y, system: residuals(system, y), PointSolver(PointDescent(system), redundancy),
        start, args=system, max_steps=max_steps, throw=False,
    )  # fmt: skip
    return Solution(found.value, found.stats["settled"], found.stats["num_steps"])


def polished(system: System, unknowns: Unknowns) -> tuple[System, Unknowns]:
    """The system with the S of the solution, and the solution after a step without damping."""
    system = compiled_rescaled(system, unknowns)
    reduced, v = normal(system, unknowns)
    return system, jax.tree.map(jnp.add, unknowns, reduced.step(v))


@eqx.filter_jit
def normal(system: System, unknowns: Unknowns) -> tuple[Reduced, Float[Array, " rows"]]:
    """The normal equations and v/σ at the solution, without damping."""
    from_changes = lambda y: residuals(system, y)
    v, times = jax.linearize(from_changes, unknowns)
    return reduce(jacobian(times, system), system.free, jnp.asarray(0.0)), v
