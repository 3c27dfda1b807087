"""Ground errors due to errors of the ancillary data: by propagation and by Monte Carlo.

Propagation: with J the derivative of the horizontal ground coordinates by every single error (bias,
drift, each row), by automatic differentiation through the whole chain, the covariance is

    Σ = J·diag(σ²)·Jᵀ,     RMS = √(tr Σ),

and CE90, the radius with 90 % of the errors inside, follows from its eigenvalues λ₁, λ₂: with s, c
normally distributed, P(λ₁·s² + λ₂·c² ≤ CE90²) = 0.9. For a nadir-looking camera h above a plane,
with V = tan(FOV/2), an error of attitude gives over the line

    RMS = h·√[(1 + 2V²/3 + V⁴/5)·σ_roll² + σ_pitch² + V²/3·σ_yaw²].

Monte Carlo: the same errors are drawn, the ground coordinates recomputed, quantiles counted.

Errors of interpolation vanish at the records of a table, and white noise is averaged between them:
lines at regular steps that fall on records, or between them, give a wrong RMS. `spread_positions`
are irregular.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped
from scipy.optimize import brentq

from jaxbundle.geometry.ellipsoid import geodetic
from jaxbundle.geometry.vectors import Vector, difference
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.image_to_ground import locate_point
from jaxbundle.pushbroom.noise import Errors, Noise, add_errors, draw, sigmas, zero_errors
from jaxbundle.pushbroom.surfaces import GroundSurface
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar


def spread_positions(
    lines: int, pixels: int, cells: tuple[int, int] = (1, 1), least: int = 1000
) -> tuple[Float[np.ndarray, "rows columns n"], Float[np.ndarray, "rows columns n"]]:
    """Irregular lines and pixels, the same number in each of rows × columns cells of an image.

    At least `least` in all: an RMS of a thousand independent errors has a standard deviation of
    1/√(2·1000) = 2 %, and less with one line in each thousandth part of the image. In every row of
    cells each of equal parts of the lines holds one position, at random within it; across a cell
    they follow multiples of the golden ratio (a low-discrepancy sequence; Niederreiter, 1992,
    chapter 3).
    """
    rows, columns = cells
    n = -(-least // (rows * columns))
    rng = np.random.default_rng(0)
    # Each row of cells deals its parts of the lines to its columns at random.
    dealt_columns = rng.permuted(np.tile(np.arange(columns), (rows, n, 1)), axis=2)
    part = np.moveaxis(columns * np.arange(n)[:, None] + dealt_columns, 2, 1)
    line_fraction = (part + rng.random(part.shape)) / (columns * n)
    pixel_fraction = (np.arange(part.size).reshape(part.shape) * (np.sqrt(5) - 1) / 2) % 1
    row, column = np.arange(rows)[:, None, None], np.arange(columns)[:, None]
    place = lambda within, cell, count, size: (cell + within) * size / count - 0.5
    return place(line_fraction, row, rows, lines), place(pixel_fraction, column, columns, pixels)


class GroundAccuracy(eqx.Module):
    """Errors east and north (X and Y in a local frame) at image positions, metres.

    `covariance` [n, 2, 2]; `rms` [n] of the length; `ce90` [n], all NaN where a ray misses the
    surface; `overall_ce90` of the errors at all other positions together, NaN if there are none.
    """

    covariance: Float[np.ndarray, "n 2 2"]
    rms: Float[np.ndarray, " n"]
    ce90: Float[np.ndarray, " n"]
    overall_ce90: float

    @property
    def overall(self) -> float:
        """The RMS over all positions whose rays meet the surface; NaN if there are none."""
        finite_rms = self.rms[np.isfinite(self.rms)]
        return float(np.sqrt(np.mean(finite_rms**2))) if len(finite_rms) else np.nan


def propagate_accuracy(
    image: PushbroomImage,
    surface: GroundSurface,
    lines: Float[np.ndarray, " n"],
    pixels: Float[np.ndarray, " n"],
    noise: Noise,
) -> GroundAccuracy:
    """The accuracy by propagation of covariances, exact to first order."""
    sigma = {
        name: values
        for name, values in sigmas(image, noise)._asdict().items()
        if np.any(getattr(noise, name))
    }
    # Without errors: one kind of σ 0, so that accuracies are 0 where rays meet the surface.
    sigma = sigma or {"position_bias": np.zeros(3)}
    covariance = np.asarray(_covariances(image, surface, lines, pixels, sigma))
    rms = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    ce90 = np.array([circular_error(c) for c in covariance])
    is_finite = np.isfinite(rms)
    overall_ce90 = circular_error(covariance[is_finite]) if is_finite.any() else np.nan
    return GroundAccuracy(covariance, rms, ce90, overall_ce90)


def simulate_accuracy(
    image: PushbroomImage,
    surface: GroundSurface,
    lines: Float[np.ndarray, " n"],
    pixels: Float[np.ndarray, " n"],
    noise: Noise,
    draws: int = 1000,
    seed: int = 0,
) -> GroundAccuracy:
    """The accuracy by Monte Carlo."""
    keys = jax.random.split(jax.random.key(seed), draws)
    errors = np.asarray(_simulate_errors(image, surface, lines, pixels, sigmas(image, noise), keys))
    covariance = np.einsum("dni,dnj->nij", errors, errors) / draws
    length = np.linalg.norm(errors, axis=2)
    rms = np.sqrt(np.mean(length**2, 0))
    is_finite = np.isfinite(rms)
    return GroundAccuracy(
        covariance,
        rms,
        np.quantile(length, 0.9, axis=0),
        float(np.quantile(length[:, is_finite], 0.9)) if is_finite.any() else np.nan,
    )


def ground_errors(
    image: PushbroomImage,
    truth: PushbroomImage,
    surface: GroundSurface,
    lines: Float[np.ndarray, " n"],
    pixels: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 2"]:
    """East and north location errors of image positions, metres."""
    return np.asarray(_ground_differences(image, truth, surface, lines, pixels))


def closed_form(
    height: float, field_of_view: float, roll: float, pitch: float, yaw: float
) -> float:
    """The RMS over a line of a nadir-looking camera above a plane, for σ of its angles in
    radians."""
    V = np.tan(field_of_view / 2)
    roll_term = (1 + 2 * V**2 / 3 + V**4 / 5) * roll**2
    return float(height * np.sqrt(roll_term + pitch**2 + V**2 / 3 * yaw**2))


def circular_error(covariance: Float[np.ndarray, "*n 2 2"], fraction: float = 0.9) -> float:
    """The radius of a circle that contains this fraction of normally distributed errors.

    For several covariances: of a mixture with equal weights.
    """
    variances = np.maximum(np.linalg.eigvalsh(covariance).reshape(-1, 2, 1), 0)
    large = variances.max()
    if not large > 0:
        return 0.0 if large == 0 else np.nan
    # P(outside) in polar coordinates is the mean over all directions of exp(−r²/2σ²), σ along the
    # direction in axes of unit variance: a smooth periodic function, whose mean over equal steps
    # converges faster than any power of their number (2000 also serve λ₁ ≫ λ₂)
    angle = (np.arange(2000) + 0.5) * np.pi / 2000
    minor, major = variances.swapaxes(0, 1) / large
    stretch = major * np.cos(angle) ** 2 + minor * np.sin(angle) ** 2
    # λ₂ = 0 leaves directions without extent; r²/1e-300 does not overflow and its exponential is 0
    stretch = np.maximum(stretch, 1e-300)
    # Ten times the largest σ is outside any fraction that double precision tells from 1.
    excess = lambda r: np.mean(np.exp(-(r**2) / (2 * stretch))) - (1 - fraction)
    return float(np.sqrt(large) * brentq(excess, 0.0, 10.0))


@partial(compile_once, static=())
def _covariances(
    image: PushbroomImage,
    surface: GroundSurface,
    lines: Float[AnyArray, " n"],
    pixels: Float[AnyArray, " n"],
    sigma: dict[str, AnyArray],
) -> Float[Array, "n 2 2"]:
    """Σ = Σₖ (Jₖ·σₖ)·(Jₖ·σₖ)ᵀ over the kinds k of errors in `sigma`.

    Kinds without errors are left out by the caller: the rows of a table are thousands of columns of
    J. J has two rows and many columns, hence reverse mode.
    """
    no_rows = jnp.zeros((0, 3))
    no_errors = zero_errors(image)._replace(attitude_white=no_rows, position_white=no_rows)
    zero = jax.tree.map(jnp.zeros_like, sigma)

    def covariance_at(line: Scalar, pixel: Scalar) -> Float[Array, "2 2"]:
        X0 = locate_point(image, surface, line, pixel)
        axes = east_north(surface, X0)
        move = lambda errors: horizontal(
            axes,
            X0,
            locate_point(add_errors(image, no_errors._replace(**errors)), surface, line, pixel),
        )
        J = jax.jacrev(move)(zero)
        parts = [(J[name] * sigma[name]).reshape(2, -1) for name in sigma]
        covariance = sum((part @ part.T for part in parts), jnp.zeros((2, 2)))
        # A ray that misses has no point; the derivative of "not a number" may still be 0.
        return jnp.where(jnp.isnan(jnp.stack([*X0])).any(), jnp.nan, covariance)

    places = jnp.asarray(lines), jnp.asarray(pixels)
    # Each position of a batch needs its own copy of the tables and of their derivatives.
    return jax.lax.map(lambda place: covariance_at(*place), places, batch_size=128)


@partial(compile_once, static=())
def _simulate_errors(
    image: PushbroomImage,
    surface: GroundSurface,
    lines: Float[AnyArray, " n"],
    pixels: Float[AnyArray, " n"],
    sigma: Errors,
    keys: Shaped[AnyArray, " draws"],
) -> Float[Array, "draws n 2"]:
    def errors_of_draw(key: Shaped[AnyArray, ""]) -> Float[Array, "n 2"]:
        erring_image = add_errors(image, draw(sigma, key))
        return _ground_differences(erring_image, image, surface, lines, pixels)

    # One draw after the other: a batch of draws would be as many copies of image and positions.
    return jax.lax.map(errors_of_draw, keys)


@partial(compile_once, static=())
def _ground_differences(
    image: PushbroomImage,
    truth: PushbroomImage,
    surface: GroundSurface,
    lines: Float[AnyArray, " n"],
    pixels: Float[AnyArray, " n"],
) -> Float[Array, "n 2"]:
    def difference_at(line: Scalar, pixel: Scalar) -> Float[Array, "2"]:
        X0 = locate_point(truth, surface, line, pixel)
        X = locate_point(image, surface, line, pixel)
        return horizontal(east_north(surface, X0), X0, X)

    return jax.vmap(difference_at)(lines, pixels)


def east_north(surface: GroundSurface, X: Vector) -> Float[Array, "2 3"]:
    """The unit vectors east and north at X; along X and Y of a local frame."""
    if surface.earth is None:
        return jnp.eye(3)[:2]
    longitude, latitude, _ = geodetic(surface.earth, X)
    s, c, z = jnp.sin(longitude), jnp.cos(longitude), jnp.sin(latitude)
    east = jnp.stack([-s, c, 0 * s])
    return jnp.stack([east, jnp.stack([-z * c, -z * s, jnp.cos(latitude)])])


def horizontal(axes: Float[AnyArray, "2 3"], X0: Vector, X: Vector) -> Float[Array, "2"]:
    """X − X0 along the axes, metres."""
    return jnp.asarray(axes) @ jnp.stack(difference(X, X0))
