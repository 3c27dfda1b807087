"""The equations of the camera models, as a protocol prints them; of an own model the docstring of
its formula."""

import inspect

from jaxbundle.cameras import CameraModel

_BROWN = (
    "Δx = x̄·ΣKᵢ·(r²ⁱ − r0²ⁱ) + P1·(r² + 2x̄²) + 2·P2·x̄·ȳ + b1·x̄ + b2·ȳ",
    "Δy = ȳ·ΣKᵢ·(r²ⁱ − r0²ⁱ) + P2·(r² + 2ȳ²) + 2·P1·x̄·ȳ,   r² = x̄² + ȳ²",
)
_RAY = "[r, s, q] = M·(X − X0), M = R3(κ)·R2(φ)·R1(ω)"
_MM = "c, x0, y0 in mm, Kᵢ in mm⁻²ⁱ, P1 and P2 in mm⁻¹"

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
    "snavely": (
        "x = f·k·x′, y = f·k·y′,   x′ = −r/q, y′ = −s/q, k = 1 + k1·ρ² + k2·ρ⁴, ρ² = x′² + y′²",
        _RAY,
        "f in px, x right, y up from the image centre",
    ),
}


def equations(model: CameraModel) -> tuple[str, ...]:
    """The lines that state a model's equations."""
    if model.name in EQUATIONS:
        return EQUATIONS[model.name]
    said = (inspect.getdoc(model.formula) or "").splitlines()
    return tuple(line for line in said if line.strip()) or ("of the user's own",)
