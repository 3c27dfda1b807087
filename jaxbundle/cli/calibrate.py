"""`jaxbundle calibrate`: calibrate cameras from photographs of a board."""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from jaxbundle.choices import BOARDS, DICTIONARIES, ESTIMATORS, TESTS
from jaxbundle.cli.app import Correlated, Force, Html, Json, Quiet, app, choice, model_choice
from jaxbundle.cli.common_options import is_in_file
from jaxbundle.errors import InputError, NotSolvedError


@app.command(example="examples/board --board 9x6 --square 0.03 --out out/board")
def calibrate(  # noqa: PLR0913 - the options of the command
    photos: Annotated[
        list[str] | None, typer.Argument(help="photographs of one camera: files, patterns, folders")
    ] = None,
    board: Annotated[
        str,
        typer.Option(
            help="COLUMNSxROWS: inner corners, circles, or squares of charuco; or a "
            "Kalibr target, FILE.yaml"
        ),
    ] = "",
    square: Annotated[
        str,
        typer.Option(
            metavar="S or S,S",
            help="side of a square, spacing of circles, in --unit; "
            "two of a stretched print: of columns, of rows",
        ),
    ] = "",
    kind: Annotated[str, choice(BOARDS)] = "chessboard",
    camera: Annotated[
        list[str] | None, typer.Option(help="NAME=PATTERN: one of several cameras; repeatable")
    ] = None,
    rig: Annotated[
        bool, typer.Option("--rig", help="rigidly mounted cameras with simultaneous photographs")
    ] = False,
    model: Annotated[str, model_choice("camera model")] = "opencv",
    models: Annotated[str, typer.Option(help="a,b,c: camera models to compare")] = "",
    folds: Annotated[int, typer.Option(help="number of cross-validation folds, for --models")] = 4,
    free: Annotated[str, typer.Option(help="parameters to estimate: fx,fy,…")] = "",
    given: Annotated[
        list[str] | None, typer.Option(help="NAME=VALUE of a parameter; held if not free")
    ] = None,
    pixel_size: Annotated[float | None, typer.Option(help="mm, for models in mm")] = None,
    diameter: Annotated[
        float | None, typer.Option(help="of the circles, to correct their eccentricity")
    ] = None,
    marker: Annotated[float | None, typer.Option(help="side of a marker or tag")] = None,
    dictionary: Annotated[str, choice(DICTIONARIES, "of markers or tags")] = "DICT_4X4_50",
    first_marker: Annotated[
        int, typer.Option(min=0, help="number of the first marker or tag of the board")
    ] = 0,
    board_sigma: Annotated[
        float | None, typer.Option(help="σ of a board coordinate, for an inexact board")
    ] = None,
    board_free: Annotated[
        bool, typer.Option("--board-free", help="estimate the points of the board")
    ] = False,
    sigma_image: Annotated[
        float | None,
        typer.Option(
            help="a priori σ of an image coordinate, pixels; default: 0.1 as a unit "
            "of weight, without a χ² test"
        ),
    ] = None,
    snooping: Annotated[
        str, choice((*TESTS, "none"), "removal of gross errors and of rig epochs")
    ] = "pope",
    significance: Annotated[float, typer.Option(help="level of the test")] = 0.001,
    robust: Annotated[str | None, choice(ESTIMATORS, "instead of removal")] = None,
    cross_validation: Annotated[
        bool, typer.Option(help="calibrate from each half of the photographs: 4 adjustments")
    ] = True,
    correlated: Correlated = True,
    unit: Annotated[str, typer.Option(help="unit of the board, a label")] = "m",
    json: Json = "",
    out: Annotated[
        Path | None, typer.Option(help="folder for report, page, JSON, cameras, network, plots")
    ] = None,
    html: Html = "",
    force: Force = False,
    brief: Annotated[
        bool, typer.Option("--brief", help="omit points and residuals from the JSON")
    ] = False,
    quiet: Quiet = False,
    plots: Annotated[bool, typer.Option(help="write plots to --out")] = True,
) -> None:
    """Calibrate cameras from photographs of a board and assess their accuracy."""
    from jaxbundle.calibration import Calibrations, calibrate_cameras, compare_models
    from jaxbundle.calibration.files import (
        COMMAND,
        COMPARED,
        calibrations_dict,
        files_of,
        fill_calibrations,
        fill_comparison,
        json_text,
    )
    from jaxbundle.calibration.page import KIND, compose_calibrations
    from jaxbundle.cli.board_options import board_given
    from jaxbundle.cli.outputs import (
        can_plot,
        check_writable,
        name_inside,
        trace_files,
        write_result,
    )
    from jaxbundle.cli.progress import counting
    from jaxbundle.io.results.result_json import unsolved_text
    from jaxbundle.leastsquares.quality.snooping import check_test
    from jaxbundle.measure.views import photographs
    from jaxbundle.network.columns import count
    from jaxbundle.photographs.opencv import need_opencv
    from jaxbundle.report.page import UNKNOWN, compose_failure, head_line

    test = None if snooping == "none" else snooping
    check_test(test, significance, "--")
    known = board_given(board, square, kind, diameter, marker, dictionary, first_marker)
    cameras = _cameras(photos, camera)
    need_opencv()
    files = [path for paths in cameras.values() for path in photographs(paths)]
    for path in files:
        if not path.exists():
            raise InputError(f"{path}: no such file or folder")
    _check_names(cameras)
    compared = _words(models)
    if compared:
        _check_compared(compared, cameras, free, rig)
    names = files_of([*cameras]) + (COMPARED if compared else [])
    check_writable(json, out, COMMAND, names, files, force, html)
    origin = UNKNOWN
    if html or out is not None:
        origin = trace_files(
            files,
            {
                "--board": board,
                "--square": square,
                "--kind": kind,
                "--diameter": diameter,
                "--marker": marker,
                "--dictionary": dictionary if marker or kind in ("charuco", "aprilgrid") else "",
                "--first-marker": first_marker or "",
                "--model": models or model,
                "--free": free,
                "--given": ", ".join(given or ()),
                "--board-sigma": board_sigma,
                "--board-free": board_free,
                "--sigma-image": sigma_image,
                "--snooping": snooping,
                "--significance": significance,
                "--robust": robust,
                "--no-correlated": True if not correlated else None,
            },
        )
    with counting(quiet or json == "-") as bar:
        task = bar.add_task("searching the board", total=len(files))

        def tell(*_: object) -> None:
            bar.advance(task)
            if bar.tasks[task].finished:
                bar.update(task, description="adjusting")

        options: dict[str, Any] = dict(
            pixel_size=pixel_size,
            sigma_image=sigma_image,
            board_sigma=board_sigma,
            board_free=board_free,
            snooping=test,
            significance=significance,
            robust=robust,
            correlated=correlated,
            object_unit=unit,
        )
        choice = None
        try:
            if compared:
                ((name, photographed),) = cameras.items()
                choice = compare_models(
                    photographed,
                    known,
                    models=compared,
                    folds=folds,
                    camera=name,
                    progress=tell,
                    **options,
                )
                found = Calibrations({name: choice.suffices.calibration})
            else:
                found = calibrate_cameras(
                    cameras,
                    known,
                    rig=rig,
                    model=model,
                    free=_words(free) or None,
                    given=_values(given),
                    cross_validation=cross_validation,
                    progress=tell,
                    **options,
                )
        except NotSolvedError as error:
            # a failure makes no folder, unless a file that was asked for belongs in it
            place = out if name_inside(json, out) or name_inside(html, out) else None
            page = partial(compose_failure, error, origin, KIND)
            with write_result(json, unsolved_text(error), place, COMMAND, names, force, html, page):
                pass
            raise
        bar.update(task, description="assessing accuracy")
        document = calibrations_dict(found, brief) if json else {}
        if choice is not None and json:
            document["models"] = choice.to_dict()
        text = json_text(document) if json else ""
        silent = json == "-" or (quiet and is_in_file(json, out, html))
        report = "" if silent else head_line(origin) + (choice or found).report()
        bar.update(task, description="writing")
        show = lambda stage, done, total: bar.update(
            task, description=stage, completed=done, total=total
        )
        page = partial(compose_calibrations, found, origin, choice)
        with write_result(json, text, out, COMMAND, names, force, html, page) as new:
            if new is not None:
                fill_calibrations(found, new, plots and can_plot(), origin, choice, show)
                if choice is not None:
                    fill_comparison(choice, new, plots and can_plot(), show)
    if report:
        print(report)
    failed = [name for name, one in found.cameras.items() if not one.converged]
    if failed:
        names = found.cameras[failed[0]].adjustment.undetermined
        what = f"; not determined: {', '.join(names[:12])}" if names else ""
        others = count(len(failed) - 1, "other camera")
        more = f"; {others} not solved either: {', '.join(failed[1:])}"
        raise NotSolvedError(
            f"not solved: camera {failed[0]}: {found.cameras[failed[0]].adjustment.termination}"
            f"{what}; free fewer parameters (--free), or take photographs from more directions"
            f"{more if len(failed) > 1 else ''}"
        )


def _check_compared(
    models: Sequence[str], cameras: Mapping[str, Sequence[str]], free: object, rig: bool
) -> None:
    """Refuse options that are incompatible with --models."""
    for given, option in ((rig, "--rig"), (free, "--free"), (len(cameras) > 1, "--camera")):
        if given:
            raise InputError(
                f"--models compares the standard parameters of one camera: omit {option}"
            )
    if len({*models}) < 2:
        raise InputError("--models: give at least two different models, such as opencv,brown")


def _check_names(cameras: Iterable[str]) -> None:
    """Refuse cameras that would share an output folder."""
    from jaxbundle.calibration.files import file_name

    folders: dict[str, str] = {}
    for name in cameras:
        # some systems do not tell the letters of a name from capitals
        other = folders.setdefault(file_name(name).casefold(), name)
        if other != name:
            raise InputError(
                f"--camera: {other!r} and {name!r} would have the same folder {file_name(name)!r}; "
                "choose other names"
            )


def _cameras(photos: Sequence[str] | None, named: Sequence[str] | None) -> dict[str, list[str]]:
    """Photographs by camera name, or all of one camera."""
    if photos and named:
        raise InputError("give photographs either as arguments or by --camera NAME=PATTERN")
    if not photos and not named:
        raise InputError(
            "no photographs: give files, patterns or folders, or --camera NAME=PATTERN"
        )
    cameras: dict[str, list[str]] = {}
    for item in named or ():
        name, equals, pattern = (part.strip() for part in item.partition("="))
        if not (name and equals and pattern):
            raise InputError(f"--camera {item}: NAME=PATTERN is expected, such as left=left/*.jpg")
        if name in cameras:
            raise InputError(
                f"--camera {name} is given twice: {name}={cameras[name][0]}, {name}={pattern}; "
                "give each camera its own name and one folder or pattern"
            )
        cameras[name] = [pattern]
    return cameras or {"cam": list(photos or ())}


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def _values(given: Sequence[str] | None) -> dict[str, float]:
    values = {}
    for item in given or ():
        name, equals, text = (part.strip() for part in item.partition("="))
        try:
            values[name] = float(text)
        except ValueError:
            equals = ""
        if not equals:
            raise InputError(f"--given {item}: NAME=VALUE is expected, such as fx=1200")
    return values
