"""A batch in several processes that JAX's own distribution has joined, on one machine or several
that see the same folder.

JAX tells every process its number, and ends all of them when one is lost. Each computes its part of
the inputs (`run_batch`) into its own file beside that of the results; the first adds the parts to
the results, in the order of the inputs, and removes them. Parts of a run that was ended are added
by the next one, whatever the number of its processes. The processes wait for each other through
files, since a collective waits only half a minute.
"""

import glob
import os
import re
import shutil
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental.multihost_utils import broadcast_one_to_all

from jaxbundle.batches.run_on_files import run_batch
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.io.results.json_lines import JsonLines
from jaxbundle.io.writing.locks import hold_lock
from jaxbundle.io.writing.replacing import unwritable
from jaxbundle.leastsquares.sharding import use_own_devices


def run_joined(inputs: Sequence[str | Path], file: str | Path, **options: Any) -> Counter:
    """As `run_batch`, in processes joined by `jaxbundle.join_processes`, which have the same
    arguments and see the same folder of results; afterwards they are no longer joined.

    **Returns:** in the first process as `run_batch`; in the others nothing.

    **Raises:** also `NotSolvedError` if another process has failed.
    """
    if os.path.exists(file) and not os.path.isfile(file):
        raise InputError(
            f"{file}: joined processes write their parts next to it; expected the name of a file"
        )
    number, index = jax.process_count(), jax.process_index()
    # A name of this run, the same in all processes, so that files of an earlier one do not count.
    token = int(broadcast_one_to_all(np.array(time.time_ns() % 10**9)))
    waiting = f"{file}.joined-{token}"
    own_options = {key: value for key, value in options.items() if key not in ("retry", "renew")}
    error_here, counts = None, Counter()
    if index == 0:
        _clear(file, waiting)
    try:
        if index == 0:
            run_batch(inputs, file, compute=False, **options)
            _tell(waiting, "begin")
        if not _wait(waiting, ["begin"])["begin"]:
            # Into a file of its own: appending to one file from several machines is not atomic.
            part = f"{file}.part-{index + 1}-of-{number}"
            with use_own_devices():
                run_batch(inputs, part, part=(index + 1, number), known=file, **own_options)
    except Exception as error:
        error_here = error
        if index == 0:
            _tell(waiting, "begin", _in_words(error))
    _tell(waiting, str(index), "" if error_here is None else _in_words(error_here))
    reports = _wait(waiting, list(map(str, range(number))))
    jax.distributed.shutdown()  # A barrier: from here every process is on its own.
    if index == 0:
        shutil.rmtree(waiting, ignore_errors=True)
    if error_here is not None:
        raise error_here
    for other_process, why in reports.items():
        if why:
            raise NotSolvedError(f"process {other_process} of the joined ones has failed: {why}")
    if index == 0:
        add_parts(file)
        counts = run_batch(inputs, file, compute=False, **own_options)
    return counts


def _in_words(error: Exception) -> str:
    return str(error) or type(error).__name__


def _clear(file: str | Path, waiting: str) -> None:
    """Add the parts left by an interrupted run, and make the folder of this one."""
    add_parts(file)
    try:
        os.mkdir(waiting)
    except OSError as error:
        raise unwritable(waiting, error) from None


def _tell(waiting: str, name: str, words: str = "") -> None:
    # Renamed when complete, so that no process reads half of it.
    path = Path(waiting, f".{name}")
    path.write_text(words, encoding="utf-8")
    path.rename(Path(waiting, name))


def _wait(waiting: str, names: Sequence[str]) -> dict[str, str]:
    """The reports of these processes, once all are there."""
    while True:
        reports = {
            name: Path(waiting, name).read_text("utf-8")
            for name in names
            if Path(waiting, name).exists()
        }
        if len(reports) == len(names):
            return reports
        time.sleep(0.2)  # seconds: far below a run, far above the look at a file


def add_parts(file: str | Path) -> None:
    """Add the lines of all parts beside a file of results to it, and remove other files left by
    joined processes.

    **Raises:** `InputError` while a run writes one of them."""
    parts_found = [
        (int(end[1]), path)
        for path in glob.glob(f"{glob.escape(str(file))}.part-*")
        if (end := re.search(r"\.part-(\d+)-of-\d+$", path))
    ]
    waiting_folders = glob.glob(f"{glob.escape(str(file))}.joined-*")
    if not parts_found and not waiting_folders:
        return
    with ExitStack() as locks:
        locks.enter_context(hold_lock(file))
        for _, path in parts_found:
            locks.enter_context(hold_lock(path))
        parts = [JsonLines(path) for _, path in sorted(parts_found)]
        lines, rows_to_write = JsonLines(file), []
        # Parts have every N-th input: taken in turn they are in the order of the inputs.
        in_turn = chain.from_iterable(zip_longest(*(part.rows(part.heads) for part in parts)))
        for row in in_turn:
            if row is not None and row["key"] not in lines:
                rows_to_write.append(row)
            if len(rows_to_write) == 256:  # lines a write: bounds the memory
                lines.append(rows_to_write)
                rows_to_write = []
        lines.append(rows_to_write)
        for _, path in parts_found:
            os.remove(path)
    for path in waiting_folders:
        shutil.rmtree(path, ignore_errors=True)
