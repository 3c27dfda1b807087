"""`jaxbundle calibrate-rig`: cameras on one mounting, from photographs of any boards."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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

if TYPE_CHECKING:
    from jaxbundle.calibration import Wand

COMMAND = "calibrate-rig"


@app.command(COMMAND, example="left/ right/ --board 9x6 --square 0.03 --out out/rig")
def calibrate_rig(  # noqa: PLR0913 - the options of the command
    folders: Annotated[
        list[str],
        typer.Argument(
            help="a folder of photographs for each camera, FOLDER or NAME=FOLDER; the first camera "
            "is the reference"
        ),
    ],
    board: Annotated[
        str,
        typer.Option(
            help="COLUMNSxROWS: inner corners, circles, or squares of charuco; a Kalibr target, "
            "FILE.yaml; or several boards, FILE.toml"
        ),
    ] = "",
    square: options.Square = "",
    kind: options.Kind = "chessboard",
    fixed: Annotated[
        bool,
        typer.Option("--fixed", help="the boards are fixed to each other, to walls for instance"),
    ] = False,
    mountings: Annotated[
        str,
        typer.Option(
            help="FILE.toml with a section [rig], as of a project: what is known of the mountings"
        ),
    ] = "",
    wand: Annotated[
        list[str] | None,
        typer.Option(
            help="NAME=VIDEO, NAME=FOLDER or NAME=FILE.csv of each camera before which a wand was "
            "waved, as for calibrate-wand; repeatable"
        ),
    ] = None,
    wand_length: Annotated[
        list[str] | None,
        typer.Option(help="of the wand, in --unit; of more markers A,B=LENGTH, each"),
    ] = None,
    wand_sigma: Annotated[
        float | None, typer.Option(help="σ of a length of the wand; default: 0.1 mm")
    ] = None,
    wand_camera: Annotated[
        list[str] | None,
        typer.Option(
            help="file of cameras, or NAME=FILE for one: interior orientations of those that see "
            "the wand, but no board; repeatable"
        ),
    ] = None,
    synchronize: Annotated[
        str,
        typer.Option(
            metavar="offset,rate,read-out",
            help="unknowns of the clocks of cameras that run by themselves, of these: from the "
            "motion of the targets in videos",
        ),
    ] = "",
    times: Annotated[
        str,
        typer.Option(
            metavar="FPS or FILE.csv",
            help="with --synchronize: frames per second, NAME=FPS,NAME=FPS, or a table camera,"
            "image,time; default: frames.csv beside the folders",
        ),
    ] = "",
    model: options.Model = "opencv",
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
        Path | None, typer.Option(help="folder for report, page, JSON, cameras, rig files, plots")
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
    """Calibrate cameras on one rigid mounting, from simultaneous photographs of any boards.

    Photographs of equal names, or equal last numbers in them, are simultaneous. Cameras are tied by
    boards that they see at the same time, through other cameras, or by the motion of the rig
    between boards that are fixed to each other, or by a wand (--wand). With --synchronize nothing
    is simultaneous: offsets and rates of the clocks follow from frames of videos in which the
    targets move.
    """
    from jaxbundle.calibration import Calibrations
    from jaxbundle.calibration import calibrate_rig as calibrate_together
    from jaxbundle.cli.board_options import board_given
    from jaxbundle.cli.calibration_outputs import CalibrationOutputs, values, words
    from jaxbundle.leastsquares.quality.snooping import check_test
    from jaxbundle.measure.views import photographs
    from jaxbundle.photographs.opencv import need_opencv

    test = None if snooping == "none" else snooping
    check_test(test, significance, "--")
    board_of_photographs: Any = board
    if board.endswith(".toml"):
        _check_alone(square, diameter, marker, first_marker, board)
    else:
        board_of_photographs = board_given(
            board, square, kind, diameter, marker, dictionary, first_marker
        )
    cameras = name_cameras(folders, allow_one=bool(wand))
    waved = wand_given(wand, wand_length, wand_sigma, wand_camera, cameras, unit, sigma_image)
    when = times_given(times, cameras) if times or synchronize else None
    need_opencv()
    files = [path for folder in cameras.values() for path in photographs([folder])]
    settings = {
        "--board": board,
        "--square": square,
        "--kind": kind,
        "--fixed": fixed,
        "--mountings": mountings,
        "--wand": ", ".join(wand or ()),
        "--wand-length": ", ".join(wand_length or ()),
        "--wand-sigma": wand_sigma,
        "--wand-camera": ", ".join(wand_camera or ()),
        "--synchronize": synchronize,
        "--times": times,
        "--model": model,
        "--free": free,
        "--given": ", ".join(given or ()),
        "--board-sigma": board_sigma,
        "--board-free": board_free,
        "--sigma-image": sigma_image,
        "--snooping": snooping,
        "--significance": significance,
        "--robust": robust,
        "--no-correlated": True if not correlated else None,
    }

    def compute(progress: Callable) -> tuple[Calibrations, None]:
        rig = calibrate_together(
            {name: [folder] for name, folder in cameras.items()},
            board_of_photographs,
            fixed=fixed,
            mountings=mountings or None,
            wand=waved,
            synchronize=synchronize,
            times=when,
            model=model,
            free=words(free) or None,
            given=values(given),
            pixel_size=pixel_size,
            board_sigma=board_sigma,
            board_free=board_free,
            sigma_image=sigma_image,
            snooping=test,
            significance=significance,
            robust=robust,
            cross_validation=cross_validation,
            correlated=correlated,
            object_unit=unit,
            progress=progress,
        )
        return Calibrations(rig.cameras, rig), None

    cameras_without_board = (
        [] if waved is None else [name for name in waved.markers if name not in cameras]
    )
    CalibrationOutputs(
        COMMAND, [*cameras, *cameras_without_board], files, settings, json, out, html, force, brief,
        quiet, plots,
        judged=CertificateOptions(accept, certificate, details, lengths), models=[model],
    ).compute(compute)  # fmt: skip


def wand_given(
    sources: Sequence[str] | None,
    lengths: Sequence[str] | None,
    sigma: float | None,
    files: Sequence[str] | None,
    cameras: Mapping[str, str],
    unit: str,
    sigma_image: float | None,
) -> "Wand | None":
    """The wand of the options, None without one.

    **Raises:** `InputError` for options that miss each other."""
    from jaxbundle.calibration import Wand
    from jaxbundle.cli.calibrate_wand import (
        cameras_by_name,
        lengths_given,
        sigma_of_length,
        split_named,
    )

    if not sources:
        options_of_wand = {"--wand-length": lengths, "--wand-sigma": sigma, "--wand-camera": files}
        for option, value in options_of_wand.items():
            if value:
                raise InputError(f"{option}: is of a wand; give --wand NAME=VIDEO, too")
        return None
    if not lengths:
        raise InputError("--wand-length: the length of the wand is missing")
    markers = dict(
        split_named(source, "NAME=VIDEO, NAME=FOLDER or NAME=FILE.csv") for source in sources
    )
    if len(markers) < len(sources):
        raise InputError("--wand: two sources are given for one camera; expected one for each")
    cameras_without_board = [name for name in markers if name not in cameras]
    if cameras_without_board and not files:
        raise InputError(
            f"--wand-camera: there is no folder of camera {cameras_without_board[0]!r}, so that it "
            "sees no board; expected its interior orientation, NAME=FILE"
        )
    return Wand(
        markers,
        lengths_given(lengths),
        sigma_of_length(sigma, unit, "--wand-sigma"),
        cameras_by_name(files or (), cameras_without_board, "--wand-camera"),
        sigma_image,
    )


def name_cameras(folders: Sequence[str], allow_one: bool = False) -> dict[str, str]:
    """Folders by the name of the camera: that given, or that of the folder, with as many of the
    folders above it as make the names unique; `allow_one`: one camera is enough."""
    names_and_folders: list[tuple[str, str]] = []
    for item in folders:
        name, equals, folder = item.partition("=")
        has_name = equals and name and folder and not Path(item).exists()
        names_and_folders.append((name, folder) if has_name else ("", item))
    for _, folder in names_and_folders:
        if not Path(folder).exists():
            raise InputError(
                f"{folder}: no such folder; expected a folder of photographs for each camera"
            )
    if len(names_and_folders) < 2 and not allow_one:
        raise InputError(
            "a rig has at least two cameras: give a folder of photographs for each; for one camera "
            "use jaxbundle calibrate"
        )
    paths = [Path(folder).resolve() for name, folder in names_and_folders if not name]
    parts = next(
        (n for n in range(1, 100) if len({p.parts[-n:] for p in paths}) == len({*paths})), 1
    )
    folder_of: dict[str, str] = {}
    for name, folder in names_and_folders:
        unique_name = name or "_".join(Path(folder).resolve().parts[-parts:])
        if unique_name in folder_of:
            raise InputError(
                f"{folder}: camera {unique_name!r} is given twice, the other is "
                f"{folder_of[unique_name]}; expected a "
                "folder and a name of its own for each camera"
            )
        folder_of[unique_name] = folder
    return folder_of


def times_given(times: str, cameras: Mapping[str, str]) -> float | dict[str, float] | Path:
    """The times of photographs: frames per second, by camera if they differ, or a table."""
    if not times:
        # Where `jaxbundle frames` writes it.
        tables = [Path(folder).parent / "frames.csv" for folder in cameras.values()]
        existing_table = next((table for table in tables if table.is_file()), None)
        if existing_table is None:
            raise InputError(
                f"--synchronize: there is no {tables[0]}; give --times: frames per second, or a "
                "table with the columns camera, image, time"
            )
        return existing_table
    # First of all: the path of a table may have "=" or be a number.
    if Path(times).is_file():
        return Path(times)
    try:
        if "=" not in times:
            return float(times)
        pairs = [word.split("=") for word in times.split(",")]
        return {name.strip(): float(rate) for name, rate in pairs}
    except ValueError:
        raise InputError(
            f"--times: expected frames per second, NAME=FPS,NAME=FPS or a file, got {times!r}"
        ) from None


def _check_alone(
    square: str, diameter: float | None, marker: float | None, first_marker: int, board: str
) -> None:
    """Refuse options of one board beside a file of boards."""
    for value, option in (
        (square, "--square"),
        (diameter, "--diameter"),
        (marker, "--marker"),
        (first_marker, "--first-marker"),
    ):
        if value:
            raise InputError(f"{option}: {board} gives the sizes of the boards; omit it")
