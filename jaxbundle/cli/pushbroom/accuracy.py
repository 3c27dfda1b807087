"""`jaxbundle pushbroom accuracy`: ground errors caused by errors of the ancillary data."""

from pathlib import Path
from typing import Annotated, cast

import typer

from jaxbundle.choices import ATTITUDE_ERRORS, AttitudeError
from jaxbundle.cli.app import choice
from jaxbundle.cli.pushbroom.app import Csv, Dem, Geoid, Json, Level, ScannerFile, pushbroom
from jaxbundle.errors import InputError

Sigma = Annotated[
    float, typer.Option(min=0, help="standard deviation: degrees, metres, per second")
]


@pushbroom.command(example="out/flight/scanner.toml --attitude-white 0.01")
def accuracy(  # noqa: PLR0913 - the options of the command
    scanner: ScannerFile,
    truth: Annotated[Path | None, typer.Option(help="scanner file of the truth")] = None,
    attitude_bias: Sigma = 0.0,
    attitude_drift: Sigma = 0.0,
    attitude_white: Sigma = 0.0,
    position_bias: Sigma = 0.0,
    position_drift: Sigma = 0.0,
    position_white: Sigma = 0.0,
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
    csv: Csv = None,
    json: Json = "",
) -> None:
    """Ground RMS and CE90 for given σ of the ancillary data, or errors against a known truth.

    Of about a thousand irregular positions, so that none of them falls in step with the records.
    """
    import numpy as np

    from jaxbundle.cli.pushbroom.accuracy_table import table_of, write_table
    from jaxbundle.cli.pushbroom.places import grid_of
    from jaxbundle.cli.pushbroom.shared import keep_inputs, open_scanner, surface_of, write_rows
    from jaxbundle.pushbroom.accuracy import (
        ground_errors,
        propagate_accuracy,
        simulate_accuracy,
        spread_positions,
    )
    from jaxbundle.pushbroom.noise import Noise
    from jaxbundle.pushbroom.terrain import Terrain

    keep_inputs([scanner, truth, dem], csv=csv, json=json, map=map_)
    fewest = 20  # the RMS of n draws is uncertain by up to 1/√n, here 22 %
    if 0 < draws < fewest:
        raise InputError(
            f"--draws {draws}: too few for an RMS; at least {fewest}, 1000 are accurate to 3 %"
        )
    if map_ is not None:
        _check_map(map_, table)
    if table:
        if dem is not None:
            raise InputError("--dem: use --height with --table; terrain has no reverse mode")
        kind = cast(AttitudeError, table)
        write_table(table_of(scanner, kind, levels, draws, seed, height), csv, json)
        return
    file = open_scanner(scanner)
    surface = surface_of(file.earth, height, dem, file.image, geoid)
    cells = grid_of(grid)
    size = file.image.lines, file.image.pixels
    spread = spread_positions(*size, cells)
    line, pixel = (v.ravel() for v in spread)
    row, column = ((np.arange(k) + 0.5) * n / k - 0.5 for k, n in zip(cells, size))
    columns = {"line": np.repeat(row, len(column)), "pixel": np.tile(column, len(row))}
    by_cell = lambda values: np.asarray(values).reshape(len(row) * len(column), -1)
    known = lambda values: np.isfinite(values).sum(1)
    # a cell where every ray misses the surface has no mean
    mean = lambda values: np.nansum(values, 1) / np.where(known(values) > 0, known(values), np.nan)
    rms = lambda values: np.sqrt(mean(values**2))
    if truth is not None:
        errors = ground_errors(file.image, open_scanner(truth).image, surface, line, pixel)
        length = np.hypot(*errors.T)
        columns |= {
            "east": mean(by_cell(errors[:, 0])),
            "north": mean(by_cell(errors[:, 1])),
            "error": rms(by_cell(length)),
        }
        if not np.isfinite(length).any():
            raise InputError("no ray meets the surface: check attitude, mounting and height")
        head = {
            "rms": float(np.sqrt(np.nanmean(length**2))),
            "ce90": float(np.nanquantile(length, 0.9)),
        }
    else:
        degree = np.pi / 180
        noise = Noise(
            degree * attitude_bias,
            degree * attitude_drift,
            degree * attitude_white,
            position_bias,
            position_drift,
            position_white,
        )
        if not any(noise):
            raise InputError("no σ is given: --attitude-white 0.01, for example, or --truth FILE")
        if isinstance(surface, Terrain):
            raise InputError("--dem: use --height with σ; terrain has no reverse mode")
        found = propagate_accuracy(file.image, surface, line, pixel, noise)
        columns |= {"rms": rms(by_cell(found.rms)), "ce90": mean(by_cell(found.ce90))}
        head = {"rms": found.overall, "ce90": found.overall_ce90}
        if draws:
            counted = simulate_accuracy(file.image, surface, line, pixel, noise, draws, seed)
            columns |= {
                "drawn_rms": rms(by_cell(counted.rms)),
                "drawn_ce90": mean(by_cell(counted.ce90)),
            }
            head |= {
                "drawn_rms": counted.overall,
                "drawn_ce90": counted.overall_ce90,
                "draws": draws,
            }
    head["positions"] = len(line)
    if map_ is not None:
        _write_map(map_, columns, head)
    write_rows(columns, csv, json, {"scanner": file.name, **head})
    if json != "-":
        typer.echo("; ".join(f"{k} {v:.6g}" for k, v in head.items()), err=True)


def _check_map(path: Path, table: str | None) -> None:
    if table:
        raise InputError("--map: not available with --table; omit one of them")
    if path.suffix.lower() not in (".tif", ".tiff", ".png"):
        raise InputError(f"--map {path}: a name that ends in .tif or .png is expected")
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
    told = f"RMS {head['rms']:.3g} m, CE90 {head['ce90']:.3g} m"
    title = "Error on the ground" if name == "error" else "RMS on the ground"
    draw = lambda ax: image_map(lines, pixels, bands[f"{name} [m]"], title, "m", told, ax)
    try:
        write_figures(path.parent, {path.stem: ((7.5, 6), None, draw)})
    except ImportError as error:
        raise InputError(str(error)) from None
