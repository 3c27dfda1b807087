"""Correction of least squares matching if the surface is not a plane within the window.

A point d of the window has its match at

    p(d) = p₀ + A·d + ½·Σ p_ij·dᵢ·dⱼ,

due to perspective, distortion, and the curvature of the surface, taken from the nodes of the guide:
q around each is a polynomial of second degree. An affine matching of windows finds the p₀ + A·c of

    gᵀ·(B·d + c) + h₀ + h₁·T ≈ gᵀ·A⁻¹·½·Σ p_ij·dᵢ·dⱼ

in the least squares sense, g the gradient of the grey values T. So A·c is subtracted.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.measure.least_squares_matching import MatchingStatus
from jaxbundle.surfaces.guide import Guide
from jaxbundle.surfaces.segments import positions, windows
from jaxbundle.surfaces.subpixel_matching import SubpixelMatches, WindowSettings, refine
from jaxbundle.surfaces.views import Grey, OrientedImage

# Windows whose normal equations are formed together: 170 pixels and 8 unknowns each, 45 MB.
MATRICES_AT_ONCE = 4096


@dataclasses.dataclass(frozen=True)
class BendingSettings:
    """The correction of matches for the curvature of the surface.

    Figures "half …, double …" are of `benchmarks/surface_settings.py` (scene "no texture", every
    fifth pixel): 2251 points, RMS of errors over σ 0.999, robust 0.964.
    """

    wide_reach: int = 4
    """Nodes on each side of the centre for a polynomial: the wide one reduces the errors of the
    nodes, which are those of the matches around it, to an eighth."""
    narrow_reach: int = 2
    """Those of the polynomial for surfaces that the wide one does not fit: 25 nodes for 6
    coefficients."""
    max_missing: float = 0.16
    """Maximum share of nodes that were not found: 4 of 25, a corner of their square. Half: RMS
    1.01, robust 0.986; double: 1.005."""
    max_misfit: float = 0.03
    """Maximum RMS of the nodes relative to the polynomial, in distances of nodes (0.12 pixel of
    their level). Half: no difference; double: 0.986."""
    difference_step: float = 4.0
    """Pixels of the base for second differences of positions: smaller ones lose digits, larger ones
    leave the window. Half and double: no difference."""
    relative_sigma: float = 0.3
    """σ of a correction relative to it. Half: RMS 1.002; double: 0.992."""
    unknown_factor: float = 2.0
    """Multiple of the mean squares of the corrections that is added to the variance where none is
    known: such places are more bent than others. Half: RMS 1.003; double: 0.994."""
    max_correction: float = 0.5
    """Maximum correction, pixels: larger ones mean that the polynomial does not fit the surface.
    Half: RMS 1.001; double: no difference."""
    max_node_shift: float = 1.5
    """Maximum shift of a node by least squares matching, pixels. Half and double: no difference."""
    min_node_correlation: float = 0.7
    """Minimum ρ of that. 0.35 and 0.95: no difference."""
    unmatched_sigma: float = 0.3
    """σ of nodes without least squares matching, pixels: about the 1/√12 of correlation in whole
    pixels. Half: RMS 1.013; double: 0.978."""
    node_sigma: float = 0.01
    """σ added to all nodes, pixels: interpolation. Half: RMS 0.989; double: 1.004."""


class GuideNodes(NamedTuple):
    """A guide, and the σ of its good nodes, pixels."""

    guide: Guide
    sigma: Float[np.ndarray, "r c"]


class Bend(NamedTuple):
    """First and second derivatives of q by u and v [n, 5] (u, v, uu, uv, vv); and which are
    reliable."""

    derivatives: Float[np.ndarray, "n 5"]
    reliable: Bool[np.ndarray, " n"]


def bend_at(nodes: GuideNodes, uv: Float[np.ndarray, "n 2"], settings: BendingSettings) -> Bend:
    """Derivatives of the widest fitting polynomial around the nearest node."""
    guide = nodes.guide
    place = (uv - guide.first) / guide.step
    nearest = np.clip(np.rint(place[:, ::-1]).astype(int), 0, np.array(guide.q.shape) - 1)
    # Many points share a node.
    node = np.ravel_multi_index(tuple(nearest.T), guide.q.shape)
    nodes_used, node_of_point = np.unique(node, return_inverse=True)
    i, j = np.unravel_index(nodes_used, guide.q.shape)
    reaches = settings.wide_reach, settings.narrow_reach
    wide, narrow = (_fit_polynomials(nodes, i, j, reach, settings) for reach in reaches)
    derivatives = np.where(wide.reliable[:, None], wide.derivatives, narrow.derivatives)
    derivatives = derivatives[node_of_point]
    # The slopes at the point, not at the node.
    du, dv = (place - nearest[:, ::-1]).T * guide.step
    derivatives[:, 0] += derivatives[:, 2] * du + derivatives[:, 3] * dv
    derivatives[:, 1] += derivatives[:, 3] * du + derivatives[:, 4] * dv
    return Bend(derivatives, (wide.reliable | narrow.reliable)[node_of_point])


def _fit_polynomials(
    nodes: GuideNodes,
    i: Int[np.ndarray, " k"],
    j: Int[np.ndarray, " k"],
    reach: int,
    settings: BendingSettings,
) -> Bend:
    """Derivatives at the nodes [i, j], of polynomials through `reach` nodes on each side."""
    guide, size = nodes.guide, nodes.guide.step
    k = np.arange(-reach, reach + 1)
    y, x = (a.ravel() for a in np.meshgrid(k, k, indexing="ij"))
    A = np.column_stack([np.ones_like(x), x, y, x * x / 2, x * y, y * y / 2])
    row, column = i[:, None] + y + reach, j[:, None] + x + reach
    around = lambda a, **how: np.pad(a, reach, **how)[row, column]
    is_good = around(guide.good)
    rate = guide.rate[i, j][:, None]
    values = (around(guide.q, mode="edge") - guide.q[i, j][:, None]) * rate
    weight = is_good / (around(nodes.sigma, mode="edge") ** 2 + settings.node_sigma**2)
    N = np.einsum("nk,ka,kb->nab", weight, A, A, optimize=True)
    # Against a singular N without nodes; of the weights, 10 and more, it is nothing.
    tiny = 1e-6
    N = N + tiny * np.eye(A.shape[1])
    p = np.linalg.solve(N, ((weight * values) @ A)[..., None])[..., 0]
    square = np.sum(weight * (values - p @ A.T) ** 2, 1)
    misfit = np.sqrt(square / np.maximum(weight.sum(1), tiny))
    is_known = is_good.mean(1) >= 1 - settings.max_missing
    is_known &= misfit < settings.max_misfit * size
    derivatives = p[:, 1:] / rate / np.array([size, size, size**2, size**2, size**2])
    return Bend(np.where(is_known[:, None], derivatives, 0.0), is_known)


def sharpen(
    base: OrientedImage,
    others: Sequence[OrientedImage],
    guide: Guide,
    half: int,
    settings: BendingSettings,
    window_settings: WindowSettings,
) -> GuideNodes:
    """The guide with good nodes refined by least squares matching in the first of the other images
    that shows them: correlation is not accurate enough for the polynomials."""
    row, column, node_uv = guide.good_nodes()
    q, is_remaining = guide.q.copy(), np.ones(len(row), bool)
    sigma = np.full(q.shape, settings.unmatched_sigma)
    rough = GuideNodes(guide, sigma.copy())
    uv = np.rint(node_uv)
    for other in others:
        k = np.flatnonzero(is_remaining)
        if not len(k):
            break
        q_at_node, normal = guide.q[row[k], column[k]], guide.normal[row[k], column[k]]
        # The node is between pixels if the guide ends above the finest level.
        shift = uv[k] - node_uv[k]
        slope = bend_at(rough, uv[k], settings).derivatives[:, :2]
        q_at_node = q_at_node + np.sum(slope * shift, 1)
        window = windows(base, other, base.points(uv[k], q_at_node), normal)
        # Pixels of this image per pixel of the guide's rate, by a step of a thousandth.
        ends = q_at_node[:, None] + [0.0, 1e-3] / guide.rate[row[k], column[k]][:, None]
        places = positions(base, other, uv[k], ends)
        start, rate = places[:, 0], (places[:, 1] - places[:, 0]) * 1e3
        match = refine(base, other, uv[k], start, window.A, half, window_settings)
        with np.errstate(invalid="ignore", divide="ignore"):
            change = np.sum((match.uv - start) * rate, 1) / np.sum(rate**2, 1)
            good = (match.status == int(MatchingStatus.CONVERGED)) & window.usable
            good &= np.abs(change) < settings.max_node_shift
            good &= match.rho > settings.min_node_correlation
        refined_rows = k[good]
        step = change[good] / guide.rate[row[refined_rows], column[refined_rows]]
        q[row[refined_rows], column[refined_rows]] = (q_at_node - np.sum(slope * shift, 1))[
            good
        ] + step
        variance_along = np.einsum("ni,nij,nj->n", rate[good], match.covariance[good], rate[good])
        sigma[row[refined_rows], column[refined_rows]] = np.sqrt(variance_along) / np.sum(
            rate[good] ** 2, 1
        )
        is_remaining[refined_rows] = False
    return GuideNodes(dataclasses.replace(guide, q=q), sigma)


def second_differences(
    base: OrientedImage,
    other: OrientedImage,
    uv: Float[np.ndarray, "n 2"],
    q: Float[np.ndarray, " n"],
    bend: Bend,
    step: float,
) -> Float[np.ndarray, "n 3 2"]:
    """p_uu, p_uv, p_vv: derivatives of the position in the other image by u and v of the base,
    pixels⁻¹, by differences over `step` pixels."""
    places = {}
    for a in (-1, 0, 1):
        for b in (-1, 0, 1):
            du, dv = step * a, step * b
            terms = np.array([du, dv, du * du / 2, du * dv, dv * dv / 2])
            displaced = base.points(uv + [du, dv], q + bend.derivatives @ terms)
            places[a, b] = other.project(displaced)
    middle = places[0, 0]
    uu = places[1, 0] - 2 * middle + places[-1, 0]
    vv = places[0, 1] - 2 * middle + places[0, -1]
    mixed = (places[1, 1] - places[1, -1] - places[-1, 1] + places[-1, -1]) / 4
    return np.stack([uu, mixed, vv], 1) / step**2


def response(
    grey: Float[np.ndarray, "rows columns"],
    uv: Float[np.ndarray, "n 2"],
    A: Float[np.ndarray, "n 2 2"],
    second_derivatives: Float[np.ndarray, "n 3 2"],
    half: int,
    max_correction: float,
) -> Float[np.ndarray, "n 2"]:
    """A·c: the error of matching with windows of 2·`half` + 1 pixels; NaN if it is not
    determined, or larger than the maximum."""
    out = np.zeros((len(uv), 2))
    k = np.arange(-half, half + 1, dtype=float)
    y, x = (a.ravel() for a in np.meshgrid(k, k, indexing="ij"))
    squares = np.stack([x * x / 2, x * y, y * y / 2])
    for begin in range(0, len(uv), MATRICES_AT_ONCE):
        part = slice(begin, begin + MATRICES_AT_ONCE)
        T, gx, gy = _cut_out_with_gradient(grey, np.rint(uv[part]).astype(int), half)
        # The unknowns: c, the four elements of B, brightness, contrast.
        G = np.stack([gx, gy, gx * x, gx * y, gy * x, gy * y, np.ones_like(T), T], 2)
        w = np.einsum("nij,nkj->nki", np.linalg.inv(A[part]), second_derivatives[part])
        displacement = np.einsum("nki,kp->nip", w, squares)
        change_of_grey = gx * displacement[:, 0] + gy * displacement[:, 1]
        # Columns of length 1: gradients and grey values have different units.
        scale = 1 / np.maximum(np.linalg.norm(G, axis=1), 1e-9)
        G = G * scale[:, None]
        # 1e-9 of the unit diagonal: without texture N is singular, and `solve` would raise
        N = np.swapaxes(G, 1, 2) @ G + 1e-9 * np.eye(8)
        c = (
            np.linalg.solve(N, np.einsum("npi,np->ni", G, change_of_grey)[:, :, None])[:, :, 0]
            * scale
        )
        correction = np.einsum("nij,nj->ni", A[part], c[:, :2])
        is_small = np.isfinite(correction).all(1) & (
            np.linalg.norm(correction, axis=1) < max_correction
        )
        out[part] = np.where(is_small[:, None], correction, np.nan)
    return out


def correct_bending(
    pair: tuple[OrientedImage, OrientedImage],
    nodes: GuideNodes,
    uv: Float[np.ndarray, "n 2"],
    q: Float[np.ndarray, " n"],
    match: SubpixelMatches,
    half: int,
    settings: BendingSettings,
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 2"]]:
    """Matches, and their covariances, corrected for bending."""
    bend = bend_at(nodes, uv, settings)
    base, other = pair
    second_derivatives = second_differences(base, other, uv, q, bend, settings.difference_step)
    good = (
        bend.reliable
        & np.isfinite(second_derivatives).all((1, 2))
        & np.isfinite(match.A).all((1, 2))
    )
    # An area in the other image of a fiftieth: a window seen from its side, or a failed match.
    good &= np.abs(np.linalg.det(np.where(good[:, None, None], match.A, np.eye(2)))) > 0.02
    rows = np.flatnonzero(good)
    correction = np.full((len(uv), 2), np.nan)
    correction[rows] = response(
        base.grey, uv[rows], match.A[rows], second_derivatives[rows], half, settings.max_correction
    )
    is_corrected = np.isfinite(correction[:, 0])  # both components or none
    applied = np.where(is_corrected[:, None], correction, 0.0)
    squares = applied[:, :, None] * applied[:, None]
    # Without a fitting polynomial the effect of bending may be as large as elsewhere.
    unknown = squares[is_corrected].mean(0) if is_corrected.any() else np.zeros((2, 2))
    doubt = np.where(
        is_corrected[:, None, None],
        settings.relative_sigma**2 * squares,
        settings.unknown_factor * unknown,
    )
    return match.uv - applied, match.covariance + doubt


def _cut_out_with_gradient(
    grey: Grey, uv: Int[np.ndarray, "n 2"], half: int
) -> tuple[Float[np.ndarray, "n pixels"], ...]:
    """Windows, and their gradients by central differences, [n, pixels]."""
    k = np.arange(-half - 1, half + 2)
    rows, columns = grey.shape
    r = np.clip(uv[:, 1, None] + k, 0, rows - 1)
    c = np.clip(uv[:, 0, None] + k, 0, columns - 1)
    a = np.asarray(grey[r[:, :, None], c[:, None]], float)
    n = len(uv)
    gx = (a[:, 1:-1, 2:] - a[:, 1:-1, :-2]) / 2
    gy = (a[:, 2:, 1:-1] - a[:, :-2, 1:-1]) / 2
    T = a[:, 1:-1, 1:-1].reshape(n, -1)
    return T - T.mean(1, keepdims=True), gx.reshape(n, -1), gy.reshape(n, -1)
