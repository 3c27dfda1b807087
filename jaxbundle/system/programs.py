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


QUICK_OPTIONS = {"xla_backend_optimization_level": 0}


def quick_jit(function: Callable, static: Sequence[int] | int = ()) -> Callable:
    """`compile_once` with little optimisation, for programs that take longer to compile than to
    run: the relative orientation of eight pairs of 64 points (jaxlib 0.10, one core) is compiled in
    4.9 s instead of 11.4 s, run in 0.37 s instead of 0.27 s."""
    return compile_once(function, static, compiler_options=QUICK_OPTIONS)
