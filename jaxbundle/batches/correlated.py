"""Errors that image points of a camera of a batch share, and its σ under them.

The components are those of `adjustment.quality.correlated_errors`: a field on the sensor, principal
point, principal distance and affine distortion by view, errors along tracks, errors of the given
points.

Three programs, for each only the cameras and components that need it: q_k = ‖F_kᵀ·v‖² of all
cameras, without any span or root (0.45 ms for 20 views of 88 points); T (`error_traces`), of some
of a batch with sizes in common (6 ms); the covariances (`error_covariances`) that components of
θ > 0 give (0.55 ms).
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbundle.adjustment.quality.correlated_errors import CorrelationSettings
from jaxbundle.batches.compiled import ProgramKey, exterior_slopes
from jaxbundle.batches.error_covariances import (
    Covariances,
    covariance_of_interior,
    covariances_along_tracks,
    covariances_by_view,
    covariances_of_columns,
    covariances_of_given,
    onto_field,
    variances_of_poses,
)
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
)
from jaxbundle.batches.error_spans import (
    BY_VIEW,
    COMPONENTS,
    FIELD,
    GIVEN,
    TRACKS,
    computed_coordinates,
    in_single_precision,
    spans_and_roots,
    spans_of_camera,
)
from jaxbundle.batches.error_traces import (
    SUMS,
    ComponentTraces,
    random_signs,
    traces_of_components,
)
from jaxbundle.batches.normal import (
    POSE,
    CameraUnknowns,
    Sightings,
    effects_of_object_points,
)
from jaxbundle.cameras import CameraModel
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray


class ComponentForms(NamedTuple):
    """The quadratic forms q [k] of the residuals of a camera, and how many points are seen in two
    views or more."""

    q: Float[np.ndarray, "*cameras k"]
    given: Float[np.ndarray, "*cameras"]


class ComponentParts(NamedTuple):
    """What components of θ = 1 give a camera: `remaining`, their tr(M·V) in its vᵀv; the covariance
    of the interior orientation, and the variances of X0, Y0, Z0, ω, φ, κ; zero where they are not
    wanted."""

    remaining: Float[np.ndarray, "*cameras k"]
    interior: Float[np.ndarray, "*cameras k n n"]
    pose: Float[np.ndarray, "*cameras k views 6"]


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
    signs = random_signs(settings, *seen.weight.shape[1:])

    def traced(given: tuple[Sightings, CameraUnknowns]) -> ComponentTraces:
        return traces_of_components(*spans_and_roots(key.model, key.free, settings, *given), signs)

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
        spans, roots = spans_and_roots(key.model, key.free, settings, seen, at)
        spans, roots = in_single_precision((spans, roots))
        e = roots.draw(
            in_single_precision(theta), jax.random.key(settings.estimation.seed), SUMS.draws
        )
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
    on_sensor, place = places_on_sensor(computed_coordinates(seen, v), used)
    of_view = jnp.einsum("vapc,vap->vc", displacements_by_view(on_sensor, used), v)
    by_view = [jnp.sum(of_view[:, of] ** 2) for of in BY_VIEW]
    K = correlation_of_views(at, used, settings.reach, seen)
    along_tracks = jnp.sum(jnp.einsum("vw,wap->vap", K, v) * v)
    # Sums over leading axes, which are vectorised.
    given, squares = given_points(used), jnp.sum(by_point**2, 1)
    K = correlation_of_given(jnp.asarray(seen.point), used, settings)
    point = jnp.sum(by_point * by_axis, (1, 2)) * given
    of_axes = jnp.sum((point @ K) * point, 1) / mean_squares_of_given(used, squares)
    of_points = [jnp.sum(of_axes[of]) for of in GIVEN_AXES]
    field = field_form(place, used, v, settings)
    q = jnp.stack([jnp.sum(v**2), field, *by_view, along_tracks, *of_points])
    parts: list[Any] = [q, jnp.sum(given).astype(float)]
    return ComponentForms(*parts)


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
    spans = spans_of_camera(model, free, seen, at)
    used = jnp.asarray(seen.weight)
    on_sensor, place = places_on_sensor(computed_coordinates(seen, spans.v), used)

    def of_field() -> Covariances:
        splines, octaves, _ = fields_of_camera(place, used, settings)
        return covariances_of_columns(*onto_field(spans, splines, octaves), 2 * used.sum())

    def of_given(axes: slice) -> Covariances:
        K = correlation_of_given(jnp.asarray(seen.point), used, settings)
        by_point = effects_of_given(used, spans.by_point)[..., axes]
        return covariances_of_given(spans, by_point, jnp.linalg.cholesky(K))

    def along_tracks() -> Covariances:
        K = correlation_of_views(at, used, settings.reach, seen)
        return covariances_along_tracks(spans, used, K)

    views, k = spans.W.shape[0], spans.Z.shape[1]
    zero = (views, POSE, POSE), (views, POSE, k), (k, k), ()
    none = lambda: Covariances(*map(jnp.zeros, zero))
    if_wanted = lambda c, function: jax.lax.cond(wanted[c], function, none)
    found = [
        none(),
        if_wanted(FIELD, of_field),
        *covariances_by_view(spans, displacements_by_view(on_sensor, used)),
        if_wanted(TRACKS, along_tracks),
        *(if_wanted(GIVEN + n, partial(of_given, of)) for n, of in enumerate(GIVEN_AXES)),
    ]
    interior = jnp.stack([covariance_of_interior(spans, c) for c in found])
    slopes = jax.vmap(exterior_slopes, (0, 0, None, None))(at.rotation, at.shift, axes, middle)
    pose = jnp.stack([variances_of_poses(spans, slopes, c) for c in found])
    parts: list[Any] = [jnp.stack([c.remaining for c in found]), interior, pose]
    return ComponentParts(*parts)
