"""Several boards in the photographs of one camera: each photograph shows any of them.

The views of one board are independent images of it (`BoardViews`); those of several are joined into
the views of one `BoardSet`, whose points are those of all boards, each in the frame of its own. A
view is one board in one photograph: a photograph of two boards has two views.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.measure.boards import Board, BoardSet, require_board
from jaxbundle.measure.views import (
    SEARCHING,
    BoardViews,
    Look,
    collect_views,
    name_photographs,
    photographs,
    refuse_sizes,
    search_board,
    searches_at_once,
)
from jaxbundle.network.columns import list_some
from jaxbundle.system.threads import map_in_threads
from jaxbundle.types import Progress


def join_views(views: Mapping[str, BoardViews]) -> BoardViews:
    """The views of several boards by one camera as views of a `BoardSet`.

    **Arguments:** by the name of the board its views, which are named as their photographs.

    **Returns:** views "PHOTOGRAPH:BOARD", sorted by the names of the photographs; `photographs`:
    theirs; `failures`: the photographs without any board.

    **Raises:** `InputError` if image sizes differ.
    """
    sizes = {name: views_of_board.image_size for name, views_of_board in views.items()}
    if len({*sizes.values()}) > 1:
        sizes_in_words = ", ".join(f"{c} × {r} of {name!r}" for name, (c, r) in sizes.items())
        raise InputError(
            f"views of boards have different image sizes: {sizes_in_words}; expected photographs "
            "of one camera, all of one size"
        )
    known_boards = require_boards(
        {name: views_of_board.board for name, views_of_board in views.items()}
    )
    boards = BoardSet(tuple(known_boards), tuple(known_boards.values()))
    rows, number = [], boards.number
    for b, views_of_board in enumerate(views.values()):
        for name, xy in zip(views_of_board.names, views_of_board.xy):
            xy_of_all = np.full((len(number), 2), np.nan)
            xy_of_all[number == b] = xy
            rows.append((name, b, xy_of_all))
    rows.sort(key=lambda row: row[0])  # stable: the boards of a photograph in their order
    seen_photographs, failures = {name for name, _, _ in rows}, {}
    for board, views_of_board in views.items():
        for name, why in views_of_board.failed:
            if name not in seen_photographs:
                failures.setdefault(name, f"{board}: {why}")
    return BoardViews(
        boards,
        tuple(f"{name}:{boards.names[b]}" for name, b, _ in rows),
        next(iter(sizes.values())),
        np.array([xy for _, _, xy in rows]).reshape(-1, len(number), 2),
        tuple(failures.items()),
        tuple(warning for views_of_board in views.values() for warning in views_of_board.warnings),
        tuple(note for views_of_board in views.values() for note in views_of_board.notes),
        photographs=tuple(name for name, _, _ in rows),
    )


def measure_board_set(
    paths: Sequence[str | Path], boards: Mapping[str, Board], progress: Progress | None = None
) -> BoardViews:
    """Find any of several boards in the photographs of one camera.

    **Arguments:** `paths`: files, patterns, folders; `boards` by name; `progress(stage, done,
    total)`.

    **Returns:** the views of a `BoardSet` of those boards that were found.

    **Raises:** `InputError` if photographs have different sizes, none shows a board, or a name of a
    board has a colon.
    """
    boards = require_boards(boards)
    file_of = name_photographs(photographs(paths))
    if not file_of:
        raise InputError("no photographs are given")
    tasks = [(name, board) for name in file_of for board in boards]

    def search(task: tuple[str, str]) -> Look:
        name, board = task
        return search_board(file_of[name], boards[board])

    def tell(done: int) -> None:
        if progress is not None and done % len(boards) == 0:
            progress(SEARCHING, done // len(boards), len(file_of))

    # As many at once as of the board whose search takes most memory.
    at_once = min(
        searches_at_once([*file_of.values()], searched_board) for searched_board in boards.values()
    )
    looks = dict(zip(tasks, map_in_threads(search, tasks, at_once, tell)))
    refuse_sizes({name: look[0] for (name, _), look in looks.items() if not isinstance(look, str)})
    views = {}
    for board, searched_board in boards.items():
        looks_of_board = {name: looks[name, board] for name in file_of}
        if all(isinstance(look, str) for look in looks_of_board.values()):
            continue
        views[board] = collect_views(file_of, looks_of_board, searched_board, hints=False)
    if not views:
        name = next(iter(file_of))
        why = "; ".join(f"{board}: {looks[name, board]}" for board in boards)
        raise InputError(
            f"no photograph of {len(file_of)} shows one of the boards {list_some(boards, 6)}: "
            f"{file_of[name]}: {why}"
        )
    return join_views(views)


def require_boards(boards: Any) -> dict[str, Board]:
    """Boards by name.

    **Raises:** `InputError` about another argument.
    """
    if not isinstance(boards, Mapping) or not boards:
        raise InputError(
            f"boards must be by name, such as {{'wall': Board(9, 6, 0.03)}}, but is {show(boards)}"
        )
    for name in boards:
        if not isinstance(name, str) or not name or ":" in name:
            raise InputError(f"board {show(name)}: expected a name without a colon")
    return {name: require_board(board) for name, board in boards.items()}
