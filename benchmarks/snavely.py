"""Snavely's camera in JAX, in the form of other programs: rotation vector, shift, f, k1, k2 in a
row."""

import jax.numpy as jnp


def residual(camera, X, xy):
    """Computed minus measured image point, pixels; camera [9], object point [3], image point [2].

    The formula of a BAL problem (Agarwal et al. 2010): P = R X + t, p = −(P₁, P₂)/P₃,
    f·(1 + k1·p² + k2·p⁴)·p; the rotation by Rodrigues' formula.
    """
    angle = jnp.linalg.norm(camera[:3]) + 1e-12
    axis = camera[:3] / angle
    turned = X * jnp.cos(angle) + jnp.cross(axis, X) * jnp.sin(angle)
    P = turned + axis * (axis @ X) * (1 - jnp.cos(angle)) + camera[3:6]
    p = -P[:2] / P[2]
    square = p @ p
    return camera[6] * (1 + square * (camera[7] + square * camera[8])) * p - xy
