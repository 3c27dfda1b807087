"""One kind of report of progress for all long functions: (stage, done, total)."""

import inspect
import io
import sys
from pathlib import Path

import pytest
from rich.progress import Progress as Bars

import jaxbundle
from jaxbundle import types
from jaxbundle.batches.run_on_files import run_batch
from jaxbundle.calibration.model_choice import compare_models
from jaxbundle.io.rasters.correction import write_corrected
from jaxbundle.measure.views import measure_boards
from jaxbundle.reconstruction.reconstruct import reconstruct
from jaxbundle.surfaces.reconstruct import reconstruct_surface

LONG = [
    jaxbundle.adjust, jaxbundle.calibrate, jaxbundle.calibrate_cameras, jaxbundle.calibrate_batch,
    jaxbundle.calibrate_rig, jaxbundle.calibrate_rigs, compare_models, run_batch, reconstruct,
    reconstruct_surface, write_corrected,
]  # fmt: skip


@pytest.mark.parametrize("function", LONG, ids=lambda f: f"{f.__module__}.{f.__qualname__}")
def test_long_functions_take_the_same(function):
    parameter = inspect.signature(function).parameters["progress"]
    assert parameter.annotation in (types.Progress, types.Progress | None)


def test_an_adjustment_reports_its_iterations():
    told = []
    network = jaxbundle.read_network("examples/convergent4/project.toml")
    result = jaxbundle.adjust(network, progress=lambda *state: told.append(state))
    stages, done, totals = zip(*told)
    assert all(stage.startswith("adjusting: vᵀPv ") for stage in stages)
    assert list(done) == list(range(len(told))) and len(told) == result.iterations + 1
    assert len({*totals}) == 1 and totals[0] >= len(told) - 1
    value = float(stages[-1].split()[2].rstrip(","))
    assert value == pytest.approx(float(result.vtpv), rel=1e-6)


def test_photographs_searched_are_reported():
    told = []
    photographs = sorted(Path("examples/board").glob("*.jpg"))[:2]
    board = jaxbundle.Board(9, 6, 0.03)
    measure_boards(photographs, board, lambda *state: told.append(state))
    assert told == [("searching the board", 1, 2), ("searching the board", 2, 2)]


def test_bars_on_a_terminal_and_nothing_in_a_pipe(monkeypatch):
    shown = io.StringIO()
    monkeypatch.setattr(sys, "stderr", shown)
    with jaxbundle.show_progress() as progress:
        progress("matching", 1, 3)
    assert shown.getvalue() == ""
    bars = Bars(disable=True)
    with jaxbundle.show_progress(bars) as progress:
        for done in range(4):
            progress(f"adjusting: vᵀPv {10 - done}", done, 7)
        progress("drawing", 1, 9)
    found = [(task.description, task.completed, task.total) for task in bars.tasks]
    assert found == [("adjusting: vᵀPv 7", 3, 7), ("drawing", 1, 9)]
