"""The unknowns of a scanner image, their names, and the resulting image.

| unknown | number | unit | about |
|---|---|---|---|
| `attitude` | 3 | rad | bias of pitch, roll, yaw |
| `attitude_rate` | 3 | rad/s | drift, from the middle line on |
| `jitter` | 3·k | rad | spline of pitch, roll, yaw (`spline`) |
| `position` | 3 | m | bias across, along the track, up |
| `position_rate` | 3 | m/s | drift |
| `focal_length` | 1 | – | relative change e: all slopes divided by 1 + e |
| `mounting` | 3 | rad | pitch, roll, yaw of the camera in the platform |
| `look_across`, `look_along` | any | – | Δξ, Δη as polynomials of û = (u − middle)/half |

The last three belong to the sensor and may be shared by its images:

    R(t) = R_table(t)·exp([a + ȧ·(t − t₀) + s(t)]×)·R_mounting,     P(t) = P_table(t) + F·(p + ṗ·(t − t₀))
    (ξ, η) = optics(u)/(1 + e) + (Σ aᵢ·ûⁱ, Σ bᵢ·ûⁱ)

with F the axes across, along, up at the middle line.
"""  # noqa: E501

import dataclasses
import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.geometry.ellipsoid import Ellipsoid
from jaxbundle.pushbroom.image import Offsets, PushbroomImage
from jaxbundle.pushbroom.scanner import AnglePolynomial, Optics, Pair
from jaxbundle.pushbroom.trajectory import orbital_frame, position_at, velocity_at
from jaxbundle.refinement.spline import NO_SPLINE, JitterSpline, make_spline
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar

Three = tuple[float, float, float]
HELD: Three = (0.0, 0.0, 0.0)
FREE: Three = (math.inf, math.inf, math.inf)

ARCSECONDS_PER_RADIAN = math.degrees(1) * 3600

TURNS = ("pitch", "roll", "yaw")
TRACK = ("across track", "along track", "up")
OF_SENSOR = ("focal_length", "mounting", "look_across", "look_along")


@dataclasses.dataclass(frozen=True)
class Freedom:
    """The prior σ of every unknown: 0 held, infinite free without prior.

    In the units of the table above; `jitter` is the σ of the spline's coefficients,
    `knot_spacing` in seconds.
    """

    attitude: Three = HELD
    attitude_rate: Three = HELD
    jitter: Three = HELD
    knot_spacing: float = 0.25
    position: Three = HELD
    position_rate: Three = HELD
    focal_length: float = 0.0
    mounting: Three = HELD
    look_across: tuple[float, ...] = ()
    look_along: tuple[float, ...] = ()


class Change(NamedTuple):
    """The unknowns of an image, zero for the given trajectory and optics."""

    attitude: Float[AnyArray, "3"]
    attitude_rate: Float[AnyArray, "3"]
    jitter: Float[AnyArray, "3 k"]
    position: Float[AnyArray, "3"]
    position_rate: Float[AnyArray, "3"]
    focal_length: Float[AnyArray, ""]
    mounting: Float[AnyArray, "3"]
    look_across: Float[AnyArray, " a"]
    look_along: Float[AnyArray, " b"]


class Sizes(NamedTuple):
    """The size of each unknown of a `Change`."""

    attitude: int
    attitude_rate: int
    jitter: int
    position: int
    position_rate: int
    focal_length: int
    mounting: int
    look_across: int
    look_along: int


# At least one number of each unknown: an array without elements would be another program.
SMALLEST_SIZES = Sizes(3, 3, 3, 3, 3, 1, 3, 1, 1)


class ChangedOptics(Optics):
    """(ξ, η) of `base` divided by 1 + e, and polynomials added."""

    base: Optics
    relative_change: Float[AnyArray, ""]
    polynomials: AnglePolynomial

    def slopes(self, u: Scalar) -> Pair:
        return change_slopes(self.base.slopes(u), self.relative_change, self.polynomials.slopes(u))


def change_slopes(slopes: Pair, relative: Scalar, added_slopes: Pair) -> Pair:
    """(ξ, η)/(1 + e) and what is added."""
    (xi, eta), (more_xi, more_eta) = slopes, added_slopes
    return xi / (1 + relative) + more_xi, eta / (1 + relative) + more_eta


class UnknownName(NamedTuple):
    """One unknown for reports: `owner`, e.g. "image A"; its name; its unit in reports, and the
    factor from the adjustment's unit. `group`: name for grouping in weak directions."""

    owner: str
    parameter: str
    unit: str
    factor: float
    group: str

    def __str__(self) -> str:
        return f"{self.parameter} of {self.owner}"


class Form(eqx.Module):
    """The constants of the unknowns of an image: axes F, spline, and the size of each unknown in
    its vector, possibly padded."""

    axes: Float[AnyArray, "3 3"]
    spline: JitterSpline = eqx.field(static=True)
    sizes: Sizes = eqx.field(static=True)

    @property
    def image_unknowns(self) -> int:
        """The number of the image's own unknowns; those of its sensor follow."""
        return sum(self.sizes) - sum(getattr(self.sizes, name) for name in OF_SENSOR)


def make_form(image: PushbroomImage, earth: Ellipsoid | None, freedom: Freedom) -> Form:
    """The form of the unknowns of one image."""
    spline = NO_SPLINE
    if any(freedom.jitter):
        begin, end = (float(image.times.time(line)) for line in (-0.5, image.lines - 0.5))
        spline = make_spline(begin, end, freedom.knot_spacing)
    axes = _axes(image, earth is None)
    number_across, number_along = len(freedom.look_across), len(freedom.look_along)
    return Form(
        axes, spline, Sizes(3, 3, 3 * spline.unknowns, 3, 3, 1, 3, number_across, number_along)
    )


@compile_once
def _axes(image: PushbroomImage, local: bool) -> Float[Array, "3 3"]:
    """F: across, along, up at the middle line."""
    t, trajectory = image.middle_time, image.trajectory
    # In a local frame the centre of the Earth is nowhere; up is Z.
    vertical = jnp.array([0.0, 0.0, 1.0]) if local else position_at(trajectory, t)
    return orbital_frame(vertical, velocity_at(trajectory, t))


def pad_forms(forms: list[Form]) -> list[Form]:
    """The forms padded to the largest size of each unknown, at least one.

    All images are then rows of one table; numbers that an image does not have are held.
    """
    sizes = Sizes(*map(max, zip(SMALLEST_SIZES, *(form.sizes for form in forms))))
    return [dataclasses.replace(form, sizes=sizes) for form in forms]


def change_of(sizes: Sizes, p: Float[AnyArray, " n"]) -> Change:
    """The unknowns of one image out of their vector."""
    parts = Change(*jnp.split(p, np.cumsum(sizes)[:-1]))
    return parts._replace(jitter=parts.jitter.reshape(3, -1), focal_length=parts.focal_length[0])


def change_image(image: PushbroomImage, form: Form, change: Change, t: Scalar) -> PushbroomImage:
    """The image at the time t with its unknowns changed."""
    jitter = form.spline.evaluate(change.jitter, t)
    return dataclasses.replace(
        image,
        offsets=change_offsets(image.offsets, form.axes, change, jitter),
        mounting=image.mounting + change.mounting,
        optics=change_optics(image, change),
    )


def change_offsets(
    old: Offsets, axes: Float[AnyArray, "3 3"], change: Change, jitter: Float[AnyArray, "3"]
) -> Offsets:
    """The offsets with attitude and position changed."""
    return Offsets(
        old.attitude + change.attitude + jitter,
        old.attitude_rate + change.attitude_rate,
        old.position + axes @ change.position,
        old.position_rate + axes @ change.position_rate,
    )


def change_optics(image: PushbroomImage, change: Change) -> ChangedOptics:
    """The optics with focal length and look angles changed."""
    # A zero coefficient more: a polynomial must have one.
    pad = lambda a: jnp.concatenate([a, jnp.zeros(1)])
    middle, half_width = middle_and_half(image)
    added_angles = AnglePolynomial(
        pad(change.look_across),
        pad(change.look_along),
        jnp.asarray(middle),
        jnp.asarray(half_width),
    )
    return ChangedOptics(image.optics, change.focal_length, added_angles)


def middle_and_half(image: PushbroomImage) -> tuple[float, float]:
    """Middle and half length of the detector line, in pixels."""
    return (image.pixels - 1) / 2, image.pixels / 2


def priors(form: Form, freedom: Freedom) -> Float[np.ndarray, " n"]:
    """The σ of every number of an image's vector; NaN where it has no such unknown."""
    room = lambda sigma, n: np.r_[sigma, np.full(n - len(sigma), np.nan)]
    freedom_of_image, sizes, spline_unknowns = freedom, form.sizes, form.spline.unknowns
    jitter = [
        room(np.repeat(s, spline_unknowns), sizes.jitter // 3) for s in freedom_of_image.jitter
    ]
    return np.concatenate(
        [
            freedom_of_image.attitude,
            freedom_of_image.attitude_rate,
            *jitter,
            freedom_of_image.position,
            freedom_of_image.position_rate,
            [freedom_of_image.focal_length],
            freedom_of_image.mounting,
            room(freedom_of_image.look_across, sizes.look_across),
            room(freedom_of_image.look_along, sizes.look_along),
        ]
    )


def names(sizes: Sizes, image: str, sensor: str) -> list[UnknownName]:
    """The name of every number of an image's vector."""
    image, sensor = f"image {image}", f"sensor {sensor}"
    arcsec = ARCSECONDS_PER_RADIAN
    listed = [UnknownName(image, f"{x} bias", "arcsec", arcsec, f"{x} bias") for x in TURNS]
    listed += [UnknownName(image, f"{x} drift", "arcsec/s", arcsec, f"{x} drift") for x in TURNS]
    listed += [
        UnknownName(image, f"{x} jitter {k + 1}", "arcsec", arcsec, f"{x} jitter")
        for x in TURNS
        for k in range(sizes.jitter // 3)
    ]
    listed += [UnknownName(image, f"position {x}", "m", 1.0, f"position {x}") for x in TRACK]
    listed += [UnknownName(image, f"velocity {x}", "m/s", 1.0, f"velocity {x}") for x in TRACK]
    listed += [UnknownName(sensor, "focal length (relative)", "ppm", 1e6, "focal length")]
    listed += [
        UnknownName(sensor, f"mounting {x}", "arcsec", arcsec, f"mounting {x}") for x in TURNS
    ]
    for word, number in (("across", sizes.look_across), ("along", sizes.look_along)):
        listed += [
            UnknownName(
                sensor, f"look angle {word}, û^{k}", "1e-6", 1e6, f"look angle {word}, û^{k}"
            )
            for k in range(number)
        ]
    return listed
