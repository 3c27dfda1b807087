"""Folders of photographs: which files are read, and what is said of the others.

Photographs in a format that is not read are listed like the others, so that reading them fails with
their name and the remedy; raw files beside a photograph of the same name are only counted.
"""

from collections import Counter
from pathlib import Path

from jaxbundle.network.columns import count
from jaxbundle.photographs.formats import RAW, SUFFIXES, is_photograph

# Files that operating systems put into folders, beside those whose name begins with a dot.
HIDDEN = ("thumbs.db", "desktop.ini")


def list_photographs(folder: Path) -> list[Path]:
    """The photographs in a folder, by name: also those whose format cannot be read."""
    files = [p for p in _visible_files(folder) if p.is_file() and is_photograph(p)]
    # Raw and JPEG of one exposure have one name; the raw file alone is listed, and refused by name.
    readable_stems = {p.stem.lower() for p in files if p.suffix.lower() in SUFFIXES}
    return [p for p in files if p.suffix.lower() not in RAW or p.stem.lower() not in readable_stems]


def describe_other_files(folder: Path) -> str:
    """The files and folders that are no photographs of their own, in words; empty if none."""
    # Names in a message of one or two lines.
    photographs, max_names = set(list_photographs(folder)), 6
    other_paths = [p for p in _visible_files(folder) if p not in photographs]
    photograph_folders = [
        p for p in other_paths if p.is_dir() and any(map(is_photograph, _visible_files(p)))
    ]
    raw = [p for p in other_paths if p.is_file() and p.suffix.lower() in RAW]
    other_files = [p for p in other_paths if p.is_file() and p not in raw]
    parts = []
    if raw:
        parts.append(f"{count(len(raw), 'raw file')} beside photographs of the same name")
    if photograph_folders:
        names = ", ".join(f"{p.name}/" for p in photograph_folders[:max_names])
        parts.append(
            f"{count(len(photograph_folders), 'folder')} with photographs ({names}); give them, too"
        )
    if other_files:
        kinds = Counter(p.suffix.lower() or "no suffix" for p in other_files)
        kinds_text = ", ".join(f"{n} {kind}" for kind, n in kinds.most_common(max_names))
        ellipsis = ", …" if len(kinds) > max_names else ""
        parts.append(f"{count(len(other_files), 'other file')} ({kinds_text}{ellipsis})")
    return f"{folder}: not read: {'; '.join(parts)}" if parts else ""


def _visible_files(folder: Path) -> list[Path]:
    return sorted(
        p for p in folder.iterdir() if not p.name.startswith(".") and p.name.lower() not in HIDDEN
    )
