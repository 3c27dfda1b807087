"""Shared by the line scanner commands: surfaces, scanner files, tables."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import typer

from jaxbundle.cli.outputs import check_file, check_json
from jaxbundle.commands.scanner_inputs import check_spheroid as check_spheroid
from jaxbundle.commands.scanner_inputs import geographic as geographic
from jaxbundle.commands.scanner_inputs import open_scanner as read_scanner_file
from jaxbundle.commands.scanner_inputs import surface_of as surface_of
from jaxbundle.io.rasters.mosaics import tiles_in
from jaxbundle.io.results.result_json import without_nan
from jaxbundle.io.scanner.scanner import ScannerInput
from jaxbundle.io.text.csv_tables import write_csv, write_text
from jaxbundle.io.writing.fingerprints import files_read
from jaxbundle.system.terminals import write_json
from jaxbundle.types import Column

if TYPE_CHECKING:
    from jaxbundle.certificates.acceptance import Acceptance


def open_scanner(path: Path) -> ScannerInput:
    """A scanner file; its warnings go to standard error."""
    return read_scanner_file(path, warn)


def check_outputs(inputs: Sequence[str | Path | None], **outputs: str | Path | None) -> None:
    """Refuse an output file, by option name, that cannot be written or is an input, such as a tile
    of a terrain; for JSON, `check_json`."""
    given = [Path(path) for path in inputs if path]
    input_files = [
        file for path in given for file in (tiles_in(path) if path.is_dir() else files_read(path))
    ]
    for option, path in outputs.items():
        check_file(f"--{option.replace('_', '-')}", str(path or ""), None, input_files)
    check_json(str(outputs.get("json") or ""))


def write_rows(
    columns: Mapping[str, Column],
    csv: Path | None,
    json_: str,
    head: Mapping | None = None,
    acceptance: "Acceptance | None" = None,
) -> None:
    """A table as CSV or JSON, in a file or on standard output; with what was found of criteria."""
    if acceptance is not None:
        head = {**(head or {}), "acceptance": acceptance.to_dict()}
    columns = {
        name: values.tolist() if isinstance(values, np.ndarray) else list(values)
        for name, values in columns.items()
    }
    rows = list(zip(*columns.values()))
    if json_:
        rows = [dict(zip(columns, row)) for row in rows]
        text = json.dumps(without_nan({**(head or {}), "rows": rows}), ensure_ascii=False) + "\n"
        if json_ == "-":
            write_json(text)
        else:
            write_text(Path(json_), text)
    # NaN, which is not equal to itself, is an empty cell
    rows = [["" if v != v else v for v in row] for row in zip(*columns.values())]
    if csv is not None and str(csv) != "-":
        write_csv(csv, list(columns), rows)
    elif not json_:
        print(",".join(columns))
        for row in rows:
            print(",".join(map(str, row)))


def warn(message: str) -> None:
    """A line on standard error."""
    typer.echo(f"jaxbundle: {message}", err=True)
