r"""Planning of vertical photographs: scale, relief displacement, expected precision, a block.

    S = c/(H − h)                               scale; H flying height, h terrain, above the datum
    Δr = r·ΔH/(H' − ΔH)                         relief displacement; r of the FOOT, H' above it
    σX = H'·σx/c                                of a point from one photograph, in plan
    σH = √2·H'²·σx/(b·c)                        of a height from a pair with the air base b

with the principal distance c, σx of an image coordinate, H' = H − h.

Sources: Wolf, Dewitt and Wilkinson (2014), Elements of Photogrammetry, chapters 6 and 18;
Kraus (2007), Photogrammetry, section 4.6.
"""

import dataclasses
import math
from collections.abc import Mapping

from jaxbundle.errors import InputError
from jaxbundle.types import not_none


def scale(c: float, height: float, terrain: float = 0.0) -> float:
    """S = c/(H − h), without unit; c in the unit of the heights."""
    return c / (height - terrain)


def relief_displacement(r: float, relief: float, height: float) -> float:
    """Δr of the top of a thing, in the unit of r.

    **Arguments:** `r` radius of its foot from the nadir point; `relief` its height ΔH; `height` of
    flight above the foot.
    """
    return r * relief / (height - relief)


def sigma_plan(c: float, height: float, sigma_image: float) -> float:
    """σX = σY of one photograph, in the unit of `height`; c and σ in one unit."""
    return height * sigma_image / c


def sigma_height(c: float, height: float, base: float, sigma_image: float) -> float:
    """σH of a pair, in the unit of `height` and `base`; c and σ in one unit."""
    return math.sqrt(2) * height**2 * sigma_image / (base * c)


@dataclasses.dataclass(frozen=True)
class BlockDesign:
    """A block of vertical photographs; lengths on the ground in the object unit."""

    height: float
    scale_number: float
    pixel_on_ground: float | None
    footprint: tuple[float, float]
    base: float
    spacing: float
    strips: int
    photographs_per_strip: int
    forward_overlap: float
    side_overlap: float
    sigma_plan: float
    sigma_height: float

    @property
    def photographs(self) -> int:
        """Number of photographs of the whole block."""
        return self.strips * self.photographs_per_strip

    @property
    def base_to_height(self) -> float:
        """b/H'."""
        return self.base / self.height


def design_block(
    c: float,
    image_format: tuple[float, float],
    area: tuple[float, float],
    sigma_image: float,
    *,
    height: float | None = None,
    scale_number: float | None = None,
    pixel_on_ground: float | None = None,
    pixel: float | None = None,
    forward_overlap: float = 0.6,
    side_overlap: float = 0.3,
) -> BlockDesign:
    """Flying height, strips and photographs for an area, and the precision to be expected.

    Every strip begins and ends with the photograph whose centre is over the area's edge or beyond,
    so that the whole area has stereoscopic cover; strips cover its width edge to edge.

    **Arguments:**

    - `c`, `image_format` (along and across the flight), `sigma_image`, `pixel`: mm.
    - `area`: length along and width across the flight, object unit (m).
    - one of `height` above ground (m), `scale_number` (1000·m per mm, the m of 1 : m), or
      `pixel_on_ground` (m; needs `pixel`).
    - `forward_overlap`, `side_overlap`: fractions; actual side overlap is larger where the number
      of strips is rounded up.

    **Raises:** `InputError` for what is not positive or no fraction, or not exactly one height.
    """
    _check_lengths(
        {"height": height, "scale_number": scale_number, "pixel_on_ground": pixel_on_ground},
        {
            "c": c,
            "width of the format": image_format[0],
            "height of the format": image_format[1],
            "length of the area": area[0],
            "width of the area": area[1],
            "sigma_image": sigma_image,
            "pixel": pixel,
        },
    )
    _check_millimetres(c, image_format)
    for name, overlap in (("forward_overlap", forward_overlap), ("side_overlap", side_overlap)):
        if not 0 <= overlap < 1:
            percent = " (60 % is 0.6)" if 1 < overlap < 100 else ""
            raise InputError(
                f"{name} is {overlap}; expected a fraction, 0 or more and below 1{percent}"
            )
    if pixel_on_ground is not None:
        if pixel is None:
            raise InputError("pixel_on_ground needs the pixel size (pixel, mm)")
        scale_number = pixel_on_ground / pixel * 1000
    if height is None:
        height = not_none(scale_number) * c / 1000
    # Lengths of 1e-9 of a base more are rounding, and need no further photograph.
    ratio = height / c
    footprint = (image_format[0] * ratio, image_format[1] * ratio)
    base, spacing = footprint[0] * (1 - forward_overlap), footprint[1] * (1 - side_overlap)
    per_strip = math.ceil(area[0] / base - 1e-9) + 1
    strips = 1 + max(0, math.ceil((area[1] - footprint[1]) / spacing - 1e-9))
    if strips > 1:
        spacing = (area[1] - footprint[1]) / (strips - 1)
    return BlockDesign(
        height=height,
        scale_number=1000 * ratio,
        pixel_on_ground=None if pixel is None else pixel * ratio,
        footprint=footprint,
        base=base,
        spacing=spacing,
        strips=strips,
        photographs_per_strip=per_strip,
        forward_overlap=forward_overlap,
        side_overlap=1 - spacing / footprint[1],
        sigma_plan=sigma_plan(c, height, sigma_image),
        sigma_height=sigma_height(c, height, base, sigma_image),
    )


def _check_millimetres(
    c: float, image: tuple[float, float], sides: tuple[float, float] = (1.0, 1000.0)
) -> None:
    """Refuse a camera in another unit.

    **Arguments:** `sides`: smallest and largest mm of the longer side of a format: the sensors of
    the smallest cameras, 100 × 100 pixels, have 1 mm; aerial film has 230 mm.

    **Raises:** `InputError`."""
    low, high = sides
    if not low <= max(image) <= high:
        unit = "m" if max(image) < low else "pixels"
        raise InputError(
            f"c {c:g} mm and a format of {image[0]:g} × {image[1]:g} mm: are they in {unit}? "
            "Expected are millimetres"
        )


def _check_lengths(
    heights: Mapping[str, float | None], other_lengths: Mapping[str, float | None]
) -> None:
    """Refuse lengths that are not positive, and another number of heights than one.

    **Raises:** `InputError`."""
    if sum(value is not None for value in heights.values()) != 1:
        raise InputError(f"give one of {', '.join(heights)}")
    for name, value in {**other_lengths, **heights}.items():
        if value is not None and not (math.isfinite(value) and value > 0):
            raise InputError(f"{name} is {value}; it must be positive")
