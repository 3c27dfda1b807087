"""The cameras of a PhotoModeler export: which of two roundings holds, and the effect of rounding.

The header has the default camera with all digits; the line of a photograph
repeats its camera with c, xp, yp to 3 decimals and the rest to 5:

    7.4693 3.6178 2.6087 7.25320 5.43990 4.981e-3 -9.814e-5 0 -6.587e-5 -2.806e-5       header
    7.469  3.618  2.609  7.25320 5.43990 0.00498 -0.00010 0.00000 -0.00007 -0.00003     photograph

A photograph has the camera of the header if every number agrees to half a unit of
the last decimal; otherwise it has another camera with the rounded numbers.
"""

from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.io.text.rows import TextRow
from jaxbundle.network.columns import list_some
from jaxbundle.network.tables import Camera

INNER = ("c", "xp", "yp", "xs", "ys", "K1", "K2", "K3", "P1", "P2")

Inner = Float[np.ndarray, "10"]


def header_camera(row: TextRow) -> tuple[Inner, Inner] | None:
    """The default camera, and half a unit of its last decimals; None without ten numbers."""
    return (row.numbers(INNER), _half_units(row.words)) if len(row) == len(INNER) else None


def photo_camera(row: TextRow, header: tuple[Inner, Inner] | None) -> tuple[Inner, Inner]:
    """The camera of a photograph (number, then ten values), and half a unit of its last decimals:
    the header's if it is the same."""
    photo_values, half_units = row.numbers(INNER, 1), _half_units(row.words[1:])
    # A tie is half a unit.
    if header is not None and (abs(header[0] - photo_values) <= (1 + 1e-9) * half_units).all():
        return header
    return photo_values, half_units


def _half_units(words: Sequence[str]) -> Inner:
    # The file prints c, xp, yp with 3 decimals and the rest with 5; a bare 0 has them too.
    printed_decimals = (3, 3, 3, 5, 5, 5, 5, 5, 5, 5)
    return 0.5 * 10.0 ** -np.maximum([_decimals(word) for word in words], printed_decimals).astype(
        float
    )


def _decimals(word: str) -> int:
    try:
        return -int(Decimal(word).as_tuple().exponent)
    except InvalidOperation:  # an exponent of twenty digits: the number is 0
        return 0


def camera_entry(id: str, values: Inner, size: Sequence[float] | None) -> dict[str, Any]:
    """The entry of a document; `size` of the image in pixels."""
    c, xp, yp, xs, ys, K1, K2, K3, P1, P2 = values.tolist()
    entry = {
        "id": id,
        "model": "brown",
        "c": c,
        "x0": xp - xs / 2,
        "y0": ys / 2 - yp,
        "K1": K1,
        "K2": K2,
        "K3": K3,
        "P1": P1,
        "P2": P2,
    }
    return entry if size is None else entry | {"image_size": size}


def rounding_warnings(
    cameras: Sequence[Camera], half_units: Float[np.ndarray, "cameras 10"], max_effect: float = 0.1
) -> list[str]:
    """Warnings about cameras whose rounding exceeds `max_effect` pixels in the corner of the
    image; parameters that are 0 or free are not counted.

    **Arguments:** `half_units` half a unit of the last decimal of each value; `max_effect`: about
    the precision of a good image point, which rounding should not exceed."""
    warnings = []
    for camera, rounding in zip(cameras, half_units):
        size, pixel = np.array(camera.image_size, float), np.array(camera.pixel_size)
        r = float(np.linalg.norm(size * pixel)) / 2
        # Derivatives of the image in the corner by the parameters, mm: ∂x/∂c = r/c, ∂Δr/∂K1 = r³ ….
        slopes = {
            "c": r / camera.parameters["c"],
            "K1": r**3,
            "K2": r**5,
            "K3": r**7,
            "P1": 3 * r**2,
            "P2": 3 * r**2,
        }
        effects = {
            name: rounding[INNER.index(name)] * slope / pixel.min()
            for name, slope in slopes.items()
            if camera.parameters[name] != 0 and name not in camera.free
        }
        large_effects = {name: effect for name, effect in effects.items() if effect > max_effect}
        if large_effects:
            in_words = (f"{name} to {effect:.2g} px" for name, effect in large_effects.items())
            effects_text = list_some(in_words, as_text=str)
            warnings.append(
                f"the file rounds camera {camera.id!r}: in the corner of the image this leaves "
                f"open {effects_text}; give more digits (--set "
                f"camera.{camera.id}.{next(iter(large_effects))}=…) or free them (--set "
                f"camera.{camera.id}.free={','.join(large_effects)})"
            )
    return warnings
