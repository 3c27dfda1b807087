"""Origin of a result: when it was computed, fingerprints of the input files, versions of the
software."""

import hashlib
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from jaxbundle.network.columns import count
from jaxbundle.system.file_content import is_plain

PACKAGES = ("jax", "jaxlib", "equinox", "lineax", "numpy", "scipy")


class InputFile(NamedTuple):
    """A file that was read: its name, bytes, and SHA-256."""

    name: str
    size: int
    sha256: str


class Origin(NamedTuple):
    """The origin of a result: the input files, the first of which names the project; further
    settings by displayed name; the date of the computation in words, empty: that of the page."""

    inputs: tuple[InputFile, ...] = ()
    settings: Mapping[str, object] = MappingProxyType({})
    computed: str = ""


UNKNOWN = Origin()


def fingerprint_files(paths: Iterable[str | Path]) -> tuple[InputFile, ...]:
    """The distinct readable regular files among these."""
    found: dict[str, InputFile] = {}
    for path in map(Path, paths):
        real = os.path.realpath(path)
        try:
            if real in found or not path.is_file() or not is_plain(path):
                continue
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
                found[real] = InputFile(str(path), os.fstat(file.fileno()).st_size, digest)
        except OSError:
            continue
    return tuple(found.values())


def stamp(files: Sequence[str], computed: str) -> list[str]:
    """What a page or report is of: the first input file, which is that of the project, in its
    folder, and the number of others; date; version."""
    from jaxbundle import __version__

    computed_and_version = [f"computed {computed}", f"jaxbundle {__version__}"]
    if not files:
        return computed_and_version
    number_of_others = len(files) - 1
    name = "/".join(Path(files[0]).parts[-2:])
    return [
        name + (f" and {count(number_of_others, 'other file')}" if number_of_others else ""),
        *computed_and_version,
    ]


def head_line(origin: Origin) -> str:
    """The stamp as the first line of a report; empty if the date is not known."""
    if not origin.computed:
        return ""
    return f"{', '.join(stamp([file.name for file in origin.inputs], origin.computed))}\n"


def software_versions() -> list[tuple[str, str]]:
    """Versions: jaxbundle, its packages, Python, the system."""
    from jaxbundle import __version__

    return [
        ("jaxbundle", __version__),
        *((name, version(name)) for name in PACKAGES),
        ("Python", platform.python_version()),
        ("System", f"{platform.system()} {platform.machine()}"),
    ]
