"""`jaxbundle adjust`: adjust a network and report it."""

from pathlib import Path
from typing import Annotated

import typer

import jaxbundle
from jaxbundle import report
from jaxbundle.adjustment.problem import REDUCTIONS
from jaxbundle.bundle.result import Adjustment
from jaxbundle.cli.app import Control, Force, Format, Input, Quiet, Settings, app
from jaxbundle.cli.outputs import check_targets, write_targets
from jaxbundle.cli.processes import check_sameness, join_processes
from jaxbundle.cli.progress import iterating
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.io import read_network
from jaxbundle.io.writing.fingerprints import of_input
from jaxbundle.leastsquares.snooping import check_test
from jaxbundle.network.columns import some


@app.command()
def adjust(
    input: Input,
    json: Annotated[str, typer.Option(help="write the result as JSON; - for stdout alone")] = "",
    out: Annotated[Path | None, typer.Option(help="folder for report, JSON, tables, plots")] = None,
    force: Force = False,
    set: Settings = None,
    format: Format = None,
    control: Control = None,
    max_iterations: Annotated[int, typer.Option(min=1)] = 100,
    method: Annotated[
        str, typer.Option(help="levenberg-marquardt or gauss-newton")
    ] = "levenberg-marquardt",
    reduction: Annotated[
        str | None,
        typer.Option(help="of the reduced system: dense, banded or iterative; chosen if not given"),
    ] = None,
    robust: Annotated[
        str | None, typer.Option(help="robust estimation: huber, cauchy or tukey")
    ] = None,
    snooping: Annotated[
        str | None, typer.Option(help="remove blunders by the test of pope or baarda")
    ] = None,
    significance: Annotated[
        float, typer.Option(
            help="level of data snooping: of the largest (pope), of one (baarda); and of the "
            "suspects of --robust (the largest)"
        ),
    ] = 0.001,
    eliminate: Annotated[
        bool, typer.Option("--eliminate", help="fix insignificant additional parameters (t < 2)")
    ] = False,
    components: Annotated[
        bool, typer.Option("--components", help="estimate variance components of the groups")
    ] = False,
    brief: Annotated[bool, typer.Option("--brief", help="no points and residuals in JSON")] = False,
    quiet: Quiet = False,
    plots: Annotated[bool, typer.Option(help="plots in the folder of --out")] = True,
    cores: Annotated[
        int | None, typer.Option(min=1, help="cores that share the work; all if not given")
    ] = None,
    join: Annotated[
        tuple[str, int, int] | None,
        typer.Option(
            metavar="HOST:PORT NUMBER INDEX",
            help="one of NUMBER processes, which find each other at the address of the first",
        ),
    ] = None,
    cluster: Annotated[
        bool, typer.Option("--cluster", help="one of the processes started by srun (SLURM)")
    ] = False,
) -> None:
    """Adjust a network and report it."""
    jaxbundle.use_cores(cores)
    if join or cluster:
        if join and cluster:
            raise InputError("--join with --cluster: give one of them")
        if json in ("-", "/dev/stdout", "/dev/fd/1"):
            raise InputError(f"--json {json} with --join or --cluster: give a file; the connection "
                             "of the processes is reported on standard output")  # fmt: skip
        first = join_processes(join, quiet)
        check_sameness(
            of_input(input), control and of_input(control), set, format, max_iterations, method,
            reduction, robust, snooping, significance, eliminate, components,
        )  # fmt: skip
        if not first:
            json, out, quiet = "", None, True
    network = read_network(input, format, tuple(set or ()), control)
    if method not in ("levenberg-marquardt", "gauss-newton"):
        raise InputError(f"--method {method!r}: levenberg-marquardt or gauss-newton")
    if reduction not in (None, *REDUCTIONS):
        raise InputError(f"--reduction {reduction!r}: {', '.join(REDUCTIONS)}")
    check_test(snooping, significance, "--")
    check_targets(input, network, json, out, control, force)
    try:
        with iterating(quiet or json == "-") as tell:
            result = jaxbundle.adjust(
                network,
                method=method,
                reduction=reduction,
                max_iterations=max_iterations,
                robust=robust,
                snooping=snooping,
                significance=significance,
                eliminate=eliminate,
                estimate_components=components,
                progress=tell,
            )
    except NotSolvedError as error:
        write_targets(error, json, out, brief, plots, force)
        raise
    write_targets(result, json, out, brief, plots, force)
    if json != "-" and not quiet and result.converged:
        print(report.text(result))
        for doubt in result.doubts:
            print(f"warning: {doubt}")
    if not result.converged:
        raise NotSolvedError(_why_not(result))


def _why_not(result: Adjustment) -> str:
    parts = [f"not solved: {result.termination}"]
    if result.undetermined:
        parts.append(f"not determined: {some(result.undetermined, 12, str)}")
        parts.append("fix them, give them a prior σ, or measure what determines them")
        parts += result.findings
    elif result.findings or result.weakness.lines:
        parts += [*result.findings, *result.weakness.lines]
    elif "limit" in result.termination:
        parts.append("raise --max-iterations or give better start values")
    else:
        parts.append("give better start values and look for gross errors")
    return "; ".join(parts)
