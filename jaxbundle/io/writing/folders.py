"""Folders of results: written completely or not at all, and only over results of the same command.

A folder has a marker, `.jaxbundle`: JSON that names the command and lists its files, each with a
digest. A folder is written if it is new, or empty, or its marker is of the same command and the
listed files are unchanged. Anything else requires `force`, which replaces the files listed by the
marker and named by the refusal. Other files are never touched.

    .FOLDER.jaxbundle/new    the new result, until it is complete
    .FOLDER.jaxbundle/ready  the same, while its files and those it replaces are exchanged
    .FOLDER.jaxbundle/old    the files it replaces
    FOLDER/.jaxbundle.work   the same, if nothing can be created or moved beside the folder

A new folder is `ready`, renamed. Otherwise the old files are moved to `old`, the marker first, and
then the new ones to the folder, the marker last: only by renames, which work on a full disk. Old
and new files are never mixed. If the program ends in between, the next command that writes to the
folder first completes or reverts the exchange (`recover`): with the new marker in place it removes
`old`, else it moves everything back.
"""

import fnmatch
import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from jaxbundle.errors import InputError
from jaxbundle.io.writing.locks import hold_lock
from jaxbundle.io.writing.replacing import unwritable
from jaxbundle.network.columns import list_some
from jaxbundle.system.temporaries import defer_interrupts, temporary

MARKER, INSIDE = ".jaxbundle", ".jaxbundle.work"
NEW, READY, OLD = "new", "ready", "old"


class Marker(NamedTuple):
    """The content of a folder's marker: the command, and the digest of every file by name."""

    by: str
    files: Mapping[str, str]


def check_folder(
    folder: Path,
    command: str,
    names: Iterable[str],
    inputs: Iterable[str | Path] = (),
    force: bool = False,
    option: str = "--out",
) -> None:
    """Refuse a folder that the command `command` cannot or may not write (see the module's
    docstring), before anything is computed.

    **Arguments:** `names`: files to write, as names or patterns with `*`; `inputs`: input files,
    which are never replaced; `option`: the option that gave the folder, for messages.

    **Raises:** `InputError`.
    """
    names, folder_in_words = tuple(names), f"{option} {folder}".lstrip()
    _check_place(folder, folder_in_words)
    real = Path(os.path.realpath(folder))
    recover(folder)
    marker = read_marker(real)
    for path in (Path(os.path.realpath(file)) for file in inputs):
        name = path.relative_to(real).as_posix() if path.is_relative_to(real) else ""
        is_known = marker is not None and name in marker.files
        if is_known or any(fnmatch.fnmatchcase(name, pattern) for pattern in names):
            raise InputError(f"{path} is part of the input and would be overwritten; give another")
    if not force:
        _refuse_others(folder, real, command, names, folder_in_words)


@contextmanager
def replace_folder(
    folder: str | Path, by: str, names: Iterable[str], force: bool = False
) -> Iterator[Path]:
    """An empty folder to fill, which then replaces `folder` or its files.

    After a failure or an interrupt it is removed, and `folder` is unchanged. Arguments as of
    `check_folder`; `force` replaces existing files among the names.

    **Raises:** `InputError` if the folder may not or cannot be written.
    """
    folder = Path(folder)
    real = Path(os.path.realpath(folder))
    _check_place(folder, str(folder))
    recover(folder)
    if not force:
        _refuse_others(folder, real, by, tuple(names), str(folder))
    new = Path(NEW)
    with ExitStack() as until:
        try:
            for parent in [p for p in real.parents if not p.exists()][::-1]:
                until.enter_context(temporary(parent, content=False)).mkdir()
            with defer_interrupts():
                work = until.enter_context(temporary(_make_work(real), content=False))
            new = work / NEW
            # From here on a second command on this folder is refused.
            until.enter_context(_hold_work(folder, work))
            until.enter_context(temporary(new)).mkdir()
            yield new
            _replace(folder, real, work, by, tuple(names), force)
        except OSError as error:
            at = str(error.filename)
            at = at.replace(str(new), str(folder)) if at.startswith(str(new)) else folder
            raise unwritable(at, error) from None
        except InputError as error:
            raise InputError(str(error).replace(str(new), str(folder))) from None


def recover(folder: str | Path) -> None:
    """Complete or revert the exchange of a command that was ended while writing the folder."""
    real = Path(os.path.realpath(folder))
    for work in _works(real):
        if work.is_dir() and not work.is_symlink():
            try:
                with _hold_work(folder, work):
                    _settle(work, real)
            except OSError as error:
                raise unwritable(folder, error) from None
            with suppress(OSError):
                work.rmdir()


def read_marker(folder: Path) -> Marker | None:
    """The marker of a folder; None if it is missing or unreadable."""
    try:
        document = json.loads((folder / MARKER).read_bytes())
        files = {str(name): str(digest) for name, digest in document["files"].items()}
        return Marker(
            str(document["command"]),
            {name: digest for name, digest in files.items() if _is_inside(folder, name)},
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None


def _is_inside(folder: Path, name: str) -> bool:
    """Whether a name cannot lead out of the folder, upwards or by a link."""
    pure = PurePosixPath(name)
    safe = pure.parts and not pure.is_absolute() and ".." not in pure.parts and "\0" not in name
    return bool(safe) and not any(os.path.islink(folder / part) for part in [*pure.parents][:-1])


def _check_place(folder: Path, said: str) -> None:
    """Refuse paths that are not folders, or cannot be created or written."""
    there = next((p for p in (folder, *folder.absolute().parents) if os.path.lexists(p)), folder)
    # A link to nothing is not followed: the folder is made where it points.
    dangling = there == folder and os.path.islink(there) and not os.path.exists(there)
    if not os.path.isdir(there) and not dangling:
        raise InputError(f"{said}: cannot be made: {there} is not a folder")
    if os.path.isdir(there) and not os.access(there, os.W_OK | os.X_OK):
        raise InputError(f"{said}: cannot be written: no permission in {there}")


def _refuse_others(folder: Path, real: Path, by: str, names: Sequence[str], said: str) -> None:
    """Refuse folders of other commands, and other files among `names`."""
    marker, entries = read_marker(real), _entries(real)
    if not entries:
        return
    own = marker.files if marker else {}
    taken = [str(folder / name) for name in _list_taken(real, names, own)]
    most = (
        40  # names in a message: those of a project or a result in full, not of a thousand figures
    )
    listed = list_some(taken, most, str)
    way = "give a new folder, or --force (force=True in Python) to"
    if marker is None and taken:
        raise InputError(
            f"{said}: not a folder of jaxbundle {by}: {listed}: already there; {way} replace "
            f"{'it' if len(taken) == 1 else 'them'}"
        )
    if marker is None:
        raise InputError(
            f"{said}: not a folder of jaxbundle {by}: it contains {list_some(entries, 3, str)}; "
            f"{way} write into it all the same"
        )
    if marker.by != by:
        there = [str(folder / name) for name in own if os.path.lexists(real / name)]
        raise InputError(
            f"{said}: a folder of jaxbundle {marker.by}, not {by}; {way} replace "
            f"{list_some([*there, *taken], most, str)}"
        )
    changed = [str(folder / n) for n, d in own.items() if _digest(real / n) not in (None, d)]
    if changed or taken:
        raise InputError(
            f"{said}: {list_some([*changed, *taken], most, str)}: already there, and not as "
            f"jaxbundle {by} wrote it; {way} replace it"
        )


def _entries(real: Path) -> list[str]:
    try:
        return sorted({*os.listdir(real)} - {MARKER, INSIDE})
    except FileNotFoundError:
        return []


def _list_taken(real: Path, names: Sequence[str], own: Iterable[str]) -> list[str]:
    """Existing files among `names`, except those listed by the marker."""
    found = {}
    for name in names:
        paths = real.glob(name) if "*" in name else [real / name]
        found |= {p.relative_to(real).as_posix(): None for p in paths if os.path.lexists(p)}
    return [name for name in found if name not in own]


def _digest(path: Path) -> str | None:
    """Digest of the content of a file; None if it is missing, empty for anything else."""
    if not os.path.lexists(path):
        return None
    # Equal to no digest of a marker: whoever put it there did not mean to lose it.
    if path.is_symlink() or not path.is_file():
        return ""
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=8)).hexdigest()


def _works(real: Path) -> tuple[Path, Path]:
    return real.with_name(f".{real.name}.jaxbundle"), real / INSIDE


def _make_work(real: Path) -> Path:
    """The folder for the new and the old files: beside, if files can be moved from there
    to the folder, which may be on another disk; else inside."""
    folder_beside, folder_inside = _works(real)
    if not real.is_dir():
        # There is nothing yet that could be inside it.
        folder_beside.mkdir(exist_ok=True)
        return folder_beside
    folder_inside.mkdir(exist_ok=True)
    try:
        folder_inside.rename(folder_beside)
    except OSError:
        return folder_inside
    return folder_beside


def _hold_work(folder: str | Path, work: Path) -> AbstractContextManager[None]:
    # Without locks (some network disks) two commands on one folder are the user's risk.
    return hold_lock(work / "run", folder, needed=False)


def _replace(
    folder: Path, real: Path, work: Path, command: str, names: Sequence[str], force: bool
) -> None:
    """Replace the old files by the complete new ones."""
    new = work / NEW
    files = {name: _digest(new / name) for name in _files(new)}
    about = f"Files that jaxbundle {command} has written here, and may replace."
    text = json.dumps(
        {"about": about, "command": command, "files": files}, ensure_ascii=False, indent=1
    )
    (new / MARKER).write_text(text + "\n", encoding="utf-8")
    files_to_remove = []
    if real.exists():
        if not force:
            _refuse_others(folder, real, command, (*files, *names), str(folder))
        marker = read_marker(real)
        own_files = [
            name for name in (marker.files if marker else ()) if os.path.lexists(real / name)
        ]
        files_to_remove = [*own_files, *_list_taken(real, names, own_files)]
        for name in (*files, *files_to_remove):
            _check_way(real, name)
            if os.path.lexists(real / name) and name not in files_to_remove:
                raise InputError(f"{folder / name}: already there; give a new folder")
    try:
        with ExitStack() as cleanup:
            with defer_interrupts():
                _exchange(real, work, files, files_to_remove)
                for name in (OLD, READY):
                    cleanup.enter_context(temporary(work / name))
    except BaseException:
        _settle(work, real)
        raise


def _exchange(real: Path, work: Path, files: Iterable[str], files_to_remove: Sequence[str]) -> None:
    """Replace old files by the new ones, all or none."""
    new, old = work / READY, work / OLD
    os.rename(work / NEW, new)  # from here on `recover` knows that the new files are complete
    if not real.exists():
        os.rename(new, real)
        return
    try:
        old.mkdir()
        for name in ([MARKER] if os.path.lexists(real / MARKER) else []) + [*files_to_remove]:
            _move(real, old, name)
        for name in (*files, MARKER):
            _move(new, real, name)
    except BaseException:
        _move_back(work, real)
        raise
    for name in files_to_remove:
        # Folders that the old result needed, if nothing else is in them.
        for parent in [*PurePosixPath(name).parents][:-1]:
            with suppress(OSError):
                (real / parent).rmdir()


def _check_way(real: Path, name: str) -> None:
    """Refuse to write through links and files, or over folders."""
    pure = PurePosixPath(name)
    for parent in [*pure.parents][:-1]:
        path = real / parent
        if path.is_symlink() or (path.exists() and not path.is_dir()):
            raise InputError(f"{path}: a folder would be written there; move it away")
    if (real / pure).is_dir() and not (real / pure).is_symlink():
        raise InputError(f"{real / pure}: is a folder; a file would be written there; move it away")


def _move_back(work: Path, real: Path) -> None:
    """Move the old files back, unless the new ones are all in place."""
    new, old = work / READY, work / OLD
    if old.is_dir() and (marker := read_marker(new)):
        for name in marker.files:
            if not os.path.lexists(new / name) and os.path.lexists(real / name):
                _move(real, new, name)
        for name in [*_files(old)]:
            _move(old, real, name)


def _settle(work: Path, real: Path) -> None:
    """Move the old files back, unless the new ones are all in place; remove the rest."""
    _move_back(work, real)
    for name in (NEW, READY, OLD):
        shutil.rmtree(work / name, ignore_errors=True)


def _files(folder: Path) -> list[str]:
    """All files below a folder, the marker last."""
    files_found = [
        Path(root, name).relative_to(folder).as_posix()
        for root, _, names in os.walk(folder)
        for name in names
    ]
    # The marker declares the others to be there, so that it must not come before them.
    return sorted(files_found, key=lambda name: (name == MARKER, name))


def _move(source: Path, target: Path, name: str) -> None:
    (target / name).parent.mkdir(parents=True, exist_ok=True)
    os.rename(source / name, target / name)
