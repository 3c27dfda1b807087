"""Further output of `jaxbundle batch`: a table and a summary of the population."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxbundle.batches.population import Population
from jaxbundle.cli.outputs import FORCE_ADVICE, check_file, check_json
from jaxbundle.errors import InputError
from jaxbundle.io.results.parquet import is_parquet, need_pyarrow, write_parquet
from jaxbundle.io.results.result_json import without_nan
from jaxbundle.io.text.csv_tables import table_rows, write_csv, write_text
from jaxbundle.report.page import Addition, Finding
from jaxbundle.report.page.adjustment import NO_ADDITION
from jaxbundle.report.verdict import BAD, GOOD

if TYPE_CHECKING:
    from jaxbundle.certificates.acceptance import Acceptance


def check_outputs(
    table: Path | None, summary: Path | None, inputs: Iterable[str], force: bool
) -> None:
    """Refuse a table or a summary that cannot be written or would replace an input."""
    inputs = tuple(inputs)
    for option, path in (("--table", table), ("--summary", summary)):
        if path is not None:
            check_file(option, str(path), None, inputs)
    if table is not None:
        if table.suffix.lower() not in (".csv", ".parquet"):
            raise InputError(f"--table {table}: expected a name that ends with .csv or .parquet")
        if summary is not None and table.resolve() == summary.resolve():
            raise InputError(f"--summary {summary}: is also the file of --table")
        if is_parquet(table):
            try:
                need_pyarrow()
            except ImportError as error:
                raise InputError(f"--table {table}: {error}") from None
    if summary is not None and not force:
        # A table is a .csv or .parquet by its name; a summary may have any.
        check_json(str(summary), FORCE_ADVICE, "--summary")


def write_outputs(
    population: Population,
    against: Mapping[str, np.ndarray],
    table: Path | None,
    summary: Path | None,
    acceptance: "Acceptance | None" = None,
) -> None:
    """Write the requested files; with criteria, whether each input meets them."""
    if table is not None:
        columns = population.table(against)
        if acceptance is not None:
            columns["accepted"] = acceptance.meets_all(population.keys.tolist())
        if is_parquet(table):
            write_parquet(table, columns)
        else:
            empty = lambda x: "" if isinstance(x, float) and np.isnan(x) else x
            write_csv(table, list(columns), (tuple(map(empty, row)) for row in table_rows(columns)))
    if summary is not None:
        document = population.summary(against)
        if acceptance is not None:
            good = acceptance.meets_all(population.keys.tolist())
            document["acceptance"] = acceptance.to_dict()
            document["not_accepted"] = population.keys[~good].tolist()
        text = json.dumps(without_nan(document), ensure_ascii=False, indent=1)
        write_text(summary, text + "\n")


def addition_of(acceptance: "Acceptance | None") -> Addition:
    """What criteria add to the page."""
    if acceptance is None:
        return NO_ADDITION
    from jaxbundle.certificates.page import acceptance_section

    finding = Finding("Acceptance", GOOD if acceptance.met else BAD, acceptance.sentence)
    return NO_ADDITION._replace(findings=(finding,), sections=(acceptance_section(acceptance),))
