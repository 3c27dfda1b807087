"""The roots of the error components of a camera of a batch, as programs (`correlated`).

The formulas are those of `adjustment.quality.correlated_errors` and `given_points`, without
indices: arrays are [views, points], masked.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbundle.adjustment.quality.correlated_errors import CorrelationSettings, cubic_splines
from jaxbundle.adjustment.quality.given_points import correlation_of_points, wendland
from jaxbundle.batches.normal import CameraUnknowns, Sightings
from jaxbundle.geometry import matrix_from_quaternion


def fields_of_camera(
    xy: Float[Array, "views points 2"],
    used: Float[Array, "views points"],
    settings: CorrelationSettings,
) -> tuple[
    Float[Array, "views points splines"],
    Float[Array, "splines splines"],
    Float[Array, "splines splines"],
    Float[Array, "views 2 points 5"],
]:
    """The finest splines B on the sensor and the root R of all octaves in them, of a mean square of
    one, with (BR)ᵀBR; displacements by view: of the principal point, of the distance and affine
    ones, of size 1 at the edge of the measured area."""
    there = used[..., None] > 0
    low = jnp.min(jnp.where(there, xy, jnp.inf), (0, 1))
    high = jnp.max(jnp.where(there, xy, -jnp.inf), (0, 1))
    size = (high - low) / 2
    at = (xy - (low + high) / 2) / jnp.max(size)
    at = jnp.where(there, at, 0.0)
    place = (at / (size / jnp.max(size)) + 1) / 2
    x, y = (cubic_splines(place[..., k], settings.knots[k]) for k in (0, 1))
    # not computed again for every product
    x, y = jax.lax.optimization_barrier((x, y * used[..., None]))
    B = y[..., :, None].astype(jnp.float32) * x[..., None, :].astype(jnp.float32)
    B = B.reshape(*used.shape, -1)
    gram = _gram_of_products(x.reshape(-1, x.shape[-1]), y.reshape(-1, y.shape[-1]))
    octaves = jnp.asarray(root_of_octaves(settings))
    gram = octaves.T @ gram @ octaves
    square = jnp.trace(gram) / jnp.sum(used)
    gram, octaves = gram / square, octaves / jnp.sqrt(square)
    x, y = at[..., 0] * used, at[..., 1] * used
    none = jnp.zeros_like(used)
    of_x = jnp.stack([used, none, x, x, y], -1)
    of_y = jnp.stack([none, used, y, -y, x], -1)
    return B, octaves, gram, jnp.stack([of_x, of_y], 1)


def _gram_of_products(
    x: Float[Array, "rays columns"], y: Float[Array, "rays rows"]
) -> Float[Array, "splines splines"]:
    """BᵀB of the products B of splines of x and of y, of which only neighbours overlap."""
    (left, number_x), (right, number_y) = (_neighbours(a.shape[1]) for a in (x, y))
    product = lambda a, pairs: a[:, pairs[0]] * a[:, pairs[1]]
    found = product(x, left).T @ product(y, right)
    found = jnp.pad(found, [(0, 1), (0, 1)])  # those that do not overlap
    full = found[number_x[None, :, None, :], number_y[:, None, :, None]]
    return full.reshape(number_x.shape[0] * number_y.shape[0], -1)


def _neighbours(
    number: int,
) -> tuple[tuple[np.ndarray, np.ndarray], Int[np.ndarray, "number number"]]:
    """The pairs of cubic splines that overlap, and which of them every two are."""
    first, second = np.triu_indices(number)
    near = second - first < 4
    pairs = first[near], second[near]
    which = np.full((number, number), -1)
    which[pairs] = which[pairs[::-1]] = np.arange(near.sum())
    return pairs, which


def root_of_octaves(settings: CorrelationSettings) -> Float[np.ndarray, "splines splines"]:
    """R with B·R·(B·R)ᵀ the sum of all octaves, B: the finest splines, of which those of octaves
    with half as many intervals are sums."""
    finest, *coarser = settings.octaves_of_knots
    # a cubic spline between two knots is determined by four places
    places = [np.linspace(0, 1, 4 * n) for n in finest]
    total = np.eye(finest[0] * finest[1])
    for octave in coarser:
        x, y = (
            np.linalg.lstsq(cubic_splines(at, n), cubic_splines(at, m), rcond=None)[0]
            for at, n, m in zip(places, finest, octave)
        )
        total += np.kron(y @ y.T, x @ x.T)
    return np.linalg.cholesky(total)


def effects_of_points(
    X: Float[Array, "points 3"],
    used: Float[Array, "views points"],
    by_point: Float[Array, "views 2 points 3"],
    settings: CorrelationSettings,
) -> tuple[Float[Array, "views 2 points 3"], Float[Array, "points points"]]:
    """The effects of errors of points seen twice or more, of a mean square of one in an image
    coordinate, and a root of the correlation of the points (`given_points`)."""
    given = used.sum(0) > 1
    X = jnp.where(given[:, None], X, 0.0)
    pairs = given[:, None] & given
    apart = jnp.where(pairs, jnp.linalg.norm(X[:, None] - X, axis=2), 0.0)
    extent = jnp.maximum(apart.max(), jnp.finfo(float).tiny)
    K = correlation_of_points(apart, extent, jnp.eye(len(X)), settings.octaves)
    K = jnp.where(pairs, K, jnp.eye(len(X)))
    by_point = by_point * given[:, None]
    rows = 2 * jnp.maximum(jnp.sum(used * given), 1)
    scale = jnp.sqrt(jnp.maximum(jnp.sum(by_point**2), jnp.finfo(float).tiny) / rows)
    return by_point / scale, jnp.linalg.cholesky(K)


def root_of_views(
    at: CameraUnknowns, used: Float[Array, "views points"], reach: float, seen: Sightings
) -> Float[Array, "views views"]:
    """A root of the correlation of the views by the distance of their stations."""
    M = jax.vmap(matrix_from_quaternion)(at.rotation)
    station = -jnp.einsum("vji,vj->vi", M, at.shift)
    X = jnp.asarray(seen.point)
    away = jnp.linalg.norm(X[None] - station[:, None], axis=2)
    depth = jnp.nanmedian(jnp.where(used > 0, away, jnp.nan))
    apart = jnp.linalg.norm(station[:, None] - station, axis=2) / (reach * depth)
    w, U = jnp.linalg.eigh(wendland(apart))
    return U * jnp.sqrt(jnp.clip(w, 0, None))
