"""`batch`: many cameras, many networks into one file, and what the file says of them."""

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from jaxbundle.batches.camera import SOLVED
from jaxbundle.batches.population import Population
from jaxbundle.batches.run_on_files import result_rows, run_batch
from jaxbundle.display import print_in_one_screen
from jaxbundle.io.results.result_json import without_nan
from jaxbundle.measure.boards import Board
from jaxbundle.results import TableMethods
from jaxbundle.types import Progress

# The count of inputs that had a result before.
SKIPPED = "skipped"


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class BatchRun(TableMethods):
    """A finished run: its `inputs`, the file of results `json_lines`, and `counts`: the number of
    inputs by status in the file, and of those "skipped" because they were in it before."""

    inputs: tuple[str, ...]
    json_lines: str
    counts: Mapping[str, int]

    @property
    def statuses(self) -> Counter:
        """The number of inputs by status."""
        return Counter({name: n for name, n in self.counts.items() if name != SKIPPED})

    @property
    def solved(self) -> int:
        """The number of inputs with a result."""
        return sum(self.statuses[status] for status in SOLVED)

    @property
    def converged(self) -> bool:
        """Whether every input has a result."""
        return self.solved == self.statuses.total()

    @cached_property
    def population(self) -> Population:
        """The results as columns, their distribution, and what is unusual."""
        return Population(result_rows(self.inputs, self.json_lines))

    def to_dict(self, against: Mapping[str, np.ndarray] | None = None) -> dict[str, Any]:
        """The summary of the population; correlations with columns `against`."""
        return without_nan(self.population.summary(against or {}))

    def table(self) -> dict[str, np.ndarray]:
        """One row per input."""
        return self.population.table({})

    def __str__(self) -> str:
        """Counts by status in a line."""
        counts = ", ".join(f"{n} {status}" for status, n in self.statuses.most_common() if n)
        skipped = self.counts.get(SKIPPED, 0)
        return f"{self.json_lines}: {counts}" + (
            f" ({skipped} skipped, already computed)" if skipped else ""
        )


def batch(  # noqa: PLR0913 (public: the options of the command, all but two by name)
    inputs: Sequence[str | Path],
    json_lines: str | Path,
    *,
    model: str = "opencv",
    free: Sequence[str] | None = None,
    board: Board | None = None,
    rig: bool = False,
    pixel_size: float | None = None,
    overrides: Sequence[str] = (),
    part: tuple[int, int] = (1, 1),
    max_iterations: int = 100,
    snooping: str | None = None,
    significance: float = 0.001,
    portion: int = 256,
    brief: bool = False,
    retry: bool = False,
    renew: bool = False,
    progress: Progress = lambda *_: None,
) -> BatchRun:
    """Calibrate many cameras and adjust many networks; an interrupted run resumes.

    Of arrays in memory: `jaxbundle.calibrate_batch`, `jaxbundle.calibrate_rigs`.

    **Arguments:**

    - `inputs`: `.npz` of many cameras or rigs; projects and other networks; with a `board`, folders
      of photographs of one camera each, or of rigs (`rig`).
    - `json_lines`: file of results, one per line; inputs already in it are skipped.
    - `model`, `free`: of the cameras; `pixel_size`: mm, for a model in mm.
    - `overrides`: KEY=VALUE (`--set`), of projects as of `read_network`; of cameras and rigs
      `rig.KEY` and `rolling_shutter.KEY`.
    - `part`: (I, N): only the I-th of N parts of the inputs.
    - `snooping`: `"pope"` at the level `significance`; `max_iterations` of each.
    - `portion`: cameras computed between writes; `brief`: omit poses and covariances.
    - `retry`: compute inputs without a result again; `renew`: those of other settings or data.
    - `progress(stage, done, total)`.

    **Raises:** `InputError` before anything is computed; an input that cannot be read or solved
    gets a line with the reason.
    """
    counts = run_batch(
        inputs,
        json_lines,
        model=model,
        free=free,
        max_iterations=max_iterations,
        snooping=snooping,
        significance=significance,
        board=board,
        rig=rig,
        pixel_size=pixel_size,
        settings=overrides,
        part=part,
        brief=brief,
        retry=retry,
        renew=renew,
        portion=portion,
        progress=progress,
    )
    return BatchRun(tuple(map(str, inputs)), str(json_lines), counts)
