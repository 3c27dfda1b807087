"""Values of a raster between its pixels: nearest, bilinear, cubic, lanczos.

Cubic is Keys' convolution with a = −½ (Keys, 1981, IEEE Trans. ASSP 29), exact for parabolas.
Lanczos is the windowed sinc of three lobes (Duchon, 1979, J. Appl. Meteorology 18),

    L(d) = sinc(d)·sinc(d/3) for |d| < 3,

its six weights divided by their sum, which is 1 within a hundredth: a constant image stays one.
Integers are pixel centres; up to half a pixel beyond the outer centres the values are extended;
farther out they are NaN, and also if a contributing pixel is NaN.

All bands of a pixel lie side by side, so that they are read together: 4 bands of 16 bits take a
quarter of the time of one band after the other. Whole numbers of up to 16 bits are exact in single
precision, in which their sums are computed.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jaxbundle.choices import RESAMPLINGS, Resampling
from jaxbundle.types import AnyArray, Scalar

# Pixels on each side of a position that contribute to its value.
REACH: dict[Resampling, int] = {"nearest": 1, "bilinear": 1, "cubic": 2, "lanczos": 3}


def resample(
    bands: Float[AnyArray, "bands rows columns"],
    row: Float[AnyArray, "*shape"],
    column: Float[AnyArray, "*shape"],
    kind: Resampling = "bilinear",
) -> Float[Array, "bands *shape"]:
    """The values of all bands at raster positions."""
    return jnp.moveaxis(resample_pixels(jnp.moveaxis(bands, 0, -1), row, column, kind), -1, 0)


def resample_pixels(
    pixels: Num[AnyArray, "rows columns bands"],
    row: Float[AnyArray, "*shape"],
    column: Float[AnyArray, "*shape"],
    kind: Resampling = "bilinear",
) -> Float[Array, "*shape bands"]:
    """The values of all bands at raster positions, in the precision of `working_type`."""
    rows, columns, _ = pixels.shape
    is_inside = (row >= -0.5) & (row <= rows - 0.5) & (column >= -0.5) & (column <= columns - 0.5)
    match kind:
        case "nearest":
            # Half to even: on the border of two pixels either serves.
            i, j = jnp.round(row).astype(int), jnp.round(column).astype(int)
            value = pixels[jnp.clip(i, 0, rows - 1), jnp.clip(j, 0, columns - 1)]
            value = value.astype(working_type(pixels.dtype))
        case "bilinear":
            value = _convolve(pixels, row, column, lambda x: (1 - x, x), 0)
        case "cubic":
            value = _convolve(pixels, row, column, _cubic_weights, 1)
        case "lanczos":
            value = _convolve(pixels, row, column, _lanczos_weights, 2)
        case _:
            raise ValueError(f"Unknown resampling {kind!r}; known: {RESAMPLINGS}")
    return jnp.where(is_inside[..., None], value, jnp.nan)


def working_type(dtype: np.dtype | str) -> np.dtype:
    """The type of sums of values of a type."""
    dtype = np.dtype(dtype)
    return np.dtype("float32" if dtype.itemsize <= 2 or dtype == "float32" else "float64")


def _convolve(
    pixels: Num[AnyArray, "rows columns bands"],
    row: Float[AnyArray, "*shape"],
    column: Float[AnyArray, "*shape"],
    weights: Callable[[Scalar], tuple[Scalar, ...]],
    lead: int,
) -> Array:
    """Products of one-dimensional weights of the pixels from `lead` before the position."""
    rows, columns, bands = pixels.shape
    working = working_type(pixels.dtype)
    i, j = jnp.floor(row), jnp.floor(column)
    weights_of = lambda place: [jnp.asarray(w)[..., None] for w in weights(place.astype(working))]
    row_weights, column_weights = (
        weights_of(jnp.asarray(row - i)),
        weights_of(jnp.asarray(column - j)),
    )
    # The index of a position that is NaN must be valid; its weights keep the value NaN.
    i, j = (jnp.nan_to_num(v).astype(jnp.int32) - lead for v in (i, j))
    flat = pixels.reshape(-1, bands)
    lines = [jnp.clip(i + k, 0, rows - 1) * columns for k in range(len(row_weights))]
    places = [jnp.clip(j + k, 0, columns - 1) for k in range(len(column_weights))]
    sum_of_row = lambda line: sum(
        w * flat[line + place].astype(working) for w, place in zip(column_weights, places)
    )
    return jnp.asarray(sum(w * sum_of_row(line) for w, line in zip(row_weights, lines)))


def _cubic_weights(x: Scalar) -> tuple[Scalar, ...]:
    """Weights of the pixels at −1, 0, 1, 2 for a position x in [0, 1].

    With the distance d, (a + 2)·d³ − (a + 3)·d² + 1 up to 1 and a·d³ − 5a·d² + 8a·d − 4a up to 2,
    a = −½.
    """
    inner = lambda d: 1 + d * d * (1.5 * d - 2.5)
    outer = lambda d: 2 + d * (-4 + d * (2.5 - 0.5 * d))
    return outer(1 + x), inner(x), inner(1 - x), outer(2 - x)


def _lanczos_weights(x: Scalar) -> tuple[Scalar, ...]:
    """Weights of the pixels at −2 … 3 for a position x in [0, 1].

    L(x − k) = 3·sin(π(x − k))·sin(π(x − k)/3)/(π(x − k))². Sines of x − k follow from those of x;
    the factor 3/π² is divided out with the sum of the weights.
    """
    angle = jnp.pi / 3 * x
    sine, sine_of_third, cosine_of_third = jnp.sin(3 * angle), jnp.sin(angle), jnp.cos(angle)
    weights = []
    for k in range(-2, 4):
        d, turn = x - k, np.pi / 3 * k
        at_pixel = jnp.abs(d) < 1e-6  # where L is 1 within rounding
        third = sine_of_third * float(np.cos(turn)) - cosine_of_third * float(np.sin(turn))
        ratio = sine * third / jnp.where(at_pixel, 1, d * d) * (-1) ** k
        weights.append(jnp.where(at_pixel, jnp.pi**2 / 3, ratio))
    total = sum(weights)
    return tuple(w / total for w in weights)
