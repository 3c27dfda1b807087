"""The footprint of an image in which each point is seen once, with approximate positions as start
values.

The footprint is the area seen between two heights. Time and pixel over it are fitted by
cubic polynomials of normalised coordinates. Newton's method starts from there; if it converges in
the image, at a point between the heights, that position is unique, because `make_footprint` has
verified that the detector line passes over every point of the footprint in the same sense: F
of `detector_line` is continuous in time, since no point is ever beside or behind the camera, and

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
from jaxtyping import Array, Bool, Float, Int

from jaxbundle.geometry.ellipsoid import Ellipsoid, at_height, residual
from jaxbundle.geometry.principal_axes import principal_axes
from jaxbundle.geometry.vectors import Vector, difference, point_on_ray, unpack
from jaxbundle.pushbroom.detector_line import slope_ahead, slopes
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.pieces import Pieces, motion
from jaxbundle.pushbroom.polynomial import value, value_and_rate
from jaxbundle.pushbroom.search_settings import DEFAULTS, SearchSettings
from jaxbundle.pushbroom.surfaces import Ground, Plane
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar

# Positions in each piece where the speed is tested: its ends and thirds. Between them
# `min_relative_speed` is the margin.
TESTED_POSITIONS = np.array([-1.0, -1 / 3, 1 / 3, 1.0])
POWERS = np.array([(i, j, k) for i in range(4) for j in range(4 - i) for k in range(4 - i - j)])


class Footprint(eqx.Module):
    """Heights in metres; (t, u) as polynomials of A·D, D the sight from the origin of the pieces.

    `frame`: A and the point −A·D₀ that makes the middle of the footprint zero.
    """

    heights: Float[AnyArray, "2"]
    frame: Float[AnyArray, "3 4"]
    coefficients: Float[AnyArray, "2 20"]

    def start(self, D: Vector) -> tuple[AnyArray, AnyArray]:
        """Time and pixel, about, of sights D."""
        x, y, z = (row[0] * D[0] + row[1] * D[1] + row[2] * D[2] + row[3] for row in self.frame)
        return _cubic(self.coefficients[0], x, y, z), _cubic(self.coefficients[1], x, y, z)

    def contains_height(self, earth: Ellipsoid | None, X: Vector) -> bool | Bool[AnyArray, "..."]:
        """Whether points are between the heights."""
        low, high = self.heights
        if earth is None:
            return (X[2] >= low) & (X[2] <= high)
        return (residual(at_height(earth, low), X) >= 0) & (
            residual(at_height(earth, high), X) <= 0
        )


def make_footprint(
    image: PushbroomImage,
    pieces: Pieces,
    samples: Float[AnyArray, " k"],
    line: Float[AnyArray, " 6"],
    earth: Ellipsoid | None,
    settings: SearchSettings = DEFAULTS,
) -> Footprint | None:
    """The footprint, or None if it is not certain that every point is seen once."""
    heights = _heights(image, earth, settings.footprint_heights)
    if heights is None:
        return None
    rows, columns, layers = settings.footprint_lattice
    times = np.linspace(float(pieces.ends[0]), float(pieces.ends[-1]), rows)
    u = np.linspace(-0.5, image.pixels - 0.5, columns)
    xi, eta = (np.asarray(v) for v in slopes(image.optics, u))
    k, tau = _pieces_of_times(pieces, times)
    levels = np.linspace(heights[0], heights[1], layers)
    speeds = partial(_speeds_at, pieces, levels, line, earth, settings.times_at_once)
    D, _ = speeds(k, tau, xi, eta)
    # A sight that misses the ground at some height: the footprint has no edge there.
    if not np.isfinite(D).all():
        return None
    footprint, errors = _fit(D, times, u, heights)
    period = float(image.times.time(1.0) - image.times.time(0.0))
    if not (errors <= settings.max_start_error * np.array([period, 1.0])).all():
        return None
    slope_range = _slope_range(pieces, np.asarray(samples), D.reshape(-1, 3), settings.slope_margin)
    if slope_range is None:
        return None
    # Slopes of points of the footprint at all times, not only when they are seen.
    xi = np.linspace(*slope_range, columns)
    eta = np.polynomial.polynomial.polyval(xi, np.asarray(line))
    k, within = np.indices((len(pieces.ends) - 1, len(TESTED_POSITIONS))).reshape(2, -1)
    _, speed = speeds(k, TESTED_POSITIONS[within], xi, eta)
    speed = speed[np.isfinite(speed)]  # a ray that misses sees no point
    has_one_sign = speed.min() * speed.max() > 0
    steady = np.abs(speed).min() > settings.min_relative_speed * np.abs(speed).max()
    return footprint if has_one_sign and steady else None


def _heights(
    image: PushbroomImage, earth: Ellipsoid | None, limits: tuple[float, float]
) -> Float[np.ndarray, "2"] | None:
    """The height range of points; None if the camera is not above the ground."""
    P = np.asarray(image.trajectory.position.values)
    if earth is None:
        altitude = P[:, 2].min()
    else:
        # The residual of a point scaled from the surface by 1 + a is (1 + a)² − 1.
        altitude = (np.sqrt(1 + np.asarray(residual(earth, tuple(P.T)))).min() - 1) * earth.c
    return np.clip(limits, -altitude / 2, altitude / 2) if altitude > 0 else None


def _pieces_of_times(
    pieces: Pieces, times: Float[np.ndarray, " times"]
) -> tuple[Int[np.ndarray, " times"], Float[np.ndarray, " times"]]:
    """Pieces of times, and τ in them."""
    ends = np.asarray(pieces.ends)
    k = np.clip(np.searchsorted(ends, times, side="right") - 1, 0, len(ends) - 2)
    return k, 2 * (times - ends[k]) / (ends[k + 1] - ends[k]) - 1


def _speeds_at(
    pieces: Pieces,
    heights: Float[np.ndarray, " heights"],
    line: Float[AnyArray, "6"],
    earth: Ellipsoid | None,
    batch: int,
    k: Int[np.ndarray, " n"],
    tau: Float[np.ndarray, " n"],
    xi: Float[np.ndarray, " slopes"],
    eta: Float[np.ndarray, " slopes"],
) -> tuple[np.ndarray, np.ndarray]:
    """Sights D [times, slopes, heights, 3] and ∂F/∂t [times, slopes, heights] at many times."""
    ends = np.asarray(pieces.ends)
    half_length = (ends[k + 1] - ends[k]) / 2
    c = np.asarray(pieces.coefficients)[k]
    pad = lambda a: np.pad(a, [(0, -len(k) % batch)] + [(0, 0)] * (a.ndim - 1), mode="edge")
    parts = [
        _speeds(*part, pieces.origin, xi, eta, heights, line, earth)
        for part in zip(*(pad(a).reshape(-1, batch, *a.shape[1:]) for a in (c, tau, half_length)))
    ]
    D, speed = (np.concatenate([np.asarray(v) for v in values])[: len(k)] for values in zip(*parts))
    return D, speed


@partial(compile_once, static=())
def _speeds(
    c: Float[AnyArray, "n 4 12"],
    tau: Float[AnyArray, " n"],
    half_length: Float[AnyArray, " n"],
    origin: Float[AnyArray, "3"],
    xi: Float[np.ndarray, " slopes"],
    eta: Float[np.ndarray, " slopes"],
    heights: Float[np.ndarray, " heights"],
    line: Float[AnyArray, "6"],
    earth: Ellipsoid | None,
) -> tuple[Array, Scalar]:
    def speed_at(
        c: Float[AnyArray, "4 12"],
        tau: Scalar,
        half_length: Scalar,
        xi: Scalar,
        eta: Scalar,
        h: Scalar,
    ) -> tuple[Array, Scalar]:
        numbers, rates = value_and_rate(c, tau)
        P, _ = motion(numbers, rates, origin)
        d = unpack(tuple(numbers[k] * xi + numbers[3 + k] * eta - numbers[6 + k] for k in range(3)))
        surface = Plane(level=h) if earth is None else Ground(at_height(earth, h))
        D = difference(point_on_ray(P, d, surface.distance(P, d)), origin)
        speed = jax.jvp(lambda n: slope_ahead(n, D, line)[0], (numbers,), (rates / half_length,))[1]
        return jnp.stack(D), speed

    over_heights = jax.vmap(speed_at, (None, None, None, None, None, 0))
    over_slopes = jax.vmap(over_heights, (None, None, None, 0, 0, None))
    return jax.vmap(over_slopes, (0, 0, 0, None, None, None))(c, tau, half_length, xi, eta, heights)


def _fit(
    D: Float[np.ndarray, "times pixels heights 3"],
    times: Float[np.ndarray, " times"],
    u: Float[np.ndarray, " pixels"],
    heights: Float[np.ndarray, "2"],
) -> tuple[Footprint, Float[np.ndarray, "2"]]:
    """The footprint through a lattice, and the largest errors of t and u there."""
    points = D.reshape(-1, 3)
    middle = points.mean(0)
    # Along the principal axes, each from −1 to 1: the cubes of metres along a strip and of heights
    # would leave the equations singular.
    _, axes = principal_axes(points - middle)
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


def _slope_range(
    pieces: Pieces,
    samples: Float[np.ndarray, " k"],
    D: Float[np.ndarray, "points 3"],
    margin: float,
) -> tuple[float, float] | None:
    """Smallest and largest ξ of the points in the image, with a margin; None if out of sight."""
    k, tau = _pieces_of_times(pieces, samples)
    c = np.asarray(pieces.coefficients)[k]
    numbers = np.einsum("kpn,pk->kn", c, tau ** np.arange(c.shape[1])[:, None])
    rsq = np.einsum("kij,nj->kni", numbers[:, :9].reshape(-1, 3, 3), D) + numbers[:, None, 9:]
    # Slopes grow without bound towards 90° off the axis; 84° is beyond any scanner.
    if (-rsq[..., 2] < 0.1 * np.linalg.norm(rsq, axis=2)).any():
        return None
    xi = -rsq[..., 0] / rsq[..., 2]
    middle, half_range = (xi.max() + xi.min()) / 2, (xi.max() - xi.min()) / 2
    return middle - margin * half_range, middle + margin * half_range


def _cubic(c: Float[AnyArray, "20"], x: Scalar, y: Scalar, z: Scalar) -> AnyArray:
    """The cubic polynomial with coefficients in the order of `POWERS`, Horner in all three."""
    following = iter(c)
    rows = [
        [value([next(following) for _ in range(4 - i - j)], z) for j in range(4 - i)]
        for i in range(4)
    ]
    return value([value(row, y) for row in rows], x)
