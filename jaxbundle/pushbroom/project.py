"""Ground → image: the lines and pixels that see a point; all of them, or none, said by a status.

The point X is seen at the time t by the pixel u where

    r + ξ(u)·q = 0,    s + η(u)·q = 0,        [r, s, q] = Rᵀ(t)·(X − P(t)),    q < 0.

`project_points` searches the whole image: the sign of the second equation, with the pixel that the
first one gives, changes wherever the line of detectors passes over the point; from each change
Newton's method in (t, u) goes on with the polynomials of `pieces`. Two passages within one step of
the search (a piece, or 1/128 of the image) that turn back in between are not separated.

`project_near` is the textbook's way for one point that is near a known place in the image, with the
trajectory itself. By the implicit function theorem its derivatives are exact in everything.

With corrections, X gives way to the point where it seems to be (`seen_point`).
"""

from enum import IntEnum
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int

from jaxbundle.geometry.ellipsoid import WGS84, Ellipsoid, normal
from jaxbundle.geometry.vectors import Vector, difference, dot, turned_back

from .corrections import seen_point
from .image import PushbroomImage, pose_at
from .pieces import DEGREE, Pieces, make_pieces
from .scanner import slopes_of

SEARCH = 128
"""The search has about as many steps at most."""
ROUNDS, STEPS = 5, 2
"""How often the piece of a point may be chosen anew, and Newton's steps with its polynomials."""
SETTLED = 1e-3
"""A last step below this, in lines and pixels, leaves an error below its square."""
EDGE = 1e-5
"""A root so many lines beyond the end of its piece stays with it."""
STRAY = 1000
"""A point that is sought so many lines off the image is given up."""
CHUNK = 2048
"""Points that go through all steps together, so that they stay in the cache."""
NEAR_STEPS = 6


class Status(IntEnum):
    """Whether a point is in the image, and if not, where it is."""

    SEEN = 0
    BEFORE = 1
    AFTER = 2
    BESIDE = 3
    HIDDEN = 4
    NOT_CONVERGED = 5

    @property
    def meaning(self) -> str:
        """In words, for a person."""
        return _MEANING[self]


_MEANING = {
    Status.SEEN: "in the image",
    Status.BEFORE: "behind the first line",
    Status.AFTER: "ahead of the last line",
    Status.BESIDE: "beside the line of detectors",
    Status.HIDDEN: "on the other side of the Earth, or behind the camera",
    Status.NOT_CONVERGED: "no place found: the trajectory is too rough",
}


class Projected(eqx.Module):
    """Lines and pixels that see the points, in order of time; NaN where there are fewer.

    `count`: how many there are. `status`: that of the point, a `Status`.
    """

    line: Float[Array, "most n"]
    pixel: Float[Array, "most n"]
    count: Int[Array, " n"]
    status: Int[Array, " n"]


class Search(eqx.Module):
    """What the search needs of an image: its pieces, times to begin with, η of ξ about."""

    pieces: Pieces
    samples: Float[Array, " k"]
    along: Float[Array, " 6"]
    earth: Ellipsoid | None = eqx.field(static=True)


def make_search(image: PushbroomImage, earth: Ellipsoid | None = WGS84) -> Search:
    """Prepare an image for `project_points`; `earth` is None in a local frame."""
    pieces = make_pieces(image, earth)
    chosen = np.unique(np.linspace(0, len(pieces.ends) - 1, SEARCH + 1).round().astype(int))
    u = np.linspace(0, max(image.pixels - 1, 1), 257)
    xi, eta = (np.asarray(v) for v in _slopes(image.optics, u))
    along = np.polynomial.polynomial.polyfit(xi, eta, 5)
    return Search(pieces, pieces.ends[chosen], jnp.asarray(along), earth)


_slopes = jax.jit(slopes_of)


@partial(jax.jit, static_argnames="most")
def project_points(
    image: PushbroomImage,
    search: Search,
    X: Float[Array, "3 n"],
    most: int = 1,
    margin: float = 0.0,
) -> Projected:
    """The places of points in the whole image, the first `most` of each.

    **Arguments:** `search` of the same image, by `make_search`; X in metres, coordinates first;
    what is beside the image by up to `margin` lines and pixels is taken as in it.
    """
    passages = lambda X: _passages(image, search, X, most, margin)
    starts, count, ahead, behind = _in_chunks(passages, tuple(X))
    hidden = _hidden(search, X)
    edge = 0.5 + margin
    first, last = image.times.time(-edge), image.times.time(image.lines - 1 + edge)
    there = count > jnp.arange(most)[:, None]
    # one after the other, not written out: all passages share one compiled Newton's method
    t, u, settled = jax.lax.map(
        lambda k: _places(image, search, X, *k), (jnp.stack(starts), there)
    )
    inside = (t >= first) & (t < last) & (u >= -edge) & (u < image.pixels - 1 + edge)
    seen = there & settled & inside & ~hidden
    lost = jnp.any(there & ~settled, axis=0)
    order = jnp.argsort(~seen, axis=0, stable=True)
    sorted_ = lambda v: jnp.take_along_axis(jnp.where(seen, v, jnp.nan), order, 0)
    # passages beyond the first `most` were not followed: they may be beside the image
    number = seen.sum(0) + jnp.maximum(count - most, 0) * ~hidden
    status = jnp.select(
        [number > 0, hidden, lost, count > 0, ahead, behind],
        [jnp.asarray(int(s)) for s in (
            Status.SEEN, Status.HIDDEN, Status.NOT_CONVERGED, Status.BESIDE, Status.AFTER,
            Status.BEFORE,
        )], int(Status.HIDDEN),
    )  # fmt: skip
    return Projected(sorted_(image.times.line(t)), sorted_(u), number, status)


@jax.jit
def project_from(
    image: PushbroomImage, search: Search, X: Vector, line: Array, pixel: Array
) -> tuple[Array, Array]:
    """Line and pixel of points near the given places; arrays of any one shape, not searched for.

    NaN where Newton's method does not settle. What is near in the image should be near in the
    arrays, as it is in a raster: points of one piece are gone through together.
    """
    flat = [jnp.ravel(a) for a in jnp.broadcast_arrays(*X, image.times.time(line), pixel * 1.0)]
    place = lambda *args: _refine(image, search, args[:3], *args[3:])
    t, u, settled = _in_chunks(lambda args: place(*args), tuple(flat))
    shape = jnp.broadcast_shapes(*(jnp.shape(a) for a in (*X, line, pixel)))
    found = lambda a: jnp.where(settled, a, jnp.nan).reshape(shape)
    return found(image.times.line(t)), found(u)


def project_near(
    image: PushbroomImage,
    X: Float[Array, "3"],
    line: Float[Array, ""],
    pixel: Float[Array, ""],
    earth: Ellipsoid | None = WGS84,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Line and pixel of one point seen near a place; differentiable in image and point."""
    g = lambda image, X, tu: misclosure(image, X, *tu, earth)
    fixed, point = stop_gradient((image, X))

    def newton(_, state):
        tu, _ = state
        J = jax.jacfwd(g, 2)(fixed, point, tu)
        return tu - jnp.linalg.solve(J, g(fixed, point, tu)), J

    start = jnp.stack([fixed.times.time(line), pixel * 1.0]), jnp.eye(2)
    # the last step is too short to change J
    tu, J = stop_gradient(jax.lax.fori_loop(0, NEAR_STEPS, newton, start))
    t, u = tu - jnp.linalg.solve(J, g(image, X, tu))
    return image.times.line(t), u


def misclosure(
    image: PushbroomImage,
    X: Float[Array, "3"],
    t: Float[Array, ""],
    u: Float[Array, ""],
    earth: Ellipsoid | None,
) -> Float[Array, "2"]:
    """Slopes at which X is seen at the time t less those of the pixel u."""
    P, R, V = pose_at(image, t)
    X = seen_point(image.corrections, earth, tuple(P), tuple(V), tuple(X))
    r, s, q = turned_back(R, difference(X, tuple(P)))
    xi, eta = image.optics.slopes(u)
    return jnp.stack([-r / q - xi, -s / q - eta])


def _in_chunks(function, arrays):
    """The function of arrays [n] by chunks."""
    n = arrays[0].shape[0]
    if n <= CHUNK:
        return function(arrays)
    chunks = -(-n // CHUNK)
    cut = lambda a: jnp.pad(a, (0, chunks * CHUNK - n), mode="edge").reshape(chunks, CHUNK)
    found = jax.lax.map(function, tuple(cut(a) for a in arrays))
    return jax.tree.map(lambda a: a.reshape(-1)[:n], found)


def _hidden(search, X):
    """Whether the Earth is between the points and the camera at the middle of the image."""
    if search.earth is None:
        return jnp.zeros(X.shape[1], bool)
    _, (P, _) = _sample(search.pieces, search.samples[len(search.samples) // 2])
    return dot(normal(search.earth, tuple(X)), difference(P, tuple(X))) <= 0


def _places(image, search, X, start, there):
    """(t, u, settled) from start times, in the order of time so that neighbours share a piece."""

    def place(start):
        order = jnp.argsort(start)
        refine = lambda args: _refine(image, search, args[:3], args[3], args[4])
        u = jnp.zeros_like(start) + (image.pixels - 1) / 2
        found = _in_chunks(refine, (*X[:, order], start[order], u))
        return tuple(jnp.zeros_like(a).at[order].set(a) for a in found)

    nothing = lambda start: (start, start, start != start)
    return jax.lax.cond(jnp.any(there), place, nothing, start)


def _passages(image, search, X, most, margin):
    """When the line of detectors passes over the points, about, and how often; before or after?

    The search begins and ends a line outside the image, so that its edges are within.
    """
    step = (1 + margin) * (image.times.time(1.0) - image.times.time(0.0))
    samples = search.samples.at[0].add(-step).at[-1].add(step)
    numbers, motions = jax.vmap(partial(_sample, search.pieces))(samples)

    def forward(numbers, motion):
        """The slope at which a point is ahead of the line of detectors; NaN behind the camera."""
        D = _sights(image, search, X, motion)
        r, s, q = (_combined(numbers, D, i) for i in range(3))
        front = q < 0
        q = jnp.where(front, q, -1.0)
        return jnp.where(front, -s / q - _polynomial(search.along, -r / q), jnp.nan)

    def step_to(state, sample):
        before, t_before, count, starts, first = state
        k, t, *place = sample
        value = forward(*place)
        passed = (before >= 0) != (value >= 0)
        passed &= ~(jnp.isnan(before) | jnp.isnan(value))
        crossing = t_before + (t - t_before) * before / jnp.where(passed, before - value, 1.0)
        starts = tuple(
            jnp.where(passed & (count == i), crossing, start) for i, start in enumerate(starts)
        )
        return (value, t, count + passed, starts, jnp.where(k == 0, value, first)), None

    zero = jnp.zeros_like(X[0])
    nowhere = zero * jnp.nan
    state = (nowhere, samples[0], zero.astype(int), (zero,) * most, nowhere)
    unroll = 1 if image.corrections.any else 4
    (final, _, count, starts, first), _ = jax.lax.scan(
        step_to, state, (jnp.arange(len(samples)), samples, numbers, motions), unroll=unroll
    )
    return starts, count, final > 0, first < 0


def _refine(image, search, X, t, u):
    """Newton's method in (t, u): the place, and whether it settled.

    The points of one piece share its polynomials, so the pieces are gone through one by one: few if
    the points are near each other. It is done when no point leaves its piece; one that strays far
    from the image is given up.
    """
    ends = search.pieces.ends
    far = STRAY * (image.times.time(1.0) - image.times.time(0.0))

    def open_(t, settled):
        return ~settled & (t >= ends[0] - far) & (t <= ends[-1] + far)

    def again(state):
        t, _, settled, rounds = state
        return (rounds < ROUNDS) & jnp.any(open_(t, settled))

    def refine(state):
        t, _, settled, rounds = state
        own = jnp.searchsorted(ends[1:-1], t, side="right")
        own = jnp.where(open_(t, settled), own, -1)
        first = jnp.min(jnp.where(own < 0, len(ends), own))
        newton = partial(_newton, image, search, X, own)
        return *jax.lax.fori_loop(first, own.max() + 1, newton, state[:3]), rounds + 1

    t, u, settled, _ = jax.lax.while_loop(again, refine, (t, u, jnp.zeros(t.shape, bool), 0))
    return t, u, settled


def _newton(image, search, X, own, k, state):
    """Steps for the points of the piece k; the others stay where they are."""
    t, u, settled = state
    pieces = search.pieces
    start, end, c = pieces.ends[k], pieces.ends[k + 1], pieces.coefficients[k]
    middle, half = (start + end) / 2, (end - start) / 2
    tau = first = (t - middle) / half
    v = u
    motion = _motion(c, tau, half, pieces.origin) if image.corrections.any else None
    D = _sights(image, search, X, motion)
    rsq = [[_combined(c[p], D, i) for p in range(DEGREE + 1)] for i in range(3)]
    (r, dr), (s, ds), (q, dq) = (_value_and_rate(p, tau) for p in rsq)
    (xi, eta), (dxi, deta) = jax.jvp(image.optics.slopes, (v,), (jnp.ones_like(v),))
    ft, gt, fu, gu = dr + xi * dq, ds + eta * dq, dxi * q, deta * q
    inverse = 1 / (ft * gu - fu * gt)
    for step in range(STEPS):
        if step:  # with the derivatives of the first one
            r, s, q = (_value(p, tau) for p in rsq)
            xi, eta = image.optics.slopes(v)
        f, g = r + xi * q, s + eta * q
        dtau, dv = inverse * (gu * f - fu * g), inverse * (ft * g - gt * f)
        tau, v = tau - dtau, v - dv
    # a sight with corrections belongs to the time at which the round began
    moved = tau - first if image.corrections.any else dtau
    line = (image.times.time(1.0) - image.times.time(0.0)) / half
    short = (jnp.abs(moved) < SETTLED * line) & (jnp.abs(dv) < SETTLED) & (q < 0)
    last = len(pieces.coefficients) - 1
    # a root at the very end of a piece would go to and fro
    ends = 1 + EDGE * line
    stays = ((tau >= -ends) | (k == 0)) & ((tau <= ends) | (k == last))
    chosen = own == k
    new = middle + tau * half, v, short & stays
    return tuple(jnp.where(chosen, a, b) for a, b in zip(new, state))


def _sample(pieces, t):
    """The twelve numbers at a time, and (P, V)."""
    k = jnp.searchsorted(pieces.ends[1:-1], t, side="right")
    start, end, c = pieces.ends[k], pieces.ends[k + 1], pieces.coefficients[k]
    half = (end - start) / 2
    tau = (t - start) / half - 1
    return _value_and_rate(c, tau)[0], _motion(c, tau, half, pieces.origin)


def _sights(image, search, X, motion):
    """Where the points are seen by a camera of this motion, from the origin of the pieces."""
    if image.corrections.any:
        X = seen_point(image.corrections, search.earth, *motion, X)
    return difference(X, tuple(search.pieces.origin))


def _motion(coefficients, tau, half, origin):
    """P = O − Mᵀ·m at τ, and its rate."""

    def position(tau):
        n = [_value_and_rate(c, tau)[0] for c in coefficients.T]
        return tuple(origin[k] - sum(n[3 * i + k] * n[9 + i] for i in range(3)) for k in range(3))

    P, V = jax.jvp(position, (tau,), (jnp.ones_like(tau),))
    return P, tuple(v / half for v in V)


def _combined(numbers, D, i):
    """Component i of M·D + m."""
    return (
        numbers[3 * i] * D[0] + numbers[3 * i + 1] * D[1] + numbers[3 * i + 2] * D[2]
        + numbers[9 + i]
    )  # fmt: skip


def _value(coefficients, tau):
    """A polynomial (Horner)."""
    value = coefficients[-1]
    for c in coefficients[-2::-1]:
        value = value * tau + c
    return value


def _value_and_rate(coefficients, tau):
    """A polynomial and its derivative (Horner)."""
    value, rate = coefficients[-1], jnp.zeros_like(tau)
    for c in coefficients[-2::-1]:
        value, rate = value * tau + c, rate * tau + value
    return value, rate


def _polynomial(coefficients, x):
    value = coefficients[-1] + 0 * x
    for c in coefficients[-2::-1]:
        value = value * x + c
    return value
