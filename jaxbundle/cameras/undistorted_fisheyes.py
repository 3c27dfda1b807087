"""`stereographic`, `equidistant`, `equisolid`, `orthographic`: the ideal projections of fisheyes.

    u = cx + fx·ρ(θ)·cos ψ,  v = cy + fy·ρ(θ)·sin ψ

with ρ = 2·tan(θ/2), θ, 2·sin(θ/2), sin θ: no distortion at all, four parameters. The formulas are
those of the ideal images (`fisheye_images.py`), where also their ranges stand.

Units: pixels, (0, 0) the centre of the upper-left pixel, u right, v down.

Source: Ray (2002), Applied Photographic Optics; Schneider, Schwalbe and Maas (2009), ISPRS Journal
of Photogrammetry and Remote Sensing 64(3).
"""

from jaxbundle.cameras import opencv
from jaxbundle.cameras.model import CameraModel, Image
from jaxbundle.cameras.scalars import Pair, Parameters, Scalar


def shift(p: Parameters, xi: Scalar, yi: Scalar) -> Pair:
    """Ideal to measured pixel coordinates."""
    return xi + p[2], yi + p[3]


def _ideal(image: Image) -> CameraModel:
    return CameraModel(
        image,
        ("fx", "fy", "cx", "cy"),
        distort=shift,
        inverse=opencv.reduce,
        unit="px",
        image=image,
    )


STEREOGRAPHIC = _ideal("stereographic")
EQUIDISTANT = _ideal("equidistant")
EQUISOLID = _ideal("equisolid")
ORTHOGRAPHIC = _ideal("orthographic")
