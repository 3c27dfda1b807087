"""`jaxbundle adjust`: adjust a network and report it."""

from pathlib import Path
from typing import Annotated

import typer

import jaxbundle
from jaxbundle.choices import ESTIMATED, ESTIMATORS, METHODS, REDUCTIONS, TESTS
from jaxbundle.cli.app import (
    Check,
    Control,
    Force,
    Format,
    Html,
    Input,
    Json,
    Quiet,
    Settings,
    app,
    choice,
)
from jaxbundle.cli.certificate_options import (
    Accept,
    CertificateFile,
    CertificateOptions,
    Details,
    Lengths,
)
from jaxbundle.cli.common_options import is_in_file
from jaxbundle.cli.gis_output import Crs, Gis, check_gis, write_gis
from jaxbundle.cli.judging import judge_of
from jaxbundle.errors import InputError, NotSolvedError


@app.command(example="examples/convergent4/project.toml --out out/convergent4", once=True)
def adjust(  # noqa: PLR0913 - the options of the command
    input: Input,
    json: Json = "",
    out: Annotated[
        Path | None, typer.Option(help="folder for report, page, JSON, tables, plots")
    ] = None,
    html: Html = "",
    save: Annotated[
        str, typer.Option(help="save the whole result, for load_adjustment and compare")
    ] = "",
    force: Force = False,
    set: Settings = None,
    format: Format = None,
    control: Control = None,
    check: Check = None,
    max_iterations: Annotated[int, typer.Option(min=1)] = 100,
    method: Annotated[str, choice(METHODS)] = "levenberg-marquardt",
    reduction: Annotated[
        str | None, choice(REDUCTIONS, "solver of the reduced system; default: automatic")
    ] = None,
    robust: Annotated[str | None, choice(ESTIMATORS, "robust estimation")] = None,
    snooping: Annotated[str | None, choice(TESTS, "remove blunders by data snooping")] = None,
    significance: Annotated[
        float,
        typer.Option(
            help="level of data snooping, for the largest (pope) or each test (baarda); and of the "
            "suspects of --robust (for the largest)"
        ),
    ] = 0.001,
    eliminate: Annotated[
        bool, typer.Option("--eliminate", help="fix insignificant additional parameters (t < 2)")
    ] = False,
    components: Annotated[
        bool, typer.Option("--components", help="estimate variance components")
    ] = False,
    correlated: Annotated[
        bool | None,
        typer.Option(
            help="look for errors that image points share, and σ under them; by itself where the σ "
            "of image points were estimated, as in networks of reconstruct"
        ),
    ] = None,
    second_minimum: Annotated[
        bool,
        typer.Option(help="look for second minima: plane objects turned over, depth reversed"),
    ] = True,
    budget: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=SIGMA",
            help="effect on the results of this σ in a held quantity, such as camera:cam:K3 or "
            "point:*:Z; repeatable",
        ),
    ] = None,
    accept: Accept = None,
    certificate: CertificateFile = "",
    details: Details = None,
    lengths: Lengths = None,
    gis: Gis = "",
    crs: Crs = "",
    brief: Annotated[
        bool, typer.Option("--brief", help="omit points and residuals from the JSON")
    ] = False,
    quiet: Quiet = False,
    plots: Annotated[bool, typer.Option(help="write plots to --out")] = True,
    cores: Annotated[int | None, typer.Option(min=1, help="number of cores; default: all")] = None,
    join: Annotated[
        tuple[str, int, int] | None,
        typer.Option(
            metavar="HOST:PORT NUMBER INDEX",
            help="join NUMBER processes at the address of the first",
        ),
    ] = None,
    cluster: Annotated[
        bool, typer.Option("--cluster", help="join the processes started by srun (SLURM)")
    ] = False,
) -> None:
    """Adjust a network and report it."""
    from jaxbundle.adjustment.error_budget import sensitivity
    from jaxbundle.cli.budget_option import held_of
    from jaxbundle.cli.outputs import (
        BudgetSupplement,
        check_targets,
        network_files,
        report_with,
        trace_origin,
        why_not,
        write_targets,
    )
    from jaxbundle.cli.processes import join_for_one_task
    from jaxbundle.cli.progress import iterating, staging
    from jaxbundle.io import read_network
    from jaxbundle.io.networks.control import select_checks
    from jaxbundle.io.writing.fingerprints import of_input
    from jaxbundle.leastsquares.quality.snooping import check_test
    from jaxbundle.report.page import Origin
    from jaxbundle.system.clock import in_words, now

    jaxbundle.use_cores(cores)
    judged = CertificateOptions(accept, certificate, details, lengths)
    has_file = is_in_file(json, out, html, save, certificate, gis)
    print_report = json != "-" and not (quiet and has_file)
    if join or cluster:
        if json in ("-", "/dev/stdout", "/dev/fd/1"):
            raise InputError(
                f"--json {json} with --join or --cluster: give a file; the connection "
                "of the processes is reported on standard output"
            )
        is_first_process = join_for_one_task(
            join,
            cluster,
            quiet,
            of_input(input),
            control and of_input(control),
            set,
            format,
            max_iterations,
            method,
            reduction,
            robust,
            snooping,
            significance,
            eliminate,
            components,
            correlated,
            second_minimum,
            budget,
            check,
        )
        if not is_first_process:
            # Only the first process writes, though all compute.
            json, out, html, save, quiet, print_report = "", None, "", "", True, False
            judged, gis, crs = CertificateOptions(), "", ""
    network = read_network(input, format=format, overrides=tuple(set or ()), control=control)
    if check:
        network = network.replace(points=select_checks(network.points, check))
    check_test(snooping, significance, "--")
    if correlated is None:
        correlated = network.observations.sigma_origin == ESTIMATED
    held_sigma = held_of(budget, network)
    # Before an adjustment that may take hours.
    check_targets(input, network, json, out, control, force, html, save)
    files = network_files(input, network, control)
    check_gis(gis, crs, files, force)
    judge = judge_of(
        "adjust",
        judged,
        {"--json": json, "--html": html, "--save": save},
        out,
        files,
        network=network,
        force=force,
    )
    origin = Origin(computed=in_words(now()))
    # Fingerprints read all files once more: only for outputs that state them.
    if html or certificate or out is not None:
        origin = trace_origin(
            input,
            network,
            control,
            {
                "--set": ", ".join(set or ()),
                "--format": format,
                "--check": ", ".join(check or ()),
                "--method": method,
                "--reduction": reduction,
                "--max-iterations": max_iterations,
                "--robust": robust,
                "--snooping": snooping,
                "--significance": significance,
                "--eliminate": eliminate,
                "--components": components,
                "--correlated": correlated,
                "--no-second-minimum": not second_minimum,
                "--budget": ", ".join(budget or ()),
                **judged.settings,
            },
        )
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
                correlated=correlated,
                second_minimum=second_minimum,
                progress=tell,
            )
    except NotSolvedError as error:
        write_targets(error, json, out, brief, plots, force, html, origin)
        raise
    effects = sensitivity(result, held_sigma) if held_sigma and result.converged else None
    judgement = judge.judge(result, origin)
    supplement = BudgetSupplement(effects, judgement)
    with staging(quiet or json == "-") as show:
        write_targets(result, json, out, brief, plots, force, html, origin, supplement, show)
        judge.write(judgement)
        write_gis(result, gis, crs)
    if save and result.converged:
        result.save(save)
    if print_report and result.converged:
        print(report_with(result, supplement, origin.computed))
        for doubt in result.doubts:
            print(f"warning: {doubt}")
    if not result.converged:
        raise NotSolvedError(why_not(result))
    judge.end(judgement)
