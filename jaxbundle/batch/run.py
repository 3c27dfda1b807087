"""What `jaxbundle batch` does: many independent calibrations and networks into one file.

Every camera and every network has a key, the path of its input seen from the folder of the file of
results: from wherever the command is run, and however the path is written, it is the same. Results
are written as JSON lines, portion by portion, and what is already in the file is not computed
again: a run can be interrupted at any moment. Each line says what it was made of, its `settings`
and the fingerprint of its `data`; where those are others, nothing is taken for a result of these.
"""

import dataclasses
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import jax
import numpy as np

from jaxbundle.arguments import one_of, whole
from jaxbundle.batch.calibrate import BatchCalibration, calibrate_batch
from jaxbundle.batch.camera import LIMIT, STATUS
from jaxbundle.batch.input import free_parameters, pixel_model
from jaxbundle.batch.result import SOLVED
from jaxbundle.batch.snooping import TESTS
from jaxbundle.batch.stacks import is_camera_stack, read_camera_stack
from jaxbundle.bundle.adjust import adjust
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.io import read_network
from jaxbundle.io.results.json_lines import JsonLines
from jaxbundle.io.results.result_json import result_dict
from jaxbundle.io.writing.fingerprints import of_input
from jaxbundle.io.writing.locks import locked
from jaxbundle.leastsquares.snooping import check_test

SNOOPING = ("snooping", "significance")
"""Settings that only a line has whose measurements were searched for blunders."""
CAMERAS_A_WRITE = 256
NETWORKS_A_CACHE = 50
"""After so many networks compiled programs are dropped: each holds memory."""


def run_batch(
    inputs: Sequence[str | Path],
    file: str | Path,
    *,
    model: str = "opencv",
    free: Sequence[str] | None = None,
    max_iterations: int = 100,
    snooping: str | None = None,
    significance: float = 0.001,
    brief: bool = False,
    retry: bool = False,
    renew: bool = False,
    portion: int = CAMERAS_A_WRITE,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Counter:
    """Calibrate the cameras of `.npz` files and adjust all other inputs as networks.

    **Arguments:**

    - `file`: JSON lines; what it already has is skipped.
    - `model`, `free`: as of `calibrate_batch`, for the cameras.
    - `max_iterations`: for each camera and each network.
    - `snooping`, `significance`: data snooping, `"pope"`, of every camera and every network.
    - `brief`: no poses and covariances of cameras.
    - `retry`: compute again what has no result in the file.
    - `renew`: compute again what the file has from other settings or other data.
    - `portion`: cameras between two writes.
    - `progress(done, total)`: called after every write; what was skipped counts as done.

    **Returns:** how many of the inputs have which status in the file, and how many of them were
    `"skipped"`, for they were there.

    **Raises:** `InputError` before anything is computed, for a missing input or a bad `.npz`, for
    results of other settings or data in the file without `renew`, and for a file another run is
    writing; a network that cannot be read or solved gets a line that says so, and the others go on.
    """
    portion = whole("portion", portion)
    max_iterations = whole("max_iterations", max_iterations)
    one_of("snooping", snooping, TESTS, none=True)
    check_test(snooping, significance)
    for path in inputs:
        if not os.path.exists(path):
            raise InputError(f"{path}: no such file or folder")
    options = dict(model=model, free=free, max_iterations=max_iterations)
    if snooping is not None:
        options |= dict(snooping=snooping, significance=significance)
    works = {}
    for path in map(str, inputs):
        name = key_of(path, file)
        if name not in works:
            of_its_kind = _cameras if is_camera_stack(path) else _network
            works[name] = of_its_kind(path, name, options, brief)
    total = sum(len(work.keys) for work in works.values())
    with locked(file):
        lines = JsonLines(file)
        again = [key for work in works.values() for key in _again(work, lines, retry, renew)]
        if again:
            lines.drop(again)
        counts, done, networks = Counter(), 0, 0
        for work in works.values():
            chosen = np.array([i for i, key in enumerate(work.keys) if key not in lines], int)
            counts["skipped"] += len(work.keys) - len(chosen)
            done += len(work.keys) - len(chosen)
            progress(done, total)
            for first in range(0, len(chosen), portion):
                rows = _rows(work, chosen[first : first + portion].tolist())
                lines.append(rows)
                done += len(rows)
                progress(done, total)
                networks += not work.is_cameras
                if not work.is_cameras and networks % NETWORKS_A_CACHE == 0:
                    jax.clear_caches()
    heads = (lines.heads[key] for work in works.values() for key in work.keys)
    return Counter(str(head.get("status", "unknown")) for head in heads) + counts


def result_rows(inputs: Sequence[str | Path], file: str | Path) -> Iterator[dict]:
    """The lines of these inputs in a file of results, in its order, as `run_batch` wrote them."""
    names = {key_of(path, file) for path in inputs}
    ours = lambda key: key in names or any(key.startswith(f"{name}#") for name in names)
    with locked(file):
        lines = JsonLines(file)
        yield from lines.rows(filter(ours, lines.heads))


def key_of(path: str | Path, file: str | Path) -> str:
    """The path of an input seen from the folder of the file of results, with / between folders."""
    folder, name = os.path.split(os.path.abspath(path))
    path = os.path.join(os.path.realpath(folder), name)
    try:
        path = os.path.relpath(path, os.path.dirname(os.path.realpath(file)))
    except ValueError:  # another drive
        pass
    return Path(path).as_posix()


@dataclasses.dataclass(frozen=True)
class _Work:
    """What is to be done for an input.

    **Fields:** `keys` of its lines; their `settings`; `data`, the fingerprint of number i; `solve`,
    the rows of some, from their numbers.
    """

    keys: tuple[str, ...]
    settings: dict
    data: Callable[[int], str]
    solve: Callable[[Sequence[int]], Iterable[dict]]
    is_cameras: bool


def _cameras(path: str, name: str, options: dict, brief: bool) -> _Work:
    stack = read_camera_stack(path)
    free = free_parameters(pixel_model(options["model"]), options["free"])

    def solve(chosen):
        batch = calibrate_batch(**stack.arguments(chosen), **options)
        return [camera_row(batch, i, brief) for i in range(len(chosen))]

    settings = options | {"model": str(options["model"]), "free": list(free), "brief": brief}
    keys = tuple(f"{name}#{camera}" for camera in stack.ids)
    return _Work(keys, settings, stack.fingerprint, solve, True)


def _network(path: str, name: str, options: dict, brief: bool) -> _Work:
    options = {key: value for key, value in options.items() if key not in ("model", "free")}
    solve = lambda chosen: [network_row(path, **options)]
    return _Work((name,), options, lambda i: of_input(path), solve, False)


def _rows(work: _Work, chosen: Sequence[int]) -> list[dict]:
    # Before the work: what is changed meanwhile is seen to be changed.
    data = [work.data(i) for i in chosen]
    return [
        {"key": work.keys[i], "status": row["status"], "settings": work.settings, "data": of} | row
        for i, of, row in zip(chosen, data, work.solve(chosen))
    ]


def _again(work: _Work, lines: JsonLines, retry: bool, renew: bool) -> list[str]:
    """The keys of an input that are in the file, and are to be computed again.

    **Raises:** `InputError` for a line that was made of something else, without `renew`."""
    again, other = [], {}
    for i, key in enumerate(work.keys):
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
            f"{key}: {difference}; give another file to --json-lines, or compute them again with "
            "--renew"
        )
    return [*again, *other]


def _difference(head: dict, work: _Work, i: int) -> str:
    """What a line was made of otherwise, in words; empty if nothing."""
    old = head.get("settings")
    if not isinstance(old, dict) or "data" not in head:
        return "its line does not say what it was made of (an earlier version wrote it)"
    for name in {**work.settings, **dict.fromkeys(SNOOPING)}:
        value = work.settings.get(name)
        # A minimum is the same after however many iterations were allowed.
        matters = name != "max_iterations" or head.get("status") == STATUS[LIMIT]
        if matters and old.get(name) != value:
            return f"{name} was {_shown(old.get(name))}, is {_shown(value)}"
    others = "the measurements were others" if work.is_cameras else "its files were others"
    return "" if head["data"] == work.data(i) else others


def _shown(value) -> str:
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)


def network_row(path: str, **options) -> dict:
    """The status and brief result of one network (`options` of `adjust`), or why there is none."""
    try:
        result = adjust(read_network(path), **options)
        status = "converged" if result.converged else result.termination
        return {"status": status} | result_dict(result, brief=True)
    except (InputError, NotSolvedError) as error:
        status = "bad input" if isinstance(error, InputError) else "not solved"
        return {"status": status, "error": str(error)}
    except (ValueError, ArithmeticError, RuntimeError, OSError, MemoryError) as error:
        return {"status": "failed", "error": f"{type(error).__name__}: {error}"}


def camera_row(batch: BatchCalibration, i: int, brief: bool = False) -> dict:
    """The result of camera i as plain dicts and numbers (angles in radians)."""
    row = {
        "status": str(batch.status[i]),
        "model": str(batch.model),
        "iterations": int(batch.iterations[i]),
        "redundancy": int(batch.redundancy[i]),
        "views": int(batch.views[i].sum()),
        "views_left_out": np.flatnonzero(~batch.views[i]).tolist(),
    }
    if batch.remark[i]:
        row["remark"] = str(batch.remark[i])
    if batch.removed is not None:
        removed = np.argwhere(batch.removed[i])
        row["removed"] = len(removed) if brief else removed.tolist()
    if batch.undetermined[i].any():
        row["undetermined"] = np.array(batch.parameters)[batch.undetermined[i]].tolist()
    if not batch.solved[i]:
        return row
    estimates = zip(batch.parameters, batch.values[i].tolist(), batch.sigma[i].tolist())
    row |= {
        "rms": float(batch.rms[i]),
        "sigma0": float(batch.sigma0[i]),
        "parameters": {name: {"value": v, "sigma": s} for name, v, s in estimates},
    }
    if not brief:
        names = ("position", "angles", "sigma_position", "sigma_angles")
        columns = zip(*(getattr(batch, name)[i].tolist() for name in names))
        row |= {
            "covariance": batch.covariance[i].tolist(),
            "poses": [dict(zip(names, values)) for values in columns],
        }
    return row
