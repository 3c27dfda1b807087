"""Checks of single values, ids and cameras, used by readers before `check_network`."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxbundle.arguments import one_of, show, text
from jaxbundle.cameras import (
    FAMILIES,
    MODEL_NAMES,
    CameraModel,
    check_own,
    check_parameters,
    default_parameters,
    get_model,
    is_known,
    is_own,
)
from jaxbundle.errors import InputError
from jaxbundle.network.columns import did_you_mean
from jaxbundle.network.number_range import is_usable_sigma, sigma_requirement
from jaxbundle.network.tables import DATUMS, RESIDUAL_DOMAINS, Camera, Source
from jaxbundle.network.units import ANGLE_UNITS, IMAGE_UNITS

AXES = ("X", "Y", "Z")
# The settings with a fixed set of values.
CHOICES = {
    "datum": DATUMS,
    "residuals": RESIDUAL_DOMAINS,
    "angle_unit": tuple(ANGLE_UNITS),
    "image_unit": IMAGE_UNITS,
}


def check_choice(key: str, value: str, choices: Sequence[str], where: str = "") -> None:
    """Refuse a setting that is not one of its choices."""
    one_of(f"{where}{key}", value, choices)


def check_unique(ids: Sequence[str], source: Source, noun: str) -> None:
    """Refuse an id that occurs in two rows of a table."""
    if len(set(ids)) == len(ids):
        return
    first_rows: dict[str, int] = {}
    for row, id in enumerate(ids):
        if first_rows.setdefault(id, row) != row:
            raise InputError(
                f"{source(row)}: {noun} {id!r} is already in {source(first_rows[id])}; "
                "an id must be unique"
            )


def model_of(model: str | CameraModel, where: str = "") -> CameraModel:
    """The camera model with this name, or the given user-defined one.

    **Raises:** `InputError` for an unknown name, or the name of another model."""
    if not isinstance(model, CameraModel) and not is_known(model):
        suggestion = did_you_mean(model, (*MODEL_NAMES, *FAMILIES))
        raise InputError(
            f"{where}unknown {'' if where else 'camera '}model {show(model)}{suggestion}"
            f"{'' if suggestion.endswith('?') else ';'} pass your own as a CameraModel, for a "
            "file that names it by read_network(path, models=[…])"
        )
    try:
        return get_model(model)
    except ValueError as error:
        raise InputError(f"{where}{error}") from None


def check_models(cameras: Sequence[Camera], where: str = "") -> None:
    """Refuse two different models with the same name: files and reports could not distinguish
    them."""
    first_of_name: dict[str, Camera] = {}
    for camera in cameras:
        first_camera = first_of_name.setdefault(str(camera.model), camera)
        if first_camera.model != camera.model:
            raise InputError(
                f"{where}cameras {first_camera.id!r} and {camera.id!r} have different models named "
                f"{str(camera.model)!r}; rename one of them, or give both the same object"
            )


def check_camera(camera: Camera, where: str = "") -> None:
    """Refuse an unknown model or parameter, and impossible values, σ and sizes.

    `where`: prefix of the message, such as "project.toml, ".
    """
    text(f"{where}id of a camera", camera.id)
    where = f"{where}camera {camera.id!r}: "
    _check_fields(camera, where)
    model = model_of(camera.model, where)
    values = {**default_parameters(model), **camera.parameters}
    try:
        check_parameters(model, values)
        if is_own(model):
            check_own(model, values)
    except ValueError as error:
        raise InputError(f"{where}{error}") from None
    for name in camera.free:
        if name not in model.parameters:
            raise InputError(
                f"{where}free names the unknown parameter {name!r}"
                f"{did_you_mean(name, model.parameters)}"
            )
        if name in model.never_free:
            raise InputError(f"{where}{name} cannot be estimated; remove it from free")
        if camera.free.count(name) > 1:
            raise InputError(f"{where}free names {name} twice")
    for name, sigma in camera.sigma.items():
        if name not in camera.free:
            raise InputError(
                f"{where}sigma is given for {name!r}, which is not free; add it to free, or remove "
                f"its sigma (free: {', '.join(camera.free) or 'none'})"
            )
        _check_sigma(f"{where}sigma of {name}", sigma)
    for name, value in camera.observed.items():
        if name not in camera.sigma:
            raise InputError(
                f"{where}observed is given for {name!r}, which has no sigma (sigma: "
                f"{', '.join(camera.sigma) or 'none'}); add it, or give a start value"
            )
        if not math.isfinite(value):
            raise InputError(f"{where}observed value of {name} is {value}; it must be finite")
    _check_ties(camera, values, where)
    _check_pair(where, "image_size", camera.image_size, "[columns, rows]")
    _check_pair(where, "pixel_size", camera.pixel_size, "[width, height] in mm")


def _check_fields(camera: Camera, where: str) -> None:
    """Refuse fields that are not numbers by name, names, or groups of names."""
    if not isinstance(camera.model, str | CameraModel):
        raise InputError(f"{where}model is {show(camera.model)}; expected a name or a CameraModel")
    for field in ("parameters", "sigma", "observed"):
        field_value = getattr(camera, field)
        if not isinstance(field_value, Mapping):
            raise InputError(
                f"{where}{field} is {show(field_value)}; expected numbers by name, such as "
                "{'c': 20.0}"
            )
    if not _are_names(camera.free):
        raise InputError(
            f"{where}free is {show(camera.free)}; expected names of parameters, such as ('c', 'x0')"
        )
    if not isinstance(camera.tie, list | tuple) or not all(map(_are_names, camera.tie)):
        raise InputError(
            f"{where}tie is {show(camera.tie)}; expected groups of names, such as [('fx', 'fy')]"
        )


def _are_names(names: Any) -> bool:
    return isinstance(names, list | tuple) and all(isinstance(name, str) for name in names)


def _check_ties(camera: Camera, values: Mapping[str, float], where: str) -> None:
    """Refuse ties of unknown parameters, of one in two groups, of different start values."""
    names = [name for group in camera.tie for name in group]
    known_parameters = get_model(camera.model).parameters
    for name in names:
        if name not in known_parameters:
            raise InputError(
                f"{where}tie names the unknown parameter "
                f"{name!r}{did_you_mean(name, known_parameters)}"
            )
        if names.count(name) > 1:
            raise InputError(f"{where}tie names {name} twice")
    for group in camera.tie:
        if len({values.get(name, 0.0) for name in group}) > 1:
            start = ", ".join(f"{name} {values.get(name, 0.0):g}" for name in group)
            raise InputError(
                f"{where}tied parameters are one unknown, but have different values: {start}"
            )


def _check_pair(where: str, name: str, pair: Any, meaning: str) -> None:
    # The number under a mask is no size.
    numbers = np.shape(pair) == (2,) and not isinstance(pair, np.ma.MaskedArray)
    if pair is not None and not (numbers and all(map(_is_positive, pair))):
        raise InputError(f"{where}{name} is {show(pair)}; expected {meaning}, both positive")


def check_sigma_image(sigma: float, where: str = "") -> None:
    """Refuse a default σ of image coordinates that is not finite and positive."""
    if isinstance(sigma, bool) or not isinstance(sigma, int | float | np.number):
        raise InputError(f"{where}sigma_image is {show(sigma)}; expected a number")
    _check_sigma(f"{where}sigma_image", sigma)


def _check_sigma(name: str, sigma: Any) -> None:
    """Refuse a σ that cannot be computed with."""
    if not _is_positive(sigma):
        raise InputError(f"{name} is {show(sigma)}; it must be finite and positive")
    if not is_usable_sigma(sigma):
        raise InputError(f"{name} is {show(sigma)}; it must be {sigma_requirement(sigma)}")


def _is_positive(value: Any) -> bool:
    try:
        return math.isfinite(value) and value > 0
    except (OverflowError, TypeError):
        return False
