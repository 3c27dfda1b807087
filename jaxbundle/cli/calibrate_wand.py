"""`jaxbundle calibrate-wand`: cameras around a room, from a wand of known length."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.choices import MARKERS_OF_A_WAND
from jaxbundle.cli import calibration_options as options
from jaxbundle.cli.app import Force, Json, Quiet, app, choice
from jaxbundle.errors import InputError

COMMAND = "calibrate-wand"
REPORT, RESULT, MARKERS = "report.txt", "result.json", "markers"


@app.command(COMMAND, example="left=left.mp4 right=right.mp4 --cameras cameras.toml --length 0.5")
def calibrate_wand(  # noqa: PLR0913 - the options of the command
    markers: Annotated[
        list[str],
        typer.Argument(
            help="NAME=VIDEO or NAME=FOLDER of photographs of each camera, or NAME=FILE.csv: "
            "frame, marker, x, y of the markers; the first camera is the reference"
        ),
    ],
    cameras: Annotated[
        list[str],
        typer.Option(
            help="file of cameras by these names, or NAME=FILE for one; repeatable: the interior "
            "orientations"
        ),
    ],
    length: Annotated[
        list[str], typer.Option(help="of the wand, in --unit; of more markers A,B=LENGTH, each")
    ],
    sigma_length: Annotated[
        float | None,
        typer.Option(help="σ of a length, the same error in all frames; default: 0.1 mm"),
    ] = None,
    sigma_image: options.SigmaImage = None,
    marker_kind: Annotated[
        str, choice(MARKERS_OF_A_WAND, "than what is behind them", "--markers")
    ] = "bright",
    snooping: options.Snooping = "pope",
    free: Annotated[
        str, typer.Option(help="parameters of the cameras to estimate: fx,fy,…; default: none")
    ] = "",
    unit: options.Unit = "m",
    json: Json = "",
    out: Annotated[Path | None, typer.Option(help="folder for report, JSON, rig files")] = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Find where cameras that stand still are, with σ, from a wand that is waved before them."""
    import dataclasses

    import jaxbundle
    from jaxbundle.calibration.files import RIG, file_name, fill_rig, json_text, rig_files
    from jaxbundle.calibration.rig.wand_markers import Mark
    from jaxbundle.cli.calibration_outputs import words
    from jaxbundle.cli.outputs import check_json_target, print_result
    from jaxbundle.cli.progress import staging
    from jaxbundle.io.text.csv_tables import write_csv
    from jaxbundle.io.writing.folders import replace_folder
    from jaxbundle.measure import BlobSettings

    # A video that is no video is reported by an error, not by messages of a codec.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    sources = dict(
        split_named(source, "NAME=VIDEO, NAME=FOLDER or NAME=FILE.csv") for source in markers
    )
    if len(sources) < len(markers):
        raise InputError("two sources are given of one camera; expected one for each")
    check_json_target(json, [*sources.values(), *cameras])
    known_cameras = cameras_by_name(cameras, list(sources))
    # What the files say is free was so in another adjustment: here it is given, unless asked for.
    free_parameters = tuple(words(free))
    for name, camera in known_cameras.items():
        sigma = {
            parameter: s for parameter, s in camera.sigma.items() if parameter in free_parameters
        }
        observed = {
            parameter: camera.observed[parameter]
            for parameter in sigma
            if parameter in camera.observed
        }
        known_cameras[name] = dataclasses.replace(
            camera, free=free_parameters, sigma=sigma, observed=observed
        )
    with staging(quiet or json == "-") as tell:
        result = jaxbundle.calibrate_wand(
            sources,
            known_cameras,
            lengths_given(length),
            sigma_length=sigma_of_length(sigma_length, unit),
            sigma_image=sigma_image,
            object_unit=unit,
            blobs=BlobSettings(dark=marker_kind == "dark"),
            snooping=None if snooping == "none" else snooping,
            progress=tell,
        )
    if out is not None:
        tables = {name: f"{MARKERS}/{file_name(name)}.csv" for name in sources}
        files = (REPORT, RESULT, *rig_files(), *tables.values())
        with replace_folder(out, COMMAND, files, force) as folder:
            (folder / REPORT).write_text(result.report(), encoding="utf-8")
            (folder / RESULT).write_text(json_text(result.to_dict()), encoding="utf-8")
            fill_rig(result.network(), folder / RIG)
            (folder / MARKERS).mkdir()
            for name, marks in result.markers.items():
                write_csv(folder / tables[name], Mark._fields, marks)
    if json or out is None or not quiet:
        print_result(result, json, quiet)


def sigma_of_length(sigma: float | None, unit: str, option: str = "--sigma-length") -> float:
    """σ of the lengths in their unit, 0.1 mm if not given.

    **Raises:** `InputError` if that is not known in this unit."""
    in_unit = {"m": 1e-4, "cm": 1e-2, "mm": 0.1}
    if sigma is None and unit not in in_unit:
        raise InputError(f"{option}: expected the σ of the lengths in {unit}")
    return in_unit[unit] if sigma is None else sigma


def split_named(text: str, expected: str) -> tuple[str, str]:
    """A name and what is given of it."""
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise InputError(f"got {text!r}; expected {expected}")
    return name, value


def cameras_by_name(files: Sequence[str], names: Sequence[str], option: str = "--cameras") -> dict:
    """Interior orientations by the name of the camera."""
    from jaxbundle.io import read_cameras
    from jaxbundle.network.columns import list_some

    camera_of = {}
    for text in files:
        name, equals, path = text.partition("=")
        # A file whose path has "=" is meant as a whole.
        if equals and not Path(text).exists():
            cameras = read_cameras(path)
            # The name in the file may be another one: which is meant must be clear.
            if len(cameras) != 1:
                raise InputError(f"{path}: has {len(cameras)} cameras; expected one, {name!r}")
            camera_of[name] = cameras[0]
        else:
            camera_of |= {camera.id: camera for camera in read_cameras(text)}
    missing_names = [name for name in names if name not in camera_of]
    if missing_names:
        raise InputError(
            f"{option}: no camera {missing_names[0]!r}; the files have "
            f"{list_some(list(camera_of)) or 'none'}; expected a camera of each name, or {option} "
            f"{missing_names[0]}=FILE"
        )
    return {name: camera_of[name] for name in names}


def lengths_given(texts: Sequence[str]) -> float | dict[tuple[str, str], float]:
    """A length, or lengths by their markers."""
    expected = "a length, or MARKER,MARKER=LENGTH for each"
    try:
        if len(texts) == 1 and "=" not in texts[0]:
            return float(texts[0])
        lengths = {}
        for text in texts:
            pair, value = split_named(text, expected)
            a, b = pair.split(",")
            lengths[a.strip(), b.strip()] = float(value)
        return lengths
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"--length: got {', '.join(texts)}; expected {expected}") from None
