"""The packaged examples.

Their files are those of `examples/` in the repository: the wheel has copies of them in
`jaxbundle/examples` (pyproject.toml), the source tree has them next to the package.
"""

import os
import re
import shutil
from importlib.resources import as_file, files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import NamedTuple

from jaxbundle.errors import InputError
from jaxbundle.system.temporaries import temporary


class Example(NamedTuple):
    """Description of an example, and a first command, with FOLDER for its folder."""

    about: str
    command: str


# By name; pyproject.toml lists the same folders.
EXAMPLES = {
    "convergent4": Example(
        "four convergent photographs; exterior orientation, points and ten camera parameters",
        "jaxbundle adjust FOLDER/project.toml --out FOLDER-result",
    ),
    "board": Example(
        "thirteen photographs of a chessboard, to calibrate their camera (extra: images)",
        "jaxbundle calibrate FOLDER --board 9x6 --square 0.03 --out FOLDER-result",
    ),
    "line_scanner": Example(
        "a satellite's line scanner that rolls, to simulate, correct and measure",
        "jaxbundle pushbroom simulate FOLDER/flight.toml --out FOLDER-result",
    ),
}


def write_example(name: str, folder: str | Path) -> None:
    """Copy the files of an example into a new or empty folder.

    **Raises:** `InputError` for an unknown name, or a folder that cannot or may not be written.
    """
    if name not in EXAMPLES:
        raise InputError(f"no example {name!r}: expected one of {', '.join(EXAMPLES)}")
    target = Path(os.path.abspath(folder))
    if os.path.lexists(target) and not (target.is_dir() and not any(target.iterdir())):
        reason = "is not empty" if target.is_dir() else "is no folder"
        raise InputError(f"{folder}: {reason}; give a new folder")
    if not target.parent.is_dir():
        raise InputError(f"{folder}: there is no folder {target.parent}")
    try:
        with (
            as_file(_example_files(name)) as source,
            temporary(f"{target}.{os.getpid()}.new") as new,
        ):
            shutil.copytree(source, new)
            os.replace(new, target)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {_reason_of(error)}") from None


def _reason_of(error: OSError) -> str:
    """The reason of the system; `copytree` lists one for each file: source, copy, reason."""
    if isinstance(error, shutil.Error) and error.args and isinstance(error.args[0], list):
        return re.sub(r"^\[Errno \d+\] |: '.*", "", str(error.args[0][0][-1]))
    return error.strerror or str(error)


def _example_files(name: str) -> Traversable:
    """The files of an example, in the package or the source tree."""
    for folder in (files("jaxbundle") / "examples", Path(__file__).parents[2] / "examples"):
        if (folder / name).is_dir():
            return folder / name
    raise InputError(f"the files of example {name!r} are missing from this installation")
