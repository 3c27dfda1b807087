"""Rotation matrices from angles and from Rodrigues' parameters, and back.

M turns directions of the object space into the camera frame: [r, s, q] = M·(X − X0). The
elementary rotations turn the axes, counter-clockwise as seen from the tip of the axis:

    R1(ω) = ⎡1    0      0  ⎤   R2(φ) = ⎡cos φ  0  −sin φ⎤   R3(κ) = ⎡ cos κ  sin κ  0⎤
            ⎢0  cos ω  sin ω⎥           ⎢  0    1     0  ⎥           ⎢−sin κ  cos κ  0⎥
            ⎣0 −sin ω  cos ω⎦           ⎣sin φ  0   cos φ⎦           ⎣   0      0    1⎦

Three systems of angles, all in radians:

    (ω, φ, κ)  omega, phi, kappa     M = R3(κ)·R2(φ)·R1(ω)        locked at φ = ±90°
    (φ, ω, κ)  phi, omega, kappa     M = R3(κ)·R1(ω)·R2(φ)        locked at ω = ±90°
    (α, t, s)  azimuth, tilt, swing  M = R3(s − π)·R1(t)·R3(−α)   locked at t = 0 and 180°

**Angles of a matrix.** The first (rightmost) angle is read from the third row of M, which depends
on two angles only. With it the first rotation is removed from M, and the other two angles follow
from well-conditioned quotients. Thus the three angles together reproduce M to rounding near a
lock too, where the first angle alone is poorly determined. At the lock itself (to 8 units of
rounding) only the sum or difference of the first and third angle exists: **the first angle is set
to zero** and the third carries the whole rotation. Derivatives there are finite, and are those of
this choice.

**Rodrigues' parameters** p = (a, b, c) = 2n·tan(θ/2) are rational, without any sine or cosine:

    M = (I − S)⁻¹(I + S),    S = ½[p]×        (Cayley, 1846)

Written out this is the Rodrigues matrix of photogrammetry (Schut, 1959, Photogrammetria 15; Faig,
1984), with the common denominator Δ = 1 + ¼(a² + b² + c²). To first order p is the rotation
vector. The parameters do not exist for a rotation by 180°.

Source of the angles: Wolf and Dewitt (2000), Elements of Photogrammetry, appendix C.
"""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxbundle.geometry.quaternions import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_multiply,
    traced_once,
)
from jaxbundle.types import AnyArray, Scalar


def R1(omega: Scalar) -> Float[Array, "3 3"]:
    """Rotation of the axes about the first axis, x, by ω in radians."""
    c, s = jnp.cos(omega), jnp.sin(omega)
    one, zero = jnp.ones_like(c), jnp.zeros_like(c)
    return jnp.array([[one, zero, zero], [zero, c, s], [zero, -s, c]])


def R2(phi: Scalar) -> Float[Array, "3 3"]:
    """Rotation of the axes about the second axis, y, by φ in radians."""
    c, s = jnp.cos(phi), jnp.sin(phi)
    one, zero = jnp.ones_like(c), jnp.zeros_like(c)
    return jnp.array([[c, zero, -s], [zero, one, zero], [s, zero, c]])


def R3(kappa: Scalar) -> Float[Array, "3 3"]:
    """Rotation of the axes about the third axis, z, by κ in radians."""
    c, s = jnp.cos(kappa), jnp.sin(kappa)
    one, zero = jnp.ones_like(c), jnp.zeros_like(c)
    return jnp.array([[c, s, zero], [-s, c, zero], [zero, zero, one]])


@traced_once
def matrix_from_omega_phi_kappa(angles: Float[AnyArray, "3"]) -> Float[Array, "3 3"]:
    """M = R3(κ)·R2(φ)·R1(ω) of (ω, φ, κ) in radians (Wolf and Dewitt, 2000, appendix C).

    ⎡ cos φ cos κ   cos ω sin κ + sin ω sin φ cos κ   sin ω sin κ − cos ω sin φ cos κ⎤
    ⎢−cos φ sin κ   cos ω cos κ − sin ω sin φ sin κ   sin ω cos κ + cos ω sin φ sin κ⎥
    ⎣    sin φ              −sin ω cos φ                       cos ω cos φ           ⎦
    """
    omega, phi, kappa = angles
    return R3(kappa) @ R2(phi) @ R1(omega)


def quaternion_from_omega_phi_kappa(angles: Float[AnyArray, "3"]) -> Float[Array, "4"]:
    """The unit quaternion, w ≥ 0, of M = R3(κ)·R2(φ)·R1(ω); (ω, φ, κ) in radians.

    The product of those of the elementary rotations, (cos ½α, −sin ½α·e)."""

    def about(axis: int, angle: Scalar) -> Float[Array, "4"]:
        c, s = jnp.cos(angle / 2), jnp.sin(angle / 2)
        return jnp.stack([c, *(-s if i == axis else jnp.zeros_like(s) for i in range(3))])

    omega, phi, kappa = angles
    # In the order of the matrices: R3·R2·R1.
    q = quaternion_multiply(about(1, phi), about(0, omega))
    q = quaternion_multiply(about(2, kappa), q)
    return jnp.where(q[0] < 0, -q, q)


@traced_once
def omega_phi_kappa_from_matrix(M: Float[AnyArray, "3 3"]) -> Float[Array, "3"]:
    """(ω, φ, κ) in radians, ω and κ in (−π, π], φ in [−π/2, π/2]; ω = 0 at φ = ±90°."""
    (_, m12, m13), (_, m22, m23), (m31, m32, m33) = M
    omega = _angle(-m32, m33)
    c, s = jnp.cos(omega), jnp.sin(omega)
    phi = jnp.arctan2(m31, c * m33 - s * m32)
    kappa = jnp.arctan2(c * m12 + s * m13, c * m22 + s * m23)
    return jnp.stack([omega, phi, kappa])


@traced_once
def omega_phi_kappa_near(
    M: Float[AnyArray, "3 3"], given: Float[AnyArray, "3"]
) -> Float[Array, "3"]:
    """(ω, φ, κ) of M in radians, of all its representations the one nearest to the given angles.

    (ω, φ, κ) and (ω + π, π − φ, κ + π) are one rotation, and so are whole turns of each.
    """
    angles = omega_phi_kappa_from_matrix(M)
    # (ω + π, π − φ, κ + π): the same rotation by the other branch of φ.
    second_solution = angles * jnp.array([1.0, -1.0, 1.0]) + jnp.pi
    # Whole turns nearest to the given angles.
    nearest_turn = lambda a: a + 2 * jnp.pi * jnp.round((given - a) / (2 * jnp.pi))
    angles, second_solution = nearest_turn(angles), nearest_turn(second_solution)
    distance = lambda a: jnp.sum((a - given) ** 2)
    return jnp.where(distance(second_solution) < distance(angles), second_solution, angles)


@traced_once
def matrix_from_phi_omega_kappa(angles: Float[AnyArray, "3"]) -> Float[Array, "3 3"]:
    """M = R3(κ)·R1(ω)·R2(φ) of (φ, ω, κ), in this order, in radians.

    The third row is (cos ω sin φ, −sin ω, cos ω cos φ).
    """
    phi, omega, kappa = angles
    return R3(kappa) @ R1(omega) @ R2(phi)


@traced_once
def phi_omega_kappa_from_matrix(M: Float[AnyArray, "3 3"]) -> Float[Array, "3"]:
    """(φ, ω, κ) in radians, φ and κ in (−π, π], ω in [−π/2, π/2]; φ = 0 at ω = ±90°."""
    (m11, _, m13), (m21, _, m23), (m31, m32, m33) = M
    phi = _angle(m31, m33)
    c, s = jnp.cos(phi), jnp.sin(phi)
    omega = jnp.arctan2(-m32, s * m31 + c * m33)
    kappa = jnp.arctan2(s * m23 - c * m21, c * m11 - s * m13)
    return jnp.stack([phi, omega, kappa])


@traced_once
def matrix_from_azimuth_tilt_swing(angles: Float[AnyArray, "3"]) -> Float[Array, "3 3"]:
    """M = R3(s − π)·R1(t)·R3(−α) of (α, t, s) in radians (Wolf and Dewitt, 2000, appendix C).

    The azimuth α of the principal plane counts clockwise from +Y, the tilt t is the angle between
    the camera axis and the vertical, the swing s counts clockwise from +y to the nadir point.

    ⎡−cos α cos s − sin α cos t sin s    sin α cos s − cos α cos t sin s   −sin t sin s⎤
    ⎢ cos α sin s − sin α cos t cos s   −sin α sin s − cos α cos t cos s   −sin t cos s⎥
    ⎣         −sin α sin t                       −cos α sin t                  cos t   ⎦
    """
    azimuth, tilt, swing = angles
    return R3(swing - jnp.pi) @ R1(tilt) @ R3(-azimuth)


@traced_once
def azimuth_tilt_swing_from_matrix(M: Float[AnyArray, "3 3"]) -> Float[Array, "3"]:
    """(α, t, s) in radians, α and s in (−π, π], t in [0, π]; α = 0 for a vertical photograph."""
    (m11, m12, _), (m21, m22, _), (m31, m32, m33) = M
    azimuth = _angle(-m31, -m32)
    c, s = jnp.cos(azimuth), jnp.sin(azimuth)
    tilt = jnp.arctan2(-s * m31 - c * m32, m33)
    swing = jnp.arctan2(c * m21 - s * m22, s * m12 - c * m11)
    return jnp.stack([azimuth, tilt, swing])


def matrix_from_rodrigues(p: Float[AnyArray, "3"]) -> Float[Array, "3 3"]:
    """The Rodrigues matrix of (a, b, c) = 2n·tan(θ/2), without unit (Schut, 1959; Faig, 1984).

    M is the matrix of the quaternion (1, a/2, b/2, c/2), whose squared length is Δ:

    Δ·m11 = 1 + ¼(a² − b² − c²),  Δ·m12 = −c + ½ab,  Δ·m21 = c + ½ab,  and so on cyclically.
    """
    return matrix_from_quaternion(jnp.concatenate([jnp.ones_like(p[:1]), p / 2]))


def rodrigues_from_matrix(M: Float[AnyArray, "3 3"]) -> Float[Array, "3"]:
    """Rodrigues' parameters (a, b, c) = 2n·tan(θ/2), without unit.

    Undefined, not finite or meaninglessly large, where M turns by 180°.
    """
    q = quaternion_from_matrix(M)
    return 2 * q[1:] / q[0]


def _angle(sine: Scalar, cosine: Scalar) -> Array:
    """arctan2, but constant zero where both arguments vanish: an angle that gimbal lock leaves
    undefined."""
    is_undefined = sine**2 + cosine**2 < (8 * jnp.finfo(jnp.result_type(sine)).eps) ** 2
    return jnp.where(is_undefined, 0, jnp.arctan2(sine, jnp.where(is_undefined, 1, cosine)))
