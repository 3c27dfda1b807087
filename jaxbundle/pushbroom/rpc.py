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

The inverse solves two equations by Newton's method in (L, P). Its last step is taken from a
constant position, so that its derivatives are those of the solution (implicit function theorem), by
line, sample, height and every coefficient.
"""

from enum import IntEnum
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int

from jaxbundle.geometry.ellipsoid import WGS84, Ellipsoid, earth_fixed
from jaxbundle.geometry.vectors import Triple, Vector, along, difference, unit, unpack
from jaxbundle.implicit import implicit_root, solve_dense
from jaxbundle.pushbroom.corrections import require_ellipsoid
from jaxbundle.pushbroom.surfaces import GroundSurface
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar

TERMS = 20
"""Of a polynomial of degree 3 in three variables, in the format RPC00B."""
DOMAIN_MARGIN = 0.1
"""The part of the scales beyond ±1 that still counts as inside. Vendors' scales are rounded and
their edges not sharp; larger: an extrapolation passes unnoticed, smaller: points at the edges of an
image have warnings. Not critical."""


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


def locate(rpc: Rpc, line: Scalar, sample: Scalar, height: Scalar) -> tuple[Array, Array, Array]:
    """Longitude and latitude, radians, of an image position at a height; and its `RpcStatus`.

    NaN if Newton's method does not converge.
    """
    H = (height - rpc.height_offset) / rpc.height_scale
    target = jnp.stack(
        [
            (line - rpc.line_offset) / rpc.line_scale,
            (sample - rpc.sample_offset) / rpc.sample_scale,
        ]
    )
    fixed = stop_gradient((rpc, H, target))

    def newton(_: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        place = state[0]
        J, v = jax.jacfwd(_twice_misclosure, has_aux=True)(place, fixed)
        step = _solve(J, v)
        return place - step, jnp.max(jnp.abs(step))

    start = (jnp.zeros(2), jnp.asarray(jnp.inf))
    # From the middle of the domain four steps reach rounding (of coefficients with all terms the
    # largest are 0.9, 1e-2, 2e-6, 3e-14); three more are a reserve for images far from linear.
    place, last = jax.lax.fori_loop(0, 7, newton, start)
    L, P = implicit_root(_misclosure, solve_dense, place, None, (rpc, H, target))
    # in units of the scales; the error after a step is about its square, below rounding
    settled = last < 1e-9
    longitude = jnp.radians(rpc.longitude_offset + rpc.longitude_scale * L)
    latitude = jnp.radians(rpc.latitude_offset + rpc.latitude_scale * P)
    settled_only = lambda a: jnp.where(settled, a, jnp.nan)
    status = jnp.where(
        settled, _inside(jnp.stack([L, P, H, *target])), int(RpcStatus.NOT_CONVERGED)
    )
    return settled_only(longitude), settled_only(latitude), status


def _misclosure(
    place: Float[Array, "2"], _: None, data: tuple[Rpc, Scalar, Array]
) -> Float[Array, "2"]:
    """Line and sample of (L, P), both in units of the scales, minus those wanted."""
    (rpc, H, target), (L, P) = data, place
    return jnp.stack(_ratios(rpc, L, P, H)) - target


def _twice_misclosure(
    place: Float[Array, "2"], data: tuple[Rpc, Scalar, Array]
) -> tuple[Array, Array]:
    """The misclosure to be differentiated and, as `has_aux` of JAX, itself."""
    v = _misclosure(place, None, data)
    return v, v


def domain(rpc: Rpc, longitude: Scalar, latitude: Scalar, height: Scalar) -> Array:
    """The `RpcStatus` of a point: whether it and its image are in the domain of the
    coefficients."""
    place = normalise(rpc, longitude, latitude, height)
    ratios = jnp.stack(_ratios(rpc, *place))
    inside = _inside(jnp.stack([*place, *ratios]))
    return jnp.where(jnp.isfinite(ratios).all(), inside, int(RpcStatus.NOT_CONVERGED))


def locate_on(
    rpc: Rpc, surface: GroundSurface, line: Scalar, sample: Scalar
) -> tuple[Array, Array, Scalar, Array]:
    """(longitude, latitude, height, status) of the first point of the line of sight on a surface.

    The points at the lowest and the highest height of the domain span a straight line; at its
    intersection with the surface it is shifted onto the line of sight of the polynomials,
    repeatedly.

    **Arguments:** `surface` above an ellipsoid of revolution.
    """
    earth = require_ellipsoid(surface.earth)
    top, d = sight(rpc, line, sample, earth)

    def shift(
        state: tuple[Vector, tuple[Array, Array, Scalar, Array]], _: None
    ) -> tuple[tuple[Vector, tuple[Array, Array, Scalar, Array]], None]:
        o = state[0]
        X = along(o, d, surface.distance(o, d))
        h = surface.height(X)
        longitude, latitude, status = locate(rpc, line, sample, h)
        seen = earth_fixed(earth, (longitude, latitude, h))
        return (along(o, difference(seen, X), 1.0), (longitude, latitude, h, status)), None

    nothing = (jnp.zeros(()), jnp.zeros(()), jnp.zeros(()), jnp.zeros((), int))
    # 20 km above the domain: also of a surface that rises above its heights the first point is met
    start = (along(top, d, -20e3), nothing)
    # The ray is nearly parallel to the line of sight: a round leaves of the distance between both
    # only its product with the angle between them.
    (_, (longitude, latitude, h, status)), _ = jax.lax.scan(shift, start, length=3)
    missed = jnp.isnan(h)
    return longitude, latitude, h, jnp.where(missed, int(RpcStatus.NOT_CONVERGED), status)


def sight(
    rpc: Rpc, line: Scalar, sample: Scalar, earth: Ellipsoid = WGS84
) -> tuple[Triple, Triple]:
    """The chord of a line of sight: its point at the highest height, and its direction downwards.

    Earth-fixed, metres; the direction is a unit vector.
    """

    def point(height: Scalar) -> Float[Array, "3"]:
        longitude, latitude, _ = locate(rpc, line, sample, height)
        return jnp.stack(earth_fixed(earth, (longitude, latitude, height)))

    ends = rpc.height_offset + jnp.abs(rpc.height_scale) * jnp.array([1.0, -1.0])
    top, bottom = jax.vmap(point)(ends)
    return unpack(top), unit(difference(bottom, top))


@partial(compile_once, static=())
def project_points(
    rpc: Rpc,
    longitude: Float[AnyArray, " n"],
    latitude: Float[AnyArray, " n"],
    height: Float[AnyArray, " n"],
) -> tuple[Scalar, Scalar, Array]:
    """Lines, samples and statuses of many points, radians and metres."""
    place = lambda *point: (*project(rpc, *point), domain(rpc, *point))
    return jax.vmap(place)(longitude, latitude, height)


@partial(compile_once, static=())
def locate_points(
    rpc: Rpc,
    line: Float[AnyArray, " n"],
    sample: Float[AnyArray, " n"],
    height: Float[AnyArray, " n"],
) -> tuple[Array, Array, Array]:
    """Longitudes, latitudes (radians) and statuses of many positions at given heights."""
    return jax.vmap(lambda l, s, h: locate(rpc, l, s, h))(line, sample, height)


@partial(compile_once, static=())
def locate_points_on(
    rpc: Rpc, surface: GroundSurface, line: Float[AnyArray, " n"], sample: Float[AnyArray, " n"]
) -> tuple[Array, Array, Scalar, Array]:
    """Longitudes, latitudes, heights and statuses of many positions on a surface."""
    return jax.vmap(lambda l, s: locate_on(rpc, surface, l, s))(line, sample)


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


def _inside(values: Float[Array, "5"]) -> Int[Array, ""]:
    """Status of normalised coordinates, ground and image."""
    inside = jnp.max(jnp.abs(values)) <= 1 + DOMAIN_MARGIN
    return jnp.where(inside, int(RpcStatus.INSIDE), int(RpcStatus.OUTSIDE))


def _solve(J: Float[Array, "2 2"], v: Float[Array, "2"]) -> Float[Array, "2"]:
    """J⁻¹·v of 2 × 2."""
    determinant = J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0]
    return (
        jnp.stack([J[1, 1] * v[0] - J[0, 1] * v[1], J[0, 0] * v[1] - J[1, 0] * v[0]]) / determinant
    )
