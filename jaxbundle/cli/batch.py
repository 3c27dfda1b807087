"""`jaxbundle batch`: many cameras, many networks."""

from typing import Annotated

import typer

import jaxbundle
from jaxbundle.cli.app import Quiet, app, choice
from jaxbundle.system.interrupts import advise


@app.command(example="cameras.npz PROJECT.toml --json-lines results.jsonl")
def batch(
    inputs: Annotated[list[str], typer.Argument(help=".npz of many cameras; projects")],
    json_lines: Annotated[str, typer.Option(help="file of results, one a line; is continued")],
    model: Annotated[str, typer.Option(help="camera model of the .npz files")] = "opencv",
    free: Annotated[str, typer.Option(help="parameters to estimate: fx,fy,…")] = "",
    max_iterations: Annotated[int, typer.Option(min=1)] = 100,
    snooping: Annotated[str, choice(("pope", "none"), "removal of gross errors")] = "none",
    significance: Annotated[float, typer.Option(help="level of the test")] = 0.001,
    portion: Annotated[int, typer.Option(min=1, help="cameras between two writes")] = 256,
    brief: Annotated[bool, typer.Option("--brief", help="no poses, no covariances")] = False,
    retry: Annotated[bool, typer.Option("--retry", help="again what has no result")] = False,
    renew: Annotated[
        bool, typer.Option("--renew", help="again what is from other settings or other data")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Calibrate many cameras and adjust many networks; interrupted, it takes up where it was.

    Lines that are in the file already are not computed again. Those of other
    settings or other data are refused, or computed again with --renew.

    It is done when every input has its line, whatever the status in it; another
    run that is writing the file is refused.
    """
    from jaxbundle.batch.run import run_batch
    from jaxbundle.batch.stacks import is_camera_stack
    from jaxbundle.cli.progress import counting

    if not all(map(is_camera_stack, inputs)):
        # Cameras fill the cores by threads of their own, and gain nothing.
        jaxbundle.use_cores()
    advise("run the same command again to go on")
    with counting(quiet) as bar:
        task = bar.add_task("batch", total=None)
        counts = run_batch(
            inputs, json_lines, model=model,
            free=[name.strip() for name in free.split(",")] if free else None,
            max_iterations=max_iterations,
            snooping=None if snooping == "none" else snooping, significance=significance,
            portion=portion, brief=brief, retry=retry,
            renew=renew,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )  # fmt: skip
    if not quiet:
        skipped = counts.pop("skipped", 0)
        said = ", ".join(f"{number} {status}" for status, number in counts.most_common() if number)
        print(f"{json_lines}: {said}" + f" ({skipped} skipped, they were there)" * bool(skipped))
