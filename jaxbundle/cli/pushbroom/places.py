"""A grid over a line scanner image, as an option."""

from jaxbundle.errors import InputError


def grid_of(grid: str) -> tuple[int, int]:
    """The two numbers of LINESxPIXELS.

    **Raises:** `InputError`.
    """
    try:
        rows, columns = (int(n) for n in grid.lower().split("x"))
        if min(rows, columns) < 1:
            raise ValueError
    except ValueError:
        raise InputError(f"--grid {grid!r}: expected two numbers, such as 11x11") from None
    return rows, columns
