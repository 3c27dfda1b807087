"""What errors that image points of a camera share do to its observations: their roots, and the rows
that poses and interior orientation span.

W are the orthonormal rows of every view, spanned by its pose, Z those of the camera, spanned by its
interior orientation without W. Residuals are M·e with M = 1 − WᵀW − ZᵀZ.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbundle.adjustment.quality.correlated_errors import CorrelationSettings
from jaxbundle.adjustment.quality.given_points import GIVEN_POINTS
from jaxbundle.batches.error_roots import (
    GIVEN_AXES,
    correlation_of_given,
    correlation_of_views,
    displacements_by_view,
    effects_of_given,
    fields_of_camera,
    places_on_sensor,
    root_of_views,
)
from jaxbundle.batches.normal import POSE, CameraUnknowns, Sightings, design
from jaxbundle.cameras import CameraModel
from jaxbundle.geometry import matrix_from_quaternion

COMPONENTS = (
    "independent errors",
    "field on the sensor",
    "principal point by view",
    "principal distance by view",
    "affine by view",
    "along tracks",
    *GIVEN_POINTS,
)
FIELD, TRACKS, GIVEN = map(
    COMPONENTS.index, ("field on the sensor", "along tracks", GIVEN_POINTS[0])
)
# Columns of the components by view among five: displacements of x and y.
BY_VIEW = (slice(0, 2), slice(2, 3), slice(3, 5))


class Spans(eqx.Module):
    """Orthonormal rows W of the views and Z of the camera, their triangular factors L and R, W·Jᵢ,
    and ∂v/∂X of every image point."""

    W: Float[Array, "views 6 2 points"]
    Z: Float[Array, "views k 2 points"]
    L: Float[Array, "views 6 6"]
    R: Float[Array, "k k"]
    WJ: Float[Array, "views 6 k"]
    v: Float[Array, "views 2 points"]
    by_point: Float[Array, "views 2 points 3"]

    def residuals(self, e: Float[Array, "r views 2 points"]) -> Float[Array, "r views 2 points"]:
        """M·e."""
        We, Ze = jnp.einsum("veap,rvap->rve", self.W, e), jnp.einsum("vkap,rvap->rk", self.Z, e)
        e = e - jnp.einsum("veap,rve->rvap", self.W, We)
        return e - jnp.einsum("vkap,rk->rvap", self.Z, Ze)


class Products(NamedTuple):
    """F_kᵀ·u of residuals: of the field, of the columns by view, along tracks, of given points."""

    field: Float[Array, "r 2 splines"]
    by_view: Float[Array, "r views 5"]
    tracks: Float[Array, "r views 2 points"]
    points: Float[Array, "r 3 points"]


class Roots(eqx.Module):
    """The roots F of the components of a camera: splines of the finest octave, what all octaves are
    of them, and the products of these; columns by view; roots of the correlations of the views and
    of the points; the effects of the points."""

    used: Float[Array, "views points"]
    splines: Float[Array, "views splines points"]
    octaves: Float[Array, "splines splines"]
    gram: Float[Array, "splines splines"]
    by_view: Float[Array, "views 2 points 5"]
    views: Float[Array, "views views"]
    by_point: Float[Array, "views 2 points 3"]
    points: Float[Array, "points points"]

    def products(self, u: Float[Array, "r views 2 points"]) -> Products:
        """F_kᵀ·u of residuals u."""
        point = jnp.einsum("vapd,rvap->rdp", self.by_point, u)
        return Products(
            jnp.einsum("vsp,rvap->ras", self.splines, u) @ self.octaves,
            jnp.einsum("vapc,rvap->rvc", self.by_view, u),
            jnp.einsum("vw,rvap->rwap", self.views, u),
            point @ self.points,
        )

    def forms(self, u: Float[Array, "r views 2 points"]) -> Float[Array, "r components"]:
        """‖F_kᵀ·u‖² of residuals u."""
        return self.forms_of(u, self.products(u))

    def forms_of(
        self, u: Float[Array, "r views 2 points"], products: Products
    ) -> Float[Array, "r components"]:
        """The same from their products."""
        field, of_view, track, point = products
        square = lambda a: jnp.sum(a**2, range(1, a.ndim))
        parts = [square(u), square(field), *(square(of_view[..., columns]) for columns in BY_VIEW)]
        of_points = [square(point[:, columns]) for columns in GIVEN_AXES]
        return jnp.stack([*parts, square(track), *of_points], 1)

    def along_tracks(self, z: Float[Array, "r views 2 points"]) -> Array:
        """F·z of errors along tracks."""
        return jnp.einsum("vw,rwap->rvap", self.views, z) * self.used[:, None]

    def of_points(self, z: Float[Array, "r 3 points"]) -> Float[Array, "r views 2 points"]:
        """F·z of errors of given points."""
        return jnp.einsum("vapd,rdp->rvap", self.by_point, z @ self.points.T)

    def draw(
        self, theta: Float[Array, " components"], key: Array, number: int
    ) -> Float[Array, "r views 2 points"]:
        """Normal errors of these sizes."""
        views, points = self.used.shape
        keys = jax.random.split(key, 5)
        size = jnp.sqrt(theta)
        normal = lambda k, *shape: jax.random.normal(keys[k], (number, *shape), theta.dtype)
        e = size[0] * normal(0, views, 2, points) * self.used[:, None]
        field = normal(1, 2, len(self.octaves)) @ self.octaves.T
        e += size[FIELD] * jnp.einsum("vsp,ras->rvap", self.splines, field)
        of_view = jnp.repeat(size[2:TRACKS], jnp.array([2, 1, 2]), total_repeat_length=5)
        e += jnp.einsum("vapc,rvc->rvap", self.by_view, of_view * normal(2, views, 5))
        e += size[TRACKS] * self.along_tracks(normal(3, views, 2, points))
        of_axes = jnp.repeat(size[GIVEN:], jnp.array([2, 1]), total_repeat_length=3)
        return e + self.of_points(of_axes[:, None] * normal(4, 3, points))


def in_single_precision(tree: Any) -> Any:
    """In single precision, twice as fast: for sums of squares of random numbers, and products with
    splines, which no span contains."""
    return jax.tree.map(lambda x: x.astype(jnp.float32), tree)


def computed_coordinates(
    sightings: Sightings, v: Float[Array, "views 2 points"]
) -> Float[Array, "views points 2"]:
    """Computed image coordinates, in which effects are given: they have no share of the residuals
    (`correlated_errors.image_rows`)."""
    return jnp.asarray(sightings.xy) + v.swapaxes(1, 2)


def spans_of_camera(
    model: CameraModel, free: tuple[int, ...], sightings: Sightings, unknowns: CameraUnknowns
) -> Spans:
    columns = [jnp.stack(axis, 1) for axis in design(model, free, sightings, unknowns)]
    rows = jnp.stack(columns, 2)  # [views, 6 + k + 1, 2, points]
    E, J, v = rows[:, :POSE], rows[:, POSE:-1], rows[:, -1]
    W, L = _orthonormal(E, jnp.asarray(sightings.weight))
    WJ = products_of_rows(W, J)
    Z, R = _orthonormal_of_all(J - jnp.einsum("vek,veap->vkap", WJ, W))
    # ray = M·X + t: of a point as of the shift, turned.
    turns = jax.vmap(matrix_from_quaternion)(unknowns.rotation)
    by_point = [sum(turns[:, i, j, None, None] * E[:, i] for i in range(3)) for j in range(3)]
    return Spans(W, Z, L, R, WJ, v, jnp.stack(by_point, -1))


def products_of_rows(
    a: Float[Array, "views m 2 points"], b: Float[Array, "views n 2 points"]
) -> Float[Array, "views m n"]:
    """Of all rows of the views."""
    flat = lambda x: x.reshape(*x.shape[:2], -1)
    return flat(a) @ flat(b).swapaxes(1, 2)


def spans_and_roots(
    model: CameraModel,
    free: tuple[int, ...],
    settings: CorrelationSettings,
    sightings: Sightings,
    unknowns: CameraUnknowns,
) -> tuple[Spans, Roots]:
    is_used = jnp.asarray(sightings.weight)
    spans = spans_of_camera(model, free, sightings, unknowns)
    on_sensor, place = places_on_sensor(computed_coordinates(sightings, spans.v), is_used)
    splines, octaves, gram = fields_of_camera(place, is_used, settings)
    by_view = displacements_by_view(on_sensor, is_used)
    by_point = effects_of_given(is_used, spans.by_point)
    points = jnp.linalg.cholesky(
        correlation_of_given(jnp.asarray(sightings.point), is_used, settings)
    )
    K = correlation_of_views(unknowns, is_used, settings.reach, sightings)
    views = root_of_views(K)
    return spans, Roots(is_used, splines, octaves, gram, by_view, views, by_point, points)


def _orthonormal(
    E: Float[Array, "views 6 2 points"], is_used: Float[Array, "views points"]
) -> tuple[Float[Array, "views 6 2 points"], Float[Array, "views 6 6"]]:
    """Rows W that span those of every view, and L of EEᵀ = L·Lᵀ; of views without points W is
    zero."""
    N = products_of_rows(E, E)
    has_none = ~(is_used.sum(1) > 0)
    scale = jax.lax.rsqrt(jnp.where(has_none[:, None], 1.0, jnp.diagonal(N, axis1=1, axis2=2)))
    N = N * scale[:, :, None] * scale[:, None, :] + has_none[:, None, None] * jnp.eye(POSE)
    L = jnp.linalg.cholesky(N)
    eye = jnp.broadcast_to(jnp.eye(POSE), N.shape)
    inverse = jax.scipy.linalg.solve_triangular(L, eye, lower=True) * scale[:, None, :]
    return jnp.einsum("vef,vfap->veap", inverse, E), L / scale[:, :, None]


def _orthonormal_of_all(
    J: Float[Array, "views k 2 points"],
) -> tuple[Float[Array, "views k 2 points"], Float[Array, "k k"]]:
    """Rows Z that span those of all views together, and R of JJᵀ = R·Rᵀ."""
    N = jnp.sum(products_of_rows(J, J), 0)
    scale = jax.lax.rsqrt(jnp.diagonal(N))
    R = jnp.linalg.cholesky(N * scale[:, None] * scale)
    inverse = jax.scipy.linalg.solve_triangular(R, jnp.eye(len(R)), lower=True) * scale
    return jnp.einsum("kl,vlap->vkap", inverse, J), R / scale[:, None]
