"""A camera of one model fitted to the rays of another: least squares over the image.

Points of a grid over the image have rays by the source. The target's parameters minimise

    Σ |image of the ray by the target − point|²  →  min        in the measured image

No rotation is estimated: exterior orientations are unchanged.
"""

from collections.abc import Callable, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Real

from jaxbundle.cameras.convert_exact import (
    CORRECTIONS,
    DISTORTIONS,
    Sizes,
    Values,
    distortion,
    invert_radial,
    normalised_correction,
)
from jaxbundle.cameras.convert_wide import as_stereographic
from jaxbundle.cameras.model import CameraModel, image_ray, project
from jaxbundle.cameras.parameters import default_parameters
from jaxbundle.cameras.pixel_frame import between_frames
from jaxbundle.float64 import local_x64
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Numbers

# Parameters fitted in addition to those free by default.
MORE_FITTED = {"brown": ("b1", "b2"), "brown-projected": ("b1", "b2"), "usgs": ("K4",)}

# Columns and rows of the points. Measured on `brown` fitted to an `opencv` of 1920 × 1080 pixels of
# 3 µm, as the RMS difference over a grid of 129 × 97: 0.182 µm; with half of the columns and rows
# 0.189, with double 0.180 in four times the time.
GRID = (33, 25)

# σ of the points of the grid beside the priors of a model (splines), in its unit: a thousandth of a
# pixel, so that knots with points move by less than 1e-6 pixels for their priors.
FIT_SIGMA = 1e-3


def fitted_parameters(model: CameraModel) -> tuple[str, ...]:
    """The parameters of a model fitted by default; all of them are separable."""
    return (*model.free, *MORE_FITTED.get(model.name, ()))


def image_grid(low: Numbers, high: Numbers) -> Float[np.ndarray, "points 2"]:
    """Points of a rectangle, including its edges."""
    columns, rows = (np.linspace(a, b, n) for a, b, n in zip(low, high, GRID))
    return np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)


def rays_of(
    model: CameraModel, values: Values, xy: Real[AnyArray, "points 2"] | Sequence
) -> Float[np.ndarray, "points 3"]:
    """Rays of measured image points; NaN if there are none."""
    with local_x64():
        return np.asarray(_rays(model, _order(model, values), np.asarray(xy, float)))


def images_of(
    model: CameraModel, values: Values, rays: Real[AnyArray, "points 3"] | Sequence
) -> Float[np.ndarray, "points 2"]:
    """Measured images of rays; NaN if there are none."""
    with local_x64():
        return np.asarray(_images(model, _order(model, values), np.asarray(rays, float)))


def come_back(
    model: CameraModel,
    values: Values,
    xy: Float[np.ndarray, "points 2"],
    rays: Float[np.ndarray, "points 3"],
) -> Bool[np.ndarray, " points"]:
    """Which points are the images of their rays: beyond the radius where a correction turns back,
    its rays belong to other points."""
    # 1e-9 of the image: rounding along the ray and back, 1e-5 pixels.
    return np.abs(images_of(model, values, rays) - xy).max(1) < 1e-9 * np.ptp(xy)


def fit_parameters(
    model: CameraModel,
    rays: Float[np.ndarray, "points 3"],
    xy: Float[np.ndarray, "points 2"],
    starts: Sequence[Values],
    free: Sequence[str] = (),
) -> dict[str, float]:
    """The parameters of a model that fit rays to their images.

    Parameters with a limited range (`CameraModel.ranges`) stay in it.

    **Arguments:** `xy` in the model's unit and axes; `starts` complete sets of start values, the
    best of them is used; `free` fitted parameters (`fitted_parameters` of the model if empty).

    **Raises:** `ValueError` if no start has an image of every ray, or the fit fails numerically.
    """
    from scipy.optimize import least_squares

    free_columns = [model.parameters.index(name) for name in free or fitted_parameters(model)]
    cost = lambda p: float(np.square(_images(model, p, rays) - xy).sum())
    with local_x64():
        # `fmin`: a start without an image of every ray costs NaN, more than any other.
        cost_or_infinity = lambda p: np.fmin(cost(p), np.inf)
        start = min((_order(model, values) for values in starts), key=cost_or_infinity)
        if not np.isfinite(cost(start)):
            has_images = [
                np.isfinite(_images(model, _order(model, v), rays)).all(1) for v in starts
            ]
            raise ValueError(_without_images(model, rays, max(has_images, key=np.sum)))

        def complete(q: Float[np.ndarray, " free"]) -> Float[np.ndarray, " parameters"]:
            p = start.copy()
            p[free_columns] = q
            return p

        low, high = _bounds(model, free_columns)
        start[free_columns] = np.clip(start[free_columns], low, high)
        # Knots at the edge of the image, which no point determines, stay near the start; without
        # this they became thousands of radians for the sake of 0.01 pixels.
        prior = np.array(
            [FIT_SIGMA / dict(model.prior).get(model.parameters[j], np.inf) for j in free_columns]
        )
        ridge, start_of_ridge = np.diag(prior)[prior > 0], start[free_columns]
        differences = lambda q: np.asarray(_images(model, complete(q), rays) - xy).ravel()
        residuals = lambda q: np.concatenate([differences(q), ridge @ (q - start_of_ridge)])
        # All columns are computed: one program for any choice of free parameters.
        slopes = lambda q: np.asarray(_jacobian(model, complete(q), rays))[..., free_columns]
        try:
            fit = least_squares(
                residuals,
                start[free_columns],
                lambda q: np.concatenate([slopes(q).reshape(-1, len(free_columns)), ridge]),
                x_scale="jac",
                # To rounding, so that a camera that the target can express is found exactly.
                ftol=1e-15,
                xtol=1e-15,
                gtol=1e-15,
                # A fit that needs more has no minimum in the range.
                max_nfev=200,
                bounds=(low, high),
            )
        except np.linalg.LinAlgError as error:
            raise ValueError(f"the fit failed: {error}") from None
    return dict(zip(model.parameters, complete(fit.x).tolist()))


def _without_images(
    model: CameraModel, rays: Float[np.ndarray, "points 3"], has_image: Bool[np.ndarray, " points"]
) -> str:
    """What to say where a model has no image of some rays."""
    axis = rays[np.hypot(rays[:, 0], rays[:, 1]).argmin()] * [0.0, 0.0, 1.0]
    cosine = rays @ axis / (np.linalg.norm(rays, axis=1) * np.linalg.norm(axis))
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    reach = f"up to {angle[has_image].max():.1f}°" if has_image.any() else "none"
    return (
        f"{model.name} has no image of the whole area: it has rays up to {angle.max():.1f}° from "
        f"the axis, of which the model has images of {reach}; choose one with a larger field"
    )


def _bounds(
    model: CameraModel, columns: Sequence[int]
) -> tuple[Float[np.ndarray, " chosen"], Float[np.ndarray, " chosen"]]:
    """Valid ranges of the parameters, with a small margin inside."""
    ends = [dict(model.ranges).get(model.parameters[j], (-np.inf, np.inf)) for j in columns]
    low, high = np.array(ends, float).reshape(-1, 2).T
    width = high - low
    # A thousandth of the range: at its end itself (α = 1, ξ = −1) formulas divide by 0.
    margin = 1e-3 * np.where(np.isfinite(width), width, 0.0)
    return low + margin, high - margin


def start_values(
    source: CameraModel, values: Values, target: CameraModel, sizes: Sizes, r0: float = 0.0
) -> list[dict[str, float]]:
    """Start values of the target: without distortion; with that of the source to the first orders,
    if the terms have counterparts; and as a stereographic camera, which has images beyond 90°."""
    shift, step = between_frames(source, target, *sizes)
    values_of = lambda names: np.array([values[name] for name in names])
    focal = values_of(source.principal_distance) * np.abs(step) * magnification(source, values)
    point = shift + step * (values_of(source.principal_point) if source.principal_point else 0.0)
    plain = default_parameters(target)
    conventions = {"format_factor": values.get("format_factor")} | ({"r0": r0} if r0 else {})
    plain |= {n: v for n, v in conventions.items() if v and n in target.never_free}
    distances = target.principal_distance
    principal_distances = focal if len(distances) == 2 else [focal.mean()] * 2
    # A fisheye's polynomial in tan θ has no image at 90°; the stereographic camera has one
    # everywhere.
    wide: dict[str, float] = dict(zip(("fx", "fy"), principal_distances))
    wide |= dict(zip(("cx", "cy"), point))
    focal = focal / magnification(target, plain)
    plain |= dict(zip(distances, focal if len(distances) == 2 else [focal.mean()]))
    plain |= dict(zip(target.principal_point, point))
    plain = {name: plain[name] for name in target.parameters}
    k, p1, p2 = _first_orders(source, values)
    # A correction maps measured to ideal, a distortion ideal to measured: inverse series.
    backward = (source.name in CORRECTIONS) != (target.name in CORRECTIONS)
    if backward:
        k, p1, p2 = invert_radial(k), -p1, -p2
    c = focal.mean()
    if target.name in ("opencv", "snavely"):
        terms = {"k1": k[0], "k2": k[1], "k3": k[2], "p1": p1, "p2": p2}
    elif target.name in (*CORRECTIONS, "brown-projected") and target.name != "bingo":
        terms = {f"K{i}": k[i - 1] / c ** (2 * i) for i in (1, 2, 3)}
        terms |= {"P1": p2 / c, "P2": -p1 / c}
    else:
        terms = {}
    starts = [plain, plain | {n: float(v) for n, v in terms.items() if n in target.parameters}]
    return starts + (as_stereographic(wide, target) if target.wide else [])


def magnification(model: CameraModel, values: Values) -> float:
    """The scale of the image on the axis, in principal distances."""
    if model.magnification is None:
        return 1.0
    return float(model.magnification([values.get(name, 1.0) for name in model.parameters]))


def _first_orders(source: CameraModel, values: Values) -> tuple[tuple[float, ...], float, float]:
    """k1 … k3, p1, p2 of the source's formula, for the principal distance 1 and v down."""
    if source.name in DISTORTIONS:
        common = distortion(source, values, sizes=((1, 1), (1, 1)))
    elif source.name in CORRECTIONS:
        common = normalised_correction(values)
    else:
        return (0.0, 0.0, 0.0), 0.0, 0.0
    return tuple(common[f"k{i}"] for i in (1, 2, 3)), common["p1"], common["p2"]


def _order(model: CameraModel, values: Values) -> Float[np.ndarray, " parameters"]:
    return np.array([values[name] for name in model.parameters], float)


def _one_image(
    model: CameraModel, p: Float[AnyArray, " parameters"], ray: Float[Array, "3"]
) -> Float[Array, "2"]:
    return jnp.stack(project(model, tuple(p), *ray))


@partial(compile_once, static=0)
def _rays(
    model: CameraModel, p: Float[AnyArray, " parameters"], xy: Float[AnyArray, "points 2"]
) -> Float[Array, "points 3"]:
    return jax.vmap(lambda xy: jnp.stack(image_ray(model, tuple(p), *xy)))(xy)


@partial(compile_once, static=0)
def _images(
    model: CameraModel, p: Float[AnyArray, " parameters"], rays: Float[AnyArray, "points 3"]
) -> Float[Array, "points 2"]:
    return jax.vmap(lambda ray: _one_image(model, p, ray))(rays)


@partial(compile_once, static=0)
def _jacobian(
    model: CameraModel, p: Float[AnyArray, " parameters"], rays: Float[AnyArray, "points 3"]
) -> Float[Array, "points 2 parameters"]:
    derivative: Callable = jax.jacfwd(_one_image, 1)
    return jax.vmap(lambda ray: derivative(model, p, ray))(rays)
