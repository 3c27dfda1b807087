r"""Conversions between equivalent camera models.

Two families, each with a common form; a model is converted through it.

**Corrections at the measured point**, mm, y up (`brown`, `usgs`), x, y from the principal point:

    xi = x·(1 + L + ΣK_i·r^2i) + (1 + P3·r² + P4·r⁴)·(P1·(r² + 2x²) + 2·P2·x·y) + b1·x + b2·y

and yi likewise. A ray fixes xi : yi : c only, so c and all coefficients may be divided by a number
T. Balanced at r0, L = −ΣK_i·r0^2i; from L to a balance at r0

    T = 1 + L + ΣK_i·r0^2i,     c, K_i, P_i, b_i  →  the same divided by T

`usgs` holds L itself, as K0.

**Distortions at the projected point** (`brown-projected`, `opencv`, `snavely`), [X, Y] the
perspective image of the ray for the principal distance 1, v down, R² = X² + Y²:

    u = cx + fx·(X·(1 + Σk_i·R^2i) + 2·p1·X·Y + p2·(R² + 2X²) + b1·X − b2·Y)

and v likewise, without b. With s = 1 − ΣK_i·r0^2i, a = s·c, and the pixel size p_x

    fx = a/p_x     k_i = K_i·c^2i/s     p1 = −c·P2/s     p2 = c·P1/s     b_i → b_i/s

Back to `brown-projected` with r0: s from s = 1 − Σk_i·s^(2i+1)·(r0/a)^2i, which is 1 for r0 = 0.

Between the families there is no exact conversion: `convert_fit.py`.

Source: Luhmann, Robson, Kyle and Boehm (2014), Close-Range Photogrammetry and 3D Imaging, for the
balanced form; the rest is elimination.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.pixel_frame import pixel_frame
from jaxbundle.types import Numbers

CORRECTIONS = ("brown", "usgs")
DISTORTIONS = ("brown-projected", "opencv", "snavely")
# Two numbers this close, relatively, are the same: some thousand roundings, and a hundred times
# less than the last digit of any file of camera parameters.
EQUAL = 1e-12

Values = Mapping[str, float]
Sizes = tuple[Numbers | None, Numbers | None]


class NotExact(Exception):
    """Why one model cannot express a camera of another; the text completes "because …"."""


def exact_parameters(
    source: CameraModel, values: Values, target: CameraModel, sizes: Sizes, r0: float = 0.0
) -> dict[str, float]:
    """The parameters of the target model that describe the same camera.

    **Arguments:** `values` all parameters of the source by name; `sizes` image size (pixels) and
    pixel size (mm), each None if unknown; `r0` of the target (mm), if it has one.

    **Raises:** `NotExact` if there are none; `ValueError` if a size is missing.
    """
    if source == target and values.get("r0", 0.0) == (r0 if "r0" in values else 0.0):
        return dict(values)
    pair = {source.name, target.name}
    if pair <= set(CORRECTIONS):
        common = _correction(source.name, values)
        return _as_usgs(common) if target.name == "usgs" else _as_brown(common, r0)
    if pair <= set(DISTORTIONS):
        # Sizes cancel where both count alike.
        if (source.unit, source.axes) == (target.unit, target.axes):
            sizes = ((1, 1), (1, 1))
        return with_distortion(target, distortion(source, values, sizes), sizes, r0)
    raise NotExact(f"{source.name} and {target.name} are different functions")


def _correction(name: str, values: Values) -> dict[str, float]:
    """The common form of a correction."""
    common = dict.fromkeys(("K4", "P3", "P4", "b1", "b2"), 0.0) | dict(values)
    if name == "usgs":
        return common | {"L": common.pop("K0")}
    r0 = common.pop("r0")
    return common | {"L": -sum(common[f"K{i}"] * r0 ** (2 * i) for i in (1, 2, 3))}


def _as_usgs(common: dict[str, float]) -> dict[str, float]:
    _need_zero(common, ("b1", "b2"), "usgs")
    return {"K0": common["L"]} | {k: v for k, v in common.items() if k not in ("L", "b1", "b2")}


def _as_brown(common: dict[str, float], r0: float) -> dict[str, float]:
    _need_zero(common, ("K4", "P3", "P4"), "brown")
    # `brown` has no linear term beside r0: c takes it, and all coefficients are divided by it.
    T = 1 + common["L"] + sum(common[f"K{i}"] * r0 ** (2 * i) for i in (1, 2, 3))
    divided = ("c", "K1", "K2", "K3", "P1", "P2", "b1", "b2")
    return {name: common[name] / T for name in divided} | {
        "x0": common["x0"],
        "y0": common["y0"],
        "r0": r0,
    }


def distortion(source: CameraModel, values: Values, sizes: Sizes) -> dict[str, float]:
    """The common form of a distortion: the parameters of `opencv` and the affine b1, b2."""
    common = dict.fromkeys(
        ("k1", "k2", "k3", "p1", "p2", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "b1", "b2"), 0.0
    )
    if source.name == "opencv":
        return common | dict(values)
    origin, step = np.abs(pixel_frame(source, *sizes))
    if source.name == "snavely":
        return common | {
            "fx": values["f"],
            "fy": values["f"],
            "cx": origin[0],
            "cy": origin[1],
            "k1": values["k1"],
            "k2": values["k2"],
        }
    c, r0 = values["c"], values["r0"]
    # The balanced polynomial is 0 at r0: its linear part is a change of c.
    s = 1 - sum(values[f"K{i}"] * r0 ** (2 * i) for i in (1, 2, 3))
    return common | {
        "fx": c * s * step[0],
        "fy": c * s * step[1],
        "cx": origin[0] + values["x0"] * step[0],
        "cy": origin[1] - values["y0"] * step[1],
        **{f"k{i}": values[f"K{i}"] * c ** (2 * i) / s for i in (1, 2, 3)},
        "p1": -c * values["P2"] / s,
        "p2": c * values["P1"] / s,
        "b1": values["b1"] / s,
        "b2": values["b2"] / s,
    }


def with_distortion(
    target: CameraModel, common: dict[str, float], sizes: Sizes, r0: float = 0.0
) -> dict[str, float]:
    """A distortion in its common form as the parameters of a model.

    **Raises:** `NotExact`, `ValueError`.
    """
    if target.name == "opencv":
        _need_zero(common, ("b1", "b2"), "opencv")
        return {name: common[name] for name in target.parameters}
    _need_zero(common, ("k4", "k5", "k6", "s1", "s2", "s3", "s4"), target.name)
    origin, step = np.abs(pixel_frame(target, *sizes))
    a = common["fx"] / step[0]
    if abs(a - common["fy"] / step[1]) > EQUAL * abs(a):
        raise NotExact(f"{target.name} has one principal distance, and that of x is not that of y")
    if target.name == "snavely":
        _need_zero(common, ("k3", "p1", "p2", "b1", "b2"), target.name)
        centre = np.array([common["cx"], common["cy"]])
        if np.abs(centre - origin).max() > EQUAL * np.abs(origin).max():
            raise NotExact("snavely has its principal point at the image centre")
        return {"f": a, "k1": common["k1"], "k2": common["k2"]}
    k = [common[f"k{i}"] for i in (1, 2, 3)]
    # The inverse of the line above, which is implicit in s.
    s = _balance(k, r0 / a)
    c = a / s
    return {
        "c": c,
        "x0": (common["cx"] - origin[0]) / step[0],
        "y0": -(common["cy"] - origin[1]) / step[1],
        **{f"K{i}": k[i - 1] * s / c ** (2 * i) for i in (1, 2, 3)},
        "P1": common["p2"] * s / c,
        "P2": -common["p1"] * s / c,
        "b1": common["b1"] * s,
        "b2": common["b2"] * s,
        "r0": r0,
    }


def _balance(k: Numbers, rho: float) -> float:
    """s with s = 1 − Σk_i·s^(2i+1)·ρ^2i.

    By Newton's method from 1 (quadratic: a few steps reach rounding, the rest stay there)."""
    terms = [k[i - 1] * rho ** (2 * i) for i in (1, 2, 3)]
    s = 1.0
    for _ in range(50):
        value = s - 1 + sum(t * s ** (2 * i + 1) for i, t in enumerate(terms, 1))
        slope = 1 + sum((2 * i + 1) * t * s ** (2 * i) for i, t in enumerate(terms, 1))
        s -= value / slope
    return s


def _need_zero(common: Values, names: Sequence[str], model: str) -> None:
    for name in names:
        if common[name] != 0:
            raise NotExact(f"{model} has no {name}, which is {common[name]:.6g}")


def normalised_correction(values: Values) -> dict[str, float]:
    """The correction of `brown`, unbalanced, in units of the principal distance and v down.

        k_i = K_i·c^2i     p1 = −c·P2     p2 = c·P1

    Like `brown` it is added to the measurement, [x, −y]/c from the principal point: the form of
    programs that undistort, not OpenCV's.

    **Returns:** k1, k2, k3, p1, p2.
    """
    c = values["c"]
    k = {f"k{i}": values[f"K{i}"] * c ** (2 * i) for i in (1, 2, 3)}
    return {**k, "p1": -c * values["P2"], "p2": c * values["P1"]}


def invert_radial(q: Numbers) -> tuple[float, float, float]:
    """The first terms of the inverse of r·(1 + q1·r² + q2·r⁴ + q3·r⁶): a start, never the answer.

    k1 = −q1     k2 = 3·q1² − q2     k3 = −12·q1³ + 8·q1·q2 − q3
    """
    q1, q2, q3 = q
    return -q1, 3 * q1**2 - q2, -12 * q1**3 + 8 * q1 * q2 - q3
