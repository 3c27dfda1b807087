"""Tables as Parquet files, by pyarrow."""

import importlib
import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxbundle.io.text.csv_tables import write_bytes


def is_parquet(path: Path) -> bool:
    """Whether this is the name of a Parquet file."""
    return path.suffix.lower() == ".parquet"


def need_pyarrow() -> None:
    """**Raises:** `ImportError`, with what to install."""
    try:
        importlib.import_module("pyarrow.parquet")
    except ImportError as error:
        raise ImportError(
            "Parquet files need pyarrow: pip install 'jaxbundle[parquet]'; a .csv needs nothing"
        ) from error


def write_parquet(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write columns of numbers and words; NaN and None become null."""
    need_pyarrow()
    arrow, parquet = map(importlib.import_module, ("pyarrow", "pyarrow.parquet"))
    as_words = lambda values: [x if x is None else str(x) for x in values]
    arrays = {
        name: arrow.array(
            as_words(values) if values.dtype.kind in "OU" else values, from_pandas=True
        )
        for name, values in columns.items()
    }
    buffer = io.BytesIO()
    parquet.write_table(arrow.table(arrays), buffer)
    write_bytes(path, buffer.getvalue())
