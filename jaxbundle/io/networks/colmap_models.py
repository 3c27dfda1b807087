"""COLMAP's camera models as ours.

| COLMAP | parameters | ours |
|---|---|---|
| SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL | f, cx, cy, k1, k2 | `opencv` with fx and fy tied |
| PINHOLE, OPENCV, FULL_OPENCV | fx, fy, cx, cy, k1, k2, p1, p2, k3 … k6 | `opencv` |
| SIMPLE_FISHEYE, SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE | f, cx, cy, k1, k2 | `kannala-brandt` |
| FISHEYE, OPENCV_FISHEYE | fx, fy, cx, cy, k1 … k4 | `kannala-brandt` |

COLMAP counts pixels from the corner of the first one: cx = cx_colmap − ½, cy likewise. Models that
are functions of their own are fitted by the nearest of ours (`nearest_camera`), unless their
coefficients make them one of these:

    FOV                         r_d = atan(2·r·tan(ω/2))/ω
    SIMPLE_DIVISION, DIVISION   x_d = 2x/(z + √(z² − 4·k·(x² + y²)))
    EUCM                        x_d = x/(α·√(β·(x² + y²) + z²) + (1 − α)·z)
    THIN_PRISM_FISHEYE          kannala-brandt with p1, p2, and sx1·r², sy1·r² added
    RAD_TAN_THIN_PRISM_FISHEYE  kannala-brandt with k0 … k5, then p0, p1 and s0 … s3 of that

EQUIRECTANGULAR is refused by name.

Source: COLMAP 4.2, src/colmap/sensor/models.h, for names, numbers and order of the parameters, and
the formulas of the models that are fitted.
"""

from collections.abc import Callable, Sequence
from functools import partial

import jax.numpy as jnp
import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.io.cameras.nearest_camera import Foreign, NoPlaceError, fitted_camera, root
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.network.tables import Camera

HALF = 0.5
"""A pixel's centre seen from its corner."""

_RADIAL = ("f", "cx", "cy", "k1", "k2")
_OPENCV = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")

MODELS: dict[str, tuple[int, str, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (0, "opencv", _RADIAL[:3]),
    "PINHOLE": (1, "opencv", _OPENCV[:4]),
    "SIMPLE_RADIAL": (2, "opencv", _RADIAL[:4]),
    "RADIAL": (3, "opencv", _RADIAL),
    "OPENCV": (4, "opencv", _OPENCV[:8]),
    "FULL_OPENCV": (6, "opencv", _OPENCV),
    "SIMPLE_FISHEYE": (14, "kannala-brandt", _RADIAL[:3]),
    "FISHEYE": (15, "kannala-brandt", _FISHEYE[:4]),
    "SIMPLE_RADIAL_FISHEYE": (8, "kannala-brandt", _RADIAL[:4]),
    "RADIAL_FISHEYE": (9, "kannala-brandt", _RADIAL),
    "OPENCV_FISHEYE": (5, "kannala-brandt", _FISHEYE),
}
"""Number in binary files, our model, parameters in their order."""

_PRISM = ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1")
_RAD_TAN = ("k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1", "s0", "s1", "s2", "s3")
FITTED: dict[str, tuple[int, tuple[str, ...]]] = {
    "FOV": (7, (*_OPENCV[:4], "omega")),
    "THIN_PRISM_FISHEYE": (10, (*_OPENCV[:4], *_PRISM)),
    "RAD_TAN_THIN_PRISM_FISHEYE": (11, (*_OPENCV[:4], *_RAD_TAN)),
    "SIMPLE_DIVISION": (12, ("f", "cx", "cy", "k")),
    "DIVISION": (13, (*_OPENCV[:4], "k")),
    "EUCM": (16, (*_OPENCV[:4], "alpha", "beta")),
}
"""Number in binary files, parameters in their order, of what is fitted."""
OTHERS = {17: "EQUIRECTANGULAR"}
NAMES = {number: name for name, (number, *_) in (MODELS | FITTED).items()} | OTHERS


def parameter_names(model: str, error: Callable[[str], InputError]) -> tuple[str, ...]:
    """The names of the parameters of a COLMAP model.

    **Raises:** what `error` makes of the message, for a model that has no counterpart here.
    """
    if model in FITTED:
        return FITTED[model][1]
    if model not in MODELS:
        known = "is not offered here" if model in OTHERS.values() else "is unknown"
        raise error(
            f"the camera model {model[:40]} {known}; these are: {', '.join((*MODELS, *FITTED))}"
        )
    return MODELS[model][2]


def from_colmap(
    id: str, model: str, size: Sequence[int], values: Sequence[float], where: str = ""
) -> Camera:
    """A camera of ours from one of COLMAP's, a `FittedCamera` where it is none of ours.

    **Raises:** `NoPlaceError` that begins with `where`, if none of ours comes near it.
    """
    names = FITTED[model][1] if model in FITTED else MODELS[model][2]
    p = dict(zip(names, map(float, values)))
    f = p.pop("f", None)
    if f is not None:
        p = {"fx": f, "fy": f} | p
    p["cx"], p["cy"] = p["cx"] - HALF, p["cy"] - HALF
    ours, exact = (MODELS[model][1], p) if model in MODELS else _exact(model, p)
    if exact is None:
        start = {name: p[name] for name in ("fx", "fy", "cx", "cy")}
        if model == "FOV":
            wide = 2 * np.tan(p["omega"] / 2) / p["omega"]
            start |= {"fx": p["fx"] * wide, "fy": p["fy"] * wide}
        foreign = Foreign(FORMULAS[model], p, start, size, fisheye=True)
        return fitted_camera(id, foreign, f"{where}camera {id!r}", f"is of COLMAP's model {model}")
    tie = (("fx", "fy"),) if f is not None else ()
    return Camera(id, ours, exact, image_size=(int(size[0]), int(size[1])), tie=tie)


def camera_or_why_not(*camera) -> Camera | NoPlaceError:
    """A camera as by `from_colmap`, or why there is none: its images can be left out."""
    try:
        return from_colmap(*camera)
    except NoPlaceError as error:
        return error


def _exact(model: str, p: dict) -> tuple[str, dict | None]:
    """The model that a camera would be without its own terms, and its parameters if it is."""
    plain = {name: p[name] for name in ("fx", "fy", "cx", "cy")}
    radial = {"THIN_PRISM_FISHEYE": ("k1", "k2", "k3", "k4"),
              "RAD_TAN_THIN_PRISM_FISHEYE": ("k0", "k1", "k2", "k3")}.get(model)  # fmt: skip
    if radial is None:
        off = p[{"FOV": "omega", "EUCM": "alpha"}.get(model, "k")]
        return "opencv", plain if off == 0 else None
    rest = [value for name, value in p.items() if name not in (*plain, *radial)]
    ours = plain | {f"k{i}": p[name] for i, name in enumerate(radial, 1)}
    return "kannala-brandt", None if any(rest) else ours


def _image(model: str, p: dict, X, Y, Z):
    """Pixels from the centre of the first one, by COLMAP's formulas."""
    square = X * X + Y * Y
    rho = root(square)
    some = jnp.where(rho > 0, rho, 1.0)
    if "FISHEYE" in model:
        scale = jnp.where(rho > 0, jnp.arctan2(rho, Z) / some, 1.0)
        x, y = (_thin_prism if model == "THIN_PRISM_FISHEYE" else _rad_tan)(p, X * scale, Y * scale)
    else:
        if model == "FOV":
            angle = jnp.arctan2(2 * rho * jnp.tan(p["omega"] / 2), Z) / p["omega"]
            limit = 2 * jnp.tan(p["omega"] / 2) / (p["omega"] * Z)
            scale = jnp.where(rho > 0, angle / some, limit)
        elif model == "EUCM":
            scale = 1 / (p["alpha"] * jnp.sqrt(p["beta"] * square + Z * Z) + (1 - p["alpha"]) * Z)
        else:
            scale = 2 / (Z + jnp.sqrt(Z * Z - 4 * p["k"] * square))
        x, y = X * scale, Y * scale
    return jnp.stack([p["fx"] * x + p["cx"], p["fy"] * y + p["cy"]])


FORMULAS = {model: partial(_image, model) for model in FITTED}


def _thin_prism(p: dict, x, y):
    r2 = x * x + y * y
    radial = 1 + r2 * (p["k1"] + r2 * (p["k2"] + r2 * (p["k3"] + r2 * p["k4"])))
    xd = x * radial + 2 * p["p1"] * x * y + p["p2"] * (r2 + 2 * x * x) + p["sx1"] * r2
    yd = y * radial + 2 * p["p2"] * x * y + p["p1"] * (r2 + 2 * y * y) + p["sy1"] * r2
    return xd, yd


def _rad_tan(p: dict, x, y):
    t2 = x * x + y * y
    radial = 1 + sum(p[f"k{i}"] * t2 ** (i + 1) for i in range(6))
    x, y = x * radial, y * radial
    r2 = x * x + y * y
    xd = x + 2 * p["p1"] * x * y + p["p0"] * (r2 + 2 * x * x) + r2 * (p["s0"] + r2 * p["s1"])
    yd = y + 2 * p["p0"] * x * y + p["p1"] * (r2 + 2 * y * y) + r2 * (p["s2"] + r2 * p["s3"])
    return xd, yd


def size_of(camera: Camera) -> tuple[int, int]:
    """The size of its images.

    **Raises:** `InputError` without one."""
    if camera.image_size is None:
        raise InputError(f"camera {camera.id!r}: COLMAP needs the image size; give image_size")
    return camera.image_size


def to_colmap(camera: Camera) -> tuple[str, list[float]]:
    """The smallest of COLMAP's models that holds a camera exactly, and its parameters.

    **Raises:** `InputError` for another model, without image size, and for a thin prism.
    """
    where = f"camera {camera.id!r}"
    candidates = [(name, names) for name, (_, ours, names) in MODELS.items()
                  if ours == camera.model]  # fmt: skip
    if not candidates:
        raise InputError(
            f"{where}: COLMAP has no model {str(camera.model)!r}; convert it with --model opencv"
        )
    size_of(camera)
    p = all_parameters(camera)
    p["cx"], p["cy"] = p["cx"] + HALF, p["cy"] + HALF
    given = {name for name, value in p.items() if value != 0 or name in ("cx", "cy")}
    if p["fx"] == p["fy"]:
        given = given - {"fx", "fy"} | {"f"}
        p["f"] = p["fx"]
    for name, names in candidates:
        if given <= {*names, *(("f",) if "fx" in names else ())}:
            return name, [p[key] for key in names]
    raise InputError(f"{where}: COLMAP has no thin prism (s1 to s4); convert it without them")
