"""Several processes with one task: join them and check that they agree on it."""

import hashlib
import sys

import numpy as np

import jaxbundle
from jaxbundle.errors import InputError, NotSolvedError


def join_processes(join: tuple[str, int, int] | None, quiet: bool) -> bool:
    """Join the processes and return whether this one writes."""
    if join and not quiet:
        print(f"jaxbundle: waiting for {join[1]} processes at {join[0]}", file=sys.stderr)
    address, processes, process = join or (None, None, None)
    return jaxbundle.join_processes(address, processes, process)


def join_for_one_task(
    join: tuple[str, int, int] | None, cluster: bool, quiet: bool, *given: object
) -> bool:
    """Join the processes of --join or --cluster, check that they are `given` the same, and return
    whether this one writes."""
    if join and cluster:
        raise InputError("--join with --cluster: give one of them")
    first = join_processes(join, quiet)
    check_sameness(*given)
    return first


def check_sameness(*given: object) -> None:
    """Refuse, in all processes, inputs or options that differ between them."""
    import jax
    from jax.experimental.multihost_utils import process_allgather

    digest = hashlib.blake2b(repr(given).encode(errors="replace"), digest_size=8).digest()
    mine = np.frombuffer(digest, np.uint32)
    try:
        same = np.all(process_allgather(mine) == mine)
    except jax.errors.JaxRuntimeError:
        raise NotSolvedError("one of the processes is lost; start all of them again") from None
    if not same:
        jax.distributed.shutdown()  # A barrier: no process ends before the others know.
        raise InputError("the processes were given different files or options")
