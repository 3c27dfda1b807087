"""Newton's method for the time t and the pixel u at which a point is seen, with the pieces.

    f = r + ξ(u)·q = 0,    g = s + η(u)·q = 0,        [r, s, q] = M(τ)·D + m(τ).

D is the sight from the origin of the pieces. A round starts with the piece that contains t and
makes `STEPS` steps with the derivatives at its start, the slopes of the pixel by their chord over
one pixel; it has settled if the steps decrease fast enough. A root beyond the end of the piece is
searched again in the next one. Few points need more than one round from a good start; they are
gathered, so that the others need no further round.
"""

from functools import partial

import jax
import jax.numpy as jnp

from jaxbundle.geometry.vectors import difference
from jaxbundle.pushbroom.corrections import apparent_point
from jaxbundle.pushbroom.polynomial import value, value_and_rate
from jaxbundle.system.devices import batch_size

STEPS = 2
"""Steps of a round."""
LEFT = 1e-7
"""Position tolerance of settled steps, in lines and pixels."""
LAST_CHANGE = 1e-3
"""Largest change of a corrected sight in its last round, in lines."""
ROUNDS = 8
"""Rounds after which a point is given up."""
GATHERED_AT_ONCE = 64, 1 << 15
"""Points gathered for another round, on a processor and on an accelerator."""
LARGEST_GATHERED = 8
"""If a larger fraction of points needs another round, all points take it."""
EDGE = 1e-5
"""A root at most this many lines beyond the end of its piece stays with it."""
FARTHEST_OUTSIDE = 1000
"""A point this many lines outside the image is given up."""


def refine(image, pieces, earth, X, t, u):
    """(t, u, settled) of points X, a triple of arrays [n], from times and pixels near by."""
    round_ = partial(_round, image, pieces, earth)
    far = FARTHEST_OUTSIDE * line_period(image)
    n = t.size
    few = min(n, batch_size(*GATHERED_AT_ONCE))

    def open_(state):
        t, _, settled, rounds = state
        near = (t >= pieces.ends[0] - far) & (t <= pieces.ends[-1] + far)
        return ~settled & near & (rounds < ROUNDS)

    def all_again(state):
        wanted, (*place, settled, rounds) = open_(state), state
        found = round_(X, *place)
        chosen = tuple(jnp.where(wanted, a, b) for a, b in zip(found, (*place, settled)))
        return *chosen, rounds + wanted

    def few_again(state):
        *place, settled, rounds = state
        chosen = first_of(open_(state), few)
        found = round_(*gather((X, *place), chosen))
        changed = replace_chosen((*place, settled), found, chosen)
        return *changed, rounds.at[chosen].add(1, mode="drop")

    def again(state):
        if n == few:
            return all_again(state)
        many = jnp.sum(open_(state)) > n // LARGEST_GATHERED
        return jax.lax.cond(many, all_again, few_again, state)

    state = t, u, jnp.zeros(n, bool), jnp.zeros(n, int)
    return jax.lax.while_loop(lambda s: jnp.any(open_(s)), again, state)[:3]


def first_of(wanted, few):
    """The indices of the first `few` that are wanted; n where there are fewer."""
    return jnp.nonzero(wanted, size=few, fill_value=wanted.size)[0]


def gather(arrays, chosen):
    """Arrays [n] at indices; any value for n."""
    return jax.tree.map(lambda a: a.at[chosen].get(mode="clip"), arrays)


def replace_chosen(arrays, values, chosen):
    """Arrays [..., n] with values [..., few] at indices; those of n are dropped."""
    return jax.tree.map(lambda a, v: a.at[..., chosen].set(v, mode="drop"), arrays, values)


def line_period(image):
    """Seconds from line 0 to line 1."""
    return image.times.time(1.0) - image.times.time(0.0)


def apparent_position(image, earth, motion, X):
    """The apparent position of X for a camera at P with the velocity V; `motion` is (P, V)."""
    P, V = motion
    return apparent_point(image.corrections, earth, P, V, X) if image.corrections.any else X


def motion(numbers, rates, origin):
    """P = O − Mᵀ·m, and its rate V, of the twelve numbers M, m."""
    position = lambda *n: tuple(
        origin[k] - sum(n[3 * i + k] * n[9 + i] for i in range(3)) for k in range(3)
    )
    return jax.jvp(position, tuple(numbers), tuple(rates))


def _round(image, pieces, earth, X, t, u):
    """Steps in the pieces where the points are at the beginning."""
    last = len(pieces.ends) - 2
    own = jnp.searchsorted(pieces.ends[1:-1], t, side="right")
    of_own = lambda a: a.at[own].get(mode="promise_in_bounds")
    start, end = of_own(pieces.ends[:-1]), of_own(pieces.ends[1:])
    middle, half = (start + end) / 2, (end - start) / 2
    tau = first = (t - middle) / half
    # one vector of each coefficient: a gather that goes into the arithmetic
    c = [[of_own(a) for a in power] for power in pieces.coefficients.transpose(1, 2, 0)]
    if image.corrections.any:
        numbers, rates = zip(*(value_and_rate(p, tau) for p in zip(*c)))
        at = motion(numbers, [r / half for r in rates], pieces.origin)
        X = apparent_position(image, earth, at, X)
        # otherwise XLA recomputes it for each of the twelve sums below
        X = jax.lax.optimization_barrier(X)
    D = difference(X, pieces.origin)
    rsq = [[_component(n, D, i) for n in c] for i in range(3)]
    (r, dr), (s, ds), (q, dq) = (value_and_rate(p, tau) for p in rsq)
    (xi, eta), (xi1, eta1) = image.optics.slopes(u), image.optics.slopes(u + 1)
    ft, gt, fu, gu = dr + xi * dq, ds + eta * dq, (xi1 - xi) * q, (eta1 - eta) * q
    inverse = 1 / (ft * gu - fu * gt)
    line = line_period(image) / half
    step, v = jnp.inf, u
    for k in range(STEPS):
        if k:
            r, s, q = (value(p, tau) for p in rsq)
            xi, eta = image.optics.slopes(v)
        f, g = r + xi * q, s + eta * q
        dtau, dv = inverse * (gu * f - fu * g), inverse * (ft * g - gt * f)
        tau, v = tau - dtau, v - dv
        before, step = step, jnp.maximum(jnp.abs(dtau) / line, jnp.abs(dv))
    # steps that shrink by step/before each leave about step²/before
    settled = (step * step <= LEFT * (before + LEFT)) & (q < 0)
    if image.corrections.any:
        # the sight refers to the time at the start of the round
        settled &= jnp.abs(tau - first) < LAST_CHANGE * line
    # a root exactly at the end of a piece would alternate
    reach = 1 + EDGE * line
    settled &= ((tau >= -reach) | (own == 0)) & ((tau <= reach) | (own == last))
    return middle + tau * half, v, settled


def _component(numbers, D, i):
    """Component i of M·D + m."""
    return (
        numbers[3 * i] * D[0]
        + numbers[3 * i + 1] * D[1]
        + numbers[3 * i + 2] * D[2]
        + numbers[9 + i]
    )
