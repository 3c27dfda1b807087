"""The roots of the error components of a camera of a batch, as programs (`correlated`).

The formulas are those of `adjustment.quality.correlated_errors` and `given_points`, without
indices: arrays are [views, points], masked.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxbundle.adjustment.quality.correlated_errors import (
    CorrelationSettings,
    cubic_spline,
    root_of_octaves,
    squares_of_splines,
)
from jaxbundle.adjustment.quality.given_points import correlation_of_points, wendland
from jaxbundle.batches.normal import CameraUnknowns, Sightings
from jaxbundle.geometry import matrix_from_quaternion

# Principal axes of the object in each component of given points: the normal of the plane that fits
# them is the last.
GIVEN_AXES = (slice(0, 2), slice(2, 3))


def places_on_sensor(
    xy: Float[Array, "views points 2"], is_used: Float[Array, "views points"]
) -> tuple[Float[Array, "views points 2"], Float[Array, "views points 2"]]:
    """Where image points are in the measured area: from its middle, in half its longer side (0 if
    invisible); and from 0 to 1 over each side."""
    has_point = is_used[..., None] > 0
    low = jnp.min(jnp.where(has_point, xy, jnp.inf), (0, 1))
    high = jnp.max(jnp.where(has_point, xy, -jnp.inf), (0, 1))
    size = (high - low) / 2
    normalised = (xy - (low + high) / 2) / jnp.max(size)
    normalised = jnp.where(has_point, normalised, 0.0)
    return normalised, (normalised / (size / jnp.max(size)) + 1) / 2


def mean_square_of_octaves(
    place: Float[Array, "views points 2"],
    is_used: Float[Array, "views points"],
    settings: CorrelationSettings,
) -> Float[Array, ""]:
    """That of the sum of all octaves of splines, Σ_i Σ_j (x_i·y_j)² = Σ_i x_i²·Σ_j y_j²."""
    total = jnp.zeros(())
    for octave in settings.octaves_of_knots:
        x, y = (squares_of_splines(place[..., k], octave[k]) for k in (0, 1))
        total += jnp.sum(is_used * x * y)
    return total / jnp.sum(is_used)


def splines(
    place: Float[Array, "views points"], number: int
) -> Float[Array, "views number points"]:
    """`correlated_errors.cubic_splines` with image points, of which there are many, along the last
    axis: operations along it are vectorised."""
    middle = jnp.arange(number, dtype=place.dtype)[:, None] - 1
    return jnp.asarray(cubic_spline((place * (number - 3))[:, None] - middle))


def fields_of_camera(
    place: Float[Array, "views points 2"],
    is_used: Float[Array, "views points"],
    settings: CorrelationSettings,
) -> tuple[
    Float[Array, "views splines points"],
    Float[Array, "splines splines"],
    Float[Array, "splines splines"],
]:
    """The finest splines B on the sensor, in single precision, and the root R of all octaves in
    them, of a mean square of one, with (BR)ᵀBR."""
    of_sides = lambda place: tuple(
        splines(place[..., k], number) for k, number in enumerate(settings.knots)
    )
    # Not computed again for every product.
    x, y = jax.lax.optimization_barrier(of_sides(place.astype(jnp.float32)))
    B = (y * is_used[:, None].astype(jnp.float32))[:, :, None] * x[:, None]
    B = B.reshape(len(B), -1, B.shape[-1])
    square = mean_square_of_octaves(place, is_used, settings)
    octaves = jnp.asarray(root_of_octaves(settings)) / jnp.sqrt(square)
    x, y = of_sides(place)
    gram = _gram_of_products(_of_all_views(x), _of_all_views(y * is_used[:, None]))
    return B, octaves, octaves.T @ gram @ octaves


def field_form(
    place: Float[Array, "views points 2"],
    is_used: Float[Array, "views points"],
    v: Float[Array, "views 2 points"],
    settings: CorrelationSettings,
) -> Float[Array, ""]:
    """‖(BR)ᵀv‖² of the splines and octaves of `fields_of_camera`, as products of x and of y."""
    x, y = (_of_all_views(splines(place[..., k], n)) for k, n in enumerate(settings.knots))
    residual = _of_all_views(v)
    products = [(y * residual_axis) @ x.T for residual_axis in residual]
    of_octaves = jnp.stack(products).reshape(2, -1) @ root_of_octaves(settings)
    return jnp.sum(of_octaves**2) / mean_square_of_octaves(place, is_used, settings)


def _of_all_views(x: Float[Array, "views rows points"]) -> Float[Array, "rows rays"]:
    return x.swapaxes(0, 1).reshape(x.shape[1], -1)


def displacements_by_view(
    normalised: Float[Array, "views points 2"], is_used: Float[Array, "views points"]
) -> Float[Array, "views 2 points 5"]:
    """Displacements by view: of the principal point, of the distance and affine ones, of size 1 at
    the edge of the measured area."""
    x, y = normalised[..., 0] * is_used, normalised[..., 1] * is_used
    zeros = jnp.zeros_like(is_used)
    of_x = jnp.stack([is_used, zeros, x, x, y], -1)
    of_y = jnp.stack([zeros, is_used, y, -y, x], -1)
    return jnp.stack([of_x, of_y], 1)


def _gram_of_products(
    x: Float[Array, "columns rays"], y: Float[Array, "rows rays"]
) -> Float[Array, "splines splines"]:
    """BᵀB of the products B of splines of x and of y, of which only neighbours overlap."""
    (pairs_x, number_x), (pairs_y, number_y) = (_neighbours(len(a)) for a in (x, y))
    product = lambda a, pairs: a[pairs[0]] * a[pairs[1]]
    products_of_pairs = product(x, pairs_x) @ product(y, pairs_y).T
    products_of_pairs = jnp.pad(products_of_pairs, [(0, 1), (0, 1)])  # those that do not overlap
    full = products_of_pairs[number_x[None, :, None, :], number_y[:, None, :, None]]
    return full.reshape(number_x.shape[0] * number_y.shape[0], -1)


def _neighbours(
    number: int,
) -> tuple[tuple[np.ndarray, np.ndarray], Int[np.ndarray, "number number"]]:
    """The pairs of cubic splines that overlap, and which of them every two are."""
    first_spline, second_spline = np.triu_indices(number)
    is_overlapping = second_spline - first_spline < 4
    pairs = first_spline[is_overlapping], second_spline[is_overlapping]
    which = np.full((number, number), -1)
    which[pairs] = which[pairs[::-1]] = np.arange(is_overlapping.sum())
    return pairs, which


def given_points(is_used: Float[Array, "views points"]) -> Bool[Array, " points"]:
    """The points seen twice or more, whose errors views share."""
    return is_used.sum(0) > 1


def correlation_of_given(
    X: Float[Array, "points 3"],
    is_used: Float[Array, "views points"],
    settings: CorrelationSettings,
) -> Float[Array, "points points"]:
    """The correlation of the given points by their distances (`given_points`); 1 of others."""
    is_given = given_points(is_used)
    X = jnp.where(is_given[:, None], X, 0.0)
    pairs = is_given[:, None] & is_given
    distances = jnp.where(pairs, jnp.linalg.norm(X[:, None] - X, axis=2), 0.0)
    extent = jnp.maximum(distances.max(), jnp.finfo(float).tiny)
    K = correlation_of_points(distances, extent, jnp.eye(len(X)), settings.octaves)
    return jnp.where(pairs, K, jnp.eye(len(X)))


def effects_of_given(
    is_used: Float[Array, "views points"], by_point: Float[Array, "views 2 points 3"]
) -> Float[Array, "views 2 points 3"]:
    """The effects of errors of given points along the principal axes, those in the plane of the
    points and those across it each of a mean square of one in an image coordinate."""
    by_point = by_point * given_points(is_used)[:, None]
    squares = jnp.moveaxis(jnp.sum(by_point**2, 1), -1, 0)
    return by_point / jnp.sqrt(mean_squares_of_given(is_used, squares))


def mean_squares_of_given(
    is_used: Float[Array, "views points"], squares: Float[Array, "3 views points"]
) -> Float[Array, "3"]:
    """The mean squares of the effects of given points in an image coordinate that belong to each
    axis, from their `squares` in both coordinates: in the plane of both axes together."""
    is_given = given_points(is_used)
    rows = 2 * jnp.maximum(jnp.sum(is_used * is_given), 1)
    total = jnp.sum(squares * is_given, (1, 2))
    of_components = [
        jnp.broadcast_to(jnp.sum(total[axes]), total[axes].shape) for axes in GIVEN_AXES
    ]
    return jnp.maximum(jnp.concatenate(of_components), jnp.finfo(float).tiny) / rows


def correlation_of_views(
    unknowns: CameraUnknowns,
    is_used: Float[Array, "views points"],
    reach: float,
    sightings: Sightings,
) -> Float[Array, "views views"]:
    """The correlation of the views by the distance of their stations."""
    M = jax.vmap(matrix_from_quaternion)(unknowns.rotation)
    station = -jnp.einsum("vji,vj->vi", M, unknowns.shift)
    X = jnp.asarray(sightings.point)
    distance_to_points = jnp.linalg.norm(X[None] - station[:, None], axis=2)
    distance_of_stations = jnp.linalg.norm(station[:, None] - station, axis=2)
    return jnp.asarray(
        wendland(distance_of_stations / (reach * _median(distance_to_points, is_used > 0)))
    )


def _median(x: Float[Array, "*axes"], is_included: Bool[Array, "*axes"]) -> Float[Array, ""]:
    """The median of some of nonnegative numbers, without sorting: bits of such numbers are ordered
    as the numbers are, and the k-th is found by halving. 0.04 ms for 1760; sorted 0.17 ms."""
    bits = jax.lax.bitcast_convert_type(jnp.where(is_included, x, jnp.inf), jnp.int64)
    highest = jax.lax.bitcast_convert_type(jnp.inf, jnp.int64)
    number = jnp.sum(is_included)

    def halve(_: int, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = low + (high - low) // 2
        is_below = jnp.sum(bits <= middle) > (number - 1) // 2
        return jnp.where(is_below, low, middle + 1), jnp.where(is_below, middle, high)

    lower_median = jax.lax.fori_loop(0, 63, halve, (jnp.zeros_like(highest), highest))[1]
    # Of an even number the mean of the two in the middle.
    upper_median = jnp.where(bits > lower_median, bits, highest).min()
    upper_median = jnp.where(
        jnp.sum(bits <= lower_median) > number // 2, lower_median, upper_median
    )
    numbers = jax.lax.bitcast_convert_type(jnp.stack([lower_median, upper_median]), float)
    return jnp.mean(numbers)


def root_of_views(K: Float[Array, "views views"]) -> Float[Array, "views views"]:
    """A root of the correlation of the views, of which two may be of one station."""
    w, U = jnp.linalg.eigh(K)
    return U * jnp.sqrt(jnp.clip(w, 0, None))
