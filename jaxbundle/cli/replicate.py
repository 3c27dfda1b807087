"""`jaxbundle replicate`: a network in two halves, each adjusted alone."""

from typing import Annotated

import typer

import jaxbundle
from jaxbundle.choices import REPLICATION, TESTS
from jaxbundle.cli.app import Control, Force, Format, Input, Json, Quiet, Settings, app, choice
from jaxbundle.cli.certificate_options import Accept


@app.command(example="out/board/network --by views --repeat 4", once=True)
def replicate(  # noqa: PLR0913 - the options of the command
    input: Input,
    more: Annotated[
        list[str] | None, typer.Argument(help="further finished jobs of the same camera")
    ] = None,
    by: Annotated[str, choice(REPLICATION, "what the halves do not share")] = "photographs",
    repeat: Annotated[int, typer.Option(min=1, help="random halves; runs have one")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="of the random halves")] = 0,
    accept: Accept = None,
    json: Json = "",
    force: Force = False,
    set: Settings = None,
    format: Format = None,
    control: Control = None,
    snooping: Annotated[str | None, choice(TESTS, "remove blunders by data snooping")] = None,
    quiet: Quiet = False,
) -> None:
    """Adjust halves of a network and compare them: do the stated σ hold?

    The difference of the interior orientations of two halves over its covariance, d²/n, is about 1
    where σ are right; stated are that of independent errors, and that of errors which image points
    share. Of several inputs, jobs of one camera, the interior orientations are compared each with
    each.
    """
    from jaxbundle.cli.acceptance import check_accept
    from jaxbundle.cli.outputs import check_writable, print_result
    from jaxbundle.cli.progress import staging

    check_accept(accept, "replicate")
    jaxbundle.use_cores()
    check_writable(json, None, "replicate", (), [input, *(more or ())], force)
    with staging(quiet or json == "-") as show:
        replication = jaxbundle.replicate(
            [input, *more] if more else input,
            by=by,
            repeat=repeat,
            seed=seed,
            format=format,
            overrides=tuple(set or ()),
            control=control,
            snooping=snooping,
            progress=show,
        )
    print_result(replication, json, quiet, accept)
