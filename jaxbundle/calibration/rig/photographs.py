"""The photographs of the cameras of a rig, and the boards that are searched in them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxbundle.arguments import show
from jaxbundle.calibration.result import Calibration
from jaxbundle.errors import InputError
from jaxbundle.io.boards.board_sets import read_boards
from jaxbundle.measure.board_sets import join_views, measure_board_set, require_boards
from jaxbundle.measure.boards import Board, require_board
from jaxbundle.measure.views import BoardViews, measure_boards, photographs
from jaxbundle.network.columns import did_you_mean
from jaxbundle.types import Progress

# What a camera of a rig may be given by.
RigPhotographs = (
    str | Path | Sequence[str | Path] | BoardViews | Mapping[str, BoardViews] | Calibration
)


def views_of_camera(
    sources: Mapping[str, Any],
    board: Board | Mapping[str, Board] | str | Path | None,
    seen_by: Mapping[str, Sequence[str]] | None = None,
    progress: Progress | None = None,
) -> tuple[dict[str, BoardViews | Calibration], Mapping[str, Sequence[str]] | None]:
    """The views of every camera, measured where photographs are given; and the bodies of a file of
    boards.

    **Raises:** `InputError` naming the camera.
    """
    boards, bodies, cameras_of = _boards_of(board, seen_by)
    for name, cameras in cameras_of.items():
        for camera in cameras:
            if camera not in sources:
                raise InputError(
                    f"board {name!r} is to be seen by a camera {camera!r}, which is not given"
                    f"{did_you_mean(camera, sources)}"
                )
    _refuse_same_files(sources)
    views = {}
    for name, source in sources.items():
        boards_of_camera = {
            b: known_board
            for b, known_board in boards.items()
            if name in cameras_of.get(b, sources)
        }
        tell = (
            None
            if progress is None
            else lambda stage, *numbers, name=name: progress(f"{stage} of {name}", *numbers)
        )
        try:
            views[name] = _views(source, boards_of_camera, boards, tell)
        except InputError as error:
            raise InputError(f"camera {name}: {error}") from None
    return views, bodies or None


def require_lists(name: str, argument: Any, example: str) -> dict[str, list[str]]:
    """Lists of names by name; none if nothing is given.

    **Raises:** `InputError` about another argument."""
    lists = {} if argument is None else argument
    is_valid = isinstance(lists, Mapping) and all(
        isinstance(names, Sequence)
        and not isinstance(names, str)
        and all(isinstance(entry, str) for entry in (key, *names))
        for key, names in lists.items()
    )
    if not is_valid:
        raise InputError(
            f"{name} must be lists of names by name, such as {example}, but is {show(argument)}"
        )
    return {key: list(names) for key, names in lists.items()}


def _boards_of(
    board: Board | Mapping[str, Board] | str | Path | None,
    seen_by: Mapping[str, Sequence[str]] | None,
) -> tuple[dict[str, Board], Mapping[str, Sequence[str]], Mapping[str, Sequence[str]]]:
    """Boards by name, their bodies, and the cameras that see each."""
    cameras = require_lists("seen_by", seen_by, "{'wall': ['left']}")
    bodies: Mapping[str, Sequence[str]] = {}
    if board is None:
        boards = {}
    elif isinstance(board, str | Path):
        boards, bodies, of_file = read_boards(board)
        cameras = {**of_file, **cameras}
    elif isinstance(board, Mapping):
        boards = require_boards(board)
    else:
        boards = {"board": require_board(board)}
    for name in cameras:
        if name not in boards:
            raise InputError(f"seen_by: there is no board {name!r}{did_you_mean(name, boards)}")
    return boards, bodies, cameras


def _views(
    source: Any,
    boards_of_camera: Mapping[str, Board],
    boards: Mapping[str, Board],
    progress: Progress | None,
) -> BoardViews | Calibration:
    """The views of one camera."""
    if isinstance(source, BoardViews | Calibration):
        return source
    if isinstance(source, Mapping):
        return join_views(_require_views(source))
    files = [source] if isinstance(source, str | Path) else source
    if not isinstance(files, Sequence):
        raise InputError(
            "photographs must be files, patterns or folders, BoardViews, or a Calibration, but are "
            f"{show(source)}"
        )
    if not boards:
        raise InputError("give the board, or the boards, that are in the photographs")
    if not boards_of_camera:
        raise InputError("no board is to be seen by this camera; give one (cameras of the boards)")
    try:
        if len(boards_of_camera) > 1:
            return measure_board_set(files, boards_of_camera, progress)
        ((name, board),) = boards_of_camera.items()
        views = measure_boards(files, board, progress, one_size=True)
        return views if len(boards) == 1 else join_views({name: views})
    except InputError as error:
        other_boards = {
            name: other_board
            for name, other_board in boards.items()
            if name not in boards_of_camera
        }
        if (board_seen := _board_in_photographs(files, other_boards)) is None:
            raise
        raise InputError(
            f"{error}. But they show board {board_seen!r}, which other cameras are to see: are the "
            "folders swapped? Give the folders, or the cameras of the boards, in the right order"
        ) from None


def _board_in_photographs(
    files: Sequence[str | Path], other_boards: Mapping[str, Board]
) -> str | None:
    """A board that the photographs show, of those that are not to be there."""
    for name, board in other_boards.items():
        try:
            measure_boards(photographs(files)[:MAX_LOOKED_AT], board)
        except InputError:
            continue
        return name
    return None


# Photographs searched for the boards of other cameras, for a message: swapped folders show them
# everywhere.
MAX_LOOKED_AT = 5


def _require_views(views_by_board: Mapping[Any, Any]) -> Mapping[str, BoardViews]:
    for name, views in views_by_board.items():
        if not isinstance(views, BoardViews):
            raise InputError(f"views of board {show(name)} are {show(views)}; expected BoardViews")
    return views_by_board


def _refuse_same_files(sources: Mapping[str, Any]) -> None:
    """Refuse a folder that is given for two cameras."""
    owner: dict[Path, str] = {}
    for name, source in sources.items():
        if isinstance(source, BoardViews | Calibration | Mapping):
            continue
        files = [source] if isinstance(source, str | Path) else source
        if not isinstance(files, Sequence):
            continue
        for path in photographs(files):
            first_owner = owner.setdefault(path.resolve(), name)
            if first_owner != name:
                raise InputError(
                    f"{path} is given for camera {first_owner!r} and for camera {name!r}; expected "
                    "photographs of its own for each camera: one folder a camera"
                )
