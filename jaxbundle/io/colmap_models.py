"""COLMAP's camera models as ours.

| COLMAP | parameters | ours |
|---|---|---|
| SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL | f, cx, cy, k1, k2 | `opencv` with fx = fy |
| PINHOLE, OPENCV, FULL_OPENCV | fx, fy, cx, cy, k1, k2, p1, p2, k3 … k6 | `opencv` |
| SIMPLE_FISHEYE, SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE | f, cx, cy, k1, k2 | `kannala-brandt` |
| FISHEYE, OPENCV_FISHEYE | fx, fy, cx, cy, k1 … k4 | `kannala-brandt` |

COLMAP counts pixels from the corner of the first one: cx = cx_colmap − ½, cy likewise. Its other
models (FOV, THIN_PRISM_FISHEYE, …) are refused by name.

Source: COLMAP 4.2, src/colmap/sensor/models.h, for names, numbers and order of the parameters.
"""

from collections.abc import Callable, Sequence

from jaxbundle.errors import InputError
from jaxbundle.io.assemble import all_parameters
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

OTHERS = {
    7: "FOV", 10: "THIN_PRISM_FISHEYE", 11: "RAD_TAN_THIN_PRISM_FISHEYE", 12: "SIMPLE_DIVISION",
    13: "DIVISION", 16: "EUCM", 17: "EQUIRECTANGULAR",
}  # fmt: skip
NAMES = {number: name for name, (number, _, _) in MODELS.items()} | OTHERS


def parameter_names(model: str, error: Callable[[str], InputError]) -> tuple[str, ...]:
    """The names of the parameters of a COLMAP model.

    **Raises:** what `error` makes of the message, for a model that has no counterpart here.
    """
    if model not in MODELS:
        known = "is not offered here" if model in OTHERS.values() else "is unknown"
        raise error(f"the camera model {model[:40]} {known}; these are: {', '.join(MODELS)}")
    return MODELS[model][2]


def from_colmap(id: str, model: str, size: Sequence[int], values: Sequence[float]) -> Camera:
    """A camera of ours from one of COLMAP's."""
    _, ours, names = MODELS[model]
    p = dict(zip(names, map(float, values)))
    f = p.pop("f", None)
    if f is not None:
        p = {"fx": f, "fy": f} | p
    p["cx"], p["cy"] = p["cx"] - HALF, p["cy"] - HALF
    return Camera(id, ours, p, image_size=(int(size[0]), int(size[1])))


def to_colmap(camera: Camera) -> tuple[str, list[float]]:
    """The smallest of COLMAP's models that holds a camera exactly, and its parameters.

    **Raises:** `InputError` for another model, without image size, and for a thin prism.
    """
    where = f"camera {camera.id!r}"
    candidates = [(name, names) for name, (_, ours, names) in MODELS.items()
                  if ours == camera.model]  # fmt: skip
    if not candidates:
        raise InputError(
            f"{where}: COLMAP has no model {camera.model!r}; convert it with --model opencv"
        )
    if camera.image_size is None:
        raise InputError(f"{where}: COLMAP needs the image size; give image_size")
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
