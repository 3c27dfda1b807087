"""Tables of `jaxbundle pushbroom rpc`: input points, figures and residuals."""

from pathlib import Path

import numpy as np

from jaxbundle.cli.pushbroom.shared import geographic, write_rows
from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import read_csv
from jaxbundle.network.columns import Columns
from jaxbundle.pushbroom.rpc_fit import RpcCheck, RpcTable

COLUMNS = ("longitude", "latitude", "height", "line", "sample")


def table_of(path: Path, optional: tuple[str, ...] = ()) -> tuple[RpcTable, Columns]:
    columns = read_csv(path)
    columns.check_names(COLUMNS, ("id", *optional))
    measured = (columns.numbers(name, required=True) for name in COLUMNS[3:])
    return RpcTable(*geographic(columns), *measured), columns


def heights_of(text: str) -> tuple[float, float]:
    try:
        low, high = (float(part) for part in text.split(":"))
        if not low < high or not np.isfinite([low, high]).all():
            raise ValueError
    except ValueError:
        raise InputError(
            f"--heights {text!r}: two numbers, the lower first, are expected, such as 0:3000"
        ) from None
    return low, high


def figures_of(name: str, check: RpcCheck) -> dict[str, float]:
    axes = ("line", "sample")
    told = {f"{name}_rms_{axis}": float(v) for axis, v in zip(axes, check.rms)}
    return told | {f"{name}_largest_{axis}": float(v) for axis, v in zip(axes, check.largest)}


def tell(head: dict, json: str, check: RpcCheck) -> None:
    """Figures as a table of name and value; as JSON with a row for every point fitted."""
    head = {name: float(v) if isinstance(v, np.floating) else v for name, v in head.items()}
    if json:
        east, north, *rest = check.table
        values = np.degrees(east), np.degrees(north), *rest, *check.residuals.T
        write_rows(dict(zip((*COLUMNS, "v_line", "v_sample"), values)), None, json, head)
    else:
        for name, value in head.items():
            print(f"{name:22} {value:.6g}")
