"""Paths from one place to another."""

import os
from pathlib import Path


def relative_path(path: str | Path, folder: str | Path) -> str:
    """A path relative to a folder; absolute where none leads there, on another drive of Windows."""
    try:
        return os.path.relpath(path, folder)
    except ValueError:
        return os.path.abspath(path)
