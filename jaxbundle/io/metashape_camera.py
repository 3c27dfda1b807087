"""A sensor of Metashape as one of our cameras.

[X, Y, Z] of a camera are right, down, forward. Its image of X, with x = X/Z, y = Y/Z, r² = x² + y²:

    x' = x·(1 + k1·r² + k2·r⁴ + k3·r⁶ + k4·r⁸) + p1·(r² + 2x²) + 2·p2·x·y
    y' = y·(1 + …)                             + p2·(r² + 2y²) + 2·p1·x·y
    u = w/2 + cx + x'·f + x'·b1 + y'·b2        v = h/2 + cy + y'·f

from the corner of the first pixel, hence in `opencv`, exactly if k4 = b2 = 0,

    fx = f + b1   fy = f   cx_cv = w/2 + cx − ½   cy_cv = h/2 + cy − ½   p1_cv = p2   p2_cv = p1

With a skew b2 or with k4 it is fitted as `brown-projected`, which has the affine terms, if the file
tells the pixel size; refused if that leaves more than 0.05 px somewhere. p3, p4 and sensors that
are no frame cameras have no place in our models and are refused by name.

Source: Agisoft Metashape user manual, appendix "Camera models".
"""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from jaxbundle.cameras import get_model
from jaxbundle.cameras.convert import MEASURABLE
from jaxbundle.cameras.convert_fit import (
    fit_parameters,
    image_grid,
    images_of,
    rays_of,
    start_values,
)
from jaxbundle.cameras.frames import pixel_frame
from jaxbundle.errors import InputError
from jaxbundle.network.columns import shown

COEFFICIENTS = ("f", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b1", "b2")
GOOD = 0.05
"""Pixels a fit may leave."""


def sensor_camera(path: Path, sensor: ET.Element) -> tuple[dict, tuple[str, ...]]:
    """The entry of a sensor in a document, and a warning where it is fitted.

    **Raises:** `InputError` naming file, sensor and element.
    """
    label = label_of(sensor)
    where = f"{path}, sensor {label!r}"
    kinds = sensor.findall("calibration")
    if not kinds:
        raise InputError(f"{where}: there is no <calibration>")
    calibration = next((c for c in kinds if c.get("class") == "adjusted"), kinds[0])
    for element in (sensor, calibration):
        if element.get("type", "frame") != "frame":
            raise InputError(
                f"{where}: sensors of type {shown(element.get('type'))} are not offered; frame is"
            )
    size = calibration.find("resolution")
    size = sensor.find("resolution") if size is None else size
    if size is None:
        raise InputError(f"{where}: there is no <resolution>")
    w, h = (number_of(f"{where}, resolution, {k}", size.get(k)) for k in ("width", "height"))
    p = dict.fromkeys(COEFFICIENTS, 0.0)
    for element in calibration:
        if element.tag in ("fx", "fy", "skew"):
            raise InputError(f"{where}: <{element.tag}> is of an old version; f, b1, b2 are known")
        if element.tag in p:
            p[element.tag] = number_of(f"{where}, {element.tag}", element.text)
    for name in ("p3", "p4"):
        if p[name] != 0:
            raise InputError(
                f"{where}: {name} is {p[name]:g} and has no place in our models; optimise the "
                f"cameras without {name} and export again"
            )
    values = {
        "fx": p["f"] + p["b1"], "fy": p["f"],
        "cx": w / 2 + p["cx"] - 0.5, "cy": h / 2 + p["cy"] - 0.5,
        "k1": p["k1"], "k2": p["k2"], "k3": p["k3"], "p1": p["p2"], "p2": p["p1"],
    }  # fmt: skip
    entry = {"id": label, "image_size": [w, h]}
    if p["b2"] == p["k4"] == 0:
        return entry | {"model": "opencv", **values}, ()
    return _fitted(where, sensor, entry, p, values)


def _fitted(where: str, sensor: ET.Element, entry: dict, p: dict, values: dict):
    """The sensor as `brown-projected`, and what that costs."""
    pitch = {e.get("name"): e.get("value") for e in sensor.iterfind("property")}
    names = ("pixel_width", "pixel_height")
    if not all(name in pitch for name in names):
        raise InputError(
            f"{where}: b2 or k4 is not 0, and without the pixel size (property pixel_width, "
            "pixel_height) there is no model for it; optimise the cameras without it"
        )
    pixel = [number_of(f"{where}, {name}", pitch[name]) for name in names]
    size, sizes = entry["image_size"], (entry["image_size"], pixel)
    if not (np.array([*size, *pixel, values["fx"], values["fy"]]) > 0).all():
        raise InputError(f"{where}: sizes and f must be positive")
    source, target = get_model("opencv"), get_model("brown-projected")
    full = dict.fromkeys(source.parameters, 0.0) | values
    rays = rays_of(source, full, image_grid([-0.5, -0.5], np.array(size) - 0.5))
    there = np.isfinite(rays).all(1)
    if there.mean() < MEASURABLE:
        raise InputError(f"{where}: its distortion turns back inside the image")
    rays = rays[there]
    with np.errstate(all="ignore"):
        uv = _published(p, size, *(rays * [1, -1, -1]).T)
    origin, step = pixel_frame(target, *sizes)
    xy = (uv - origin) / step
    try:
        found = fit_parameters(target, rays, xy, start_values(source, full, target, sizes))
    except ValueError as error:
        raise InputError(f"{where}: {error}") from None
    left = np.linalg.norm((images_of(target, found, rays) - xy) * step, axis=1).max()
    if not left <= GOOD:  # also where it is NaN
        raise InputError(
            f"{where}: b2 {p['b2']:g} and k4 {p['k4']:g} have no place in our models; the nearest, "
            f"brown-projected, differs by {left:.3g} px; optimise the cameras without them"
        )
    warning = (
        f"sensor {entry['id']!r} has b2 or k4: fitted as brown-projected, largest difference "
        f"{left:.2g} px"
    )
    return entry | {"model": target.name, "pixel_size": pixel, **found}, (warning,)


def _published(p: dict, size, X, Y, Z):
    """The manual's formula, from the centre of the first pixel."""
    x, y = X / Z, Y / Z
    r2 = x * x + y * y
    radial = 1 + r2 * (p["k1"] + r2 * (p["k2"] + r2 * (p["k3"] + r2 * p["k4"])))
    xd = x * radial + p["p1"] * (r2 + 2 * x * x) + 2 * p["p2"] * x * y
    yd = y * radial + p["p2"] * (r2 + 2 * y * y) + 2 * p["p1"] * x * y
    u = size[0] / 2 + p["cx"] + xd * (p["f"] + p["b1"]) + yd * p["b2"]
    return np.stack([u, size[1] / 2 + p["cy"] + yd * p["f"]], 1) - 0.5


def label_of(element: ET.Element) -> str:
    """What an element is called."""
    return element.get("label") or element.get("id") or "?"


def numbers_of(where: str, text: str | None, n: int) -> np.ndarray:
    """So many finite numbers."""
    words = (text or "").split()
    if len(words) != n:
        raise InputError(f"{where}: {len(words)} numbers where {n} are expected")
    return np.array([number_of(where, word) for word in words])


def number_of(where: str, text: str | None) -> float:
    """A finite number."""
    try:
        number = float(text or "")
    except ValueError:
        number = np.nan
    if not np.isfinite(number):
        raise InputError(f"{where}: {shown(text)} where a number is expected")
    return number
