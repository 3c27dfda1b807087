"""Whether a camera should have more parameters or fewer: one rule for all advice about it.

Three findings bear on it, and they can come together:

- parameters are hardly determined (`Adjustment.weakness`), or the distortion turns back inside the
  image, where nothing was measured;
- residuals have a part that the lens model lacks: a field on the sensor that all photographs share
  (`report.correlated`), a bias of the camera (`calibration.bias`), an affinity that is held
  (`calibration.affinity`), an RMS that measurement does not explain;
- coefficients are not significant: |value|/σ is small.

| hardly determined | part lacking | advice |
|---|---|---|
| yes | yes or no | fewer parameters, or photographs that determine them |
| no | yes | a richer model |
| no | no | fewer parameters, if some are not significant |

Photographs that do not determine the parameters they have determine no more of them; what the model
lacks is then part of the σ only. A part that is lacking is in σ0, which makes |value|/σ small: with
it, significance says nothing about what the lens needs.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxbundle.adjustment.result import Adjustment

FEWER, RICHER, SIGNIFICANT_ONLY = "fewer", "richer", "significant only"

FEWER_PARAMETERS = (
    "Free fewer camera parameters, or give them a prior σ; c needs depth or convergent images, x0 "
    "and y0 need images rolled about their axis."
)
# What follows from a field on the sensor.
ADVICE_ON_FIELD = {
    FEWER: "these photographs determine no further parameters of the camera, and the σ shown "
    "contain it",
    RICHER: "a richer lens model may represent it (free more coefficients of the camera in the "
    "project, or choose another model there, and adjust it; of photographs of boards, `calibrate "
    "--models` compares models); the σ shown contain it",
}


def advise_parameters(hardly_determined: bool, lacking: bool) -> str:
    """`FEWER` or `RICHER` parameters, or those that are `SIGNIFICANT_ONLY`."""
    if hardly_determined:
        return FEWER
    return RICHER if lacking else SIGNIFICANT_ONLY


def is_hardly_determined(adjustment: "Adjustment", camera: str = "") -> bool:
    """Whether parameters of a camera are hardly determined, or its distortion turns back inside the
    image; of any camera, if none is named."""
    of_camera = f" of camera {camera}"
    are_named = (
        name.endswith(of_camera) if camera else of_camera in name
        for name in adjustment.weakness.unknowns
    )
    turning = (
        reach.message is not None
        for id, reach in adjustment.distortion_reach.items()
        if camera in ("", id)
    )
    return any(are_named) or any(turning)
