"""Several processes, on this machine or others, that compute one result."""

import os
import re
import socket
import sys
import time
from typing import NoReturn

from jaxbundle.errors import InputError


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
        reason = " ".join(str(error).split())[:300]
        if address is None and not any(name.startswith("SLURM_") for name in os.environ):
            reason = "no SLURM variables were found"
        raise InputError(f"the processes cannot be joined: {reason}; {HOW_TO_JOIN}") from None
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
            reason = os.strerror(error.errno or 0)
            raise InputError(f"port {port}: {reason}; take another") from None
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
