"""The kinds of observations of a refinement, in addition to those of photographs
(`network/kinds.py`).

| kind | residuals | touches |
|---|---|---|
| scanner coordinates | line, pixel | scanner image, sensor, point |
| control points | along the axes of the point | point |
| priors of corrections | every correction | scanner image, or sensor |

**Scanner.** The pose at the time t(l) of the measured line is known, so the condition is explicit
(`jaxbundle.pushbroom.ground_to_image.misclosure`): the slopes of the ray to the point, minus those
of the measured pixel,

    g = [−r/q − ξ(u), −s/q − η(u)],        [r, s, q] = Rᵀ(t)·(X̃ − P(t)),

with X̃ the apparent position of X with corrections. In lines and pixels,

    v = S·g,        S = −(∂g/∂(l, u))⁻¹,

the first Newton step from the measured position to the projected point: computed − observed up to
terms of v². S is evaluated at the start values and again at the solution, and held while the
equations are solved. The required trajectory and optics refer to the measured line and pixel: they
are computed once and stored with the measurement (`MeasuredLine`).

**Points.** X = X₀ + Aᵀ·δ with the axes A of the point (rows: east, north, up; or X, Y, Z), along
each of which it may be held, controlled with σ, or free.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.geometry.ellipsoid import Ellipsoid
from jaxbundle.leastsquares.declarations import Kind
from jaxbundle.leastsquares.indexing.indices import fill_up
from jaxbundle.leastsquares.spaces import Change, Vector
from jaxbundle.pushbroom.corrections import Corrections
from jaxbundle.pushbroom.ground_to_image import misclosure_of
from jaxbundle.pushbroom.image import LinePose, Offsets, PushbroomImage, move_pose, recorded_pose
from jaxbundle.refinement.freedom import (
    Form,
    Sizes,
    change_of,
    change_offsets,
    change_slopes,
    middle_and_half,
)
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar


class Placed(NamedTuple):
    """Points, and the axes (rows) of their changes."""

    position: Float[AnyArray, "*rows 3"]
    axes: Float[AnyArray, "*rows 3 3"]


# X and the axes as scalars (`leastsquares.spaces`)
PlacedBlock = tuple[tuple[Scalar, ...], tuple[tuple[Scalar, ...], ...]]


@dataclasses.dataclass(frozen=True)
class AlongAxes:
    """The space of `Placed`: a change is one along the axes, which are orthonormal."""

    width = 3

    def prepare(self, value: Placed) -> PlacedBlock:
        return tuple(value.position), tuple(map(tuple, value.axes))

    def move(self, block: PlacedBlock, change: Change) -> tuple[Scalar, ...]:
        X, axes = block
        steps = [tuple(d * x for x in axis) for d, axis in zip(change, axes)]
        return tuple(sum(parts) for parts in zip(X, *steps))

    def retract(self, value: Placed, change: Float[AnyArray, "3"]) -> Placed:
        return value._replace(position=value.position + change @ value.axes)

    # The axes of the origin: `retract` moves along them, and they do not change.
    def difference(self, value: Placed, origin: Placed) -> Float[Array, "3"]:
        return jnp.matmul(origin.axes, value.position - origin.position)

    def hold(self, value: Placed, start: Placed, free: Float[AnyArray, "3"]) -> Placed:
        return self.retract(start, free * self.difference(value, start))

    def chart(self, value: Placed) -> None:  # noqa: ARG002
        return None


@dataclasses.dataclass(frozen=True)
class VectorRow(Vector):
    """Many numbers that add, as one array: one operation instead of many scalars."""

    def prepare(self, value: Float[AnyArray, " k"]) -> Float[AnyArray, " k"]:
        return value

    def move(self, block: Float[Array, " k"], change: Change) -> Float[Array, " k"]:
        return block.at[jnp.array(self.moving)].add(jnp.stack(change)) if change else block


class MeasuredLine(NamedTuple):
    """What belongs to a measured line and pixel: the pose that the tables give, seconds from the
    middle line, offsets, mounting and axes F of the image; the coefficient of every unknown of the
    spline in the jitter; the slopes (ξ, η); 1, û, û², … by the coefficients across and along; S."""

    pose: LinePose
    dt: Scalar
    offsets: Offsets
    mounting: Float[AnyArray, "*n 3"]
    axes: Float[AnyArray, "*n 3 3"]
    jitter: Float[AnyArray, "*n k"]
    slopes: Float[AnyArray, "*n 2"]
    across: Float[AnyArray, "*n a"]
    along: Float[AnyArray, "*n b"]
    scale: Float[AnyArray, "*n 2 2"]


@dataclasses.dataclass(frozen=True)
class ScannerPoint:
    """v for a measured line and pixel; `sizes`: of the unknowns of an image and its sensor."""

    corrections: Corrections
    earth: Ellipsoid | None
    sizes: Sizes

    def __call__(
        self,
        unknowns_of_image: Float[AnyArray, " p"],
        sensor: Float[AnyArray, " q"],
        X: Float[AnyArray, "3"],
        line: MeasuredLine,
    ) -> Float[AnyArray, "2"]:
        """v = S·g, in lines and pixels."""
        return line.scale @ self.misclosure(unknowns_of_image, sensor, X, line)

    def misclosure(
        self,
        unknowns_of_image: Float[AnyArray, " p"],
        sensor: Float[AnyArray, " q"],
        X: Float[AnyArray, "3"],
        line: MeasuredLine,
    ) -> Float[Array, "2"]:
        """g: the slopes of the point minus those of the pixel."""
        change = change_of(self.sizes, jnp.concatenate([unknowns_of_image, sensor]))
        jitter = change.jitter @ line.jitter
        offsets = change_offsets(line.offsets, line.axes, change, jitter)
        pose = move_pose(line.pose, line.dt, offsets, line.mounting + change.mounting)
        added_slopes = line.across @ change.look_across, line.along @ change.look_along
        xi, eta = line.slopes
        slopes = change_slopes((xi, eta), change.focal_length, added_slopes)
        return misclosure_of(pose, slopes, X, self.corrections, self.earth)


def line_of(
    image: PushbroomImage,
    form: Form,
    origin: Float[AnyArray, "3"],
    place: Float[AnyArray, "2"],
) -> MeasuredLine:
    """What belongs to a measured (line, pixel), in coordinates relative to an origin; without S."""
    t = image.times.time(place[0])
    pose, (middle, half_width) = recorded_pose(image, t), middle_and_half(image)
    weights = form.spline.weights(t)
    powers = lambda n: jnp.array([((place[1] - middle) / half_width) ** k for k in range(n)])
    return MeasuredLine(
        pose._replace(P=pose.P - origin),
        t - image.middle_time,
        image.offsets,
        image.mounting,
        form.axes,
        jnp.pad(weights, (0, form.sizes.jitter // 3 - len(weights))),
        jnp.stack(image.optics.slopes(place[1])),
        powers(form.sizes.look_across),
        powers(form.sizes.look_along),
        jnp.eye(2),
    )


def lines_of(
    kind: ScannerPoint,
    image: PushbroomImage,
    form: Form,
    origin: Float[AnyArray, "3"],
    unknowns_of_image: Float[AnyArray, " p"],
    sensor: Float[AnyArray, " q"],
    X: Float[AnyArray, "n 3"],
    places: Float[AnyArray, "n 2"],
) -> tuple[MeasuredLine, Float[np.ndarray, "n 2"]]:
    """What belongs to the measured places of points X [n, 3] of an image, S where its corrections
    are `unknowns_of_image` and `sensor`; and v."""
    n = len(places)
    padded = fill_up(n)
    at_places = np.asarray(X)[padded], np.asarray(places)[padded]
    lines = _lines_of(kind, image, form, origin, unknowns_of_image, sensor, *at_places)
    return jax.tree.map(lambda x: np.asarray(x)[:n], lines)


@compile_once
def _lines_of(
    kind: ScannerPoint,
    image: PushbroomImage,
    form: Form,
    origin: Float[AnyArray, "3"],
    unknowns_of_image: Float[AnyArray, " p"],
    sensor: Float[AnyArray, " q"],
    X: Float[AnyArray, "n 3"],
    places: Float[AnyArray, "n 2"],
) -> tuple[MeasuredLine, Float[AnyArray, "n 2"]]:
    def line_and_residual(
        X: Float[AnyArray, "3"], place: Float[AnyArray, "2"]
    ) -> tuple[MeasuredLine, Float[AnyArray, "2"]]:
        def misclosure(place: Float[Array, "2"]) -> tuple[Array, tuple[Array, MeasuredLine]]:
            line = line_of(image, form, origin, place)
            g = kind.misclosure(unknowns_of_image, sensor, X, line)
            # ∂g/∂(l, u) needs the trajectory's own derivative by time; g and the line come with it
            return g, (g, line)

        slope, (g, line) = jax.jacfwd(misclosure, has_aux=True)(place)
        line = line._replace(scale=-jnp.linalg.inv(slope))
        return line, line.scale @ g

    return jax.vmap(line_and_residual)(X, places)


# Kinds are compared by their functions, as keys of compiled programs: a lambda in `control` or
# `priors` would be another one, and compiled again, for every refinement.
def _along_axes(X: Float[AnyArray, "3"], place: Placed) -> Float[AnyArray, "3"]:
    return place.axes @ (X - place.position)


def _itself(correction: Float[AnyArray, " k"], _: None) -> Float[AnyArray, " k"]:
    return correction


def scanner_points(residual: ScannerPoint) -> Kind:
    """Image points of scanner images with the same equations."""
    tables = ("scanner image", "sensor", "point")
    return Kind("scanner coordinates", residual, tables, ("line", "pixel"))


def control(axes: tuple[str, str, str]) -> Kind:
    """Given coordinates along the axes of points."""
    return Kind("control points", _along_axes, ("point",), axes, snooped="single")


def priors(table: str) -> Kind:
    """Priors of a table of corrections."""
    return Kind(f"corrections of every {table}", _itself, (table,), snooped="")
