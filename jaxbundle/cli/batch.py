"""`jaxbundle batch`: many cameras, many networks."""

import os
import re
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import jaxbundle
from jaxbundle.choices import BOARDS, DICTIONARIES
from jaxbundle.cli.app import Html, Quiet, app, choice, model_choice
from jaxbundle.cli.certificate_options import Accept
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.system.interrupts import advise

if TYPE_CHECKING:
    from jaxbundle.network.columns import Columns

# Statuses of networks whose lines have an `error`.
STATUSES_WITH_REASON = ("bad input", "not solved", "failed")


@app.command(example="cameras.npz PROJECT.toml --json-lines results.jsonl")
def batch(  # noqa: PLR0913 - the options of the command
    inputs: Annotated[
        list[str],
        typer.Argument(help=".npz of many cameras; projects; with --board folders of photographs"),
    ],
    json_lines: Annotated[
        str, typer.Option(help="file of results, one per line; resumed if it exists")
    ],
    model: Annotated[str, model_choice("camera model of the .npz files")] = "opencv",
    free: Annotated[str, typer.Option(help="parameters to estimate: fx,fy,…")] = "",
    board: Annotated[
        str, typer.Option(help="of photographs, COLUMNSxROWS as of calibrate; a folder a camera")
    ] = "",
    square: Annotated[
        str,
        typer.Option(
            metavar="S or S,S",
            help="side of a square, distance of circles; "
            "two of a stretched print: of columns, of rows",
        ),
    ] = "",
    kind: Annotated[str, choice(BOARDS)] = "chessboard",
    marker: Annotated[float | None, typer.Option(help="side of a marker or tag")] = None,
    dictionary: Annotated[str, choice(DICTIONARIES, "of markers or tags")] = "DICT_4X4_50",
    first_marker: Annotated[
        int, typer.Option(min=0, help="number of the first marker or tag of the board")
    ] = 0,
    rig: Annotated[
        bool,
        typer.Option("--rig", help="folders of rigs: in each a folder of photographs a camera"),
    ] = False,
    pixel_size: Annotated[float | None, typer.Option(help="mm, for models in mm")] = None,
    set: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=VALUE",
            help="of projects as of adjust; of cameras and rigs sigma_image, rig.KEY, "
            "rolling_shutter.KEY, such as rolling_shutter.line_time=2e-5; repeatable",
        ),
    ] = None,
    part: Annotated[
        str, typer.Option(help="I/N: the I-th of N parts of the inputs; each has its own file")
    ] = "",
    max_iterations: Annotated[int, typer.Option(min=1)] = 100,
    snooping: Annotated[str, choice(("pope", "none"), "removal of gross errors")] = "none",
    significance: Annotated[float, typer.Option(help="level of the test")] = 0.001,
    correlated: Annotated[
        bool,
        typer.Option("--correlated", help="look for errors that image points share; σ under them"),
    ] = False,
    portion: Annotated[int, typer.Option(min=1, help="cameras computed between writes")] = 256,
    brief: Annotated[bool, typer.Option("--brief", help="omit poses and covariances")] = False,
    retry: Annotated[
        bool,
        typer.Option(
            "--retry", help="recompute inputs without a result, or without unsearched photographs"
        ),
    ] = False,
    renew: Annotated[
        bool, typer.Option("--renew", help="recompute results of other settings or data")
    ] = False,
    table: Annotated[
        Path | None,
        typer.Option(help="one row per input: CSV, or Parquet if the name ends with .parquet"),
    ] = None,
    summary: Annotated[
        Path | None,
        typer.Option(help="JSON: distributions, outlying cameras, correlations"),
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option(help="CSV of id and quantities to correlate with: serial number, date"),
    ] = None,
    html: Html = "",
    accept: Accept = None,
    force: Annotated[
        bool,
        typer.Option(
            "--force", help="let --html and --summary replace files that are not HTML or JSON"
        ),
    ] = False,
    join: Annotated[
        tuple[str, int, int] | None,
        typer.Option(
            metavar="HOST:PORT NUMBER INDEX",
            help="join NUMBER processes at the address of the first; each computes a part",
        ),
    ] = None,
    cluster: Annotated[
        bool, typer.Option("--cluster", help="join the processes started by srun (SLURM)")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Calibrate many cameras and adjust many networks; an interrupted run resumes.

    With --board, a folder without a network holds the photographs of one camera; corners are kept
    next to the file of results.

    Inputs with a line in the file are not computed again. Lines of other settings or data are
    refused, or recomputed with --renew. Status 0 means that every input has a line and at least one
    of them a result, 3 that none has. Only one run at a time may write the file.
    """
    from jaxbundle.batches.page import compose_batch
    from jaxbundle.batches.photographs import is_photograph_folder
    from jaxbundle.batches.population import read_against
    from jaxbundle.batches.processes import add_parts, run_joined
    from jaxbundle.batches.run_on_files import run_batch
    from jaxbundle.batches.stacks import is_camera_stack
    from jaxbundle.cli.acceptance import accept_result, check_accept, end_unmet
    from jaxbundle.cli.batch_outputs import addition_of, check_outputs, write_outputs
    from jaxbundle.cli.board_options import board_given
    from jaxbundle.cli.outputs import check_page, trace_files
    from jaxbundle.cli.processes import join_for_one_task
    from jaxbundle.cli.progress import counting
    from jaxbundle.commands.batch_run import BatchRun
    from jaxbundle.io.text.csv_tables import write_text
    from jaxbundle.network.columns import count

    if not board and (square or marker is not None):
        raise InputError("--board is missing: COLUMNSxROWS, inner corners of a chessboard, as 9x6")
    board_of_photographs = (
        board_given(board, square, kind, None, marker, dictionary, first_marker) if board else None
    )
    check_accept(accept, "batch")
    check_page(html, None, [*inputs, json_lines], force)
    files = [*inputs, json_lines, *filter(None, (html, against and str(against)))]
    check_outputs(table, summary, files, force)
    summary_options = _made_of_lines(
        {"--html": html, "--table": table, "--summary": summary, "--accept": accept}, json_lines
    )
    columns = None if against is None else _read_against(against, bool(summary_options))
    if not all(
        is_camera_stack(input_path) or board_of_photographs and is_photograph_folder(input_path)
        for input_path in inputs
    ):
        # Cameras already use the cores by threads; devices gain nothing.
        jaxbundle.use_cores()
    compute, is_first_process = partial(run_batch, part=_part(part)), True
    if join or cluster:
        if part:
            raise InputError("--part with --join or --cluster: each process computes its part")
        compute = run_joined
        is_first_process = join_for_one_task(
            join,
            cluster,
            quiet,
            inputs,
            json_lines,
            model,
            free,
            max_iterations,
            snooping,
            significance,
            correlated,
            board,
            square,
            kind,
            marker,
            dictionary,
            first_marker,
            rig,
            pixel_size,
            set,
        )
        if not is_first_process:
            # Only the first process writes, though all compute.
            html, table, summary, accept, summary_options, quiet = "", None, None, None, [], True
    elif not part:
        add_parts(json_lines)  # left by joined processes that were ended
    advise("run the same command again to resume")
    with counting(quiet) as bar:
        task = bar.add_task("batch", total=None)
        counts = compute(
            inputs,
            json_lines,
            model=model,
            free=[name.strip() for name in free.split(",")] if free else None,
            max_iterations=max_iterations,
            snooping=None if snooping == "none" else snooping,
            significance=significance,
            correlated=correlated,
            board=board_of_photographs,
            rig=rig,
            pixel_size=pixel_size,
            settings=set or (),
            portion=portion,
            brief=brief,
            retry=retry,
            renew=renew,
            progress=lambda _, done, total: bar.update(task, completed=done, total=total),
        )
    done = BatchRun(tuple(inputs), json_lines, counts)
    acceptance = None
    if summary_options:
        population = done.population
        # Read again, for the keys that now have results.
        beside = {} if columns is None else read_against(columns, population.keys, str(against))
        acceptance = accept_result(population, accept)
        write_outputs(population, beside, table, summary, acceptance)
    if html:
        origin = trace_files(
            inputs,
            {
                "--model": model,
                "--free": free,
                "--max-iterations": max_iterations,
                "--snooping": snooping,
                "--significance": significance,
                "--correlated": correlated or None,
                "--board": board,
                "--square": square,
                "--kind": kind if board else "",
                "--rig": rig,
                "--pixel-size": pixel_size,
                "--set": ", ".join(set or ()),
                "--part": part,
                "--against": "" if against is None else str(against),
                "--accept": "; ".join(accept or ()),
            },
        )
        write_text(Path(html), compose_batch(population, origin, beside, addition_of(acceptance)))
    total, solved = done.statuses.total(), done.solved
    counts_in_words = ", ".join(f"{n} {status}" for status, n in done.statuses.most_common() if n)
    if not quiet:
        print(done.report())
        if acceptance is not None:
            print(f"\n{acceptance}")
        if any(counts[status] for status in STATUSES_WITH_REASON):
            _print_reasons(inputs, json_lines)
    if is_first_process and board_of_photographs:
        _name_unsearched(inputs, json_lines)
    if is_first_process and total and not solved:
        raise NotSolvedError(
            f"{json_lines}: none of {count(total, 'input')} has a result: {counts_in_words}"
        )
    if is_first_process and quiet and solved < total:
        print(
            f"jaxbundle: {json_lines}: {total - solved} of {count(total, 'input')} without a "
            f"result: {counts_in_words}",
            file=sys.stderr,
        )
    end_unmet(acceptance)


def _made_of_lines(outputs: Mapping[str, object], json_lines: str) -> list[str]:
    """The options asked for whose files are made from the lines of results.

    **Raises:** `InputError` if these go to a pipe or a device, which cannot be read again."""
    wanted_options = [name for name, value in outputs.items() if value]
    if wanted_options and os.path.exists(json_lines) and not os.path.isfile(json_lines):
        raise InputError(
            f"{wanted_options[0]}: is made from the lines of --json-lines, but {json_lines} is no "
            "file"
        )
    return wanted_options


def _print_reasons(inputs: Sequence[str], json_lines: str, max_reasons: int = 5) -> None:
    """The first errors of a file of results, if it is one that can be read again."""
    from jaxbundle.batches.run_on_files import result_rows

    if not os.path.isfile(json_lines):
        return
    reasons = [_reason(row) for row in result_rows(inputs, json_lines) if row.get("error")]
    print(*reasons[:max_reasons], sep="\n")
    if len(reasons) > max_reasons:
        print(f'and {len(reasons) - max_reasons} more: see "error" in {json_lines}')


def _name_unsearched(inputs: Sequence[str], json_lines: str, limit: int = 5) -> None:
    """Warn of photographs that results lack by a fault of the machine, with the reason."""
    from jaxbundle.batches.photographs import NOT_SEARCHED
    from jaxbundle.batches.run_on_files import result_rows

    rows = result_rows(inputs, json_lines) if os.path.isfile(json_lines) else ()
    unsearched = [
        f"{row['key']}/{name}: {row['photographs_not_used'][name]}"
        for row in rows
        for name in row.get(NOT_SEARCHED, ())
    ]
    if unsearched:
        were = "photograph was" if len(unsearched) == 1 else "photographs were"
        rest_of_list = [f"and {len(unsearched) - limit} more: see {NOT_SEARCHED!r} in {json_lines}"]
        print(
            f"warning: {len(unsearched)} {were} not searched and missing from the results; run the "
            "command again with --retry to search again",
            *unsearched[:limit],
            *(rest_of_list if len(unsearched) > limit else []),
            sep="\n",
            file=sys.stderr,
        )


def _reason(row: dict) -> str:
    """The error of a line, with its key unless it begins with the file."""
    key, error = row["key"], row["error"]
    names_key = key.rpartition("/")[2] in error.partition(":")[0]
    return error if names_key else f"{key}: {error}"


def _read_against(path: Path, has_use: bool) -> "Columns":
    """The table of `--against`, read whole before the run, for its errors."""
    from jaxbundle.batches.population import read_against
    from jaxbundle.io.text.csv_tables import read_csv

    table = read_csv(path)
    if not has_use:
        raise InputError("--against: give --html, --table or --summary as well")
    read_against(table, table.ids("id") if "id" in table.values else (), str(path))
    return table


def _part(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"\s*(\d{1,9})\s*/\s*(\d{1,9})\s*", text or "1/1")
    if not match or not 1 <= int(match[1]) <= int(match[2]):
        raise InputError(f"--part {text}: expected I/N, the I-th of N parts, such as 1/4")
    return int(match[1]), int(match[2])
