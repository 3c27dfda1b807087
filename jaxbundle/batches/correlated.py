"""Errors that image points of a camera of a batch share, and its σ under them.

The components are those of `adjustment.quality.correlated_errors`: a field on the sensor, principal
point, principal distance and affine distortion by view, errors along tracks, errors of the given
points. With the orthonormal rows W of every view and Z of the camera that the poses and then the
interior orientation span,

    M = 1 − WᵀW − ZᵀZ,        T_kj = ‖F_kᵀ·M·F_j‖²,        q_k = ‖F_kᵀ·v‖²

and with the triangular factors L of a view and R of the camera the effects of the errors F·ξ

    x = R⁻ᵀ·Z·F·ξ  (interior),        L⁻ᵀ·(W·F·ξ − W·Jᵢ·x)  (pose)

so that covariances need only W·V·Wᵀ, W·V·Zᵀ and Z·V·Zᵀ of every V = F·Fᵀ: no row of all
observations is solved for. T of errors along tracks and of given points, of which a camera has
thousands of columns, is from random combinations of them (`SumSettings`).

Three programs, for each only the cameras and components that need it: q of all cameras, without any
span or root (0.45 ms for 20 views of 88 points); T, of some of a batch with sizes in common (6 ms);
the covariances that components of θ > 0 give (0.55 ms).
"""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbundle.adjustment.quality.correlated_errors import CorrelationSettings
from jaxbundle.adjustment.quality.given_points import GIVEN_POINTS
from jaxbundle.batches.compiled import ProgramKey, exterior_slopes
from jaxbundle.batches.error_roots import (
    GIVEN_AXES,
    correlation_of_given,
    correlation_of_views,
    displacements_by_view,
    effects_of_given,
    field_form,
    fields_of_camera,
    given_points,
    mean_squares_of_given,
    places_on_sensor,
    root_of_views,
)
from jaxbundle.batches.normal import (
    POSE,
    CameraUnknowns,
    Sightings,
    design,
    effects_of_object_points,
)
from jaxbundle.cameras import CameraModel
from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray

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


@dataclasses.dataclass(frozen=True)
class SumSettings:
    """How many random numbers and cameras sums are from that would take too long exactly.

    **Fields:**

    - `probes`: random combinations of the columns of errors along tracks, and of given points: of
      matrices of rank r their sums of squares are right to √(2/(16·r)), 5 % for r = 50.
    - `traced`: cameras of a batch that its traces are from, which are nearly the same in all: where
      those of a camera differ by a tenth, their mean is right to 1.3 %.
    - `draws` that the covariance of the forms of a camera is from, right to √(2/16) = 35 %: degrees
      of freedom, which it is for, need no more.
    """

    probes: int = 16
    traced: int = 64
    draws: int = 16


SUMS = SumSettings()


class ComponentForms(NamedTuple):
    """The quadratic forms q [k] of the residuals of a camera, and how many points are seen in two
    views or more."""

    q: Float[np.ndarray, "*cameras k"]
    given: Float[np.ndarray, "*cameras"]


class ComponentTraces(NamedTuple):
    """T [k, k] of the components of a camera, and the traces of three of them
    (`leastsquares.quality.size_traces`); zero where they are not wanted."""

    T: Float[np.ndarray, "*cameras k k"]
    cubes: Float[np.ndarray, "*cameras k k k"]


class ComponentParts(NamedTuple):
    """What components of θ = 1 give a camera: `remaining`, their tr(M·V) in its vᵀv; the covariance
    of the interior orientation, and the variances of X0, Y0, Z0, ω, φ, κ; zero where they are not
    wanted."""

    remaining: Float[np.ndarray, "*cameras k"]
    interior: Float[np.ndarray, "*cameras k n n"]
    pose: Float[np.ndarray, "*cameras k views 6"]


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
    splines: Float[Array, "views points splines"]
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
            jnp.einsum("vps,rvap->ras", self.splines, u) @ self.octaves,
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
        parts = [square(u), square(field), *(square(of_view[..., of]) for of in BY_VIEW)]
        of_points = [square(point[:, of]) for of in GIVEN_AXES]
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
        e += size[FIELD] * jnp.einsum("vps,ras->rvap", self.splines, field)
        of_view = jnp.repeat(size[2:TRACKS], jnp.array([2, 1, 2]), total_repeat_length=5)
        e += jnp.einsum("vapc,rvc->rvap", self.by_view, of_view * normal(2, views, 5))
        e += size[TRACKS] * self.along_tracks(normal(3, views, 2, points))
        of_axes = jnp.repeat(size[GIVEN:], jnp.array([2, 1]), total_repeat_length=3)
        return e + self.of_points(of_axes[:, None] * normal(4, 3, points))


def _single(tree: Any) -> Any:
    """In single precision, twice as fast: for sums of squares of random numbers, and products with
    splines, which no span contains."""
    return jax.tree.map(lambda x: x.astype(jnp.float32), tree)


class Covariances(NamedTuple):
    """W·V·Wᵀ, W·V·Zᵀ and Z·V·Zᵀ of a component V of the `trace`."""

    ww: Float[Array, "views 6 6"]
    wz: Float[Array, "views 6 k"]
    zz: Float[Array, "k k"]
    trace: Float[Array, ""]

    @property
    def remaining(self) -> Float[Array, ""]:
        """tr(M·V)."""
        return self.trace - jnp.trace(self.zz) - jnp.trace(self.ww, axis1=1, axis2=2).sum()


@partial(compile_once, static=(0, 1))
def forms_of_portion(
    key: ProgramKey, settings: CorrelationSettings, seen: Sightings, at: CameraUnknowns
) -> ComponentForms:
    """The forms of every camera of a portion; `seen`: with the weights of the adjustment."""
    return key.for_every(lambda given: _forms(key.model, settings, *given))((seen, at))


@partial(compile_once, static=(0, 1))
def traces_of_portion(
    key: ProgramKey,
    settings: CorrelationSettings,
    seen: Sightings,
    at: CameraUnknowns,
    wanted: Bool[AnyArray, " cameras"],
) -> ComponentTraces:
    """The traces of the cameras of a portion for which they are wanted."""
    number = len(COMPONENTS)
    zero: list[Any] = [jnp.zeros((number,) * n) for n in (2, 3)]
    none = lambda _: ComponentTraces(*zero)
    signs = _signs(settings, *seen.weight.shape[1:])

    def traced(given: tuple[Sightings, CameraUnknowns]) -> ComponentTraces:
        return _traces(*_spans_and_roots(key.model, key.free, settings, *given), signs)

    of_camera = lambda given: jax.lax.cond(given[2], traced, none, given[:2])
    return key.for_every(of_camera)((seen, at, wanted))


@partial(compile_once, static=(0, 1))
def parts_of_portion(
    key: ProgramKey,
    settings: CorrelationSettings,
    seen: Sightings,
    at: CameraUnknowns,
    axes: Float[AnyArray, "cameras 3 3"],
    middle: Float[AnyArray, "cameras 3"],
    wanted: Bool[AnyArray, "cameras k"],
) -> ComponentParts:
    """What the wanted components give every camera of a portion; that of the independent part is
    the classical covariance, and left at zero."""
    number, k, views = len(COMPONENTS), len(key.free), seen.weight.shape[1]
    shapes = (number,), (number, k, k), (number, views, POSE)
    zero: list[Any] = [jnp.zeros(shape) for shape in shapes]
    none = lambda *_: ComponentParts(*zero)
    found = partial(_parts, key.model, key.free, settings)
    of_camera = lambda given: jax.lax.cond(jnp.any(given[-1][1:]), found, none, *given)
    return key.for_every(of_camera)((seen, at, axes, middle, wanted))


@partial(compile_once, static=(0, 1))
def scatter_of_portion(
    key: ProgramKey,
    settings: CorrelationSettings,
    seen: Sightings,
    at: CameraUnknowns,
    theta: Float[AnyArray, "cameras k"],
) -> Float[Array, "cameras k k"]:
    """The covariance of the forms q of every camera of a portion under errors of the sizes θ."""

    def drawn(given: tuple[Sightings, CameraUnknowns, Array]) -> Float[Array, "k k"]:
        seen, at, theta = given
        spans, roots = _spans_and_roots(key.model, key.free, settings, seen, at)
        spans, roots = _single((spans, roots))
        e = roots.draw(_single(theta), jax.random.key(settings.estimation.seed), SUMS.draws)
        q = roots.forms(spans.residuals(e)).astype(float)
        away = q - q.mean(0)
        return away.T @ away / (SUMS.draws - 1)

    def of_camera(given: tuple[Sightings, CameraUnknowns, Array]) -> Float[Array, "k k"]:
        none = lambda _: jnp.zeros((len(COMPONENTS),) * 2)
        return jax.lax.cond(jnp.any(given[2] > 0), drawn, none, given)

    return key.for_every(of_camera)((seen, at, theta))


def _forms(
    model: CameraModel, settings: CorrelationSettings, seen: Sightings, at: CameraUnknowns
) -> ComponentForms:
    """vᵀV_k·v of one camera, with the correlations V of errors along tracks and of given points,
    without their roots."""
    used = jnp.asarray(seen.weight)
    by_axis, by_point = effects_of_object_points(model, seen, at)
    v = by_axis.swapaxes(0, 1)
    on_sensor, place = places_on_sensor(_computed(seen, v), used)
    of_view = jnp.einsum("vapc,vap->vc", displacements_by_view(on_sensor, used), v)
    by_view = [jnp.sum(of_view[:, of] ** 2) for of in BY_VIEW]
    K = correlation_of_views(at, used, settings.reach, seen)
    along_tracks = jnp.sum(jnp.einsum("vw,wap->vap", K, v) * v)
    # sums over leading axes, which are vectorised
    given, squares = given_points(used), jnp.sum(by_point**2, 1)
    K = correlation_of_given(jnp.asarray(seen.point), used, settings)
    point = jnp.sum(by_point * by_axis, (1, 2)) * given
    of_axes = jnp.sum((point @ K) * point, 1) / mean_squares_of_given(used, squares)
    of_points = [jnp.sum(of_axes[of]) for of in GIVEN_AXES]
    field = field_form(place, used, v, settings)
    q = jnp.stack([jnp.sum(v**2), field, *by_view, along_tracks, *of_points])
    parts: list[Any] = [q, jnp.sum(given).astype(float)]
    return ComponentForms(*parts)


def _computed(seen: Sightings, v: Float[Array, "views 2 points"]) -> Float[Array, "views points 2"]:
    """Computed image coordinates, in which effects are given: they have no share of the residuals
    (`correlated_errors.image_rows`)."""
    return jnp.asarray(seen.xy) + v.swapaxes(1, 2)


def _parts(
    model: CameraModel,
    free: tuple[int, ...],
    settings: CorrelationSettings,
    seen: Sightings,
    at: CameraUnknowns,
    axes: Float[Array, "3 3"],
    middle: Float[Array, "3"],
    wanted: Bool[Array, " k"],
) -> ComponentParts:
    """`parts_of_portion` of one camera."""
    spans = _spans(model, free, seen, at)
    used = jnp.asarray(seen.weight)
    on_sensor, place = places_on_sensor(_computed(seen, spans.v), used)

    def of_field() -> Covariances:
        splines, octaves, _ = fields_of_camera(place, used, settings)
        return _of_columns(*_onto_field(spans, splines, octaves), 2 * used.sum())

    def of_given(axes: slice) -> Covariances:
        K = correlation_of_given(jnp.asarray(seen.point), used, settings)
        by_point = effects_of_given(used, spans.by_point)[..., axes]
        return _of_given(spans, by_point, jnp.linalg.cholesky(K))

    def along_tracks() -> Covariances:
        K = correlation_of_views(at, used, settings.reach, seen)
        return _along_tracks(spans, used, K)

    views, k = spans.W.shape[0], spans.Z.shape[1]
    zero = (views, POSE, POSE), (views, POSE, k), (k, k), ()
    none = lambda: Covariances(*map(jnp.zeros, zero))
    if_wanted = lambda c, function: jax.lax.cond(wanted[c], function, none)
    found = [
        none(),
        if_wanted(FIELD, of_field),
        *_by_view(spans, displacements_by_view(on_sensor, used)),
        if_wanted(TRACKS, along_tracks),
        *(if_wanted(GIVEN + n, partial(of_given, of)) for n, of in enumerate(GIVEN_AXES)),
    ]
    interior = jnp.stack([_of_interior(spans, c) for c in found])
    slopes = jax.vmap(exterior_slopes, (0, 0, None, None))(at.rotation, at.shift, axes, middle)
    pose = jnp.stack([_of_poses(spans, slopes, c) for c in found])
    parts: list[Any] = [jnp.stack([c.remaining for c in found]), interior, pose]
    return ComponentParts(*parts)


class OntoSpans(NamedTuple):
    """W·F and Z·F of the field [.., axis and spline] and of the columns by view."""

    WB: Float[Array, "views 6 n"]
    ZB: Float[Array, "k n"]
    WF: Float[Array, "views 6 5"]
    ZF: Float[Array, "views k 5"]


def _spans(model: CameraModel, free: tuple[int, ...], seen: Sightings, at: CameraUnknowns) -> Spans:
    columns = [jnp.stack(axis, 1) for axis in design(model, free, seen, at)]
    rows = jnp.stack(columns, 2)  # [views, 6 + k + 1, 2, points]
    E, J, v = rows[:, :POSE], rows[:, POSE:-1], rows[:, -1]
    W, L = _orthonormal(E, jnp.asarray(seen.weight))
    WJ = _products(W, J)
    Z, R = _orthonormal_of_all(J - jnp.einsum("vek,veap->vkap", WJ, W))
    # ray = M·X + t: of a point as of the shift, turned
    turns = jax.vmap(matrix_from_quaternion)(at.rotation)
    by_point = [sum(turns[:, i, j, None, None] * E[:, i] for i in range(3)) for j in range(3)]
    return Spans(W, Z, L, R, WJ, v, jnp.stack(by_point, -1))


def _products(
    a: Float[Array, "views m 2 points"], b: Float[Array, "views n 2 points"]
) -> Float[Array, "views m n"]:
    """Of all rows of the views."""
    flat = lambda x: x.reshape(*x.shape[:2], -1)
    return flat(a) @ flat(b).swapaxes(1, 2)


def _spans_and_roots(
    model: CameraModel,
    free: tuple[int, ...],
    settings: CorrelationSettings,
    seen: Sightings,
    at: CameraUnknowns,
) -> tuple[Spans, Roots]:
    used = jnp.asarray(seen.weight)
    spans = _spans(model, free, seen, at)
    on_sensor, place = places_on_sensor(_computed(seen, spans.v), used)
    splines, octaves, gram = fields_of_camera(place, used, settings)
    by_view = displacements_by_view(on_sensor, used)
    by_point = effects_of_given(used, spans.by_point)
    points = jnp.linalg.cholesky(correlation_of_given(jnp.asarray(seen.point), used, settings))
    K = correlation_of_views(at, used, settings.reach, seen)
    views = root_of_views(K)
    return spans, Roots(used, splines, octaves, gram, by_view, views, by_point, points)


def _onto_field(
    spans: Spans,
    splines: Float[Array, "views points splines"],
    octaves: Float[Array, "splines splines"],
) -> tuple[Float[Array, "views 6 n"], Float[Array, "k n"]]:
    """W·F and Z·F of the field."""
    project = lambda A: jnp.einsum("veap,vps->veas", _single(A), splines) @ octaves
    flat = lambda A: A.reshape(*A.shape[:-2], -1)
    return flat(project(spans.W)), flat(project(spans.Z).sum(0))


def _project(spans: Spans, roots: Roots) -> OntoSpans:
    return OntoSpans(
        *_onto_field(spans, roots.splines, roots.octaves),
        jnp.einsum("veap,vapc->vec", spans.W, roots.by_view),
        jnp.einsum("vkap,vapc->vkc", spans.Z, roots.by_view),
    )


class FewColumns(NamedTuple):
    """S = FᵀM·F of the field and of the columns by view, by blocks."""

    field: Float[Array, "n n"]
    mixed: Float[Array, "m n"]
    by_view: Float[Array, "m m"]

    @staticmethod
    def of(roots: Roots, projected: OntoSpans) -> "FewColumns":
        WB, ZB, WF, ZF = projected
        views, columns = WF.shape[0], WF.shape[2]
        field = jax.scipy.linalg.block_diag(roots.gram, roots.gram)
        field = field - jnp.einsum("ves,vet->st", WB, WB) - ZB.T @ ZB
        mixed = jnp.einsum("vps,vapc->vacs", roots.splines, _single(roots.by_view)) @ roots.octaves
        mixed = mixed.swapaxes(1, 2).reshape(views, columns, -1)
        mixed = mixed - jnp.einsum("ves,vec->vcs", WB, WF) - jnp.einsum("ks,vkc->vcs", ZB, ZF)
        own = jnp.einsum("vapc,vapd->vcd", roots.by_view, roots.by_view)
        own = own - jnp.einsum("vec,ved->vcd", WF, WF)
        diagonal = jnp.arange(views)
        by_view = -jnp.einsum("vkc,wkd->vcwd", ZF, ZF)
        by_view = by_view.at[diagonal, :, diagonal, :].add(own)
        flat = views * columns
        return FewColumns(field, mixed.reshape(flat, -1), by_view.reshape(flat, flat))

    def sums(self, other: "FewColumns") -> Float[Array, "components components"]:
        """Sums of the products of the elements of the blocks of two, by components."""
        of_view = jnp.zeros((5, len(COMPONENTS)))
        for k, columns in enumerate(BY_VIEW, FIELD + 1):
            of_view = of_view.at[columns, k].set(1.0)
        each = jnp.tile(of_view, (len(self.by_view) // 5, 1))
        found = each.T @ (self.by_view * other.by_view) @ each
        with_field = each.T @ jnp.sum(self.mixed * other.mixed, 1)
        found = found.at[FIELD].add(with_field).at[:, FIELD].add(with_field)
        return found.at[FIELD, FIELD].add(jnp.sum(self.field * other.field))


def _signs(settings: CorrelationSettings, views: int, points: int) -> tuple[Array, Array]:
    """Random combinations of the columns of errors along tracks and of given points, the same of
    every camera."""
    keys = jax.random.split(jax.random.key(settings.estimation.seed))
    signs = lambda key, *shape: jax.random.rademacher(key, (SUMS.probes, *shape), dtype=float)
    return signs(keys[0], views, 2, points), signs(keys[1], 3, points)


def _traces(spans: Spans, roots: Roots, signs: tuple[Array, Array]) -> ComponentTraces:
    projected = _project(spans, roots)
    S, count = _single(FewColumns.of(roots, projected)), len(COMPONENTS)
    T, cubes = S.sums(S), jnp.zeros((count,) * 3)
    # S_ij·S_jk of every j
    through = FewColumns(S.field @ S.field, S.mixed @ S.field, S.mixed @ S.mixed.T)
    cubes = cubes.at[FIELD].set(S.sums(through))
    of_columns = np.arange(len(S.by_view)) % 5
    for k, columns in enumerate(BY_VIEW, FIELD + 1):
        some = np.flatnonzero((of_columns >= columns.start) & (of_columns < columns.stop))
        field, by_view = S.mixed[some], S.by_view[some]
        through = FewColumns(field.T @ field, by_view.T @ field, by_view.T @ by_view)
        cubes = cubes.at[k].set(S.sums(through))
    # of random combinations of the columns of the others
    masks = [jnp.zeros((3, 1)).at[axes].set(1.0) for axes in GIVEN_AXES]
    errors = [roots.along_tracks(signs[0]), *(roots.of_points(signs[1] * one) for one in masks)]
    remaining = jnp.stack([c.remaining for c in _covariances(spans, roots, projected)])
    spans, roots = _single((spans, roots))
    for k, e in zip(range(TRACKS, count), _single(errors)):
        u = spans.residuals(e)
        products = roots.products(u)
        found = roots.forms_of(u, products).mean(0)
        T = T.at[k].set(found)
        flat = [x.reshape(SUMS.probes, -1) / jnp.sqrt(SUMS.probes) for x in products[:2]]
        pairs = FewColumns(flat[0].T @ flat[0], flat[1].T @ flat[0], flat[1].T @ flat[1])
        cubes = cubes.at[k].set(S.sums(pairs))
        # half of them again: M·F·(Fᵀ·M·F·ξ)
        half = [x[: SUMS.probes // 2] for x in products]
        e = (
            roots.along_tracks(half[2])
            if k == TRACKS
            else roots.of_points(half[3] * _single(masks[k - GIVEN]))
        )
        z = spans.residuals(e)
        more = [x * y for x, y in zip(roots.products(z), half)]
        own = jnp.zeros(count).at[k].set(jnp.sum(z**2)).at[FIELD].set(jnp.sum(more[0]))
        for j, columns in enumerate(BY_VIEW, FIELD + 1):
            own = own.at[j].set(jnp.sum(more[1][..., columns]))
        cubes = cubes.at[k, k].set(own / (SUMS.probes // 2))
    # of two of them from the combinations of both
    both = (T[TRACKS:, TRACKS:] + T[TRACKS:, TRACKS:].T) / 2
    T = T.at[:, TRACKS:].set(T[TRACKS:].T).at[TRACKS:, TRACKS:].set(both)
    T = T.astype(float).at[0].set(remaining).at[:, 0].set(remaining)
    parts: list[Any] = [T, cubes.astype(float)]
    return ComponentTraces(*parts)


def _covariances(spans: Spans, roots: Roots, of: OntoSpans) -> list[Covariances]:
    """Of all components."""
    W, k = spans.W, spans.Z.shape[1]
    rows = 2 * roots.used.sum()
    own = jnp.einsum("veap,vfap->vef", W, W)
    return [
        Covariances(own, jnp.zeros((*W.shape[:2], k)), jnp.eye(k), rows),
        _of_columns(of.WB, of.ZB, rows),
        *_by_view(spans, roots.by_view),
        _along_tracks(spans, roots.used, roots.views @ roots.views.T),
        *(_of_given(spans, roots.by_point[..., axes], roots.points) for axes in GIVEN_AXES),
    ]


def _of_columns(
    WF: Float[Array, "views 6 n"], ZF: Float[Array, "k n"], trace: Float[Array, ""]
) -> Covariances:
    """Of columns F that all views share."""
    return Covariances(WF @ WF.swapaxes(1, 2), WF @ ZF.T, ZF @ ZF.T, trace)


def _by_view(spans: Spans, by_view: Float[Array, "views 2 points 5"]) -> list[Covariances]:
    """Of the components by view."""
    WF = jnp.einsum("veap,vapc->vec", spans.W, by_view)
    ZF = jnp.einsum("vkap,vapc->vkc", spans.Z, by_view)
    found = []
    for one in BY_VIEW:
        w, z = WF[..., one], ZF[..., one]
        wz = jnp.einsum("vec,vkc->vek", w, z)
        trace = jnp.sum(by_view[..., one] ** 2)
        zz = jnp.einsum("vkc,vlc->kl", z, z)
        found.append(Covariances(w @ w.swapaxes(1, 2), wz, zz, trace))
    return found


def _along_tracks(
    spans: Spans, used: Float[Array, "views points"], K: Float[Array, "views views"]
) -> Covariances:
    """Of errors along tracks, of the correlation K of the views, which is 1 in a view."""
    W, Z = spans.W, spans.Z
    own = jnp.einsum("veap,vfap->vef", W, W)
    near = jnp.einsum("vw,wkap->vkap", K, Z)
    wz, zz = jnp.einsum("veap,vkap->vek", W, near), jnp.einsum("vkap,vlap->kl", Z, near)
    return Covariances(own, wz, zz, 2 * used.sum())


def _of_given(
    spans: Spans, by_point: Float[Array, "views 2 points axes"], root: Float[Array, "points points"]
) -> Covariances:
    """Of errors of given points along some axes with a root of their correlation."""
    W, Z = spans.W, spans.Z
    WG = jnp.einsum("veap,vapd->vedp", W, by_point) @ root
    ZG = jnp.einsum("vkap,vapd->kdp", Z, by_point) @ root
    WG, ZG = WG.reshape(*W.shape[:2], -1), ZG.reshape(Z.shape[1], -1)
    return _of_columns(WG, ZG, jnp.sum(by_point**2))


def _of_interior(spans: Spans, c: Covariances) -> Float[Array, "k k"]:
    """The covariance of the interior orientation, R⁻ᵀ·ZVZᵀ·R⁻¹."""
    back = lambda b: jax.scipy.linalg.solve_triangular(spans.R.T, b, lower=False)
    return back(back(c.zz).T)


def _of_poses(
    spans: Spans, slopes: Float[Array, "views 6 6"], c: Covariances
) -> Float[Array, "views 6"]:
    """The variances of X0, Y0, Z0, ω, φ, κ of the views."""
    # W·F·ξ − W·Jᵢ·x = (W − B·Z)·F·ξ
    transposed = jax.scipy.linalg.solve_triangular(spans.R, spans.WJ.swapaxes(1, 2), lower=True)
    B = transposed.swapaxes(1, 2)
    mixed = c.wz @ B.swapaxes(1, 2)
    C = c.ww - mixed - mixed.swapaxes(1, 2) + B @ c.zz @ B.swapaxes(1, 2)
    # slopes·L⁻ᵀ
    S = jax.scipy.linalg.solve_triangular(spans.L, slopes.swapaxes(1, 2), lower=True)
    return jnp.einsum("vec,vef,vfc->vc", S, C, S)


def _orthonormal(
    E: Float[Array, "views 6 2 points"], used: Float[Array, "views points"]
) -> tuple[Float[Array, "views 6 2 points"], Float[Array, "views 6 6"]]:
    """Rows W that span those of every view, and L of EEᵀ = L·Lᵀ; of views without points W is
    zero."""
    N = _products(E, E)
    none = ~(used.sum(1) > 0)
    scale = jax.lax.rsqrt(jnp.where(none[:, None], 1.0, jnp.diagonal(N, axis1=1, axis2=2)))
    N = N * scale[:, :, None] * scale[:, None, :] + none[:, None, None] * jnp.eye(POSE)
    L = jnp.linalg.cholesky(N)
    eye = jnp.broadcast_to(jnp.eye(POSE), N.shape)
    inverse = jax.scipy.linalg.solve_triangular(L, eye, lower=True) * scale[:, None, :]
    return jnp.einsum("vef,vfap->veap", inverse, E), L / scale[:, :, None]


def _orthonormal_of_all(
    J: Float[Array, "views k 2 points"],
) -> tuple[Float[Array, "views k 2 points"], Float[Array, "k k"]]:
    """Rows Z that span those of all views together, and R of JJᵀ = R·Rᵀ."""
    N = jnp.sum(_products(J, J), 0)
    scale = jax.lax.rsqrt(jnp.diagonal(N))
    R = jnp.linalg.cholesky(N * scale[:, None] * scale)
    inverse = jax.scipy.linalg.solve_triangular(R, jnp.eye(len(R)), lower=True) * scale
    return jnp.einsum("kl,vlap->vkap", inverse, J), R / scale[:, None]
