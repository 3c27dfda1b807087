"""The option `jaxbundle adjust --budget`."""

from jaxbundle.adjustment.quality.fixed_quantities import split_name
from jaxbundle.arguments import positive
from jaxbundle.errors import InputError
from jaxbundle.network.kinds.base import ANGLES
from jaxbundle.network.tables import Network
from jaxbundle.network.units import ANGLE_UNITS


def held_of(words: list[str] | None, network: Network) -> dict[str, float]:
    """σ by name, angles in radians.

    **Raises:** `InputError`."""
    held_sigma = {}
    for text in words or ():
        name, mark, sigma = text.rpartition("=")
        if not mark:
            raise InputError(f"--budget {text!r}: expected NAME=SIGMA, such as camera:cam:K3=1e-6")
        try:
            parameter = split_name(name)[2]
        except InputError as error:
            raise InputError(f"--budget {error}") from None
        if name in held_sigma:
            raise InputError(f"--budget {name}: is given twice")
        try:
            number = float(sigma)
        except ValueError:
            raise InputError(f"--budget {name}: {sigma!r} is not a number") from None
        unit = ANGLE_UNITS[network.angle_unit] if parameter in ANGLES else 1.0
        held_sigma[name] = positive(f"--budget {name}", number) * unit
    return held_sigma
