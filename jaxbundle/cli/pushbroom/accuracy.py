"""`jaxbundle pushbroom accuracy`: ground errors caused by errors of the ancillary data."""

from pathlib import Path
from typing import Annotated, cast

import typer

from jaxbundle.choices import ATTITUDE_ERRORS, AttitudeError
from jaxbundle.cli.app import choice
from jaxbundle.cli.certificate_options import Accept
from jaxbundle.cli.pushbroom.app import Csv, Dem, Geoid, Json, Level, ScannerFile, pushbroom
from jaxbundle.errors import InputError


@pushbroom.command(example="out/flight/scanner.toml --attitude-white 0.01")
def accuracy(  # noqa: PLR0913 - the options of the command
    scanner: ScannerFile,
    truth: Annotated[Path | None, typer.Option(help="scanner file of the truth")] = None,
    attitude_bias: Annotated[
        float,
        typer.Option(min=0, help="σ of a constant error of each angle of the attitude, degrees"),
    ] = 0.0,
    attitude_drift: Annotated[
        float,
        typer.Option(
            min=0, help="σ of an error of each angle that grows with time, degrees per second"
        ),
    ] = 0.0,
    attitude_white: Annotated[
        float,
        typer.Option(min=0, help="σ of independent errors of the angles of every record, degrees"),
    ] = 0.0,
    position_bias: Annotated[
        float,
        typer.Option(
            min=0, help="σ of a constant error of each coordinate of the position, metres"
        ),
    ] = 0.0,
    position_drift: Annotated[
        float,
        typer.Option(
            min=0, help="σ of an error of each coordinate that grows with time, metres per second"
        ),
    ] = 0.0,
    position_white: Annotated[
        float,
        typer.Option(
            min=0, help="σ of independent errors of the coordinates of every record, metres"
        ),
    ] = 0.0,
    draws: Annotated[
        int, typer.Option(min=0, help="Monte Carlo draws, in addition to propagation")
    ] = 0,
    seed: int = 0,
    grid: Annotated[
        str, typer.Option(help="LINESxPIXELS parts of the image, a row of the table each")
    ] = "11x11",
    table: Annotated[
        str | None, choice(ATTITUDE_ERRORS, "tabulate a flight file, given as SCANNER")
    ] = None,
    levels: Annotated[str, typer.Option(help="attitude σ of that table, degrees")] = "0.01,0.1",
    map_: Annotated[
        Path | None,
        typer.Option("--map", help="map of the error: .tif (all columns), .png (a figure)"),
    ] = None,
    height: Level = None,
    dem: Dem = None,
    geoid: Geoid = None,
    accept: Accept = None,
    csv: Csv = None,
    json: Json = "",
) -> None:
    """Ground RMS and CE90 for given σ of the ancillary data, or errors against a known truth.

    Of about a thousand irregular positions, so that none of them falls in step with the records.
    """
    from jaxbundle import pushbroom as line_scanners
    from jaxbundle.cli.acceptance import accept_result, check_accept, end_unmet
    from jaxbundle.cli.pushbroom.accuracy_table import table_of, write_table
    from jaxbundle.cli.pushbroom.places import grid_of
    from jaxbundle.cli.pushbroom.shared import check_outputs, warn, write_rows

    check_accept(accept, "pushbroom accuracy")
    check_outputs([scanner, truth, dem, geoid], csv=csv, json=json, map=map_)
    if map_ is not None:
        _check_map(map_)
    sigmas = {
        "attitude_bias": attitude_bias,
        "attitude_drift": attitude_drift,
        "attitude_white": attitude_white,
        "position_bias": position_bias,
        "position_drift": position_drift,
        "position_white": position_white,
    }
    if table:
        if dem is not None:
            raise InputError("--dem: use --height with --table; terrain has no reverse mode")
        _refuse_beside_table(accept=accept, map=map_, truth=truth, geoid=geoid, **sigmas)
        kind = cast(AttitudeError, table)
        write_table(table_of(scanner, kind, levels, draws, seed, height), csv, json)
        return
    result = line_scanners.accuracy(
        scanner,
        truth=truth,
        **sigmas,
        draws=draws,
        seed=seed,
        grid=grid_of(grid),
        height=height,
        dem=dem,
        geoid=geoid,
        tell=warn,
    )
    figures = {name: value for name, value in result.figures.items() if name != "scanner"}
    if map_ is not None:
        _write_map(map_, result.table(), figures)
    acceptance = accept_result(result, accept)
    write_rows(result.columns, csv, json, result.figures, acceptance)
    if json != "-":
        typer.echo("; ".join(f"{k} {v:.6g}" for k, v in figures.items()), err=True)
    end_unmet(acceptance)


def _refuse_beside_table(**options: object) -> None:
    """Refuse options that the table of a flight has no use for: it has errors of its own."""
    for name, value in options.items():
        if value:
            option = f"--{name.replace('_', '-')}"
            raise InputError(f"{option}: not available with --table; omit one of them")


def _check_map(path: Path) -> None:
    if path.suffix.lower() not in (".tif", ".tiff", ".png"):
        raise InputError(f"--map {path}: expected a name that ends in .tif or .png")
    if not path.absolute().parent.is_dir():
        raise InputError(f"--map {path}: there is no folder {path.parent}")


def _write_map(path: Path, columns: dict, head: dict) -> None:
    """All columns as bands; or the RMS, or the error, as a figure."""
    import numpy as np

    from jaxbundle.io.rasters.error_maps import write_image_raster
    from jaxbundle.plotting import image_map
    from jaxbundle.plotting.files import write_figures

    lines, pixels = (np.unique(columns[name]) for name in ("line", "pixel"))
    bands = {
        f"{name} [m]": values.reshape(len(lines), len(pixels))
        for name, values in columns.items()
        if name not in ("line", "pixel")
    }
    if path.suffix.lower() != ".png":
        write_image_raster(path, lines, pixels, bands)
        return
    name = "error" if "error" in columns else "rms"
    overall = f"RMS {head['rms']:.3g} m, CE90 {head['ce90']:.3g} m"
    title = "Error on the ground" if name == "error" else "RMS on the ground"
    draw = lambda ax: image_map(lines, pixels, bands[f"{name} [m]"], title, "m", overall, ax)
    try:
        write_figures(path.parent, {path.stem: ((7.5, 6), None, draw)})
    except ImportError as error:
        raise InputError(str(error)) from None
