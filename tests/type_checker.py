"""Checks of types and shapes of the package while the tests run (`conftest.py`)."""

from contextlib import contextmanager
from pathlib import Path

import jaxtyping
from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
"""Whole numbers count as numbers, as PEP 484 has it."""


ROOMS = ("geometry", "cameras")
"""Rooms of formulas. Arrays of the engine stand for others while it plans, and what only passes on
what a user gives has words of its own for a wrong type."""


def modules_with_shapes(package: Path) -> list[str]:
    """The modules of these rooms whose annotations have shapes."""
    files = [path for room in ROOMS for path in (package / room).glob("*.py")]
    shaped = [path for path in files if "jaxtyping" in path.read_text()]
    return sorted(f"{package.name}.{path.parent.name}.{path.stem}" for path in shaped)


@contextmanager
def unchecked():
    """Disables these checks, to test the package's own messages about wrong types."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
