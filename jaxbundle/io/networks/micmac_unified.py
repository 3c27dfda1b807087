"""Unified distortions of MicMac, `ModUnif`: general polynomials, Ebner, Brown, fisheyes.

    TypeModele  Params V0, V1, …  Etats S0, S1, …      q = PP + F·[X/Z, Y/Z], pixels

| TypeModele | image of q |
|---|---|
| `eModelePolyDegN`, N ≤ 7 | [x, y] = (q − [S1, S2])/S0, plus [V0·x + V1·y − 2V2·x² + V3·xy + V4·y², −V0·y + V1·x + V2·xy − 2V3·y² + V5·x²] and, for every degree d from 3 on, the monomials xᵈ … yᵈ with d + 1 coefficients of x, then as many of y; times S0, plus [S1, S2] |
| `eModeleEbner` | Ebner's 12 parameters of q, with the base B = S0: x² and y² less 2B²/3 |
| `eModeleDCBrown` | Brown's 14 parameters of q, with F = S0 |
| `eModele_DRad_PPaEqPPs`, `eModele_Fraser_PPaEqPPs` | as `ModRad` and `ModPhgrStd` with the centre PP: R3 … R11, P1, P2, b1, b2 |
| `eModele_FishEye_10_5_5`, `eModele_EquiSolid_FishEye_10_5_5` | [x, y] = (q − [V0, V1])/S0 = tan θ·[cos α, sin α]; ρ = θ, or 2·sin(θ/2); with u = ρ·[cos α, sin α]: u·(1 + V2·ρ² + … + V11·ρ²⁰), five pairs of tangential terms V12 … V21, V22·u_x, V23·[u_y, u_x]; times S0, plus [V0, V1] |

Rays up to and beyond 90° have an image by the fisheyes: θ is the angle of the ray F·X + …, not of its
tangent. The nearest of our models is fitted, with its differences. `eModeleRadFour…`, the
stereographic fisheye, polynomials of a fisheye beyond V23 and the direction C2M are refused by name.

Source: the formulas as MicMac (`phgr_ebner_brown_dist.cpp`) and iTowns' reader of its cameras state
them.
"""  # noqa: E501

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxbundle.cameras.scalars import Scalar
from jaxbundle.errors import InputError
from jaxbundle.io.cameras.nearest_camera import FittedCamera, Foreign, fit_camera, root
from jaxbundle.io.text.xml_fields import XmlFields, number_in

# fx = fy, cx, cy: scalars; `V`, `S`: arrays of Params and Etats.
UnifiedParameters = Mapping[str, Any]


def unified_camera(
    id: str,
    xml: XmlFields,
    part: ET.Element,
    core: Mapping[str, float],
    size: tuple[int, int],
    pixel: float,
) -> FittedCamera:
    """The nearest of our cameras; `part`: the element `ModUnif`, `core`: fx = fy, cx, cy.

    **Raises:** `InputError` for another kind."""
    kind = (part.findtext("TypeModele") or "").strip()
    V, S = (
        [number_in(e.text or "", f"{xml.path}: {name}") for e in part.iter(name)]
        for name in ("Params", "Etats")
    )
    if kind not in FORMULAS:
        raise InputError(
            f"{xml.path}: ModUnif {kind or 'without TypeModele'} is not supported; expected one "
            f"of {', '.join(FORMULAS)}: calibrate again with one of them, or with Fraser"
        )
    formula, states, parameter_count = FORMULAS[kind]
    if len(S) < states:
        raise InputError(f"{xml.path}: {kind} needs {states} Etats, but has {len(S)}")
    if any(V[parameter_count:]):
        raise InputError(
            f"{xml.path}: {kind}: only the first {parameter_count} Params are supported, but "
            "others are not 0"
        )
    if states and not S[0] > 0:
        raise InputError(f"{xml.path}: {kind}: the first of Etats must be positive, not {S[0]:g}")
    # Coefficients that are missing are 0.
    V = (V + [0.0] * parameter_count)[:parameter_count]
    fisheye, start = "FishEye" in kind, dict(core)
    if fisheye:
        start = {"fx": S[0], "fy": S[0], "cx": V[0], "cy": V[1]}
        start |= {f"k{i}": V[1 + i] for i in (1, 2, 3, 4)}
    parameters = {**core, "V": jnp.array(V), "S": jnp.array(S)}
    foreign = Foreign(formula, parameters, start, size, (pixel, pixel), fisheye)
    return fit_camera(id, foreign, str(xml.path), f"is {kind}")


def _pinhole(p: UnifiedParameters, X: Scalar, Y: Scalar, Z: Scalar) -> tuple[Scalar, Scalar]:
    return p["cx"] + p["fx"] * X / Z, p["cy"] + p["fy"] * Y / Z


def _polynomial(
    degree: int, p: UnifiedParameters, X: Scalar, Y: Scalar, Z: Scalar
) -> Float[Array, "2"]:
    V, S = p["V"], p["S"]
    u, v = _pinhole(p, X, Y, Z)
    if degree < 2:
        dx, dy = (V[0] * u + V[1] * v, -V[0] * v + V[1] * u) if degree else (0.0, 0.0)
        return jnp.stack([u + dx, v + dy])
    x, y = (u - S[1]) / S[0], (v - S[2]) / S[0]
    dx = V[0] * x + V[1] * y - 2 * V[2] * x * x + V[3] * x * y + V[4] * y * y
    dy = -V[0] * y + V[1] * x + V[2] * x * y - 2 * V[3] * y * y + V[5] * x * x
    begin = 6  # of the coefficients of degree d: V0 … V5 are those of degrees 1 and 2
    for d in range(3, degree + 1):
        monomials = jnp.stack([x ** (d - k) * y**k for k in range(d + 1)])
        dx = dx + V[begin : begin + d + 1] @ monomials
        dy = dy + V[begin + d + 1 : begin + 2 * d + 2] @ monomials
        begin += 2 * d + 2
    return jnp.stack([u + S[0] * dx, v + S[0] * dy])


def _ebner(p: UnifiedParameters, X: Scalar, Y: Scalar, Z: Scalar) -> Float[Array, "2"]:
    x, y = _pinhole(p, X, Y, Z)
    a1, a2, a3, a4, a5, a6, a7, a8, a9, a10, a11, a12 = p["V"]
    base = 2 * p["S"][0] ** 2 / 3  # makes x² and y² orthogonal to 1 over a 3 × 3 grid of points
    s, t = x * x - base, y * y - base
    dx = a1 * x + a2 * y - 2 * a3 * s + a4 * x * y + a5 * t + a7 * x * t + a9 * y * s + a11 * s * t
    dy = a2 * x - a1 * y + a3 * x * y - 2 * a4 * t + a6 * s + a8 * y * s + a10 * x * t + a12 * s * t
    return jnp.stack([x + dx, y + dy])


def _brown(p: UnifiedParameters, X: Scalar, Y: Scalar, Z: Scalar) -> Float[Array, "2"]:
    x, y = _pinhole(p, X, Y, Z)
    a1, a2, a3, a4, a5, a6, a7, a8, a9, a10, a11, a12, a13, a14 = p["V"]
    s, t = x * x, y * y
    radial = a13 * s * t / p["S"][0] + a14 * (s + t)
    dx = a1 * x + a2 * y + a3 * x * y + a4 * t + a5 * s * y + a6 * x * t + a7 * s * t + x * radial
    dy = a8 * x * y + a9 * s + a10 * s * y + a11 * x * t + a12 * s * t + y * radial
    return jnp.stack([x + dx, y + dy])


def _fraser(p: UnifiedParameters, X: Scalar, Y: Scalar, Z: Scalar) -> Float[Array, "2"]:
    V = jnp.pad(p["V"], (0, 9 - len(p["V"])))
    x, y = p["fx"] * X / Z, p["fy"] * Y / Z
    r2 = x * x + y * y
    R = r2 * jnp.polyval(V[4::-1], r2)
    dx = x * R + V[5] * (r2 + 2 * x * x) + 2 * V[6] * x * y + V[7] * x + V[8] * y
    dy = y * R + V[6] * (r2 + 2 * y * y) + 2 * V[5] * x * y
    return jnp.stack([p["cx"] + x + dx, p["cy"] + y + dy])


def _fisheye(
    equisolid: bool, p: UnifiedParameters, X: Scalar, Y: Scalar, Z: Scalar
) -> Float[Array, "2"]:
    V, F = p["V"], p["S"][0]
    # Homogeneous: a ray of 90° and beyond has Z ≤ 0.
    a = p["fx"] * X + (p["cx"] - V[0]) * Z
    b = p["fy"] * Y + (p["cy"] - V[1]) * Z
    tangent = root(a * a + b * b)
    angle = jnp.arctan2(tangent, F * Z)
    rho = 2 * jnp.sin(angle / 2) if equisolid else angle
    scale = jnp.where(tangent > 0, rho / jnp.where(tangent > 0, tangent, 1.0), 1 / (F * Z))
    x, y = a * scale, b * scale
    r2 = x * x + y * y
    radial = 1 + r2 * jnp.polyval(V[11:1:-1], r2)  # V2 … V11, the highest power first
    dx, dy = V[22] * x + V[23] * y, V[23] * x
    for k in range(5):
        P, Q, n = V[12 + 2 * k], V[13 + 2 * k], 2 * k + 2
        dx = dx + r2**k * (P * (r2 + n * x * x) + Q * n * x * y)
        dy = dy + r2**k * (Q * (r2 + n * y * y) + P * n * x * y)
    return jnp.stack([V[0] + F * (x * radial + dx), V[1] + F * (y * radial + dy)])


def _count_params(degree: int) -> int:
    """Params of a polynomial: the first two degrees share coefficients (a similarity is fixed by
    the orientation), from the third on every monomial has one in x and one in y."""
    return {0: 0, 1: 2, 2: 6}.get(degree, 6 + sum(2 * d + 2 for d in range(3, degree + 1)))


# By kind: the formula, the number of Etats, the number of Params.
FORMULAS = {
    **{
        f"eModelePolyDeg{n}": (partial(_polynomial, n), 3 if n > 1 else 0, _count_params(n))
        for n in range(8)
    },
    "eModeleEbner": (_ebner, 1, 12),
    "eModeleDCBrown": (_brown, 1, 14),
    "eModele_DRad_PPaEqPPs": (_fraser, 0, 5),
    "eModele_Fraser_PPaEqPPs": (_fraser, 0, 9),
    "eModele_FishEye_10_5_5": (partial(_fisheye, False), 1, 24),
    "eModele_EquiSolid_FishEye_10_5_5": (partial(_fisheye, True), 1, 24),
}
