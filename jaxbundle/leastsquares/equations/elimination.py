"""The structured solve: eliminate rows, solve the reduced system, substitute back.

With N = [A Wᵀ; W V] and V block diagonal (Brown 1958; Triggs et al. 2000, section 6.1):

    V = L·Lᵀ,   Z = L⁻¹·W,   h = L⁻¹·b_e
    S = A − Zᵀ·Z                      (sums over pairs of incidences of one eliminated row)
    S·x = b − Zᵀ·h                    (`reduced.py`)
    x_e = L⁻ᵀ·(h − Z·x)

Three tiers: the plan is made once per problem, N per accepted point, this solve per damping.
"""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.experimental.layout import Layout, with_layout_constraint
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxbundle.leastsquares.equations.banded import BandFactor, factorise_band
from jaxbundle.leastsquares.equations.damping import matrices
from jaxbundle.leastsquares.equations.iterative import ConjugateGradients, precondition
from jaxbundle.leastsquares.equations.normal import (
    Normal,
    average_over_devices,
    gather,
    scatter,
    sum_over_devices,
)
from jaxbundle.leastsquares.equations.reduced import DenseFactor, Reduced, factorise_dense
from jaxbundle.leastsquares.indexing.plan import IncidencePairs, Plan, Tangent
from jaxbundle.leastsquares.indexing.rows import look_up
from jaxbundle.types import not_none

# Relative residual of a reduced system solved iteratively to full precision: what one refinement
# reaches after a run to 1e-10 (`ConjugateGradients.reachable`). A smaller one may be unreachable
# because of rounding, and the iterates then drift along open motions. Half costs a step of
# conjugate gradients more, double one less.
FULL_PRECISION = 1e-12
# A pivot below this fraction of its diagonal element is rounding: the unknown is undetermined.
#
# Measured on 1260 normal matrices of 5 to 200 unknowns with one exactly dependent column: rounding
# leaves a last pivot of 2e-16 (median) to 1.6e-15 (largest), of either sign. Half or double decide
# none of them. A pivot at the limit has lost up to 1.6 % of itself to rounding: the σ of a
# determined unknown is still right to 0.8 %.
PIVOT = 1e-13


# By group, a block for every incidence.
Incident = dict[str, Float[Array, "chunks length w v"]]


class NormalFactor(eqx.Module):
    """Factorised N, for solving and for blocks of its inverse. `reduced`: the factor of S scaled by
    `scale`."""

    plan: Plan
    reduced: DenseFactor | BandFactor | ConjugateGradients
    scale: Tangent
    lower_inverse: Float[Array, "rows w w"] | None
    Z: dict[str, Float[Array, "chunks length w v"]]

    def inverse(self) -> Reduced:
        """The blocks of S⁻¹ where S has blocks."""
        return self.reduced.inverse().scale_symmetrically(self.plan, self.scale)


def damp(normal: Normal, damping: Float[Array, ""]) -> Normal:
    """N + λ·D."""
    N, e = normal.blocks, normal.plan.eliminated
    damping_blocks = {name: damping * d for name, d in matrices(N.damping_matrix).items()}
    diagonal = {name: B + damping_blocks[name] for name, B in N.diagonal_blocks.items()}
    eliminated = None if e is None else not_none(N.eliminated) + damping_blocks[e]
    return Normal(
        normal.plan, dataclasses.replace(N, diagonal_blocks=diagonal, eliminated=eliminated)
    )


def regularise_diagonal(normal: Normal, ridge: float = 1e-10) -> Normal:
    """N + `ridge`·diag(N) (Tikhonov), so that it can be factorised if it is singular.

    The pivots are then at least 1e-10, a thousand times `PIVOT`, and undetermined unknowns get σ of
    1e5 times their σ with all others given: far beyond all that is judged weak. An unknown with
    a σ below 1e-3 of this keeps it to 1e-6; half or double the ridge change no verdict."""
    N, e = normal.blocks, normal.plan.eliminated

    def add(B: Float[Array, "rows w w"]) -> Float[Array, "rows w w"]:
        diagonal = jnp.diagonal(B, axis1=1, axis2=2)
        # Of an unknown without observations the diagonal is zero, and so are its row and column.
        ridge_of_rows = jnp.where(diagonal > 0, ridge * diagonal, 1.0)
        return B + ridge_of_rows[:, :, None] * jnp.eye(B.shape[1])

    diagonal = {name: add(B) for name, B in N.diagonal_blocks.items()}
    eliminated = None if e is None else add(not_none(N.eliminated))
    return Normal(
        normal.plan, dataclasses.replace(N, diagonal_blocks=diagonal, eliminated=eliminated)
    )


def factorise(
    normal: Normal, pin_datum: Bool[Array, ""] | bool = True, tolerance: float = FULL_PRECISION
) -> NormalFactor:
    """Factorise N, with open datum directions pinned if `pin_datum`; `tolerance`: of a reduced
    system solved iteratively. A pivot at the level of rounding gives NaN, as a negative one does:
    its sign is an accident."""
    plan = normal.plan
    S, scale, lower_inverse, Z = reduced_system(normal, pin_datum)
    if plan.reduction == "iterative":
        factor = precondition(normal, Z, S, scale, tolerance)
    else:
        factor = (factorise_band if plan.reduction == "banded" else factorise_dense)(plan, S)
    # S is scaled, so a squared pivot is 1 − R² of its unknown on those before it: the part of its
    # information that no other unknown explains. One unsound pivot spoils all: σ of other unknowns
    # would be finite and wrong. (An iterative solution has only the pivots of its diagonal blocks:
    # it finds what one row leaves open, and not what several rows do together.)
    sound = jnp.all(factor.pivots**2 > PIVOT)
    scale = {g: jnp.where(sound, s, jnp.nan) for g, s in scale.items()}
    return NormalFactor(plan, factor, scale, lower_inverse, Z)


def reduced_system(
    normal: Normal, pin_datum: Bool[Array, ""] | bool = True
) -> tuple[Reduced, Tangent, Float[Array, "rows w w"] | None, Incident]:
    """S scaled by the diagonal of A; the scale, L⁻¹ and Z.

    Held unknowns get a one. A problem that may float is singular along its open motions; with
    `pin_datum` a one is added to as many diagonal elements (`Datum.pins`), which makes it regular
    and changes the solution along these motions only."""
    plan = normal.plan
    S, lower_inverse, Z = eliminate(normal)
    # The diagonal of A, not of S: the pivots of S then show what elimination takes from an unknown,
    # too. A diagonal of S near zero, scaled to one, would hide it.
    diagonal = normal.diagonal()
    scale = {g: jnp.where(diagonal[g] > 0, diagonal[g], 1.0) ** -0.5 for g in plan.kept}
    S = S.scale_symmetrically(plan, scale)
    for g, B in S.diagonal_blocks.items():
        diagonal_additions = 1.0 - plan.groups[g].free
        # With d pins on a matrix of defect d, N + Σ eᵢeᵢᵀ is regular, and the solution is that of
        # the minimal datum in which the pinned unknowns do not change. Inner constraints instead
        # (G·Gᵀ added) would fill the whole matrix, band and all; a QR of G in the loop compiled
        # longer.
        if plan.datum is not None:
            diagonal_additions = diagonal_additions + pin_datum * plan.datum.pins[g]
        S.diagonal_blocks[g] = B + diagonal_additions[:, :, None] * jnp.eye(B.shape[1])
    return S, scale, lower_inverse, Z


def eliminate(normal: Normal) -> tuple[Reduced, Float[Array, "rows w w"] | None, Incident]:
    """S = A − Zᵀ·Z in blocks, L⁻¹ of the eliminated rows, and Z."""
    plan, N, e = normal.plan, normal.blocks, normal.plan.eliminated
    diagonal, off_diagonal = dict(N.diagonal_blocks), dict(N.off_diagonal_blocks)
    if e is None:
        return Reduced(diagonal, off_diagonal), None, {}
    # Held directions have zero rows in W: with a one on the diagonal they take no part.
    held_directions = (1.0 - plan.groups[e].free)[:, :, None] * jnp.eye(plan.groups[e].width)
    lower_inverse = inverse_cholesky(not_none(N.eliminated) + held_directions)
    # L⁻¹ itself and not L: it is used for every incidence, for right-hand sides and for cofactors,
    # and a product of 3×3 vectorises where a substitution does not.
    Z, ZtZ, ZtZ_off = {}, {}, {}
    for g, W in N.W.items():
        at = plan.incidences[g]
        Z[g] = _row_major(_lower_times(lower_inverse, at.eliminated, W))
        # The diagonal blocks of ZᵀZ: an incidence with itself (observations of the same two rows
        # share one incidence). All of a chunk belong to one kept row, so their sum is one product
        # of depth length × w; only the chunks are scattered.
        rows = Z[g].reshape(at.row.shape[0], -1, W.shape[-1])
        of_chunks = jnp.einsum("cki,ckj->cij", rows, rows)
        ZtZ[g] = jax.ops.segment_sum(of_chunks, at.row, diagonal[g].shape[0])
    # The others: pairs of incidences of one eliminated row, of two kept rows.
    for key, at in plan.blocks.items():
        if at.pairs is not None:
            ZtZ_off[key] = sum_pairs(at.pairs, at.row.shape[0], Z[key[0]], Z[key[1]])
    # The only exchange between devices in a factorisation: every one has eliminated rows of its
    # own, and then the whole S.
    ZtZ, ZtZ_off = sum_over_devices(plan, (ZtZ, ZtZ_off))
    diagonal = {g: B - ZtZ[g] if g in ZtZ else B for g, B in diagonal.items()}
    for key, B in ZtZ_off.items():
        off_diagonal[key] = off_diagonal[key] - B if key in off_diagonal else -B
    return Reduced(diagonal, off_diagonal), lower_inverse, Z


def solve(factor: NormalFactor, right: Tangent) -> Tangent:
    """N⁻¹·b for one right-hand side, linear and transposable in b. Without eliminated rows in b,
    which are zero then, the solution has none either: passes over all incidences are saved."""
    plan, Z = factor.plan, factor.Z
    e = plan.eliminated if plan.eliminated in right else None
    # Free: held unknowns do not change, whatever a right-hand side has along them.
    kept_right = {g: right[g] * plan.groups[g].free * s for g, s in factor.scale.items()}
    if e is not None:
        free = plan.groups[e].free
        h = jnp.einsum("nij,nj->ni", factor.lower_inverse, right[e] * free)
        for g, x in gather(plan, Z, h).items():
            kept_right[g] = kept_right[g] - x * factor.scale[g]
    # Devices that differ in the last digit would take different branches later.
    x = average_over_devices(plan, factor.reduced.solve(kept_right))
    x = {g: rows * plan.groups[g].free * factor.scale[g] for g, rows in x.items()}
    if e is not None:
        # x_e = L⁻ᵀ·(h − Z·x), with h = L⁻¹·b_e from above.
        h = h - scatter(plan, Z, x)
        x[e] = jnp.einsum("nji,nj->ni", factor.lower_inverse, h) * free
    return x


def sum_pairs(
    pairs: IncidencePairs,
    blocks: int,
    a: Float[Array, "chunks length w v"],
    b: Float[Array, "chunks length w v2"],
) -> Float[Array, "blocks v v2"]:
    """Σ aᵀb over the pairs of every block: one small matrix product of depth (length × w) per
    chunk, at most a quarter of the time of scattered outer products."""
    a, b = (x.reshape(-1, *x.shape[2:]) for x in (a, b))
    width, m, n = a.shape[1], a.shape[2], b.shape[2]

    def add(
        sums: Float[Array, "blocks w v"],
        i: Int[Array, "chunks length"],
        j: Int[Array, "chunks length"],
        k: Int[Array, " chunks"],
    ) -> Float[Array, "blocks w v"]:
        number, depth = len(i), i.shape[1] * width
        # Gathering whole blocks takes 18 ms for the pairs of BAL 16; column by column, 53.
        first_rows, second_rows = look_up(a, i), look_up(b, j).reshape(number, depth, n)
        # With the left factor transposed as it is gathered, chunks of up to 100 pairs take three
        # quarters of the time (BAL 49: 8.9 ms for all pairs instead of 12.1); in longer ones, most
        # of those of BAL 16, the transposition costs a third more than it saves.
        if i.shape[1] <= 100:
            turned = _row_major(jnp.moveaxis(first_rows, 3, 1))
            product = turned.reshape(number, m, depth) @ second_rows
        else:
            product = jnp.einsum("cki,ckj->cij", first_rows.reshape(number, depth, m), second_rows)
        # `chunk_pairs` lists them by block.
        return sums.at[k].add(product, indices_are_sorted=True)

    return sum_over_pairs(pairs, add, jnp.zeros((blocks, m, n)))


def sum_over_pairs(
    pairs: IncidencePairs, add: Callable, sums: PyTree[Array], at_once: int = 4096
) -> PyTree[Array]:
    """`add(sums, first, second, block)` for all chunks of pairs, some at a time.

    `at_once`: pairs whose factors are in memory at the same time; half and double take the same
    time within 5 % (BAL 16)."""
    for chunks in zip(pairs.first, pairs.second, pairs.block):
        # A loop over some thousand pairs: their gathered factors stay in the cache. All at once
        # they would be 73 MB for the 170 046 pairs of BAL 16 (two blocks of 3 × 9 each).
        number, length = chunks[0].shape
        step = max(1, at_once // length)
        whole_steps = number // step * step
        if number > step:
            steps = [x[:whole_steps].reshape(-1, step, *x.shape[1:]) for x in chunks]
            sums, _ = jax.lax.scan(lambda sums, chunk: (add(sums, *chunk), None), sums, steps)
            chunks = [x[whole_steps:] for x in chunks]
        # The rest, which fills no whole step.
        if len(chunks[0]):
            sums = add(sums, *chunks)
    return sums


def inverse_cholesky(V: Float[Array, "n w w"]) -> Float[Array, "n w w"]:
    """L⁻¹ of V = L·Lᵀ, written out over scalars (7 ns per row of three; a batched Cholesky takes
    60); NaN if V is not positive definite."""
    w = V.shape[-1]
    L, M = {}, {}
    for j in range(w):
        # V is not scaled: its pivot is compared with its own diagonal element.
        pivot = V[:, j, j] - sum(L[j, k] ** 2 for k in range(j))
        M[j, j] = jax.lax.rsqrt(jnp.where(pivot > PIVOT * V[:, j, j], pivot, jnp.nan))
        for i in range(j + 1, w):
            L[i, j] = (V[:, i, j] - sum(L[i, k] * L[j, k] for k in range(j))) * M[j, j]
    for j in range(w):
        for i in range(j + 1, w):
            M[i, j] = -sum(L[i, k] * M[k, j] for k in range(j, i)) * M[i, i]
    zero = jnp.zeros_like(V[:, 0, 0])
    rows = [jnp.stack([M.get((i, j), zero) for j in range(w)], -1) for i in range(w)]
    return jnp.stack(rows, -2)


def _lower_times(
    lower: Float[Array, "rows w w"],
    rows: Int[Array, "chunks length"],
    W: Float[Array, "chunks length w v"],
) -> Float[Array, "chunks length w v"]:
    """lower[at]·W of every incidence, `lower` triangular; written out: half the time of a
    product."""
    w = lower.shape[-1]
    blocks = look_up(lower.reshape(-1, w * w), rows)
    row = lambda i: sum(blocks[..., w * i + j, None] * W[..., j, :] for j in range(i + 1))
    return jnp.stack([row(i) for i in range(w)], -2)


@jax.jit
def _row_major(x: Array) -> Array:
    """Blocks in row-major order. Otherwise XLA chooses the layout of a shared array for one of its
    readers (the product by chunks), and the gathers of the pairs take three times as long.

    Jitted by itself because of a fault of JAX 0.10: if a function returns a constrained array, XLA
    also chooses the layout of its other results, which are then read in the default order, with
    wrong numbers."""
    return with_layout_constraint(x, Layout(major_to_minor=tuple(range(x.ndim))))
