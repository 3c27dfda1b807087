"""Whether the input of a command is small, so that compiling takes longer than computing."""

import re
from pathlib import Path

# Bytes of input, some 3000 image points: adjusted in 0.1 s by quickly compiled programs.
SMALL_INPUT = 100_000


def is_small(path: Path) -> bool:
    """Whether a file, the files beside it for a project, or those of a folder, are small; a project
    with files elsewhere is not."""
    folder = path if path.is_dir() else path.parent if path.suffix == ".toml" else None
    total = 0
    try:
        for file in folder.iterdir() if folder else [path]:
            total += file.stat().st_size
            if total > SMALL_INPUT or file.is_dir():
                return False
        if path.suffix == ".toml":
            # Paths that lead upwards, or begin at a root, are of files that were not counted.
            return not re.search(r"""["'](\.\.|/|\w:)""", path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False  # The command says so.
    return True
