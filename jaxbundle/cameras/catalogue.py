"""The camera models by name, and own models, which are given as objects.

Splines have names with numbers, such as `spline-12x9-110`: `get_model` creates
them. Own models are not registered: otherwise one part of a program could change the meaning of a
name in another.
"""

import re
from collections.abc import Callable
from functools import partial

from jaxbundle.cameras.bingo import BINGO
from jaxbundle.cameras.brown import BROWN, BROWN_PROJECTED
from jaxbundle.cameras.division import DIVISION
from jaxbundle.cameras.double_sphere import DOUBLE_SPHERE
from jaxbundle.cameras.equirectangular import EQUIRECTANGULAR
from jaxbundle.cameras.eucm import EUCM
from jaxbundle.cameras.fisheye_prism import (
    KANNALA_BRANDT_TANGENTIAL,
    RAD_TAN_THIN_PRISM_FISHEYE,
    THIN_PRISM_FISHEYE,
)
from jaxbundle.cameras.fov_model import FOV
from jaxbundle.cameras.kannala_brandt import KANNALA_BRANDT
from jaxbundle.cameras.mei import MEI
from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.names import closest
from jaxbundle.cameras.opencv import OPENCV
from jaxbundle.cameras.radial_spline import radial_spline
from jaxbundle.cameras.scaramuzza import SCARAMUZZA
from jaxbundle.cameras.snavely import SNAVELY
from jaxbundle.cameras.spline import spline
from jaxbundle.cameras.undistorted_fisheyes import (
    EQUIDISTANT,
    EQUISOLID,
    ORTHOGRAPHIC,
    STEREOGRAPHIC,
)
from jaxbundle.cameras.usgs import USGS
from jaxbundle.choices import MODEL_FAMILIES

MODELS = {
    model.name: model
    for model in (
        BROWN,
        BROWN_PROJECTED,
        USGS,
        BINGO,
        OPENCV,
        SNAVELY,
        DIVISION,
        KANNALA_BRANDT,
        KANNALA_BRANDT_TANGENTIAL,
        THIN_PRISM_FISHEYE,
        RAD_TAN_THIN_PRISM_FISHEYE,
        FOV,
        EUCM,
        DOUBLE_SPHERE,
        MEI,
        SCARAMUZZA,
        EQUIDISTANT,
        STEREOGRAPHIC,
        EQUISOLID,
        ORTHOGRAPHIC,
        EQUIRECTANGULAR,
    )
}
MODEL_NAMES: tuple[str, ...] = tuple(MODELS)

_MAKERS: dict[str, Callable[..., CameraModel]] = {
    "radial-spline-N-FOV": lambda n, fov: radial_spline(int(n), float(fov)),
    "spline-NXxNY-FOV": lambda x, y, fov: spline(int(x), int(y), float(fov)),
}
FAMILIES = {name: (form, _MAKERS[name]) for name, form in MODEL_FAMILIES.items()}
"""Models with numbers in their names: the pattern, and the function that creates them."""


def get_model(model: str | CameraModel) -> CameraModel:
    """The camera model of this name; an own model is returned unchanged.

    **Raises:** `ValueError`, with the known names and the closest one, if it is unknown, and for an
    own model with the name of a built-in one.
    """
    if isinstance(model, CameraModel):
        if is_own(model) and _built_in(model.name):
            raise ValueError(
                f"Camera model {model.name!r} is built in; give your own another name."
            )
        return model
    built_in = _built_in(model)
    if built_in is None:
        raise ValueError(
            f"Unknown camera model {model!r}{closest(model, (*MODEL_NAMES, *FAMILIES))} "
            f"The models are {', '.join((*MODEL_NAMES, *FAMILIES))}."
        )
    return built_in


def is_own(model: str | CameraModel) -> bool:
    """Whether this is an own model, which is defined only by its object."""
    return isinstance(model, CameraModel) and _built_in(model.name) != model


def key_of(model: str | CameraModel) -> str | CameraModel:
    """The key of a model for comparisons: the name of a built-in model, or the own model."""
    return model.name if isinstance(model, CameraModel) and not is_own(model) else model


def is_known(name: str) -> bool:
    """Whether a built-in model has this name, or a family has names of this form."""
    return _of_family(name) is not None or (isinstance(name, str) and name in MODELS)


def _built_in(name: str) -> CameraModel | None:
    """The model of a name, created for a family; None if it is unknown.

    **Raises:** `ValueError` for a name of a family whose numbers are impossible.
    """
    if isinstance(name, str) and name in MODELS:  # a file may have anything there
        return MODELS[name]
    make_model = _of_family(name)
    return None if make_model is None else make_model()


def _of_family(name: str) -> Callable[[], CameraModel] | None:
    for form, make in FAMILIES.values():
        if isinstance(name, str) and (match := re.fullmatch(form, name)):
            return partial(make, *match.groups())
    return None
