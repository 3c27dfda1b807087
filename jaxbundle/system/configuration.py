"""JAX settings, only on request: cores, kept programs, processes."""

import os
import re
import socket
import sys
import time
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

from jaxbundle.errors import InputError
from jaxbundle.system.temporaries import watch_cache
from jaxbundle.system.xla_flags import jaxlib_version

# XLA's environment variable of the number of threads of its pool; default: one for each core.
THREADS = "NPROC"


def allow_programs_at_once() -> None:
    """Let programs with batched factorisations run at once, from several threads; call it before
    the first JAX computation.

    jaxlib 0.10 waits in XLA's pool for the parts of such a factorisation: as many programs as the
    pool has threads deadlock. From 0.11 on they do not (tests/test_float64.py, with one thread
    too), and nothing is set: more threads than cores make large networks up to a sixth slower
    (`NPROC=4 python benchmarks/bal_ours.py FILE --devices 2`).
    """
    if jaxlib_version() < (0, 11):
        os.environ.setdefault(THREADS, str(available_cores() + 2))


def can_run_two_programs() -> bool:
    """Whether XLA's pool has a thread left while two programs wait in it."""
    if jaxlib_version() >= (0, 11):
        return True  # they do not wait there
    given = os.environ.get(THREADS, "")
    return (int(given) if given.isdecimal() else available_cores()) > 2


def use_cores(number: int | None = None) -> None:
    """Use all cores of the processor, or this number, for large networks, as JAX devices; call it
    before the first JAX computation."""
    import jax

    from jaxbundle.arguments import integer

    cores = available_cores() if number is None else integer("number", number)
    jax.config.update("jax_num_cpu_devices", cores)


def keep_programs(folder: str | os.PathLike | None = None) -> bool:
    """Keep compiled programs in a folder by JAX's persistent cache, so that later processes start
    without compiling; call it before the first JAX computation.

    `folder`: default that of the environment variable JAX_COMPILATION_CACHE_DIR, else
    `jaxbundle` in the user's cache folder.

    **Returns:** whether the folder is writable, and jaxlib 0.10.2 or later; if not, nothing is
    kept. For every kept program earlier ones print two errors, about features of the processor
    that are none.
    """
    import jax

    from jaxbundle.arguments import path

    folder = None if folder is None else path("folder", folder)
    variable = "JAX_COMPILATION_CACHE_DIR"
    if folder is None:
        home = os.path.join(os.path.expanduser("~"), ".cache")
        caches = os.environ.get("XDG_CACHE_HOME") or home
        folder = os.environ.get(variable) or os.path.join(caches, "jaxbundle")
    try:
        os.makedirs(folder, exist_ok=True)
        usable = os.access(folder, os.W_OK | os.X_OK)
    except OSError:
        usable = False
    usable = usable and jaxlib_version() >= (0, 10, 2)
    # JAX has already read the variable, and would warn of a bad folder for every program.
    jax.config.update("jax_compilation_cache_dir", os.fspath(folder) if usable else None)
    if not usable:
        return False
    watch_cache(folder)
    _remove_damaged_programs(Path(os.path.abspath(folder)))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        # Seconds. JAX's 1 s keeps none of the dozen programs of a small network; reading a file
        # takes some milliseconds, so that below 0.02 keeping saves nothing.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.02)
    return True


def _remove_damaged_programs(folder: Path) -> None:
    """Remove the files of programs that JAX cannot read, instead of showing its warnings.

    JAX compiles them again, in every process, since it does not replace a file. A damaged one is
    left by a full disk; one that is just being written by another process is not touched."""
    show, about = warnings.showwarning, "Error (reading|writing) persistent compilation cache entry"

    def handle(message: Warning | str, *where: Any, **options: Any) -> None:
        if not re.match(about, str(message)):
            return show(message, *where, **options)
        # Within a minute another process has written the file of a program, some megabytes.
        name, latest = re.search(r"'(\w+)", str(message)), time.time() - 60.0
        for file in folder.glob(f"{name[1]}-*-cache") if name else ():
            with suppress(OSError):
                if file.stat().st_mtime < latest:
                    file.unlink()

    # "always": as an error, by -W error, it would end the computation.
    warnings.filterwarnings("always", about)
    warnings.showwarning = handle


def join_processes(
    address: str | None = None,
    processes: int | None = None,
    process: int | None = None,
    *,
    lost_after_seconds: int = 30,
    wait_seconds: int = 60,
) -> bool:
    """Join other processes, on this machine or others, that run the same program on the same files;
    call it before the first JAX computation.

    **Arguments:**

    - `address`: `host:port` of process 0, the same for all; `processes`: their number;
      `process`: the index of this one, from 0. Under SLURM or on TPUs JAX finds all three:
      give none of them.
    - `lost_after_seconds`: a process silent for this time is lost, and the others end too.
    - `wait_seconds`: how long the processes wait for each other to start.

    **Returns:** whether this is process 0, the one that should write the results. All of them have
    the result.

    **Raises:** `InputError` if the processes are not specified, or process 0 is not found. JAX
    aborts process 0 if the others do not join.
    """
    import jax

    _check_joining(address, processes, process, lost_after_seconds, wait_seconds)
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    # The service would intercept SIGTERM, and the process would continue.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(
            address,
            processes,
            process,
            heartbeat_timeout_seconds=lost_after_seconds,
            initialization_timeout=wait_seconds,
        )
    except (ValueError, TypeError, RuntimeError) as error:
        why = " ".join(str(error).split())[:300]
        if address is None and not any(name.startswith("SLURM_") for name in os.environ):
            why = "no SLURM variables were found"
        raise InputError(f"the processes cannot be joined: {why}; {HOW_TO_JOIN}") from None
    return jax.process_index() == 0


HOW_TO_JOIN = (
    "expected: host:port of process 0, the number of processes, and which one this is, from 0; "
    "none of them under SLURM"
)


def _check_joining(
    address: str | None,
    processes: int | None,
    process: int | None,
    lost_after_seconds: int,
    wait_seconds: int,
) -> None:
    """Check the arguments of `join_processes`, and that the address can be reached."""
    from jaxbundle.arguments import integer

    for name, value in (("processes", processes), ("process", process)):
        if value is not None:
            integer(name, value, least=0)
    integer("lost_after_seconds", lost_after_seconds)
    integer("wait_seconds", wait_seconds)
    if address is None:
        return
    parts = re.fullmatch(r"(\S+):(\d{1,5})", str(address))
    if not parts or not 0 < int(parts[2]) < 65536:
        raise InputError(f"the processes cannot be joined at {address!r}; {HOW_TO_JOIN}")
    if processes is not None and process is not None and not 0 <= process < processes:
        raise InputError(f"process {process} of {processes} cannot be joined; {HOW_TO_JOIN}")
    _check_address(parts[1].strip("[]"), int(parts[2]), process, wait_seconds)


def _check_address(host: str, port: int, process: int | None, wait_seconds: int) -> None:
    """Check that process 0 has its port and the others reach process 0; JAX would abort
    otherwise."""
    try:
        socket.getaddrinfo(host, port)
    except (OSError, UnicodeError):
        raise InputError(f"there is no machine {host!r} to join processes at") from None
    if process == 0:
        try:
            socket.create_server(("", port)).close()
        except OSError as error:
            why = os.strerror(error.errno or 0)
            raise InputError(f"port {port}: {why}; take another") from None
        return
    end = time.monotonic() + wait_seconds
    while process:
        try:
            return socket.create_connection((host, port), timeout=5).close()
        except OSError:
            if time.monotonic() > end:
                raise InputError(
                    f"no process 0 at {host}:{port} after {wait_seconds} seconds"
                ) from None
            time.sleep(0.1)


def leave(status: int) -> NoReturn:
    """End this process; immediately if joined with others, since an orderly exit waits for them."""
    jax = sys.modules.get("jax")
    if jax and jax.distributed.is_initialized():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)


def available_cores() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
