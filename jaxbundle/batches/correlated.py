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
    key: ProgramKey,
    settings: CorrelationSettings,
    sightings: Sightings,
    unknowns: CameraUnknowns,
    is_wanted: Bool[AnyArray, " cameras"],
) -> ComponentForms:
    """The forms of the cameras of a portion for which they are wanted; `sightings`: with the
    weights of the adjustment."""
    zero: list[Any] = [jnp.zeros(len(COMPONENTS)), jnp.zeros(())]
    no_forms = lambda _: ComponentForms(*zero)
    of_residuals = lambda camera: _forms(key.model, settings, *camera)
    of_camera = lambda camera: jax.lax.cond(camera[2], of_residuals, no_forms, camera[:2])
    return key.for_every(of_camera)((sightings, unknowns, is_wanted))


@partial(compile_once, static=(0, 1))
def traces_of_portion(
    key: ProgramKey,
    settings: CorrelationSettings,
    sightings: Sightings,
    unknowns: CameraUnknowns,
    is_wanted: Bool[AnyArray, " cameras"],
) -> ComponentTraces:
    """The traces of the cameras of a portion for which they are wanted."""
    number = len(COMPONENTS)
    zero: list[Any] = [jnp.zeros((number,) * n) for n in (2, 3)]
    no_traces = lambda _: ComponentTraces(*zero)
    signs = random_signs(settings, *sightings.weight.shape[1:])

    def traced(camera: tuple[Sightings, CameraUnknowns]) -> ComponentTraces:
        return traces_of_components(*spans_and_roots(key.model, key.free, settings, *camera), signs)

    of_camera = lambda camera: jax.lax.cond(camera[2], traced, no_traces, camera[:2])
    return key.for_every(of_camera)((sightings, unknowns, is_wanted))


@partial(compile_once, static=(0, 1))
def parts_of_portion(
    key: ProgramKey,
    settings: CorrelationSettings,
    sightings: Sightings,
    unknowns: CameraUnknowns,
    axes: Float[AnyArray, "cameras 3 3"],
    middle: Float[AnyArray, "cameras 3"],
    is_wanted: Bool[AnyArray, "cameras k"],
) -> ComponentParts:
    """What the wanted components give every camera of a portion; that of the independent part is
    the classical covariance, and left at zero."""
    number, k, views = len(COMPONENTS), len(key.free), sightings.weight.shape[1]
    shapes = (number,), (number, k, k), (number, views, POSE)
    zero: list[Any] = [jnp.zeros(shape) for shape in shapes]
    no_parts = lambda *_: ComponentParts(*zero)
    parts_of_camera = partial(_parts, key.model, key.free, settings)
    of_camera = lambda camera: jax.lax.cond(
        jnp.any(camera[-1][1:]), parts_of_camera, no_parts, *camera
    )
    return key.for_every(of_camera)((sightings, unknowns, axes, middle, is_wanted))


@partial(compile_once, static=(0, 1))
def scatter_of_portion(
    key: ProgramKey,
    settings: CorrelationSettings,
    sightings: Sightings,
    unknowns: CameraUnknowns,
    theta: Float[AnyArray, "cameras k"],
) -> Float[Array, "cameras k k"]:
    """The covariance of the forms q of every camera of a portion under errors of the sizes θ."""

    def covariance_of_draws(camera: tuple[Sightings, CameraUnknowns, Array]) -> Float[Array, "k k"]:
        sightings, unknowns, theta = camera
        spans, roots = spans_and_roots(key.model, key.free, settings, sightings, unknowns)
        spans, roots = in_single_precision((spans, roots))
        e = roots.draw(
            in_single_precision(theta), jax.random.key(settings.estimation.seed), SUMS.draws
        )
        q = roots.forms(spans.residuals(e)).astype(float)
        deviation = q - q.mean(0)
        return deviation.T @ deviation / (SUMS.draws - 1)

    def of_camera(camera: tuple[Sightings, CameraUnknowns, Array]) -> Float[Array, "k k"]:
        no_scatter = lambda _: jnp.zeros((len(COMPONENTS),) * 2)
        return jax.lax.cond(jnp.any(camera[2] > 0), covariance_of_draws, no_scatter, camera)

    return key.for_every(of_camera)((sightings, unknowns, theta))


def _forms(
    model: CameraModel,
    settings: CorrelationSettings,
    sightings: Sightings,
    unknowns: CameraUnknowns,
) -> ComponentForms:
    """vᵀV_k·v of one camera, with the correlations V of errors along tracks and of given points,
    without their roots."""
    is_used = jnp.asarray(sightings.weight)
    by_axis, by_point = effects_of_object_points(model, sightings, unknowns)
    v = by_axis.swapaxes(0, 1)
    on_sensor, place = places_on_sensor(computed_coordinates(sightings, v), is_used)
    of_view = jnp.einsum("vapc,vap->vc", displacements_by_view(on_sensor, is_used), v)
    by_view = [jnp.sum(of_view[:, columns] ** 2) for columns in BY_VIEW]
    K = correlation_of_views(unknowns, is_used, settings.reach, sightings)
    along_tracks = jnp.sum(jnp.einsum("vw,wap->vap", K, v) * v)
    # Sums over leading axes, which are vectorised.
    is_given, squares = given_points(is_used), jnp.sum(by_point**2, 1)
    K = correlation_of_given(jnp.asarray(sightings.point), is_used, settings)
    point = jnp.sum(by_point * by_axis, (1, 2)) * is_given
    of_axes = jnp.sum((point @ K) * point, 1) / mean_squares_of_given(is_used, squares)
    of_points = [jnp.sum(of_axes[columns]) for columns in GIVEN_AXES]
    field = field_form(place, is_used, v, settings)
    q = jnp.stack([jnp.sum(v**2), field, *by_view, along_tracks, *of_points])
    parts: list[Any] = [q, jnp.sum(is_given).astype(float)]
    return ComponentForms(*parts)


def _parts(
    model: CameraModel,
    free: tuple[int, ...],
    settings: CorrelationSettings,
    sightings: Sightings,
    unknowns: CameraUnknowns,
    axes: Float[Array, "3 3"],
    middle: Float[Array, "3"],
    is_wanted: Bool[Array, " k"],
) -> ComponentParts:
    """`parts_of_portion` of one camera."""
    spans = spans_of_camera(model, free, sightings, unknowns)
    is_used = jnp.asarray(sightings.weight)
    on_sensor, place = places_on_sensor(computed_coordinates(sightings, spans.v), is_used)

    def of_field() -> Covariances:
        splines, octaves, _ = fields_of_camera(place, is_used, settings)
        return covariances_of_columns(*onto_field(spans, splines, octaves), 2 * is_used.sum())

    def of_given(axes: slice) -> Covariances:
        K = correlation_of_given(jnp.asarray(sightings.point), is_used, settings)
        by_point = effects_of_given(is_used, spans.by_point)[..., axes]
        return covariances_of_given(spans, by_point, jnp.linalg.cholesky(K))

    def along_tracks() -> Covariances:
        K = correlation_of_views(unknowns, is_used, settings.reach, sightings)
        return covariances_along_tracks(spans, is_used, K)

    views, k = spans.W.shape[0], spans.Z.shape[1]
    zero = (views, POSE, POSE), (views, POSE, k), (k, k), ()
    no_covariances = lambda: Covariances(*map(jnp.zeros, zero))
    if_wanted = lambda c, function: jax.lax.cond(is_wanted[c], function, no_covariances)
    # Of those by view all three, or none.
    any_by_view = jnp.any(is_wanted[FIELD + 1 : TRACKS])
    by_view = jax.lax.cond(
        any_by_view,
        lambda: covariances_by_view(spans, displacements_by_view(on_sensor, is_used)),
        lambda: [no_covariances() for _ in BY_VIEW],
    )
    component_covariances = [
        no_covariances(),
        if_wanted(FIELD, of_field),
        *by_view,
        if_wanted(TRACKS, along_tracks),
        *(
            if_wanted(GIVEN + n, partial(of_given, axes_of_component))
            for n, axes_of_component in enumerate(GIVEN_AXES)
        ),
    ]
    interior = jnp.stack([covariance_of_interior(spans, c) for c in component_covariances])
    slopes = jax.vmap(exterior_slopes, (0, 0, None, None))(
        unknowns.rotation, unknowns.shift, axes, middle
    )
    pose = jnp.stack([variances_of_poses(spans, slopes, c) for c in component_covariances])
    parts: list[Any] = [jnp.stack([c.remaining for c in component_covariances]), interior, pose]
    return ComponentParts(*parts)
