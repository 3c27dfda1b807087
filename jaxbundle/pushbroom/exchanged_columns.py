"""Measured image positions whose columns are exchanged, which points with known positions show."""

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError


def refuse_exchanged(
    measured: Float[np.ndarray, "n 2"],
    computed: Float[np.ndarray, "n 2"],
    name: str,
    where: str = "",
    columns: tuple[str, str] = ("line", "pixel"),
) -> None:
    """Refuse positions, measured and computed from given coordinates, of which the measured ones
    are exchanged.

    **Arguments:** `name` of their table; `where`: the image, in words; `columns`: their names.

    **Raises:** `InputError`."""
    # Three points are not all on the diagonal, or near another's place, by chance.
    if len(measured) < 3:
        return
    distance, distance_exchanged = (
        np.median(np.linalg.norm(computed - places, axis=1))
        for places in (measured, measured[:, ::-1])
    )
    # An order of magnitude: start values explain a hundred pixels, but not that these vanish.
    if distance > 10 * distance_exchanged:
        both = " and ".join(columns)
        raise InputError(
            f"{name}: {both} seem to be exchanged{where}: points with given coordinates are "
            f"{distance:.0f} pixels from their measurements (median), and "
            f"{distance_exchanged:.0f} with {both} exchanged; check the names of the columns"
        )
