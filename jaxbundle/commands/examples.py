"""`example`: the packaged examples."""

from pathlib import Path

from jaxbundle.errors import InputError
from jaxbundle.system.examples import EXAMPLES, write_example


def example(name: str, folder: str | Path) -> Path:
    """Write a packaged example into a new or empty folder: `"convergent4"`, `"board"`,
    `"line_scanner"`.

    **Returns:** the folder.

    **Raises:** `InputError` for an unknown name, or a folder that cannot or may not be written.
    """
    if not name:
        raise InputError(f"name: expected one of {', '.join(EXAMPLES)}")
    write_example(name, folder)
    return Path(folder)
