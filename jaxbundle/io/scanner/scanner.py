"""A scanner image as returned by every reader."""

import dataclasses

from jaxbundle.geometry.ellipsoid import Ellipsoid
from jaxbundle.pushbroom.image import PushbroomImage


@dataclasses.dataclass(frozen=True)
class ScannerInput:
    """The image, the ellipsoid of its Earth (None: a local frame), warnings of the reader;
    `backwards`: whether its clock runs against time, so that no correction can be applied."""

    name: str
    image: PushbroomImage
    earth: Ellipsoid | None
    warnings: tuple[str, ...] = ()
    backwards: bool = False
