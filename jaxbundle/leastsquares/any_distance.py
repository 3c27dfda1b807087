"""Points at any distance, up to infinity: their parametrisation in the engine."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbundle.geometry import transform_point
from jaxbundle.leastsquares.datum.motions import JointMotion
from jaxbundle.leastsquares.spaces import Change, WithoutChart, hold_by_retraction, tangent_basis
from jaxbundle.types import AnyArray, Scalar

# Infinity, in units of the length s of a row: rays to it from places a length s apart differ by
# 1e-8 radians, a ten-thousandth of a pixel if the principal distance is 10 000 pixels. At a
# hundredth of this distance they would differ by a hundredth of a pixel, which can be measured; a
# hundred times more changes nothing.
LARGEST_DISTANCE = 1e8


@dataclasses.dataclass(frozen=True)
class AnyDistance(WithoutChart):
    """Places X of space with a length s each, [4]; where s is 0 the coordinates move, as those of
    `Vector(3)` do; where it is not, the homogeneous vector (X, s) on its sphere: two directions
    across the ray from the origin, and one along it in which s/|X| moves,

        X ← (X + A·δ)/(1 + |X|/s·δ₃),   A = (n·e₁, n·e₂, −s·u),  u = X/|X|,  n² = |X|² + s².

    So nearly parallel rays give a well-determined direction and an inverse distance that may become
    0, instead of a diverging distance. A step beyond infinity (`LARGEST_DISTANCE`) ends there.

    Source: Förstner and Wrobel (2016), 5.1 and 10.2, spherically normalised homogeneous vectors.
    """

    width = 3

    def prepare(
        self, value: Float[Array, " 4"]
    ) -> tuple[Change, tuple[Change, ...], Float[Array, ""]]:
        A, c = _frame(value)
        return tuple(value[:3]), tuple(map(tuple, A)), c

    def move(self, block: tuple[Change, tuple[Change, ...], Scalar], change: Change) -> Change:
        X, A, c = block
        if not change:
            return X
        scale = 1 / (1 + c * change[2])
        return tuple((x + sum(a * d for a, d in zip(row, change))) * scale for x, row in zip(X, A))

    def retract(
        self, value: Float[Array, " 4"], change: Float[AnyArray, " 3"]
    ) -> Float[Array, " 4"]:
        A, c = _frame(value)
        displaced, s = value[:3] + A @ change, value[3]
        # 1 + c·δ₃ ≤ 0 would put the point behind the origin, through infinity: it stops there.
        smallest_divisor = jnp.where(
            s > 0, length(displaced) / jnp.where(s > 0, LARGEST_DISTANCE * s, 1.0), 0.0
        )
        return value.at[:3].set(displaced / jnp.maximum(1 + c * change[2], smallest_divisor))

    def difference(
        self, value: Float[Array, " 4"], origin: Float[Array, " 4"]
    ) -> Float[Array, " 3"]:
        A, c = _frame(origin)
        u, X = origin[:3] / length(origin[:3]), value[:3]
        inverse_distance_change = (length(origin[:3]) - u @ X) / jnp.where(
            c > 0, origin[3] + c * (u @ X), 1.0
        )
        shift = X * (1 + c * inverse_distance_change) - origin[:3]
        direction_change = A.T @ shift / (A * A).sum(0)
        return jnp.where(c > 0, direction_change.at[2].set(inverse_distance_change), X - origin[:3])

    def hold(
        self, value: Float[Array, " 4"], start: Float[Array, " 4"], free: Float[Array, " 3"]
    ) -> Float[Array, " 4"]:
        return hold_by_retraction(self, value, start, free)


def derivative(value: Float[Array, " 4"]) -> Float[Array, "3 3"]:
    """∂X/∂δ [3, 3]."""
    A, c = _frame(value)
    return A.at[:, 2].add(-c * value[:3])


def is_at_infinity(
    X: Float[np.ndarray, "n 3"], s: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Which points at any distance are at infinity."""
    # 0.99: a point that was moved to infinity is there but for the rounding of later motions.
    return (np.linalg.norm(X, axis=1) > 0.99 * LARGEST_DISTANCE * s) & (s > 0)


def shares(
    X: Float[np.ndarray, "n 3"], s: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """For points at any distance, the change of direction (radians) by a unit change across the
    ray, and the change of 1/|X| by a unit change along it."""
    square = (X**2).sum(1)
    return np.sqrt(1 + s**2 / square), s / square + 1 / s


def length(X: Float[Array, " 3"]) -> Float[Array, ""]:
    """|X|, 1 where it is 0."""
    square = X @ X
    return jnp.sqrt(jnp.where(square > 0, square, 1.0))


def _frame(value: Float[Array, " 4"]) -> tuple[Float[Array, "3 3"], Float[Array, ""]]:
    """A [3, 3] and |X|/s; the unit matrix and 0 for points that move by coordinates."""
    X, s = value[:3], value[3]
    r = length(X)
    tangents = jnp.sqrt(r * r + s * s) * tangent_basis(X / r)
    A = jnp.concatenate([tangents, -s * X[:, None] / r], 1)
    # One program for points of both kinds: which a point is, is data.
    is_far = s > 0
    return jnp.where(is_far, A, jnp.eye(3)), jnp.where(is_far, r / jnp.where(is_far, s, 1.0), 0.0)


def _transform(motion: Float[Array, " 7"], value: Float[Array, " 4"]) -> Float[Array, " 4"]:
    """A point that moves with space; at infinity only its direction rotates."""
    transformed = transform_point(motion, value[:3])
    # A point at infinity does not shift: a direction, kept at its distance.
    rotated = transformed - transform_point(motion, jnp.zeros(3))
    rotated = rotated * length(value[:3]) / length(rotated)
    moves_at_infinity = jnp.sqrt(value[:3] @ value[:3]) > 0.99 * LARGEST_DISTANCE * value[3]
    return value.at[:3].set(jnp.where(moves_at_infinity & (value[3] > 0), rotated, transformed))


move_at_any_distance = JointMotion(_transform, _transform, transform_point, 3)
