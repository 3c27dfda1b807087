"""What the command line writes: a JSON file, and a folder of report, JSON, tables, plots and the
adjusted network as a project.

`check_targets` finds before an adjustment what could not be written after it.
"""

import os
import sys
from collections.abc import Iterable
from pathlib import Path

from jaxbundle import report
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.io.csv_tables import table_rows, write_csv, write_text
from jaxbundle.io.project import ADJUSTED, FILE_NAME, write_project
from jaxbundle.io.result_json import result_text, unsolved_text
from jaxbundle.io.result_project import adjusted_network
from jaxbundle.io.settings import TABLES as NETWORK_TABLES
from jaxbundle.network.tables import Network
from jaxbundle.plotting import save_figures
from jaxbundle.plotting.files import FIGURES
from jaxbundle.result import Adjustment

REPORT, RESULT = "report.txt", "result.json"
TABLES = ("cameras", "images", "points", "residuals", "checks")
FILES = (REPORT, RESULT, *(f"{name}.csv" for name in TABLES))
NETWORK_FILES = (FILE_NAME, *(f"{name}.csv" for name in NETWORK_TABLES))
"""In the folder of the adjusted network."""


def check_targets(
    input: Path, network: Network, json: str, out: Path | None, control: Path | None = None
) -> None:
    """Refuse a JSON file or a folder that cannot be written, or that would replace the input."""
    names = (*FILES, *(Path(ADJUSTED) / name for name in NETWORK_FILES))
    check_writable(json, out, names, network_files(input, network, control))


def network_files(
    input: Path, network: Network, control: Path | None = None
) -> tuple[str | Path, ...]:
    """The files a network was read from."""
    tables = (network.images, network.points, network.observations, network.distances)
    files = (input, input / FILE_NAME, *(table.source.name for table in tables))
    return files if control is None else (*files, control)


def check_writable(
    json: str, out: Path | None, names: Iterable[str | Path], inputs: Iterable[str | Path]
) -> None:
    """Refuse a JSON file, or a folder for files of these names, that cannot be written, or that
    would replace one of the inputs."""
    written = []
    if out is not None:
        _check_folder(f"--out {out}", out)
        written += [out / name for name in names]
    if json not in ("", "-"):
        path = Path(json)
        if path.is_dir():
            raise InputError(f"--json {json}: is a folder; give the name of a file")
        if out is None or os.path.abspath(path.parent) != os.path.abspath(out):
            if not os.path.isdir(path.parent):
                raise InputError(f"--json {json}: there is no folder {path.parent}")
            _check_folder(f"--json {json}", path.parent)
        written.append(path)
    read = {os.path.realpath(path) for path in inputs}
    for path in written:
        if os.path.realpath(path) in read:
            raise InputError(f"{path} is part of the input and would be overwritten; give another")


def _check_folder(option: str, folder: Path) -> None:
    """Refuse what is no folder, or where none can be made, or nothing written."""
    there = next((p for p in (folder, *folder.absolute().parents) if os.path.exists(p)), folder)
    if not os.path.isdir(there):
        raise InputError(f"{option}: cannot be made: {there} is not a folder")
    if not os.access(there, os.W_OK | os.X_OK):
        raise InputError(f"{option}: cannot be written: no permission in {there}")


def write_targets(
    result: Adjustment | NotSolvedError, json: str, out: Path | None, brief: bool, plots: bool
) -> None:
    """Write JSON (`-`: on standard output) and folder of a result, or of why there is none."""
    solved = isinstance(result, Adjustment)
    text = lambda brief: result_text(result, brief) if solved else unsolved_text(result)
    if json == "-":
        sys.stdout.writelines(text(brief))
    if out is not None:
        protocol = report.text(result) if solved else f"{result}\n"
        _make_empty(out)
        write_text(out / REPORT, protocol)
        write_text(out / RESULT, text(False))
    if json not in ("", "-"):
        write_text(Path(json), text(brief))
    if out is not None and solved and result.converged:
        _write_tables(result, out)
        write_project(adjusted_network(result), out / ADJUSTED)
        if plots:
            try:
                save_figures(result, out)
            except ImportError as error:
                print(f"no plots: {error}", file=sys.stderr)


def _make_empty(folder: Path) -> None:
    """Make the folder, and remove what an earlier run has written into it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path in _own_files(folder):
            path.unlink(missing_ok=True)
        network = folder / ADJUSTED
        if network.is_dir() and not any(network.iterdir()):
            network.rmdir()
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be written: {error.strerror}") from None


def _own_files(folder: Path) -> Iterable[Path]:
    yield from (folder / name for name in FILES)
    yield from (folder / ADJUSTED / name for name in NETWORK_FILES)
    for pattern in FIGURES:
        yield from folder.glob(pattern)


def _write_tables(result: Adjustment, folder: Path) -> None:
    for name in TABLES:
        table = result.table(name)
        if table:
            write_csv(folder / f"{name}.csv", list(table), table_rows(table))
