"""Coordinates and σ that 64-bit numbers can hold, with the digits that a network needs."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.arguments import positive
from jaxbundle.errors import InputError
from jaxbundle.network.tables import Network

# Normal equations and cofactors have products of four lengths, or of two lengths and the weight
# 1/σ², and sums over many of them: a hundredth of the fourth root of the largest number.
LARGEST = float(f"{np.finfo(float).max ** (1 / 4) / 100:.0e}")


def is_usable_sigma(sigma: Float[np.ndarray, " *shape"] | float) -> Bool[np.ndarray, " *shape"]:
    """Which σ can be computed with, by their squares and those of their weights; infinite and
    missing ones cannot."""
    sigma = np.asarray(sigma)
    return (sigma >= 1 / LARGEST) & (sigma <= LARGEST)


def sigma_requirement(sigma: Float[np.ndarray, ""] | float, positive: str = "positive") -> str:
    """What a σ that cannot be used must be, in words; `positive`: where it is no positive
    number."""
    return f"between {1 / LARGEST:g} and {LARGEST:g}" if 0 < sigma < np.inf else positive


def sigma_of_setting(name: str, value: Any) -> float:
    """A σ that a setting gives.

    **Raises:** `InputError` for one that cannot be used."""
    sigma = positive(name, value)
    if not is_usable_sigma(sigma):
        raise InputError(f"{name} is {sigma:g}; it must be {sigma_requirement(sigma)}")
    return sigma


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
