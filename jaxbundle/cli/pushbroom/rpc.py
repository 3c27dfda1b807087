"""`jaxbundle pushbroom rpc`: fit, apply and compensate rational polynomial coefficients."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.choices import RPC_BIASES, TESTS
from jaxbundle.cli.app import Application, choice
from jaxbundle.cli.certificate_options import Accept
from jaxbundle.cli.pushbroom.app import Csv, Dem, Geoid, Json, Level, pushbroom
from jaxbundle.errors import InputError

rpc = Application(help="Rational polynomial coefficients (RPC00B).")
pushbroom.add_typer(rpc, name="rpc")

RpcFile = Annotated[
    Path,
    typer.Argument(
        help="coefficients: _RPC.TXT, .RPB, a tagged GeoTIFF, XML of DIMAP or DigitalGlobe, .geom"
    ),
]
Figures = Annotated[str, typer.Option(help="figures and all points as JSON; - for standard output")]
Out = Annotated[Path, typer.Option(help="file for the coefficients: .txt, .rpb, an existing .tif")]


@rpc.command(example="out/flight/scanner.toml --out out/image_RPC.TXT")
def fit(
    source: Annotated[
        Path, typer.Argument(help="scanner file, or table longitude,latitude,height,line,sample")
    ],
    out: Out,
    heights: Annotated[
        str, typer.Option(help="LOW:HIGH of the ground, metres above the ellipsoid")
    ] = "0:3000",
    ridge: Annotated[
        float | None, typer.Option(min=0, help="ridge parameter; default: automatic")
    ] = None,
    accept: Accept = None,
    json: Figures = "",
) -> None:
    """Fit coefficients to a scanner or a table; print the residuals in pixels."""
    from jaxbundle import pushbroom as line_scanners
    from jaxbundle.cli.acceptance import accept_result, check_accept, end_unmet
    from jaxbundle.cli.pushbroom.shared import check_outputs, warn, write_rows

    check_accept(accept, "pushbroom rpc fit")
    check_outputs([source], out=out, json=json)
    fitted = line_scanners.rpc.fit(source, heights=_heights(heights), ridge=ridge, tell=warn)
    fitted.write(out)
    acceptance = accept_result(fitted, accept)
    if json:
        write_rows(fitted.columns, None, json, fitted.figures, acceptance)
    else:
        print(fitted if acceptance is None else f"{fitted}\n\n{acceptance}")
    end_unmet(acceptance)


@rpc.command(example="out/image_RPC.TXT --points points.csv")
def apply(
    coefficients: RpcFile,
    points: Annotated[
        Path,
        typer.Option(help="longitude,latitude,height[,id] (degrees, metres), or line,sample[,id]"),
    ],
    height: Level = None,
    dem: Dem = None,
    geoid: Geoid = None,
    csv: Csv = None,
    json: Json = "",
) -> None:
    """Project ground points to the image, or locate image positions on a surface."""
    from jaxbundle import pushbroom as line_scanners
    from jaxbundle.cli.pushbroom.shared import check_outputs, warn, write_rows

    check_outputs([coefficients, points, dem, geoid], csv=csv, json=json)
    applied = line_scanners.rpc.apply(
        coefficients, points, height=height, dem=dem, geoid=geoid, tell=warn
    )
    write_rows(applied.columns, csv, json)


@rpc.command(example="out/image_RPC.TXT --control control.csv --out out/shifted_RPC.TXT")
def compensate(  # noqa: PLR0913 - the options of the command
    coefficients: RpcFile,
    control: Annotated[
        Path,
        typer.Option(
            help="table longitude,latitude,height,line,sample[,id,role,seast,snorth,sheight]; "
            "role: control or check"
        ),
    ],
    out: Out,
    model: Annotated[str, choice(RPC_BIASES, "in the image")] = "shift",
    sigma: Annotated[
        float | None,
        typer.Option(help="σ of measured lines and samples, pixels; default: 1, not tested"),
    ] = None,
    snooping: Annotated[
        str, choice(("none", *TESTS), "points beyond its limit are left out")
    ] = "none",
    significance: Annotated[float, typer.Option(help="of snooping")] = 0.001,
    crs: Annotated[
        str | None, typer.Option(help="projected system: the table has x,y,height,…")
    ] = None,
    geoid: Annotated[
        Path | None, typer.Option(help="heights are above it: raster, or name of a PROJ grid")
    ] = None,
    csv: Csv = None,
    accept: Accept = None,
    json: Figures = "",
) -> None:
    """Remove the bias found by control points; print residuals, redundancy numbers and w."""
    from jaxbundle import pushbroom as line_scanners
    from jaxbundle.cli.acceptance import accept_result, check_accept, end_unmet
    from jaxbundle.cli.pushbroom.shared import check_outputs, warn, write_rows
    from jaxbundle.io.scanner.rpc import RASTERS

    check_accept(accept, "pushbroom rpc compensate")
    # The tags of a raster may be replaced in place.
    check_outputs([control, geoid], out=out, csv=csv, json=json)
    check_outputs([coefficients], csv=csv, json=json, out=None if out.suffix in RASTERS else out)
    compensated = line_scanners.rpc.compensate(
        coefficients,
        control,
        model=model,
        sigma=sigma,
        snooping=snooping,
        significance=significance,
        crs=crs,
        geoid=geoid,
        tell=warn,
    )
    compensated.write(out)
    acceptance = accept_result(compensated, accept)
    write_rows(compensated.columns, csv, json, compensated.figures, acceptance)
    if json != "-":
        typer.echo(compensated, err=True)
    end_unmet(acceptance)


def _heights(text: str) -> tuple[float, float]:
    try:
        low, high = (float(part) for part in text.split(":"))
    except ValueError:
        low, high = 0.0, 0.0
    # NaN is not below.
    if not (low < high and abs(low) != float("inf") and high != float("inf")):
        raise InputError(
            f"--heights {text!r}: expected two numbers, the lower first, such as 0:3000"
        )
    return low, high
