"""Passages of the detector line over a point, searched over the whole image.

The slope F(t) by which the point is ahead of the line (`detector_line`) changes its sign at every
passage. Between two times of the search (ends of pieces) F is approximated by the cubic with its
values and rates at both: one that crosses zero and back within the step passes twice. Points behind
the Earth are not seen.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxbundle.geometry.ellipsoid import normal
from jaxbundle.geometry.vectors import Vector, difference, dot
from jaxbundle.pushbroom.detector_line import slope_ahead
from jaxbundle.pushbroom.pieces import sample
from jaxbundle.pushbroom.prepared import ScannerGeometry, Search

# Start times [most, n]; their number, and whether the point is ahead of the last line, behind the
# first, never above the horizon [n].
Passages = tuple[Array, Array, Array, Array, Array]
# F, its rate and the time of the previous step; the number of passages, less those passed over, and
# their start times; F of the first step; whether the camera has been above the horizon
PassagesState = tuple[Array, Array, Array, Array, tuple[Array, ...], Array, Array]
# Number and time of a step, twelve numbers and their rates there, (P, V).
SearchStep = tuple[Array, Array, Array, Array, tuple[Vector, Vector]]


def find_passages(
    image: ScannerGeometry,
    search: Search,
    X: Vector,
    max_passages: int,
    margin: float | Array,
    passed_over: Int[Array, " n"],
) -> Passages:
    """Approximate times of passages over the points, and their number; whether points are
    ahead of the last line, behind the first, or never above the horizon.

    The times are those of the first `max_passages` passages after `passed_over` ones; the number
    is that of all. The search begins and ends one line outside the image, to include its edges.
    """
    step = (1 + margin) * image.line_period
    samples = jnp.asarray(search.samples).at[0].add(-step).at[-1].add(step)
    numbers, rates, motions = jax.vmap(partial(sample, search.pieces))(samples)
    vertical = None if search.earth is None else normal(search.earth, X)

    def step_to(state: PassagesState, sample: SearchStep) -> tuple[PassagesState, None]:
        value_before, rate_before, t_before, count, starts, first_value, has_risen = state
        k, t, numbers, rates, motion = sample
        D = difference(image.apparent_position(search.earth, motion, X), search.pieces.origin)
        ahead = lambda numbers: slope_ahead(numbers, D, search.detector_line)[0]
        value, rate = jax.jvp(ahead, (numbers,), (rates,))
        if vertical is not None:
            is_above = dot(vertical, difference(motion[0], X)) > 0
            value, has_risen = jnp.where(is_above, value, jnp.nan), has_risen | is_above
        h = t - t_before
        crosses_once, crosses_twice, places = _find_zeros(
            value_before, value, rate_before * h, rate * h
        )
        crossings = crosses_once + 2 * crosses_twice
        starts = tuple(
            jnp.select(
                [(count + j == i) & (crossings > j) for j in range(2)],
                [t_before + h * s for s in places],
                start,
            )
            for i, start in enumerate(starts)
        )
        first_value = jnp.where(k == 0, value, first_value)
        return (value, rate, t, count + crossings, starts, first_value, has_risen), None

    zero = jnp.zeros_like(X[0])
    no_value, all_false = zero * jnp.nan, zero > 1
    state = (
        no_value,
        zero,
        samples[0],
        -passed_over,
        (zero,) * max_passages,
        no_value,
        all_false if vertical is not None else ~all_false,
    )
    # Four steps of plain sights a turn hide the cost of the loop; steps with corrections are long
    # enough, and four of them only take longer to compile.
    unroll = 1 if image.corrections.any else 4
    (final, _, _, remaining_count, starts, first_value, has_risen), _ = jax.lax.scan(
        step_to, state, (jnp.arange(len(samples)), samples, numbers, rates, motions), unroll=unroll
    )
    # NaN at an end, where the point is behind the camera, is neither ahead nor behind
    return jnp.stack(starts), remaining_count + passed_over, final > 0, first_value < 0, ~has_risen


def _find_zeros(
    a: Float[Array, " n"], b: Float[Array, " n"], da: Float[Array, " n"], db: Float[Array, " n"]
) -> tuple[Array, Array, tuple[Array, Array]]:
    """Whether a function crosses zero once or twice from 0 to 1, and approximately where; from its
    values and rates at both ends (cubic), false if one is NaN."""
    is_defined = ~(jnp.isnan(a) | jnp.isnan(b))
    crosses_once = is_defined & ((a >= 0) != (b >= 0))
    linear_zero = a / jnp.where(crosses_once, a - b, 1.0)
    turns = is_defined & ~crosses_once & (a * da < 0) & (b * db > 0)
    # The zero of the rate, c + 2h·s + k·s², between ends of different sign; q avoids the
    # cancellation of −h ± √(h² − ck) (Press et al., 2007, Numerical Recipes, section 5.6).
    rise = b - a
    c, h, k = da, 3 * rise - 2 * da - db, 3 * (da + db - 2 * rise)
    q = -(h + jnp.copysign(jnp.sqrt(jnp.maximum(h * h - c * k, 0.0)), h))
    s = c / jnp.where(turns, q, 1.0)
    s = jnp.where((s > 0) & (s < 1), s, q / jnp.where(turns & (k != 0), k, 1.0))
    turn = a + s * (da + s * (h + s * k / 3))
    crosses_twice = turns & ((turn >= 0) != (a >= 0))
    # A parabola on each side of the turn.
    part = lambda end: jnp.sqrt(turn / jnp.where(crosses_twice, turn - end, 1.0))
    first_zero, second_zero = s * (1 - part(a)), s + (1 - s) * part(b)
    return (
        crosses_once,
        crosses_twice,
        (jnp.where(crosses_once, linear_zero, first_zero), second_zero),
    )
