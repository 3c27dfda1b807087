"""A board measured in many photographs; failed photographs are listed, the others are used."""

import dataclasses
import glob
import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from math import prod
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.arguments import numeric_array
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.float64 import enable_x64
from jaxbundle.measure.boards import Board, BoardSet, require_board
from jaxbundle.measure.corners import (
    find_board_points,
    largest_chessboard,
    memory_of_search,
    other_sizes,
)
from jaxbundle.network.columns import count
from jaxbundle.photographs.concurrent import photographs_at_once
from jaxbundle.photographs.folders import list_photographs
from jaxbundle.photographs.formats import SUFFIXES
from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.photographs.reading import image_errors, photograph_size, read_photograph
from jaxbundle.system.file_content import read_content
from jaxbundle.system.threads import map_in_threads
from jaxbundle.types import Progress

# The stage in reports of progress.
SEARCHING = "searching the board"
# Number of photographs searched for boards of other sizes: those without a board, if few have it,
# and the others, whether their board is a part of a larger one. A search takes longest where there
# is nothing to find; most of three decide about a larger board.
MAX_SEARCHED = 3

# Search result of a board in a photograph: image size and image points, or why none.
Look = tuple[tuple[int, int], Float[np.ndarray, "points 2"]] | str
HINT = "give --"


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class BoardViews:
    """The measurements of a board: image points of every view, and failed photographs.

    **Fields:** `names` of the views; `image_size` (columns, rows); `xy` pixels, NaN for missing
    points; `failed`: name and reason of every photograph not used; `warnings`: probable
    mistakes; `notes`: what was found otherwise than usual; `photographs`: of several boards (a
    `BoardSet`) the photograph of every view, otherwise `names`.
    """

    board: Board | BoardSet
    names: tuple[str, ...]
    image_size: tuple[int, int]
    xy: Float[np.ndarray, "views points 2"]
    failed: tuple[tuple[str, str], ...] = ()
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    photographs: tuple[str, ...] = ()

    def __post_init__(self):
        if not isinstance(self.board, BoardSet):
            require_board(self.board)
        if isinstance(self.names, str) or not isinstance(self.names, Sequence | np.ndarray):
            raise InputError(f"names must be a list, one for each view, but is {self.names!r:.60}")
        object.__setattr__(self, "names", tuple(map(str, self.names)))
        if len({*self.names}) < len(self.names):
            raise InputError("names of the views must differ, but some occur twice")
        object.__setattr__(self, "photographs", tuple(self.photographs) or self.names)
        if len(self.photographs) != len(self.names):
            raise InputError(
                f"photographs: {len(self.photographs)} are given for {len(self.names)} views; "
                "expected one for each view, or none"
            )
        xy = numeric_array("xy", self.xy, "pixels [views, points, 2]").astype(float)
        object.__setattr__(self, "xy", xy)
        points = len(self.board.ids)
        if np.shape(self.xy) != (len(self.names), points, 2):
            raise InputError(
                f"image points of {len(self.names)} views of a board of {points} points must have "
                f"the shape [{len(self.names)}, {points}, 2], but have {np.shape(self.xy)}"
            )
        size = self.image_size
        try:
            good = np.shape(size) == (2,) and all(0 < n < np.inf for n in size)
        except (TypeError, ValueError):
            good = False
        if not good:
            raise InputError(f"image_size must be columns and rows, but is {size!r:.60}")

    def __len__(self) -> int:
        return len(self.names)

    @property
    def visible(self) -> Bool[np.ndarray, "views points"]:
        """Which points were found."""
        return np.all(np.isfinite(self.xy), axis=2)

    @property
    def possible(self) -> int:
        """Number of points of the boards of all views, found or not."""
        if isinstance(self.board, BoardSet):
            sizes = np.bincount(self.board.number)
            return int(sizes[self.board.seen(self.visible)].sum())
        return self.visible.size

    @property
    def centres(self) -> Float[np.ndarray, "views 3"]:
        """The centre of the board of every view, in the frame of its board, object unit."""
        if isinstance(self.board, BoardSet):
            middle = np.array([board.points.mean(0) for board in self.board.boards])
            return middle[self.board.seen(self.visible)]
        return np.broadcast_to(self.board.points.mean(0), (len(self), 3))

    def take(
        self, rows: Bool[np.ndarray, " views"] | Int[np.ndarray, " rows"], why: str = ""
    ) -> "BoardViews":
        """Some of the views (a mask or indices); the others count as failed if `why` is given."""
        keep = np.zeros(len(self), bool)
        keep[rows] = True
        out = [(name, why) for name, is_kept in zip(self.names, keep) if not is_kept and why]
        names = tuple(name for name, is_kept in zip(self.names, keep) if is_kept)
        photographs = tuple(name for name, is_kept in zip(self.photographs, keep) if is_kept)
        return dataclasses.replace(
            self,
            names=names,
            xy=self.xy[keep],
            failed=(*self.failed, *out),
            photographs=photographs,
        )


def photographs(sources: Sequence[str | Path]) -> list[Path]:
    """Files of paths, patterns (`left/*.jpg`) and folders, each once and in order.

    **Raises:** `InputError` if a pattern or a folder has none.
    """
    files_found: dict[Path, None] = {}
    for item in sources:
        path = Path(item)
        if path.is_dir():
            files = list_photographs(path)
            if not files:
                raise InputError(f"{path}: no photographs in this folder ({', '.join(SUFFIXES)})")
        elif not path.exists() and any(c in str(item) for c in "*?["):
            files = sorted(map(Path, glob.glob(str(item))))
            if not files:
                raise InputError(f"{item}: no file matches this pattern")
        else:
            files = [path]
        files_found |= dict.fromkeys(files)
    return list(files_found)


def measure_boards(
    paths: Sequence[str | Path],
    board: Board,
    progress: Progress | None = None,
    one_size: bool = False,
) -> BoardViews:
    """Find a board in photographs.

    **Arguments:** `paths`: files, patterns, folders; `progress(stage, done, total)`; `one_size`:
    refuse photographs of several sizes.

    **Returns:** the views of the board with the most frequent image size.

    **Raises:** `InputError` if no photograph shows the board.
    """
    files = photographs(paths)
    if not files:
        raise InputError("no photographs are given")
    file_of = name_photographs(files)
    repeated = _find_repeated(file_of)

    def search(name: str) -> tuple[Look, bool]:
        return (repeated[name], False) if name in repeated else _search(file_of[name], board)

    looks, negatives = {}, {}

    def tell(done: int) -> None:
        if progress is not None:
            progress(SEARCHING, done, len(file_of))

    searched = map_in_threads(search, file_of, searches_at_once(files, board), tell)
    for name, (look, negative) in zip(file_of, searched):
        looks[name], negatives[name] = look, negative
    if one_size:
        refuse_sizes({name: look[0] for name, look in looks.items() if not isinstance(look, str)})
    views = collect_views(file_of, looks, board)
    of_negatives = sum(negatives[name] for name in views.names)
    notes = (
        f"light squares on dark ground, the negative of the usual board, in {of_negatives} of "
        f"{len(views)} photographs",
    ) * bool(of_negatives)
    warnings = _part_of_a_larger(file_of, views.names, board)
    return dataclasses.replace(views, warnings=warnings, notes=notes)


def collect_views(
    file_of: Mapping[str, Path], looks: Mapping[str, Look], board: Board, hints: bool = True
) -> BoardViews:
    """The views of searched photographs, with the most frequent image size.

    **Arguments:** `file_of`: the photographs by name (`name_photographs`); `looks`: the result of
    `search_board` of each.

    **Raises:** `InputError` if no photograph shows the board.
    """
    failures = {name: look for name, look in looks.items() if isinstance(look, str)}
    views_found = [(name, *look) for name, look in looks.items() if not isinstance(look, str)]
    if hints and len(views_found) < len(looks) / 2:
        failures |= _other_boards(file_of, board, failures)
    if not views_found:
        raise InputError(_nothing_found(file_of, failures))
    sizes = Counter(size for _, size, _ in views_found)
    size = sizes.most_common(1)[0][0]
    for name, image_size, _ in views_found:
        if image_size != size:
            hint = ": it was rotated after exposure" if image_size == size[::-1] else ""
            failures[name] = (
                f"has {image_size[0]} × {image_size[1]} pixels, most have {size[0]} × "
                f"{size[1]}{hint}"
            )
    used_views = [(name, xy) for name, image_size, xy in views_found if image_size == size]
    failures |= _find_saved_again(used_views)
    used_views = [(name, xy) for name, xy in used_views if name not in failures]
    order = {name: i for i, name in enumerate(file_of)}
    return BoardViews(
        board,
        tuple(name for name, _ in used_views),
        size,
        np.array([xy for _, xy in used_views]),
        tuple(sorted(failures.items(), key=lambda item: order[item[0]])),
    )


def refuse_sizes(sizes: Mapping[str, tuple[int, int]]) -> None:
    """Refuse photographs of more than one size, such as of two cameras in one folder.

    **Arguments:** columns and rows by the name of the photograph.

    **Raises:** `InputError` naming a photograph of each size.
    """
    numbers = Counter(sizes.values())
    if len(numbers) < 2:
        return
    first_of_size = {
        size: next(name for name, size_of_photograph in sizes.items() if size_of_photograph == size)
        for size in numbers
    }
    sizes_in_words = ", ".join(
        f"{count(number, 'photograph')} of {columns} × {rows} pixels "
        f"({first_of_size[columns, rows]})"
        for (columns, rows), number in numbers.most_common()
    )
    raise InputError(
        f"photographs have different sizes: {sizes_in_words}; expected those of one camera, all of "
        "one size: move the others to a folder of their own"
    )


def search_board(path: str | Path, board: Board) -> Look:
    """Image size (columns, rows) and image points of a board in one photograph, or the reason of a
    failure, without the path."""
    return _search(path, board)[0]


def _search(path: str | Path, board: Board) -> tuple[Look, bool]:
    """The search result, and whether the board is a negative."""
    try:
        with image_errors(path):
            grey = read_photograph(path)
            points_found = find_board_points(grey, board)
        return ((grey.shape[1], grey.shape[0]), points_found.xy), points_found.negative
    except InputError as error:
        return str(error).removeprefix(f"{path}: "), False


def searches_at_once(files: Sequence[str | Path], board: Board, base: float = 0.0) -> int:
    """In how many photographs a board can be searched at once; `base`: bytes that each search takes
    besides, in a process of its own."""
    sizes = []
    for path in files:
        with suppress(InputError):
            sizes.append(photograph_size(path))
    columns, rows = max(sizes, key=prod, default=(0, 0))
    need = memory_of_search(rows, columns, board.kind)
    return photographs_at_once(rows * columns, base + need)


def search_alone(task: tuple[str | Path, Board]) -> Look:
    """`search_board` in a separate process, one of several on this machine."""
    enable_x64()
    need_opencv().setNumThreads(1)
    return search_board(*task)


def _find_repeated(paths: Mapping[str, Path]) -> dict[str, str]:
    """The files with the content of an earlier one, and the earlier one."""
    first_of_content: dict[bytes, str] = {}
    repeated = {}
    for name, path in paths.items():
        try:
            content = read_content(path, text=False)
        except InputError:
            continue
        earlier = first_of_content.setdefault(hashlib.blake2b(content).digest(), name)
        if earlier != name and content:
            repeated[name] = f"is the same file as {earlier}"
    return repeated


def _find_saved_again(used_views: Sequence[tuple[str, np.ndarray]]) -> dict[str, str]:
    """Views with the same points as an earlier one: one photograph in another
    compression or format.

    JPEG at quality 70 moves corners by 0.015 pixels (RMS); two photographs of one pose, with noise
    of their own, agree to 0.022 and more (real ones, a contrast of 100 grey values)."""
    repeated: dict[str, str] = {}
    for i, (name, xy) in enumerate(used_views):
        for earlier_name, earlier in used_views[:i]:
            distance = np.linalg.norm(xy - earlier, axis=1)
            in_both = np.isfinite(distance)
            if earlier_name in repeated or in_both.mean() < 0.8:  # most of the board
                continue
            rms = float(np.sqrt(np.mean(distance[in_both] ** 2)))
            if rms < 0.02:
                repeated[name] = (
                    f"shows the board where {earlier_name} does, to {rms:.1g} px: the same "
                    "photograph saved again, or another of the same pose; one is used"
                )
                break
    return repeated


def _nothing_found(paths: Mapping[str, Path], failures: Mapping[str, str]) -> str:
    """One line about photographs without a board, preferably about one with another board."""
    hinted = (name for name in failures if HINT in failures[name])
    first_failure = next(hinted, next(iter(failures)))
    reason = f"{paths[first_failure]}: {failures[first_failure]}"
    return f"no photograph of {len(failures)} shows the board: {reason}"


def _other_boards(
    paths: Mapping[str, Path], board: Board, failures: Mapping[str, str]
) -> dict[str, str]:
    """Reasons of some photographs without the board, with the size of another board in them."""
    sizes = {}
    for name in list(failures)[:MAX_SEARCHED]:
        try:
            sizes[name] = other_sizes(read_photograph(paths[name]), board)
        except InputError:
            continue
    if board.kind in ("charuco", "aprilgrid"):
        return {
            name: f"{failures[name]}. But {_markers_seen(other_board, board)}"
            for name, other_board in sizes.items()
            if other_board is not None
        }
    return {
        name: f"{failures[name]}. But there is one of {other_board.columns}x{other_board.rows}: "
        f"{HINT}board {other_board.columns}x{other_board.rows}, if it is seen whole"
        for name, other_board in sizes.items()
        if other_board is not None
    }


def _markers_seen(other_board: Board, board: Board) -> str:
    """The board that the markers seen tell, and what to give."""
    options = []
    if other_board.dictionary != board.dictionary:
        options.append(f"--dictionary {other_board.dictionary}")
    if (other_board.columns, other_board.rows) != (board.columns, board.rows):
        options.append(f"--board {other_board.columns}x{other_board.rows} (or more rows)")
    if other_board.first_marker != board.first_marker:
        options.append(f"--first-marker {other_board.first_marker}")
    return f"the markers seen are those of another board: give {', '.join(options)}"


def _part_of_a_larger(
    paths: Mapping[str, Path], used_views: Sequence[str], board: Board
) -> tuple[str, ...]:
    """A warning if most of some photographs show the same larger board; one may be wrong."""
    if board.kind != "chessboard":
        return ()
    searched = used_views[:MAX_SEARCHED]
    sizes = Counter(largest_chessboard(read_photograph(paths[name]), board) for name in searched)
    (larger_board, times), *_ = sizes.most_common(1) or [(None, 0)]
    if larger_board is None or times <= len(searched) / 2:
        return ()
    larger = larger_board.columns >= board.columns and larger_board.rows >= board.rows
    if not larger or larger_board == board:
        return ()
    size = f"{larger_board.columns}x{larger_board.rows}"
    return (
        f"the board of {board.columns}x{board.rows} is a part of a larger one, of {size} "
        f"({searched[0]}), and not the same part everywhere; if {size} is the board: {HINT}board "
        f"{size}",
    )


def name_photographs(files: Sequence[Path]) -> dict[str, Path]:
    """Photographs by file name, with as many folders as make the names unique."""
    for parts in range(1, max((len(p.parts) for p in files), default=0) + 1):
        names = ["/".join(p.parts[-parts:]) for p in files]
        if len({*names}) == len(names):
            return dict(zip(names, files))
    return {str(p): p for p in files}
