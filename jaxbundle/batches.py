"""What `jaxbundle batch` does: many independent calibrations and networks into one file.

Every camera and every network has a key. Results are written as JSON lines, portion by portion,
and what is already in the file is not computed again: a run can be interrupted at any moment.
"""

import os
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np

from jaxbundle.adjustment.batch import BatchCalibration, calibrate_batch
from jaxbundle.adjustment.batch_input import free_parameters, pixel_model
from jaxbundle.bundle import adjust
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.io import read_network
from jaxbundle.io.camera_stacks import CameraStack, read_camera_stack
from jaxbundle.io.json_lines import JsonLines
from jaxbundle.io.result_json import result_dict

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
    brief: bool = False,
    retry: bool = False,
    portion: int = CAMERAS_A_WRITE,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Counter:
    """Calibrate the cameras of `.npz` files and adjust all other inputs as networks.

    **Arguments:**

    - `file`: JSON lines; what it already has is skipped.
    - `model`, `free`, `max_iterations`: as of `calibrate_batch`, for the cameras.
    - `brief`: no poses and covariances of cameras.
    - `retry`: compute again what did not converge in an earlier run.
    - `portion`: cameras between two writes.
    - `progress(done, total)`: called after every write; what was skipped counts as done.

    **Returns:** how many lines of this run have which status, and `"skipped"`.

    **Raises:** `InputError` before anything is computed, for a missing input or a bad `.npz`; a
    network that cannot be read or solved gets a line that says so, and the others go on.
    """
    inputs = list(dict.fromkeys(map(str, inputs)))
    for path in inputs:
        if not os.path.exists(path):
            raise InputError(f"{path}: no such file or folder")
    stacks = {path: read_camera_stack(path) for path in inputs if path.endswith(".npz")}
    if stacks:
        free_parameters(pixel_model(model), free)
    total = sum(len(stacks[path].keys) if path in stacks else 1 for path in inputs)
    options = dict(model=model, free=free, max_iterations=max_iterations)
    lines = JsonLines(file, retry)
    counts, done, networks = Counter(), 0, 0

    def write(rows):
        nonlocal done
        lines.append(rows)
        counts.update(row["status"] for row in rows)
        done += len(rows)
        progress(done, total)

    for path in inputs:
        stack = stacks.get(path)
        keys = stack.keys if stack else (path,)
        chosen = np.array([i for i, key in enumerate(keys) if key not in lines], int)
        counts["skipped"] += len(keys) - len(chosen)
        done += len(keys) - len(chosen)
        progress(done, total)
        for first in range(0, len(chosen), portion):
            if stack:
                write(_cameras(stack, chosen[first : first + portion], brief, options))
            else:
                write([network_row(path)])
                networks += 1
                if networks % NETWORKS_A_CACHE == 0:
                    jax.clear_caches()
    return counts


def network_row(path: str) -> dict:
    """The brief result of one network, or why there is none."""
    try:
        result = adjust(read_network(path))
        status = "converged" if result.converged else result.termination
        return {"key": path, "status": status} | result_dict(result, brief=True)
    except (InputError, NotSolvedError) as error:
        status = "bad input" if isinstance(error, InputError) else "not solved"
        return {"key": path, "status": status, "error": str(error)}
    except (ValueError, ArithmeticError, RuntimeError, OSError) as error:
        return {"key": path, "status": "failed", "error": f"{type(error).__name__}: {error}"}


def _cameras(stack: CameraStack, chosen, brief: bool, options: dict) -> list[dict]:
    batch = calibrate_batch(**stack.arguments(chosen), **options)
    return [{"key": stack.keys[c]} | camera_row(batch, i, brief) for i, c in enumerate(chosen)]


def camera_row(batch: BatchCalibration, i: int, brief: bool = False) -> dict:
    """The result of camera i as plain dicts and numbers (angles in radians)."""
    row = {
        "status": str(batch.status[i]),
        "model": batch.model,
        "iterations": int(batch.iterations[i]),
        "redundancy": int(batch.redundancy[i]),
        "views": int(batch.views[i].sum()),
        "views_left_out": np.flatnonzero(~batch.views[i]).tolist(),
    }
    if not batch.converged[i]:
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
