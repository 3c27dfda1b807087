"""Checks of arguments: one line names the argument and what is expected.

Masked values become NaN. Complex numbers are refused, and JAX tracers (under `jax.jit`, `jax.vmap`
or `jax.grad`) where numbers are needed.
"""

import functools
import inspect
import math
import numbers
import operator
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ParamSpec, TypeVar

import jax
import numpy as np
from jax.core import Tracer

from jaxbundle.errors import InputError

P = ParamSpec("P")
T = TypeVar("T")
# Fits in the 32-bit integers of compiled programs; no count here comes near it.
LARGEST_INTEGER = 10**9


def show(value: Any) -> str:
    """A value for a message; long ones are cut."""
    text = " ".join(repr(value.item() if isinstance(value, np.generic) else value).split())
    return text if len(text) <= 60 else f"{text[:58]}…"


def integer(name: str, value: Any, least: int = 1, most: int = LARGEST_INTEGER) -> int:
    """A whole number from `least` to `most`.

    **Raises:** `InputError`."""
    refuse_traced(name, value)
    try:
        number = least - 1 if isinstance(value, bool | np.bool_) else operator.index(value)
    except TypeError:
        number = least - 1
    if not least <= number <= most:
        upper = "10⁹" if most == LARGEST_INTEGER else most
        raise InputError(
            f"{name} must be a whole number from {least} to {upper}, but is {show(value)}"
        )
    return number


def number(
    name: str, value: Any, expected: str = "a number", good: Callable[[float], bool] = math.isfinite
) -> float:
    """A number that satisfies `good`, by default a finite one.

    **Raises:** `InputError`."""
    refuse_traced(name, value)
    value = value.item() if isinstance(value, np.ndarray | jax.Array) and not value.ndim else value
    real = isinstance(value, numbers.Real) and not isinstance(value, bool | np.bool_)
    try:
        if real and good(float(value)):
            return float(value)
    except OverflowError:
        pass
    raise InputError(f"{name} must be {expected}, but is {show(value)}")


def positive(name: str, value: Any) -> float:
    """A finite number above 0.

    **Raises:** `InputError`."""
    return number(name, value, "a positive number", lambda x: 0 < x < math.inf)


def at_least_zero(name: str, value: Any) -> float:
    """A non-negative number, possibly infinite.

    **Raises:** `InputError`."""
    return number(name, value, "0 or a positive number", lambda x: x >= 0)


def one_of(name: str, value: Any, choices: Sequence[str], allow_none: bool = False) -> str | None:
    """One of the given words, or None if allowed.

    **Raises:** `InputError`."""
    if (value is None and allow_none) or (isinstance(value, str) and value in choices):
        return value
    expected = f"one of {', '.join(choices)}" if len(choices) > 1 else choices[0]
    raise InputError(f"{name} must be {expected}{' or None' * allow_none}, not {show(value)}")


def truth(name: str, value: Any) -> bool:
    """True or False.

    **Raises:** `InputError`."""
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"{name} must be True or False, but is {show(value)}")
    return bool(value)


def text(name: str, value: Any) -> str:
    """A non-empty text.

    **Raises:** `InputError`."""
    if not isinstance(value, str) or not value.strip():
        raise InputError(f"{name} must be a text, but is {show(value)}")
    return value


def path(name: str, value: Any) -> str:
    """The path of a file or folder.

    **Raises:** `InputError`."""
    if not isinstance(value, str | os.PathLike):
        raise InputError(f"{name} must be the path of a file or folder, but is {show(value)}")
    return os.fspath(value)


def numeric_array(name: str, values: Any, expected: str, truths: bool = False) -> np.ndarray:
    """Values as an array of real numbers, or of Booleans; a masked number becomes NaN, a masked
    Boolean False.

    **Raises:** `InputError` that says what is expected."""
    refuse_traced(name, values)
    masked = _stacked_masks(values)
    if masked is not None:
        values = masked
    try:
        array = np.asanyarray(values) if masked is not None else np.asarray(values)
    except (ValueError, TypeError):
        raise InputError(f"{name} must be {expected}, but its rows differ in length") from None
    if array.dtype.kind not in "biuf" or (array.dtype.kind == "b" and not truths):
        raise InputError(f"{name} must be {expected}, but {_got(array)}")
    if isinstance(array, np.ma.MaskedArray):
        truth = array.dtype.kind == "b"
        array = np.ma.filled(array, False) if truth else np.ma.filled(array.astype(float), np.nan)
    return array


def vector(name: str, value: Any, size: int, expected: str) -> np.ndarray:
    """Finite numbers [size]; one number stands for all of them.

    **Raises:** `InputError`."""
    array = numeric_array(name, value, expected).astype(float)
    if array.shape not in ((), (size,)) or not np.isfinite(array).all():
        raise InputError(f"{name} must be {expected}, but is {show(array.tolist())}")
    return np.broadcast_to(array, size)


def refuse_unknown(name: str, options: Mapping[str, Any], known: Callable[..., Any]) -> None:
    """Refuse options that a function does not pass on to `known`.

    **Raises:** `TypeError`, as Python does, but naming the function that was called."""
    names = [*inspect.signature(known).parameters]
    for option in sorted(options.keys() - {*names}):
        raise TypeError(
            f"{name}() has no argument {option!r}; beside its own it takes {', '.join(names)}"
        )


def refuse_traced(name: str, *values: Any) -> None:
    """Refuse JAX tracers anywhere in the values.

    **Raises:** `InputError`."""
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values)):
        raise InputError(
            f"{name} must be numbers, but is traced by JAX: this function does not work under "
            "jax.jit, jax.vmap or jax.grad; jaxbundle.solve does"
        )


def without_masks(function: Callable[P, T]) -> Callable[P, T]:
    """The function, refusing masked arrays, whose masks arithmetic of JAX would ignore.

    **Raises:** `InputError`."""

    @functools.wraps(function)
    def checked(*args: P.args, **options: P.kwargs) -> T:
        if any(isinstance(value, np.ma.MaskedArray) for value in (*args, *options.values())):
            raise InputError(
                f"{function.__name__}: a masked array, expected numbers: leave masked rows out, or "
                "give them the weight 0"
            )
        return function(*args, **options)

    return checked


def _stacked_masks(values: Any) -> np.ma.MaskedArray | None:
    """A masked array, also from lists of masked arrays, whose masks `np.asarray` would lose."""
    if isinstance(values, np.ma.MaskedArray):
        return values
    if isinstance(values, list | tuple) and any(
        isinstance(leaf, np.ma.MaskedArray) for leaf in jax.tree.leaves(values)
    ):
        parts = [(part, _stacked_masks(part)) for part in values]
        try:
            return np.ma.stack(
                [np.ma.asanyarray(part if masked is None else masked) for part, masked in parts]
            )
        except ValueError:
            return None
    return None


def _got(array: np.ndarray) -> str:
    if array.shape == ():
        return f"is {show(array.item())}"
    kinds = {"U": "text", "S": "text", "c": "complex numbers", "b": "truth values"}
    return f"contains {kinds.get(array.dtype.kind, f'values of type {array.dtype}')}"
