r"""Corners where four squares meet, two light and two dark, fitted to the grey values around them.

Two lines cross at the corner x at the angles θ₁, θ₂; with sᵢ = nᵢ·(p − x) the distances of a pixel
p from them and E(s) = 2·Φ(s/τ) − 1 a blurred change from −1 to 1,

    g(p) = (M + D·E(s₁)·E(s₂))·(1 + m·(p − x))

(for oblique lines the joint distribution of both blurs, of correlation n₁·n₂, `_joint`). M is the
mean level, m the change of the light, D half the contrast, τ the blur of lens and pixel. All nine
unknowns of a corner are estimated from the grey values of its pixels, without interpolation; the
covariance follows from the noise, which is that of the residuals. The model, like the image, is
symmetrical about x, so that neither the encoding of the grey values (gamma) nor spreading ink nor
an oblique view shifts the corner.

In the light squares of a ChArUco board, markers with a dark border are a strip of width oᵢ away
from the lines; D·E·E has then the term −2·|D|·Φ((|s₁| − o₁)/τ)·Φ((|s₂| − o₂)/τ) there.
"""

import dataclasses

import numpy as np
import scipy  # its parts are loaded on use
from jaxtyping import Float

from jaxbundle.measure.corner_quality import LARGEST_SIGMA, NO_CORNER, TOO_SMALL
from jaxbundle.measure.grey_value_fit import noise_of_residuals, normal_equations

LARGEST_HALF = 7
"""Most pixels from the corner: the lens bends lines; 10 make σ smaller by a fifth and take twice
the time."""
COMPLETE = 5.0
"""Pixels from the corner, in τ, for a blurred image, to separate edges from uneven light."""
PART = 0.4
"""Pixels used, from the corner, in distances to the nearest other corner."""
FIRST_BLUR = 1.0
"""τ before it is estimated."""
SHARPEST, SOFTEST = 0.35, 4.0
"""Limits of τ, pixels: a pixel's area alone has 1/√12 = 0.29."""
SOFT, SMALLEST_IMAGE = 2.8, 64
"""τ from which the image is reduced, and the rows or columns that it must have."""
NARROWEST = 1.5
"""Narrowest strip or window, in τ: below, blurred edges are one."""
WIDE = 3.2
"""A strip of this width, in τ, determines the step without the marker beside it, whose place in
a printed board is known to a pixel of the print only."""
NEGLECTED, NEGLECTED_NARROW = 0.01, 0.06
"""σ, in τ·|n₁·n₂|, of what is not modelled beside markers under oblique lines, to whose sides they
are not parallel; the second decreases by exp(−(width/τ)²/2). Found on rendered boards tilted by 50°
and 65°."""
COVERED = 3.0
"""Residuals of a corner above this multiple of their median over all corners are not noise."""
UNKNOWNS = 9
STEPS, CONVERGED = 12, 4e-3
"""Most steps, and the change of nearly all corners, in pixels, after which the next is
negligible."""
TERMS, NEGLIGIBLE = 8, 3e-3
"""Most terms of the series for oblique lines, and the size of the last one, relative to the
contrast."""
PAIRS = 8
"""Pairs of opposite sectors about the corner whose residuals are compared."""


@dataclasses.dataclass(frozen=True)
class Saddles:
    """Corners: pixels, covariance, and why one was left out, or ""."""

    xy: Float[np.ndarray, "n 2"]
    covariance: Float[np.ndarray, "n 2 2"]
    why: np.ndarray


def fit_saddles(
    grey: np.ndarray,
    near: Float[np.ndarray, "n 2"],
    lines: Float[np.ndarray, "n 2 2"],
    strips: Float[np.ndarray, "n 2 2 2"] | None = None,
) -> Saddles:
    """Corners of squares in a photograph.

    **Arguments:** `near`: the corners to a pixel or two; `lines`: the vectors to the next
    corner (or other edge) along both lines, pixels; `strips`, for ChArUco boards: distances of the
    marker's corner from both lines, in the quarter of these signs of s₁ and s₂ (0: negative).
    """
    found, blur = _fit(grey, near, lines, strips, LARGEST_HALF)
    if COMPLETE * np.median(blur) > LARGEST_HALF:
        found, blur = _fit(grey, near, lines, strips, COMPLETE * np.median(blur))
    if np.median(blur) < SOFT or min(grey.shape) < SMALLEST_IMAGE:
        return found
    # an image blurred over several pixels loses nothing in half the pixels, and the windows then
    # contain the whole change
    rows, columns = (n // 2 * 2 for n in grey.shape)
    small = grey[:rows, :columns].reshape(rows // 2, 2, columns // 2, 2).mean((1, 3))
    found = fit_saddles(small, (near - 0.5) / 2, lines / 2, None if strips is None else strips / 2)
    return Saddles(2 * found.xy + 0.5, 4 * found.covariance, found.why)


def _fit(grey, near, lines, strips, largest):
    """The corners, and τ of each."""
    length = np.linalg.norm(lines, axis=2)
    half = np.clip(PART * length.min(1), 2.0, largest)
    angle = np.arctan2(lines[..., 1], lines[..., 0])
    oblique = np.abs(np.sin(angle[:, 0] - angle[:, 1]))
    window = int(np.ceil(half.max()))
    v, u = np.mgrid[-window : window + 1, -window : window + 1].reshape(2, -1)
    base = np.rint(near)
    place = base[:, None] + np.stack([u, v], 1)
    height, width = grey.shape
    inside = ((place >= 0) & (place < [width, height])).all(2)
    column, row = np.where(inside[..., None], place, 0).astype(int).transpose(2, 0, 1)
    # single precision is faster by half, and exact to 1e-5 pixels
    g, place = grey[row, column].astype(np.float32), place.astype(np.float32)
    strips = None if strips is None else strips.astype(np.float32)
    theta = np.zeros((len(near), UNKNOWNS))
    theta[:, :2], theta[:, 2:4] = near, angle
    theta[:, 6] = np.log(FIRST_BLUR)
    reference, prior = theta.copy(), np.zeros(UNKNOWNS)
    reference[:, 6] = np.log(0.8)
    prior[2:4], prior[6], prior[7:] = 0.3**-2.0, 1.0, 0.1**-2.0
    noise = np.ones(len(near))
    for step in range(STEPS):
        weight = inside & (np.linalg.norm(place - theta[:, None, :2], axis=2) <= half[:, None])
        if strips is not None:
            weight &= _beside_lines(theta.astype(np.float32), place, strips)
        weight = weight.astype(np.float32)
        if step < 2:
            theta[:, 4:6] = _levels(theta.astype(np.float32), place, g, weight)
        model, J = _model(theta.astype(np.float32), place, strips)
        r = g - model
        N, b = normal_equations(J, r, weight, prior, reference - theta, noise)
        d = np.linalg.solve(N, b[..., None])[..., 0]
        limit = [0.7, 0.7, 0.2, 0.2, 100, 100, 0.4, 0.1, 0.1]
        theta = theta + np.clip(d, np.negative(limit), limit)
        theta[:, 6] = np.clip(theta[:, 6], np.log(SHARPEST), np.log(SOFTEST))
        noise = noise_of_residuals(r, weight, UNKNOWNS)
        if step > 2 and np.quantile(np.abs(d[:, :2]), 0.95) < CONVERGED:
            break
    model, J = _model(theta.astype(np.float32), place, strips)
    r = g - model
    N, _ = normal_equations(J, r, weight, prior, 0 * theta, noise)
    Q = np.linalg.inv(N)
    scale = noise * _excess(J, r, weight, Q, noise, place - theta[:, None, :2])
    covariance = scale[:, None, None] ** 2 * Q[:, :2, :2]
    blur, xy = np.exp(theta[:, 6]), theta[:, :2]
    narrow = half * oblique if strips is None else np.minimum(half * oblique, strips.min((1, 2, 3)))
    # what the model neglects in narrow strips
    if strips is not None:
        ratio = narrow / blur
        neglected = NEGLECTED + NEGLECTED_NARROW * np.exp(-(ratio**2) / 2)
        lean = np.abs(np.cos(angle[:, 0] - angle[:, 1])) / oblique
        neglected = np.where(ratio < WIDE, neglected * blur * lean, 0.0)
        covariance = covariance + neglected[:, None, None] ** 2 * np.eye(2)
    why = np.full(len(near), "", dtype=object)
    largest = np.linalg.eigvalsh(np.nan_to_num(covariance, nan=1e9))[:, 1]
    why[~(largest <= LARGEST_SIGMA**2)] = TOO_SMALL
    why[narrow < NARROWEST * blur] = TOO_SMALL
    moved = np.linalg.norm(xy - near, axis=1)
    # residuals far above those of the other corners: something covers the window in part
    covered = (noise > COVERED * np.median(noise)) & (noise > 0.05 * np.abs(theta[:, 5]))
    lost = ~(moved < np.maximum(half, 2.5)) | (noise > 0.4 * np.abs(theta[:, 5])) | covered
    why[lost | (weight.sum(1) < 2 * UNKNOWNS)] = NO_CORNER
    return Saddles(xy, covariance, why), blur


def lines_of_grid(xy: Float[np.ndarray, "rows columns 2"]) -> Float[np.ndarray, "rows columns 2 2"]:
    """Vectors to the next points along the row and along the column, the shorter of both sides; NaN
    for a point without neighbours."""
    lines = []
    for axis in (1, 0):
        step = np.diff(xy, axis=axis)
        gap = np.full_like(np.take(xy, [0], axis), np.nan)
        both = np.stack([np.concatenate([step, gap], axis), np.concatenate([gap, step], axis)])
        length = np.nan_to_num(np.linalg.norm(both, axis=3), nan=np.inf)
        lines.append(np.take_along_axis(both, length.argmin(0)[None, ..., None], 0)[0])
    return np.stack(lines, 2)


def _distances(theta, place):
    """Distances s and positions t of pixels by both lines, [n, pixels, 2]."""
    c, s = np.cos(theta[:, None, 2:4]), np.sin(theta[:, None, 2:4])
    x, y = (place - theta[:, None, :2])[..., None, :].transpose(3, 0, 1, 2)
    return y * c - x * s, x * c + y * s


def _strip_of(s, strips):
    """The strips of the quarters of pixels, [n, pixels, 2]."""
    first, second = (s > 0).astype(int).transpose(2, 0, 1)
    return strips[np.arange(len(s))[:, None], first, second]


def _beside_lines(theta, place, strips):
    """Pixels of the light strips; of narrow ones also the dark border of the marker, as wide as the
    strip."""
    s, _ = _distances(theta, place)
    strip, blur = _strip_of(s, strips), np.exp(theta[:, 6])[:, None, None]
    wide = strip > WIDE * blur
    limit = np.where(wide, strip - 2 * blur, np.maximum(2 * strip - 1.5 * blur, strip))
    return (np.abs(s) < limit).any(2)


def _levels(theta, place, g, weight):
    """M and D of the pixels for the lines as they are."""
    s, _ = _distances(theta, place)
    x = (2 * scipy.special.ndtr(s / np.exp(theta[:, None, 6:7])) - 1).prod(2)
    n, sx, sy = weight.sum(1), (weight * x).sum(1), (weight * g).sum(1)
    sxx, sxy = (weight * x * x).sum(1), (weight * x * g).sum(1)
    D = (n * sxy - sx * sy) / np.maximum(n * sxx - sx**2, 1e-9)
    return np.stack([(sy - D * sx) / np.maximum(n, 1), D], 1)


def _model(theta, place, strips):
    """Grey values of the pixels, and their derivatives [n, pixels, unknowns]; those by θ and τ
    without the part through ρ: they are even about the corner, and do not touch it."""
    s, t = _distances(theta, place)
    tau, M, D = np.exp(theta[:, None, 6]), theta[:, None, 4], theta[:, None, 5]
    rho = np.cos(theta[:, 2] - theta[:, 3])[:, None]
    z = s / tau[..., None]
    P, along = _joint(z, rho)
    E = 2 * scipy.special.ndtr(z) - 1
    X = 4 * (P - 0.25 * (1 + E[..., 0]) * (1 + E[..., 1])) + E[..., 0] * E[..., 1]
    slope = (4 * along - 2 * _density(z)) / tau[..., None]  # of X by s
    of_blur = -(s * slope).sum(2)
    if strips is not None:
        k = (np.abs(s) - _strip_of(s, strips)) / tau[..., None]
        side = np.sign(s)
        P, along = _joint(k, rho * side[..., 0] * side[..., 1])
        there = 2 * np.sign(D) * (side[..., 0] * side[..., 1] == np.sign(D))
        X = X - there * P
        slope = slope - there[..., None] * along * side / tau[..., None]
        of_blur += there * (k * along).sum(2)
    away = place - theta[:, None, :2]
    c, n = np.cos(theta[:, None, 2:4]), np.sin(theta[:, None, 2:4])
    light = 1 + (away * theta[:, None, 7:]).sum(2)
    squares = M + D * X
    slope, of_blur = slope * (D * light)[..., None], of_blur * D * light
    J = np.stack(
        [
            (slope * n).sum(2),
            -(slope * c).sum(2),
            -slope[..., 0] * t[..., 0],
            -slope[..., 1] * t[..., 1],
            light,
            X * light,
            of_blur,
            squares * away[..., 0],
            squares * away[..., 1],
        ],
        2,
    )
    return squares * light, J


def _density(z):
    return np.exp(-z * z / 2) / np.float32(np.sqrt(2 * np.pi))


def _joint(z, rho):
    """P(ε₁ < z₁, ε₂ < z₂) of normal variables of correlation ρ, by the tetrachoric series

        Φ(z₁)·Φ(z₂) + φ(z₁)·φ(z₂)·Σ ρᵏ⁺¹/(k + 1)!·He_k(z₁)·He_k(z₂)

    and its derivatives φ(z₁)·Φ((z₂ − ρ·z₁)/√(1 − ρ²)), … by both."""
    ndtr, f = scipy.special.ndtr, _density(z)
    F = ndtr(z)
    before, He = np.zeros_like(z), np.ones_like(z)
    total, factor = 0.0, np.ones_like(rho)
    largest = np.abs(rho).max()
    for k in range(TERMS):
        if k and largest ** (k + 1) / (k + 1) < NEGLIGIBLE:
            break
        factor = factor * rho / (k + 1)
        total = total + factor * He[..., 0] * He[..., 1]
        before, He = He, z * He - k * before
    P = F[..., 0] * F[..., 1] + f[..., 0] * f[..., 1] * total
    other = (z[..., ::-1] - rho[..., None] * z) / np.sqrt(1 - np.minimum(rho**2, 0.99))[..., None]
    return P, f * ndtr(other)


def _excess(J, r, weight, Q, noise, away):
    """By how much the corners from opposite pairs of sectors scatter more than the noise says (1:
    not); what is alike on opposite sides does not move the corner."""
    angle = np.arctan2(away[..., 1], away[..., 0])
    pair = ((angle / np.pi + 1) * PAIRS).astype(int) % PAIRS
    total, inverse = np.zeros(len(r)), np.linalg.inv(Q[:, :2, :2])
    for k in range(PAIRS):
        score = np.einsum("npi,np->ni", J, weight * r * (pair == k))
        moved = np.einsum("nij,nj->ni", Q[:, :2], score)
        total += np.einsum("ni,nij,nj->n", moved, inverse, moved)
    ratio = total / (2 * (PAIRS - 1) * noise**2)
    return np.where(ratio > 1 + 3 * np.sqrt(1 / PAIRS), np.sqrt(ratio), 1.0)
