"""The equations of the camera models for reports; for a user-defined model the docstring of its
formula."""

import inspect
import re

from jaxbundle.cameras import CameraModel, is_own

_BROWN = (
    "Δx = x̄·ΣKᵢ·(r²ⁱ − r0²ⁱ) + P1·(r² + 2x̄²) + 2·P2·x̄·ȳ + b1·x̄ + b2·ȳ",
    "Δy = ȳ·ΣKᵢ·(r²ⁱ − r0²ⁱ) + P2·(r² + 2ȳ²) + 2·P1·x̄·ȳ,   r² = x̄² + ȳ²",
)
_RAY = "[r, s, q] = M·(X − X0), M = R3(κ)·R2(φ)·R1(ω)"
_MM = "c, x0, y0 in mm, Kᵢ in mm⁻²ⁱ, P1 and P2 in mm⁻¹"
_PX = "fx, fy, cx, cy in px"
_LENS = "[X, Y, Z] = [r, −s, −q]"
_PIXEL = "m = [(u − cx)/fx, (v − cy)/fy], ρ² = |m|²"
_AZIMUTH = "u = cx + fx·ρ·cos ψ, v = cy + fy·ρ·sin ψ,   ψ the azimuth, θ = ∠(ray, axis)"
_ANGLE = ("u = cx + fx·a′, v = cy + fy·b′", "[a, b] = θ·[cos ψ, sin ψ], t² = a² + b²")
_FISHEYE = (
    "a′ = a·k + 2·p1·a·b + p2·(t² + 2a²)",
    "b′ = b·k + 2·p2·a·b + p1·(t² + 2b²)",
    "k = 1 + k1·t² + k2·t⁴ + k3·t⁶ + k4·t⁸",
)

EQUATIONS: dict[str, tuple[str, ...]] = {
    "brown": (
        "x̄ + Δx = −c·r/q, ȳ + Δy = −c·s/q,   x̄ = x − x0, ȳ = y − y0 (measured)",
        *_BROWN,
        _RAY,
        _MM,
    ),
    "brown-projected": (
        "x = x0 + x̄ + Δx, y = y0 + ȳ + Δy,   x̄ = −c·r/q, ȳ = −c·s/q (projected)",
        *_BROWN,
        _RAY,
        _MM,
    ),
    "usgs": (
        "x̄ + Δx = −c·r/q, ȳ + Δy = −c·s/q,   x̄ = x − x0, ȳ = y − y0 (measured)",
        "Δx = x̄·(K0 + K1·r² + … + K4·r⁸) + (1 + P3·r² + P4·r⁴)·(P1·(r² + 2x̄²) + 2·P2·x̄·ȳ)",
        "Δy = ȳ·(K0 + K1·r² + … + K4·r⁸) + (1 + P3·r² + P4·r⁴)·(P2·(r² + 2ȳ²) + 2·P1·x̄·ȳ)",
        _RAY,
        _MM,
    ),
    "bingo": (
        "x·(1 − dr/R) − x0 = −c·r/q, y·(1 − dr/R) − y0 = −c·s/q,   R² = x² + y², ρ = R·F/100",
        "dr = 0.373785·p25·ρ·(1 − ρ²) + 0.304790·p26·ρ·(1 − ρ²)·(ρ − 0.4)",
        _RAY,
        "c, x0, y0, p25, p26 in the image unit",
    ),
    "opencv": (
        "u = cx + fx·x″, v = cy + fy·y″,   x′ = −r/q, y′ = s/q, r² = x′² + y′²",
        "x″ = x′·k + 2·p1·x′y′ + p2·(r² + 2x′²) + s1·r² + s2·r⁴",
        "y″ = y′·k + 2·p2·x′y′ + p1·(r² + 2y′²) + s3·r² + s4·r⁴",
        "k = (1 + k1·r² + k2·r⁴ + k3·r⁶)/(1 + k4·r² + k5·r⁴ + k6·r⁶)",
        _RAY,
        "fx, fy, cx, cy in px",
    ),
    "kannala-brandt": (
        "u = cx + fx·θd·cos ψ, v = cy + fy·θd·sin ψ,   ψ the azimuth, θ = ∠(ray, axis)",
        "θd = θ·(1 + k1·θ² + k2·θ⁴ + k3·θ⁶ + k4·θ⁸)",
        _RAY,
        "fx, fy, cx, cy in px",
    ),
    "division": ("[X, Y, Z] ∝ [m, 1 + k·ρ²],   " + _PIXEL, _LENS, _RAY, _PX),
    "kannala-brandt-tangential": (*_ANGLE, *_FISHEYE, _RAY, _PX),
    "thin-prism-fisheye": (
        *_ANGLE,
        *_FISHEYE,
        "and sx1·t² added to a′, sy1·t² to b′",
        _RAY,
        _PX,
    ),
    "rad-tan-thin-prism-fisheye": (
        *_ANGLE,
        "a′ = g + 2·p1·g·h + p0·(d² + 2g²) + s0·d² + s1·d⁴",
        "b′ = h + 2·p0·g·h + p1·(d² + 2h²) + s2·d² + s3·d⁴",
        "[g, h] = [a, b]·(1 + k0·t² + … + k5·t¹²), d² = g² + h²",
        _RAY,
        _PX,
    ),
    "fov": (_AZIMUTH, "ρ = atan(2·tan(ω/2)·tan θ)/ω,   ω = omega", _RAY, _PX),
    "eucm": (
        "u = cx + fx·X/N, v = cy + fy·Y/N,   N = α·d + (1 − α)·Z",
        "d² = β·(X² + Y²) + Z²,   " + _LENS,
        _RAY,
        _PX,
    ),
    "double-sphere": (
        "u = cx + fx·X/N, v = cy + fy·Y/N,   N = α·d2 + (1 − α)·(ξ·d1 + Z)",
        "d1² = X² + Y² + Z², d2² = X² + Y² + (ξ·d1 + Z)²,   " + _LENS,
        _RAY,
        _PX,
    ),
    "mei": (
        "u = cx + fx·mx′, v = cy + fy·my′,   m = [X, Y]/(Z + ξ·|X, Y, Z|), ρ² = |m|²",
        "mx′ = mx·(1 + k1·ρ² + k2·ρ⁴) + 2·p1·mx·my + p2·(ρ² + 2mx²)",
        "my′ = my·(1 + k1·ρ² + k2·ρ⁴) + 2·p2·mx·my + p1·(ρ² + 2my²)",
        _LENS,
        _RAY,
        _PX,
    ),
    "scaramuzza": (
        "[X, Y, Z] ∝ [x′, y′, a0 + a2·ρ² + a3·ρ³ + a4·ρ⁴],   ρ² = x′² + y′²",
        "u − cx = c·x′ + d·y′, v − cy = e·x′ + y′",
        _LENS,
        _RAY,
        "a0, cx, cy in px",
    ),
    "equidistant": (_AZIMUTH, "ρ = θ", _RAY, _PX),
    "stereographic": (_AZIMUTH, "ρ = 2·tan(θ/2)", _RAY, _PX),
    "equisolid": (_AZIMUTH, "ρ = 2·sin(θ/2)", _RAY, _PX),
    "orthographic": (_AZIMUTH, "ρ = sin θ", _RAY, _PX),
    "equirectangular": (
        "u = cx + fx·λ, v = cy + fy·φ,   λ = atan2(X, Z), φ = atan2(Y, √(X² + Z²))",
        _LENS,
        _RAY,
        _PX,
    ),
    "radial-spline": (
        _AZIMUTH,
        "ρ = θ·(1 + S(θ²)), S the natural cubic spline",
        "through 0, s1, s2, … at equal steps of θ²",
        _RAY,
        _PX,
    ),
    "spline": (
        "u = cx + fx·(a + ΣΣ B·B·dx), v = cy + fy·(b + ΣΣ B·B·dy),   B cubic B-splines",
        "[a, b] = 2·tan(θ/2)·[cos ψ, sin ψ],   ψ the azimuth, θ = ∠(ray, axis)",
        _RAY,
        _PX,
    ),
    "snavely": (
        "x = f·k·x′, y = f·k·y′,   x′ = −r/q, y′ = −s/q, k = 1 + k1·ρ² + k2·ρ⁴, ρ² = x′² + y′²",
        _RAY,
        "f in px, x right, y up from the image centre",
    ),
}


def camera_equations(model: CameraModel) -> tuple[str, ...]:
    """The lines that state a model's equations."""
    name = model.name if is_own(model) else re.sub(r"-\d.*", "", model.name)
    if name in EQUATIONS:
        return EQUATIONS[name]
    docstring_lines = (inspect.getdoc(model.formula) or "").splitlines()
    return tuple(line for line in docstring_lines if line.strip()) or ("user-defined",)
