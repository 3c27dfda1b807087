"""A file that one process at a time writes.

The lock is an empty file beside it, `.NAME.lock`, that the operating system keeps locked (flock; on
Windows its first byte) until the process ends in any way: a lock file left by a killed process
has no effect. The file may be renamed over meanwhile.
"""

import errno
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

from jaxbundle.errors import InputError
from jaxbundle.system.temporaries import defer_interrupts, temporary

# Whether locks are those of Windows.
USES_MSVCRT = os.name == "nt"
# Errors of file systems without locks.
NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


@contextmanager
def hold_lock(
    path: str | Path, display_name: str | Path | None = None, needed: bool = True
) -> Iterator[None]:
    """Hold the lock of a file, which need not exist; devices and pipes have none.

    **Arguments:** `display_name`: the name in messages, by default the file; `needed`:
    whether a file system without locks is an error.

    **Raises:** `InputError` if another process holds it, or it cannot be locked.
    """
    if os.path.exists(path) and not os.path.isfile(path):
        yield
        return
    real_path, name = Path(os.path.realpath(path)), path if display_name is None else display_name
    if not real_path.parent.is_dir():
        raise InputError(f"{name}: there is no folder {real_path.parent}")
    lock = real_path.with_name(f".{real_path.name}.lock")
    with ExitStack() as cleanup:
        with defer_interrupts():  # A lock is removed only by the process that holds it.
            cleanup.enter_context(_acquire(lock, name, needed))
            # Removed before release: no other process locks a file about to vanish.
            cleanup.enter_context(temporary(lock))
        yield
    # Windows cannot remove open files: there it is removed now, unless another process has opened
    # it meanwhile.
    if USES_MSVCRT:
        with suppress(OSError):
            lock.unlink()


def _acquire(lock: Path, name: str | Path, needed: bool) -> BinaryIO:
    """The locked file.

    **Raises:** `InputError` as `hold_lock`."""
    try:
        while (stream := _open_locked(lock, needed)) is None:
            pass
    except BlockingIOError:
        raise InputError(
            f"{name}: another run is writing it; wait for its end, or give another name"
        ) from None
    except OSError as error:
        raise InputError(
            f"{name}: its lock {lock} cannot be made: {error.strerror}; the folder must be writable"
        ) from None
    return stream


def _open_locked(lock: Path, needed: bool) -> BinaryIO | None:
    """The file, locked; None if it vanished meanwhile.

    **Raises:** `BlockingIOError` if another process has the lock."""
    stream = open(lock, "ab")
    try:
        try:
            _lock(stream)
        except OSError as error:
            if needed or error.errno not in NO_LOCKS:
                raise
        if os.path.samestat(os.fstat(stream.fileno()), os.stat(lock)):
            return stream
    except FileNotFoundError:
        pass
    except BaseException:
        stream.close()
        raise
    stream.close()
    return None


def _lock(stream: BinaryIO) -> None:
    if not USES_MSVCRT:
        import fcntl

        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return
    msvcrt: Any = import_module("msvcrt")
    try:
        msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)
    except OSError as error:
        raise BlockingIOError(error.errno, error.strerror) from None
