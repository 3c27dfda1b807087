"""Compilation of the functions that are called from the host: one place for its options.

Only JAX's own cache keeps compiled programs between processes; every process traces its functions
anew. Keeping the traced code as well (`jax.export`), found by a digest of all live code of the
package (bytecode, closures, classes, globals, versions), took 230 lines and saved a second process
of a small adjustment 0.5 s of 3.9, while a first one took 0.3 s more: not worth a program that may
be older than the code."""

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
