"""Files replaced completely or not at all: written under a temporary name beside, then renamed."""

import errno
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from jaxbundle.errors import InputError
from jaxbundle.system.temporaries import defer_interrupts, temporary

DISK_FULL = (errno.ENOSPC, errno.EDQUOT)


@contextmanager
def replace_file(path: str | Path) -> Iterator[Path]:
    """The temporary name of one file, as `replace_files`."""
    with replace_files(path) as (temporary,):
        yield temporary


@contextmanager
def replace_files(*paths: str | Path) -> Iterator[tuple[Path, ...]]:
    """Temporary names, beside some files, to write to; at the end they are renamed to the files.

    If writing fails, none is renamed and the temporary files are removed; existing files
    are unchanged. Several files are renamed in sequence: if the system refuses a
    later one (a read-only file), the earlier files are new and the message
    names the refused one. A link stays a link: its target is replaced.

    **Raises:** `InputError` for disk errors, and if the path exists but is not a file.
    """
    real_paths = [Path(os.path.realpath(path)) for path in paths]
    for path, target in zip(paths, real_paths):
        if target.exists() and not target.is_file():
            raise InputError(f"{path}: cannot be written: it is not a file; give another name")
    # Names have 255 bytes at most: 60 characters of up to 4 leave room for the rest.
    names = tuple(
        target.with_name(f".{target.stem[:60]}.{os.getpid()}{target.suffix}")
        for target in real_paths
    )
    with ExitStack() as cleanup:
        for name in names:
            cleanup.enter_context(temporary(name))
        try:
            yield names
            with defer_interrupts():
                for name, target in zip(names, real_paths):
                    os.replace(name, target)
        except OSError as error:
            path_of_name = dict(zip(map(str, names), paths))
            raise unwritable(path_of_name.get(str(error.filename), paths[0]), error) from None
        except InputError as error:
            message = str(error)
            for name, path in zip(names, paths):
                message = message.replace(str(name), str(path))
            raise InputError(message) from None


def remove_left_behind(path: str | Path) -> None:
    """Remove what killed processes have left of a file that they wrote: a large map takes the place
    of the next one. Files of processes that still run are kept, and all where it is not known."""
    target = Path(os.path.realpath(path))
    if os.name != "posix" or not target.parent.is_dir():
        return
    pattern = re.compile(rf"\.{re.escape(target.stem[:60])}\.(\d+){re.escape(target.suffix)}")
    for name in os.listdir(target.parent):
        match = pattern.fullmatch(name)
        if match is not None and not _is_running(int(match[1])):
            with suppress(OSError):
                os.unlink(target.with_name(name))


def _is_running(process: int) -> bool:
    """Whether there is a process with this number."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def unwritable(path: str | Path, error: OSError) -> InputError:
    """Why a file or folder cannot be written, in one line; a full disk is named."""
    reason = error.strerror or " ".join(str(error).split())
    if isinstance(error, FileNotFoundError) and not Path(path).absolute().parent.is_dir():
        reason = f"there is no folder {Path(path).parent}"
    is_full = error.errno in DISK_FULL and (os.path.isfile(path) or not os.path.exists(path))
    return InputError(f"{path}: cannot be written: {reason}{disk_of(path) if is_full else ''}")


def disk_of(path: str | Path) -> str:
    """The disk of a file and its free space, as the end of a message."""
    folder = Path(os.path.realpath(path))
    while not folder.exists():
        folder = folder.parent
    free_bytes = shutil.disk_usage(folder).free
    while not os.path.ismount(folder):
        folder = folder.parent
    return f"; {free_bytes / 1e6:.6g} MB are free on the disk at {folder}"
