"""Errors that image points of a camera of a batch share, and its σ under them.

The components are those of `adjustment.quality.correlated_errors`: a field on the sensor, principal
point, principal distance and affine distortion by view, errors along tracks. With the orthonormal
rows W of every view and Z of the camera that the poses and then the interior orientation span,

    M = 1 − WᵀW − ZᵀZ,        T_kj = ‖F_kᵀ·M·F_j‖²,        q_k = ‖F_kᵀ·v‖²

and with the triangular factors L of a view and R of the camera the effects of the errors F·ξ

    x = R⁻ᵀ·Z·F·ξ  (interior),        L⁻ᵀ·(W·F·ξ − W·Jᵢ·x)  (pose)

of which only products of small matrices are formed: no row of all observations is solved for.
The sizes θ ≥ 0 of T·θ = q are estimated for each camera, or for a whole batch from the sums of T
and q; the size of the independent part is always that of the camera.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.adjustment.quality.correlated_errors import DEFAULTS, CorrelationSettings
from jaxbundle.batches.compiled import ProgramKey, exterior_slopes
from jaxbundle.batches.normal import POSE, CameraUnknowns, Sightings, design
from jaxbundle.cameras import CameraModel
from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.leastsquares.quality.error_components import SizeEquations
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray

COMPONENTS = (
    "independent errors",
    "field on the sensor",
    "principal point by view",
    "principal distance by view",
    "affine by view",
    "along tracks",
)
# Columns of the components by view among five: displacements of x and y.
BY_VIEW = (slice(0, 2), slice(2, 3), slice(3, 5))
# Random combinations of the columns of errors along tracks: their share of a variance is right to
# √(2/64) = 18 %.
PROBES = 64


class ComponentSums(NamedTuple):
    """Of a camera: T [k, k] and q [k] of the components; by component the covariance of the
    interior orientation, and the variances of X0, Y0, Z0, ω, φ, κ, for θ = 1."""

    T: Float[AnyArray, "*cameras k k"]
    q: Float[AnyArray, "*cameras k"]
    interior: Float[AnyArray, "*cameras k n n"]
    pose: Float[AnyArray, "*cameras k views 6"]


@partial(compile_once, static=(0, 1))
def sums_of_portion(
    key: ProgramKey,
    octaves: tuple[tuple[int, int], ...],
    reach: float,
    seen: Sightings,
    at: CameraUnknowns,
    axes: Float[AnyArray, "cameras 3 3"],
    middle: Float[AnyArray, "cameras 3"],
) -> ComponentSums:
    """The sums of every camera of a portion; `seen`: with the weights of the adjustment."""

    def of_camera(given: tuple[Sightings, CameraUnknowns, Array, Array]) -> ComponentSums:
        return component_sums(key.model, key.free, octaves, reach, *given)

    return key.for_every(of_camera)((seen, at, axes, middle))


def component_sums(
    model: CameraModel,
    free: tuple[int, ...],
    octaves: tuple[tuple[int, int], ...],
    reach: float,
    seen: Sightings,
    at: CameraUnknowns,
    axes: Float[Array, "3 3"],
    middle: Float[Array, "3"],
) -> ComponentSums:
    """The sums of one camera from all its image points with weight."""
    used = jnp.asarray(seen.weight)
    views, points = used.shape
    x, y = (jnp.stack(columns, -1) for columns in design(model, free, seen, at))
    rows = jnp.stack([x, y], 1)  # [views, 2, points, 6 + k + 1]
    E, J, v = rows[..., :POSE], rows[..., POSE:-1], rows[..., -1]
    W, L = _orthonormal(E, used)
    WJ = jnp.einsum("veap,vapk->vek", W, J)
    remains = J - jnp.einsum("veap,vek->vapk", W, WJ)
    Z, R = _orthonormal_of_all(remains)
    # at computed coordinates, which have no share of the residuals (`correlated_errors.image_rows`)
    computed = jnp.asarray(seen.xy) + v.swapaxes(1, 2)
    field, by_view = _fields(computed, used, octaves)
    # W·F and Z·F: of the field [views, rows, axis, spline], of the five columns of every view
    WB = jnp.einsum("veap,vps->veas", W, field).reshape(views, POSE, -1)
    ZB = jnp.einsum("vkap,vps->kas", Z, field).reshape(Z.shape[1], -1)
    WF = jnp.einsum("veap,vapc->vec", W, by_view)
    ZF = jnp.einsum("vkap,vapc->kvc", Z, by_view)
    root = _track_root(at, used, reach, seen)
    u, Wt, Zt = _along_tracks(root, W, Z, used)
    # Fᵀ·M·F by blocks
    gram = jnp.einsum("vps,vpt->st", field, field)
    zero = jnp.zeros_like(gram)
    S_field = jnp.block([[gram, zero], [zero, gram]])
    S_field = S_field - jnp.einsum("ves,vet->st", WB, WB) - ZB.T @ ZB
    mixed = jnp.einsum("vps,vapc->asvc", field, by_view).reshape(-1, views, by_view.shape[-1])
    mixed = mixed - jnp.einsum("ves,vec->svc", WB, WF) - jnp.einsum("ks,kvc->svc", ZB, ZF)
    own = jnp.einsum("vapc,vapd->vcd", by_view, by_view) - jnp.einsum("vec,ved->vcd", WF, WF)
    S_view = -jnp.einsum("kvc,kwd->vcwd", ZF, ZF)
    diagonal = jnp.arange(views)
    S_view = S_view.at[diagonal, :, diagonal, :].add(own)
    track_by_field = jnp.einsum("vps,rvap->ras", field, u)
    track_by_view = jnp.einsum("vapc,rvap->rvc", by_view, u)
    track_by_track = jnp.einsum("vw,rvap->rwap", root, u)
    square = lambda a: jnp.sum(a**2)
    mean = lambda a: jnp.sum(a**2) / PROBES
    redundancy = 2 * used.sum() - POSE * (used.sum(1) > 0).sum() - len(free)
    parts = BY_VIEW
    T = jnp.zeros((len(COMPONENTS), len(COMPONENTS)))
    T = T.at[0, 0].set(redundancy).at[0, 1].set(jnp.trace(S_field)).at[1, 1].set(square(S_field))
    T = (
        T.at[0, 5]
        .set(mean(u))
        .at[1, 5]
        .set(mean(track_by_field))
        .at[5, 5]
        .set(mean(track_by_track))
    )
    for k, of in enumerate(parts, 2):
        T = T.at[0, k].set(jnp.einsum("vcvc->", S_view[:, of, :, of]))
        T = T.at[1, k].set(square(mixed[:, :, of])).at[k, 5].set(mean(track_by_view[:, :, of]))
        for j, other in enumerate(parts, 2):
            if j >= k:
                T = T.at[k, j].set(square(S_view[:, of, :, other]))
    T = jnp.triu(T) + jnp.triu(T, 1).T
    vB = jnp.einsum("vps,vap->as", field, v)
    vF = jnp.einsum("vapc,vap->vc", by_view, v)
    q = [square(v), square(vB), *(square(vF[:, of]) for of in parts)]
    q.append(square(jnp.einsum("vw,vap->wap", root, v)))
    # effects on the interior orientation, and through it on the poses
    inner = lambda z: jax.scipy.linalg.solve_triangular(R.T, z, lower=False)
    outer = lambda z: inner(z) @ inner(z).T
    k = Z.shape[1]
    flat = lambda z: z.reshape(k, -1)
    interior = [outer(jnp.eye(k)), outer(ZB), *(outer(flat(ZF[:, :, of])) for of in parts)]
    interior.append(outer(Zt) / PROBES)
    slopes = jax.vmap(exterior_slopes, (0, 0, None, None))(at.rotation, at.shift, axes, middle)

    def of_pose(wf: Float[Array, "views 6 n"], z: Float[Array, "k n"]) -> Float[Array, "views 6"]:
        change = wf - jnp.einsum("vek,kn->ven", WJ, inner(z))
        back = jax.vmap(lambda l, c: jax.scipy.linalg.solve_triangular(l.T, c, lower=False))
        return jnp.sum((slopes @ back(L, change)) ** 2, -1)

    each = jnp.eye(views)[:, None, :, None]
    wide = lambda f: (each * f[:, :, None, :]).reshape(views, POSE, -1)
    pose = [
        of_pose(jnp.broadcast_to(jnp.eye(POSE), (views, POSE, POSE)), jnp.zeros((k, POSE)))
        + of_pose(jnp.zeros((views, POSE, k)), jnp.eye(k)),
        of_pose(WB, ZB),
        *(of_pose(wide(WF[:, :, of]), flat(ZF[:, :, of])) for of in parts),
        of_pose(Wt, Zt) / PROBES,
    ]
    return ComponentSums(T, jnp.stack(q), jnp.stack(interior), jnp.stack(pose))


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


def _fields(
    xy: Float[Array, "views points 2"],
    used: Float[Array, "views points"],
    octaves: tuple[tuple[int, int], ...],
) -> tuple[Float[Array, "views points splines"], Float[Array, "views 2 points 5"]]:
    """Splines on the sensor of a mean square of one, and displacements by view: of the principal
    point, of the distance and affine ones, of size 1 at the edge of the measured area."""
    there = used[..., None] > 0
    low = jnp.min(jnp.where(there, xy, jnp.inf), (0, 1))
    high = jnp.max(jnp.where(there, xy, -jnp.inf), (0, 1))
    size = (high - low) / 2
    at = (xy - (low + high) / 2) / jnp.max(size)
    at = jnp.where(there, at, 0.0)
    half = size / jnp.max(size)
    B = jnp.concatenate([_splines(at, half, knots) for knots in octaves], -1) * used[..., None]
    B = B / jnp.sqrt(jnp.sum(B**2) / jnp.sum(used))
    x, y = at[..., 0] * used, at[..., 1] * used
    none = jnp.zeros_like(used)
    of_x = jnp.stack([used, none, x, x, y], -1)
    of_y = jnp.stack([none, used, y, -y, x], -1)
    return B, jnp.stack([of_x, of_y], 1)


def _splines(
    at: Float[Array, "views points 2"], half: Float[Array, "2"], knots: tuple[int, int]
) -> Float[Array, "views points columns*rows"]:
    """`correlated_errors.splines` of a program."""
    factors = []
    for axis, number in enumerate(knots):
        place = (at[..., axis] / half[axis] + 1) / 2 * (number - 3)
        d = jnp.abs(place[..., None] - (jnp.arange(number) - 1.0))
        inner, outer = 2 / 3 - d**2 + d**3 / 2, jnp.clip(2 - d, 0, None) ** 3 / 6
        factors.append(jnp.where(d < 1, inner, outer))
    found = factors[1][..., :, None] * factors[0][..., None, :]
    return found.reshape(*at.shape[:2], -1)


def _track_root(
    at: CameraUnknowns, used: Float[Array, "views points"], reach: float, seen: Sightings
) -> Float[Array, "views views"]:
    """A root of the correlation of the views by the distance of their stations."""
    M = jax.vmap(matrix_from_quaternion)(at.rotation)
    station = -jnp.einsum("vji,vj->vi", M, at.shift)
    X = jnp.asarray(seen.point)
    away = jnp.linalg.norm(X[None] - station[:, None], axis=2)
    depth = jnp.nanmedian(jnp.where(used > 0, away, jnp.nan))
    apart = jnp.linalg.norm(station[:, None] - station, axis=2) / (reach * depth)
    K = jnp.clip(1 - apart, 0, None) ** 4 * (4 * apart + 1)
    w, U = jnp.linalg.eigh(K)
    return U * jnp.sqrt(jnp.clip(w, 0, None))


def _along_tracks(
    root: Float[Array, "views views"],
    W: Float[Array, "views 6 2 points"],
    Z: Float[Array, "views k 2 points"],
    used: Float[Array, "views points"],
) -> tuple[Array, Array, Array]:
    """M·F·ξ [probes, views, 2, points] of random signs ξ, W·F·ξ [views, 6, probes], Z·F·ξ."""
    views, _, _, points = W.shape
    signs = jax.random.rademacher(jax.random.key(0), (PROBES, views, 2, points), dtype=float)
    e = jnp.einsum("vw,rwap->rvap", root, signs) * used[:, None]
    We, Ze = jnp.einsum("veap,rvap->ver", W, e), jnp.einsum("vkap,rvap->kr", Z, e)
    u = e - jnp.einsum("veap,ver->rvap", W, We) - jnp.einsum("vkap,kr->rvap", Z, Ze)
    return u, We, Ze


class BatchErrors(NamedTuple):
    """Sizes √θ of the `COMPONENTS` [cameras, k] (NaN where a camera cannot show one), and of every
    camera the covariance of the interior orientation and the variances of the poses under them."""

    sizes: Float[np.ndarray, "cameras k"]
    covariance: Float[np.ndarray, "cameras n n"]
    pose: Float[np.ndarray, "cameras views 6"]


def batch_errors(
    sums: ComponentSums,
    views: np.ndarray,
    points: np.ndarray,
    together: bool,
    settings: CorrelationSettings = DEFAULTS,
) -> BatchErrors:
    """σ of all cameras under errors that their image points share.

    **Arguments:** `sums` of all cameras, arrays of the host; `views` and image `points` used of
    each; `together`: one set of sizes for all cameras, else one for each. A camera with fewer than
    `settings.min_images` views has no components by view, with fewer image points no field.
    """
    T, q, interior, pose = (np.asarray(x) for x in sums)
    cameras, k = q.shape
    shown = np.ones((cameras, k), bool)
    enough = views >= settings.min_images
    shown[:, 1:5] = enough[:, None]
    shown[:, 1] &= points >= settings.min_points_of_field
    shown[:, 5] = views > 1
    shown &= np.isfinite(q) & np.isfinite(T).all(2)
    theta = np.full((cameras, k), np.nan)
    critical = settings.estimation.critical(k - 1)
    if together:
        good = shown.all(1)
        if good.any():
            # of all cameras that show every component; others take these sizes over
            found = SizeEquations(T[good].sum(0), False, critical).solve(q[good].sum(0))[0]
            theta[shown[:, 0]] = found
            shared = np.einsum("nk,nk->n", T[:, 0, 1:], theta[:, 1:])
            with np.errstate(invalid="ignore"):
                theta[:, 0] = np.clip((q[:, 0] - shared) / T[:, 0, 0], 0, None)
    else:
        for n in np.flatnonzero(shown[:, 0]):
            of = np.flatnonzero(shown[n])
            equations = SizeEquations(T[n][np.ix_(of, of)], False, critical)
            theta[n, of] = equations.solve(q[n][of])[0]
    known = np.nan_to_num(theta)
    none = np.isnan(theta).all(1)
    covariance = np.einsum("nk,nkij->nij", known, np.nan_to_num(interior))
    variance = np.einsum("nk,nkvi->nvi", known, np.nan_to_num(pose))
    covariance[none], variance[none] = np.nan, np.nan
    return BatchErrors(np.sqrt(theta), covariance, variance)
