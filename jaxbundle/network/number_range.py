"""Coordinates that 64-bit numbers can hold, with the digits that a network needs."""

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.network.tables import Network

# Normal equations and cofactors have products of four lengths, and sums over many of them: a
# hundredth of the fourth root of the largest number.
LARGEST = float(f"{np.finfo(float).max ** (1 / 4) / 100:.0e}")


def check_coordinates(
    network: Network, noticed_step: float = 1e-7, refused_step: float = 1e-3
) -> Network:
    """The network, with a warning if its coordinates are so large that rounding matters.

    `noticed_step`, `refused_step`: between neighbouring numbers, relative to the extent of the
    network. σ of the best networks are 1e-6 to 1e-7 of it, so larger steps are noticed; at a
    thousandth the object is lost. Where nothing of the extent is left, a unit is taken for it.

    **Raises:** `InputError` for coordinates that cannot be computed with."""
    for table, noun, axes in (
        (network.points, "point", ("X", "Y", "Z")),
        (network.images, "image", ("X0", "Y0", "Z0")),
    ):
        x = table.position
        for row, k in np.argwhere(np.isfinite(x) & (np.abs(x) > LARGEST))[:1]:
            raise InputError(
                f"{table.source(row)}: {noun} {table.id[row]!r}: expected {axes[k]} within "
                f"±{LARGEST:g}, got {x[row, k]:g}"
            )
    position = np.concatenate([network.points.position, network.images.position])
    position = position[np.isfinite(position).all(1)]
    extent = np.ptp(position, 0).max() if len(position) else 0.0
    largest = np.abs(position).max(initial=0.0)
    step = np.spacing(largest)
    if 0 < extent < 1 / LARGEST:
        raise InputError(
            f"{network.points.source.name}: the network is {extent:.2g} {network.object_unit} "
            f"wide: expected more than {1 / LARGEST:g}; give its coordinates in a smaller unit"
        )
    # Equal coordinates may be poor start values, or all that is left of others.
    if step <= noticed_step * extent or extent == 0 and step < refused_step:
        return network
    message = (
        f"coordinates of {largest:.3g} are held in steps of {step:.2g} {network.object_unit}, and "
        f"the network is {extent:.3g} {network.object_unit} wide: subtract a common offset from "
        "all of them"
    )
    if step > refused_step * extent:
        raise InputError(f"{network.points.source.name}: {message}")
    return network.warn(message)
