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
from jaxtyping import Bool, Float, Real

from jaxbundle.measure.corner_quality import MAX_SIGMA, NO_CORNER, TOO_SMALL
from jaxbundle.measure.grey_value_fit import noise_of_residuals, normal_equations

# x, y, θ₁, θ₂, M, D, ln τ, m of corners.
Theta = Float[np.ndarray, "n 9"]
UNKNOWNS = 9
Pixels = Float[np.ndarray, "n pixels"]
# Widths of the light strips by both lines, in the quarter of these signs of s₁ and s₂.
Strips = Float[np.ndarray, "n 2 2 2"]


@dataclasses.dataclass(frozen=True)
class SaddleSettings:
    """How corners of four squares are fitted, and which are refused.

    Half and double were tried on the rendered boards of `tests/measure/test_corner_accuracy.py`, 79
    corners with an RMS error of 0.0051 pixel. What is not mentioned below changes nothing there: it
    guards against dirt, blur and wrong detections, and is not critical.

    **Fields:**

    - `max_half`: most pixels from the corner: the lens bends lines; 10 make σ smaller by a fifth
      and take twice the time (half: RMS 0.0091, double: 0.0050).
    - `complete`: pixels from the corner, in τ, for a blurred image, to separate edges from uneven
      light.
    - `part`: pixels used, from the corner, in distances to the nearest other corner; the rest is
      room for the blur of the next edges, and for perspective (half: 0.0105, a quarter of the
      corners lost; double: 0.0048).
    - `first_blur`: τ before it is estimated.
    - `min_blur`, `max_blur`: limits of τ, pixels: a pixel's area alone has 1/√12 = 0.29.
    - `blur_to_reduce`, `min_rows_to_reduce`: τ from which the image is halved, and the rows or
      columns that it must have.
    - `min_strip`: narrowest strip or window, in τ: below, blurred edges are one.
    - `wide_strip`: a strip of this width, in τ, determines the step without the marker beside it,
      whose place in a printed board is known to a pixel of the print only (half: 0.0055, double:
      0.0047).
    - `neglected`, `neglected_narrow`: σ, in τ·|n₁·n₂|, of what is not modelled beside markers under
      oblique lines, to whose sides they are not parallel; the second decreases by
      exp(−(width/τ)²/2). Found on rendered boards tilted by 50° and 65°.
    - `max_relative_noise`: residuals of a corner above this multiple of their median over all
      corners are not noise: something covers the window in part.
    - `max_steps`, `last_step`: end of the iterations: evaluations, and the change of 19 corners in
      20, pixels, after which the next is negligible (Gauss-Newton).
    - `max_terms`, `last_term`: of the series for oblique lines, and the size of the last one,
      relative to the contrast: below the steps of grey values, 1/255.
    - `pairs`: of opposite sectors about the corner whose residuals are compared.
    """

    max_half: int = 7
    complete: float = 5.0
    part: float = 0.4
    first_blur: float = 1.0
    min_blur: float = 0.35
    max_blur: float = 4.0
    blur_to_reduce: float = 2.8
    min_rows_to_reduce: int = 64
    min_strip: float = 1.5
    wide_strip: float = 3.2
    neglected: float = 0.01
    neglected_narrow: float = 0.06
    max_relative_noise: float = 3.0
    max_steps: int = 12
    last_step: float = 4e-3
    max_terms: int = 8
    last_term: float = 3e-3
    pairs: int = 8


@dataclasses.dataclass(frozen=True)
class Saddles:
    """Corners: pixels, covariance, and why one was left out, or ""."""

    xy: Float[np.ndarray, "n 2"]
    covariance: Float[np.ndarray, "n 2 2"]
    why: np.ndarray  # of str


def fit_saddles(
    grey: Real[np.ndarray, "rows columns"],
    approximate: Float[np.ndarray, "n 2"],
    lines: Float[np.ndarray, "n 2 2"],
    strips: Strips | None = None,
    settings: SaddleSettings | None = None,
) -> Saddles:
    """Corners of squares in a photograph.

    **Arguments:** `approximate`: the corners to a pixel or two; `lines`: the vectors to the next
    corner (or other edge) along both lines, pixels; `strips`, for ChArUco boards: distances of the
    marker's corner from both lines, in the quarter of these signs of s₁ and s₂ (0: negative).
    """
    settings = settings or SaddleSettings()
    saddles, blur = _fit(grey, approximate, lines, strips, settings.max_half, settings)
    if (half := settings.complete * np.median(blur)) > settings.max_half:
        saddles, blur = _fit(grey, approximate, lines, strips, half, settings)
    if np.median(blur) < settings.blur_to_reduce or min(grey.shape) < settings.min_rows_to_reduce:
        return saddles
    # An image blurred over several pixels loses nothing in half the pixels, and the windows then
    # contain the whole change.
    rows, columns = (n // 2 * 2 for n in grey.shape)
    small = grey[:rows, :columns].reshape(rows // 2, 2, columns // 2, 2).mean((1, 3))
    strips = None if strips is None else strips / 2
    saddles = fit_saddles(small, (approximate - 0.5) / 2, lines / 2, strips, settings)
    return Saddles(2 * saddles.xy + 0.5, 4 * saddles.covariance, saddles.why)


@dataclasses.dataclass(frozen=True)
class _Windows:
    """The pixels about corners [n, pixels]: (u, v), grey values, whether in the image, and how far
    from each corner they are used."""

    place: Float[np.ndarray, "n pixels 2"]
    grey: Pixels
    inside: Bool[np.ndarray, "n pixels"]
    half: Float[np.ndarray, " n"]
    strips: Strips | None

    @classmethod
    def cut(
        cls,
        grey: Real[np.ndarray, "rows columns"],
        approximate: Float[np.ndarray, "n 2"],
        half_window: Float[np.ndarray, " n"],
        strips: Strips | None,
    ) -> "_Windows":
        """Those of the largest window for all corners."""
        window = int(np.ceil(half_window.max()))
        v, u = np.mgrid[-window : window + 1, -window : window + 1].reshape(2, -1)
        place = np.rint(approximate)[:, None] + np.stack([u, v], 1)
        height, width = grey.shape
        is_inside = np.all((place >= 0) & (place < [width, height]), axis=2)
        column, row = np.where(is_inside[..., None], place, 0).astype(int).transpose(2, 0, 1)
        # Single precision is faster by half. It rounds a place of some thousand pixels to 0.0002:
        # σ of a corner is 0.005 and more.
        g, place = grey[row, column].astype(np.float32), place.astype(np.float32)
        return cls(
            place, g, is_inside, half_window, None if strips is None else strips.astype(np.float32)
        )

    def weight(self, theta: Theta, settings: SaddleSettings) -> Pixels:
        """1 for the pixels of the model about the corners as they are."""
        distance = np.linalg.norm(self.place - theta[:, None, :2], axis=2)
        is_used = self.inside & (distance <= self.half[:, None])
        if self.strips is not None:
            wide = settings.wide_strip
            is_used &= _beside_lines(theta.astype(np.float32), self.place, self.strips, wide)
        return is_used.astype(np.float32)


def _fit(
    grey: Real[np.ndarray, "rows columns"],
    approximate: Float[np.ndarray, "n 2"],
    lines: Float[np.ndarray, "n 2 2"],
    strips: Strips | None,
    largest: float,
    settings: SaddleSettings,
) -> tuple[Saddles, Float[np.ndarray, " n"]]:
    """The corners, and τ of each."""
    length = np.linalg.norm(lines, axis=2)
    half_window = np.clip(settings.part * length.min(1), 2.0, largest)
    angle = np.arctan2(lines[..., 1], lines[..., 0])
    windows = _Windows.cut(grey, approximate, half_window, strips)
    theta = np.zeros((len(approximate), UNKNOWNS))
    theta[:, :2], theta[:, 2:4] = approximate, angle
    theta[:, 6] = np.log(settings.first_blur)
    # Weights 1/σ² of weak pseudo-observations: lines to 0.3 rad, τ of a lens in focus to a factor
    # of e, light that changes by 10 % a pixel.
    reference, prior = theta.copy(), np.zeros(UNKNOWNS)
    reference[:, 6] = np.log(0.8)
    prior[2:4], prior[6], prior[7:] = 0.3**-2.0, 1.0, 0.1**-2.0
    noise = np.ones(len(approximate))
    for step in range(settings.max_steps):
        weight = windows.weight(theta, settings)
        if step < 2:
            levels = _levels(theta.astype(np.float32), windows.place, windows.grey, weight)
            theta[:, 4:6] = levels
        model, J = _model(theta.astype(np.float32), windows.place, windows.strips, settings)
        r = windows.grey - model
        N, b = normal_equations(J, r, weight, prior, reference - theta, noise)
        d = np.linalg.solve(N, b[..., None])[..., 0]
        # Gauss-Newton with bounded steps: beyond τ, here 0.7 of it, the model is not linear. Lines
        # turn by 0.2 rad, levels change by 100 grey values, τ by a factor of 1.5, the light by 10 %
        # a pixel at most.
        limit = [0.7, 0.7, 0.2, 0.2, 100, 100, 0.4, 0.1, 0.1]
        theta = theta + np.clip(d, np.negative(limit), limit)
        theta[:, 6] = np.clip(theta[:, 6], np.log(settings.min_blur), np.log(settings.max_blur))
        noise = noise_of_residuals(r, weight, UNKNOWNS)
        if step > 2 and np.quantile(np.abs(d[:, :2]), 0.95) < settings.last_step:
            break
    model, J = _model(theta.astype(np.float32), windows.place, windows.strips, settings)
    r = windows.grey - model
    N, _ = normal_equations(J, r, weight, prior, 0 * theta, noise)
    Q = np.linalg.inv(N)
    from_corner = windows.place - theta[:, None, :2]
    scale = noise * _excess(J, r, weight, Q, noise, from_corner, settings.pairs)
    covariance = scale[:, None, None] ** 2 * Q[:, :2, :2]
    shift = np.linalg.norm(theta[:, :2] - approximate, axis=1)
    has_few = weight.sum(1) < 2 * UNKNOWNS
    is_lost = has_few | ~(shift < np.maximum(half_window, 2.5))
    covariance, why = _judge(
        theta, covariance, noise, half_window, angle, strips, is_lost, settings
    )
    return Saddles(theta[:, :2], covariance, why), np.exp(theta[:, 6])


def _judge(
    theta: Theta,
    covariance: Float[np.ndarray, "n 2 2"],
    noise: Float[np.ndarray, " n"],
    half_window: Float[np.ndarray, " n"],
    angle: Float[np.ndarray, "n 2"],
    strips: Strips | None,
    is_lost: Bool[np.ndarray, " n"],
    settings: SaddleSettings,
) -> tuple[Float[np.ndarray, "n 2 2"], np.ndarray]:
    """The covariance with what the model neglects, and why corners are left out, or ""."""
    blur, contrast = np.exp(theta[:, 6]), np.abs(theta[:, 5])
    oblique = np.abs(np.sin(angle[:, 0] - angle[:, 1]))
    narrow = half_window * oblique
    if strips is not None:
        narrow = np.minimum(narrow, strips.astype(np.float32).min((1, 2, 3)))
        ratio = narrow / blur
        neglected = settings.neglected + settings.neglected_narrow * np.exp(-(ratio**2) / 2)
        lean = np.abs(np.cos(angle[:, 0] - angle[:, 1])) / oblique
        neglected = np.where(ratio < settings.wide_strip, neglected * blur * lean, 0.0)
        covariance = covariance + neglected[:, None, None] ** 2 * np.eye(2)
    why = np.full(len(theta), "", dtype=object)
    largest = np.linalg.eigvalsh(np.nan_to_num(covariance, nan=1e9))[:, 1]
    why[~(largest <= MAX_SIGMA**2)] = TOO_SMALL
    why[narrow < settings.min_strip * blur] = TOO_SMALL
    # Residuals far above those of the other corners, and visible beside the contrast (D is half of
    # it): something covers the window in part; at 0.4·D there is no saddle at all.
    covered = (noise > settings.max_relative_noise * np.median(noise)) & (noise > 0.05 * contrast)
    why[is_lost | (noise > 0.4 * contrast) | covered] = NO_CORNER
    return covariance, why


def lines_of_grid(xy: Float[np.ndarray, "rows columns 2"]) -> Float[np.ndarray, "rows columns 2 2"]:
    """Vectors to the next points along the row and along the column, the shorter of both sides; NaN
    for a point without neighbours."""
    lines = []
    for axis in (1, 0):
        step = np.diff(xy, axis=axis)
        gap = np.full_like(np.take(xy, [0], axis), np.nan)
        steps_both_ways = np.stack(
            [np.concatenate([step, gap], axis), np.concatenate([gap, step], axis)]
        )
        length = np.nan_to_num(np.linalg.norm(steps_both_ways, axis=3), nan=np.inf)
        lines.append(np.take_along_axis(steps_both_ways, length.argmin(0)[None, ..., None], 0)[0])
    return np.stack(lines, 2)


def _distances(
    theta: Theta, place: Float[np.ndarray, "n pixels 2"]
) -> tuple[Float[np.ndarray, "n pixels 2"], Float[np.ndarray, "n pixels 2"]]:
    """Distances s and positions t of pixels by both lines, [n, pixels, 2]."""
    c, s = np.cos(theta[:, None, 2:4]), np.sin(theta[:, None, 2:4])
    x, y = (place - theta[:, None, :2])[..., None, :].transpose(3, 0, 1, 2)
    return y * c - x * s, x * c + y * s


def _strip_of(
    s: Float[np.ndarray, "n pixels 2"], strips: Strips
) -> Float[np.ndarray, "n pixels 2"]:
    """The strips of the quarters of pixels, [n, pixels, 2]."""
    is_beyond_first, is_beyond_second = (s > 0).astype(int).transpose(2, 0, 1)
    return strips[np.arange(len(s))[:, None], is_beyond_first, is_beyond_second]


def _beside_lines(
    theta: Theta, place: Float[np.ndarray, "n pixels 2"], strips: Strips, wide_strip: float
) -> Bool[np.ndarray, "n pixels"]:
    """Pixels of the light strips; of narrow ones also the dark border of the marker, as wide as the
    strip."""
    s, _ = _distances(theta, place)
    strip, blur = _strip_of(s, strips), np.exp(theta[:, 6])[:, None, None]
    # 2 τ before the marker's edge; with the border of a narrow one, 1.5 τ before its far side
    wide = strip > wide_strip * blur
    limit = np.where(wide, strip - 2 * blur, np.maximum(2 * strip - 1.5 * blur, strip))
    return np.any(np.abs(s) < limit, axis=2)


def _levels(
    theta: Theta, place: Float[np.ndarray, "n pixels 2"], g: Pixels, weight: Pixels
) -> Float[np.ndarray, "n 2"]:
    """M and D of the pixels for the lines as they are."""
    s, _ = _distances(theta, place)
    x = (2 * scipy.special.ndtr(s / np.exp(theta[:, None, 6:7])) - 1).prod(2)
    n, sx, sy = weight.sum(1), (weight * x).sum(1), (weight * g).sum(1)
    sxx, sxy = (weight * x * x).sum(1), (weight * x * g).sum(1)
    D = (n * sxy - sx * sy) / np.maximum(n * sxx - sx**2, 1e-9)
    return np.stack([(sy - D * sx) / np.maximum(n, 1), D], 1)


def _model(
    theta: Theta,
    place: Float[np.ndarray, "n pixels 2"],
    strips: Strips | None,
    settings: SaddleSettings,
) -> tuple[Pixels, Float[np.ndarray, "n pixels 9"]]:
    """Grey values of the pixels, and their derivatives [n, pixels, unknowns]; those by θ and τ
    without the part through ρ: they are even about the corner, and do not touch it."""
    s, t = _distances(theta, place)
    tau, M, D = np.exp(theta[:, None, 6]), theta[:, None, 4], theta[:, None, 5]
    rho = np.cos(theta[:, 2] - theta[:, 3])[:, None]
    z = s / tau[..., None]
    P, derivative = _joint(z, rho, settings)
    E = 2 * scipy.special.ndtr(z) - 1
    X = 4 * (P - 0.25 * (1 + E[..., 0]) * (1 + E[..., 1])) + E[..., 0] * E[..., 1]
    slope = (4 * derivative - 2 * _density(z)) / tau[..., None]  # of X by s
    of_blur = -(s * slope).sum(2)
    if strips is not None:
        k = (np.abs(s) - _strip_of(s, strips)) / tau[..., None]
        side = np.sign(s)
        P, derivative = _joint(k, rho * side[..., 0] * side[..., 1], settings)
        correction = 2 * np.sign(D) * (side[..., 0] * side[..., 1] == np.sign(D))
        X = X - correction * P
        slope = slope - correction[..., None] * derivative * side / tau[..., None]
        of_blur += correction * (k * derivative).sum(2)
    from_corner = place - theta[:, None, :2]
    c, n = np.cos(theta[:, None, 2:4]), np.sin(theta[:, None, 2:4])
    light = 1 + (from_corner * theta[:, None, 7:]).sum(2)
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
            squares * from_corner[..., 0],
            squares * from_corner[..., 1],
        ],
        2,
    )
    return squares * light, J


def _density(z: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    return np.exp(-z * z / 2) / np.float32(np.sqrt(2 * np.pi))


def _joint(
    z: Float[np.ndarray, "n pixels 2"],
    rho: Float[np.ndarray, "n pixels"] | Float[np.ndarray, "n 1"],
    settings: SaddleSettings,
) -> tuple[Pixels, Float[np.ndarray, "n pixels 2"]]:
    """P(ε₁ < z₁, ε₂ < z₂) of normal variables of correlation ρ, by the tetrachoric series

        Φ(z₁)·Φ(z₂) + φ(z₁)·φ(z₂)·Σ ρᵏ⁺¹/(k + 1)!·He_k(z₁)·He_k(z₂)

    and its derivatives φ(z₁)·Φ((z₂ − ρ·z₁)/√(1 − ρ²)), … by both."""
    ndtr, f = scipy.special.ndtr, _density(z)
    F = ndtr(z)
    previous_polynomial, He = np.zeros_like(z), np.ones_like(z)
    total, factor = 0.0, np.ones_like(rho)
    largest = np.abs(rho).max()
    for k in range(settings.max_terms):
        if k and largest ** (k + 1) / (k + 1) < settings.last_term:
            break
        factor = factor * rho / (k + 1)
        total = total + factor * He[..., 0] * He[..., 1]
        previous_polynomial, He = He, z * He - k * previous_polynomial
    P = F[..., 0] * F[..., 1] + f[..., 0] * f[..., 1] * total
    # ρ² = 0.99: lines at 6°, which are no corner
    other_coordinate = (z[..., ::-1] - rho[..., None] * z) / np.sqrt(1 - np.minimum(rho**2, 0.99))[
        ..., None
    ]
    return P, f * ndtr(other_coordinate)


def _excess(
    J: Float[np.ndarray, "n pixels 9"],
    r: Pixels,
    weight: Pixels,
    Q: Float[np.ndarray, "n 9 9"],
    noise: Float[np.ndarray, " n"],
    from_corner: Float[np.ndarray, "n pixels 2"],
    pairs: int,
) -> Float[np.ndarray, " n"]:
    """By how much the corners from opposite pairs of sectors scatter more than the noise says (1:
    not); what is alike on opposite sides does not move the corner."""
    angle = np.arctan2(from_corner[..., 1], from_corner[..., 0])
    pair = ((angle / np.pi + 1) * pairs).astype(int) % pairs
    total, inverse = np.zeros(len(r)), np.linalg.inv(Q[:, :2, :2])
    for k in range(pairs):
        score = np.einsum("npi,np->ni", J, weight * r * (pair == k))
        shift = np.einsum("nij,nj->ni", Q[:, :2], score)
        total += np.einsum("ni,nij,nj->n", shift, inverse, shift)
    ratio = total / (2 * (pairs - 1) * noise**2)
    # χ²/f of f = 2·pairs coordinates has the σ √(2/f): only beyond 3 of it
    return np.where(ratio > 1 + 3 * np.sqrt(1 / pairs), np.sqrt(ratio), 1.0)
