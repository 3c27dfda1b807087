"""The command line: `jaxbundle adjust`, `jaxbundle batch`, `jaxbundle convert`.

Exit status: 0 solved; 2 bad input (one line, nothing written); 3 not solved (says why).
"""

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import (
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)

import jaxbundle
from jaxbundle import report
from jaxbundle.batches import run_batch
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.io import read_network, write_project
from jaxbundle.network.columns import some
from jaxbundle.network.reduction import REDUCTIONS
from jaxbundle.result import Adjustment
from jaxbundle.targets import check_targets, write_targets

BAD_INPUT, NOT_SOLVED = 2, 3

app = typer.Typer(
    name="jaxbundle",
    help="Least squares for photogrammetry: self-calibrating bundle adjustment.",
    invoke_without_command=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

Input = Annotated[Path, typer.Argument(help="project .toml, text list of photographs, …")]


def _version(asked: bool) -> None:
    if asked:
        print(f"jaxbundle {jaxbundle.__version__}")
        raise typer.Exit


@app.callback()
def _main(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="print the version")
    ] = False,
) -> None:
    """Every command has its own help: jaxbundle adjust --help."""
    if context.invoked_subcommand is None:
        print(context.get_help())
        raise typer.Exit(BAD_INPUT)


@app.command()
def adjust(
    input: Input,
    json: Annotated[str, typer.Option(help="write the result as JSON; - for stdout alone")] = "",
    out: Annotated[Path | None, typer.Option(help="folder for report, JSON, tables, plots")] = None,
    set: Annotated[list[str] | None, typer.Option(help="KEY=VALUE replaces a setting")] = None,
    format: Annotated[str | None, typer.Option(help="kind of input, if not recognised")] = None,
    max_iterations: Annotated[int, typer.Option(min=1)] = 100,
    method: Annotated[
        str, typer.Option(help="levenberg-marquardt or gauss-newton")
    ] = "levenberg-marquardt",
    reduction: Annotated[
        str | None,
        typer.Option(help="of the reduced system: dense, banded or iterative; chosen if not given"),
    ] = None,
    snooping: Annotated[
        str | None, typer.Option(help="remove blunders one at a time: pope or baarda")
    ] = None,
    significance: Annotated[
        float, typer.Option(help="level of one test of data snooping, two-sided")
    ] = 0.001,
    eliminate: Annotated[
        bool, typer.Option("--eliminate", help="fix insignificant additional parameters (t < 2)")
    ] = False,
    components: Annotated[
        bool, typer.Option("--components", help="estimate variance components of the groups")
    ] = False,
    brief: Annotated[bool, typer.Option("--brief", help="no points and residuals in JSON")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="print nothing but errors")] = False,
    plots: Annotated[bool, typer.Option(help="plots in the folder of --out")] = True,
) -> None:
    """Adjust a network and report it."""
    jaxbundle.enable_x64()
    jaxbundle.use_cores()
    network = read_network(input, format, tuple(set or ()))
    if method not in ("levenberg-marquardt", "gauss-newton"):
        raise InputError(f"--method {method!r}: levenberg-marquardt or gauss-newton")
    if reduction not in (None, *REDUCTIONS):
        raise InputError(f"--reduction {reduction!r}: {', '.join(REDUCTIONS)}")
    if snooping not in (None, "pope", "baarda"):
        raise InputError(f"--snooping {snooping!r}: pope or baarda")
    if not 0 < significance < 1:
        raise InputError(f"--significance {significance:g}: a number between 0 and 1")
    check_targets(input, network, json, out)
    try:
        with _progress(quiet or json == "-") as tell:
            result = jaxbundle.adjust(
                network,
                method=method,
                reduction=reduction,
                max_iterations=max_iterations,
                snooping=snooping,
                significance=significance,
                eliminate=eliminate,
                estimate_components=components,
                progress=tell,
            )
    except NotSolvedError as error:
        write_targets(error, json, out, brief, plots)
        raise
    write_targets(result, json, out, brief, plots)
    if json != "-" and not quiet and result.converged:
        print(report.text(result))
    if not result.converged:
        raise NotSolvedError(_why_not(result))


@app.command()
def batch(
    inputs: Annotated[list[str], typer.Argument(help=".npz of many cameras; projects")],
    json_lines: Annotated[str, typer.Option(help="file of results, one a line; is continued")],
    model: Annotated[str, typer.Option(help="camera model of the .npz files")] = "opencv",
    free: Annotated[str, typer.Option(help="parameters to estimate: fx,fy,…")] = "",
    max_iterations: Annotated[int, typer.Option(min=1)] = 100,
    portion: Annotated[int, typer.Option(min=1, help="cameras between two writes")] = 256,
    brief: Annotated[bool, typer.Option("--brief", help="no poses, no covariances")] = False,
    retry: Annotated[bool, typer.Option("--retry", help="again what did not converge")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="print nothing but errors")] = False,
) -> None:
    """Calibrate many cameras and adjust many networks; interrupted, it takes up where it was."""
    jaxbundle.enable_x64()
    console = Console(stderr=True)
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    with Progress(
        *columns, console=console, transient=True, disable=quiet or not console.is_terminal
    ) as bar:
        task = bar.add_task("batch", total=None)
        counts = run_batch(
            inputs, json_lines, model=model, free=free.split(",") if free else None,
            max_iterations=max_iterations, portion=portion, brief=brief, retry=retry,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )  # fmt: skip
    if not quiet:
        said = ", ".join(f"{number} {status}" for status, number in counts.items() if number)
        print(f"{json_lines}: {said or 'nothing to do'}")


@app.command()
def convert(
    input: Input,
    output: Annotated[Path, typer.Argument(help="folder of the project to write")],
    set: Annotated[list[str] | None, typer.Option(help="KEY=VALUE replaces a setting")] = None,
    format: Annotated[str | None, typer.Option(help="kind of input, if not recognised")] = None,
) -> None:
    """Write any input as a project: project.toml and CSV tables."""
    path = write_project(read_network(input, format, tuple(set or ())), output)
    print(path)


def _why_not(result: Adjustment) -> str:
    parts = [f"not solved: {result.termination}"]
    if result.undetermined:
        parts.append(f"not determined: {some(result.undetermined, 12, str)}")
        parts.append("fix them, give them a prior σ, or measure what determines them")
    elif "limit" in result.termination:
        parts.append("raise --max-iterations or give better start values")
    else:
        parts.append("give better start values and look for gross errors")
    return "; ".join(parts)


class _progress:
    """A line with the iteration and vᵀPv on a terminal; nothing in a pipe."""

    def __init__(self, silent: bool):
        self.console = Console(stderr=True)
        self.silent = silent or not self.console.is_terminal

    def __enter__(self):
        if self.silent:
            return None
        self.bar = Progress(
            SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn(),
            console=self.console, transient=True,
        )  # fmt: skip
        self.bar.start()
        task = self.bar.add_task("compiling")
        return lambda step, cost, damping: self.bar.update(
            task, description=f"iteration {int(step)}: vᵀPv {2 * float(cost):.6g}"
        )

    def __exit__(self, *_):
        if not self.silent:
            self.bar.stop()


def main() -> None:
    """Run the command line; errors of the input, the solution, the machine end in one line."""
    try:
        sys.exit(app(standalone_mode=False))
    except (InputError, NotSolvedError) as error:
        print(f"jaxbundle: {error}", file=sys.stderr)
        sys.exit(BAD_INPUT if isinstance(error, InputError) else NOT_SOLVED)
    except MemoryError:
        print("jaxbundle: not enough memory for this network", file=sys.stderr)
        sys.exit(NOT_SOLVED)
    except (OSError, OverflowError, RecursionError) as error:
        print(f"jaxbundle: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(BAD_INPUT)
    except typer.Abort:
        sys.exit(130)
    except Exception as error:
        # Usage errors of the command line itself (unknown option, missing argument).
        if hasattr(error, "format_message"):
            print(f"jaxbundle: {error.format_message()}", file=sys.stderr)
            sys.exit(BAD_INPUT)
        raise
