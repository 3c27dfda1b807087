"""Polynomials, their coefficients from the constant upwards (Horner)."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

Coefficients = Float[Array, "k *shape"] | Sequence[Float[Array, "*shape"] | float]


def value(coefficients: Coefficients, x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """c₀ + c₁·x + c₂·x² + …"""
    total = coefficients[-1]
    for c in coefficients[-2::-1]:
        total = total * x + c
    return total


def value_and_rate(
    coefficients: Coefficients, x: Float[Array, "*shape"]
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """The same, and its derivative by x."""
    total, rate = coefficients[-1], jnp.zeros_like(x)
    for c in coefficients[-2::-1]:
        total, rate = total * x + c, rate * x + total
    return total, rate
