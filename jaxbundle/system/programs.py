"""Compilation of the functions that are called from the host: one place for its options."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax


def compile_once(
    function: Callable, static: Sequence[int] | int | None = None, **options: Any
) -> Any:
    """`jax.jit`, with `options`. `static`: the positions of arguments compiled in; None: everything
    that is no array, as by `equinox.filter_jit`."""
    if static is None:
        return eqx.filter_jit(function, **options)
    return jax.jit(function, static_argnums=static, **options)
