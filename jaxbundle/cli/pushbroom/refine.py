"""`jaxbundle pushbroom refine`: adjust scanner images with control and tie points."""

import dataclasses
import json as json_
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.cli.app import Force, Html, Json
from jaxbundle.cli.certificate_options import Accept
from jaxbundle.cli.pushbroom.app import pushbroom

PHOTOGRAPHS = "photographs"


@pushbroom.command(example="refine.toml --out out/refined")
def refine(
    input: Annotated[Path, typer.Argument(help="refine file, .toml (docs/pushbroom.md)")],
    out: Annotated[
        Path | None, typer.Option(help="folder for report, page, JSON, refined files")
    ] = None,
    html: Html = "",
    force: Force = False,
    accept: Accept = None,
    json: Json = "",
) -> None:
    """Refine scanner images, rigorous or with RPC, with control and tie points."""
    from jaxbundle import pushbroom as line_scanners
    from jaxbundle.cli.acceptance import accept_result, check_accept, end_unmet
    from jaxbundle.cli.outputs import (
        PAGE,
        REPORT,
        RESULT,
        check_writable,
        trace_files,
        write_result,
    )
    from jaxbundle.cli.pushbroom.shared import warn
    from jaxbundle.io.networks.project import FILES, fill_project
    from jaxbundle.io.results.result_json import verdict_dict, without_nan
    from jaxbundle.io.scanner.refined_images import (
        describe_refits,
        describe_states,
        names_of_images,
        write_images,
    )
    from jaxbundle.io.scanner.refined_orientations import FILE as PRECISION
    from jaxbundle.io.scanner.refined_orientations import TABLE, write_refined_orientations
    from jaxbundle.io.scanner.refinement import read_refinement
    from jaxbundle.io.text.csv_tables import write_csv, write_text
    from jaxbundle.io.writing.fingerprints import files_read
    from jaxbundle.refinement import adjusted_photographs, point_rows, report, to_json
    from jaxbundle.report.page import UNKNOWN, head_line
    from jaxbundle.report.page.refinement import compose_refinement
    from jaxbundle.report.refinement_verdict import conclude_refinement
    from jaxbundle.types import not_none

    check_accept(accept, "pushbroom refine")
    file = read_refinement(input)
    names = [REPORT, PAGE, RESULT, "points.csv", *(f"{PHOTOGRAPHS}/{name}" for name in FILES)]
    names += [TABLE, PRECISION, *names_of_images(file)]
    files = files_read(input)
    check_writable(json, out, "pushbroom refine", names, files, force, html)
    origin = UNKNOWN
    if html or out is not None:
        origin = trace_files(
            files,
            {
                "snooping": file.snooping,
                "significance": file.significance,
            },
        )
    result = line_scanners.refine(file)
    if out is not None:
        refits = describe_refits(result)
        result = dataclasses.replace(result, warnings=(*result.warnings, *refits))
    verdict = conclude_refinement(result)
    text = head_line(origin) + report(result, verdict.words)
    acceptance = accept_result(result, accept)
    document = without_nan({"verdict": verdict_dict(verdict), **to_json(result)})
    if acceptance is not None:
        text += f"\n{acceptance}\n"
        document["acceptance"] = without_nan(acceptance.to_dict())
    as_json = json_.dumps(document, ensure_ascii=False) + "\n"
    page = partial(compose_refinement, result, origin)
    with write_result(json, as_json, out, "pushbroom refine", names, force, html, page) as new:
        if new is not None:
            for state_warning in describe_states(write_images(new, file, result)):
                warn(state_warning)
            write_refined_orientations(new, not_none(out), file, result)
            rows = point_rows(result)
            write_csv(new / "points.csv", list(rows[0]), [list(row.values()) for row in rows])
            photographs = adjusted_photographs(result)
            if photographs is not None:
                fill_project(photographs, new / PHOTOGRAPHS)
            write_text(new / REPORT, text)
            write_text(new / RESULT, as_json)
    if json != "-":
        print(text, end="")
    else:
        for warning in result.warnings:
            warn(warning)
    end_unmet(acceptance)
