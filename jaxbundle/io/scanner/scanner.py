"""A scanner image as returned by every reader."""

import dataclasses

from jaxbundle.geometry.ellipsoid import Ellipsoid
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.rpc.agreement import Agreement


@dataclasses.dataclass(frozen=True)
class ScannerInput:
    """The image, the ellipsoid of its Earth (None: a local frame), warnings of the reader;
    `backwards`: whether its clock runs against time, so that no correction can be applied;
    `agreement` with the RPC of the product, if it has any, and the heights for which these
    hold."""

    name: str
    image: PushbroomImage
    earth: Ellipsoid | None
    warnings: tuple[str, ...] = ()
    backwards: bool = False
    agreement: Agreement | None = None
    rpc_heights: tuple[float, float] | None = None
