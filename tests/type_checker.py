"""What checks types and shapes of the package while the tests run (`conftest.py`)."""

from contextlib import contextmanager
from pathlib import Path

import jaxtyping
from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
"""Whole numbers count as numbers, as PEP 484 has it."""


def modules_with_shapes(package: Path) -> list[str]:
    """The modules whose annotations have shapes: formulas, arrays, the engine. What only passes on
    what a user gives has words of its own for a wrong type."""
    files = [path for path in package.rglob("*.py") if "jaxtyping" in path.read_text()]
    names = (".".join(path.relative_to(package.parent).with_suffix("").parts) for path in files)
    return sorted(name.removesuffix(".__init__") for name in names)


@contextmanager
def unchecked():
    """Without these checks: to see what the package itself says of what is of a wrong type."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
