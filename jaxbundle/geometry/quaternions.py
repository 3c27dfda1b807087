"""Unit quaternions and the exponential map: how rotations move during an adjustment.

A quaternion q = (w, u) = (w, x, y, z) stands for the rotation by the angle θ about the unit
vector n,

    q = (cos θ/2, n sin θ/2),        M(q) = I + 2w[u]× + 2[u]×²,        M(−q) = M(q),

where [u]× is the matrix of the cross product, [u]×·a = u × a. Products agree with products of
matrices, M(p∘q) = M(p)·M(q). A rotation vector v = θn is its logarithm:

    exp([v]×) = I + [v]× + ½[v]×² + … = M(q(v)),        q(v) = (cos θ/2, ½v · sin(θ/2)/(θ/2)).

A rotation is improved on the left, in the camera frame, by three small angles δ in radians:

    M(q ⊞ δ) = exp([δ]×)·M(q),        q₁ ⊟ q₀ = δ  such that  q₀ ⊞ δ = q₁.

The elementary rotations of photogrammetry turn the axes, not the points, hence the minus in
R1(ω) = exp(−ω[e₁]×) (see `rotations`).

All functions are smooth at zero rotation: sin θ/θ and (arctan t)/t are functions of θ² and t²,
summed as power series where the square is small, so that derivatives of every order are exact.

Sources: Hamilton (1844) for the product; Shepperd (1978), J. Guidance and Control 1(3), 223–224,
for the quaternion of a matrix; Solà (2017), arXiv:1711.02508, for Exp, Log, ⊞ and ⊟.
"""

from functools import partial, reduce
from math import factorial

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxbundle.types import AnyArray

# Traced once for all callers, and compiled as a part of each.
traced_once = partial(jax.jit, inline=True)


@traced_once
def quaternion_multiply(a: Float[AnyArray, "4"], b: Float[AnyArray, "4"]) -> Float[Array, "4"]:
    """The product a∘b, of which the rotation is M(a)·M(b): b acts first (Hamilton, 1844)."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def quaternion_conjugate(q: Float[AnyArray, "4"]) -> Float[Array, "4"]:
    """The inverse rotation (w, −x, −y, −z) of a unit quaternion: M(q*) = M(q)ᵀ."""
    return jnp.concatenate([q[:1], -q[1:]])


@traced_once
def matrix_from_quaternion(q: Float[AnyArray, "4"]) -> Float[Array, "3 3"]:
    """The rotation matrix M(q) of q = (w, x, y, z).

    Divided by q·q, so that a quaternion of any length but zero gives a true rotation.
    """
    w, x, y, z = q
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    rows = [
        [ww + xx - yy - zz, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), ww - xx + yy - zz, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), ww - xx - yy + zz],
    ]
    return jnp.array(rows) / (ww + xx + yy + zz)


@traced_once
def quaternion_from_matrix(M: Float[AnyArray, "3 3"]) -> Float[Array, "4"]:
    """The unit quaternion (w, x, y, z), w ≥ 0, of a rotation matrix.

    The elements of M give all ten products in 4qqᵀ. The row with the largest diagonal element is
    never short and is parallel to q: stable for every rotation, by 180° included, where one of the
    two signs of q is returned (Shepperd, 1978).
    """
    (m11, m12, m13), (m21, m22, m23), (m31, m32, m33) = M
    products = jnp.array(
        [
            [1 + m11 + m22 + m33, m32 - m23, m13 - m31, m21 - m12],
            [m32 - m23, 1 + m11 - m22 - m33, m12 + m21, m13 + m31],
            [m13 - m31, m12 + m21, 1 - m11 + m22 - m33, m23 + m32],
            [m21 - m12, m13 + m31, m23 + m32, 1 - m11 - m22 + m33],
        ]
    )
    q = _normalise(products[jnp.argmax(jnp.diagonal(products))])
    return jnp.where(q[0] < 0, -q, q)


@traced_once
def quaternion_from_rotation_vector(v: Float[AnyArray, "3"]) -> Float[Array, "4"]:
    """The unit quaternion of exp([v]×), v in radians (Solà, 2017, Exp)."""
    half_vector = v / 2
    square = jnp.sum(half_vector * half_vector)
    cosine = 1 - square / 2 * _sine_over_angle(square / 4) ** 2  # cos h = 1 − 2 sin²(h/2)
    return jnp.concatenate([cosine[None], _sine_over_angle(square) * half_vector])


@traced_once
def rotation_vector_from_quaternion(q: Float[AnyArray, "4"]) -> Float[Array, "3"]:
    """The rotation vector v, |v| ≤ π, in radians: 2 arctan(|u|/w)·u/|u| (Solà, 2017, Log).

    The length and the sign of q do not matter. A rotation by 180° has two logarithms, v and −v,
    between which the result jumps; either reproduces the rotation.
    """
    q = jnp.where(q[0] < 0, -q, q)
    w, u = q[0], q[1:]
    square = jnp.sum(u * u)
    # |u|/w < 0.1: the series of arctan t has 11 terms, the first omitted one 4e-24.
    small = square < 0.01 * w * w
    w_small = jnp.where(small, w, 1)
    root = jnp.sqrt(jnp.where(small, 1, square))
    series = _horner(_ARCTANGENT_SERIES, jnp.where(small, square, 0) / w_small**2) / w_small
    return 2 * jnp.where(small, series, jnp.arctan2(root, w) / root) * u


def matrix_from_rotation_vector(v: Float[AnyArray, "3"]) -> Float[Array, "3 3"]:
    """The rotation matrix exp([v]×) = I + [v]× + ½[v]×² + …, v in radians."""
    return matrix_from_quaternion(quaternion_from_rotation_vector(v))


def rotation_vector_from_matrix(M: Float[AnyArray, "3 3"]) -> Float[Array, "3"]:
    """The rotation vector v, |v| ≤ π, in radians, of a rotation matrix M = exp([v]×)."""
    return rotation_vector_from_quaternion(quaternion_from_matrix(M))


@traced_once
def retract_quaternion(q: Float[AnyArray, "4"], delta: Float[AnyArray, "3"]) -> Float[Array, "4"]:
    """The unit quaternion q ⊞ δ of exp([δ]×)·M(q): q turned by δ, radians, in the camera frame."""
    return _normalise(quaternion_multiply(quaternion_from_rotation_vector(delta), q))


@traced_once
def quaternion_difference(q1: Float[AnyArray, "4"], q0: Float[AnyArray, "4"]) -> Float[Array, "3"]:
    """The rotation q₁ ⊟ q₀ = δ, in radians, in the camera frame, that leads from q₀ to q₁.

    The inverse of the retraction: q₀ ⊞ δ = ±q₁.
    """
    return rotation_vector_from_quaternion(quaternion_multiply(q1, quaternion_conjugate(q0)))


@traced_once
def small_difference(q1: Float[AnyArray, "4"], q0: Float[AnyArray, "4"]) -> Float[Array, "3"]:
    """2 tan(θ/2)·n of the rotation from q₀ to q₁ (Gibbs, 1884), which equals q₁ ⊟ q₀ to second
    order and has fewer operations: for first derivatives at q₁ = q₀."""
    # 2·|u|/w = 2·tan(θ/2) = θ + θ³/12 + …: no √, no arctan.
    w, *u = quaternion_multiply(q1, quaternion_conjugate(q0))
    return 2 * jnp.stack(u) / w


@traced_once
def turn_object_slightly(q: Float[AnyArray, "4"], v: Float[AnyArray, "3"]) -> Float[Array, "4"]:
    """The quaternion of M(q)·exp([v]×)ᵀ to first order in v, in radians; not of unit length."""
    return quaternion_multiply(q, jnp.concatenate([jnp.ones(1), -v / 2]))


def _normalise(q: AnyArray) -> Array:
    q = jnp.asarray(q)
    return q / jnp.sqrt(jnp.sum(q * q))


def _horner(coefficients: list[float], x: AnyArray) -> Array:
    # Of the highest coefficient first.
    zero = jnp.zeros_like(x)
    return reduce(lambda total, coefficient: total * x + coefficient, reversed(coefficients), zero)


# Enough terms for float64, and a switch far enough from zero that the closed forms, and their
# second derivatives, do not cancel beyond it.
_SINE_SERIES = [(-1) ** k / factorial(2 * k + 1) for k in range(9)]
_ARCTANGENT_SERIES = [(-1) ** k / (2 * k + 1) for k in range(11)]


@traced_once
def _sine_over_angle(square: AnyArray) -> Array:
    """sin θ/θ as a function of θ², smooth at zero."""
    # θ < 0.3: nine terms, the first omitted one 1e-26 of them all.
    small = square < 0.1
    angle = jnp.sqrt(jnp.where(small, 1, square))
    series = _horner(_SINE_SERIES, jnp.where(small, square, 0))
    return jnp.where(small, series, jnp.sin(angle) / angle)
