"""Temporary files and folders that an interrupted run removes, and uninterruptible steps.

In a notebook or a program an interrupt is an exception, and the blocks below clean up as after any
other. The command line ends without one (`system.interrupts`): it calls `remove_temporaries`.
"""

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

TYPE_CHECKING = False  # avoids importing typing
if TYPE_CHECKING:
    from multiprocessing.process import BaseProcess

# By name, whether its content is removed too.
_temporaries: dict[str, bool] = {}
_caches: set[str] = set()
_processes: set["BaseProcess"] = set()
_lock = threading.RLock()
# The thread inside `defer_interrupts`, once per nested block.
_deferring_threads: list[int] = []
_put_off: list[Callable[[], None]] = []


@contextmanager
def temporary(path: str | os.PathLike, content: bool = True) -> Iterator[Path]:
    """A future file or folder that is removed at the end of the block if it exists.

    `content`: remove a folder with its content; otherwise only if empty.
    """
    name = os.path.abspath(path)
    with _lock:
        _temporaries[name] = content
    try:
        yield Path(path)
    finally:
        _remove(name, content)
        _temporaries.pop(name, None)


@contextmanager
def defer_interrupts() -> Iterator[None]:
    """An interrupt of the command line waits for the end of this block: for a few system calls that
    belong together, such as two renames, never for long work."""
    _lock.acquire()
    _deferring_threads.append(threading.get_ident())
    try:
        yield
    finally:
        _deferring_threads.pop()
        _lock.release()
        if _put_off and threading.get_ident() not in _deferring_threads:
            _put_off[0]()


def defer(action: Callable[[], None]) -> bool:
    """Whether this thread is inside `defer_interrupts`; then the action is called at the end of the
    block."""
    if threading.get_ident() not in _deferring_threads:
        return False
    _put_off.append(action)
    return True


def watch_cache(folder: str | os.PathLike) -> None:
    """Register a folder into which a library writes directly: files open at an interrupt are
    removed, since they are incomplete."""
    _caches.add(os.path.realpath(folder))


def watch_process(process: "BaseProcess", running: bool = True) -> None:
    """Register a process that an interrupt ends with this one, until it is no longer `running`."""
    _processes.add(process) if running else _processes.discard(process)


def remove_temporaries(patience: float) -> None:
    """Remove temporary files and end the processes of this one, which must end at once, since no
    `defer_interrupts` block can begin after this. A thread in such a block may finish it, within
    the given seconds."""
    _lock.acquire(timeout=patience)
    for process in [*_processes]:
        with suppress(OSError, ValueError):
            process.kill()
    for name, content in reversed(list(_temporaries.items())):
        _remove(name, content)
    _remove_open_files(_caches)


def _remove(name: str, content: bool) -> None:
    with suppress(OSError):
        if os.path.islink(name) or not os.path.isdir(name):
            os.unlink(name)
            return
        for folder, folders, files in os.walk(name, topdown=False) if content else ():
            for entry in (*files, *folders):
                path = os.path.join(folder, entry)
                with suppress(OSError):
                    os.unlink(path) if entry in files or os.path.islink(path) else os.rmdir(path)
        os.rmdir(name)


def _remove_open_files(folders: set[str]) -> None:
    """Remove the files directly in the folders that are open (known on Linux)."""
    descriptors = "/proc/self/fd"
    for descriptor in os.listdir(descriptors) if folders and os.path.isdir(descriptors) else ():
        with suppress(OSError):
            path = os.readlink(os.path.join(descriptors, descriptor))
            if os.path.dirname(path) in folders:
                os.unlink(path)
