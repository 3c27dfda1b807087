"""What the code of a program depends on, in words, as its key (`programs`).

Functions and classes of this package and of those it builds on are described by their names: their
sources and versions are in the key. Everything unknown raises `CannotDescribe`.
"""

import ast
import collections
import dataclasses
import enum
import functools
import hashlib
import re
import sys
import time
import types
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer

IMPORTED = time.time_ns()
ROOT = Path(__file__).parents[1]
SETTINGS = tuple(name for name in (
    "jax_debug_infs", "jax_debug_nans", "jax_default_matmul_precision", "jax_default_prng_impl",
    "jax_explicit_x64_dtypes", "jax_high_dynamic_range_gumbel", "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion", "jax_random_seed_offset", "jax_softmax_custom_jvp",
    "jax_threefry_gpu_kernel_lowering", "jax_threefry_partitionable",
    "jax_use_shardy_partitioner",
) if hasattr(jax.config, name))  # fmt: skip
"""JAX's settings on which the code of a program depends."""
BUILT_ON = ("jax", "jaxlib", "jaxtyping", "equinox", "lineax", "numpy", "optimistix")
KNOWN = frozenset(("builtins", "functools", "jaxbundle", "operator", *BUILT_ON))
"""Packages whose functions and classes are described by their names."""
JITTED = type(jax.jit(abs))
CONSTANT = re.compile(rb"\n([A-Z][A-Z0-9_]*) = ([-+\w.\"'(][^\n#]*)(?=\n)")
FUNCTION = re.compile(rb"\ndef (\w*[a-z]\w*)\(")
SHORTEST_CHECK = 2.0
"""Seconds between two looks at the times of all sources."""


class CannotDescribe(Exception):
    """Something on which a program depends in an unknown way."""


def setting(name: str) -> Any:
    """A setting of JAX, as it is here: some can be changed within a block."""
    return getattr(jax.config, name)


def quick_key(leaves, tree, others, compiled_in) -> Any:
    """A key within this process, from equality as of `jax.jit`; None where arguments cannot be
    compared.

    **Raises:** `CannotDescribe` under a transformation, and for arrays on other devices."""
    words: list[str] = []
    for x in leaves:
        _describe_data(x, words)
    static, shape = jax.tree.flatten(others)
    exact = tuple((type(x), repr(x) if isinstance(x, float) else x) for x in static)
    settings = *map(setting, SETTINGS), jax.dtypes.canonicalize_dtype(float)
    key = tuple(words), tree, exact, shape, compiled_in, settings
    try:
        hash(key)
    except TypeError:
        return None
    return key


def describe_surroundings() -> list[str]:
    """What programs depend on besides their arguments.

    **Raises:** `CannotDescribe` if the package is not as in its files."""
    state, sources = state_of_package()
    if not _is_as_in_files(sources):
        raise CannotDescribe
    settings = [(name, repr(setting(name))) for name in SETTINGS]
    mesh = getattr(jax.sharding, "get_abstract_mesh", lambda: None)()
    number = jax.dtypes.canonicalize_dtype(float)
    return [state, repr(settings), repr((jax.default_backend(), jax.device_count(), number, mesh))]


class Source(NamedTuple):
    """What a source defines: constants that are literals of one line, of a name that occurs again
    all; and functions."""

    constants: dict[str, tuple]
    functions: list[str]


@functools.cache
def state_of_package() -> tuple[str, dict[str, Source]]:
    """The sources of this package and the versions of those it builds on, as words; and what they
    define, by module.

    **Raises:** `CannotDescribe` if the sources cannot be read."""
    digest, sources, files = hashlib.blake2b(digest_size=16), {}, _list_sources()
    for file in files:
        try:
            source = file.read_bytes()
        except OSError:
            raise CannotDescribe from None
        inside = file.relative_to(ROOT)
        digest.update(str(inside).encode() + source)
        module = ".".join(("jaxbundle", *inside.with_suffix("").parts)).removesuffix(".__init__")
        sources[module] = _read_source(source)
    try:
        versions = [version(name) for name in ("jaxbundle", *BUILT_ON)]
    except PackageNotFoundError:
        raise CannotDescribe from None
    return " ".join((digest.hexdigest(), sys.version, *versions)), sources


@functools.cache
def _list_sources() -> list[Path]:
    """The sources of this package.

    **Raises:** `CannotDescribe` if they are not files, as in an archive."""
    files = sorted(ROOT.rglob("*.py"))
    if Path(__file__) not in files:
        raise CannotDescribe
    return files


def _read_source(source: bytes) -> Source:
    constants: dict[str, tuple] = {}
    for name, text in CONSTANT.findall(source):
        try:
            name = name.decode()
            constants[name] = ast.literal_eval(text.decode()), *constants.get(name, ())
        except (ValueError, SyntaxError, TypeError):
            continue
    return Source(constants, [name.decode() for name in FUNCTION.findall(source)])


def _is_as_in_files(sources: dict[str, Source]) -> bool:
    """Whether no source has changed since the import, and no constant or function of a module was
    replaced, as in an experiment."""
    if not _are_older_than_import(int(time.monotonic() / SHORTEST_CHECK)):
        return False
    return not any(_find_replaced(name, source) for name, source in sources.items())


@functools.lru_cache(1)
def _are_older_than_import(_: int) -> bool:
    """Whether no source has changed since the import; asked once for each argument."""
    try:
        return all(file.stat().st_mtime_ns <= IMPORTED for file in _list_sources())
    except OSError:
        return False


def _find_replaced(name: str, source: Source) -> list[str]:
    """The constants and functions of a module that are not those of its source."""
    inside = vars(sys.modules[name]) if name in sys.modules else {}
    known = source.constants.items() if inside else ()
    replaced = [c for c, values in known if c in inside and inside[c] not in values]
    for function in source.functions if inside else ():
        x = inside.get(function)
        if isinstance(x, types.FunctionType) and (x.__module__, x.__name__) != (name, function):
            replaced.append(function)
    return replaced


def describe(x: Any, found: list[str], is_data: Callable | None) -> None:
    """Append what a program can depend on in `x`: of the leaves that are data only shape and type;
    `is_data` None: everything is compiled in.

    **Raises:** `CannotDescribe`."""
    if is_data is not None and is_data(x):
        _describe_data(x, found)
    elif x is None or type(x) in (bool, int, float, complex, str, bytes):
        found.append(f"{type(x).__name__} {x!r}")
    elif eqx.is_array(x):
        _describe_data(x, found)
        found.append(hashlib.blake2b(np.asarray(x).tobytes()).hexdigest())
    elif isinstance(x, type | types.FunctionType):
        _describe_function(x, found)
    elif type(x) in (list, tuple, range, frozenset) or _is_named_tuple(x):
        _describe_name(type(x), found)
        found.append(str(len(x)))
        for item in sorted(x, key=repr) if isinstance(x, frozenset) else x:
            describe(item, found, is_data)
    elif type(x) in (dict, collections.OrderedDict, types.MappingProxyType):
        found.append(f"{type(x).__name__} {len(x)}")
        for key, value in x.items():
            describe(key, found, None)
            describe(value, found, is_data)
    elif isinstance(x, enum.Enum):
        _describe_name(type(x), found)
        found.append(x.name)
    elif isinstance(x, jax.sharding.Mesh):
        found.append(f"mesh {x} {[device.id for device in x.devices.flat]}")
    elif not dataclasses.is_dataclass(x):
        _describe_function(x, found)
    else:
        _describe_name(type(x), found)
        for field in (f for f in dataclasses.fields(x) if f.compare):
            # A dataclass that is no module of equinox is one leaf to JAX.
            inside = isinstance(x, eqx.Module) and not field.metadata.get("static")
            found.append(field.name)
            describe(getattr(x, field.name, None), found, is_data if inside else None)


def _is_named_tuple(x: Any) -> bool:
    return isinstance(x, tuple) and hasattr(x, "_fields")


def _describe_data(x, found: list[str]) -> None:
    if isinstance(x, Tracer):
        raise CannotDescribe
    kind, spread = getattr(x, "dtype", None), ""
    if kind is not None and jax.dtypes.canonicalize_dtype(kind) != kind:
        raise CannotDescribe
    if isinstance(x, jax.Array):
        devices = x.devices()
        if next(iter(devices)).platform != jax.default_backend():
            raise CannotDescribe
        spread = x.sharding if len(devices) > 1 else ""
    if setting("jax_default_device") is not None:
        raise CannotDescribe
    weak = getattr(x, "weak_type", False)
    found.append(f"data {kind or type(x).__name__} {np.shape(x)} {weak} {spread}")


def _describe_function(x: Any, found: list[str]) -> None:
    """A function or class by its name; a function inside another one by its code and what it
    encloses."""
    if _is_named(x):
        return _describe_name(x, found)
    if type(x) is functools.partial:
        parts = [x.func, x.args, x.keywords]
    elif isinstance(x, types.MethodType):
        parts = [x.__func__, x.__self__]
    elif isinstance(x, types.FunctionType) and _runs_in_known(x):
        parts = _code_of(x)
    elif type(x) is JITTED:
        parts = [vars(x)["__wrapped__"]]
    elif isinstance(x, jax.custom_jvp):
        parts = [x.fun, x.jvp]
    elif type(x) is object and x is NO_AXIS:
        parts = []
    else:
        raise CannotDescribe
    found.append(str(type(x).__name__))
    for part in parts:
        describe(part, found, None)


def _code_of(x: types.FunctionType) -> list:
    code = x.__code__
    constants = [c for c in code.co_consts if not isinstance(c, types.CodeType)]
    where = x.__globals__["__name__"], x.__qualname__, code.co_names
    cells = [cell.cell_contents for cell in x.__closure__ or ()]
    return [
        *where, code.co_freevars, code.co_code, repr(constants), repr(list(code.co_positions())),
        x.__defaults__, x.__kwdefaults__, cells,
    ]  # fmt: skip


def _describe_name(x: Any, found: list[str]) -> None:
    if not _is_named(x):
        raise CannotDescribe
    found.append(f"{x.__module__} {x.__qualname__}")


def _is_named(x: Any) -> bool:
    """Whether `x` can be found by its name in a known module."""
    if isinstance(x, types.FunctionType) and not _runs_in_known(x):
        return False
    module, name = getattr(x, "__module__", None), getattr(x, "__qualname__", None)
    if not (isinstance(module, str) and isinstance(name, str)) or not _is_known(module):
        return False
    there: Any = sys.modules.get(module)
    for part in name.split("."):
        there = getattr(there, part, None)
    return there is x


def _runs_in_known(x: types.FunctionType) -> bool:
    """Whether the code of a function is in a known module, whatever it says of itself."""
    return _is_known(str(x.__globals__.get("__name__", "")))


def _is_known(module: str) -> bool:
    return module.partition(".")[0] in KNOWN


def _find_no_axis(function: Any) -> Any:
    """The sentinel that `jax.vmap` encloses where no axis has a name."""
    for cell in getattr(function, "__closure__", None) or ():
        x = cell.cell_contents
        found = x if type(x) is object else _find_no_axis(x)
        if found is not None:
            return found
    return None


NO_AXIS = _find_no_axis(jax.vmap(abs))
