"""The footprint of an image in which each point is seen once, with approximate positions as start
values.

The footprint is the area seen between two heights. Time and pixel over it are fitted by
cubic polynomials of normalised coordinates. Newton's method starts from there; if it converges in
the image, at a point between the heights, that position is unique, because `make_footprint` has
verified that the detector line passes over every point of the footprint in the same sense: F
of `passages` is continuous in time, since no point is ever beside or behind the camera, and

    ∂F/∂t ≠ 0 wherever F = 0,    so that a second zero would need one of the other sign between.

∂F/∂t of points seen by a detector is the speed of its footprint over the ground. It is tested four
times in each piece, for all slopes ξ of points of the footprint in the whole image. An image that
turns back, rotates, or is too rough for the polynomials has no footprint: all its points are
searched for.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.geometry.ellipsoid import Ellipsoid, at_height, residual
from jaxbundle.geometry.vectors import along, difference
from jaxbundle.pushbroom.newton import motion
from jaxbundle.pushbroom.passages import ahead, slopes
from jaxbundle.pushbroom.pieces import CHUNK, Pieces
from jaxbundle.pushbroom.polynomial import value, value_and_rate
from jaxbundle.pushbroom.surfaces import Ground, Plane
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray

HEIGHTS = -1000.0, 10_000.0
"""Lowest and highest height, metres, if the camera is more than twice as high."""
TIMES, ACROSS, LEVELS = 17, 9, 4
"""Times, pixels and heights of the lattice through which the polynomials are fitted."""
TESTED_POSITIONS = np.array([-1.0, -1 / 3, 1 / 3, 1.0])
"""Positions in each piece where the speed is tested."""
SMALLEST_SPEED = 0.1
"""Smallest speed relative to the largest; smallest cosine between a sight and the axis."""
SLOPE_MARGIN = 1.2
"""Slopes are tested this factor beyond those of the lattice points."""
LARGEST_ERROR = 50.0
"""Allowed error of the polynomials, in lines and pixels."""
POWERS = np.array([(i, j, k) for i in range(4) for j in range(4 - i) for k in range(4 - i - j)])


class Footprint(eqx.Module):
    """Heights in metres; (t, u) as polynomials of A·D, D the sight from the origin of the pieces.

    `frame`: A and the point −A·D₀ that makes the middle of the footprint zero.
    """

    heights: Float[AnyArray, "2"]
    frame: Float[AnyArray, "3 4"]
    coefficients: Float[AnyArray, "2 20"]

    def start(self, D):
        """Time and pixel, about, of sights D."""
        x, y, z = (row[0] * D[0] + row[1] * D[1] + row[2] * D[2] + row[3] for row in self.frame)
        return _cubic(self.coefficients[0], x, y, z), _cubic(self.coefficients[1], x, y, z)

    def level(self, earth, X):
        """Whether points are between the heights."""
        low, high = self.heights
        if earth is None:
            return (X[2] >= low) & (X[2] <= high)
        return (residual(at_height(earth, low), X) >= 0) & (
            residual(at_height(earth, high), X) <= 0
        )


def make_footprint(
    image,
    pieces: Pieces,
    samples: Float[AnyArray, " k"],
    line: Float[AnyArray, " 6"],
    earth: Ellipsoid | None,
) -> Footprint | None:
    """The footprint, or None if it is not certain that every point is seen once."""
    heights = _heights(image, earth)
    if heights is None:
        return None
    times = np.linspace(float(pieces.ends[0]), float(pieces.ends[-1]), TIMES)
    u = np.linspace(-0.5, image.pixels - 0.5, ACROSS)
    xi, eta = (np.asarray(v) for v in slopes(image.optics, u))
    k, tau = _places(pieces, times)
    levels = np.linspace(heights[0], heights[1], LEVELS)
    D, _ = _speeds_at(pieces, k, tau, xi, eta, levels, line, earth)
    if not np.isfinite(D).all():
        return None
    footprint, errors = _fit(D, times, u, heights)
    period = float(image.times.time(1.0) - image.times.time(0.0))
    if not (errors <= LARGEST_ERROR * np.array([period, 1.0])).all():
        return None
    reach = _reach(pieces, np.asarray(samples), D.reshape(-1, 3))
    if reach is None:
        return None
    xi = np.linspace(*reach, ACROSS)
    eta = np.polynomial.polynomial.polyval(xi, np.asarray(line))
    k, within = np.indices((len(pieces.ends) - 1, len(TESTED_POSITIONS))).reshape(2, -1)
    _, speed = _speeds_at(pieces, k, TESTED_POSITIONS[within], xi, eta, levels, line, earth)
    speed = speed[np.isfinite(speed)]  # a ray that misses sees no point
    same = speed.min() * speed.max() > 0
    moving = np.abs(speed).min() > SMALLEST_SPEED * np.abs(speed).max()
    return footprint if same and moving else None


def _heights(image, earth):
    """The height range of points; None if the camera is not above the ground."""
    P = np.asarray(image.trajectory.position.values)
    if earth is None:
        above = P[:, 2].min()
    else:
        above = (np.sqrt(1 + np.asarray(residual(earth, tuple(P.T)))).min() - 1) * earth.c
    return np.clip(HEIGHTS, -above / 2, above / 2) if above > 0 else None


def _places(pieces, times):
    """Pieces of times, and τ in them."""
    ends = np.asarray(pieces.ends)
    k = np.clip(np.searchsorted(ends, times, side="right") - 1, 0, len(ends) - 2)
    return k, 2 * (times - ends[k]) / (ends[k + 1] - ends[k]) - 1


def _speeds_at(pieces, k, tau, xi, eta, heights, line, earth):
    """Sights D [times, slopes, heights, 3] and ∂F/∂t [times, slopes, heights] at many times."""
    ends = np.asarray(pieces.ends)
    half = (ends[k + 1] - ends[k]) / 2
    c = np.asarray(pieces.coefficients)[k]
    pad = lambda a: np.pad(a, [(0, -len(k) % CHUNK)] + [(0, 0)] * (a.ndim - 1), mode="edge")
    parts = [
        _speeds(*part, pieces.origin, xi, eta, heights, line, earth)
        for part in zip(*(pad(a).reshape(-1, CHUNK, *a.shape[1:]) for a in (c, tau, half)))
    ]
    D, speed = (np.concatenate([np.asarray(v) for v in values])[: len(k)] for values in zip(*parts))
    return D, speed


@partial(compile_once, static=())
def _speeds(c, tau, half, origin, xi, eta, heights, line, earth):
    def at(c, tau, half, xi, eta, h):
        numbers, rates = value_and_rate(c, tau)
        P, _ = motion(numbers, rates, origin)
        d = tuple(numbers[k] * xi + numbers[3 + k] * eta - numbers[6 + k] for k in range(3))
        surface = Plane(level=h) if earth is None else Ground(at_height(earth, h))
        D = difference(along(P, d, surface.distance(P, d)), origin)
        speed = jax.jvp(lambda n: ahead(n, D, line)[0], (numbers,), (rates / half,))[1]
        return jnp.stack(D), speed

    over_heights = jax.vmap(at, (None, None, None, None, None, 0))
    over_slopes = jax.vmap(over_heights, (None, None, None, 0, 0, None))
    return jax.vmap(over_slopes, (0, 0, 0, None, None, None))(c, tau, half, xi, eta, heights)


def _fit(D, times, u, heights):
    """The footprint through a lattice, and the largest errors of t and u there."""
    points = D.reshape(-1, 3)
    middle = points.mean(0)
    axes = np.linalg.svd(points - middle, full_matrices=False)[2]
    A = axes / np.abs((points - middle) @ axes.T).max(0)[:, None]
    x = (points - middle) @ A.T
    terms = np.prod(x[:, None, :] ** POWERS, axis=2)
    shape = D.shape[:3]
    tu = np.stack(
        [np.broadcast_to(times[:, None, None], shape), np.broadcast_to(u[None, :, None], shape)], -1
    ).reshape(-1, 2)
    coefficients = np.linalg.lstsq(terms, tu, rcond=None)[0]
    errors = np.abs(terms @ coefficients - tu).max(0)
    frame = np.c_[A, -A @ middle]
    return Footprint(jnp.asarray(heights), jnp.asarray(frame), jnp.asarray(coefficients.T)), errors


def _reach(pieces, samples, D):
    """Smallest and largest ξ of the points in the image, with a margin; None if out of sight."""
    k, tau = _places(pieces, samples)
    c = np.asarray(pieces.coefficients)[k]
    numbers = np.einsum("kpn,pk->kn", c, tau ** np.arange(c.shape[1])[:, None])
    rsq = np.einsum("kij,nj->kni", numbers[:, :9].reshape(-1, 3, 3), D) + numbers[:, None, 9:]
    if (-rsq[..., 2] < SMALLEST_SPEED * np.linalg.norm(rsq, axis=2)).any():
        return None
    xi = -rsq[..., 0] / rsq[..., 2]
    middle, half = (xi.max() + xi.min()) / 2, (xi.max() - xi.min()) / 2
    return middle - SLOPE_MARGIN * half, middle + SLOPE_MARGIN * half


def _cubic(c, x, y, z):
    """The cubic polynomial with coefficients in the order of `POWERS`, Horner in all three."""
    c = iter(c)
    rows = [[value([next(c) for _ in range(4 - i - j)], z) for j in range(4 - i)] for i in range(4)]
    return value([value(row, y) for row in rows], x)
