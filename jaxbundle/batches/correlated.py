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
from jaxbundle.batches.compiled import ProgramKey, exterior_slopes
from jaxbundle.batches.error_roots import effects_of_points, fields_of_camera, root_of_views
from jaxbundle.batches.normal import POSE, CameraUnknowns, Sightings, design
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
    "given points",
)
FIELD, TRACKS, GIVEN = map(
    COMPONENTS.index, ("field on the sensor", "along tracks", "given points")
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


class ComponentSums(NamedTuple):
    """Of a camera: T [k, k] of the components, the traces of three of them
    (`leastsquares.quality.size_traces`), and q [k]; by component the covariance of the
    interior orientation, and the variances of X0, Y0, Z0, ω, φ, κ, for θ = 1; how many points are
    seen in two views or more; whether it has traces."""

    T: Float[np.ndarray, "*cameras k k"]
    cubes: Float[np.ndarray, "*cameras k k k"]
    q: Float[np.ndarray, "*cameras k"]
    interior: Float[np.ndarray, "*cameras k n n"]
    pose: Float[np.ndarray, "*cameras k views 6"]
    given: Float[np.ndarray, "*cameras"]
    traced: Bool[np.ndarray, "*cameras"]


class Spans(eqx.Module):
    """Orthonormal rows W of the views and Z of the camera (`component_sums`), their triangular
    factors L and R, W·Jᵢ, and ∂v/∂X of every image point."""

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
        field, of_view, track, point = self.products(u)
        square = lambda a: jnp.sum(a**2, range(1, a.ndim))
        parts = [square(u), square(field), *(square(of_view[..., of]) for of in BY_VIEW)]
        return jnp.stack([*parts, square(track), square(point)], 1)

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
        return e + size[GIVEN] * self.of_points(normal(4, 3, points))


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
def sums_of_portion(
    key: ProgramKey,
    settings: CorrelationSettings,
    seen: Sightings,
    at: CameraUnknowns,
    axes: Float[AnyArray, "cameras 3 3"],
    middle: Float[AnyArray, "cameras 3"],
    traced: Bool[AnyArray, " cameras"],
) -> ComponentSums:
    """The sums of every camera of a portion; `seen`: with the weights of the adjustment; `traced`:
    those whose traces are wanted; the others have the first row and column of T alone."""

    def of_camera(given: tuple[Sightings, CameraUnknowns, Array, Array, Array]) -> ComponentSums:
        return component_sums(key.model, key.free, settings, *given)

    return key.for_every(of_camera)((seen, at, axes, middle, traced))


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


def component_sums(
    model: CameraModel,
    free: tuple[int, ...],
    settings: CorrelationSettings,
    seen: Sightings,
    at: CameraUnknowns,
    axes: Float[Array, "3 3"],
    middle: Float[Array, "3"],
    traced: Bool[Array, ""],
) -> ComponentSums:
    """The sums of one camera from all its image points with weight."""
    spans, roots = _spans_and_roots(model, free, settings, seen, at)
    projected = _project(spans, roots)
    none = lambda *_: (jnp.zeros((len(COMPONENTS),) * 2), jnp.zeros((len(COMPONENTS),) * 3))
    T, cubes = jax.lax.cond(traced, partial(_traces, settings), none, spans, roots, projected)
    covariances = _covariances(spans, roots, projected)
    of_white = jnp.stack([c.remaining for c in covariances])
    T = T.at[0].set(of_white).at[:, 0].set(of_white)
    q = roots.forms(spans.v[None])[0]
    interior = jnp.stack([_of_interior(spans, c) for c in covariances])
    slopes = jax.vmap(exterior_slopes, (0, 0, None, None))(at.rotation, at.shift, axes, middle)
    pose = jnp.stack([_of_poses(spans, slopes, c) for c in covariances])
    given = jnp.sum(roots.used.sum(0) > 1)
    parts: list[Any] = [T, cubes, q, interior, pose, given.astype(float), traced]
    return ComponentSums(*parts)


class OntoSpans(NamedTuple):
    """W·F and Z·F of the field [.., axis and spline] and of the columns by view."""

    WB: Float[Array, "views 6 n"]
    ZB: Float[Array, "k n"]
    WF: Float[Array, "views 6 5"]
    ZF: Float[Array, "views k 5"]


def _spans_and_roots(
    model: CameraModel,
    free: tuple[int, ...],
    settings: CorrelationSettings,
    seen: Sightings,
    at: CameraUnknowns,
) -> tuple[Spans, Roots]:
    used = jnp.asarray(seen.weight)
    x, y = (jnp.stack(columns, -1) for columns in design(model, free, seen, at))
    rows = jnp.stack([x, y], 1)  # [views, 2, points, 6 + k + 1]
    E, J, v = rows[..., :POSE], rows[..., POSE:-1], rows[..., -1]
    W, L = _orthonormal(E, used)
    WJ = jnp.einsum("veap,vapk->vek", W, J)
    Z, R = _orthonormal_of_all(J - jnp.einsum("veap,vek->vapk", W, WJ))
    # ray = M·X + t: of a point as of the shift, turned
    turns = jax.vmap(matrix_from_quaternion)(at.rotation)
    by_point = jnp.einsum("vapi,vij->vapj", E[..., :3], turns)
    spans = Spans(W, Z, L, R, WJ, v, by_point)
    # at computed coordinates, which have no share of the residuals (`correlated_errors.image_rows`)
    computed = jnp.asarray(seen.xy) + v.swapaxes(1, 2)
    splines, octaves, gram, by_view = fields_of_camera(computed, used, settings)
    by_point, points = effects_of_points(jnp.asarray(seen.point), used, by_point, settings)
    views = root_of_views(at, used, settings.reach, seen)
    return spans, Roots(used, splines, octaves, gram, by_view, views, by_point, points)


def _project(spans: Spans, roots: Roots) -> OntoSpans:
    W, Z = spans.W, spans.Z
    project = lambda A: jnp.einsum("veap,vps->veas", _single(A), roots.splines) @ roots.octaves
    flat = lambda A: A.reshape(*A.shape[:-2], -1)
    return OntoSpans(
        flat(project(W)),
        flat(project(Z).sum(0)),
        jnp.einsum("veap,vapc->vec", W, roots.by_view),
        jnp.einsum("vkap,vapc->vkc", Z, roots.by_view),
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


def _traces(
    settings: CorrelationSettings, spans: Spans, roots: Roots, projected: OntoSpans
) -> tuple[Array, Array]:
    """T and tr(M·V_i·M·V_j·M·V_l), but for the independent part."""
    S, count = _single(FewColumns.of(roots, projected)), len(COMPONENTS)
    T, cubes = S.sums(S), jnp.zeros((count,) * 3)
    # S_ij·S_jk of every j
    through = FewColumns(S.field @ S.field, S.mixed @ S.field, S.mixed @ S.mixed.T)
    cubes = cubes.at[FIELD].set(S.sums(through))
    for k, columns in enumerate(BY_VIEW, FIELD + 1):
        some = (jnp.arange(len(S.by_view)) % 5)[:, None]
        some = ((some >= columns.start) & (some < columns.stop)).astype(S.by_view.dtype)
        field, by_view = some * S.mixed, some * S.by_view
        through = FewColumns(field.T @ S.mixed, by_view.T @ S.mixed, by_view.T @ S.by_view)
        cubes = cubes.at[k].set(S.sums(through))
    # of random combinations of the columns of the others
    keys = jax.random.split(jax.random.key(settings.estimation.seed))
    signs = lambda key, *shape: jax.random.rademacher(key, (SUMS.probes, *shape), dtype=float)
    errors = [
        roots.along_tracks(signs(keys[0], *spans.v.shape)),
        roots.of_points(signs(keys[1], 3, len(roots.points))),
    ]
    spans, roots = _single((spans, roots))
    for k, e in zip((TRACKS, GIVEN), _single(errors)):
        u = spans.residuals(e)
        products = roots.products(u)
        found = roots.forms(u).mean(0)
        T = T.at[k].set(found)
        flat = [x.reshape(SUMS.probes, -1) / jnp.sqrt(SUMS.probes) for x in products[:2]]
        pairs = FewColumns(flat[0].T @ flat[0], flat[1].T @ flat[0], flat[1].T @ flat[1])
        cubes = cubes.at[k].set(S.sums(pairs))
        # half of them again: M·F·(Fᵀ·M·F·ξ)
        half = [x[: SUMS.probes // 2] for x in products]
        e = roots.along_tracks(half[2]) if k == TRACKS else roots.of_points(half[3])
        z = spans.residuals(e)
        more = [x * y for x, y in zip(roots.products(z), half)]
        own = jnp.zeros(count).at[k].set(jnp.sum(z**2)).at[FIELD].set(jnp.sum(more[0]))
        for j, columns in enumerate(BY_VIEW, FIELD + 1):
            own = own.at[j].set(jnp.sum(more[1][..., columns]))
        cubes = cubes.at[k, k].set(own / (SUMS.probes // 2))
    T = T.at[:, TRACKS].set(T[TRACKS]).at[:, GIVEN].set(T[GIVEN])
    both = (T[TRACKS, GIVEN] + T[GIVEN, TRACKS]) / 2
    T = T.at[TRACKS, GIVEN].set(both).at[GIVEN, TRACKS].set(both)
    return T.astype(float), cubes.astype(float)


def _covariances(spans: Spans, roots: Roots, of: OntoSpans) -> list[Covariances]:
    """Of all components."""
    W, Z = spans.W, spans.Z
    WB, ZB, WF, ZF = of
    rows = 2 * roots.used.sum()
    own = jnp.einsum("veap,vfap->vef", W, W)
    k = Z.shape[1]
    found = [
        Covariances(own, jnp.zeros((*W.shape[:2], k)), jnp.eye(k), rows),
        Covariances(WB @ WB.swapaxes(1, 2), WB @ ZB.T, ZB @ ZB.T, rows),
    ]
    for one in BY_VIEW:
        w, z = WF[..., one], ZF[..., one]
        wz = jnp.einsum("vec,vkc->vek", w, z)
        trace = jnp.sum(roots.by_view[..., one] ** 2)
        zz = jnp.einsum("vkc,vlc->kl", z, z)
        found.append(Covariances(w @ w.swapaxes(1, 2), wz, zz, trace))
    # Z·V of errors along tracks: V is 1 in a view
    near = jnp.einsum("vw,wkap->vkap", roots.views @ roots.views.T, Z)
    wz, zz = jnp.einsum("veap,vkap->vek", W, near), jnp.einsum("vkap,vlap->kl", Z, near)
    found.append(Covariances(own, wz, zz, rows))
    WG = jnp.einsum("veap,vapd->vedp", W, roots.by_point) @ roots.points
    ZG = jnp.einsum("vkap,vapd->kdp", Z, roots.by_point) @ roots.points
    WG, ZG = WG.reshape(*W.shape[:2], -1), ZG.reshape(k, -1)
    trace = jnp.sum(roots.by_point**2)
    return [*found, Covariances(WG @ WG.swapaxes(1, 2), WG @ ZG.T, ZG @ ZG.T, trace)]


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
    E: Float[Array, "views 2 points 6"], used: Float[Array, "views points"]
) -> tuple[Float[Array, "views 6 2 points"], Float[Array, "views 6 6"]]:
    """Rows W that span the columns of every view, and L of EᵀE = L·Lᵀ; of views without points W is
    zero."""
    N = jnp.einsum("vape,vapf->vef", E, E)
    none = ~(used.sum(1) > 0)
    scale = jax.lax.rsqrt(jnp.where(none[:, None], 1.0, jnp.diagonal(N, axis1=1, axis2=2)))
    N = N * scale[:, :, None] * scale[:, None, :] + none[:, None, None] * jnp.eye(POSE)
    L = jnp.linalg.cholesky(N)
    solve = jax.vmap(lambda l, b: jax.scipy.linalg.solve_triangular(l, b, lower=True))
    views, _, points, _ = E.shape
    flat = (E * scale[:, None, None, :]).reshape(views, 2 * points, POSE).swapaxes(1, 2)
    return solve(L, flat).reshape(views, POSE, 2, points), L / scale[:, :, None]


def _orthonormal_of_all(
    J: Float[Array, "views 2 points k"],
) -> tuple[Float[Array, "views k 2 points"], Float[Array, "k k"]]:
    """Rows Z that span the columns of all views together, and R of JᵀJ = R·Rᵀ."""
    N = jnp.einsum("vapk,vapl->kl", J, J)
    scale = jax.lax.rsqrt(jnp.diagonal(N))
    R = jnp.linalg.cholesky(N * scale[:, None] * scale)
    flat = (J * scale).reshape(-1, len(scale)).T
    views, _, points, k = J.shape
    Z = jax.scipy.linalg.solve_triangular(R, flat, lower=True)
    return Z.reshape(k, views, 2, points).swapaxes(0, 1), R / scale[:, None]
