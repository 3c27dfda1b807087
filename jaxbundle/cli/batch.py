"""`jaxbundle batch`: many cameras, many networks."""

from typing import Annotated

import typer

import jaxbundle
from jaxbundle.batches import run_batch
from jaxbundle.cli.app import Quiet, app
from jaxbundle.cli.progress import counting


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
    quiet: Quiet = False,
) -> None:
    """Calibrate many cameras and adjust many networks; interrupted, it takes up where it was."""
    jaxbundle.enable_x64()
    with counting(quiet) as bar:
        task = bar.add_task("batch", total=None)
        counts = run_batch(
            inputs, json_lines, model=model, free=free.split(",") if free else None,
            max_iterations=max_iterations, portion=portion, brief=brief, retry=retry,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )  # fmt: skip
    if not quiet:
        said = ", ".join(f"{number} {status}" for status, number in counts.items() if number)
        print(f"{json_lines}: {said or 'nothing to do'}")
