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
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import jax
import numpy as np

from jaxbundle.arguments import one_of, whole
from jaxbundle.batch.calibrate import calibrate_batch
from jaxbundle.batch.camera import LIMIT, SOLVED, STATUS
from jaxbundle.batch.input import free_parameters, pixel_model
from jaxbundle.batch.photographs import (
    PhotographFolders,
    calibrate_views,
    is_photograph_folder,
    of_photographs,
)
from jaxbundle.batch.snooping import TESTS
from jaxbundle.batch.stacks import is_camera_stack, read_camera_stack
from jaxbundle.bundle.adjust import adjust
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.io import read_network
from jaxbundle.io.boards.kept_corners import KeptCorners
from jaxbundle.io.results.json_lines import JsonLines
from jaxbundle.io.results.result_json import result_dict
from jaxbundle.io.writing.fingerprints import of_input
from jaxbundle.io.writing.locks import locked
from jaxbundle.leastsquares.snooping import check_test
from jaxbundle.measure.boards import Board, require_board
from jaxbundle.measure.views import search_alone
from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.system.configuration import available_cores
from jaxbundle.system.workers import Workers

SNOOPING = ("snooping", "significance")
"""Settings present only in lines computed with data snooping."""
CAMERAS_A_WRITE = 256
NETWORKS_A_CACHE = 50
"""Compiled programs are dropped after this number of networks, to free memory."""


def run_batch(
    inputs: Sequence[str | Path],
    file: str | Path,
    *,
    model: str = "opencv",
    free: Sequence[str] | None = None,
    max_iterations: int = 100,
    snooping: str | None = None,
    significance: float = 0.001,
    board: Board | None = None,
    part: tuple[int, int] = (1, 1),
    brief: bool = False,
    retry: bool = False,
    renew: bool = False,
    portion: int = CAMERAS_A_WRITE,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Counter:
    """Calibrate the cameras of `.npz` files and of folders of photographs, and adjust all other
    inputs as networks.

    **Arguments:**

    - `file`: JSON lines; inputs already in it are skipped.
    - `model`, `free`: as in `calibrate_batch`, for the cameras.
    - `max_iterations`: for each camera and each network.
    - `snooping`, `significance`: data snooping, `"pope"`, of every camera and every network.
    - `board`: the board in the photographs; every folder without a network is then one of
      photographs of one camera. Found corners are stored in `FILE.corners` beside the file.
    - `part`: (I, N): of all cameras and networks the I-th and every N-th after it, I from 1.
    - `brief`: no poses and covariances of cameras.
    - `retry`: compute inputs without a result in the file again.
    - `renew`: compute inputs with results of other settings or other data again.
    - `portion`: cameras between two writes.
    - `progress(done, total)`: called after every write, and while photographs are searched;
      skipped inputs count as done.

    **Returns:** the number of inputs by status in the file, and of those `"skipped"` because they
    were already in it.

    **Raises:** `InputError` before anything is computed, for a missing input or a bad `.npz`, for
    results of other settings or data in the file without `renew`, and for a file that another run
    is writing. A network that cannot be read or solved gets a line with the reason; the run
    continues.
    """
    portion = whole("portion", portion)
    max_iterations = whole("max_iterations", max_iterations)
    one_of("snooping", snooping, TESTS, none=True)
    check_test(snooping, significance)
    if board is not None:
        require_board(board)
        need_opencv()
    check_part(part)
    for path in inputs:
        if not os.path.exists(path):
            raise InputError(f"{path}: no such file or folder")
    options = dict(model=model, free=free, max_iterations=max_iterations)
    if snooping is not None:
        options |= dict(snooping=snooping, significance=significance)
    with ExitStack() as held:
        held.enter_context(locked(file))
        works = _works(inputs, file, board, options, brief, held)
        ours = _shares([len(work.keys) for work in works], part)
        total = sum(map(len, ours))
        lines = JsonLines(file)
        again = [key for work, share in zip(works, ours)
                 for key in _again(work, share, lines, retry, renew)]  # fmt: skip
        if again:
            lines.drop(again)
        counts, done, networks = Counter(), 0, 0
        for work, share in zip(works, ours):
            chosen = np.array([i for i in share if work.keys[i] not in lines], int)
            counts["skipped"] += len(share) - len(chosen)
            done += len(share) - len(chosen)
            progress(done, total)
            for first in range(0, len(chosen), portion):
                some = chosen[first : first + portion].tolist()
                rows = _rows(work, some, partial(_tell, progress, done, len(some), total))
                lines.append(rows)
                done += len(rows)
                progress(done, total)
                networks += work.is_network
                if work.is_network and networks % NETWORKS_A_CACHE == 0:
                    jax.clear_caches()
    heads = (lines.heads[work.keys[i]] for work, share in zip(works, ours) for i in share)
    return Counter(str(head.get("status", "unknown")) for head in heads) + counts


def result_rows(inputs: Sequence[str | Path], file: str | Path) -> Iterator[dict]:
    """The lines of these inputs in a file of results, in its order, as `run_batch` wrote them."""
    names = {key_of(path, file) for path in inputs}
    ours = lambda key: key in names or any(key.startswith(f"{name}#") for name in names)
    with locked(file):
        lines = JsonLines(file)
        yield from lines.rows(filter(ours, lines.heads))


def key_of(path: str | Path, file: str | Path) -> str:
    """The path of an input relative to the folder of the result file, with / between folders."""
    folder, name = os.path.split(os.path.abspath(path))
    path = os.path.join(os.path.realpath(folder), name)
    try:
        path = os.path.relpath(path, os.path.dirname(os.path.realpath(file)))
    except ValueError:  # another drive
        pass
    return Path(path).as_posix()


def check_part(part: Sequence[int]) -> None:
    """Refuse invalid (I, N), 1 ≤ I ≤ N.

    **Raises:** `InputError`."""
    if len(part) != 2 or not 1 <= whole("part", part[0]) <= whole("part", part[1]):
        raise InputError(f"part {part}: (I, N) is expected, the I-th of N parts, I from 1 to N")


def _shares(numbers: Sequence[int], part: tuple[int, int]) -> list[list[int]]:
    """Which cameras or networks of each input belong to a part."""
    ends = [0, *itertools.accumulate(numbers)]
    own = [range(first, last) for first, last in zip(ends, ends[1:])]
    return [[i - of.start for i in of if i % part[1] == part[0] - 1] for of in own]


Tell = Callable[[float], None]


@dataclasses.dataclass(frozen=True)
class _Work:
    """The work for an input, or for all folders of photographs.

    **Fields:** `keys` of its lines; their `settings`; `data`, the fingerprint of number i; `solve`,
    the rows of some, from their numbers, telling what part of them is done; `made_of`: what the
    fingerprint is of, in words.
    """

    keys: tuple[str, ...]
    settings: dict
    data: Callable[[int], str]
    solve: Callable[[Sequence[int], Tell], Iterable[dict]]
    made_of: str = "the measurements"
    is_network: bool = False


def _works(
    inputs: Sequence[str | Path], file: str | Path, board: Board | None, options: dict, brief: bool,
    held: ExitStack,
) -> list[_Work]:  # fmt: skip
    """The work of all inputs, without repetitions."""
    works, folders = {}, {}
    for path in map(str, inputs):
        name = key_of(path, file)
        if name in works or name in folders:
            continue
        if is_camera_stack(path):
            works[name] = _cameras(path, name, options, brief)
        elif board is not None and is_photograph_folder(path):
            folders[name] = path
        else:
            works[name] = _network(path, name, options)
    if board is not None and folders:
        regular = os.path.isfile(file) or not os.path.exists(file)
        kept = held.enter_context(KeptCorners(f"{file}.corners" if regular else ":memory:"))
        workers = held.enter_context(Workers(search_alone, available_cores()))
        found = PhotographFolders(tuple(folders.values()), board, kept, workers)
        works["photographs"] = _photographed(found, tuple(folders), options, brief)
    return [*works.values()]


def _cameras(path: str, name: str, options: dict, brief: bool) -> _Work:
    stack = read_camera_stack(path)

    def solve(chosen, _):
        batch = calibrate_batch(**stack.arguments(chosen), **options)
        return [batch.row(i, brief) for i in range(len(chosen))]

    keys = tuple(f"{name}#{camera}" for camera in stack.ids)
    return _Work(keys, _settings(options, brief), stack.fingerprint, solve)


def _photographed(
    found: PhotographFolders, keys: tuple[str, ...], options: dict, brief: bool
) -> _Work:
    settings = _settings(options, brief) | {"board": repr(found.board)}

    def solve(chosen, tell):
        measured = found.measure(chosen, tell)
        rows = {i: {"status": "bad input", "error": why}
                for i, why in measured.items() if isinstance(why, str)}  # fmt: skip
        views = {i: one for i, one in measured.items() if not isinstance(one, str)}
        for i, batch, place in calibrate_views(views, options):
            rows[i] = batch.row(place, brief, len(views[i]))
            rows[i] |= of_photographs(views[i], brief)
        return [rows[i] for i in chosen]

    return _Work(keys, settings, found.fingerprint, solve, "its photographs")


def _settings(options: dict, brief: bool) -> dict:
    """Settings of the lines of cameras."""
    free = free_parameters(pixel_model(options["model"]), options["free"])
    return options | {"model": str(options["model"]), "free": list(free), "brief": brief}


def _network(path: str, name: str, options: dict) -> _Work:
    options = {key: value for key, value in options.items() if key not in ("model", "free")}
    solve = lambda chosen, _: [network_row(path, **options) for _ in chosen]
    return _Work((name,), options, lambda i: of_input(path), solve, "its files", True)


def _tell(progress, done: int, number: int, total: int, part: float) -> None:
    """Of so many that are being computed a part is done."""
    progress(done + int(part * number), total)


def _rows(work: _Work, chosen: Sequence[int], tell: Tell) -> list[dict]:
    # Before the computation, so that later changes are detected.
    data = [work.data(i) for i in chosen]
    return [
        {"key": work.keys[i], "status": row["status"], "settings": work.settings, "data": of} | row
        for i, of, row in zip(chosen, data, work.solve(chosen, tell))
    ]


def _again(
    work: _Work, share: Sequence[int], lines: JsonLines, retry: bool, renew: bool
) -> list[str]:
    """The keys of an input that are in the file and must be recomputed.

    **Raises:** `InputError` for a line with other settings or data, without `renew`."""
    again, other = [], {}
    for i in share:
        key = work.keys[i]
        head = lines.heads.get(key)
        if head is None:
            continue
        if retry and head.get("status") not in SOLVED:
            again.append(key)
        elif difference := _difference(head, work, i):
            other[key] = difference
    if other and not renew:
        key, difference = next(iter(other.items()))
        raise InputError(
            f"{lines.path}: has {len(other)} of these inputs from other settings or other data, "
            f"{key}: {difference}; give another file to --json-lines, or recompute them with "
            "--renew"
        )
    return [*again, *other]


def _difference(head: dict, work: _Work, i: int) -> str:
    """Differences in settings or data of a line, in words; empty if none."""
    old = head.get("settings")
    if not isinstance(old, dict) or "data" not in head:
        return "its line does not say what it was made of (an earlier version wrote it)"
    for name in {**work.settings, **dict.fromkeys(SNOOPING)}:
        value = work.settings.get(name)
        # A minimum does not depend on the iteration limit.
        matters = name != "max_iterations" or head.get("status") == STATUS[LIMIT]
        if matters and old.get(name) != value:
            return f"{name} was {_shown(old.get(name))}, is {_shown(value)}"
    return "" if head["data"] == work.data(i) else f"{work.made_of} were others"


def _shown(value) -> str:
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)


def network_row(path: str, **options) -> dict:
    """The status and brief result of one network (`options` of `adjust`), or the reason for a
    failure."""
    try:
        result = adjust(read_network(path), **options)
        status = "converged" if result.converged else result.termination
        return {"status": status} | result_dict(result, brief=True)
    except (InputError, NotSolvedError) as error:
        status = "bad input" if isinstance(error, InputError) else "not solved"
        return {"status": status, "error": str(error)}
    except (ValueError, ArithmeticError, RuntimeError, OSError, MemoryError) as error:
        return {"status": "failed", "error": f"{type(error).__name__}: {error}"}
