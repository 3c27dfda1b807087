"""Rational polynomial coefficients (RPC): an image as polynomials of longitude, latitude, height.

With L, P, H the longitude, latitude and height minus their offsets, divided by their scales,

    line   = line_offset   + line_scale·a(L, P, H)/b(L, P, H),
    sample = sample_offset + sample_scale·c(L, P, H)/d(L, P, H),

each polynomial of 20 coefficients in the order of RPC00B (STDI-0002, appendix E):

    1, L, P, H, LP, LH, PH, L², P², H², PLH, L³, LP², LH², L²P, P³, PH², L²H, P²H, H³.

RPC00A has another order and is not supported. Offsets and scales have the units of the files,
degrees and metres; longitudes and latitudes of functions are in radians.
Heights are above the ellipsoid. In RPC00B line 0, sample 0 is the centre of the first pixel, as
in this package; `sample` is the pixel of a line scanner.

The inverse solves two equations in (L, P) by Newton's method, each step followed by one with the
same Jacobian, which makes its convergence cubic (Traub 1964, section 8.4). Many positions begin
where a polynomial of line, sample and height puts them, and need one step. Its derivatives are
those of the solution (implicit function theorem), by line, sample, height and every coefficient.
Points are scalars, not vectors: XLA computes several at a time then, and is four times as fast.
"""

from collections.abc import Callable
from enum import IntEnum
from functools import partial, reduce

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int

from jaxbundle.arguments import without_masks
from jaxbundle.float64 import require_x64
from jaxbundle.geometry.ellipsoid import WGS84, Ellipsoid, earth_fixed
from jaxbundle.geometry.vectors import Triple, Vector, difference, point_on_ray, unit, unpack
from jaxbundle.implicit import implicit_root
from jaxbundle.pushbroom.corrections import require_ellipsoid
from jaxbundle.pushbroom.surfaces import GroundSurface
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar

# (L, P), or line and sample, in units of the scales.
Place = tuple[Scalar, Scalar]
# Of a polynomial of degree 3 in three variables, in the format RPC00B.
TERMS = 20
# The part of the scales beyond ±1 that still counts as inside. Vendors' scales are rounded and
# their edges not sharp; larger: an extrapolation passes unnoticed, smaller: points at the edges of
# an image have warnings. Not critical.
DOMAIN_MARGIN = 0.1


# Metres above the highest height of the domain at which lines of sight begin: higher than the
# terrain of any planet reaches above its mean. Only its order of magnitude counts.
ABOVE_DOMAIN = 20e3


class RpcStatus(IntEnum):
    """Validity of the polynomials at a position."""

    INSIDE = 0
    OUTSIDE = 1
    NOT_CONVERGED = 2

    @property
    def meaning(self) -> str:
        """The status in words."""
        return _MEANING[self]


_MEANING = {
    RpcStatus.INSIDE: "inside the domain",
    RpcStatus.OUTSIDE: "outside the domain of the coefficients: extrapolated",
    RpcStatus.NOT_CONVERGED: "no place found: the iterations do not converge",
}


class Rpc(eqx.Module):
    """Coefficients of RPC00B, offsets and scales: lines, samples, degrees, metres."""

    line_numerator: Float[AnyArray, "20"]
    line_denominator: Float[AnyArray, "20"]
    sample_numerator: Float[AnyArray, "20"]
    sample_denominator: Float[AnyArray, "20"]
    line_offset: Scalar
    line_scale: Scalar
    sample_offset: Scalar
    sample_scale: Scalar
    longitude_offset: Scalar
    longitude_scale: Scalar
    latitude_offset: Scalar
    latitude_scale: Scalar
    height_offset: Scalar
    height_scale: Scalar


def project(rpc: Rpc, longitude: Scalar, latitude: Scalar, height: Scalar) -> tuple[Scalar, Scalar]:
    """Line and sample of one point, given in radians and metres; see `domain` for their status."""
    line, sample = _ratios(rpc, *normalise(rpc, longitude, latitude, height))
    return (
        rpc.line_offset + rpc.line_scale * line,
        rpc.sample_offset + rpc.sample_scale * sample,
    )


class InversePolynomial(eqx.Module):
    """(L, P) as polynomials of line, sample and height, all in units of the scales: start values of
    many positions."""

    coefficients: Float[AnyArray, "2 20"]

    def start(self, line: Scalar, sample: Scalar, height: Scalar) -> Place:
        """(L, P), about."""
        terms = monomials(line, sample, height)
        L, P = (sum(c * m for c, m in zip(row, terms)) for row in self.coefficients)
        return L, P


def fit_inverse(rpc: Rpc, points: int = 6) -> InversePolynomial:
    """The inverse as cubic polynomials, fitted to a lattice of `points` a side over the domain.

    Four a side determine a cubic; six show it the places between. It is a start: a worse one, as of
    an image far from linear, costs a step.
    """
    fixed = stop_gradient(rpc)
    L, P, H = (x.ravel() for x in jnp.meshgrid(*3 * [jnp.linspace(-1.0, 1.0, points)]))
    line, sample = jax.vmap(partial(_ratios, fixed))(L, P, H)
    A = jnp.stack(jnp.broadcast_arrays(*monomials(line, sample, H)), 1)
    # A place where a denominator vanishes says nothing.
    good = jnp.isfinite(A).all(1, keepdims=True)
    right = jnp.where(good, jnp.stack([L, P], 1), 0.0)
    coefficients, *_ = jnp.linalg.lstsq(jnp.where(good, A, 0.0), right)
    return InversePolynomial(jnp.where(jnp.isfinite(coefficients), coefficients, 0.0).T)


# From the middle of the domain two reach rounding (of coefficients with all terms the largest are
# 0.9 and 1e-4); the others are a reserve for images far from linear.
MAX_STEPS = 10
# The last step in units of the scales. Cubic convergence leaves its third power times the square of
# the curvature of line and sample, 1e-2 of real images: 1e-13.
SETTLED = 1e-3


def locate(
    rpc: Rpc,
    line: Scalar,
    sample: Scalar,
    height: Scalar,
    inverse: InversePolynomial | None = None,
    max_steps: int = MAX_STEPS,
) -> tuple[Array, Array, Array]:
    """Longitude and latitude, radians, of an image position at a height; and its `RpcStatus`.

    NaN if Newton's method does not converge. It begins in the middle of the domain, or where
    `inverse` says.
    """
    H = (height - rpc.height_offset) / rpc.height_scale
    target = (
        (line - rpc.line_offset) / rpc.line_scale,
        (sample - rpc.sample_offset) / rpc.sample_scale,
    )
    data = rpc, H, target
    fixed = stop_gradient(data)
    misclosure = lambda L, P: _misclosure((L, P), None, fixed)

    def is_unsettled(state: tuple[int, Place, Scalar]) -> Array:
        number, _, last_step = state
        return jnp.asarray((number < max_steps) & (last_step > SETTLED))

    def newton(state: tuple[int, Place, Scalar]) -> tuple[int, Place, Scalar]:
        number, place, _ = state
        one, nil = jnp.ones_like(place[0]), jnp.zeros_like(place[0])
        v, by_L = jax.jvp(misclosure, place, (one, nil))
        _, by_P = jax.jvp(misclosure, place, (nil, one))
        # Both with the Jacobian of the first.
        step = _solve(by_L, by_P, v)
        new_place = place[0] - step[0], place[1] - step[1]
        second_step = _solve(by_L, by_P, misclosure(*new_place))
        new_place = new_place[0] - second_step[0], new_place[1] - second_step[1]
        return number + 1, new_place, jnp.maximum(jnp.abs(step[0]), jnp.abs(step[1]))

    start = jnp.zeros_like(H), jnp.zeros_like(H)
    if inverse is not None:
        start = stop_gradient(inverse).start(*fixed[2], fixed[1])
    state = newton((0, start, jnp.full_like(H, jnp.inf)))
    if max_steps > 1:
        state = jax.lax.while_loop(is_unsettled, newton, state)
    _, place, last_step = state
    L, P = implicit_root(_misclosure, _solve_root, place, None, data)
    settled = last_step <= SETTLED
    longitude = jnp.radians(rpc.longitude_offset + rpc.longitude_scale * L)
    latitude = jnp.radians(rpc.latitude_offset + rpc.latitude_scale * P)
    settled_only = lambda a: jnp.where(settled, a, jnp.nan)
    status = jnp.where(settled, _domain_status(L, P, H, *target), int(RpcStatus.NOT_CONVERGED))
    return settled_only(longitude), settled_only(latitude), status


def _misclosure(place: Place, _: None, data: tuple[Rpc, Scalar, Place]) -> Place:
    """Line and sample of (L, P), both in units of the scales, minus those wanted."""
    rpc, H, target = data
    line, sample = _ratios(rpc, *place, H)
    return line - target[0], sample - target[1]


def _solve_root(times: Callable, _: None, b: Place) -> Place:
    """The solution of A·x = b, of `implicit_root`."""
    one, nil = jnp.ones_like(b[0]), jnp.zeros_like(b[0])
    return _solve(times((one, nil)), times((nil, one)), b)


def domain(rpc: Rpc, longitude: Scalar, latitude: Scalar, height: Scalar) -> Array:
    """The `RpcStatus` of a point: whether it and its image are in the domain of the
    coefficients."""
    place = normalise(rpc, longitude, latitude, height)
    line, sample = _ratios(rpc, *place)
    status = _domain_status(*place, line, sample)
    return jnp.where(jnp.isfinite(line + sample), status, int(RpcStatus.NOT_CONVERGED))


def locate_on(
    rpc: Rpc,
    surface: GroundSurface,
    line: Scalar,
    sample: Scalar,
    inverse: InversePolynomial | None = None,
) -> tuple[Array, Array, Scalar, Array]:
    """(longitude, latitude, height, status) of the first point of the line of sight on a surface.

    The points at the lowest and the highest height of the domain span a straight line; at its
    intersection with the surface it is shifted onto the line of sight of the polynomials,
    repeatedly.

    **Arguments:** `surface` above an ellipsoid of revolution; `inverse`: as of `locate`.
    """
    earth = require_ellipsoid(surface.earth)
    top, d = sight(rpc, line, sample, earth, inverse)

    def shift(
        state: tuple[Vector, tuple[Array, Array, Scalar, Array]], _: None
    ) -> tuple[tuple[Vector, tuple[Array, Array, Scalar, Array]], None]:
        o = state[0]
        X = point_on_ray(o, d, surface.distance(o, d))
        h = surface.height(X)
        longitude, latitude, status = locate(rpc, line, sample, h, inverse)
        located = earth_fixed(earth, (longitude, latitude, h))
        return (
            point_on_ray(o, difference(located, X), 1.0),
            (longitude, latitude, h, status),
        ), None

    no_position = (jnp.zeros(()), jnp.zeros(()), jnp.zeros(()), jnp.zeros((), int))
    # Also of a surface that rises above the heights of the domain the first point is met.
    start = (point_on_ray(top, d, -ABOVE_DOMAIN), no_position)
    # The ray is nearly parallel to the line of sight: a round leaves of the distance between both
    # only its product with the angle between them.
    (_, (longitude, latitude, h, status)), _ = jax.lax.scan(shift, start, length=3)
    is_missed = jnp.isnan(h)
    return longitude, latitude, h, jnp.where(is_missed, int(RpcStatus.NOT_CONVERGED), status)


def sight(
    rpc: Rpc,
    line: Scalar,
    sample: Scalar,
    earth: Ellipsoid = WGS84,
    inverse: InversePolynomial | None = None,
) -> tuple[Triple, Triple]:
    """The chord of a line of sight: its point at the highest height, and its direction downwards.

    Earth-fixed, metres; the direction is a unit vector.
    """

    def point(height: Scalar) -> Float[Array, "3"]:
        longitude, latitude, _ = locate(rpc, line, sample, height, inverse)
        return jnp.stack(earth_fixed(earth, (longitude, latitude, height)))

    ends = rpc.height_offset + jnp.abs(rpc.height_scale) * jnp.array([1.0, -1.0])
    top, bottom = jax.vmap(point)(ends)
    return unpack(top), unit(difference(bottom, top))


@without_masks
@partial(compile_once, static=())
def project_points(
    rpc: Rpc,
    longitude: Float[AnyArray, " n"],
    latitude: Float[AnyArray, " n"],
    height: Float[AnyArray, " n"],
) -> tuple[Scalar, Scalar, Array]:
    """Lines, samples and statuses of many points, radians and metres."""
    require_x64()
    place = lambda *point: (*project(rpc, *point), domain(rpc, *point))
    return jax.vmap(place)(longitude, latitude, height)


@without_masks
@partial(compile_once, static=())
def locate_points(
    rpc: Rpc,
    line: Float[AnyArray, " n"],
    sample: Float[AnyArray, " n"],
    height: Float[AnyArray, " n"],
) -> tuple[Array, Array, Array]:
    """Longitudes, latitudes (radians) and statuses of many positions at given heights."""
    require_x64()
    inverse = fit_inverse(rpc)

    def locate_all(max_steps: int) -> tuple[Array, Array, Array]:
        locate_one = lambda l, s, h: locate(rpc, l, s, h, inverse, max_steps)
        return jax.vmap(locate_one)(line, sample, height)

    # One step of nearly every image settles all: without the loop, which keeps its values in
    # memory between steps, in half the time.
    one_step = locate_all(1)
    settled = jnp.all(one_step[2] != int(RpcStatus.NOT_CONVERGED))
    return jax.lax.cond(settled, lambda: one_step, lambda: locate_all(MAX_STEPS))


@without_masks
@partial(compile_once, static=())
def locate_points_on(
    rpc: Rpc, surface: GroundSurface, line: Float[AnyArray, " n"], sample: Float[AnyArray, " n"]
) -> tuple[Array, Array, Scalar, Array]:
    """Longitudes, latitudes, heights and statuses of many positions on a surface."""
    require_x64()
    inverse = fit_inverse(rpc)
    return jax.vmap(lambda l, s: locate_on(rpc, surface, l, s, inverse))(line, sample)


def monomials(L: Scalar, P: Scalar, H: Scalar) -> tuple[Scalar, ...]:
    """The 20 terms in the order of RPC00B."""
    return (
        1.0 + 0 * L,  # of the shape of L
        L,
        P,
        H,
        L * P,
        L * H,
        P * H,
        L * L,
        P * P,
        H * H,
        P * L * H,
        L * L * L,
        L * P * P,
        L * H * H,
        L * L * P,
        P * P * P,
        P * H * H,
        L * L * H,
        P * P * H,
        H * H * H,
    )


def normalise(rpc: Rpc, longitude: Scalar, latitude: Scalar, height: Scalar) -> Triple:
    """(L, P, H); longitudes may differ by turns."""
    east = jnp.degrees(longitude) - rpc.longitude_offset
    east = east - 360 * jnp.round(east / 360)
    return (
        east / rpc.longitude_scale,
        (jnp.degrees(latitude) - rpc.latitude_offset) / rpc.latitude_scale,
        (height - rpc.height_offset) / rpc.height_scale,
    )


def _ratios(rpc: Rpc, L: Scalar, P: Scalar, H: Scalar) -> tuple[Scalar, Scalar]:
    """a/b and c/d: line and sample in units of their scales."""
    terms = monomials(L, P, H)
    value = lambda coefficients: sum(c * m for c, m in zip(coefficients, terms))
    return (
        value(rpc.line_numerator) / value(rpc.line_denominator),
        value(rpc.sample_numerator) / value(rpc.sample_denominator),
    )


def _domain_status(*values: Scalar) -> Int[Array, ""]:
    """Status of normalised coordinates, ground and image."""
    largest = reduce(jnp.maximum, map(jnp.abs, values))
    return jnp.where(largest <= 1 + DOMAIN_MARGIN, int(RpcStatus.INSIDE), int(RpcStatus.OUTSIDE))


def _solve(by_L: Place, by_P: Place, v: Place) -> Place:
    """J⁻¹·v, J by its columns."""
    determinant = by_L[0] * by_P[1] - by_P[0] * by_L[1]
    return (
        (by_P[1] * v[0] - by_P[0] * v[1]) / determinant,
        (by_L[0] * v[1] - by_L[1] * v[0]) / determinant,
    )
