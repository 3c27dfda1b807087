"""Passages of the detector line over a point, searched over the whole image.

    F(t) = −s/q − η(ξ),    ξ = −r/q,    [r, s, q] = M(t)·D + m(t),

the slope of the point ahead of the detector line, η a polynomial of ξ, changes its sign at every
passage. Between two times of the search (ends of pieces) F is approximated by the cubic with its
values and rates at both: one that crosses zero and back within the step passes twice. Points behind
the Earth are not seen.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxbundle.geometry.ellipsoid import normal
from jaxbundle.geometry.vectors import difference, dot
from jaxbundle.pushbroom.newton import apparent_position, line_period, motion
from jaxbundle.pushbroom.polynomial import value, value_and_rate
from jaxbundle.system.programs import compile_once

SEARCH, FINE_SEARCH = 128, 512
"""Largest number of search steps; the finer one if the camera may turn back."""
DETECTORS = 257
"""Number of points along the line for fitting η of ξ."""


def sample_times(pieces, most: int = SEARCH):
    """Ends of pieces, `most` steps at most."""
    last = len(pieces.ends) - 1
    chosen = np.unique(np.linspace(0, last, min(most, last) + 1).round().astype(int))
    return pieces.ends[chosen]


def line_of_detectors(optics, pixels):
    """Coefficients of η as a polynomial of ξ."""
    u = np.linspace(0, max(pixels - 1, 1), DETECTORS)
    xi, eta = (np.asarray(v) for v in slopes(optics, u))
    return jnp.asarray(np.polynomial.polynomial.polyfit(xi, eta, 5))


slopes = compile_once(lambda optics, u: optics.slopes(u), ())


def ahead(numbers, D, along):
    """(F, ξ): the slope by which a sight D is ahead of the detectors; NaN behind the camera."""
    r, s, q = (sum(numbers[3 * i + k] * D[k] for k in range(3)) + numbers[9 + i] for i in range(3))
    front = q < 0
    q = jnp.where(front, q, -1.0)
    xi = -r / q
    return jnp.where(front, -s / q - value(along, xi), jnp.nan), xi


def sample(pieces, t):
    """The twelve numbers at a time, their rates, and (P, V)."""
    k = jnp.searchsorted(pieces.ends[1:-1], t, side="right")
    start, end, c = pieces.ends[k], pieces.ends[k + 1], pieces.coefficients[k]
    half = (end - start) / 2
    numbers, rates = value_and_rate(c, (t - start) / half - 1)
    return numbers, rates / half, motion(numbers, rates / half, pieces.origin)


def passages(image, search, X, most, margin):
    """Approximate times of passages over the points, and their number; whether points are
    ahead of the last line, behind the first, or never above the horizon.

    The search begins and ends one line outside the image, to include its edges.
    """
    step = (1 + margin) * line_period(image)
    samples = search.samples.at[0].add(-step).at[-1].add(step)
    numbers, rates, motions = jax.vmap(partial(sample, search.pieces))(samples)
    up = None if search.earth is None else normal(search.earth, X)

    def step_to(state, sample):
        before, rate_before, t_before, count, starts, first, risen = state
        k, t, numbers, rates, motion = sample
        D = difference(apparent_position(image, search.earth, motion, X), search.pieces.origin)
        value, rate = jax.jvp(lambda n: ahead(n, D, search.along)[0], (numbers,), (rates,))
        if up is not None:
            above = dot(up, difference(motion[0], X)) > 0
            value, risen = jnp.where(above, value, jnp.nan), risen | above
        h = t - t_before
        once, twice, places = _zeros(before, value, rate_before * h, rate * h)
        new = once + 2 * twice
        starts = tuple(
            jnp.select(
                [(count + j == i) & (new > j) for j in range(2)],
                [t_before + h * s for s in places],
                start,
            )
            for i, start in enumerate(starts)
        )
        first = jnp.where(k == 0, value, first)
        return (value, rate, t, count + new, starts, first, risen), None

    zero = jnp.zeros_like(X[0])
    nowhere, never = zero * jnp.nan, zero > 1
    state = (
        nowhere,
        zero,
        samples[0],
        zero.astype(int),
        (zero,) * most,
        nowhere,
        never if up is not None else ~never,
    )
    unroll = 1 if image.corrections.any else 4
    (final, _, _, count, starts, first, risen), _ = jax.lax.scan(
        step_to, state, (jnp.arange(len(samples)), samples, numbers, rates, motions), unroll=unroll
    )
    return jnp.stack(starts), count, final > 0, first < 0, ~risen


def _zeros(a, b, da, db):
    """Whether a function crosses zero once or twice from 0 to 1, and approximately where; from its
    values and rates at both ends (cubic), false if one is NaN."""
    known = ~(jnp.isnan(a) | jnp.isnan(b))
    once = known & ((a >= 0) != (b >= 0))
    straight = a / jnp.where(once, a - b, 1.0)
    turns = known & ~once & (a * da < 0) & (b * db > 0)
    # the zero of the rate, c + 2h·s + k·s², between ends of different sign
    rise = b - a
    c, h, k = da, 3 * rise - 2 * da - db, 3 * (da + db - 2 * rise)
    q = -(h + jnp.copysign(jnp.sqrt(jnp.maximum(h * h - c * k, 0.0)), h))
    s = c / jnp.where(turns, q, 1.0)
    s = jnp.where((s > 0) & (s < 1), s, q / jnp.where(turns & (k != 0), k, 1.0))
    turn = a + s * (da + s * (h + s * k / 3))
    twice = turns & ((turn >= 0) != (a >= 0))
    # a parabola on each side of the turn
    part = lambda end: jnp.sqrt(turn / jnp.where(twice, turn - end, 1.0))
    before, after = s * (1 - part(a)), s + (1 - s) * part(b)
    return once, twice, (jnp.where(once, straight, before), after)
