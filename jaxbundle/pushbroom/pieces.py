"""The trajectory of an image as piecewise polynomials in time, for ground → image.

A point X is at [r, s, q] = Rᵀ·(X − P) = M·(X − O) + m in the camera frame, O a fixed origin. The
twelve numbers M, m are interpolated by polynomials of degree 3 through Chebyshev points of short
pieces of time. A piece ends at interpolation nodes of a table and is halved until the polynomials
reproduce image coordinates within `TOLERANCE` pixels. This costs a few multiplications per point,
while interpolation and rotation cost hundreds. Degree 3 needs more pieces than 5, but half the
time.
"""

from functools import partial
from math import comb

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid, ray_to_ellipsoid
from jaxbundle.geometry.vectors import rotate
from jaxbundle.leastsquares.indexing.indices import round_up
from jaxbundle.pushbroom.image import PushbroomImage, pose_at
from jaxbundle.pushbroom.interpolation import breaks, span
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray

DEGREE = 3
TOLERANCE = 1e-7
SHORTEST_PIECE = 1e-3
"""Shortest piece, as a fraction of a line."""
CHUNK = 1024
"""Fixed batch size of times for the pose: one shape to compile."""
MOST_SHARED = 128
"""Images with at most this many pieces share compiled programs with those of similar number; with
more, not all ends are search times (`passages`), and halves would make them uneven."""
EQUAL_TIMES = 1e-6
"""Rows of two tables closer in time than this fraction of a line count as one."""

NODES = np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))
CHECKS = np.cos(np.pi * np.arange(DEGREE + 2) / (DEGREE + 1))
"""Check times between the nodes and at the ends, where the polynomial error is largest."""
TO_COEFFICIENTS = np.linalg.inv(np.vander(NODES, increasing=True))
TO_CHECKS = np.vander(CHECKS, DEGREE + 1, increasing=True) @ TO_COEFFICIENTS
TO_HALVES = np.array(
    [
        [
            [comb(k, j) * side ** (k - j) / 2**k for k in range(DEGREE + 1)]
            for j in range(DEGREE + 1)
        ]
        for side in (-1.0, 1.0)
    ]
)
"""From the coefficients of a polynomial in τ to those in τ' from −1 to 1, τ = (τ' ∓ 1)/2."""


class Pieces(eqx.Module):
    """Ends of the n pieces in seconds; coefficients of M (rows first) and m in τ from −1 to 1."""

    ends: Float[AnyArray, " ends"]
    coefficients: Float[AnyArray, "n 4 12"]
    origin: Float[AnyArray, "3"]


def make_pieces(image: PushbroomImage, earth: Ellipsoid | None) -> Pieces:
    """The pieces from the edge of the first line to that of the last, within the tables.

    `earth` as in `make_search`.

    **Raises:** `InputError` if no pieces represent the trajectory.
    """
    first, last = (float(image.times.time(line)) for line in (-0.5, image.lines - 0.5))
    line = (last - first) / image.lines
    tables = image.trajectory.position, image.trajectory.attitude.table
    starts, ends = zip(*(span(table) for table in tables))
    first, last = max(first, *starts), min(last, *ends)
    nodes = np.unique(np.concatenate([breaks(table) for table in tables]))
    nodes = nodes[(nodes > first + EQUAL_TIMES * line) & (nodes < last - EQUAL_TIMES * line)]
    ends = np.r_[first, nodes[np.diff(nodes, prepend=-np.inf) > EQUAL_TIMES * line], last]
    origin, reach, per_radian = _sight(image, earth)
    left, right, found = ends[:-1], ends[1:], []
    while len(left):
        values, checks = _numbers(image, origin, left, right, (first, last))
        wrong = np.abs(TO_CHECKS @ values - checks)
        # turns act on the whole sight, shifts over its length
        error = per_radian * (wrong[..., :9].max((1, 2)) + wrong[..., 9:].max((1, 2)) / reach)
        good = error <= TOLERANCE
        found += zip(left[good], right[good], TO_COEFFICIENTS @ values[good])
        left, right = left[~good], right[~good]
        if len(left) and (right - left).min() < SHORTEST_PIECE * line:
            raise InputError(
                f"attitude: the trajectory at {left[0]:.9g} s does not follow from its rows within "
                f"{SHORTEST_PIECE:g} lines; look for wrong rows there"
            )
        middle = (left + right) / 2
        left, right = np.r_[left, middle], np.r_[middle, right]
    more = round_up(len(found)) - len(found) if len(found) <= MOST_SHARED else 0
    found = _halve_some(found, more)
    coefficients = jnp.asarray(np.stack([piece[2] for piece in found]))
    return Pieces(
        jnp.asarray(np.r_[[p[0] for p in found], last]), coefficients, jnp.asarray(origin)
    )


def _halve_some(pieces, number: int):
    """Pieces (start, end, coefficients) in order of time, some of the longest halved."""
    pieces = sorted(pieces, key=lambda piece: piece[1] - piece[0])
    whole, long = pieces[: len(pieces) - number], pieces[len(pieces) - number :]
    for start, end, c in long:
        middle = (start + end) / 2
        whole += [(start, middle, TO_HALVES[0] @ c), (middle, end, TO_HALVES[1] @ c)]
    return sorted(whole, key=lambda piece: piece[0])


def _numbers(image, origin, left, right, span):
    """The twelve numbers at nodes and checks of many pieces: [n, 4, 12] and [n, 5, 12]."""
    places = np.r_[NODES, CHECKS]
    t = (left + right)[:, None] / 2 + (right - left)[:, None] / 2 * places
    t = np.clip(t, *span)
    padded = np.pad(t.ravel(), (0, -t.size % CHUNK), mode="edge").reshape(-1, CHUNK)
    numbers = np.concatenate([_pose_numbers(image, origin, times) for times in padded])
    numbers = numbers[: t.size].reshape(*t.shape, 12)
    return numbers[:, : DEGREE + 1], numbers[:, DEGREE + 1 :]


@partial(compile_once, static=())
def _pose_numbers(image, origin, times):
    def at(t):
        P, R, _ = pose_at(image, t)
        return jnp.concatenate([R.T.ravel(), R.T @ (origin - P)])

    return jax.vmap(at)(times)


@partial(compile_once, static=())
def _middle(image):
    pose = pose_at(image, image.middle_time)
    u = (image.pixels - 1) / 2
    slopes, per_pixel = jax.jvp(image.optics.slopes, (u,), (1.0,))
    return pose, rotate(pose.R, (*slopes, -1.0)), jnp.hypot(*per_pixel)


def _sight(image, earth):
    """A point on the ground in the middle, its distance, and pixels a radian (the finer of two)."""
    (P, _, V), d, per_pixel = jax.tree.map(np.asarray, _middle(image))
    if earth is None:
        s = -P[2] / d[2] if d[2] else 0.0
    else:
        s = float(ray_to_ellipsoid(earth, P, d))
    reach = s if np.isfinite(s) and s > 0 else 1e3
    period = float(image.times.time(1.0) - image.times.time(0.0))
    advance = max(np.linalg.norm(V) * period / reach, 1e-12)
    return P + reach * np.array(d), reach, max(1 / float(per_pixel), 1 / advance)
