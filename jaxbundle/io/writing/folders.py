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

    command: str
    files: Mapping[str, str]


def check_folder(
    folder: Path,
    command: str,
    names: Iterable[str],
    inputs: Iterable[str | Path] = (),
    force: bool = False,
    option: str = "--out",
) -> None:
    """Refuse a folder that the command cannot or may not write (see the module's docstring),
    before anything is computed.

    **Arguments:** `names`: files to write, as names or patterns with `*`; `inputs`: input files,
    which are never replaced; `option`: the option that gave the folder, for messages.

    **Raises:** `InputError`.
    """
    names, subject = tuple(names), f"{option} {folder}".lstrip()
    _check_location(folder, subject)
    real_folder = Path(os.path.realpath(folder))
    recover(folder)
    marker = read_marker(real_folder)
    for path in (Path(os.path.realpath(file)) for file in inputs):
        name = path.relative_to(real_folder).as_posix() if path.is_relative_to(real_folder) else ""
        is_listed = marker is not None and name in marker.files
        if is_listed or any(fnmatch.fnmatchcase(name, pattern) for pattern in names):
            raise InputError(f"{path} is part of the input and would be overwritten; give another")
    if not force:
        _refuse_foreign_files(folder, real_folder, command, names, subject)


def keep_inputs(subject: str, file: Path, inputs: Iterable[str | Path]) -> None:
    """Refuse a file to write that is an input, by real paths: an input may be named through a link.

    **Raises:** `InputError`, which begins with `subject`."""
    real = os.path.realpath(file)
    if any(real == os.path.realpath(input_file) for input_file in inputs):
        raise InputError(f"{subject}: is part of the input and would be overwritten; give another")


@contextmanager
def replace_folder(
    folder: str | Path, command: str, names: Iterable[str], force: bool = False
) -> Iterator[Path]:
    """An empty folder to fill, which then replaces `folder` or its files.

    After a failure or an interrupt it is removed, and `folder` is unchanged. Arguments as of
    `check_folder`; `force` replaces existing files among the names.

    **Raises:** `InputError` if the folder may not or cannot be written.
    """
    folder = Path(folder)
    real_folder = Path(os.path.realpath(folder))
    _check_location(folder, str(folder))
    recover(folder)
    if not force:
        _refuse_foreign_files(folder, real_folder, command, tuple(names), str(folder))
    new = Path(NEW)
    with ExitStack() as cleanup:
        try:
            for parent in [p for p in real_folder.parents if not p.exists()][::-1]:
                cleanup.enter_context(temporary(parent, content=False)).mkdir()
            with defer_interrupts():
                work = cleanup.enter_context(
                    temporary(_make_work_folder(real_folder), content=False)
                )
            new = work / NEW
            # From here on a second command on this folder is refused.
            cleanup.enter_context(_lock_work_folder(folder, work))
            cleanup.enter_context(temporary(new)).mkdir()
            yield new
            _replace(folder, real_folder, work, command, tuple(names), force)
        except OSError as error:
            failed_path = str(error.filename)
            failed_path = (
                failed_path.replace(str(new), str(folder))
                if failed_path.startswith(str(new))
                else folder
            )
            raise unwritable(failed_path, error) from None
        except InputError as error:
            raise InputError(str(error).replace(str(new), str(folder))) from None


def recover(folder: str | Path) -> None:
    """Complete or revert the exchange of a command that was ended while writing the folder."""
    real_folder = Path(os.path.realpath(folder))
    for work in _work_folders(real_folder):
        if work.is_dir() and not work.is_symlink():
            try:
                with _lock_work_folder(folder, work):
                    _finish_or_revert(work, real_folder)
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
    relative = PurePosixPath(name)
    safe = (
        relative.parts
        and not relative.is_absolute()
        and ".." not in relative.parts
        and "\0" not in name
    )
    return bool(safe) and not any(
        os.path.islink(folder / part) for part in [*relative.parents][:-1]
    )


def _check_location(folder: Path, subject: str) -> None:
    """Refuse paths that are not folders, or cannot be created or written."""
    existing = next((p for p in (folder, *folder.absolute().parents) if os.path.lexists(p)), folder)
    # A link to nothing is not followed: the folder is made where it points.
    is_dangling = existing == folder and os.path.islink(existing) and not os.path.exists(existing)
    if not os.path.isdir(existing) and not is_dangling:
        raise InputError(f"{subject}: cannot be made: {existing} is not a folder")
    if os.path.isdir(existing) and not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(f"{subject}: cannot be written: no permission in {existing}")


def _refuse_foreign_files(
    folder: Path, real_folder: Path, command: str, names: Sequence[str], subject: str
) -> None:
    """Refuse folders of other commands, and other files among `names`."""
    marker, entries = read_marker(real_folder), _list_entries(real_folder)
    if not entries:
        return
    marker_files = marker.files if marker else {}
    existing_files = [
        str(folder / name) for name in _list_existing(real_folder, names, marker_files)
    ]
    limit = (
        40  # names in a message: those of a project or a result in full, not of a thousand figures
    )
    files_text = list_some(existing_files, limit, str)
    remedy = "give a new folder, or --force (force=True in Python) to"
    if marker is None and existing_files:
        raise InputError(
            f"{subject}: not a folder of jaxbundle {command}: {files_text}: already there; "
            f"{remedy} replace {'it' if len(existing_files) == 1 else 'them'}"
        )
    if marker is None:
        raise InputError(
            f"{subject}: not a folder of jaxbundle {command}: it contains "
            f"{list_some(entries, 3, str)}; {remedy} write into it all the same"
        )
    if marker.command != command:
        old_files = [
            str(folder / name) for name in marker_files if os.path.lexists(real_folder / name)
        ]
        raise InputError(
            f"{subject}: a folder of jaxbundle {marker.command}, not {command}; {remedy} replace "
            f"{list_some([*old_files, *existing_files], limit, str)}"
        )
    changed = [
        str(folder / n)
        for n, d in marker_files.items()
        if _digest(real_folder / n) not in (None, d)
    ]
    if changed or existing_files:
        raise InputError(
            f"{subject}: {list_some([*changed, *existing_files], limit, str)}: already there, and "
            f"not as jaxbundle {command} wrote it; {remedy} replace it"
        )


def _list_entries(real_folder: Path) -> list[str]:
    try:
        return sorted({*os.listdir(real_folder)} - {MARKER, INSIDE})
    except FileNotFoundError:
        return []


def _list_existing(
    real_folder: Path, names: Sequence[str], marker_files: Iterable[str]
) -> list[str]:
    """Existing files among `names`, except those listed by the marker."""
    existing_names = {}
    for name in names:
        paths = real_folder.glob(name) if "*" in name else [real_folder / name]
        existing_names |= {
            p.relative_to(real_folder).as_posix(): None for p in paths if os.path.lexists(p)
        }
    return [name for name in existing_names if name not in marker_files]


def _digest(path: Path) -> str | None:
    """Digest of the content of a file; None if it is missing, empty for anything else."""
    if not os.path.lexists(path):
        return None
    # Equal to no digest of a marker: whoever put it there did not mean to lose it.
    if path.is_symlink() or not path.is_file():
        return ""
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=8)).hexdigest()


def _work_folders(real_folder: Path) -> tuple[Path, Path]:
    return real_folder.with_name(f".{real_folder.name}.jaxbundle"), real_folder / INSIDE


def _make_work_folder(real_folder: Path) -> Path:
    """The folder for the new and the old files: beside, if files can be moved from there
    to the folder, which may be on another disk; else inside."""
    sibling_folder, inner_folder = _work_folders(real_folder)
    if not real_folder.is_dir():
        # There is nothing yet that could be inside it.
        sibling_folder.mkdir(exist_ok=True)
        return sibling_folder
    inner_folder.mkdir(exist_ok=True)
    try:
        inner_folder.rename(sibling_folder)
    except OSError:
        return inner_folder
    return sibling_folder


def _lock_work_folder(folder: str | Path, work: Path) -> AbstractContextManager[None]:
    # Without locks (some network disks) two commands on one folder are the user's risk.
    return hold_lock(work / "run", folder, needed=False)


def _replace(
    folder: Path, real_folder: Path, work: Path, command: str, names: Sequence[str], force: bool
) -> None:
    """Replace the old files by the complete new ones."""
    new = work / NEW
    files = {name: _digest(new / name) for name in _list_files(new)}
    description = f"Files that jaxbundle {command} has written here, and may replace."
    text = json.dumps(
        {"about": description, "command": command, "files": files}, ensure_ascii=False, indent=1
    )
    (new / MARKER).write_text(text + "\n", encoding="utf-8")
    replaced_files = []
    if real_folder.exists():
        if not force:
            _refuse_foreign_files(folder, real_folder, command, (*files, *names), str(folder))
        marker = read_marker(real_folder)
        old_files = [
            name for name in (marker.files if marker else ()) if os.path.lexists(real_folder / name)
        ]
        replaced_files = [*old_files, *_list_existing(real_folder, names, old_files)]
        for name in (*files, *replaced_files):
            _check_target(real_folder, name)
            if os.path.lexists(real_folder / name) and name not in replaced_files:
                raise InputError(f"{folder / name}: already there; give a new folder")
    try:
        with ExitStack() as cleanup:
            with defer_interrupts():
                _exchange(real_folder, work, files, replaced_files)
                for name in (OLD, READY):
                    cleanup.enter_context(temporary(work / name))
    except BaseException:
        _finish_or_revert(work, real_folder)
        raise


def _exchange(
    real_folder: Path, work: Path, files: Iterable[str], replaced_files: Sequence[str]
) -> None:
    """Replace old files by the new ones, all or none."""
    new, old = work / READY, work / OLD
    os.rename(work / NEW, new)  # from here on `recover` knows that the new files are complete
    if not real_folder.exists():
        os.rename(new, real_folder)
        return
    try:
        old.mkdir()
        for name in ([MARKER] if os.path.lexists(real_folder / MARKER) else []) + [*replaced_files]:
            _move(real_folder, old, name)
        for name in (*files, MARKER):
            _move(new, real_folder, name)
    except BaseException:
        _move_back(work, real_folder)
        raise
    for name in replaced_files:
        # Folders that the old result needed, if nothing else is in them.
        for parent in [*PurePosixPath(name).parents][:-1]:
            with suppress(OSError):
                (real_folder / parent).rmdir()


def _check_target(real_folder: Path, name: str) -> None:
    """Refuse to write through links and files, or over folders."""
    relative = PurePosixPath(name)
    for parent in [*relative.parents][:-1]:
        path = real_folder / parent
        if path.is_symlink() or (path.exists() and not path.is_dir()):
            raise InputError(f"{path}: a folder would be written there; move it away")
    if (real_folder / relative).is_dir() and not (real_folder / relative).is_symlink():
        raise InputError(
            f"{real_folder / relative}: is a folder; a file would be written there; move it away"
        )


def _move_back(work: Path, real_folder: Path) -> None:
    """Move the old files back, unless the new ones are all in place."""
    new, old = work / READY, work / OLD
    if old.is_dir() and (marker := read_marker(new)):
        for name in marker.files:
            if not os.path.lexists(new / name) and os.path.lexists(real_folder / name):
                _move(real_folder, new, name)
        for name in [*_list_files(old)]:
            _move(old, real_folder, name)


def _finish_or_revert(work: Path, real_folder: Path) -> None:
    """Move the old files back, unless the new ones are all in place; remove the rest."""
    _move_back(work, real_folder)
    for name in (NEW, READY, OLD):
        shutil.rmtree(work / name, ignore_errors=True)


def _list_files(folder: Path) -> list[str]:
    """All files below a folder, the marker last."""
    paths = [
        Path(root, name).relative_to(folder).as_posix()
        for root, _, names in os.walk(folder)
        for name in names
    ]
    # The marker declares the others to be there, so that it must not come before them.
    return sorted(paths, key=lambda name: (name == MARKER, name))


def _move(source: Path, target: Path, name: str) -> None:
    (target / name).parent.mkdir(parents=True, exist_ok=True)
    os.rename(source / name, target / name)
