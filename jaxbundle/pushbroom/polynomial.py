"""Polynomials, their coefficients from the constant upwards (Horner)."""

from collections.abc import Sequence

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxbundle.types import AnyArray, Scalar

Coefficients = Float[AnyArray, "k ..."] | Sequence[Scalar]


def value(coefficients: Coefficients, x: Scalar) -> Float[Array, "..."]:
    """c₀ + c₁·x + c₂·x² + …"""
    total = jnp.asarray(coefficients[-1])
    for c in coefficients[-2::-1]:
        total = total * x + c
    return total


def value_and_rate(
    coefficients: Coefficients, x: Scalar
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """c₀ + c₁·x + c₂·x² + … and its derivative by x, in one loop (Horner)."""
    total, rate = jnp.asarray(coefficients[-1]), jnp.zeros_like(x)
    for c in coefficients[-2::-1]:
        total, rate = total * x + c, rate * x + total
    return total, rate
