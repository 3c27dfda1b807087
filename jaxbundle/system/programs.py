"""Programs that a later process starts without tracing.

JAX keeps compiled programs (`keep_programs`) but finds them by their code, for which the function
must be traced and lowered first: of a small adjustment in a second process that took longer than
everything after the imports. Hence the code is kept as well (StableHLO, by `jax.export`), under a
key of everything it depends on: the sources of this package, versions, settings, the shapes and
types of all arrays, and everything that is compiled in (`program_keys`). Where this is not known,
as for a function from outside the package, the function is traced as usual.
"""

import dataclasses
import functools
import hashlib
import inspect
import os
import pickle
import re
import time
import uuid
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import export

from jaxbundle.system.configuration import folder_of_programs
from jaxbundle.system.program_keys import (
    CannotDescribe,
    describe,
    describe_surroundings,
    quick_key,
    setting,
)
from jaxbundle.system.temporaries import temporary

LAYOUT = export.DisabledSafetyCheck.custom_call("LayoutConstraint")
"""`elimination.py` requests a memory layout; the same version of JAX reads it back."""
CHECKSUM = 32
"""Bytes at the beginning of a file: JAX does not survive damaged code."""
LONGEST_UNUSED = 30 * 86400.0
"""Seconds after which the file of an unused program is removed."""


def compile_once(function: Callable, static: Sequence[int] | int | None = None, **options) -> Any:
    """`jax.jit` for functions of a module, with programs kept for later processes.

    `static`: the positions of arguments compiled in; None: everything that is no array, as by
    `equinox.filter_jit`. `options`: of `jax.jit`."""
    positions = (static,) if isinstance(static, int) else static
    known: dict[Any, Callable | None] = {}
    if positions is None:
        jitted = eqx.filter_jit(function, **options)
    else:
        jitted = jax.jit(function, static_argnums=positions, **options)

    @functools.wraps(function)
    def run(*args, **kwargs):
        folder = folder_of_programs()
        if folder is None or setting("jax_disable_jit") or jax.process_count() > 1:
            return jitted(*args, **kwargs)
        given = _Given(function, args, kwargs, positions)
        try:
            key = given.quick_key() or given.full_key()
        except CannotDescribe:
            return jitted(*args, **kwargs)
        if key not in known:
            known[key] = _find(function, given, Path(folder), options)
        program = known[key]
        return jitted(*args, **kwargs) if program is None else program(given.leaves)

    return run


class _Given:
    """The arguments of a call: `leaves`, the arrays, and everything else."""

    def __init__(self, function: Callable, args: tuple, kwargs: dict, static):
        if kwargs and static:
            bound = inspect.signature(function).bind(*args, **kwargs)
            args, kwargs = bound.args, bound.kwargs
        self.function, self.args, self.kwargs = function, args, kwargs
        self.static, self.all_data = frozenset(static or ()), static is not None
        self.is_data = eqx.is_array_like if self.all_data else eqx.is_array
        traced = tuple(None if i in self.static else x for i, x in enumerate(args)), kwargs
        self.arrays, self.others = eqx.partition(traced, self.is_data)
        self.leaves, self.tree = jax.tree.flatten(self.arrays)

    def with_leaves(self, leaves) -> tuple[list, dict]:
        """The arguments with other arrays."""
        traced, kwargs = eqx.combine(jax.tree.unflatten(self.tree, leaves), self.others)
        return [self.args[i] if i in self.static else x for i, x in enumerate(traced)], kwargs

    def quick_key(self) -> Any:
        """The key of a program in this process."""
        compiled_in = tuple(self.args[i] for i in sorted(self.static))
        return quick_key(self.leaves, self.tree, self.others, compiled_in)

    def full_key(self) -> str:
        """The key of a program in any process, as a digest."""
        found = describe_surroundings()
        describe(self.function, found, None)
        for i, x in enumerate(self.args):
            describe(x, found, None if i in self.static else self.is_data)
        describe(self.kwargs, found, self.is_data)
        return hashlib.blake2b("\n".join(found).encode(), digest_size=16).hexdigest()


@dataclasses.dataclass(frozen=True)
class _Place:
    """The place of an array in the results of a program."""

    number: int


def _find(function: Callable, given: _Given, folder: Path, options: dict) -> Callable | None:
    """The program of a call: read, or traced and kept; None if it cannot be kept."""
    name = re.sub(r"\W", "_", function.__name__)
    try:
        file = folder / f"{name}-{given.full_key()}-traced"
        exported, result = _read(file) or _trace(function, given, file)
    except (CannotDescribe, NotImplementedError, TypeError, ValueError):
        # An error of the function itself is raised again without a program.
        return None

    def call(*leaves):
        return exported.call(*leaves)

    call.__name__ = exported.fun_name
    compiled, is_place = jax.jit(call, **options), lambda x: isinstance(x, _Place)

    def run(leaves: list) -> Any:
        found = compiled(*leaves)
        fill = lambda x: found[x.number] if is_place(x) else x
        return jax.tree.map(fill, result, is_leaf=is_place)

    return run


def _trace(function: Callable, given: _Given, file: Path) -> tuple[export.Exported, Any]:
    """Trace a function, and keep the code if it can be written. The result has a `_Place` for
    every array."""
    result: Any = None

    def of_leaves(*leaves):
        nonlocal result
        args, kwargs = given.with_leaves(leaves)
        found = function(*args, **kwargs)
        if given.all_data:
            found = jax.tree.map(jnp.asarray, found)
        arrays, rest = eqx.partition(found, eqx.is_array)
        # Weak types are lost in a file.
        arrays = jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype), arrays)
        found, shape = jax.tree.flatten(arrays)
        result = eqx.combine(jax.tree.unflatten(shape, map(_Place, range(len(found)))), rest)
        return found

    of_leaves.__name__ = function.__name__
    exported = export.export(jax.jit(of_leaves), disabled_checks=[LAYOUT])(*given.leaves)
    _write(file, exported, result)
    return exported, result


def _read(file: Path) -> tuple[export.Exported, Any] | None:
    """A kept program; None if there is none, if it is damaged, or not the user's own."""
    try:
        content = file.read_bytes()
        check, content = content[:CHECKSUM], content[CHECKSUM:]
        if check != _checksum(content) or not _is_own(file):
            return None
        code, result = pickle.loads(content)
        os.utime(file)
        return export.deserialize(code), result
    except Exception:
        # Of another version, say: it is traced again and replaced.
        return None


def _write(file: Path, exported: export.Exported, result: Any) -> None:
    """Keep a program; without a word if that is impossible, as for a full disk."""
    try:
        content = pickle.dumps((bytes(exported.serialize()), result))
        with temporary(file.with_name(f".{uuid.uuid4().hex}")) as new:
            with open(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as opened:
                opened.write(_checksum(content) + content)
            os.replace(new, file)
        _remove_unused(file.parent)
    except (OSError, ImportError, NotImplementedError, pickle.PickleError, AttributeError,
            TypeError, ValueError):  # fmt: skip
        pass


def _checksum(content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=CHECKSUM).digest()


def _is_own(file: Path) -> bool:
    """Whether nobody else can have written a file."""
    if not hasattr(os, "geteuid"):
        return True
    state = file.stat()
    return state.st_uid == os.geteuid() and not state.st_mode & 0o022


@functools.cache
def _remove_unused(folder: Path) -> None:
    """Remove programs that have not been used for long; once per process."""
    latest = time.time() - LONGEST_UNUSED
    for file in folder.glob("*-traced"):
        if file.stat().st_mtime < latest:
            file.unlink(missing_ok=True)
