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
from jaxtyping import Bool, Float

from jaxbundle.measure.least_squares_matching import MatchingStatus
from jaxbundle.surface.guide import SPACING, Guide
from jaxbundle.surface.refinement import refine
from jaxbundle.surface.segments import positions, windows
from jaxbundle.surface.views import OrientedImage

NODE_REACHES = 4, 2
"""Nodes on each side of the centre for the polynomial. The wide one reduces the errors of the
nodes, which are those of the matches around it, to an eighth; the narrow one is for surfaces
that the wide one does not fit."""
MOST_MISSING = 0.16
"""Maximum share of nodes that were not found."""
MOST_MISFIT = 0.12
"""Maximum RMS of the nodes relative to the polynomial, pixels of their level."""
STEP = 4.0
"""Pixels of the base for second differences of positions."""
LARGEST_SIGMA = 0.3
"""σ of a correction relative to it."""
UNKNOWN = 2.0
"""Multiple of the mean squares of the corrections added if a correction is unknown."""
LARGEST_CORRECTION = 0.5
"""Maximum correction, pixels: larger ones mean that the polynomial does not fit the surface."""
NEAR, SURE = 1.5, 0.7
"""Maximum shift of a node by least squares matching, pixels, and its minimum ρ."""
CORRELATED, NODE_SIGMA = 0.3, 0.01
"""σ of nodes without least squares matching; σ added to all nodes. Pixels."""
TINY = 1e-6
NODES_AT_ONCE = 4096


class Nodes(NamedTuple):
    """A guide, and the σ of its good nodes, pixels."""

    guide: Guide
    sigma: Float[np.ndarray, "r c"]


class Bend(NamedTuple):
    """First and second derivatives of q by u and v [n, 5] (u, v, uu, uv, vv); and which are
    known."""

    derivatives: Float[np.ndarray, "n 5"]
    known: Bool[np.ndarray, " n"]


def bend_at(nodes: Nodes, uv: Float[np.ndarray, "n 2"]) -> Bend:
    """Derivatives of the widest fitting polynomial around the nearest node."""
    guide = nodes.guide
    place = (uv - guide.first) / guide.step
    nearest = np.clip(np.rint(place[:, ::-1]).astype(int), 0, np.array(guide.q.shape) - 1)
    # many points share a node
    node = np.ravel_multi_index(tuple(nearest.T), guide.q.shape)
    nodes_used, own = np.unique(node, return_inverse=True)
    i, j = np.unravel_index(nodes_used, guide.q.shape)
    wide, narrow = (_polynomials(nodes, i, j, reach) for reach in NODE_REACHES)
    derivatives = np.where(wide.known[:, None], wide.derivatives, narrow.derivatives)[own]
    # the slopes at the point, not at the node
    du, dv = (place - nearest[:, ::-1]).T * guide.step
    derivatives[:, 0] += derivatives[:, 2] * du + derivatives[:, 3] * dv
    derivatives[:, 1] += derivatives[:, 3] * du + derivatives[:, 4] * dv
    return Bend(derivatives, (wide.known | narrow.known)[own])


def _polynomials(nodes, i, j, reach) -> Bend:
    """Derivatives at the nodes [i, j], of polynomials through `reach` nodes on each side."""
    guide, size = nodes.guide, nodes.guide.step
    k = np.arange(-reach, reach + 1)
    y, x = (a.ravel() for a in np.meshgrid(k, k, indexing="ij"))
    A = np.column_stack([np.ones_like(x), x, y, x * x / 2, x * y, y * y / 2])
    row, column = i[:, None] + y + reach, j[:, None] + x + reach
    around = lambda a, **how: np.pad(a, reach, **how)[row, column]
    there = around(guide.good)
    rate = guide.rate[i, j][:, None]
    values = (around(guide.q, mode="edge") - guide.q[i, j][:, None]) * rate
    weight = there / (around(nodes.sigma, mode="edge") ** 2 + NODE_SIGMA**2)
    N = np.einsum("nk,ka,kb->nab", weight, A, A, optimize=True) + TINY * np.eye(A.shape[1])
    p = np.linalg.solve(N, ((weight * values) @ A)[..., None])[..., 0]
    square = np.sum(weight * (values - p @ A.T) ** 2, 1)
    misfit = np.sqrt(square / np.maximum(weight.sum(1), TINY))
    known = there.mean(1) >= 1 - MOST_MISSING
    known &= misfit < MOST_MISFIT * size / SPACING
    found = p[:, 1:] / rate / np.array([size, size, size**2, size**2, size**2])
    return Bend(np.where(known[:, None], found, 0.0), known)


def sharpen(base: OrientedImage, others: Sequence[OrientedImage], guide: Guide, half: int) -> Nodes:
    """The guide with good nodes refined by least squares matching in the first of the other images
    that shows them: correlation is not accurate enough for the polynomials."""
    row, column = np.nonzero(guide.good)
    q, left = guide.q.copy(), np.ones(len(row), bool)
    sigma = np.full(q.shape, CORRELATED)
    rough = Nodes(guide, sigma.copy())
    uv = np.rint(np.stack([column, row], 1) * guide.step + guide.first)
    for other in others:
        k = np.flatnonzero(left)
        if not len(k):
            break
        here, normal = guide.q[row[k], column[k]], guide.normal[row[k], column[k]]
        # the node is between pixels if the guide ends above the finest level
        shift = uv[k] - (np.stack([column[k], row[k]], 1) * guide.step + guide.first)
        slope = bend_at(rough, uv[k]).derivatives[:, :2]
        here = here + np.sum(slope * shift, 1)
        shape = windows(base, other, base.points(uv[k], here), normal)
        ends = (
            here[:, None] * np.array([1.0, 1.0])
            + [0.0, 1e-3] / guide.rate[row[k], column[k]][:, None]
        )
        places = positions(base, other, uv[k], ends)
        start, rate = places[:, 0], (places[:, 1] - places[:, 0]) * 1e3
        match = refine(base, other, uv[k], start, shape.A, half)
        with np.errstate(invalid="ignore", divide="ignore"):
            change = np.sum((match.uv - start) * rate, 1) / np.sum(rate**2, 1)
            good = (match.status == int(MatchingStatus.CONVERGED)) & shape.usable
            good &= (np.abs(change) < NEAR) & (match.rho > SURE)
        moved = k[good]
        step = change[good] / guide.rate[row[moved], column[moved]]
        q[row[moved], column[moved]] = (here - np.sum(slope * shift, 1))[good] + step
        along = np.einsum("ni,nij,nj->n", rate[good], match.covariance[good], rate[good])
        sigma[row[moved], column[moved]] = np.sqrt(along) / np.sum(rate[good] ** 2, 1)
        left[moved] = False
    return Nodes(dataclasses.replace(guide, q=q), sigma)


def second_differences(
    base: OrientedImage,
    other: OrientedImage,
    uv: Float[np.ndarray, "n 2"],
    q: Float[np.ndarray, " n"],
    bend: Bend,
) -> Float[np.ndarray, "n 3 2"]:
    """p_uu, p_uv, p_vv: derivatives of the position in the other image by u and v of the base,
    pixels⁻¹."""
    places = {}
    for a in (-1, 0, 1):
        for b in (-1, 0, 1):
            du, dv = STEP * a, STEP * b
            terms = np.array([du, dv, du * du / 2, du * dv, dv * dv / 2])
            there = base.points(uv + [du, dv], q + bend.derivatives @ terms)
            places[a, b] = other.project(there)
    middle = places[0, 0]
    uu = places[1, 0] - 2 * middle + places[-1, 0]
    vv = places[0, 1] - 2 * middle + places[0, -1]
    mixed = (places[1, 1] - places[1, -1] - places[-1, 1] + places[-1, -1]) / 4
    return np.stack([uu, mixed, vv], 1) / STEP**2


def response(
    grey: Float[np.ndarray, "rows columns"],
    uv: Float[np.ndarray, "n 2"],
    A: Float[np.ndarray, "n 2 2"],
    second: Float[np.ndarray, "n 3 2"],
    half: int,
) -> Float[np.ndarray, "n 2"]:
    """A·c: the error of matching with windows of 2·`half` + 1 pixels; 0 if it is not
    determined."""
    out = np.zeros((len(uv), 2))
    k = np.arange(-half, half + 1, dtype=float)
    y, x = (a.ravel() for a in np.meshgrid(k, k, indexing="ij"))
    squares = np.stack([x * x / 2, x * y, y * y / 2])
    for first in range(0, len(uv), NODES_AT_ONCE):
        part = slice(first, first + NODES_AT_ONCE)
        T, gx, gy = _with_gradient(grey, np.rint(uv[part]).astype(int), half)
        one = np.ones_like(T)
        G = np.stack([gx, gy, gx * x, gx * y, gy * x, gy * y, one, T], 2)
        w = np.einsum("nij,nkj->nki", np.linalg.inv(A[part]), second[part])
        moved = np.einsum("nki,kp->nip", w, squares)
        away = gx * moved[:, 0] + gy * moved[:, 1]
        scale = 1 / np.maximum(np.linalg.norm(G, axis=1), 1e-9)
        G = G * scale[:, None]
        N = np.swapaxes(G, 1, 2) @ G + 1e-9 * np.eye(8)
        c = np.linalg.solve(N, np.einsum("npi,np->ni", G, away)[:, :, None])[:, :, 0] * scale
        found = np.einsum("nij,nj->ni", A[part], c[:, :2])
        small = np.isfinite(found).all(1) & (np.linalg.norm(found, axis=1) < LARGEST_CORRECTION)
        out[part] = np.where(small[:, None], found, 0.0)
    return out


def correct_bending(
    pair: tuple[OrientedImage, OrientedImage],
    nodes: Nodes,
    uv: Float[np.ndarray, "n 2"],
    q: Float[np.ndarray, " n"],
    match,
    half: int,
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 2"]]:
    """Matches, and their covariances, corrected for bending."""
    bend = bend_at(nodes, uv)
    base, other = pair
    second = second_differences(base, other, uv, q, bend)
    good = bend.known & np.isfinite(second).all((1, 2)) & np.isfinite(match.A).all((1, 2))
    good &= np.abs(np.linalg.det(np.where(good[:, None, None], match.A, np.eye(2)))) > 0.02
    rows = np.flatnonzero(good)
    off = np.zeros((len(uv), 2))
    off[rows] = response(base.grey, uv[rows], match.A[rows], second[rows], half)
    squares = off[:, :, None] * off[:, None]
    # without a fitting polynomial the effect of bending may be as large as elsewhere
    unknown = squares[rows].mean(0) if len(rows) else np.zeros((2, 2))
    doubt = np.where(good[:, None, None], LARGEST_SIGMA**2 * squares, UNKNOWN * unknown)
    return match.uv - off, match.covariance + doubt


def _with_gradient(grey, uv, half):
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
