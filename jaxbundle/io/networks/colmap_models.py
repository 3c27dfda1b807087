"""COLMAP's camera models as ours.

| COLMAP | parameters | ours |
|---|---|---|
| SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL | f, cx, cy, k1, k2 | `opencv` with fx and fy tied |
| PINHOLE, OPENCV, FULL_OPENCV | fx, fy, cx, cy, k1, k2, p1, p2, k3 … k6 | `opencv` |
| SIMPLE_FISHEYE, SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE | f, cx, cy, k1, k2 | `kannala-brandt` |
| FISHEYE, OPENCV_FISHEYE | fx, fy, cx, cy, k1 … k4 | `kannala-brandt` |
| FOV, EUCM, DIVISION, THIN_PRISM_FISHEYE, RAD_TAN_THIN_PRISM_FISHEYE | | of the same names |
| SIMPLE_DIVISION | f, cx, cy, k | `division` |
| EQUIRECTANGULAR | w, h | `equirectangular`, fx = w/(2π), fy = h/π, its centre |

COLMAP counts pixels from the corner of the first one: cx = cx_colmap − ½, cy likewise. FOV with
ω = 0 is `opencv`.

Source: COLMAP 4.2, src/colmap/sensor/models.h, for names, numbers and order of the parameters.
"""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.io.networks.assemble import PIXEL_CENTRE, all_parameters
from jaxbundle.io.networks.losses import size_of
from jaxbundle.network.tables import Camera

_RADIAL = ("f", "cx", "cy", "k1", "k2")
_OPENCV = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")

# Number in binary files, our model, parameters in their order.
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
    "FOV": (7, "fov", (*_OPENCV[:4], "omega")),
    "THIN_PRISM_FISHEYE": (10, "thin-prism-fisheye", (*_OPENCV[:8], "k3", "k4", "sx1", "sy1")),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        11,
        "rad-tan-thin-prism-fisheye",
        (*_OPENCV[:4], "k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1", "s0", "s1", "s2", "s3"),
    ),
    "SIMPLE_DIVISION": (12, "division", ("f", "cx", "cy", "k")),
    "DIVISION": (13, "division", (*_OPENCV[:4], "k")),
    "EUCM": (16, "eucm", (*_OPENCV[:4], "alpha", "beta")),
    "EQUIRECTANGULAR": (17, "equirectangular", ("w", "h")),
}
NAMES = {number: name for name, (number, *_) in MODELS.items()}
# Our models that COLMAP has.
COLMAP_MODELS = tuple(dict.fromkeys(our_model for _, our_model, _ in MODELS.values()))


def parameter_names(model: str, error: Callable[[str], InputError]) -> tuple[str, ...]:
    """The names of the parameters of a COLMAP model.

    **Raises:** `error` with a message, for a model without a counterpart here.
    """
    if model not in MODELS:
        raise error(f"the camera model {model[:40]} is unknown; these are: {', '.join(MODELS)}")
    return MODELS[model][2]


def from_colmap(id: str, model: str, size: Sequence[int], values: Iterable[float]) -> Camera:
    """Our camera from one of COLMAP."""
    _, our_model, names = MODELS[model]
    p = dict(zip(names, map(float, values)))
    size = int(size[0]), int(size[1])
    if model == "EQUIRECTANGULAR":
        return Camera(id, our_model, _panorama(p["w"], p["h"]), image_size=size)
    f = p.pop("f", None)
    if f is not None:
        p = {"fx": f, "fy": f} | p
    p["cx"], p["cy"] = p["cx"] - PIXEL_CENTRE, p["cy"] - PIXEL_CENTRE
    if model == "FOV" and p["omega"] == 0:  # its formula divides by ω; the limit has no distortion
        our_model = "opencv"
        del p["omega"]
    tie = (("fx", "fy"),) if f is not None else ()
    return Camera(id, our_model, p, image_size=size, tie=tie)


def _panorama(width: float, height: float) -> dict[str, float]:
    return {
        "fx": width / (2 * np.pi),
        "fy": height / np.pi,
        "cx": width / 2 - PIXEL_CENTRE,
        "cy": height / 2 - PIXEL_CENTRE,
    }


def to_colmap(camera: Camera) -> tuple[str, list[float]]:
    """The smallest of COLMAP's models that holds a camera exactly, and its parameters.

    **Raises:** `InputError` for another model, without image size, for a thin prism of `opencv`,
    and for an incomplete panorama.
    """
    where = f"camera {camera.id!r}"
    candidates = [
        (name, names) for name, (_, our_model, names) in MODELS.items() if our_model == camera.model
    ]
    if not candidates:
        raise InputError(
            f"{where}: COLMAP has no model {str(camera.model)!r}; convert it with --model opencv"
        )
    size = size_of(camera, "COLMAP")
    p = all_parameters(camera)
    if camera.model == "equirectangular":
        full_panorama = _panorama(*map(float, size))
        if not np.allclose(
            [p[name] for name in full_panorama], [*full_panorama.values()], rtol=1e-12
        ):
            raise InputError(f"{where}: COLMAP has whole panoramas only, of the image size")
        return "EQUIRECTANGULAR", [float(size[0]), float(size[1])]
    p["cx"], p["cy"] = p["cx"] + PIXEL_CENTRE, p["cy"] + PIXEL_CENTRE
    needed_names = {name for name, value in p.items() if value != 0 or name in ("cx", "cy")}
    if p["fx"] == p["fy"]:
        needed_names = needed_names - {"fx", "fy"} | {"f"}
        p["f"] = p["fx"]
    for name, names in candidates:
        # A model of two focal lengths holds equal ones too.
        if needed_names <= {*names, *(("f",) if "fx" in names else ())}:
            return name, [p[key] for key in names]
    raise InputError(f"{where}: COLMAP has no thin prism (s1 to s4); convert it without them")
