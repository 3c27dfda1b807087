"""`jaxbundle pushbroom accuracy --table`: attitude trajectories by attitude accuracies."""

from pathlib import Path

import numpy as np

from jaxbundle.choices import AttitudeError
from jaxbundle.cli.pushbroom.shared import surface_of, write_rows
from jaxbundle.commands.scanner_tables import check_draws
from jaxbundle.errors import InputError
from jaxbundle.io.scanner.flight import read_flight
from jaxbundle.pushbroom.study import AccuracyTable, accuracy_table


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
            f"--levels {levels!r}: expected positive numbers, such as 0.01,0.1"
        ) from None
    flight_file = read_flight(path)
    surface = surface_of(flight_file.earth, height, None)
    return accuracy_table(
        flight_file.flight, surface, np.radians(sigmas), kind, draws or 1000, seed
    )


def write_table(table: AccuracyTable, csv: Path | None, json: str) -> None:
    """As CSV or JSON, one row per trajectory and accuracy; or as a printed table."""
    if csv is None and not json:
        print(table)
    else:
        write_rows(table.table(), csv, json, table.figures)
