"""`jaxbundle calibrate`: calibrate cameras from photographs of a board."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from jaxbundle.cli import calibration_options as options
from jaxbundle.cli.app import Correlated, Force, Html, Json, Quiet, app
from jaxbundle.cli.certificate_options import (
    Accept,
    CertificateFile,
    CertificateOptions,
    Details,
    Lengths,
)
from jaxbundle.errors import InputError


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
    square: options.Square = "",
    kind: options.Kind = "chessboard",
    camera: Annotated[
        list[str] | None, typer.Option(help="NAME=PATTERN: one of several cameras; repeatable")
    ] = None,
    rig: Annotated[
        bool,
        typer.Option("--rig", help="rigidly mounted cameras with simultaneous photographs"),
    ] = False,
    model: options.Model = "opencv",
    models: Annotated[str, typer.Option(help="a,b,c: camera models to compare")] = "",
    folds: Annotated[int, typer.Option(help="number of cross-validation folds, for --models")] = 4,
    free: options.Free = "",
    given: options.Given = None,
    pixel_size: options.PixelSize = None,
    diameter: options.Diameter = None,
    marker: options.Marker = None,
    dictionary: options.Dictionary = "DICT_4X4_50",
    first_marker: options.FirstMarker = 0,
    board_sigma: options.BoardSigma = None,
    board_free: options.BoardFree = False,
    sigma_image: options.SigmaImage = None,
    snooping: options.Snooping = "pope",
    significance: options.Significance = 0.001,
    robust: options.Robust = None,
    cross_validation: options.CrossValidation = True,
    correlated: Correlated = True,
    unit: options.Unit = "m",
    json: Json = "",
    out: Annotated[
        Path | None, typer.Option(help="folder for report, page, JSON, cameras, network, plots")
    ] = None,
    html: Html = "",
    force: Force = False,
    accept: Accept = None,
    certificate: CertificateFile = "",
    details: Details = None,
    lengths: Lengths = None,
    brief: options.Brief = False,
    quiet: Quiet = False,
    plots: options.Plots = True,
) -> None:
    """Calibrate cameras from photographs of a board and assess their accuracy."""
    from jaxbundle.calibration import Calibrations, calibrate_cameras, compare_models
    from jaxbundle.calibration.files import COMMAND
    from jaxbundle.cli.board_options import board_given
    from jaxbundle.cli.calibration_outputs import CalibrationOutputs, values, words
    from jaxbundle.leastsquares.quality.snooping import check_test
    from jaxbundle.measure.views import photographs
    from jaxbundle.photographs.opencv import need_opencv

    test = None if snooping == "none" else snooping
    check_test(test, significance, "--")
    board_of_photographs = board_given(
        board, square, kind, diameter, marker, dictionary, first_marker
    )
    cameras = _cameras(photos, camera)
    need_opencv()
    files = [path for paths in cameras.values() for path in photographs(paths)]
    compared = words(models)
    if compared:
        _check_compared(compared, cameras, free, rig)
    settings = {
        "--board": board,
        "--square": square,
        "--unit": unit,
        "--kind": kind,
        "--rig": rig,
        "--diameter": diameter,
        "--marker": marker,
        "--dictionary": dictionary if marker or kind in ("charuco", "aprilgrid") else "",
        "--first-marker": first_marker or "",
        "--model": models or model,
        "--folds": folds if compared else None,
        "--free": free,
        "--given": ", ".join(given or ()),
        "--pixel-size": pixel_size,
        "--board-sigma": board_sigma,
        "--board-free": board_free,
        "--sigma-image": sigma_image,
        "--snooping": snooping,
        "--significance": significance,
        "--robust": robust,
        "--no-cross-validation": True if not (cross_validation or compared) else None,
        "--no-correlated": True if not correlated else None,
    }
    common: dict[str, Any] = dict(
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

    def compute(progress: Callable) -> tuple[Calibrations, Any]:
        if compared:
            ((name, photographed),) = cameras.items()
            comparison = compare_models(
                photographed,
                board_of_photographs,
                models=compared,
                folds=folds,
                camera=name,
                progress=progress,
                **common,
            )
            return Calibrations({name: comparison.suffices.calibration}), comparison
        calibrations = calibrate_cameras(
            cameras,
            board_of_photographs,
            rig=rig,
            model=model,
            free=words(free) or None,
            given=values(given),
            cross_validation=cross_validation,
            progress=progress,
            **common,
        )
        return calibrations, None

    CalibrationOutputs(
        COMMAND, [*cameras], files, settings, json, out, html, force, brief, quiet, plots,
        bool(compared), CertificateOptions(accept, certificate, details, lengths),
        compared or [model],
    ).compute(compute)  # fmt: skip


def _check_compared(
    models: Sequence[str], cameras: Mapping[str, Sequence[str]], free: object, rig: bool
) -> None:
    """Refuse options that are incompatible with --models."""
    for is_given, option in ((rig, "--rig"), (free, "--free"), (len(cameras) > 1, "--camera")):
        if is_given:
            raise InputError(
                f"--models compares the standard parameters of one camera: omit {option}"
            )
    if len({*models}) < 2:
        raise InputError("--models: give at least two different models, such as opencv,brown")


def _cameras(
    photos: Sequence[str] | None, named_folders: Sequence[str] | None
) -> dict[str, list[str]]:
    """Photographs by camera name, or all of one camera."""
    if photos and named_folders:
        raise InputError("give photographs either as arguments or by --camera NAME=PATTERN")
    if not photos and not named_folders:
        raise InputError(
            "no photographs: give files, patterns or folders, or --camera NAME=PATTERN"
        )
    cameras: dict[str, list[str]] = {}
    for item in named_folders or ():
        name, equals, pattern = (part.strip() for part in item.partition("="))
        if not (name and equals and pattern):
            raise InputError(f"--camera {item}: expected NAME=PATTERN, such as left=left/*.jpg")
        if name in cameras:
            raise InputError(
                f"--camera {name} is given twice: {name}={cameras[name][0]}, {name}={pattern}; "
                "give each camera its own name and one folder or pattern"
            )
        cameras[name] = [pattern]
    return cameras or {"cam": list(photos or ())}
