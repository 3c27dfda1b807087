"""Newton's method for the time t and the pixel u at which a point is seen, with the pieces.

    f = r + ξ(u)·q = 0,    g = s + η(u)·q = 0,        [r, s, q] = M(τ)·D + m(τ).

D is the sight from the origin of the pieces. A round starts with the piece that contains t and
makes a few steps with the derivatives at its start (the chord method: one matrix for all steps of
a round), the slopes of the pixel by their chord over one pixel; it has settled if the steps
decrease fast enough. A root beyond the end of the piece is searched again in the next one. Few
points need more than one round from a good start; they are gathered, so that the others need no
further round. `SearchSettings` has the limits.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxbundle.geometry.vectors import Triple, Vector, difference
from jaxbundle.pushbroom.pieces import motion
from jaxbundle.pushbroom.polynomial import value, value_and_rate
from jaxbundle.pushbroom.prepared import ScannerGeometry, Search
from jaxbundle.system.devices import batch_size
from jaxbundle.types import AnyArray, Scalar

# Of points [n]: time, pixel, whether they have settled, rounds made.
RefinementState = tuple[AnyArray, AnyArray, Array, Array]


def refine(
    image: ScannerGeometry,
    search: Search,
    X: Vector,
    t: Float[AnyArray, " n"],
    u: Float[AnyArray, " n"],
) -> tuple[AnyArray, AnyArray, Array]:
    """(t, u, settled) of points X, a triple of arrays [n], from times and pixels near by."""
    ends, settings = search.pieces.ends, search.settings
    margin = settings.max_distance * image.line_period
    n = t.size
    batch = min(n, batch_size(*settings.gathered_at_once))

    def is_open(state: RefinementState) -> Bool[Array, " n"]:
        t, _, settled, rounds = state
        is_near = (t >= ends[0] - margin) & (t <= ends[-1] + margin)
        return ~settled & is_near & (rounds < settings.max_rounds)

    def advance_all(state: RefinementState) -> RefinementState:
        is_active, (*place, settled, rounds) = is_open(state), state
        advanced = _make_round(image, search, X, *place)
        t, u, settled = (jnp.where(is_active, a, b) for a, b in zip(advanced, (*place, settled)))
        return t, u, settled, rounds + is_active

    def advance_few(state: RefinementState) -> RefinementState:
        *place, settled, rounds = state
        indices = first_indices(is_open(state), batch)
        advanced = _make_round(image, search, *gather((X, *place), indices))
        changed = scatter((*place, settled), advanced, indices)
        return *changed, rounds.at[indices].add(1, mode="drop")

    def advance(state: RefinementState) -> RefinementState:
        if n == batch:
            return advance_all(state)
        # Gathering and scattering beats a round of all points only for few of them: a larger part
        # would be gathered batch by batch, a smaller one recomputes settled points. Not critical.
        many = jnp.sum(is_open(state)) > n // 8
        return jax.lax.cond(many, advance_all, advance_few, state)

    state = t, u, jnp.zeros(n, bool), jnp.zeros(n, int)
    return jax.lax.while_loop(lambda s: jnp.any(is_open(s)), advance, state)[:3]


def first_indices(mask: Bool[Array, " n"], size: int) -> Int[Array, " few"]:
    """The first `size` indices at which the mask is true; n where there are fewer."""
    return jnp.nonzero(mask, size=size, fill_value=mask.size)[0]


def gather(arrays: PyTree[Array], indices: Int[Array, " few"]) -> PyTree[Array]:
    """Arrays [n] at indices; any value for n."""
    return jax.tree.map(lambda a: a.at[indices].get(mode="clip"), arrays)


def scatter(
    arrays: PyTree[Array], values: PyTree[Array], indices: Int[Array, " few"]
) -> PyTree[Array]:
    """Arrays [..., n] with values [..., few] at indices; those of n are dropped."""
    return jax.tree.map(lambda a, v: a.at[..., indices].set(v, mode="drop"), arrays, values)


def _make_round(
    image: ScannerGeometry,
    search: Search,
    X: Vector,
    t: Float[AnyArray, " n"],
    u: Float[AnyArray, " n"],
) -> tuple[AnyArray, AnyArray, Array]:
    """Steps in the pieces where the points are at the beginning.

        [δτ, δu]ᵀ = (∂(f, g)/∂(τ, u))⁻¹·[f, g]ᵀ,

    the inverse of 2 × 2 written out.
    """
    pieces, settings = search.pieces, search.settings
    last_piece = len(pieces.ends) - 2
    piece = jnp.searchsorted(pieces.ends[1:-1], t, side="right")
    in_piece = lambda a: a.at[piece].get(mode="promise_in_bounds")
    start, end = in_piece(pieces.ends[:-1]), in_piece(pieces.ends[1:])
    middle, half_length = (start + end) / 2, (end - start) / 2
    tau = start_tau = (t - middle) / half_length
    # One vector of each coefficient: a gather that goes into the arithmetic.
    c = [[in_piece(a) for a in power] for power in pieces.coefficients.transpose(1, 2, 0)]
    if image.corrections.any:
        numbers, rates = zip(*(value_and_rate(p, tau) for p in zip(*c)))
        position_velocity = motion(numbers, [r / half_length for r in rates], pieces.origin)
        X = image.apparent_position(search.earth, position_velocity, X)
        # Otherwise XLA recomputes it for each of the twelve sums below.
        X = jax.lax.optimization_barrier(X)
    D = difference(X, pieces.origin)
    rsq = [[_component(n, D, i) for n in c] for i in range(3)]
    (r, dr), (s, ds), (q, dq) = (value_and_rate(p, tau) for p in rsq)
    (xi, eta), (xi1, eta1) = image.optics.slopes(u), image.optics.slopes(u + 1)
    ft, gt, fu, gu = dr + xi * dq, ds + eta * dq, (xi1 - xi) * q, (eta1 - eta) * q
    inverse = 1 / (ft * gu - fu * gt)
    line = image.line_period / half_length
    step, v = jnp.inf, u
    for k in range(settings.steps_per_round):
        if k:
            r, s, q = (value(p, tau) for p in rsq)
            xi, eta = image.optics.slopes(v)
        f, g = r + xi * q, s + eta * q
        dtau, dv = inverse * (gu * f - fu * g), inverse * (ft * g - gt * f)
        tau, v = tau - dtau, v - dv
        previous_step, step = step, jnp.maximum(jnp.abs(dtau) / line, jnp.abs(dv))
    # Steps that shrink by step/previous_step each leave about step²/previous_step (geometric
    # series). The second term lets a start at the solution settle, whose steps are rounding and do
    # not shrink.
    tolerance = settings.position_tolerance
    settled = (step * step <= tolerance * (previous_step + tolerance)) & (q < 0)
    if image.corrections.any:
        # The sight refers to the time at the start of the round.
        settled &= jnp.abs(tau - start_tau) < settings.sight_tolerance * line
    # A root exactly at the end of a piece would alternate.
    reach = 1 + settings.piece_overlap * line
    settled &= ((tau >= -reach) | (piece == 0)) & ((tau <= reach) | (piece == last_piece))
    return middle + tau * half_length, v, settled


def _component(numbers: Sequence[Scalar], D: Triple, i: int) -> Scalar:
    """Component i of M·D + m."""
    return (
        numbers[3 * i] * D[0]
        + numbers[3 * i + 1] * D[1]
        + numbers[3 * i + 2] * D[2]
        + numbers[9 + i]
    )
