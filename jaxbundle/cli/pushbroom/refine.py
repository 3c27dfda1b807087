"""`jaxbundle pushbroom refine`: least squares on control and tie points."""

import dataclasses
import json as json_
from pathlib import Path
from typing import Annotated

import typer

import jaxbundle
from jaxbundle.cli.pushbroom.app import pushbroom, warn
from jaxbundle.io.csv_tables import write_csv, write_text
from jaxbundle.io.project import write_project
from jaxbundle.io.refinement import read_refinement
from jaxbundle.io.result_json import without_nan
from jaxbundle.io.scanner_writing import write_scanner_image
from jaxbundle.refinement import adjusted_photographs, point_rows, report, to_json
from jaxbundle.refinement import refine as refine_images


@pushbroom.command()
def refine(
    input: Annotated[Path, typer.Argument(help="refine file, .toml (docs/pushbroom.md)")],
    out: Annotated[
        Path | None, typer.Option(help="folder for report, JSON, refined files")
    ] = None,
    json: Annotated[str, typer.Option(help="write the result as JSON; - for stdout alone")] = "",
) -> None:
    """Refine attitude, position and optics of scanner images by points; report what they tell."""
    jaxbundle.enable_x64()
    file = read_refinement(input)
    result = refine_images(
        file.images, file.points, file.observations, file.frames,
        snooping=file.snooping, significance=file.significance,
    )  # fmt: skip
    result = dataclasses.replace(result, warnings=(*file.warnings, *result.warnings))
    text, document = report(result), without_nan(to_json(result))
    as_json = json_.dumps(document, ensure_ascii=False) + "\n"
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        for one in file.images:
            write_scanner_image(out, one.id, result.image(one.id), one.earth)
        rows = point_rows(result)
        write_csv(out / "points.csv", list(rows[0]), [list(row.values()) for row in rows])
        photographs = adjusted_photographs(result)
        if photographs is not None:
            write_project(photographs, out / "photographs")
        write_text(out / "report.txt", text)
        write_text(out / "result.json", as_json)
    if json == "-":
        print(as_json, end="")
    else:
        if json:
            write_text(Path(json), as_json)
        print(text, end="")
    if json == "-":
        for warning in result.warnings:
            warn(warning)
