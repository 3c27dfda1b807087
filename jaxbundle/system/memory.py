"""Memory: how much is free, which errors say that it is used up, and its return to the system."""

import ctypes
import errno
import math
import os
import sys
from contextlib import suppress
from pathlib import Path

# What OpenCV, XLA, C++, the system, Python and the dynamic linker say without memory.
SHORTAGES = (
    "failed to allocate",
    "resource_exhausted",
    "bad_alloc",
    "cannot allocate memory",
    "can't start new thread",
    "failed to map segment",
)
# Bytes of address space, most of it never used, with which a command, or any other, compiles its
# programs; with 0.2 to 0.4 GB less LLVM or XLA abort the process (measured on small inputs, JAX
# 0.10, two cores).
SMALLEST_ADDRESS_SPACE = {"": 1.7e9, "calibrate": 2.1e9, "reconstruct": 2.8e9}
# Bytes: larger limits of version 1 of control groups mean none. The kernel writes 2⁶³ − 1 rounded
# down to pages, whose size differs (Documentation/admin-guide/cgroup-v1/memory.rst).
NO_LIMIT = 2**60


def free_memory() -> float:
    """Bytes that this process may still take: the least of what the machine has available, and of
    what is left of the limits of its control groups (containers) and of its address space (`ulimit
    -v`). Infinite where the system does not say."""
    return max(0.0, min(_available_memory(), _address_space_left(), left_in_control_groups()))


def require_address_space(command: str = "") -> None:
    """Refuse a limit of the address space below which XLA and LLVM abort the process without an
    error that can be caught.

    **Raises:** `MemoryError`."""
    remaining = _address_space_left()
    needed = SMALLEST_ADDRESS_SPACE.get(command, SMALLEST_ADDRESS_SPACE[""])
    if remaining < needed:
        raise MemoryError(
            f"not enough memory: the limit of the address space (ulimit -v) leaves "
            f"{remaining / 1e9:.2f} GB; at least {needed / 1e9:.2f} GB are needed: raise it"
        )


def is_memory_shortage(error: BaseException) -> bool:
    """Whether an error of Python or of a library says that no memory is left."""
    if isinstance(error, MemoryError):
        return True
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    message = str(error).lower()
    return not isinstance(error, ValueError) and any(words in message for words in SHORTAGES)


def left_in_control_groups(root: str | Path = "/") -> float:
    """Bytes left in the control groups of this process, of version 1 or 2, below a root folder:
    limit − usage, without cached files, which the system drops when others need the memory."""
    remaining = math.inf
    for line in _read_text(Path(root, "proc/self/cgroup")).splitlines():
        _, controllers, group = (*line.split(":", 2), "", "")[:3]
        # Version 2 has one line, "0::/group"; version 1 one for each controller.
        if controllers and "memory" not in controllers.split(","):
            continue
        mounted = Path(root, "sys/fs/cgroup", *["memory"] * bool(controllers))
        names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        if not controllers:
            names = ("memory.max", "memory.current", "inactive_file")
        # A container may see its own group as the root of the mounted tree.
        group_folder = mounted / group.lstrip("/")
        # The limit of every enclosing group applies, too: the least of them counts.
        for folder in dict.fromkeys((group_folder, *group_folder.parents, mounted)):
            if folder == mounted or mounted in folder.parents:
                remaining = min(remaining, _group_memory_left(folder, *names))
    return remaining


def return_freed_memory() -> None:
    """Return freed memory to the system (glibc). Reading and planning a large problem leave it in
    small pieces, which the arrays of XLA cannot use: 40 MB before the first iteration on 84 000
    image points."""
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)


def _group_memory_left(folder: Path, limit: str, usage: str, cached: str) -> float:
    limit_text, usage_text = (_read_text(folder / name).strip() for name in (limit, usage))
    if not (limit_text.isdecimal() and usage_text.isdecimal()) or int(limit_text) >= NO_LIMIT:
        return math.inf
    # Cached files are counted as used, and are given up when memory is asked for.
    return (
        int(limit_text) - int(usage_text) + _field(_read_text(folder / "memory.stat"), cached, 0.0)
    )


def _available_memory() -> float:
    """Bytes that are available: Linux and Windows say it; of other systems half of the memory is
    taken, what a machine at work has free, and infinity where not even that is known."""
    if sys.platform == "win32":
        return _available_on_windows()
    if text := _read_text(Path("/proc/meminfo")):
        return 1024 * _field(text, "MemAvailable:", math.inf)
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2
    except (AttributeError, ValueError, OSError):
        return math.inf


class MemoryStatus(ctypes.Structure):
    """MEMORYSTATUSEX of the Windows API (sysinfoapi.h)."""

    _fields_ = (
        ("length", ctypes.c_uint32),
        ("load", ctypes.c_uint32),
        *((name, ctypes.c_uint64) for name in ("total", "available", "page_total", "page_left")),
        *((name, ctypes.c_uint64) for name in ("virtual_total", "virtual_left", "extended_left")),
    )


def _available_on_windows() -> float:
    status = MemoryStatus()
    status.length = ctypes.sizeof(status)
    kernel = getattr(getattr(ctypes, "windll", None), "kernel32", None)
    if kernel is None or not kernel.GlobalMemoryStatusEx(ctypes.byref(status)):
        return math.inf
    return float(status.available)


def _address_space_left() -> float:
    try:
        import resource
    except ImportError:  # Windows
        return math.inf
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    pages = _read_text(Path("/proc/self/statm")).split()
    if limit == resource.RLIM_INFINITY or not pages:
        return math.inf
    return limit - int(pages[0]) * os.sysconf("SC_PAGE_SIZE")


def _field(text: str, name: str, otherwise: float) -> float:
    for line in text.splitlines():
        words = line.split()
        if len(words) > 1 and words[0] == name:
            return float(words[1])
    return otherwise


def _read_text(path: Path) -> str:
    with suppress(OSError):
        return path.read_text()
    return ""
