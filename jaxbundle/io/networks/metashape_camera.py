"""A sensor of Metashape as one of our cameras.

[X, Y, Z] of a camera are right, down, forward. Its image of X, with x = X/Z, y = Y/Z, r² = x² + y²:

    x' = x·(1 + k1·r² + k2·r⁴ + k3·r⁶ + k4·r⁸) + (p1·(r² + 2x²) + 2·p2·x·y)·(1 + p3·r² + p4·r⁴)
    y' = y·(1 + …)                             + (p2·(r² + 2y²) + 2·p1·x·y)·(1 + p3·r² + p4·r⁴)
    u = w/2 + cx + x'·f + x'·b1 + y'·b2        v = h/2 + cy + y'·f

from the corner of the first pixel, hence in `opencv`, exactly if k4 = p3 = p4 = b2 = 0 (where p1
and p2 are 0, p3 and p4 have no effect),

    fx = f + b1   fy = f   cx_cv = w/2 + cx − ½   cy_cv = h/2 + cy − ½   p1_cv = p2   p2_cv = p1

A fisheye has (x, y) = (X, Y)/√(X² + Y²)·θ, θ the angle to the axis, in the same formula, or
2·sin(θ/2) for θ (equisolid); the first is exactly `kannala-brandt` if p1 = p2 = b2 = 0. A spherical
sensor is `equirectangular` with f = w/(2π). Before an alignment f follows from the focal length and
the pixel size in mm (`property`). Everything
else is fitted by the nearest model, with a warning that gives the largest difference.

Old exports (PhotoScan to 1.2) have fx, fy, skew for f, b1, b2, cx and cy from the corner of the
image, and p1 and p2 exchanged.

Source: Agisoft Metashape user manual, appendix "Camera models"; PhotoScan user manual 1.2, the same
appendix.
"""

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxbundle.arguments import show
from jaxbundle.cameras.scalars import Scalar
from jaxbundle.errors import InputError
from jaxbundle.io.cameras.nearest_camera import Foreign, NoPlaceError, nearest_camera, root
from jaxbundle.io.networks.assemble import PIXEL_CENTRE
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.io.text.xml_fields import number_in

COEFFICIENTS = ("f", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b1", "b2")
OLD_COEFFICIENTS = ("fx", "fy", "skew")
FISHEYE = ("fisheye", "equidistant", "equidistant_fisheye", "equisolid", "equisolid_fisheye")
TYPES = ("frame", *FISHEYE)
SPHERICAL = "spherical"
CALIBRATION_KEYS = Keys(
    ("resolution", "type", "class", *COEFFICIENTS, *OLD_COEFFICIENTS),
    {"date": "when it was saved", "label": "the name of the camera"},
)
SENSOR_KEYS = Keys(
    ("id", "label", "type", "resolution", "calibration", "property"),
    {
        **dict.fromkeys(
            ("bands", "data_type", "black_level", "sensitivity", "vignetting", "planes", "meta"),
            "brightness",
        ),
        "covariance": "σ of the calibration, which an adjustment gives anew",
        **dict.fromkeys(
            ("master_id", "location", "rotation", "layer_index", "location_covariance",
             "rotation_covariance", "reference"),
            "a rig of sensors: every camera has a transform of its own",
        ),
    },
    {"rolling_shutter": "one pose a photograph is read", "film": "fiducial marks are not read",
     "fiducials": "the image is taken as digital"},
)  # fmt: skip
PIXEL = ("pixel_width", "pixel_height")


def sensor_camera(path: Path, sensor: ET.Element) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The entry of a sensor in a document, and warnings about a fit.

    **Raises:** `InputError` naming file, sensor and element; `NoPlaceError` for a sensor of
    another kind, of size 0, or that no model fits.
    """
    label = label_of(sensor)
    where = f"{path}, sensor {label!r}"
    kinds = sensor.findall("calibration")
    if sensor.get("type") == SPHERICAL:
        return _spherical_camera(where, label, sensor), ()
    kinds = kinds or _nominal_calibration(where, sensor)
    if not kinds:
        raise NoPlaceError(f"{where}: there is no <calibration>")
    calibration = next((c for c in kinds if c.get("class") == "adjusted"), kinds[0])
    kind = calibration.get("type", sensor.get("type", "frame"))
    for name in (sensor.get("type", "frame"), kind):
        if name not in TYPES:
            raise NoPlaceError(
                f"{where}: sensors of type {show(name)} are not offered; these are: "
                f"{', '.join((*TYPES, SPHERICAL))}"
            )
    w, h = _image_size(where, sensor if calibration.find("resolution") is None else calibration)
    p = _coefficients(where, calibration, w, h)
    values = {
        "fx": p["f"] + p["b1"],
        "fy": p["f"],
        "cx": w / 2 + p["cx"] - PIXEL_CENTRE,
        "cy": h / 2 + p["cy"] - PIXEL_CENTRE,
        "k1": p["k1"],
        "k2": p["k2"],
        "k3": p["k3"],
    }
    if not (np.array([w, h, values["fx"], values["fy"]]) > 0).all():
        raise NoPlaceError(f"{where}: sizes and f must be positive")
    entry = {"id": label, "image_size": [w, h]}
    decentred = p["p1"] != 0 or p["p2"] != 0  # p3 and p4 are factors of these terms
    if kind == "frame":
        values |= {"p1": p["p2"], "p2": p["p1"]}
        extra_terms = {name: p[name] for name in ("k4", "b2", *(("p3", "p4") if decentred else ()))}
    else:
        values |= {"k4": p["k4"]}
        extra_terms = {name: p[name] for name in ("p1", "p2", "b2")}
    extra_terms = {name: value for name, value in extra_terms.items() if value != 0}
    if not extra_terms and "equisolid" not in kind:
        return entry | {"model": "opencv" if kind == "frame" else "kannala-brandt", **values}, ()
    foreign = Foreign(
        FORMULAS[kind],
        p | {"w": w, "h": h},
        values,
        (w, h),
        _pixel_size(where, sensor),
        kind != "frame",
    )
    fitted, fit = nearest_camera(foreign, where)
    terms_text = "".join(f"{name} {value:g}, " for name, value in extra_terms.items()).rstrip(", ")
    reason = f"has {terms_text}" if terms_text else "is equisolid"
    return entry | fitted, (f"sensor {label!r} {reason}: {fit}",)


def _spherical_camera(where: str, label: str, sensor: ET.Element) -> dict[str, Any]:
    """u = w/2 + f·atan2(X, Z), v = h/2 + f·atan2(Y, √(X² + Z²)), f = w/(2π)."""
    w, h = _image_size(where, sensor)
    f = w / (2 * np.pi)
    core = {"fx": f, "fy": f, "cx": w / 2 - PIXEL_CENTRE, "cy": h / 2 - PIXEL_CENTRE}
    return {"id": label, "image_size": [w, h], "model": "equirectangular", **core}


def _nominal_calibration(where: str, sensor: ET.Element) -> list[ET.Element]:
    """The calibration that the properties of a sensor give before an alignment: f from the focal
    length and the pixel size in mm."""
    properties = {e.get("name"): e.get("value") for e in sensor.iterfind("property")}
    pixel = _pixel_size(where, sensor)
    if pixel is None or not properties.get("focal_length"):
        return []
    focal = number_in(properties["focal_length"] or "", f"{where}, focal_length")
    calibration = ET.Element("calibration", {"class": "initial"})
    ET.SubElement(calibration, "f").text = repr(focal / pixel[0])
    return [calibration] if focal > 0 else []


def _image_size(where: str, element: ET.Element) -> tuple[float, float]:
    size = element.find("resolution")
    if size is None:
        raise InputError(f"{where}: there is no <resolution>")
    w, h = (number_in(size.get(k, ""), f"{where}, resolution, {k}") for k in ("width", "height"))
    return w, h


def _coefficients(where: str, calibration: ET.Element, w: float, h: float) -> dict[str, float]:
    """All coefficients in the current form."""
    tags = [element.tag for element in calibration]
    repeated_tag = next(
        (tag for tag in (*COEFFICIENTS, *OLD_COEFFICIENTS) if tags.count(tag) > 1), None
    )
    if repeated_tag:
        raise InputError(f"{where}: <{repeated_tag}> occurs twice")
    values = {
        element.tag: number_in(element.text or "", f"{where}, {element.tag}")
        for element in calibration
        if element.tag in (*COEFFICIENTS, *OLD_COEFFICIENTS)
    }
    old = "f" not in values and "fy" in values
    foreign_tags = ("f", "b1", "b2") if old else OLD_COEFFICIENTS
    if mixed_tags := [tag for tag in foreign_tags if values.get(tag)]:
        raise InputError(
            f"{where}: {', '.join(mixed_tags)} beside {'fy' if old else 'f'}; expected f, b1 and "
            "b2, or fx, fy and skew"
        )
    p = dict.fromkeys(COEFFICIENTS, 0.0) | {
        k: v for k, v in values.items() if k not in foreign_tags
    }
    if old:
        fy = p.pop("fy")
        p |= {
            "f": fy,
            "b1": p.pop("fx", fy) - fy,
            "b2": p.pop("skew", 0.0),
            "cx": values.get("cx", w / 2) - w / 2,
            "cy": values.get("cy", h / 2) - h / 2,
            "p1": p["p2"],
            "p2": p["p1"],
        }
    return p


def check_sensor(unknown: UnknownKeys, sensor: ET.Element, where: str) -> None:
    """Notice what a sensor has and the reader does not know; coefficients that are 0 do not count.

    **Raises:** `InputError` for what may change the geometry."""
    unknown.check_element(sensor, SENSOR_KEYS, where)
    for calibration in sensor.iterfind("calibration"):
        names = [e.tag for e in calibration if isinstance(e.tag, str) and not _is_zero(e.text)]
        unknown.check((*names, *calibration.attrib), CALIBRATION_KEYS, where)


def _is_zero(text: str | None) -> bool:
    try:
        return float(text or "") == 0
    except ValueError:
        return False


def _pixel_size(where: str, sensor: ET.Element) -> list[float] | None:
    properties = {e.get("name"): e.get("value") for e in sensor.iterfind("property")}
    if not all(name in properties for name in PIXEL):
        return None
    pixel = [number_in(properties[name] or "", f"{where}, {name}") for name in PIXEL]
    return pixel if min(pixel) > 0 else None


def _project_metashape(
    kind: str, p: Mapping[str, Scalar], X: Scalar, Y: Scalar, Z: Scalar
) -> Float[Array, "2"]:
    """The manual's formula, from the centre of the first pixel."""
    if kind == "frame":
        x, y = X / Z, Y / Z
    else:
        radius = root(X * X + Y * Y)
        angle = jnp.arctan2(radius, Z)
        length = 2 * jnp.sin(angle / 2) if "equisolid" in kind else angle
        scale = jnp.where(radius > 0, length / jnp.where(radius > 0, radius, 1.0), 1.0)
        x, y = X * scale, Y * scale
    r2 = x * x + y * y
    radial = 1 + r2 * (p["k1"] + r2 * (p["k2"] + r2 * (p["k3"] + r2 * p["k4"])))
    tangential_factor = 1 + r2 * (p["p3"] + r2 * p["p4"])
    xd = x * radial + (p["p1"] * (r2 + 2 * x * x) + 2 * p["p2"] * x * y) * tangential_factor
    yd = y * radial + (p["p2"] * (r2 + 2 * y * y) + 2 * p["p1"] * x * y) * tangential_factor
    u = p["w"] / 2 + p["cx"] + xd * (p["f"] + p["b1"]) + yd * p["b2"]
    return jnp.stack([u, p["h"] / 2 + p["cy"] + yd * p["f"]]) - PIXEL_CENTRE


FORMULAS = {kind: partial(_project_metashape, kind) for kind in TYPES}


def label_of(element: ET.Element) -> str:
    """The name of an element."""
    return element.get("label") or element.get("id") or "?"


def numbers_of(where: str, text: str | None, n: int) -> Float[np.ndarray, " n"]:
    """The given number of finite numbers."""
    words = (text or "").split()
    if len(words) != n:
        raise InputError(f"{where}: {len(words)} numbers where {n} are expected")
    return np.array([number_in(word, where) for word in words])
