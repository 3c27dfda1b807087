"""Equivalent fisheye and omnidirectional camera models.

**Polynomials of the angle** (`equidistant`, `kannala-brandt`, `kannala-brandt-tangential`,
`thin-prism-fisheye`, `rad-tan-thin-prism-fisheye`, `radial-spline-…` without distortion): one
holds another if it has all of its terms that are not 0. The decentring of
`rad-tan-thin-prism-fisheye` is taken at the distorted radius and is a separate term.

**A sphere and a plane** (`mei`, `eucm`, `double-sphere`, `stereographic`, `spline-…` without
distortion, and perspective cameras with ξ = 0), in the parameters of `mei`,

    u = cx + γ·X/(Z + ξ·R)

    eucm, β = 1; double-sphere, ξ = 0       ξ = α/(1 − α),  γ = f/(1 − α)
    stereographic                           ξ = 1,          γ = 2f
    opencv, brown-projected, snavely        ξ = 0,          γ = f

with the distortion k1, k2, p1, p2 of `mei`, which at ξ = 0 is that of `opencv`.

**Division**: `scaramuzza` with a3 = a4 = 0 on a square sensor, k = a0·a2, f = a0; `eucm` with
α = 1/2, k = −β/4; `stereographic`, k = −1/4.
"""

from collections.abc import Mapping
from typing import NoReturn

from jaxbundle.cameras.convert_exact import (
    DISTORTIONS,
    EQUAL,
    NotExact,
    Sizes,
    distortion,
    with_distortion,
)
from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.undistorted_fisheyes import STEREOGRAPHIC

CORE = ("fx", "fy", "cx", "cy")
_K = {f"k{i}": f"k{i}" for i in (1, 2, 3, 4)}
_P = {"p1": "p1", "p2": "p2"}
# The terms of a model by its names.
ANGLE: dict[str, dict[str, str]] = {
    "equidistant": {},
    "kannala-brandt": _K,
    "kannala-brandt-tangential": _K | _P,
    "thin-prism-fisheye": _K | _P | {"sx1": "sx1", "sy1": "sy1"},
    "rad-tan-thin-prism-fisheye": {
        **{f"k{i}": f"k{i + 1}" for i in range(6)},
        **{
            name: f"{name} at the distorted radius" for name in ("p0", "p1", "s0", "s1", "s2", "s3")
        },
    },
}
SPHERES = ("mei", "eucm", "double-sphere", "stereographic", *DISTORTIONS, "division")
DIVISIONS = ("division", "scaramuzza", "eucm", "stereographic")

Values = Mapping[str, float]


def exact_wide(
    source: CameraModel, values: Values, target: CameraModel, sizes: Sizes, r0: float = 0.0
) -> dict[str, float]:
    """As `convert_exact.exact_parameters`, for these models."""
    for convert in (_by_angle, _by_division, _by_sphere):
        parameters = convert(source, values, target, sizes, r0)
        if parameters is not None:
            return parameters
    raise NotExact(f"{source.name} and {target.name} are different functions")


def as_stereographic(core: Values, target: CameraModel) -> list[dict[str, float]]:
    """The parameters of a target equal to the stereographic camera; none if impossible."""
    try:
        return [exact_wide(STEREOGRAPHIC, core, target, (None, None))]
    except NotExact:
        return []


def _by_angle(
    source: CameraModel, values: Values, target: CameraModel, _sizes: Sizes, _r0: float
) -> dict[str, float] | None:
    names = [_plain_family(model, "radial-spline-", "equidistant") for model in (source, target)]
    if not {*names} <= {*ANGLE}:
        return None
    of_source, of_target = (ANGLE[name] for name in names)
    _need_no_spline(source, values)
    terms = {common: values[name] for name, common in of_source.items()}
    for common, value in terms.items():
        if value != 0 and common not in of_target.values():
            raise NotExact(f"{target.name} has no {common}, which is {value:.6g}")
    core = {name: values[name] for name in CORE}
    coefficients = {name: terms.get(common, 0.0) for name, common in of_target.items()}
    return dict.fromkeys(target.parameters, 0.0) | core | coefficients


def _by_division(
    source: CameraModel, values: Values, target: CameraModel, _sizes: Sizes, _r0: float
) -> dict[str, float] | None:
    """As `division`, or None if one of the two is not such a model."""
    pair = {source.name, target.name}
    if not (pair <= {*DIVISIONS} and pair & {"division", "scaramuzza"}):
        return None
    f = values[source.principal_distance[0]]
    core = {"fx": f, "fy": values.get("fy", f), "cx": values["cx"], "cy": values["cy"]}
    match source.name:
        case "division":
            k = values["k"]
        case "stereographic":
            k = -0.25
        case "eucm":
            _need(values, "division", alpha=0.5)
            k = -0.25 * values["beta"]
        case _:
            _need(values, "division", a3=0.0, a4=0.0, c=1.0, d=0.0, e=0.0)
            k = f * values["a2"]
    match target.name:
        case "division":
            return core | {"k": k}
        case "stereographic":
            return core if k == -0.25 else _refuse(f"stereographic is k = -0.25, not {k:.6g}")
        case "eucm":
            return (
                core | {"alpha": 0.5, "beta": -4 * k}
                if k < 0
                else _refuse(f"eucm is a division with k < 0, and it is {k:.6g}")
            )
    if core["fx"] != core["fy"]:
        _refuse("scaramuzza has one principal distance, and that of x is not that of y")
    return dict.fromkeys(target.parameters, 0.0) | {
        "a0": f,
        "cx": core["cx"],
        "cy": core["cy"],
        "a2": k / f,
        "c": 1.0,
    }


def _need(values: Values, model: str, **expected: float) -> None:
    for name, value in expected.items():
        # Exactly: a value close to it is another camera, which a fit can represent.
        if values[name] != value:
            _refuse(f"as a {model} its {name} is {value:g}, and it is {values[name]:.6g}")


def _by_sphere(
    source: CameraModel, values: Values, target: CameraModel, sizes: Sizes, r0: float
) -> dict[str, float] | None:
    names = [_plain_family(model, "spline-", "stereographic") for model in (source, target)]
    if not {*names} <= {*SPHERES}:
        return None
    _need_no_spline(source, values)
    return _from_sphere(target, names[1], _as_sphere(source, names[0], values, sizes), sizes, r0)


def _as_sphere(source: CameraModel, name: str, values: Values, sizes: Sizes) -> dict[str, float]:
    """A camera in the parameters of `mei`."""
    if name == "mei":
        return dict(values)
    if name in DISTORTIONS:
        common = distortion(source, values, sizes)
        for term, value in common.items():
            if value != 0 and term not in (*CORE, "k1", "k2", "p1", "p2"):
                raise NotExact(f"mei has no {term}, which is {value:.6g}")
        return {"xi": 0.0} | {n: common[n] for n in (*CORE, "k1", "k2", "p1", "p2")}
    xi = {"stereographic": 1.0, "division": 0.0}.get(name)
    need = {"eucm": ("beta", 1.0), "double-sphere": ("xi", 0.0), "division": ("k", 0.0)}.get(name)
    if need and values[need[0]] != need[1]:
        raise NotExact(f"{name} is another function unless {need[0]} is {need[1]:g}")
    # ξ = α/(1 − α), see the module.
    if xi is None:
        xi = values["alpha"] / (1 - values["alpha"])
    core = {name: values[name] * (1 + xi if name[0] == "f" else 1) for name in CORE}
    return core | {"xi": xi} | dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)


def _from_sphere(
    target: CameraModel, name: str, mei: Values, sizes: Sizes, r0: float
) -> dict[str, float]:
    """The parameters of a model of a camera in those of `mei`."""
    if name == "mei":
        return dict(mei)
    xi = mei["xi"]
    if name in DISTORTIONS:
        if xi != 0:
            _refuse(f"{name} is a perspective camera, and xi is {xi:.6g}")
        zero = ("k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "b1", "b2")
        return with_distortion(target, {**mei, **dict.fromkeys(zero, 0.0)}, sizes, r0)
    # Only `mei` itself has a distortion beside its sphere.
    for term in ("k1", "k2", "p1", "p2"):
        if mei[term] != 0:
            _refuse(f"{target.name} has no {term}, which is {mei[term]:.6g}")
    fixed_xi = {"stereographic": 1.0, "division": 0.0}.get(name, xi)
    if abs(xi - fixed_xi) > EQUAL:
        _refuse(f"{target.name} is the sphere with xi = {fixed_xi:g}, and it is {xi:.6g}")
    core = {n: mei[n] / (1 + xi if n[0] == "f" else 1) for n in CORE}
    alpha = xi / (1 + xi)
    shape = {"eucm": {"alpha": alpha, "beta": 1.0}, "double-sphere": {"xi": 0.0, "alpha": alpha}}
    return dict.fromkeys(target.parameters, 0.0) | core | shape.get(name, {})


def _plain_family(model: CameraModel, family: str, plain: str) -> str:
    """Conversion of a spline without distortion to an equal model."""
    return plain if model.name.startswith(family) else model.name


def _need_no_spline(source: CameraModel, values: Values) -> None:
    if "spline-" in source.name and any(values[name] for name in source.parameters[len(CORE) :]):
        _refuse(f"the distortion of {source.name} is a spline")


def _refuse(why: str) -> NoReturn:
    raise NotExact(why)
