"""The camera models by name, and a user's own, which are given as objects.

Own models are in no list: a list that grows would let one part of a program change what a name
means in another.
"""

from jaxbundle.cameras.bingo import BINGO
from jaxbundle.cameras.brown import BROWN, BROWN_PROJECTED
from jaxbundle.cameras.kannala_brandt import KANNALA_BRANDT
from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.names import closest
from jaxbundle.cameras.opencv import OPENCV
from jaxbundle.cameras.snavely import SNAVELY
from jaxbundle.cameras.usgs import USGS

MODELS = {
    model.name: model
    for model in (BROWN, BROWN_PROJECTED, USGS, BINGO, OPENCV, KANNALA_BRANDT, SNAVELY)
}
MODEL_NAMES: tuple[str, ...] = tuple(MODELS)


def get_model(model: str | CameraModel) -> CameraModel:
    """The camera model of this name; an own model is itself.

    **Raises:** `ValueError`, with the known names and the closest one, if there is none, and for an
    own model of the name of another.
    """
    if isinstance(model, CameraModel):
        if MODELS.get(model.name, model) != model:
            raise ValueError(
                f"Camera model {model.name!r} is built in; give your own another name."
            )
        return model
    if model not in MODELS:
        raise ValueError(
            f"Unknown camera model {model!r}{closest(model, MODEL_NAMES)} "
            f"The models are {', '.join(MODEL_NAMES)}."
        )
    return MODELS[model]


def is_own(model: str | CameraModel) -> bool:
    """Whether it is a user's own model, which only an object describes."""
    return isinstance(model, CameraModel) and MODELS.get(model.name) != model


def key_of(model: str | CameraModel) -> str | CameraModel:
    """What stands for a model where models are compared: the name of a built-in one, an own one
    itself."""
    return model.name if isinstance(model, CameraModel) and not is_own(model) else model
