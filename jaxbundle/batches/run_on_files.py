"""The computation of `jaxbundle batch`: many independent calibrations and networks into one file.

Every camera and every network has a key, the path of its input relative to the folder of the result
file, independent of the working directory. Results
are written as JSON lines, portion by portion, and inputs already in the file are skipped,
so that a run can be interrupted at any time. Each line contains its `settings`
and the fingerprint of its `data`; lines with other ones are not accepted as results.
"""

import dataclasses
import itertools
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxbundle.arguments import integer
from jaxbundle.batches.camera import LIMIT, SOLVED, STATUS
from jaxbundle.batches.photographs import NOT_SEARCHED
from jaxbundle.batches.work import WHERE_GIVEN, BatchSettings, ShareDone, Work, plan_works
from jaxbundle.errors import InputError
from jaxbundle.io.results.json_lines import JsonLines
from jaxbundle.io.writing.locks import hold_lock
from jaxbundle.measure.boards import Board
from jaxbundle.system.paths import relative_path
from jaxbundle.types import Progress

# The stage in reports of progress.
STAGE = "calibrating"


def run_batch(  # noqa: PLR0913 keyword arguments of a public function
    inputs: Sequence[str | Path],
    file: str | Path,
    *,
    model: str = "opencv",
    free: Sequence[str] | None = None,
    max_iterations: int = 100,
    snooping: str | None = None,
    significance: float = 0.001,
    correlated: bool = False,
    board: Board | None = None,
    rig: bool = False,
    pixel_size: float | None = None,
    settings: Sequence[str] = (),
    part: tuple[int, int] = (1, 1),
    brief: bool = False,
    retry: bool = False,
    renew: bool = False,
    portion: int = 256,
    known: str | Path | None = None,
    compute: bool = True,
    progress: Progress = lambda *_: None,
) -> Counter:
    """Calibrate the cameras and rigs of `.npz` files and of folders of photographs, and adjust all
    other inputs as networks.

    **Arguments:**

    - `file`: JSON lines; inputs already in it are skipped.
    - `model`, `free`: as in `calibrate_batch`, for the cameras.
    - `max_iterations`: for each camera and each network.
    - `snooping`, `significance`: data snooping, `"pope"`, of every camera and every network.
    - `correlated`: σ under errors that image points share as well, of every camera from its own
      views (`calibrate_batch`, `"camera"`), and of every network.
    - `board`: the board in the photographs; every folder without a network is then one of
      photographs of one camera. Found corners are stored in `FILE.corners` beside the file.
    - `rig`: such a folder has a folder for every camera of a rig; simultaneous photographs have
      equal names or last numbers.
    - `pixel_size`: mm, for a model in mm.
    - `settings`: KEY=VALUE, of a project as with `jaxbundle adjust`; of cameras and rigs
      `rolling_shutter.KEY` and `rig.KEY` (`calibrate_rigs`).
    - `part`: (I, N): of all cameras and networks the I-th and every N-th after it, I from 1.
    - `brief`: no poses and covariances of cameras.
    - `retry`: compute inputs without a result in the file again, and those that lack photographs
      for which there was no memory.
    - `renew`: compute inputs with results of other settings or other data again.
    - `portion`: cameras between two writes: what an interruption loses, a quarter of a second.
    - `known`: another file of results; inputs in it are skipped.
    - `compute`: False: only check, drop and count the lines of the file.
    - `progress(stage, done, total)`: called after every write, and while photographs are searched;
      skipped inputs count as done.

    **Returns:** the number of inputs by status in the file, and of those `"skipped"` because they
    were already in it.

    **Raises:** `InputError` before anything is computed, for a missing input or a bad `.npz`, for
    results of other settings or data in the file without `renew`, and for a file that another run
    is writing. A network that cannot be read or solved gets a line with the reason; the run
    continues.
    """
    portion = integer("portion", portion)
    check_part(part)
    batch_settings = BatchSettings.check(
        model, free, board, rig, pixel_size, settings, max_iterations, snooping, significance, brief
    )
    batch_settings = dataclasses.replace(batch_settings, correlated=correlated)
    for path in inputs:
        if not os.path.exists(path):
            raise InputError(f"{path}: no such file or folder")
    with ExitStack() as locks:
        locks.enter_context(hold_lock(file))
        works = plan_works(
            {key_of(path, file): str(path) for path in inputs}, file, batch_settings, locks
        )
        shares_of_part = _shares([len(work.keys) for work in works], part)
        total = sum(map(len, shares_of_part))
        lines = JsonLines(file)
        # All inputs are checked before anything is dropped: an error leaves the file as it was.
        to_recompute = [
            key
            for work, share in zip(works, shares_of_part)
            for key in _to_recompute(work, share, lines, retry, renew)
        ]
        if to_recompute:
            lines.drop(to_recompute)
        counts, number_done, networks = Counter(), 0, 0
        # By key, not by position, so that inputs may be added, left out, and reordered between runs
        keys_in_file = {*lines.heads} | ({*JsonLines(known).heads} if known is not None else set())
        for work, share in zip(works, shares_of_part) if compute else ():
            rows_to_compute = np.array([i for i in share if work.keys[i] not in keys_in_file], int)
            counts["skipped"] += len(share) - len(rows_to_compute)
            number_done += len(share) - len(rows_to_compute)
            progress(STAGE, number_done, total)
            step = min(portion, work.portion)
            for begin in range(0, len(rows_to_compute), step):
                rows_of_step = rows_to_compute[begin : begin + step].tolist()
                rows = _rows(
                    work,
                    rows_of_step,
                    partial(_tell, progress, number_done, len(rows_of_step), total),
                )
                lines.append(rows)
                number_done += len(rows)
                progress(STAGE, number_done, total)
                networks += work.is_network
                # Networks of many sizes leave a compiled program each: dropped from time to time.
                if work.is_network and networks % 50 == 0:
                    jax.clear_caches()
    keys = (work.keys[i] for work, share in zip(works, shares_of_part) for i in share)
    heads = (lines.heads[key] for key in keys if key in lines)
    return Counter(str(head.get("status", "unknown")) for head in heads) + counts


def result_rows(inputs: Sequence[str | Path], file: str | Path) -> Iterator[dict]:
    """The lines of these inputs in a file of results, in its order, as `run_batch` wrote them."""
    names = {key_of(path, file) for path in inputs}
    is_of_inputs = lambda key: key in names or any(key.startswith(f"{name}#") for name in names)
    with hold_lock(file):
        lines = JsonLines(file)
        yield from lines.rows(filter(is_of_inputs, lines.heads))


def key_of(path: str | Path, file: str | Path) -> str:
    """The path of an input relative to the folder of the result file, with / between folders."""
    folder, name = os.path.split(os.path.abspath(path))
    # The folder without links, but not the input itself, whose name the user gave.
    path = os.path.join(os.path.realpath(folder), name)
    return Path(relative_path(path, os.path.dirname(os.path.realpath(file)))).as_posix()


def check_part(part: Sequence[int]) -> None:
    """Refuse invalid (I, N), 1 ≤ I ≤ N.

    **Raises:** `InputError`."""
    if len(part) != 2 or not 1 <= integer("part", part[0]) <= integer("part", part[1]):
        raise InputError(f"part {part}: expected (I, N), the I-th of N parts, I from 1 to N")


def _shares(numbers: Sequence[int], part: tuple[int, int]) -> list[list[int]]:
    """Which cameras or networks of each input belong to a part."""
    ends = [0, *itertools.accumulate(numbers)]
    # Every N-th, not a block: inputs of similar size are often neighbours, and the parts take
    # equally long.
    ranges = [range(begin, end) for begin, end in zip(ends, ends[1:])]
    return [[i - r.start for i in r if i % part[1] == part[0] - 1] for r in ranges]


def _tell(progress: Progress, number_done: int, number: int, total: int, part: float) -> None:
    """Report that a fraction `part` of `number` inputs is done."""
    progress(STAGE, number_done + int(part * number), total)


def _rows(work: Work, rows: Sequence[int], tell: ShareDone) -> list[dict]:
    # Before the computation, so that later changes are detected.
    data = [work.data(i) for i in rows]
    return [
        {
            "key": work.keys[i],
            "status": row["status"],
            "settings": work.settings,
            "data": data_of_input,
        }
        | row
        for i, data_of_input, row in zip(rows, data, work.solve(rows, tell))
    ]


def _to_recompute(
    work: Work, share: Sequence[int], lines: JsonLines, retry: bool, renew: bool
) -> list[str]:
    """The keys of an input that are in the file and must be recomputed.

    **Raises:** `InputError` for a line with other settings or data, without `renew`."""
    keys_to_recompute, differing_keys = [], {}
    for i in share:
        key = work.keys[i]
        head = lines.heads.get(key)
        if head is None:
            continue
        if retry and (head.get("status") not in SOLVED or head.get(NOT_SEARCHED)):
            keys_to_recompute.append(key)
        elif difference := _difference(head, work, i):
            differing_keys[key] = difference
    if differing_keys and not renew:
        key, difference = next(iter(differing_keys.items()))
        raise InputError(
            f"{lines.path}: has {len(differing_keys)} of these inputs from other settings or other "
            f"data, {key}: {difference}; give another file to --json-lines, or recompute them with "
            "--renew"
        )
    return [*keys_to_recompute, *differing_keys]


def _difference(head: dict, work: Work, i: int) -> str:
    """Differences in settings or data of a line, in words; empty if none."""
    old = head.get("settings")
    if not isinstance(old, dict) or "data" not in head:
        return "its line does not say what it was computed from (written by an earlier version)"
    for name in {**work.settings, **dict.fromkeys(WHERE_GIVEN)}:
        value = work.settings.get(name)
        # A minimum does not depend on the iteration limit.
        matters = name != "max_iterations" or head.get("status") == STATUS[LIMIT]
        if matters and old.get(name) != value:
            return f"{name} was {_show_value(old.get(name))}, is {_show_value(value)}"
    return "" if head["data"] == work.data(i) else f"{work.made_of} were others"


def _show_value(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)
