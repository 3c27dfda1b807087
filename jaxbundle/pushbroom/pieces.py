"""The trajectory of an image as piecewise polynomials in time, for ground → image.

A point X is at [r, s, q] = Rᵀ·(X − P) = M·(X − O) + m in the camera frame, O a fixed origin. The
twelve numbers M, m are interpolated by polynomials of degree 3 through Chebyshev points of short
pieces of time. A piece ends at interpolation nodes of a table and is halved until the polynomials
reproduce image coordinates within a tolerance. This costs a few multiplications per point,
while interpolation and rotation cost hundreds.
"""

from collections.abc import Sequence
from functools import partial
from math import comb

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid, ray_to_ellipsoid
from jaxbundle.geometry.vectors import Triple, rotate
from jaxbundle.leastsquares.indexing.indices import round_up
from jaxbundle.pushbroom.image import LinePose, PushbroomImage, pose_at
from jaxbundle.pushbroom.interpolation import breaks, span
from jaxbundle.pushbroom.polynomial import value_and_rate
from jaxbundle.pushbroom.search_settings import DEFAULTS, SearchSettings
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar

# Of the polynomials: 5 needs fewer pieces, but twice the time for every point.
DEGREE = 3
NODES = np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))
# Check times between the nodes and at the ends, where the polynomial error is largest.
CHECKS = np.cos(np.pi * np.arange(DEGREE + 2) / (DEGREE + 1))
TO_COEFFICIENTS = np.linalg.inv(np.vander(NODES, increasing=True))
TO_CHECKS = np.vander(CHECKS, DEGREE + 1, increasing=True) @ TO_COEFFICIENTS
# From the coefficients of a polynomial in τ to those in τ' from −1 to 1, τ = (τ' ∓ 1)/2.
TO_HALVES = np.array(
    [
        [
            [comb(k, j) * side ** (k - j) / 2**k for k in range(DEGREE + 1)]
            for j in range(DEGREE + 1)
        ]
        for side in (-1.0, 1.0)
    ]
)


# Start, end, coefficients.
Piece = tuple[float, float, Float[np.ndarray, "4 12"]]
# M (rows first) and m
TwelveNumbers = Sequence[Scalar] | Float[AnyArray, "12 ..."]


class Pieces(eqx.Module):
    """Ends of the n pieces in seconds; coefficients of M (rows first) and m in τ from −1 to 1."""

    ends: Float[AnyArray, " ends"]
    coefficients: Float[AnyArray, "n 4 12"]
    origin: Float[AnyArray, "3"]


def make_pieces(
    image: PushbroomImage, earth: Ellipsoid | None, settings: SearchSettings = DEFAULTS
) -> Pieces:
    """The pieces from the edge of the first line to that of the last, within the tables.

    `earth` as in `make_search`.

    **Raises:** `InputError` if no pieces represent the trajectory.
    """
    first_time, last_time = (float(image.times.time(line)) for line in (-0.5, image.lines - 0.5))
    line = (last_time - first_time) / image.lines
    tables = image.trajectory.position, image.trajectory.attitude.table
    starts, ends = zip(*(span(table) for table in tables))
    first_time, last_time = max(first_time, *starts), min(last_time, *ends)
    nodes = np.unique(np.concatenate([breaks(table) for table in tables]))
    equal = settings.equal_times * line
    nodes = nodes[(nodes > first_time + equal) & (nodes < last_time - equal)]
    ends = np.r_[first_time, nodes[np.diff(nodes, prepend=-np.inf) > equal], last_time]
    origin, sight_length, per_radian = _middle_sight(image, earth)
    piece_starts, piece_ends, pieces = ends[:-1], ends[1:], []
    while len(piece_starts):
        values, checks = _pose_numbers_of_pieces(
            image, origin, piece_starts, piece_ends, (first_time, last_time), settings.times_at_once
        )
        deviations = np.abs(TO_CHECKS @ values - checks)
        # Turns act on the whole sight, shifts over its length.
        error = per_radian * (
            deviations[..., :9].max((1, 2)) + deviations[..., 9:].max((1, 2)) / sight_length
        )
        good = error <= settings.piece_tolerance
        pieces += zip(piece_starts[good], piece_ends[good], TO_COEFFICIENTS @ values[good])
        # A rough trajectory, or a wrong row, would be halved for ever.
        piece_starts, piece_ends = piece_starts[~good], piece_ends[~good]
        if len(piece_starts) and (piece_ends - piece_starts).min() < settings.min_piece * line:
            raise InputError(
                f"positions or attitude: the trajectory at {piece_starts[0]:.9g} s does not follow "
                f"from their rows within {settings.min_piece:g} lines; look for wrong rows there"
            )
        middle = (piece_starts + piece_ends) / 2
        piece_starts, piece_ends = np.r_[piece_starts, middle], np.r_[middle, piece_ends]
    shared = len(pieces) <= settings.max_shared_pieces
    extra_count = round_up(len(pieces)) - len(pieces) if shared else 0
    # A half has the same polynomial: pieces that only fill up move no position.
    pieces = _halve_some(pieces, extra_count)
    coefficients = jnp.asarray(np.stack([piece[2] for piece in pieces]))
    return Pieces(
        jnp.asarray(np.r_[[p[0] for p in pieces], last_time]), coefficients, jnp.asarray(origin)
    )


def _halve_some(pieces: list[Piece], number: int) -> list[Piece]:
    """Pieces (start, end, coefficients) in order of time, some of the longest halved."""
    pieces = sorted(pieces, key=lambda piece: piece[1] - piece[0])
    result, longest = pieces[: len(pieces) - number], pieces[len(pieces) - number :]
    for start, end, c in longest:
        middle = (start + end) / 2
        result += [(start, middle, TO_HALVES[0] @ c), (middle, end, TO_HALVES[1] @ c)]
    return sorted(result, key=lambda piece: piece[0])


def _pose_numbers_of_pieces(
    image: PushbroomImage,
    origin: Float[np.ndarray, "3"],
    piece_starts: Float[np.ndarray, " n"],
    piece_ends: Float[np.ndarray, " n"],
    span: tuple[float, float],
    batch: int,
) -> tuple[np.ndarray, np.ndarray]:
    """The twelve numbers at nodes and checks of many pieces: [n, 4, 12] and [n, 5, 12]."""
    places = np.r_[NODES, CHECKS]
    t = (piece_starts + piece_ends)[:, None] / 2 + (piece_ends - piece_starts)[:, None] / 2 * places
    t = np.clip(t, *span)
    padded = np.pad(t.ravel(), (0, -t.size % batch), mode="edge").reshape(-1, batch)
    numbers = np.concatenate([_pose_numbers(image, origin, times) for times in padded])
    numbers = numbers[: t.size].reshape(*t.shape, 12)
    return numbers[:, : DEGREE + 1], numbers[:, DEGREE + 1 :]


@partial(compile_once, static=())
def _pose_numbers(
    image: PushbroomImage, origin: Float[np.ndarray, "3"], times: Float[np.ndarray, " times"]
) -> Float[Array, "times 12"]:
    def numbers_at(t: Scalar) -> Float[Array, "12"]:
        P, R, _ = pose_at(image, t)
        return jnp.concatenate([R.T.ravel(), R.T @ (origin - P)])

    return jax.vmap(numbers_at)(times)


def sample_times(pieces: Pieces, max_steps: int) -> Float[AnyArray, " k"]:
    """Ends of pieces, with at most `max_steps` steps between them."""
    last_index = len(pieces.ends) - 1
    indices = np.unique(
        np.linspace(0, last_index, min(max_steps, last_index) + 1).round().astype(int)
    )
    return pieces.ends[indices]


def sample(pieces: Pieces, t: Scalar) -> tuple[Array, Array, tuple[Triple, Triple]]:
    """The twelve numbers at a time, their rates, and (P, V)."""
    k = jnp.searchsorted(pieces.ends[1:-1], t, side="right")
    start, end, c = pieces.ends[k], pieces.ends[k + 1], pieces.coefficients[k]
    half_length = (end - start) / 2
    numbers, rates = value_and_rate(c, (t - start) / half_length - 1)
    return numbers, rates / half_length, motion(numbers, rates / half_length, pieces.origin)


def motion(
    numbers: TwelveNumbers, rates: TwelveNumbers, origin: Float[AnyArray, "3"]
) -> tuple[Triple, Triple]:
    """P = O − Mᵀ·m, and its rate V, of the twelve numbers M, m."""
    position = lambda *n: tuple(
        origin[k] - sum(n[3 * i + k] * n[9 + i] for i in range(3)) for k in range(3)
    )
    return jax.jvp(position, tuple(numbers), tuple(rates))


@partial(compile_once, static=())
def _middle(image: PushbroomImage) -> tuple[LinePose, Triple, Scalar]:
    pose = pose_at(image, image.middle_time)
    u = (image.pixels - 1) / 2
    slopes, per_pixel = jax.jvp(image.optics.slopes, (u,), (1.0,))
    return pose, rotate(pose.R, (*slopes, -1.0)), jnp.hypot(*per_pixel)


def _middle_sight(
    image: PushbroomImage, earth: Ellipsoid | None
) -> tuple[Float[np.ndarray, "3"], float, float]:
    """A point on the ground in the middle, its distance, and pixels a radian (the finer of two)."""
    (P, _, V), d, per_pixel = jax.tree.map(np.asarray, _middle(image))
    if earth is None:
        s = float(-P[2] / d[2]) if d[2] else 0.0
    else:
        s = float(ray_to_ellipsoid(earth, P, d))
    # Looking at the sky or into the ground: a kilometre serves to weigh turns against shifts.
    sight_length = s if np.isfinite(s) and s > 0 else 1e3
    period = float(image.times.time(1.0) - image.times.time(0.0))
    # Not zero: a camera may stand still.
    advance = max(float(np.linalg.norm(V)) * period / sight_length, 1e-12)
    return P + sight_length * np.array(d), sight_length, max(1 / float(per_pixel), 1 / advance)
