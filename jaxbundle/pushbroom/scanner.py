"""A detector line: exposure times of lines, and viewing directions of pixels.

Line l and pixel u are counted from 0, integers at the centres: pixel 0 of line 0 is the first
pixel, its area from −½ to ½. A pixel looks along [ξ, η, −1] in the camera frame: ξ to the
right, η forward, both tangents of angles. Three kinds of optics:

- `FocalLine`: detectors at (x, y) = (pitch·(u − middle), row) in the focal plane of a frame camera,
  so that principal distance, principal point and every distortion of `jaxbundle.cameras` apply;
- `AngleTable`: angles ψ across and along for every pixel, ξ = tan ψ, linear in between;
- `AnglePolynomial`: the tangents as polynomials of û = (u − middle)/half.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from jaxbundle.cameras import get_model, image_ray
from jaxbundle.pushbroom.polynomial import value
from jaxbundle.types import AnyArray, Scalar

Pair = tuple[Scalar, Scalar]


class LineTimes(eqx.Module):
    """Line l is exposed at first + period·l, or at times of a table, interpolated linearly;
    seconds."""

    first: Float[AnyArray, ""]
    period: Float[AnyArray, ""]
    table: Float[AnyArray, " lines"] | None = None

    def time(self, line: Scalar) -> Scalar:
        """The time of a line."""
        if self.table is None:
            return self.first + self.period * line
        return _interpolate(self.table, line)

    def line(self, t: Scalar) -> Scalar:
        """The line of a time."""
        if self.table is None:
            return (t - self.first) / self.period
        # The inverse of `_interpolate`, continued in the same way beyond the ends.
        rows = jnp.searchsorted(self.table, t, side="right") - 1
        row = jnp.clip(rows, 0, len(self.table) - 2)
        start, end = self.table[row], self.table[row + 1]
        return row + (t - start) / (end - start)


class Optics(eqx.Module):
    """The viewing directions of the pixels of the line."""

    @abc.abstractmethod
    def slopes(self, u: Scalar) -> Pair:
        """(ξ, η) of the pixel u."""


class FocalLine(Optics):
    """Detectors on a straight line in the focal plane of the camera `model`.

    `parameters` of the model, in its unit; `pitch` in this unit a pixel; `middle` the pixel at
    x = 0; `row` the y of the line.
    """

    parameters: Float[AnyArray, " p"]
    pitch: Float[AnyArray, ""]
    middle: Float[AnyArray, ""]
    row: Float[AnyArray, ""]
    model: str = eqx.field(static=True, default="brown")

    def slopes(self, u: Scalar) -> Pair:
        model = get_model(self.model)
        x = self.pitch * (u - self.middle)
        r, s, q = image_ray(model, tuple(self.parameters), x, self.row + 0 * x)
        return -r / q, -s / q


class AngleTable(Optics):
    """Angles in radians for every pixel."""

    across: Float[AnyArray, " pixels"]
    along: Float[AnyArray, " pixels"]

    def slopes(self, u: Scalar) -> Pair:
        return jnp.tan(_interpolate(self.across, u)), jnp.tan(_interpolate(self.along, u))


class AnglePolynomial(Optics):
    """Tangents ξ and η as polynomials of û, coefficients from the constant upwards."""

    across: Float[AnyArray, " k"]
    along: Float[AnyArray, " m"]
    middle: Float[AnyArray, ""]
    half: Float[AnyArray, ""]

    def slopes(self, u: Scalar) -> Pair:
        x = (u - self.middle) / self.half
        zero = jnp.zeros_like(x)  # a constant has the shape of x too
        return zero + value(self.across, x), zero + value(self.along, x)


def slopes_of(optics: Optics, pixels: Float[AnyArray, " n"]) -> Pair:
    """(ξ, η) of many pixels."""
    return jax.vmap(optics.slopes)(pixels)


def _interpolate(values: Float[AnyArray, " n"], place: Scalar) -> Scalar:
    """Linear interpolation; the first and last step continue beyond the ends."""
    i = jnp.clip(jnp.floor(place).astype(int), 0, len(values) - 2)
    part = place - i
    return (1 - part) * values[i] + part * values[i + 1]
