"""`jaxbundle frames`: photographs out of videos."""

import os
from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.cli.app import Force, Json, Quiet, app
from jaxbundle.errors import InputError


@app.command(example="left.mp4 right.mp4 --number 40 --out out/frames")
def frames(
    videos: Annotated[list[Path], typer.Argument(help="videos; several: simultaneous ones")],
    out: Annotated[Path, typer.Option(help="folder for a folder of frames of each video")],
    number: Annotated[int, typer.Option(min=1, help="number of frames of each, at most")] = 60,
    every: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="instead, every Nth frame, for calibrate-rig --synchronize: the videos "
            "need not be simultaneous",
        ),
    ] = None,
    first: Annotated[
        str, typer.Option(help="a,b: the frame of each video at which all begin; default: 0")
    ] = "",
    json: Json = "",
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Choose sharp frames that differ from videos, of several at the same instants."""
    import jaxbundle
    from jaxbundle.cli.outputs import check_json_target, print_result
    from jaxbundle.cli.progress import staging

    # FFmpeg's own lines about a damaged file, beside the error of the command; read by OpenCV when
    # it is imported
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    check_json_target(json, videos)
    try:
        begin = [int(word) for word in first.split(",")] if first else ()
    except ValueError:
        raise InputError(f"--first: expected whole numbers a,b, got {first!r}") from None
    with staging(quiet or json == "-") as tell:
        result = jaxbundle.frames(
            videos, out, number=number, every=every, first=begin, force=force, progress=tell
        )
    print_result(result, json, quiet)
