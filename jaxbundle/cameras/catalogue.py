"""The camera models by name."""

from .bingo import BINGO
from .brown import BROWN, BROWN_PROJECTED
from .kannala_brandt import KANNALA_BRANDT
from .model import CameraModel
from .names import closest
from .opencv import OPENCV
from .snavely import SNAVELY
from .usgs import USGS

MODELS = {
    model.name: model
    for model in (BROWN, BROWN_PROJECTED, USGS, BINGO, OPENCV, KANNALA_BRANDT, SNAVELY)
}
MODEL_NAMES: tuple[str, ...] = tuple(MODELS)


def get_model(name: str) -> CameraModel:
    """The camera model of this name.

    **Raises:** `ValueError`, with the known names and the closest one, if there is none.
    """
    if name not in MODELS:
        raise ValueError(
            f"Unknown camera model {name!r}{closest(name, MODEL_NAMES)} "
            f"The models are {', '.join(MODEL_NAMES)}."
        )
    return MODELS[name]
