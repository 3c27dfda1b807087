"""When the line of detectors passes over a point: searched for over the whole image.

    F(t) = −s/q − η(ξ),    ξ = −r/q,    [r, s, q] = M(t)·D + m(t),

the slope at which the point is ahead of the line of detectors, η a polynomial of ξ, changes its
sign at every passage. Two passages within one step of the search (a piece, or 1/128 of the image)
that turn back in between are not separated.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxbundle.geometry.vectors import difference

from .newton import line_period, motion, seen_from
from .polynomial import value, value_and_rate

SEARCH = 128
"""The search has about as many steps at most."""
DETECTORS = 257
"""Places along the line through which η of ξ is fitted."""


def sample_times(pieces):
    """Ends of pieces, `SEARCH` steps at most."""
    last = len(pieces.ends) - 1
    chosen = np.unique(np.linspace(0, last, min(SEARCH, last) + 1).round().astype(int))
    return pieces.ends[chosen]


def line_of_detectors(optics, pixels):
    """Coefficients of η as a polynomial of ξ."""
    u = np.linspace(0, max(pixels - 1, 1), DETECTORS)
    xi, eta = (np.asarray(v) for v in slopes(optics, u))
    return jnp.asarray(np.polynomial.polynomial.polyfit(xi, eta, 5))


slopes = jax.jit(lambda optics, u: optics.slopes(u))


def ahead(numbers, D, along):
    """(F, ξ): the slope by which a sight D is ahead of the detectors; NaN behind the camera."""
    r, s, q = (
        sum(numbers[3 * i + k] * D[k] for k in range(3)) + numbers[9 + i] for i in range(3)
    )
    front = q < 0
    q = jnp.where(front, q, -1.0)
    xi = -r / q
    return jnp.where(front, -s / q - value(along, xi), jnp.nan), xi


def sample(pieces, t):
    """The twelve numbers at a time, and (P, V)."""
    k = jnp.searchsorted(pieces.ends[1:-1], t, side="right")
    start, end, c = pieces.ends[k], pieces.ends[k + 1], pieces.coefficients[k]
    half = (end - start) / 2
    numbers, rates = value_and_rate(c, (t - start) / half - 1)
    return numbers, motion(numbers, rates / half, pieces.origin)


def passages(image, search, X, most, margin):
    """When the line of detectors passes over the points, about, and how often; before or after?

    The search begins and ends a line outside the image, so that its edges are within.
    """
    step = (1 + margin) * line_period(image)
    samples = search.samples.at[0].add(-step).at[-1].add(step)
    numbers, motions = jax.vmap(partial(sample, search.pieces))(samples)

    def step_to(state, sample):
        before, t_before, count, starts, first = state
        k, t, numbers, motion = sample
        D = difference(seen_from(image, search.earth, motion, X), search.pieces.origin)
        value, _ = ahead(numbers, D, search.along)
        passed = (before >= 0) != (value >= 0)
        passed &= ~(jnp.isnan(before) | jnp.isnan(value))
        crossing = t_before + (t - t_before) * before / jnp.where(passed, before - value, 1.0)
        starts = tuple(
            jnp.where(passed & (count == i), crossing, start) for i, start in enumerate(starts)
        )
        return (value, t, count + passed, starts, jnp.where(k == 0, value, first)), None

    zero = jnp.zeros_like(X[0])
    nowhere = zero * jnp.nan
    state = (nowhere, samples[0], zero.astype(int), (zero,) * most, nowhere)
    unroll = 1 if image.corrections.any else 4
    (final, _, count, starts, first), _ = jax.lax.scan(
        step_to, state, (jnp.arange(len(samples)), samples, numbers, motions), unroll=unroll
    )
    return jnp.stack(starts), count, final > 0, first < 0
