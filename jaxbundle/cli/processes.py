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
    join: tuple[str, int, int] | None, cluster: bool, quiet: bool, *task: object
) -> bool:
    """Join the processes of --join or --cluster, check that they are `task` the same, and return
    whether this one writes."""
    if join and cluster:
        raise InputError("--join with --cluster: give one of them")
    is_first_process = join_processes(join, quiet)
    check_sameness(*task)
    return is_first_process


def check_sameness(*task: object) -> None:
    """Refuse, in all processes, inputs or options that differ between them."""
    import jax
    from jax.experimental.multihost_utils import process_allgather

    digest = hashlib.blake2b(repr(task).encode(errors="replace"), digest_size=8).digest()
    digest_words = np.frombuffer(digest, np.uint32)
    try:
        is_same = np.all(process_allgather(digest_words) == digest_words)
    except jax.errors.JaxRuntimeError:
        raise NotSolvedError("one of the processes is lost; start all of them again") from None
    if not is_same:
        jax.distributed.shutdown()  # A barrier: no process ends before the others know.
        raise InputError("the processes were given different files or options")
