r"""Nearly straight edges between two levels of grey, fitted to the grey values of the pixels beside
them: a blurred step.

With s the distance of a pixel from the chord of an edge, towards its inner side, and t its position
along it, −1 … 1 from end to end, the edge is at s = u(t) = a + b·t + c·t², and the grey value

    g = W + (B − W)·[Φ((s − u)/τ) − q·Φ((s − u − w)/τ)] + V·Φ(−(s − u + o)/τ)

W and B are the outer and the inner level, linear in t; Φ the normal distribution and τ the blur,
that of the lens and of the pixel's area (1/12 pixel²). The second term is the far side of the inner
strip of width w, behind which q (0 … 1) is at the outer level again; the third an unknown level V +
W beyond the outer strip of width o. Both are 0 unless the strips are narrow. All unknowns of an
edge are estimated at once from its pixels, nothing is interpolated, so that their covariance
follows from the noise, which is that of the residuals. The half level of the *grey values* counts
as the edge: they are taken as proportional to light. An encoded photograph (gamma) shifts every
edge towards its dark side (`edge_shift`).

c takes up the curvature by the lens. It is bounded by a prior σ, so that short edges are
straight. Pixels near the ends, where the blur of the adjacent edges reaches, are left out. Parts of
an edge that contradict the others (dirt, a shadow) are left out, and if the others still scatter
more than their σ, the covariance is increased.
"""

import dataclasses

import numpy as np
import scipy  # its parts are loaded on use
from jaxtyping import Bool, Float, Int, Real

from jaxbundle.leastsquares.quality.distributions import NORMAL_SIGMA_BY_MAD
from jaxbundle.measure.grey_value_fit import noise_of_residuals, normal_equations

# The unknowns of edges, in the order of `UNKNOWNS`.
Theta = Float[np.ndarray, "n 9"]
# A, b, c, W at the middle, its change to the end, the same of B, V, ln τ.
UNKNOWNS = 9


@dataclasses.dataclass(frozen=True)
class EdgeSettings:
    """How edges are fitted to the grey values beside them.

    Half and double were tried on rendered markers (`tests/measure/test_corner_accuracy.py`), 48
    corners with an RMS error of 0.0162 pixel and error/σ 1.04; what has no figures below hardly
    changes either.

    **Fields:**

    - `blur_in_focus`: τ of a lens in focus, and the pixel: expected with a σ of a factor of e.
    - `min_blur`, `max_blur`: limits of τ, pixels: a pixel's area alone has 1/√12 = 0.29, and the
      step of a blur of 4 is 30 pixels wide.
    - `max_columns`: rows of pixels across an edge; longer edges are sampled: 64 make σ smaller by a
      quarter and take twice the time (half: RMS 0.0178, double: 0.0158).
    - `reach`: pixels are used to this distance from the edge, in τ, and one pixel more: Φ(−3.5) =
      0.02 %, the step is complete.
    - `clearance`: distance from adjacent edges in τ: Φ(−2.7) = 0.4 % of their contrast is
      left (half: RMS 0.0246, error/σ 1.58; double: 0.0300, for fewer pixels).
    - `parts`: of an edge that are compared, and left out singly: two or three pixels each at
      `max_columns`.
    - `max_part_shift`: of a part in its standard deviations: 2·Φ(−3.5) is once in 180 edges.
    - `max_steps`, `last_step`: end of the iterations: evaluations, and the change of nine edges in
      ten, pixels; the next is then negligible (Gauss-Newton).
    """

    blur_in_focus: float = 0.8
    min_blur: float = 0.35
    max_blur: float = 4.0
    max_columns: int = 32
    reach: float = 3.5
    clearance: float = 2.7
    parts: int = 12
    max_part_shift: float = 3.5
    max_steps: int = 8
    last_step: float = 3e-3


@dataclasses.dataclass(frozen=True)
class StraightEdges:
    """The expected edges: what is known of `n` of them before the fit.

    **Fields:** `start`, `end`, pixels, the inner side to the right of their direction as seen in
    the image (u right, v down); `before`, `after`: a point and the direction of the adjacent edges,
    [n, 2, 2]; `inner`, `outer`: widths of the strips at both ends, pixels, [n, 2]; `far`: positions
    t of the boundaries of cells behind the inner strip, [n, cells + 1], and `level` of each cell, 1
    for the outer level and 0 for the inner one, [n, cells].
    """

    start: Float[np.ndarray, "n 2"]
    end: Float[np.ndarray, "n 2"]
    before: Float[np.ndarray, "n 2 2"]
    after: Float[np.ndarray, "n 2 2"]
    inner: Float[np.ndarray, "n 2"]
    outer: Float[np.ndarray, "n 2"]
    far: Float[np.ndarray, "n cells+1"]
    level: Float[np.ndarray, "n cells"]

    @property
    def half(self) -> Float[np.ndarray, " n"]:
        """Half the length of the chord, pixels."""
        return np.linalg.norm(self.end - self.start, axis=1) / 2

    @property
    def middle(self) -> Float[np.ndarray, "n 2"]:
        return (self.start + self.end) / 2

    @property
    def along(self) -> Float[np.ndarray, "n 2"]:
        return (self.end - self.start) / (2 * self.half[:, None])

    @property
    def inward(self) -> Float[np.ndarray, "n 2"]:
        return _right_of(self.along)


@dataclasses.dataclass(frozen=True)
class EdgeFits:
    """Fitted edges: a, b, c in pixels and their covariance; blur τ and its σ of ln τ; contrast
    (inner minus outer level) and noise in grey values; `solved`: whether there is such an edge."""

    curve: Float[np.ndarray, "n 3"]
    covariance: Float[np.ndarray, "n 3 3"]
    blur: Float[np.ndarray, " n"]
    contrast: Float[np.ndarray, " n"]
    noise: Float[np.ndarray, " n"]
    solved: Bool[np.ndarray, " n"]


def take(edges: StraightEdges, rows: Int[np.ndarray, " rows"]) -> StraightEdges:
    """Some of the edges."""
    return StraightEdges(
        *(getattr(edges, field.name)[rows] for field in dataclasses.fields(StraightEdges))
    )


def _right_of(direction: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """To the right in the image, whose v points down: (1, 0) → (0, 1)."""
    return np.stack([-direction[..., 1], direction[..., 0]], -1)


def fit_edges(
    grey: Real[np.ndarray, "rows columns"],
    edges: StraightEdges,
    blur: Float[np.ndarray, " n"],
    curvature: float,
    settings: EdgeSettings,
    coarse: bool = False,
) -> EdgeFits:
    """Edges in a photograph.

    **Arguments:** `grey` [rows, columns]; `blur`: expected τ, which chooses the pixels;
    `curvature`: prior σ of it, 1/pixels; `coarse`: the edges are only known to a few pixels.
    """
    pixels = _Pixels.choose(grey, edges, blur, settings)
    theta = _start(pixels, blur, coarse)
    prior, expected = _pseudo_observations(edges, curvature, settings)
    noise = np.full(len(theta), 1.0)
    last_part = settings.parts - 1
    part = np.minimum(((pixels.t + 1) / 2 * settings.parts).astype(int).clip(0), last_part)
    weight = pixels.weight
    for step in range(settings.max_steps):
        model, J = _model(theta, pixels)
        r = pixels.grey - model
        # Not earlier: at the start whole edges are off, and parts contradict one another.
        if step == 3:
            weight = pixels.weight * _consistent_parts(J, r, pixels.weight, part, settings)[0]
        N, b = normal_equations(J, r, weight, prior, expected - theta, noise)
        d = np.linalg.solve(N, b[..., None])[..., 0]
        # Beyond τ the step is not linear: a, b, c by τ at most, τ by a factor of 1.5.
        limit = np.exp(theta[:, 8])[:, None]
        d[:, :3] = np.clip(d[:, :3], -limit, limit)
        d[:, 8] = np.clip(d[:, 8], -0.4, 0.4)
        theta = theta + d
        theta[:, 8] = np.clip(theta[:, 8], np.log(settings.min_blur), np.log(settings.max_blur))
        noise = noise_of_residuals(r, weight, UNKNOWNS)
        # Edges that do not exist never settle: a tenth of them may go on.
        if step > 2 and np.quantile(np.abs(d[:, 0]), 0.9) < settings.last_step:
            break
    model, J = _model(theta, pixels)
    r = pixels.grey - model
    _, excess = _consistent_parts(J, r, pixels.weight, part, settings)
    N, _ = normal_equations(J, r, weight, prior, expected - theta, noise)
    Q = np.linalg.inv(N)[:, :3, :3]
    contrast = theta[:, 5] - theta[:, 3]
    sum_of_weights = weight.sum(1)
    # An edge has twice as many pixels as unknowns, stands out of its residuals five times, and
    # keeps 60 % of its pixels.
    is_solved = (
        (sum_of_weights > 2 * UNKNOWNS)
        & (noise < 0.2 * np.abs(contrast))
        & np.isfinite(Q).all((1, 2))
    )
    is_solved &= (weight * pixels.weight).sum(1) > 0.6 * pixels.weight.sum(1)
    scale = noise * excess
    return EdgeFits(
        theta[:, :3], scale[:, None, None] ** 2 * Q, np.exp(theta[:, 8]), contrast, noise, is_solved
    )


@dataclasses.dataclass(frozen=True)
class _Pixels:
    """The pixels beside each edge [n, pixels]: s, t, grey value, weight 0 or 1; widths of the
    strips and q there."""

    s: np.ndarray
    t: np.ndarray
    grey: np.ndarray
    weight: np.ndarray
    inner: np.ndarray
    outer: np.ndarray
    level: np.ndarray

    @classmethod
    def choose(
        cls,
        grey: Real[np.ndarray, "rows columns"],
        edges: StraightEdges,
        blur: Float[np.ndarray, " n"],
        settings: EdgeSettings,
    ) -> "_Pixels":
        """Those between the adjacent edges, in the strips, and within reach of the step."""
        direction, inward, half_length = edges.along, edges.inward, edges.half
        flat = np.abs(direction[:, 0]) > np.abs(direction[:, 1])
        k = np.where(flat, 0, 1)  # the axis that runs along the edge
        row = np.arange(len(k))
        low = np.minimum(edges.start, edges.end)[row, k]
        high = np.maximum(edges.start, edges.end)[row, k]
        number = int(min(np.ceil(np.max(high - low)) + 1, settings.max_columns))
        step = np.maximum((high - low) / max(number - 1, 1), 1.0)
        major = np.rint(low[:, None] + step[:, None] * np.arange(number))
        slope = direction[row, 1 - k] / direction[row, k]
        line = edges.middle[row, 1 - k, None] + slope[:, None] * (
            major - edges.middle[row, k, None]
        )
        reach = settings.reach * blur[:, None] + 1
        rows = int(np.ceil((settings.reach * np.max(blur) + 1) * np.sqrt(1 + np.max(slope**2))))
        minor = np.rint(line)[:, :, None] + np.arange(-rows, rows + 1)
        major = np.broadcast_to(major[:, :, None], minor.shape)
        place = np.where(
            flat[:, None, None, None], np.stack([major, minor], -1), np.stack([minor, major], -1)
        ).reshape(len(k), -1, 2)
        height, width = grey.shape
        is_inside = np.all((place >= 0) & (place < [width, height]), axis=2)
        u, v = np.where(is_inside[..., None], place, 0).astype(int).transpose(2, 0, 1)
        from_middle = place - edges.middle[:, None]
        s = np.einsum("npk,nk->np", from_middle, inward)
        t = np.einsum("npk,nk->np", from_middle, direction) / half_length[:, None]
        ends = np.stack([(1 - t) / 2, (1 + t) / 2], 2)
        inner, outer = (np.einsum("npe,ne->np", ends, w) for w in (edges.inner, edges.outer))
        weight = np.asarray(is_inside & (s < np.minimum(inner, reach)))
        weight &= s > -np.minimum(outer, reach)
        for adjacent in (edges.before, edges.after):
            from_adjacent = place - adjacent[:, None, 0]
            clear = np.einsum("npk,nk->np", from_adjacent, _right_of(adjacent[:, 1]))
            weight &= clear > np.maximum(settings.clearance * blur, 0.5)[:, None]
        weight &= np.abs(t) < 1
        level = np.zeros_like(t)
        if np.any(weight & (s > inner - settings.reach * blur[:, None])):
            # The cells behind the strip, blurred along the edge.
            sharp = (half_length / blur)[:, None, None]
            share_passed = scipy.special.ndtr(sharp * (t[:, :, None] - edges.far[:, None]))
            level = np.einsum(
                "npc,nc->np", share_passed[:, :, :-1] - share_passed[:, :, 1:], edges.level
            )
        # Single precision is faster, and exact to 1e-5 pixels.
        return cls(*(x.astype(np.float32) for x in (s, t, grey[v, u], weight, inner, outer, level)))


def _start(pixels: _Pixels, blur: Float[np.ndarray, " n"], coarse: bool) -> Theta:
    """Start values: levels from both sides, and for `coarse` the line from the steepest changes."""
    theta = np.zeros((len(blur), UNKNOWNS))
    w, s, g = pixels.weight, pixels.s, pixels.grey
    theta[:, 8] = np.log(blur)
    for column, side in ((3, s < 0), (5, s > 0)):
        reach_of_side = np.where(w * side > 0, np.abs(s), 0.0)
        is_far = w * side * (reach_of_side > 0.5 * reach_of_side.max(1, keepdims=True))
        theta[:, column] = (is_far * g).sum(1) / np.maximum(is_far.sum(1), 1)
    if coarse:
        # Pixels between the levels, weighted by q·(1 − q) of their place q between them, lie about
        # the step, also from far away; a line through them, robust by 1/(1 + d²) (Cauchy) of their
        # distances d in pixels against those of other edges.
        rate = (g - theta[:, 3:4]) / np.where(
            np.abs(theta[:, 5:6] - theta[:, 3:4]) > 1, theta[:, 5:6] - theta[:, 3:4], np.inf
        )
        middle = w * (np.clip(rate, 0, 1) * (1 - np.clip(rate, 0, 1)))
        for _ in range(3):
            basis = np.stack([np.ones_like(s), pixels.t], 2)
            N = np.einsum("npi,np,npj->nij", basis, middle, basis) + 1e-6 * np.eye(2)
            b = np.einsum("npi,np,np->ni", basis, middle, s)
            line = np.linalg.solve(N, b[..., None])[..., 0]
            from_line = s - np.einsum("npi,ni->np", basis, line)
            middle = middle / (1 + (from_line / 1.0) ** 2)
        theta[:, :2] = line
    return theta


def _pseudo_observations(
    edges: StraightEdges, curvature: float, settings: EdgeSettings
) -> tuple[Theta, Theta]:
    """Weights 1/σ² and values of weak pseudo-observations, for where the pixels say nothing: c =
    curvature·half²/2 by the lens, the change of a level along the edge ±20 grey values, V ±100, τ
    that of a lens in focus to a factor of e."""
    p, expected = np.zeros((2, len(edges.start), UNKNOWNS))
    p[:, 2] = (curvature * edges.half**2 / 2) ** -2.0
    p[:, 4] = p[:, 6] = 20.0**-2
    p[:, 7] = 100.0**-2
    p[:, 8] = 1.0
    expected[:, 8] = np.log(settings.blur_in_focus)
    return p, expected


def _model(
    theta: Theta, pixels: _Pixels
) -> tuple[Float[np.ndarray, "n pixels"], Float[np.ndarray, "n pixels 9"]]:
    """Grey values of the pixels, and their derivatives [n, pixels, unknowns]."""
    a, b, c, W, W1, B, B1, V, lntau = (x[:, None] for x in theta.T.astype(np.float32))
    tau, t = np.exp(lntau), pixels.t
    s = pixels.s - (a + t * (b + t * c))
    W, B = W + W1 * t, B + B1 * t
    z, to_far_edge, to_outer_edge = s / tau, (s - pixels.inner) / tau, (s + pixels.outer) / tau
    ndtr, density = (
        scipy.special.ndtr,
        lambda z: np.exp(-z * z / 2) * np.float32((2 * np.pi) ** -0.5),
    )
    q = pixels.level
    F, f, zf = ndtr(z), density(z), 0.0
    zf = z * f
    if q.any():
        density_at_far = q * density(to_far_edge)
        F, f, zf = F - q * ndtr(to_far_edge), f - density_at_far, zf - to_far_edge * density_at_far
    beyond = ndtr(-to_outer_edge)
    of_out = density(to_outer_edge)
    step = B - W
    shift = (-step * f + V * of_out) / tau
    J = np.stack(
        [
            shift,
            t * shift,
            t * t * shift,
            1 - F,
            t * (1 - F),
            F,
            t * F,
            beyond,
            -step * zf + V * to_outer_edge * of_out,
        ],
        2,
    )
    return W + step * F + V * beyond, J


def _consistent_parts(
    J: Float[np.ndarray, "n pixels 9"],
    r: Float[np.ndarray, "n pixels"],
    weight: Float[np.ndarray, "n pixels"],
    part: Int[np.ndarray, "n pixels"],
    settings: EdgeSettings,
) -> tuple[Float[np.ndarray, "n pixels"], Float[np.ndarray, " n"]]:
    """1 for pixels of parts that agree with the edge, and by how much the parts scatter more than
    the noise says."""
    n, parts = len(r), settings.parts
    index = (part + parts * np.arange(n)[:, None]).ravel()
    add = lambda x: np.bincount(index, x.ravel(), n * parts).reshape(n, parts)
    information = add(weight * J[:, :, 0] ** 2)
    # With 2 % of the information of the best part, σ is seven times as large (1/√0.02): it says
    # nothing about the edge.
    is_known = information > 0.02 * information.max(1, keepdims=True)
    shift = add(weight * J[:, :, 0] * r) / np.where(is_known, information, np.inf)
    noise = noise_of_residuals(r, weight, UNKNOWNS)[:, None]
    z = shift * np.sqrt(information) / noise
    # The median over the known parts: unknown ones come last.
    order = np.sort(np.where(is_known, np.abs(z), np.inf), axis=1)
    middle = np.maximum(is_known.sum(1) - 1, 0) // 2
    scatter = NORMAL_SIGMA_BY_MAD * np.take_along_axis(order, middle[:, None], 1)
    good = is_known & (np.abs(z) < settings.max_part_shift * np.maximum(scatter, 1.0))
    redundancy = good.sum(1) - 3  # a, b, c
    chi2 = np.where(good, z, 0.0) ** 2
    excess = np.sqrt(chi2.sum(1) / np.maximum(redundancy, 1))
    # Not where it is within the spread of χ² itself, √(2/f), twice.
    significant = excess**2 > 1 + 2 * np.sqrt(2 / np.maximum(redundancy, 1))
    excess = np.where((redundancy > 2) & significant, excess, 1.0)
    keep = np.take_along_axis(good | ~is_known, part, 1)
    return keep.astype(float), excess
