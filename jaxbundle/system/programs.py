"""Programs that a later process starts without tracing.

JAX keeps compiled programs (`keep_programs`) but finds them by their code, for which the function
must be traced and lowered first: of a small adjustment in a second process that took longer than
everything after the imports. Hence the code is kept as well (StableHLO, by `jax.export`), under a
key of everything it depends on: the sources of this package, versions, settings, the shapes and
types of all arrays, and everything else in the arguments. If an argument cannot be described, such
as a function from outside the package, the function is traced as usual.
"""

import dataclasses
import enum
import functools
import hashlib
import os
import pickle
import sys
import threading
import types
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jaxlib
import numpy as np
from jax import export
from jax.core import Tracer

from jaxbundle.system.configuration import folder_of_programs
from jaxbundle.system.temporaries import temporary

SETTINGS = (
    "jax_debug_infs", "jax_debug_nans", "jax_default_device", "jax_default_matmul_precision",
    "jax_default_prng_impl", "jax_disable_jit", "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion", "jax_threefry_partitionable",
)  # fmt: skip
"""JAX's settings on which the code of a program depends."""
DESCRIBABLE = frozenset(
    ("builtins", "equinox", "functools", "jax", "jaxbundle", "jaxlib", "lineax", "numpy",
     "operator", "optimistix")
)  # fmt: skip
"""Packages whose functions and classes are described by their names: their versions are in the
key."""
LAYOUT = export.DisabledSafetyCheck.custom_call("LayoutConstraint")
"""`elimination.py` requests a memory layout; the same version of JAX reads it back."""


def compile_once(function: Callable, static: Sequence[int] | int | None = None, **options) -> Any:
    """`jax.jit` for functions of a module, with programs kept for later processes.

    `static`: the positions of arguments compiled in; None: everything that is no array, as by
    `equinox.filter_jit`. `options`: of `jax.jit`."""
    positions = (static,) if isinstance(static, int) else static
    programs: dict[str, _Program] = {}
    lock = threading.RLock()
    if positions is None:
        jitted = eqx.filter_jit(function, **options)
    else:
        jitted = jax.jit(function, static_argnums=positions, **options)

    @functools.wraps(function)
    def run(*args, **kwargs):
        folder = folder_of_programs()
        if folder is None or _setting("jax_disable_jit") or jax.process_count() > 1:
            return jitted(*args, **kwargs)
        given = _Given(args, kwargs, positions)
        try:
            key = given.key_for(function)
        except _CannotDescribe:
            return jitted(*args, **kwargs)
        with lock:
            if key not in programs:
                file = Path(folder) / f"{function.__name__}-{key}-traced"
                exported, result = _read(file) or _trace(function, given, file)
                programs[key] = _Program(exported, result, options)
        return programs[key](given.leaves)

    return run


class _Given:
    """The arguments of a call: `leaves`, the arrays, and everything else."""

    def __init__(self, args: tuple, kwargs: dict, static: Sequence[int] | None):
        is_data = eqx.is_array if static is None else eqx.is_array_like
        self.static = frozenset(static or ())
        fixed = lambda i: jax.tree.map(lambda _: i not in self.static, args[i])
        chosen = tuple(fixed(i) for i in range(len(args))), jax.tree.map(lambda _: True, kwargs)
        data = jax.tree.map(lambda x, chosen: chosen and is_data(x), (args, kwargs), chosen)
        self.args, self.kwargs, self.is_data = args, kwargs, is_data
        arrays, self.others = eqx.partition((args, kwargs), data)
        self.leaves, self.tree = jax.tree.flatten(arrays)

    def with_leaves(self, leaves) -> tuple[tuple, dict]:
        """The arguments with other arrays."""
        return eqx.combine(jax.tree.unflatten(self.tree, leaves), self.others)

    def key_for(self, function: Callable) -> str:
        """What the program depends on, as a digest."""
        settings = [(name, repr(_setting(name))) for name in SETTINGS]
        number = jax.dtypes.canonicalize_dtype(float)
        place = jax.default_backend(), jax.device_count(), number
        found = [_state_of_package(), repr(settings), repr(place)]
        _describe(function, found, None)
        for i, x in enumerate(self.args):
            _describe(x, found, None if i in self.static else self.is_data)
        _describe(self.kwargs, found, self.is_data)
        return hashlib.blake2b("\n".join(found).encode(), digest_size=16).hexdigest()


@dataclasses.dataclass(frozen=True)
class _Place:
    """The place of an array in the results of a program."""

    number: int


class _Program:
    """A program of a list of arrays. `result`: its result with a `_Place` for every array."""

    def __init__(self, exported: export.Exported, result: Any, options: dict):
        def call(*leaves):
            return exported.call(*leaves)

        call.__name__ = exported.fun_name
        self.call, self.result = jax.jit(call, **options), result

    def __call__(self, leaves: list) -> Any:
        found = self.call(*leaves)
        place = lambda x: isinstance(x, _Place)
        fill = lambda x: found[x.number] if place(x) else x
        return jax.tree.map(fill, self.result, is_leaf=place)


def _trace(function: Callable, given: _Given, file: Path) -> tuple[export.Exported, Any]:
    """Trace a function, and keep the code if it can be written."""
    result: Any = None

    def of_leaves(*leaves):
        nonlocal result
        args, kwargs = given.with_leaves(leaves)
        arrays, rest = eqx.partition(function(*args, **kwargs), eqx.is_array)
        found, shape = jax.tree.flatten(arrays)
        result = eqx.combine(jax.tree.unflatten(shape, map(_Place, range(len(found)))), rest)
        return found

    of_leaves.__name__ = function.__name__
    exported = export.export(jax.jit(of_leaves), disabled_checks=[LAYOUT])(*given.leaves)
    _write(file, exported, result)
    return exported, result


def _read(file: Path) -> tuple[export.Exported, Any] | None:
    """A kept program; None if there is none, or it is damaged."""
    try:
        code, result = pickle.loads(file.read_bytes())
        return export.deserialize(code), result
    except Exception:
        # Whatever a damaged file raises: it is traced again and replaced.
        return None


def _write(file: Path, exported: export.Exported, result: Any) -> None:
    """Keep a program; without a word if that is impossible, as for a full disk."""
    try:
        content = pickle.dumps((bytes(exported.serialize()), result))
        with temporary(file.with_name(f".{file.name}.{os.getpid()}")) as new:
            new.write_bytes(content)
            new.replace(file)
    except (OSError, ImportError, pickle.PickleError, AttributeError, TypeError):
        pass


# ---------------------------------------------------------------------- the key of a program


class _CannotDescribe(Exception):
    """An argument on which the program depends in an unknown way."""


def _setting(name: str) -> Any:
    """A setting of JAX, as it is here: some can be changed within a block."""
    return getattr(jax.config, name)


@functools.cache
def _state_of_package() -> str:
    """The sources of this package, and the versions of all that generate code."""
    digest = hashlib.blake2b(digest_size=16)
    root = Path(__file__).parents[1]
    for file in sorted(root.rglob("*.py")):
        digest.update(str(file.relative_to(root)).encode())
        digest.update(file.read_bytes())
    modules = [sys.modules[name] for name in ("equinox", "lineax", "optimistix", "jaxtyping")
               if name in sys.modules]  # fmt: skip
    versions = [str(module.__version__) for module in (jax, jaxlib, np, *modules)]
    return " ".join((digest.hexdigest(), sys.version, *versions))


def _describe(x: Any, found: list[str], is_data: Callable | None) -> None:
    """Append what a program can depend on in `x`: of the leaves that are data only shape and type;
    `is_data` None: everything is compiled in.

    **Raises:** `_CannotDescribe`."""
    if isinstance(x, Tracer):
        raise _CannotDescribe
    if is_data is not None and is_data(x):
        _describe_data(x, found)
    elif x is None or isinstance(x, bool | int | float | complex | str | bytes):
        found.append(f"{type(x).__name__} {x!r}")
    elif eqx.is_array(x):
        _describe_data(x, found)
        found.append(hashlib.blake2b(np.asarray(x).tobytes()).hexdigest())
    elif isinstance(x, list | tuple | range):
        _describe_name(type(x), found)
        found.append(str(len(x)))
        for item in x:
            _describe(item, found, is_data)
    elif isinstance(x, dict):
        found.append(f"dict {len(x)}")
        for key, value in x.items():
            _describe(key, found, None)
            _describe(value, found, is_data)
    elif isinstance(x, enum.Enum):
        _describe_name(type(x), found)
        found.append(x.name)
    elif isinstance(x, jax.sharding.Mesh):
        found.append(f"mesh {x} {[device.id for device in x.devices.flat]}")
    elif type(x) is object:  # a sentinel
        found.append("object")
    elif isinstance(x, type | types.FunctionType) or not dataclasses.is_dataclass(x):
        _describe_function(x, found)
    else:
        _describe_name(type(x), found)
        for field in (f for f in dataclasses.fields(x) if f.compare):
            # A dataclass that is no module of equinox is one leaf to JAX.
            inside = isinstance(x, eqx.Module) and not field.metadata.get("static")
            found.append(field.name)
            _describe(getattr(x, field.name, None), found, is_data if inside else None)


def _describe_data(x, found):
    kind, weak = getattr(x, "dtype", type(x).__name__), getattr(x, "weak_type", False)
    spread = isinstance(x, jax.Array) and len(x.devices()) > 1
    found.append(f"data {kind} {np.shape(x)} {weak} {x.sharding if spread else ''}")


def _describe_function(x, found):
    """A function or class by its name; a function inside another one by its code and what it
    encloses."""
    if _is_named(x):
        return _describe_name(x, found)
    if isinstance(x, functools.partial):
        parts = [x.func, x.args, x.keywords]
    elif isinstance(x, types.MethodType):
        parts = [x.__func__, x.__self__]
    elif isinstance(x, types.FunctionType) and _is_known(x):
        code = x.__code__
        constants = [c for c in code.co_consts if not isinstance(c, types.CodeType)]
        found.append(f"{x.__module__} {x.__qualname__} {code.co_code.hex()} {constants!r}")
        found.append(repr(list(code.co_positions())))
        cells = [cell.cell_contents for cell in x.__closure__ or ()]
        parts = [x.__defaults__, x.__kwdefaults__, cells]
    elif _is_known(type(x)) and hasattr(x, "__wrapped__"):  # of jax.jit, say
        parts = [x.__wrapped__]
    else:
        raise _CannotDescribe
    found.append(type(x).__name__)
    for part in parts:
        _describe(part, found, None)


def _describe_name(x, found):
    if not _is_named(x):
        raise _CannotDescribe
    found.append(f"{x.__module__} {x.__qualname__}")


def _is_named(x) -> bool:
    """Whether `x` can be found by its name in a known module."""
    if not _is_known(x) or not isinstance(getattr(x, "__qualname__", None), str):
        return False
    there: Any = sys.modules.get(x.__module__)
    for name in x.__qualname__.split("."):
        there = getattr(there, name, None)
    return there is x


def _is_known(x) -> bool:
    return str(getattr(x, "__module__", "")).partition(".")[0] in DESCRIBABLE
