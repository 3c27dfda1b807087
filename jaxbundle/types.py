"""Types for annotations; shapes are those of jaxtyping.

Functions of one point, ray or pose accept JAX and NumPy arrays and return JAX arrays.
Formulas of unpacked scalars work element by element: given arrays, they work on many at once.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from jax import Array
from jaxtyping import Float

AnyArray = Array | np.ndarray
Numbers = Sequence[float] | Float[np.ndarray, " n"]
# Cells of a table: numbers, text, or other content of a file.
Column = Sequence[Any] | np.ndarray
Index = int | np.integer
Scalar = float | Float[AnyArray, "..."]
# `progress(stage, done, total)`: called when a stage of long work begins and as it advances.
Progress = Callable[[str, int, int], object]
T = TypeVar("T")


def not_none(value: T | None) -> T:
    """A value that cannot be None because of earlier checks, although its type allows it."""
    assert value is not None
    return value
