"""`jaxbundle pushbroom accuracy --table`: attitude trajectories by attitude accuracies."""

from pathlib import Path

import numpy as np

from jaxbundle.choices import AttitudeError
from jaxbundle.cli.pushbroom.shared import surface_of, write_rows
from jaxbundle.commands.scanner_tables import check_draws
from jaxbundle.errors import InputError
from jaxbundle.io.scanner.flight import read_flight
from jaxbundle.pushbroom.study import TRAJECTORIES, AccuracyTable, accuracy_table

WAYS = ("drawn", "propagated", "closed")


def table_of(
    path: Path, kind: AttitudeError, levels: str, draws: int, seed: int, height: float | None
) -> AccuracyTable:
    """The table of a flight file, the levels as `0.01,0.1` in degrees."""
    check_draws(draws)
    try:
        sigmas = [float(level) for level in levels.split(",")]
        if not min(sigmas) > 0:
            raise ValueError
    except ValueError:
        raise InputError(
            f"--levels {levels!r}: positive numbers are expected, such as 0.01,0.1"
        ) from None
    given = read_flight(path)
    surface = surface_of(given.earth, height, None)
    return accuracy_table(given.flight, surface, np.radians(sigmas), kind, draws or 1000, seed)


def write_table(table: AccuracyTable, csv: Path | None, json: str) -> None:
    """As CSV or JSON, one row per trajectory and accuracy; or as a printed table."""
    if csv is None and not json:
        print(set_out(table))
        return
    rows = [
        (cell.trajectory, 0.0, cell.interpolation, cell.rms, cell.ce90, *[np.nan] * 4)
        for cell in table.error_free
    ]
    rows += [
        (
            cell.trajectory,
            _degrees(cell.sigma),
            "",
            cell.drawn_rms,
            cell.drawn_ce90,
            cell.propagated_rms,
            cell.propagated_ce90,
            cell.closed_rms,
            cell.closed_ce90,
        )
        for cell in table.erring
    ]
    names = ["trajectory", "sigma", "interpolation", "rms", "ce90"]
    names += [f"{way}_{value}" for way in WAYS[1:] for value in names[3:5]]
    write_rows(
        dict(zip(names, zip(*rows))),
        csv,
        json,
        {
            "altitude": table.altitude,
            "field_of_view": _degrees(table.field_of_view),
            "kind": table.kind,
            "draws": table.draws,
        },
    )


def set_out(table: AccuracyTable) -> str:
    """The printed table: trajectories across, accuracies down."""
    what = {"bias": "one error per image", "white": "an error in every record of the table"}
    text = [
        f"altitude {table.altitude / 1e3:.1f} km, field of view {_degrees(table.field_of_view):g}°",
        f"error of attitude about each axis: {what[table.kind]}; {table.draws} draws",
    ]
    line = lambda name, values, form: f"{name:22}" + "".join(f"{v:>10{form}}" for v in values)
    for value in ("rms", "ce90"):
        text += ["", line(f"{value.upper()} [m]", TRAJECTORIES, "")]
        for method in dict.fromkeys(cell.interpolation for cell in table.error_free):
            cells = [getattr(c, value) for c in table.error_free if c.interpolation == method]
            text.append(line(f"no error, {method}", cells, ".4f"))
        for sigma in dict.fromkeys(cell.sigma for cell in table.erring):
            for way in WAYS:
                cells = [getattr(c, f"{way}_{value}") for c in table.erring if c.sigma == sigma]
                text.append(line(f"{_degrees(sigma):g}°, {way}", cells, ".2f"))
    return "\n".join(text)


def _degrees(angle: float) -> float:
    return float(f"{np.degrees(angle):.6g}")
