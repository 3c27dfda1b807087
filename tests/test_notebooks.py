"""The notebooks run from their first cell to their last, open with a question, show a picture."""

import sys
from pathlib import Path

import matplotlib
import nbformat
import pytest
from IPython.core.interactiveshell import InteractiveShell
from IPython.utils.capture import capture_output
from matplotlib import pyplot as plt
from traitlets.config import Config

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))

each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def outputs(notebook):
    return [output for cell in notebook.cells for output in cell.get("outputs", [])]


def texts(output):
    """What a reader sees of an output, as text: streams, data in all its forms but pictures."""
    data = output.get("data", {})
    return [output.get("text", ""), *(str(x) for kind, x in data.items() if "image" not in kind)]


def pictures(notebook):
    return [output for output in outputs(notebook) if "image/png" in output.get("data", {})]


def test_there_are_notebooks():
    assert NOTEBOOKS


@each_notebook
def test_opens_with_a_question(path):
    first = nbformat.read(path, as_version=4).cells[0]
    assert first.cell_type == "markdown"
    assert "?" in first.source


@each_notebook
def test_is_stored_with_clean_outputs(path):
    """Run to the end, in order, with figures; no warnings and no traces of the machine."""
    notebook = nbformat.read(path, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert pictures(notebook)
    for output in outputs(notebook):
        assert output.output_type != "error"
        assert output.get("name") != "stderr"
        for text in texts(output):
            assert str(Path.home()) not in text and str(FOLDER.parent) not in text
    assert not any(cell.metadata for cell in notebook.cells)


class Shell(InteractiveShell):
    def enable_gui(self, gui=None):
        """None: pictures are drawn inline."""


@pytest.fixture(scope="module")
def only_shell(tmp_path_factory):
    """IPython in this process: a kernel for each notebook would import and trace all again."""
    with pytest.MonkeyPatch.context() as patch, matplotlib.rc_context():
        patch.setenv("IPYTHONDIR", str(tmp_path_factory.mktemp("ipython")))
        patch.setitem(sys.modules, "__main__", sys.modules["__main__"])  # IPython puts its own
        shell = Shell.instance(config=Config({"HistoryManager": {"enabled": False}}))
        shell.enable_matplotlib("inline")
        yield shell
        plt.switch_backend("agg")
        Shell.clear_instance()


@pytest.fixture
def shell(only_shell):
    """With no names but its own; figures that a test before has left are not the notebook's."""
    plt.close("all")
    with matplotlib.rc_context():
        yield only_shell
    only_shell.reset()


FURTHER = (
    "a_real_facade", "calibrate_and_trust", "calibrate_through_pixels",
    "four_photographs_to_a_surface", "gradient_checked_experiment", "lapan_a3", "next_photograph",
    "rolling_shutter_on_a_drone", "ten_thousand_cameras", "thesis_network", "two_strips_to_a_dsm",
    "two_video_cameras", "weights_learned_from_data",
    "which_camera_model",
)  # fmt: skip
"""Whose functions another notebook, or another test, calls."""
DOWNLOADED = {"a_real_facade": "../out/facade8"}
"""Real data that are not in this repository, relative to the notebooks."""


@pytest.mark.slow
@pytest.mark.parametrize("path", [
    pytest.param(path, id=path.stem, marks=pytest.mark.further if path.stem in FURTHER else ())
    for path in NOTEBOOKS
])  # fmt: skip
def test_runs(path, shell, monkeypatch):
    monkeypatch.chdir(path.parent)
    if path.stem in DOWNLOADED and not (FOLDER / DOWNLOADED[path.stem]).exists():
        pytest.skip(f"{DOWNLOADED[path.stem]} is not there: the reader downloads it")
    figures = 0
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "code":
            with capture_output() as captured:
                result = shell.run_cell(cell.source, store_history=True)
            result.raise_error()
            figures += sum("image/png" in output.data for output in captured.outputs)
    assert figures
