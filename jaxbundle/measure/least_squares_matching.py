"""Least squares matching: a window of one image found in another, to a fraction of a pixel.

    g1(x, y) + v = h0 + h1·g2(u, v),        [u, v] = A·[x, y, 1]

with x, y from the centre of the window, A [2, 3] an affine transformation into the other
image, with the position of the centre in its last column, h0 and h1 for brightness and contrast:
eight unknowns. g2 between the pixels by the cubic spline through them; the Jacobian by automatic
differentiation. Damped steps (Marquardt).

Interpolated noise of variance σ² has the variance σ²·κ(u)·κ(v), periodic by pixels: 1 at a pixel,
0.57 in the middle of four. With equal noise in both windows

    E vᵀv/(n² − 8) = σ²·(1 + h1²·κ̄),    C = σ²·(1 + h1²)·N⁻¹,

with n² pixels in the window and κ̄ the mean of κ(u)·κ(v) over them, since the gradients are smooth
and interpolation does not reduce their noise. C is the covariance of one position relative to the
other: each window has half of it. Noise makes vᵀv smallest midway between pixels: the expectation
of ½·vᵀv contains ½·σ²·h1²·Σκ(u)·κ(v), which shifts p by −N⁻¹·∂/∂p of it; this is subtracted.

Cubic convolution instead of the spline shifts positions by up to 0.03 pixel on sharp photographs.

Both images may have been smoothed by a Gaussian of s pixels before (`blur`). Then noise is not
reduced by interpolation, but correlated, with R = exp(−d²/4s²) at a distance of d pixels:

    E vᵀv = σ²·(n² − tr(N⁻¹·JᵀRJ)),    C = σ²·N₀⁻¹·JᵀRJ·N₀⁻¹,

with N₀ = N − E JₙᵀJₙ: noise gradients, of variance σ²/2s², are in N, but determine nothing.

If the surface is not a plane within the window, residuals are not noise: they are correlated, and
large in one part of it, such as behind an edge. With g = J'v of every pixel (its row of J times its
residual) the covariance follows from their correlations (over `reach` pixels),

    C = N⁻¹·Σ K(d)·g(x)·g(x + d)ᵀ·N⁻¹,    K = (1 − |dx|/reach)·(1 − |dy|/reach) or 0.

On photographs of objects 3 to 40 m away it reduces errors above 4 σ from 3.4 to 0.9 %. Of noise
alone σ is 0.6 to 0.7 of the true one, since the fit takes part of the correlation.

Perspective and the curvature of the surface add terms of second order to A (six, of both
coordinates), which shift the position by up to the mean of them over the window. With `bend`, they
are unknowns of the last step, each observed as 0 with this σ: what the window does not determine of
them is part of C.

Sources: Conley (1999), GMM estimation with cross sectional dependence, J. of Econometrics 92(1);
Gruen (1985), Adaptive least squares correlation, South African J. of Photogrammetry 14(3);
Ackermann (1984), Digital image correlation, Photogrammetric Record 11(64); Schreier, Braasch and
Sutton (2000), Systematic errors in digital image correlation caused by intensity interpolation,
Optical Engineering 39(11); Unser (1999), Splines, IEEE Signal Processing Magazine 16(6).
"""

import dataclasses
from collections.abc import Callable
from enum import IntEnum
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Bool, Float, Int

from jaxbundle.types import AnyArray, Scalar

# A [2, 3], row by row, h0, h1.
UNKNOWNS = 8
Unknowns = Float[Array, "8"]
Normal = Float[Array, "8 8"]
Pixels = Float[AnyArray, " n*n"]


@dataclasses.dataclass(frozen=True)
class LeastSquaresSettings:
    """When the iterations of a matching end, and which results are refused.

    **Fields:**

    - `last_step`: pixels; steps below this, anywhere in the window, end the iterations. A match of
      good texture has a σ of 0.016, and the next step is far smaller.
    - `max_shift`: the centre may move from its start by this part of the side of the window: beyond
      half of it, the point is outside the window that was expected.
    - `min_scale`: smallest determinant of A relative to its start; below 0 it is mirrored.
    - `min_contrast`: standard deviation of grey values, relative to the largest, below which there
      is none: ten roundings of 32 bits.
    - `min_pivot`: smallest square of a pivot of N, scaled to a unit diagonal, below which nothing
      is determined: a hundred roundings of 32 bits.
    - `damping`, `min_damping`: λ at the start, and the smallest, which rounding does not exceed.
    """

    last_step: float = 0.005
    max_shift: float = 0.5
    min_scale: float = 0.1
    min_contrast: float = 1e-6
    min_pivot: float = 1e-5
    damping: float = 1e-3
    min_damping: float = 1e-6


class MatchingStatus(IntEnum):
    """How a matching ended."""

    CONVERGED = 0
    NOT_CONVERGED = 1
    OUTSIDE = 2
    """The window extends beyond the other image."""
    NO_TEXTURE = 3
    """The grey values do not determine the position."""
    DIVERGED = 4
    """The match moved too far from its start, shrank (`min_scale`), or was mirrored."""


class LeastSquaresMatch(eqx.Module):
    """`affine`: A, pixels of the other image; `radiometry`: (h0, h1); `covariance`: of the position
    A[:, 2], pixels², relative to the window; `sigma0`: of a residual v, which has the noise of both
    windows, grey values; `correlation`: ρ of the window and its match; `status`: a
    `MatchingStatus`."""

    affine: Float[Array, "2 3"]
    radiometry: Float[Array, "2"]
    covariance: Float[Array, "2 2"]
    sigma0: Float[Array, ""]
    correlation: Float[Array, ""]
    status: Int[Array, ""]

    @property
    def place(self) -> Float[Array, "*batch 2"]:
        """(u, v) of the centre of the window in the other image."""
        return self.affine[..., 2]


def match_least_squares(
    template: Float[AnyArray, "n n"],
    image: Float[AnyArray, "rows columns"],
    start: Float[AnyArray, "2 3"],
    steps: int = 12,
    blur: float = 0.0,
    reach: int = 0,
    bend: float | Float[AnyArray, ""] = 0.0,
    settings: LeastSquaresSettings | None = None,
) -> LeastSquaresMatch:
    """Match a window with another image, from a start within a few pixels; batch it by `jax.vmap`.

    **Arguments:** `template`: grey values of the window, n odd, its centre the point; `image`: the
    other image or a piece of it; `start`: A, from pixels about the centre of the window (x right, y
    down) to pixels of `image`; `steps`: maximum evaluations, of which two matches in three need
    six; `blur`: σ, pixels, of the Gaussian by which both were smoothed, 0: white noise; `reach`:
    pixels, less than n/2, over which residuals may be correlated, 0: not at all (then no `bend`);
    `bend`: σ of terms of second order at the edge of the window, pixels of `image`. With `blur`,
    `reach` and `bend` are not used.

    **Returns:** `status` gives the reason of a failure; the covariance is infinite if undetermined.
    """
    settings = settings or LeastSquaresSettings()
    n, dtype, start = template.shape[0], template.dtype, start.astype(template.dtype)
    mean, contrast = jnp.mean(template), jnp.std(template)
    textured = contrast > settings.min_contrast * jnp.max(jnp.abs(template))
    unit = jnp.where(textured, contrast, 1)
    grey = ((template - mean) / unit).ravel()
    other_coefficients = spline_coefficients((image.astype(dtype) - mean) / unit)
    offset = jnp.arange(n, dtype=dtype) - n // 2
    y, x = (a.ravel() for a in jnp.meshgrid(offset, offset, indexing="ij"))
    # Unknowns scaled by their effect at the edge of the window.
    size = jnp.asarray([n // 2, n // 2, 1, n // 2, n // 2, 1, 1, 1], dtype)
    computed = lambda p: jax.vmap(_compute, (None, None, 0, 0))(p / size, other_coefficients, x, y)
    p = size * _with_radiometry(start, other_coefficients, x, y)
    p, N, square, moving = _minimise(computed, grey, p, steps, settings)
    Q, determined = _inverse(N, settings.min_pivot)
    contrast2 = (p[7] / size[7]) ** 2
    if blur > 0:
        J = jax.jacfwd(computed)(p)
        M = _sum_over_pairs(J, n, lambda d: np.exp(-(d**2) / (4 * blur**2)))
        variance = square / (n * n - jnp.trace(Q @ M))
        N = N - variance * _expect_noise(contrast2, size, x, y, blur)
        Q, real = _inverse(N, settings.min_pivot)
        determined, C, pulled = determined & real, variance * Q @ M @ Q, 0
    else:
        variance = square / (n * n - UNKNOWNS)
        C, pulled = _white_noise(p, Q, determined, variance, contrast2, (size, x, y))
        if reach:
            J, v = jax.jacfwd(computed)(p), computed(p) - grey
            p, C = _bend(p, J, v, variance, bend, x, y, reach, settings.min_pivot)
    p = (p + pulled) / size
    is_determined = textured & determined & (p[7] > 0)
    return LeastSquaresMatch(
        affine=p[:6].reshape(2, 3),
        radiometry=jnp.stack([mean + unit * p[6] - p[7] * mean, p[7]]),
        covariance=jnp.where(is_determined, C[2:6:3, 2:6:3], jnp.inf),
        sigma0=unit * jnp.sqrt(variance),
        correlation=jnp.sqrt(jnp.maximum(1 - square / n**2, 0)),
        status=_status(p, start, image.shape, n, textured, is_determined, moving, settings),
    )


def _status(
    p: Unknowns,
    start: Float[AnyArray, "2 3"],
    shape: tuple[int, ...],
    n: int,
    textured: Bool[Array, ""],
    is_determined: Bool[Array, ""],
    moving: Bool[Array, ""],
    settings: LeastSquaresSettings,
) -> Int[Array, ""]:
    """The first reason for the end of a matching."""
    affine = p[:6].reshape(2, 3)
    middle = (jnp.asarray(shape[::-1]) - 1) / 2
    h = n // 2
    corners = jnp.asarray([[-h, h, h, -h], [-h, -h, h, h], [1, 1, 1, 1]], affine.dtype)
    farthest = jnp.max(jnp.abs(affine @ corners - middle[:, None]), 1)
    shift = jnp.linalg.norm(affine[:, 2] - start[:, 2])
    area = jnp.linalg.det(affine[:, :2]) / jnp.linalg.det(start[:, :2])
    reasons = (
        (~textured, MatchingStatus.NO_TEXTURE),
        (jnp.any(farthest > middle), MatchingStatus.OUTSIDE),
        (
            # So written that NaN counts, too.
            ~((shift < settings.max_shift * n) & (area > settings.min_scale)),
            MatchingStatus.DIVERGED,
        ),
        (~is_determined, MatchingStatus.NO_TEXTURE),
        (moving, MatchingStatus.NOT_CONVERGED),
    )
    return jnp.select(
        [holds for holds, _ in reasons],
        [int(status) for _, status in reasons],
        int(MatchingStatus.CONVERGED),
    )


def spline_coefficients(
    image: Float[AnyArray, "rows columns"],
) -> Float[Array, "rows+2 columns+2"]:
    """Coefficients of the cubic spline through the pixels of an image, without curvature at its
    edge (the natural spline): from one before the first pixel to one after the last."""
    filter_rows, filter_columns = (jnp.asarray(_prefilter(n), image.dtype) for n in image.shape)
    return filter_rows @ image @ filter_columns.T


def grey_value(
    coefficients: Float[AnyArray, "rows columns"], u: Scalar, v: Scalar
) -> Float[AnyArray, ""]:
    """The grey value of an image at (u, v), by its `spline_coefficients`."""
    rows, columns = coefficients.shape
    i, j = (jnp.floor(jax.lax.stop_gradient(a)) for a in (v, u))
    # From the pixel before: the first coefficient is before the first pixel.
    row = [jnp.clip(i.astype(int) + k, 0, rows - 1) for k in (0, 1, 2, 3)]
    column = [jnp.clip(j.astype(int) + k, 0, columns - 1) for k in (0, 1, 2, 3)]
    row_weights, column_weights = _spline_weights(v - i), _spline_weights(u - j)
    # Sums written out: one loop over the window, whereas small products are one call each.
    nil = jnp.zeros((), coefficients.dtype)
    line = lambda r: sum((b * coefficients[r, c] for b, c in zip(column_weights, column)), nil)
    return sum((a * line(r) for a, r in zip(row_weights, row)), nil)


def _spline_weights(t: Scalar) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """The cubic B-spline at t + 1, t, 1 − t, 2 − t, 0 ≤ t < 1 (Unser, 1999, equation 3)."""
    return (
        (1 - t) ** 3 / 6,
        ((3 * t - 6) * t * t + 4) / 6,
        (((3 - 3 * t) * t + 3) * t + 1) / 6,
        t**3 / 6,
    )


def _prefilter(n: int) -> Float[np.ndarray, "m n"]:
    """From n values to the m = n + 2 coefficients of the spline through them, with one beyond each
    end.

    The inverse of the banded matrix of ⅙, ⅔, ⅙, dense: windows are small, and two products with it
    are one call for all of a batch, where the recursive filter of Unser is a loop over the rows."""
    B = (np.eye(n, k=-1) + 4 * np.eye(n) + np.eye(n, k=1)) / 6
    # Second derivatives c₋₁ − 2·c₀ + c₁ of 0 at the ends: there c₀ is the value itself.
    B[[0, -1]] = np.eye(n)[[0, -1]]
    c = np.linalg.inv(B)
    return np.concatenate([2 * c[:1] - c[1:2], c, 2 * c[-1:] - c[-2:-1]])


def _remaining_noise(t: Pixels) -> Pixels:
    """κ: variance of interpolated white noise of variance 1, t from a pixel, along one axis."""
    # The prefilter's response √3·(√3 − 2)^|k|; 0.27²⁴ is rounding.
    k = np.arange(-24, 25)
    response = np.sqrt(3.0) * (np.sqrt(3.0) - 2) ** np.abs(k)
    correlation = np.correlate(response, response, "full")[2 * 24 :][:4]
    w = _spline_weights(t)
    pairs = ((i, a, j, b) for i, a in enumerate(w) for j, b in enumerate(w))
    return sum((correlation[abs(i - j)] * a * b for i, a, j, b in pairs), jnp.zeros_like(t))


def _bend(
    p: Unknowns,
    J: Float[Array, "n*n 8"],
    v: Pixels,
    variance: Scalar,
    bend: Scalar,
    x: Pixels,
    y: Pixels,
    reach: int,
    min_pivot: float,
) -> tuple[Unknowns, Normal]:
    """The unknowns after a step that includes terms of second order, observed as 0 ± `bend`, and
    their covariance from correlated residuals."""
    x, y = x / jnp.max(x), y / jnp.max(y)
    second_order = [J[:, k] * term for k in (2, 5) for term in (x * x, x * y, y * y)]
    # As unknowns in units of their σ: columns of 0 if `bend` is 0, which change nothing.
    J = jnp.column_stack([J, *(bend * column for column in second_order)])
    weight = jnp.diag(variance * np.repeat([0, 1], [UNKNOWNS, len(second_order)]).astype(J.dtype))
    Q, _ = _inverse(J.T @ J + weight, min_pivot)
    step = Q @ (J.T @ v)
    g, n = J * (v - J @ step)[:, None], round(len(v) ** 0.5)
    K = lambda d: np.maximum(1 - np.abs(d) / reach, 0)
    C = Q @ (_sum_over_pairs(g, n, K) + weight**2) @ Q
    return p - step[:UNKNOWNS], C[:UNKNOWNS, :UNKNOWNS]


def _sum_over_pairs(
    g: Float[Array, "n*n k"], n: int, K: Callable[[np.ndarray], np.ndarray]
) -> Float[Array, "k k"]:
    """Σ K(dx)·K(dy)·g(x)·g(x + d)ᵀ over a window of n × n pixels; K separates, so that it takes 2·n
    products a pixel instead of n²."""
    k = np.arange(n)
    weight = jnp.asarray(K(k[:, None] - k), g.dtype)
    smoothed = jnp.einsum("ab,cd,bdp->acp", weight, weight, g.reshape(n, n, -1))
    return g.T @ smoothed.reshape(g.shape)


def _expect_noise(contrast2: Scalar, size: Unknowns, x: Pixels, y: Pixels, blur: float) -> Normal:
    """E JₙᵀJₙ for residuals of variance 1, for the share of the other image."""
    ones, nil = jnp.ones_like(x), jnp.zeros_like(x)
    slope = jnp.sqrt(contrast2 / (1 + contrast2) / (2 * blur**2))
    u = jnp.stack([x, y, ones, nil, nil, nil, nil, nil], 1) / size * slope
    v = jnp.stack([nil, nil, nil, x, y, ones, nil, nil], 1) / size * slope
    contrast = jnp.zeros((UNKNOWNS, UNKNOWNS), x.dtype).at[7, 7].set(len(x) / (1 + contrast2))
    return u.T @ u + v.T @ v + contrast


def _white_noise(
    p: Unknowns,
    Q: Normal,
    determined: Bool[Array, ""],
    variance: Scalar,
    contrast2: Scalar,
    window: tuple[Unknowns, Pixels, Pixels],
) -> tuple[Normal, Unknowns]:
    """C from equal white noise in both windows, and the correction of p, which noise draws towards
    the middle between pixels."""
    size, x, y = window
    fraction = lambda u: u - jnp.floor(jax.lax.stop_gradient(u))

    def interpolated_noise(p: Unknowns) -> Float[Array, ""]:
        """½·Σκ(u)·κ(v) over the window."""
        a = p / size
        u, v = fraction(a[0] * x + a[1] * y + a[2]), fraction(a[3] * x + a[4] * y + a[5])
        return jnp.sum(_remaining_noise(u) * _remaining_noise(v)) / 2

    remaining, pull = jax.value_and_grad(interpolated_noise)(p)
    noise = variance / (1 + contrast2 * remaining / (len(x) / 2))
    pulled = contrast2 * noise * jnp.where(determined, Q @ pull, 0)
    return noise * (1 + contrast2) * Q, pulled


def _compute(
    p: Unknowns, image: Float[Array, "rows columns"], x: Scalar, y: Scalar
) -> Float[Array, ""]:
    """h0 + h1·g2 of one pixel of the window."""
    return p[6] + p[7] * grey_value(image, p[0] * x + p[1] * y + p[2], p[3] * x + p[4] * y + p[5])


def _with_radiometry(
    start: Float[AnyArray, "2 3"], image: Float[Array, "rows columns"], x: Pixels, y: Pixels
) -> Unknowns:
    """The eight unknowns: A, and h0, h1 from the mean and the variance of the covered pixels."""
    u, v = start @ jnp.stack([x, y, jnp.ones_like(x)])
    covered = jax.vmap(grey_value, (None, 0, 0))(image, u, v)
    standard_deviation = jnp.std(covered)
    h1 = jnp.where(
        standard_deviation > 0, 1 / jnp.where(standard_deviation > 0, standard_deviation, 1), 1
    )
    return jnp.concatenate([start.ravel(), jnp.stack([-h1 * jnp.mean(covered), h1])])


def _minimise(
    computed: Callable[[Unknowns], Pixels],
    grey: Pixels,
    begin: Unknowns,
    steps: int,
    settings: LeastSquaresSettings,
) -> tuple[Unknowns, Normal, Scalar, Bool[Array, ""]]:
    """The unknowns, N, vᵀv, and whether they still change, after damped steps.

    Marquardt's own rule (1963), λ by tenfold: a step is accepted if vᵀv does not grow, and the
    position decides about the end, in pixels. The engine (`leastsquares/iterations/loop.py`)
    accepts by the gain ratio and ends by the σ of the unknowns; its limits for rounding are those
    of 64 bits, whereas windows are matched in 32. Measured on 512 windows of 17 × 17 pixels in
    pieces of 41 × 41, stopping at 0.1 σ: the same RMS error, 0.016 pixel, and the same time, 0.40
    ms against 0.43 here; from starts up to 2.5 pixels off it loses 6 matches, this rule 3. At 0.01
    σ it loses 6 of the near ones to rounding.
    """

    def twice(p: Unknowns) -> tuple[Pixels, Pixels]:
        values = computed(p)
        return values, values

    # Traced once, for the start and the steps.
    @jax.jit
    def normal_equations(p: Unknowns) -> tuple[Normal, Unknowns, Scalar]:
        # Forward, and stored: in reverse, or within the products, grey values are looked up again.
        J, values = jax.lax.optimization_barrier(jax.jacfwd(twice, has_aux=True)(p))
        v = values - grey
        return J.T @ J, J.T @ v, v @ v

    def improve(state: tuple[Any, ...]) -> tuple[Any, ...]:
        count, p, N, g, square, damping, moving = state
        # Scaled to a unit diagonal; by 1e-20 the step of an unknown without effect is 0, not NaN.
        scale = 1 / jnp.sqrt(jnp.diag(N) + 1e-20)
        scaled = N * scale * scale[:, None] + damping * jnp.eye(UNKNOWNS, dtype=N.dtype)
        step = -scale * cho_solve(cho_factor(scaled), scale * g)
        N1, g1, square1 = normal_equations(p + step)
        better = square1 <= square
        new = (p + step, N1, g1, square1)
        accepted_values = [jnp.where(better & moving, a, b) for a, b in zip(new, (p, N, g, square))]
        is_still = jnp.max(jnp.abs(step[:6])) < settings.last_step
        rate = jnp.where(better, 0.1, 10.0).astype(damping.dtype)
        damping = jnp.maximum(damping * rate, settings.min_damping)
        return count + 1, *accepted_values, damping, moving & ~is_still

    damping = jnp.asarray(settings.damping, begin.dtype)
    start = (0, begin, *normal_equations(begin), damping, jnp.asarray(True))
    _, p, N, _, square, _, moving = jax.lax.while_loop(
        lambda state: (state[0] < steps) & state[-1], improve, start
    )
    return p, N, square, moving


def _inverse(
    N: Float[Array, "k k"], min_pivot: float
) -> tuple[Float[Array, "k k"], Bool[Array, ""]]:
    """N⁻¹, and whether N determines everything."""
    scale = 1 / jnp.sqrt(jnp.diag(N) + 1e-20)
    scaled = N * scale * scale[:, None]
    factor = cho_factor(scaled)
    smallest_pivot = jnp.min(jnp.diag(factor[0]) ** 2)
    determined = jnp.isfinite(smallest_pivot) & (smallest_pivot > min_pivot)
    eye = jnp.eye(len(N), dtype=N.dtype)
    safe = jnp.where(determined, scaled, eye)
    return cho_solve(cho_factor(safe), eye) * scale * scale[:, None], determined
