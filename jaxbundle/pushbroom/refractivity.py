"""Refractive index of the U.S. Standard Atmosphere 1976, and its integral over the height; the
bending of rays that follows: `corrections.refract`.

With the geopotential height H = r·h/(r + h), the temperature T of each layer is linear in H and the
pressure follows from the hydrostatic equation dp = −ρ·g·dh (U.S. Standard Atmosphere, 1976,
eqs. 18, 23, 33):

    T = T_b + L_b·(H − H_b),
    p = p_b·(T/T_b)^(−g₀/(R·L_b)),    or    p_b·exp(−g₀·(H − H_b)/(R·T_b))    where L_b = 0.

The refractivity n − 1 is proportional to the density ρ = p/(R·T) (Gladstone and Dale). By the
hydrostatic equation the air above h weighs what p carries, so that

    ∫ (n − 1) dh  from h upwards  =  (n − 1)/ρ·p/ḡ,

where ḡ is gravity at the centre of that air, about R·T/g₀ above h.
"""

from types import ModuleType

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.types import Scalar

# g₀, m/s², of the standard.
GRAVITY = 9.80665
# r of the geopotential height, metres, of the standard: for the latitude where gravity is g₀.
EARTH_RADIUS = 6356766.0
# R of dry air, J/(kg·K): the standard's R* by its molar mass at sea level.
GAS_CONSTANT = 8314.32 / 28.9644
# (n − 1)/ρ, m³/kg: n − 1 at 15 °C, 1013.25 hPa and 0.55 µm (Ciddor, 1996, Applied Optics 35,
# 1566–1573), where ρ is 1.225 kg/m³. It is 0.6 % more at 0.48 µm, 0.7 % less at 0.70 µm.
REFRACTIVITY = 2.779e-4 / 1.225

# Geopotential heights at which the layers begin, metres (table 4); the last is continued with
# constant temperature, without effect: a millionth of the air is above it.
BASES = 1e3 * np.array([0.0, 11.0, 20.0, 32.0, 47.0, 51.0, 71.0, 84.852])
# Temperature per metre of each layer, kelvin.
LAPSES = 1e-3 * np.array([-6.5, 0.0, 1.0, 2.8, 0.0, -2.8, -2.0, 0.0])
# Temperature at the beginning of each layer, kelvin.
TEMPERATURES = 288.15 + np.r_[0.0, np.cumsum(LAPSES[:-1] * np.diff(BASES))]


def _pressure(
    H: Scalar,
    base: Scalar,
    temperature: Scalar,
    lapse: Scalar,
    pressure: Scalar,
    *,
    numbers: ModuleType = jnp,
) -> tuple[Scalar, Scalar]:
    """T and p at H in the layer that begins at `base`, with `numbers` jax.numpy or numpy."""
    exponent = GRAVITY / GAS_CONSTANT
    T = temperature + lapse * (H - base)
    # Both branches are computed, so that the one not chosen must not divide by zero.
    power = -exponent / numbers.where(lapse == 0, 1.0, lapse)
    return T, pressure * numbers.where(
        lapse == 0, numbers.exp(-exponent * (H - base) / temperature), (T / temperature) ** power
    )


def _base_pressures() -> Float[np.ndarray, " layers"]:
    """Continuous from layer to layer, starting with the standard pressure at sea level."""
    pressures = [101325.0]
    for k in range(len(BASES) - 1):
        layer = BASES[k], TEMPERATURES[k], LAPSES[k], pressures[-1]
        pressures.append(float(_pressure(BASES[k + 1], *layer, numbers=np)[1]))
    return np.array(pressures)


# Pressure at the beginning of each layer, pascal.
PRESSURES = _base_pressures()


def refractivity(height: Scalar) -> tuple[Scalar, Scalar]:
    """n − 1 at a height above the ellipsoid, metres, and its integral from there upwards, metres.

    From −5 km on. The ellipsoid stands for mean sea level: a geoid height of 50 m changes the
    refractivity by half a percent."""
    H = EARTH_RADIUS * height / (EARTH_RADIUS + height)
    # Comparisons: half the compilation of a search in the table.
    layer = sum((H >= base).astype(int) for base in BASES[1:])
    T, p = _pressure(H, *(jnp.asarray(a)[layer] for a in (BASES, TEMPERATURES, LAPSES, PRESSURES)))
    density = p / (GAS_CONSTANT * T)
    # R·T/g₀ = 7300 m for 250 K, the mean temperature above most heights; 1 km more changes the
    # integral by 3e-4
    gravity = GRAVITY * (EARTH_RADIUS / (EARTH_RADIUS + height + 7300.0)) ** 2
    return REFRACTIVITY * density, REFRACTIVITY * p / gravity
