"""The guard around third-party parsers: whatever they raise becomes an error that names the file.

Parsers of general formats (laspy, lazrs, Pillow, rasterio, zipfile, NumPy) raise on a damaged file
whatever their code runs into: `struct.error`, `KeyError`, `OverflowError`, a panic of Rust. Only
the call of the parser belongs inside the guard, so that a fault of this package is not taken for
one of the file. What no guard can catch, native code that aborts the process or allocates
gigabytes, is prevented by comparing the counts of a header with the length of the file before.
"""

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from jaxbundle.errors import InputError
from jaxbundle.system.memory import free_memory, is_memory_shortage

NOT_OF_FILES = (KeyboardInterrupt, SystemExit, GeneratorExit)


@contextmanager
def foreign_parser(path: str | Path, expected: str, *, shortage: bool = True) -> Iterator[None]:
    """The context of a call of a third-party parser.

    **Arguments:** `path`: the file, with the place in it if that is known (`"c.npz, array xy"`);
    `expected`: what the file should be, with its article (`"a saved adjustment"`); `shortage`:
    whether an error for lack of memory is one of the file, too; otherwise it is raised as it is.

    **Raises:** `InputError` for any error of the parser.
    """
    try:
        yield
    except InputError:
        raise
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{path}: no such file") from None
    except BaseException as error:  # panics of Rust (pyo3) are no `Exception`
        if isinstance(error, NOT_OF_FILES) or (not shortage and is_memory_shortage(error)):
            raise
        raise InputError(f"{path}: {_describe(error, expected)}") from None


def _describe(error: BaseException, expected: str) -> str:
    if is_memory_shortage(error):
        return (
            f"is damaged, or too large for the memory ({free_memory() / 1e9:.1f} GB are free); "
            f"expected {expected}"
        )
    if isinstance(error, OSError) and error.errno in (errno.EACCES, errno.EPERM, errno.EIO):
        return f"cannot be read: {error.strerror}"
    message = " ".join(str(error).split())[:200]
    kind = "" if message else type(error).__name__
    # The bare text of a KeyError is only the key.
    message = f"no {message}" if isinstance(error, KeyError) else message
    return f"is not {expected}, or is damaged: {message or kind}"
