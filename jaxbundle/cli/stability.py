"""`jaxbundle stability`: calibrations of one camera at several epochs."""

from typing import Annotated

import typer

from jaxbundle.cli.app import app
from jaxbundle.errors import InputError


@app.command(example="spring.json summer.json autumn.json --at 8,24,13")
def stability(
    files: Annotated[
        list[str], typer.Argument(help="results (JSON) of calibrate or adjust, FILE or FILE#ID")
    ],
    at: Annotated[
        str, typer.Option(help="a,b,c: a number or date per epoch, such as temperature, for slopes")
    ] = "",
    json: Annotated[str, typer.Option(help="write the result as JSON; - prints only JSON")] = "",
) -> None:
    """Test whether calibrations of one camera differ significantly."""
    from json import dumps
    from pathlib import Path

    from jaxbundle.batch.population import number_or_days
    from jaxbundle.calibration.stability import stability as compare_epochs
    from jaxbundle.cli.camera_inputs import calibration_given
    from jaxbundle.io.text.csv_tables import write_bytes
    from jaxbundle.report.layout import table
    from jaxbundle.system.terminals import write_json

    calibrations = []
    for file in files:
        camera, covariance = calibration_given(file)
        if covariance is None:
            raise InputError(
                f"{file}: has no covariance; give the result.json of calibrate or adjust"
            )
        calibrations.append((camera, covariance))
    words = [word.strip() for word in at.split(",")] if at else []
    numbers = [number_or_days(word, "--at") for word in words] or None
    found = compare_epochs(calibrations, numbers)
    if json:
        text = dumps(found.to_dict(), indent=1) + "\n"
        if json == "-":
            write_json(text)
            return
        write_bytes(Path(json), text.encode())
    rows = []
    for k, name in enumerate(found.names):
        row = [
            name,
            *(f"{x:.6g}" for x in (found.mean[k], found.mean_sigma[k], found.between[k])),
            f"{found.probability[k]:.2g}",
        ]
        if found.slope is not None:
            row += [
                f"{x[k]:.{digits}g}"
                for x, digits in (
                    (found.slope, 4),
                    (found.slope_sigma, 2),
                    (found.slope_probability, 2),
                    (found.about_slope, 2),
                )
                if x is not None
            ]
        rows.append(row)
    head = ["parameter", "mean", "σ", "between", "p", "slope", "σ slope", "p", "about it"]
    # the columns about slopes are there only with --at
    head = head[: len(rows[0])]
    print("\n".join(table(head, rows, "l" + "r" * (len(head) - 1))))
    print(f"\nall epochs the same, all parameters: {found.all_parameters}")
    print(f"the same, rotation removed:          {found.rotation_removed}")
    print(
        f"images against the mean (RMS, rotation removed): {found.image_found:.4g} px, expected by "
        f"the σ {found.image_expected:.4g} px; between epochs {found.image_between:.4g} px"
    )
