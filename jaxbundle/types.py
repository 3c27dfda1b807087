"""Types that annotations share; shapes are jaxtyping's.

Functions of one point, ray or pose take arrays of JAX and NumPy alike and return those of JAX.
Formulas of unpacked scalars work element by element: given arrays, they work on many at once.
"""

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from jax import Array
from jaxtyping import Float

AnyArray = Array | np.ndarray
Numbers = Sequence[float] | Float[np.ndarray, " n"]
Column = Sequence[Any] | np.ndarray
"""Cells of a table: numbers, text, or what a file has there."""
Index = int | np.integer
Scalar = float | Float[AnyArray, "..."]
T = TypeVar("T")


def present(value: T | None) -> T:
    """A value that is there by what was checked before, though its type allows for None."""
    assert value is not None
    return value
