"""The notebooks run from their first cell to their last, open with a question, show a picture."""

from pathlib import Path

import nbclient
import nbformat
import pytest
from ipykernel import kernelspec

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
    """Run to the end, in order, with pictures; no warnings and nothing of the machine it ran on."""
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


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Jupyter is migrating its paths:DeprecationWarning")
@each_notebook
def test_runs(path, tmp_path, monkeypatch):
    # a kernel of this very interpreter, whatever else is installed for the user
    kernelspec.write_kernel_spec(tmp_path / "kernels" / "python3")
    monkeypatch.setenv("JUPYTER_PATH", str(tmp_path))
    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        cell.pop("outputs", None)
        if cell.cell_type == "code":
            cell.outputs = []
    client = nbclient.NotebookClient(
        notebook,
        kernel_name="python3",
        timeout=900,
        resources={"metadata": {"path": str(path.parent)}},
    )
    client.execute()
    assert not [output for output in outputs(notebook) if output.output_type == "error"]
    assert pictures(notebook)
