"""Rules that one value, one id or one camera must obey; readers use them before `check_network`."""

import math
from collections.abc import Sequence

import numpy as np

from jaxbundle.arguments import one_of
from jaxbundle.cameras import MODEL_NAMES, check_parameters, default_parameters, get_model
from jaxbundle.errors import InputError
from jaxbundle.network.columns import did_you_mean, shown
from jaxbundle.network.tables import DATUMS, RESIDUAL_DOMAINS, Camera, Source
from jaxbundle.network.units import ANGLE_UNITS, IMAGE_UNITS

AXES = ("X", "Y", "Z")
CHOICES = {
    "datum": DATUMS,
    "residuals": RESIDUAL_DOMAINS,
    "angle_unit": tuple(ANGLE_UNITS),
    "image_unit": IMAGE_UNITS,
}
"""The settings that are one of a few words."""


def check_choice(key: str, value: str, choices: Sequence[str], where: str = "") -> None:
    """Refuse a setting that is not one of its choices."""
    one_of(f"{where}{key}", value, choices)


def check_unique(ids: Sequence[str], source: Source, thing: str) -> None:
    """Refuse an id that stands in two rows of a table."""
    if len(set(ids)) == len(ids):
        return
    first: dict[str, int] = {}
    for row, id in enumerate(ids):
        if first.setdefault(id, row) != row:
            raise InputError(
                f"{source(row)}: {thing} {id!r} stands already in {source(first[id])}; "
                "an id must be unique"
            )


def check_camera(camera: Camera, where: str = "") -> None:
    """Refuse an unknown model or parameter, and impossible values, σ and sizes.

    `where` begins the message: "project.toml, ".
    """
    where = f"{where}camera {camera.id!r}: "
    if camera.model not in MODEL_NAMES:
        raise InputError(
            f"{where}unknown model {camera.model!r}{did_you_mean(camera.model, MODEL_NAMES)}"
        )
    model = get_model(camera.model)
    try:
        check_parameters(model, {**default_parameters(model), **camera.parameters})
    except ValueError as error:
        raise InputError(f"{where}{error}") from None
    for name in camera.free:
        if name not in model.parameters:
            raise InputError(
                f"{where}free names the unknown parameter {name!r}"
                f"{did_you_mean(name, model.parameters)}"
            )
        if name in model.never_free:
            raise InputError(f"{where}{name} cannot be estimated; take it out of free")
        if camera.free.count(name) > 1:
            raise InputError(f"{where}free names {name} twice")
    for name, sigma in camera.sigma.items():
        if name not in camera.free:
            raise InputError(
                f"{where}sigma is given for {name!r}, which is not free; add it to free, or take "
                f"its sigma away (free: {', '.join(camera.free) or 'none'})"
            )
        if not _positive(sigma):
            raise InputError(f"{where}sigma of {name} is {sigma}; it must be finite and positive")
    _check_pair(where, "image_size", camera.image_size, "[columns, rows]")
    _check_pair(where, "pixel_size", camera.pixel_size, "[width, height] in mm")


def _check_pair(where, name, pair, meaning):
    if pair is not None and not (len(pair) == 2 and all(map(_positive, pair))):
        raise InputError(f"{where}{name} is {list(pair)}; expected {meaning}, both positive")


def check_sigma_image(sigma: float, where: str = "") -> None:
    """Refuse a default σ of image coordinates that is no finite positive number."""
    if isinstance(sigma, bool) or not isinstance(sigma, int | float | np.number):
        raise InputError(f"{where}sigma_image is {shown(sigma)}; a number is expected")
    if not _positive(sigma):
        raise InputError(f"{where}sigma_image is {shown(sigma)}; it must be finite and positive")


def _positive(value) -> bool:
    try:
        return math.isfinite(value) and value > 0
    except OverflowError:
        return False
